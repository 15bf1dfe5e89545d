"""The command ``zoomjax lens``."""

from pathlib import Path
from typing import Annotated

import typer

from .._core.text import plain
from ._jax import set_up_jax
from .arguments import size_of
from .commands import app
from .options import place


@app.command(epilog='Example: `zoomjax lens "nikkor 18-200 ii" -o lens.json`')
def lens(
    search: Annotated[
        str, typer.Argument(metavar="SEARCH", help='Words of the name, such as "nikkor 18-200".')
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="OUT",
            help="Write the one lens found: lens.json, or a folder for it.",
            callback=place,
        ),
    ] = None,
    image_size: Annotated[
        str | None,
        typer.Option(metavar="WxH", help="Image size in px. Default: 6000 px wide, as the sensor is."),
    ] = None,
    crop: Annotated[
        float | None,
        typer.Option(
            metavar="FACTOR", help="Crop factor of the images. Default: that of the sensor calibrated on."
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")] = False,
) -> None:
    """Search the library of lenses, or write one of them as lens.json.

    The lenses are those of the lensfun database. The table shows the zoom
    model of each, and the largest distance of a corrected point from that
    of the database. Needs the extra "lensfun".
    """
    set_up_jax()
    from .library_lens import rows, write_lens

    size = size_of(image_size)
    if output is not None:
        made = write_lens(search, output, size=size, crop=crop, overwrite=overwrite)
        error = made.about["table_error_px"]
        print(plain(f"{made.about['lens']}: within {error:.2g} px of its table, written to {output}"))
        return
    if crop is not None:
        raise ValueError("--crop is for a lens that is written: give --output, too.")
    from rich.table import Table

    from .console import show_table

    found, more = rows(search, size)
    table = Table(box=None)
    for column in ("lens", "crop", "mm", "model", "error, px"):
        table.add_column(column, justify="left" if column in ("lens", "model") else "right")
    for row in found:
        table.add_row(plain(row.name), row.crop, row.focal, row.model, row.error)
    show_table(table, highlight=False)
    if more > 0:
        print(f"and {more} more: search by more words.")
