"""Every format, out and back: images of all shapes, sensors of two sizes, focal lengths in mm and in px.

The lens is strong, and its centre is off the middle. The tool's reader and ours get the same file.
"""

import itertools

import numpy as np
import pytest

import zoomjax as zj
from zoomjax.io.equipment import FILM
from zoomjax.models import TableZoom

from ._lenses import STRONG
from .test_read import BOTH, given
from .test_write import MARGIN, error, shown

SIZES = ((640, 480), (960, 540), (427, 641), (641, 479))
"""4:3, 16:9, an upright one and one of odd sides."""

CROPS = (1.0, 1.5)
FOCAL = np.array([18.0, 19.0, 50.0, 190.0, 200.0])
"""mm. Unreal eases the first and last interval."""

CELLS = list(itertools.product(SIZES, CROPS, ("mm", "px")))


def of_cell(size, crop, unit):
    """A lens, the size of a pixel in mm, and its focal lengths."""
    pitch = FILM / crop / np.hypot(*size)
    factor = 1.0 if unit == "mm" else 1 / pitch
    zoom = zj.PolynomialZoom(2, STRONG, np.array(18.0 * factor))
    centre = np.array(size) / 2 + [0.01 * size[0], -0.02 * size[1]]
    lens = zj.ZoomLens(zoom, centre, np.array([18.0, 200.0]) * factor, size, focal_unit=unit)
    return lens, pitch, FOCAL * factor


def there_and_back(name, path, lens, pitch, focal):
    """Write, and read: with both reports, and the unit of the lens that came back in that of the lens."""
    report = zj.interop.write(lens, path, format=name, focal=focal, pixel_pitch=pitch)
    told = given(name, lens)
    told |= {"focal": FOCAL} if "focal" in told else {}
    # A table of these follows the tool between its focal lengths, too, which takes long.
    zoom = None if name in ("gyroflow", "unreal") else TableZoom()
    back = zj.interop.read(path, zoom=zoom, **told)
    unit = pitch if lens.focal_unit == "px" else 1.0
    return report, back, unit if back.lens.focal_unit == "mm" else unit / pitch


def apart(lens, back, focal, factor, *, any_scale=False):
    """The greatest distance of corrected points, px; up to a magnification where the tool has one."""
    own = np.clip(focal * factor, *np.asarray(back.focal_range))  # the ends are fitted, too
    wanted, got = (np.asarray(d.undistort(shown(lens))) for d in (lens(focal), back(own)))
    from_centre = got - np.asarray(lens.centre)
    if any_scale:
        more = np.sum(from_centre * (wanted - got)) / np.sum(from_centre**2)
        got = got + more * from_centre
    return np.hypot(*(got - wanted).T).max()


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in BOTH if name != "stmap"])
def test_tools_and_we_read_what_was_written(name, tmp_path):
    fmt = BOTH[name]
    for number, cell in enumerate(CELLS):
        lens, pitch, focal = of_cell(*cell)
        path = tmp_path / f"{number}{fmt.suffixes[0] * (fmt.zoom != 'one')}"
        report, back, factor = there_and_back(name, path, lens, pitch, focal)
        files = report.files if fmt.zoom == "one" else [path] * len(focal)
        for index, (file, f) in enumerate(zip(files, focal, strict=True)):
            assert error(name, file, lens, f, index, pitch=pitch) <= report.worst + MARGIN, cell
            off = apart(lens, back.lens, f, factor, any_scale=name in ("lensfun", "hugin"))
            assert off <= 1.3 * (report.at_nodes + back.report.at_nodes) + 0.02, cell
        assert back.lens.image_size == lens.image_size
        assert np.asarray(back.lens.centre) == pytest.approx(np.asarray(lens.centre), abs=1e-3)
        known = back.lens.pixel_pitch
        assert known is None or known == pytest.approx(pitch, rel=1e-6), cell


@pytest.mark.slow
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("unit", ["mm", "px"])
def test_maps_are_read_as_they_were_written(size, unit, tmp_path):
    """They need no sensor; what they hold is compared pixel by pixel elsewhere."""
    lens, pitch, focal = of_cell(size, 1.5, unit)
    report, back, factor = there_and_back("stmap", tmp_path / "maps", lens, pitch, focal[[0, -1]])
    assert factor == 1.0
    assert back.lens.focal_unit == unit
    assert np.asarray(back.lens.centre) == pytest.approx(np.asarray(lens.centre), abs=1e-3)
    for f in focal[[0, -1]]:
        assert apart(lens, back.lens, f, 1.0) <= report.worst + back.report.worst + 1e-3
