"""Files of the lensfun database give the lenses of the library: one fit for both."""

import xml.etree.ElementTree as ET
from pathlib import Path

import lensfunpy
import numpy as np
import pytest
from scipy.optimize import minimize_scalar

import zoomjax as zj
from zoomjax.interop.radial_table import RadialTable, zoom_of_table
from zoomjax.models import TableZoom

SIZE = (4288, 2848)
NAMES = (
    "Nikon AF-S DX VR Zoom-Nikkor 18-200mm f/3.5-5.6G IF-ED",
    "Canon EF 35-105mm f/4.5-5.6",  # far from even powers
    "Canon PowerShot S100 & compatibles",  # a 4:3 sensor
    "KM 28-100mm f/3.5-5.6 AF D",  # SmoothZoom
    "Tokina 11-16mm f/2.8 AT-X 116 AF Pro DX",  # its table turns back within the image
)


def entry(name, folder):
    """The XML of a lens of the database, in a file of its own."""
    for path in sorted((Path(lensfunpy.__file__).parent / "db_files").glob("*.xml")):
        for lens in ET.parse(path).getroot().iter("lens"):
            distorts = lens.find("calibration/distortion") is not None
            if distorts and " ".join((lens.findtext("model") or "").split()) == name:
                root = ET.Element("lensdatabase", version="1")
                root.append(lens)
                ET.ElementTree(root).write(folder / "a.xml")
                return folder / "a.xml"
    raise AssertionError(name)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("smaller", [1.0, 1.5])
def test_a_file_of_the_database_is_the_lens_of_the_library(name, smaller, tmp_path):
    path = entry(name, tmp_path)
    own = round(float(ET.parse(path).getroot().findtext(".//cropfactor")), 3)
    [table] = [t for t in zj.interop.find_lenses(name) if (t.name, t.crop_factor) == (name, own)]
    crop = smaller * own
    wanted = zj.interop.library_lens(table, image_size=SIZE, crop=crop)
    found = zj.interop.read(path, image_size=SIZE, crop=crop)
    assert type(found.lens.zoom) is type(wanted.zoom)
    # Lensfun's 0.3 counts a pixel less along each side, which the library leaves out.
    assert found.report.worst == pytest.approx(wanted.about["table_error_px"], rel=0.1, abs=0.05)
    assert found.lens.pixel_pitch == pytest.approx(wanted.pixel_pitch, rel=1e-3)
    assert zj.models.certify(found.lens).certified
    grid = np.stack(np.meshgrid(*(np.linspace(0, side - 1, 9) for side in SIZE)), -1).reshape(-1, 2)
    middle = (np.array(SIZE) - 1) / 2
    for focal in np.geomspace(*np.asarray(found.lens.focal_range), 4):
        ours, theirs = (np.asarray(lens(focal).undistort(grid)) - middle for lens in (found.lens, wanted))
        radii = [np.hypot(*(points[np.hypot(*ours.T) > 1].T)) for points in (ours, theirs)]
        scale = np.median(radii[1] / radii[0])
        again = np.asarray(wanted(focal).distort(middle + scale * ours))
        seen = np.isfinite(again).all(
            -1
        )  # a corner where the table turns back may be just beyond the other
        assert seen.all() or (seen.mean() > 0.9 and "turns back" in str(found.report))
        assert np.hypot(*(again - grid)[seen].T).max() < max(0.5, found.report.worst)


OFF_CENTRE = (
    '<lensdatabase version="1"><lens><maker>M</maker><model>A</model><mount>X</mount>'
    '<cropfactor>1</cropfactor><center x="0.2" y="-0.15"/><calibration>'
    '<distortion model="ptlens" focal="18" a="0.02" b="-0.08" c="0.03"/>'
    '<distortion model="ptlens" focal="35" a="0.01" b="-0.02" c="0.01"/>'
    '<distortion model="ptlens" focal="70" a="0.002" b="0.003" c="0.001"/>'
    "</calibration></lens></lensdatabase>"
)


def off_centre(folder):
    """A lens whose farthest corner is 1.2 half diagonals from its centre."""
    (folder / "a.xml").write_text(OFF_CENTRE)
    return folder / "a.xml"


def rippled(folder):
    """A lens that seven coefficients follow worst in a narrow ring."""
    return entry("Canon RF-S 18-150mm F3.5-6.3 IS STM", folder)


@pytest.mark.slow
@pytest.mark.parametrize("made", [off_centre, rippled])
def test_the_error_that_is_said_is_the_greatest_of_all_radii(made, tmp_path):
    """Of many points on the way to the farthest corner, at the magnification that is best for them."""
    path = made(tmp_path)
    found = zj.interop.read(path, image_size=SIZE)
    [source] = lensfunpy.Database(xml=path.read_text(), load_common=False, load_bundled=False).lenses
    centre = np.asarray(found.lens.centre)
    far = np.where(centre > (np.array(SIZE) - 1) / 2, 0, np.array(SIZE) - 1)
    way = centre + np.linspace(0.01, 1.1, 300)[:, None] * (far - centre)
    nodes = np.array(found.report.focal)
    worst = 0.0
    for focal in [*nodes, *np.sqrt(nodes[1:] * nodes[:-1])]:
        modifier = lensfunpy.Modifier(source, source.crop_factor, *SIZE)
        flags = lensfunpy.ModifyFlags.DISTORTION
        modifier.initialize(float(focal), 4.0, 1000.0, scale=1.0, flags=flags)
        apart = [np.ravel(modifier.apply_geometry_distortion(*map(float, point), 1, 1)) for point in way]
        theirs = np.array(apart, float)
        inside = ((theirs >= 0) & (theirs <= np.array(SIZE) - 1)).all(axis=1)

        def error(scale, focal=focal, theirs=theirs, inside=inside):
            ours = np.asarray(found.lens(focal).distort(centre + scale * (way[inside] - centre)))
            return np.hypot(*(ours - theirs[inside]).T).max()

        best = minimize_scalar(error, bounds=(0.95, 1.05), method="bounded", options={"xatol": 1e-7})
        worst = max(worst, best.fun)
    assert 0.8 * worst <= found.report.worst
    assert worst <= found.report.worst + 0.02


def test_a_table_that_turns_back_says_where(tmp_path):
    found = zj.interop.read(entry(NAMES[-1], tmp_path), image_size=SIZE)
    assert any("turns back before the border of the image at 11 mm" in note for note in found.report.notes)


@pytest.mark.slow
def test_the_model_that_is_asked_for_is_taken(tmp_path):
    path = entry(NAMES[3], tmp_path)
    assert isinstance(zj.interop.read(path, image_size=SIZE).lens.zoom, zj.SmoothZoom)
    table = zj.interop.read(path, image_size=SIZE, zoom=TableZoom())
    assert isinstance(table.lens.zoom, TableZoom)
    four = zj.interop.read(path, image_size=SIZE, terms=4)
    assert four.lens.zoom.parameters.shape[1] == 4
    division = zj.interop.read(path, image_size=SIZE, distortion_model=zj.models.Division())
    assert isinstance(division.lens.distortion_model, zj.models.Division)
    assert table.report.at_nodes < min(four.report.at_nodes, division.report.at_nodes)


def test_positions_of_poly5_are_not_scaled(tmp_path):
    """It has the magnification 1 in all versions of lensfun, others have not."""
    path = tmp_path / "a.xml"
    path.write_text(
        '<lensdatabase version="1"><lens><maker>M</maker><model>A</model><mount>X</mount>'
        "<cropfactor>1</cropfactor><calibration>"
        '<distortion model="poly5" focal="24" k1="-0.05" k2="0.004"/>'
        '<distortion model="poly5" focal="70" k1="0.01" k2="0"/></calibration></lens></lensdatabase>'
    )
    back = zj.interop.read(path, image_size=(601, 401), zoom=TableZoom())
    corrected = np.asarray(back.lens(24.0).undistort(np.array([[0.0, 0.0], [600.0, 200.0]])))
    z = corrected - [300, 200]
    r2 = np.sum(z * z, -1, keepdims=True) / 200**2
    assert [300, 200] + z * (1 - 0.05 * r2 + 0.004 * r2**2) == pytest.approx(
        np.array([[0.0, 0.0], [600.0, 200.0]]), abs=0.02
    )


@pytest.mark.parametrize(
    "polynomial",
    [[-0.1, 0.0, 0.2, 0.0, 0.0], [1e-9, 0.0, -30.0, 0.0, 0.0]],
    ids=["negative at the centre", "folded at once"],
)
def test_a_table_that_is_no_map_has_no_model(polynomial):
    table = RadialTable((24.0, 35.0), (24.0, 35.0), lambda focal: np.array(polynomial), 1.8)
    assert zoom_of_table(table, centre=np.array([319.5, 239.5]), image_size=(640, 480)) is None
