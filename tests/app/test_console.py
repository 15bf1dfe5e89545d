"""What the command line prints, in terminals of all widths."""

import pytest
from rich.table import Table

from zoomjax.app.console import show_table


@pytest.mark.parametrize("columns", [20, 40, 60, 79, 120])
def test_no_figure_is_lost_in_a_narrow_terminal(monkeypatch, capsys, columns):
    monkeypatch.setenv("COLUMNS", str(columns))
    table = Table(box=None)
    table.add_column("", no_wrap=True)
    for name in ("px, held out", "px", "mm on board"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_row("zoom polynomial (algebraic)", "0.1234", "0.2345", "0.3456")
    show_table(table)
    told = capsys.readouterr().out
    for figure in ("(algebraic)", "0.1234", "0.2345", "0.3456", "px, held out", "mm on board"):
        assert figure in told
