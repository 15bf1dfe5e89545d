"""Names and tables of the real lensfun database, and what its own code makes of them."""

import builtins
import math

import numpy as np
import pytest

from zoomjax.interop import find_lenses, lens_names
from zoomjax.interop.database import lensfunpy, one_named, tables

from ._lensfun import distorted

SIZE = (3001, 2001)


def test_hundreds_of_zooms_are_found():
    zooms = find_lenses(zooms=True)
    assert len(zooms) > 600
    assert {table.name for table in zooms} < set(lens_names())
    assert all(len(table.focal) > 1 for table in zooms)
    assert len(find_lenses()) == len(tables()) > 1200


@pytest.mark.parametrize("search", ["nikkor 18-200", "18-200 NIKKOR", "  vr zoom-nikkor 18-200mm "])
def test_a_search_finds_all_words_in_any_order_and_case(search):
    assert [table.name for table in find_lenses(search)] == [
        "Nikon AF-S DX VR Zoom-Nikkor 18-200mm f/3.5-5.6G IF-ED",
        "Nikon AF-S DX VR Zoom-Nikkor 18-200mm f/3.5-5.6G IF-ED II",
    ]


def test_the_whole_name_of_a_lens_is_that_lens_though_another_begins_so():
    [table] = one_named("nikon AF-S DX VR Zoom-Nikkor 18-200mm f/3.5-5.6G IF-ED")
    assert table.name.endswith("IF-ED")


def test_one_that_is_not_there_or_not_alone_is_a_sentence():
    with pytest.raises(ValueError, match=r"has no lens 'a lens of glass'"):
        one_named("a lens of glass")
    with pytest.raises(
        ValueError, match=r"2 lenses fit 'nikkor 18-200': choose \"Nikon .*\" or \"Nikon .*II\"\."
    ):
        one_named("nikkor 18-200")
    with pytest.raises(ValueError, match=r"or one of \d+ more"):
        one_named("nikkor")


@pytest.mark.parametrize("index", range(0, 1200, 60))
def test_polynomials_are_what_lensfun_does(index):
    table = tables()[index]
    middle, unit = (
        (np.array(SIZE) - 1) / 2,
        math.hypot(*np.array(SIZE) - 1) / 2 / math.hypot(table.aspect_ratio, 1),
    )
    points = np.array([[0.0, 0.0], [2800.0, 1400.0], [1500.0, 100.0]])
    for focal in (table.focal[0], math.sqrt(table.focal[0] * table.focal[-1]), table.focal[-1]):
        radius = np.linalg.norm(points - middle, axis=1, keepdims=True) / unit
        ours = middle + (points - middle) * np.polyval(table.polynomial(focal)[::-1], radius)
        theirs = distorted(table, focal, table.source.crop_factor, SIZE, points)
        np.testing.assert_allclose(ours, theirs, atol=0.01)


def test_sensors_of_several_shapes_are_told_apart():
    assert {round(table.aspect_ratio, 2) for table in tables()[::25]} >= {1.33, 1.5}


def test_without_lensfunpy_the_error_says_what_to_install(monkeypatch):
    real = builtins.__import__

    def missing(name, *rest):
        if name == "lensfunpy":
            raise ModuleNotFoundError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", missing)
    with pytest.raises(ImportError, match=r'needs the extra "lensfun": pip install "zoomjax\[lensfun\]"'):
        lensfunpy()
