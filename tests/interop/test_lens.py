"""Zoom lenses from files: their centres, the size of their pixels, and what is between focal lengths."""

import json

import lensfunpy
import numpy as np
import pytest

import zoomjax as zj
from benchmarks.mutations import LCP
from zoomjax.models import PolynomialZoom, SmoothZoom, TableZoom

from ._lenses import LENSES, PITCH
from ._readers import READERS, project
from .test_write import shown

FOCAL = [18, 24, 35, 50, 85, 200]
PITCHED = ("nuke", "opentrackio", "lensfun", "gyroflow", "unreal", "opencv", "nerfstudio")
"""Formats whose files say how large a pixel is."""


def path_of(name, folder):
    fmt = next(fmt for fmt in zj.interop.formats() if fmt.name == name)
    return folder / (name if fmt.zoom == "one" else f"a{fmt.suffixes[0]}")


@pytest.mark.parametrize("name", ["nuke", "opentrackio", "colmap", "opencv"])
@pytest.mark.parametrize("zoom", [None, TableZoom()])
def test_a_centre_that_moves_keeps_moving(name, zoom, tmp_path):
    """Its mean would be a pixel off."""
    lens, path = LENSES["moving centre"](), path_of(name, tmp_path)
    zj.interop.write(lens, path, format=name, focal=FOCAL, pixel_pitch=PITCH)
    told = {"image_size": lens.image_size} if name == "nuke" else {}
    back = zj.interop.read(path, zoom=zoom, **told)
    assert isinstance(back.lens.shift, TableZoom if zoom is not None else PolynomialZoom)
    factor = 1 if back.lens.focal_unit == "mm" else 1 / PITCH
    for focal in FOCAL:
        found = np.asarray(back.lens.centre_at(focal * factor))
        assert found == pytest.approx(np.asarray(lens.centre_at(float(focal))), abs=1e-6)
        moved = back.lens(focal * factor).undistort(shown(lens)) - lens(float(focal)).undistort(shown(lens))
        assert np.abs(moved).max() < 0.1
    assert any("centre moves along the zoom, as the file's do, by up to" in n for n in back.report.notes)
    assert not any("scatter" in note for note in back.report.notes)


def test_centres_that_scatter_are_smoothed_and_that_is_said(tmp_path):
    rows = "1 SIMPLE_RADIAL 640 480 500 320 240 -0.1\n"
    scattered = [rows.replace("500 320", f"{f} {x}") for f, x in ((500, 320), (700, 330), (1000, 321))]
    (tmp_path / "cameras.txt").write_text("".join(scattered))
    back = zj.interop.read(tmp_path / "cameras.txt")
    centres = [np.asarray(back.lens.centre_at(f))[0] for f in (500.0, 700.0, 1000.0)]
    off = np.abs(np.array(centres) - [319.5, 329.5, 320.5]).max()
    assert off > 1
    [note] = [note for note in back.report.notes if "scatter" in note]
    assert float(note.split("up to ")[2].split()[0]) == pytest.approx(off, rel=0.1)
    assert zj.interop.read(tmp_path / "cameras.txt", zoom=TableZoom()).report.at_nodes < 0.1


def test_a_prior_with_a_mean_draws_values_to_it(tmp_path):
    rows = "1 SIMPLE_RADIAL 640 480 {} 320 240 -0.1\n"
    (tmp_path / "cameras.txt").write_text("".join(map(rows.format, (500, 700, 1000))))
    zoom = SmoothZoom(error=1e4, mean=[[0.05, -0.01], [0.03, 0.0], [0.0, 0.02]])
    back = zj.interop.read(tmp_path / "cameras.txt", zoom=zoom).lens.zoom
    np.testing.assert_allclose(back.parameters[:3], zoom.mean, atol=1e-6)
    np.testing.assert_allclose(back.parameters[3:], 0, atol=1e-6)


def test_values_that_no_smooth_model_follows_are_smoothed_and_that_is_said(tmp_path):
    rows = "1 SIMPLE_RADIAL 640 480 {} 320 240 {}\n"
    focal, jumps = (500, 700, 1000, 1400, 2000, 3000), (-0.1, 0.1, -0.2, 0.4, -0.8, 1.6)
    (tmp_path / "cameras.txt").write_text("".join(map(rows.format, focal, jumps)))
    back, table = (zj.interop.read(tmp_path / "cameras.txt", zoom=zoom) for zoom in (None, TableZoom()))
    [note] = back.report.notes
    assert note == (
        f"The zoom model smooths the file's values, by up to {back.report.at_nodes:.2g} px: a table, "
        "TableZoom(), keeps them."
    )
    assert table.report.at_nodes < 0.05 < 0.5 < back.report.at_nodes
    assert not table.report.notes


@pytest.mark.slow
@pytest.mark.parametrize(("direction", "focal"), [("undistort", [18, 200]), ("redistort", [18, 35, 200])])
@pytest.mark.parametrize("kind", [name for name in LENSES if name.startswith("moving")])
def test_maps_show_a_centre_that_moves(kind, focal, direction, tmp_path):
    """Which they do not say; about one for all they would be pixels off."""
    lens = LENSES[kind]()
    zj.interop.write(lens, tmp_path / "m", format="stmap", focal=focal)
    back = zj.interop.read(tmp_path / "m", direction=direction, zoom=TableZoom())
    assert type(back.lens.distortion_model) is type(lens.distortion_model)
    assert back.report.worst < 1e-3
    assert any("centre moves along the zoom" in note for note in back.report.notes)
    for f in map(float, focal):
        assert np.asarray(back.lens.centre_at(f)) == pytest.approx(np.asarray(lens.centre_at(f)), abs=0.01)
        moved = back.lens(f).undistort(shown(lens)) - lens(f).undistort(shown(lens))
        assert np.abs(moved).max() < 1e-3


def test_maps_of_one_centre_give_a_lens_of_one_centre(tmp_path):
    zj.interop.write(LENSES["division"](), tmp_path / "m", format="stmap", focal=[18, 50, 200])
    back = zj.interop.read(tmp_path / "m")
    assert back.lens.shift is None
    assert not back.report.notes


@pytest.mark.parametrize("name", PITCHED)
def test_the_size_of_pixels_comes_back(name, tmp_path):
    """And so a lens that was read can be written again."""
    lens, path = LENSES["landscape"](), path_of(name, tmp_path)
    zj.interop.write(lens, path, format=name, focal=FOCAL, pixel_pitch=PITCH)
    told = {"image_size": lens.image_size} if name in ("nuke", "lensfun") else {}
    back = zj.interop.read(path, **told).lens
    assert back.focal_unit == "mm"
    assert back.pixel_pitch == pytest.approx(PITCH, rel=1e-6)
    zj.interop.write(back, tmp_path / "again.txt", format="colmap", focal=FOCAL)


def test_focal_lengths_in_mm_tell_the_size_of_pixels_if_they_agree(tmp_path):
    rows = "1 SIMPLE_RADIAL 640 480 {} 320 240 -0.1\n"
    (tmp_path / "a.txt").write_text(rows.format(500) + rows.format(1000))
    assert zj.interop.read(tmp_path / "a.txt", focal=[20, 40.2]).lens.pixel_pitch == pytest.approx(0.0401)
    assert zj.interop.read(tmp_path / "a.txt", focal=[20, 50]).lens.pixel_pitch is None
    assert zj.interop.read(tmp_path / "a.txt").lens.pixel_pitch is None


@pytest.mark.parametrize("unit", [1e3, 1e-3, 1e-6])
def test_focal_lengths_in_another_unit_than_mm_are_said(unit, tmp_path):
    rows = "1 SIMPLE_RADIAL 640 480 {} 320 240 -0.1\n"
    (tmp_path / "a.txt").write_text(rows.format(2000) + rows.format(4000))
    found = zj.interop.read(tmp_path / "a.txt", focal=[20 * unit, 40 * unit])
    assert found.lens.pixel_pitch is None
    assert "are in another unit: it means pixels of" in " ".join(found.report.notes)
    assert zj.interop.read(tmp_path / "a.txt", focal=[20, 40]).report.notes == ()


@pytest.mark.parametrize("name", ["gyroflow", "unreal"])
def test_a_table_does_between_focal_lengths_as_the_tool(name, tmp_path):
    """Few focal lengths, between which the tool's interpolation and one that is linear in 1/f differ."""
    lens, path = LENSES["landscape"](), path_of(name, tmp_path)
    focal = [18, 18.1, 40, 199, 200]  # Unreal eases the first and last interval
    zj.interop.write(lens, path, format=name, focal=focal, pixel_pitch=PITCH)
    back = zj.interop.read(path, zoom=TableZoom())
    smooth = zj.interop.read(path)
    assert back.report.between < 0.15 < smooth.report.between
    assert any("TableZoom(), keeps to that" in note for note in smooth.report.notes)
    assert back.report.focal == pytest.approx(focal)
    for f in (25.0, 70.0, 120.0):
        corrected = np.asarray(back.lens(f).undistort(shown(lens)))
        found = READERS[name](path, f, corrected, size=lens.image_size, mm=f)
        assert np.hypot(*(found - shown(lens)).T).max() <= back.report.worst + 0.05


def test_adobes_profiles_are_linear_in_the_logarithm_of_the_focal_length(tmp_path):
    second = LCP.replace('stCamera:FocalLength="18"', 'stCamera:FocalLength="72"')
    assert second != LCP
    first, other = (text[text.index("<rdf:li") : text.index("</rdf:Seq>")] for text in (LCP, second))
    other = other.replace("-0.1", "0.05")
    assert other.count("0.05") == 1
    (tmp_path / "a.lcp").write_text(LCP.replace(first, first + other))
    back = zj.interop.read(tmp_path / "a.lcp", zoom=TableZoom())
    matrix = np.array([[480, 0, 0.51 * 600 - 0.5], [0, 480, 0.49 * 400 - 0.5], [0, 0, 1]])
    corrected = np.asarray(back.lens(36.0).undistort(shown(back.lens)))
    found = project(matrix, [(-0.1 + 0.05) / 2, 0.02, 0, 0], corrected)
    assert np.hypot(*(found - shown(back.lens)).T).max() <= back.report.worst + 0.01
    assert back.report.worst < 0.2


def test_a_lens_of_lensfun_has_its_name(tmp_path):
    import dataclasses

    lens = dataclasses.replace(
        LENSES["landscape"](), about={"lens": "18-200mm <new> & sharp", "maker": "Some"}, pixel_pitch=PITCH
    )
    zj.interop.write(lens, tmp_path / "a.xml", format="lensfun")
    database = lensfunpy.Database(
        xml=(tmp_path / "a.xml").read_text(), load_common=False, load_bundled=False
    )
    [found] = database.lenses
    assert (found.maker, found.model) == ("Some", "18-200mm <new> & sharp")
    back = zj.interop.read(tmp_path / "a.xml", image_size=lens.image_size, name="sharp")
    assert back.lens.about["lens"] == "18-200mm <new> & sharp"
    zj.interop.write(lens, tmp_path / "a.json", format="gyroflow")
    assert json.loads((tmp_path / "a.json").read_text())["lens_model"] == "18-200mm <new> & sharp"
