"""Rays, which are corrected positions over the focal length, through every format that says both."""

import numpy as np
import pytest

import zoomjax as zj
from zoomjax.models import Division, PolynomialZoom, TableZoom

from ._lenses import PITCH
from .test_read import BOTH, SILENT
from .test_write import shown

CELLS = [
    (name, unit)
    for name in BOTH
    for unit in ("mm", "px")
    if name != "lensfun" and not (name in SILENT and unit == "px")
]
"""lensfun scales corrected images as it likes: its focal lengths are labels. Those given are in mm."""

FOCAL = np.array([18.0, 50.0])
MARGIN = 0.05
"""px beyond the errors that were reported."""

K = ([[-0.15]], [[0.1, -0.03]], [[0.03, 0.0], [-0.18, 0.02]])
"""Two fixed lenses, and a zoom: from -16 % at the wide end."""


def strong(k, unit):
    """A strong lens off the middle, and its focal lengths."""
    focal = FOCAL[: len(k)] / (PITCH if unit == "px" else 1.0)
    zoom = PolynomialZoom(len(k) - 1, np.array(k), focal[0])
    ends = np.array([focal[0], focal[-1]])
    return zj.ZoomLens(zoom, np.array([325.0, 236.0]), ends, (640, 480), focal_unit=unit), focal


def there_and_back(name, lens, focal, folder, *, labels=None, **more):
    """Both reports, and the lens that came back."""
    path = folder / (name if BOTH[name].zoom == "one" else f"{name}{BOTH[name].suffixes[0]}")
    report = zj.interop.write(lens, path, format=name, focal=focal, pixel_pitch=PITCH)
    told = {"image_size": lens.image_size} if name in ("nuke", "discorpy") else {}
    labels = focal if name in SILENT else labels
    back = zj.interop.read(path, format=name, focal=labels, **told, **more)
    return report, back


def in_px(lens, focal):
    """Focal lengths of a lens in px, by its own pixel pitch where it has one."""
    return np.asarray(focal) / (1.0 if lens.focal_unit == "px" else lens.pixel_pitch or PITCH)


def apart(lens, focal, back, own):
    """The greatest distance of rays, in px of the corrected image of the first lens's focal length."""
    wanted, got = (
        (np.asarray(one(float(f)).undistort(shown(lens))) - np.asarray(one.centre)) / in_px(one, f)
        for one, f in ((lens, focal), (back, own))
    )
    return np.hypot(*(got - wanted).T).max() * in_px(lens, focal)


@pytest.mark.parametrize("k", K, ids=["barrel", "pincushion", "zoom"])
@pytest.mark.parametrize(("name", "unit"), CELLS)
def test_rays_come_back_within_the_reported_error(name, unit, k, tmp_path):
    lens, focal = strong(k, unit)
    report, back = there_and_back(name, lens, focal, tmp_path)
    for f, own in zip(focal, back.report.focal, strict=True):
        assert apart(lens, f, back.lens, own) <= report.at_nodes + back.report.at_nodes + MARGIN
        assert in_px(back.lens, own) == pytest.approx(in_px(lens, f), rel=2e-3)


@pytest.mark.parametrize(
    "more", [{"zoom": TableZoom()}, {"distortion_model": Division()}, {"terms": 4}], ids=str
)
def test_a_field_of_view_keeps_its_rays_in_any_model(more, tmp_path):
    """The better a model fits, the nearer: its scale is that of its own fit."""
    lens, focal = strong(K[2], "px")
    report, back = there_and_back("hugin", lens, focal, tmp_path, **more)
    assert back.report.at_nodes < 0.3
    for f, own in zip(focal, back.report.focal, strict=True):
        assert apart(lens, f, back.lens, own) <= report.at_nodes + back.report.at_nodes + MARGIN


def test_a_field_of_view_with_a_label_in_mm_tells_the_size_of_a_pixel(tmp_path):
    lens, focal = strong(K[0], "mm")
    report, back = there_and_back("hugin", lens, focal, tmp_path, labels=focal)
    assert back.report.focal == tuple(focal)
    assert back.lens.pixel_pitch == pytest.approx(PITCH, rel=2e-3)
    assert apart(lens, focal[0], back.lens, focal[0]) <= report.at_nodes + back.report.at_nodes + MARGIN
