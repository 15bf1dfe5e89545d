"""The command ``zoomjax reproduce``."""

from .._core.text import plain
from ._jax import set_up_jax
from .arguments import Overwrite
from .commands import app
from .console import show_table, stages
from .options import ResultsFolder


@app.command(epilog="Example: `zoomjax reproduce -o paper`")
def reproduce(
    output: ResultsFolder,
    overwrite: Overwrite = False,
) -> None:
    """Repeat the two experiments of Alvarez et al. (2012) on synthetic scenes.

    The paper's images are not public, so the scenes are made from its
    published numbers. Writes reproduce.md, with the tables next to those of
    the paper, Figures 5 to 10 as PNG and PDF, and reproduce.json.
    """
    set_up_jax()
    from rich.table import Table

    from . import reproduce as again
    from .results_folder import results_folder

    with results_folder(output, again.FILES, overwrite=overwrite) as folder, stages() as stage:
        experiments = again.reproduce(folder, stage)
    for title, experiment in zip(("Table 1, striped board", "Table 2, football"), experiments, strict=True):
        table = Table("", title=f"\n{title}: RMS residuals", title_justify="left", box=None)
        for column in ("the paper", "here", "difference"):
            table.add_column(column, justify="right", no_wrap=True)
        for row in experiment.rows:
            table.add_row(row.name, *row.cells())
        show_table(table, highlight=False)
    print(
        "\nAll scenes are synthetic. Tables, figures and the origin of each number are in "
        f"{plain(str(output / 'reproduce.md'))}."
    )
