"""What goes with what: the table in docs/formulation.md is tried on a model of each kind; see `_serves`."""

import pytest

from . import _serves, test_models
from ._serves import COLUMNS, KINDS, TRIES, refused

TRIED = [(row, name) for row in TRIES if not isinstance(row.function, str) for name in KINDS]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("row", "name"), TRIED, ids=[f"{row.function.__name__}-{name}" for row, name in TRIED]
)
def test_a_cell_says_what_the_code_does(row, name):
    if refused(row, name):
        with pytest.raises((ValueError, TypeError), match=r"needs|must be"):
            row.function(name)
    else:
        assert row.function(name) is not None


@pytest.mark.parametrize(
    "row", [row for row in TRIES if isinstance(row.function, str)], ids=lambda row: row.function
)
def test_the_others_are_in_the_table_of_all_models(row):
    assert not any(refused(row, name) for name in COLUMNS)
    marks = getattr(test_models, row.function).pytestmark
    assert test_models.every.mark in marks


def test_the_page_has_the_table():
    text = _serves.PAGE.read_text()
    assert text.count(_serves.BEGIN) == 1
    assert text.split(_serves.BEGIN)[1].split(_serves.END)[0] == _serves.table()


def test_models_of_one_kind_have_the_same_marks():
    for row in TRIES:
        for name in COLUMNS:
            served = [refused(row, kind) for kind in KINDS if kind_of(kind) == kind_of(name)]
            assert served == [refused(row, name)]


def kind_of(name):
    row = _serves.ROWS[name]
    zooms = (_serves.zj.models.AbstractFocusZoom, _serves.zj.models.AbstractPriorZoom)
    linear = isinstance(row.zoom, _serves.zj.models.AbstractLinearZoom)
    radial = isinstance(row.distortion, _serves.zj.models.AbstractRadial)
    polynomial = row.distortion == _serves.zj.models.RadialPolynomial()
    return linear, *(isinstance(row.zoom, kind) for kind in zooms), radial, polynomial
