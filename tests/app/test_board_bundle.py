"""Photos of a board of which nothing says whether they are of one zoom."""

import dataclasses

import cv2
import numpy as np
import pytest

from tests._boards import FOCAL, SIZE, bent, displaced, seen_through, true_lens
from zoomjax.app.board_bundle import bundle_of, sharing_options
from zoomjax.app.focal_sources import GRID, Focals, choose_focals
from zoomjax.app.image_calibration import _calibrated
from zoomjax.app.image_job import ImageJob
from zoomjax.app.model_choice import WantedModel
from zoomjax.app.plane_focals import FocalGroup, may_be_of_one_zoom
from zoomjax.detect import GridDetector
from zoomjax.detect.batch import Detection

OF_ONE = np.full(6, 1600.0)


@pytest.fixture
def photos(tmp_path):
    """Photos of a bent board, at these focal lengths."""

    def of(focal, height=0.1):
        grids, _ = seen_through(true_lens(), bent(height), np.asarray(focal))
        grids = grids + 0.15 * np.random.default_rng(0).standard_normal(grids.shape)
        made = []
        for number, grid in enumerate(grids):
            file = tmp_path / f"{number}.png"
            cv2.imwrite(str(file), np.zeros((8, 8), np.uint8))
            made.append(Detection(file.name, str(file), SIZE, tuple(GridDetector.lines(grid)), None, grid))
        return made

    return of


def calibrated(detections):
    model = WantedModel(model="polynomial", degree=0, terms=2)  # nothing is chosen: faster
    return _calibrated(
        ImageJob((".",), detector="grid", model=model), detections, lambda _: None, lambda _: None
    )


@pytest.mark.slow
@pytest.mark.parametrize(("focal", "expected"), [(OF_ONE, True), (FOCAL[3:9], False)])
def test_photos_of_several_zooms_pull_a_common_focal_length_apart(focal, expected, photos):
    detections = photos(focal)
    names = tuple(d.name for d in detections)
    group = FocalGroup(names, 1600.0, 0.0, (1500.0, 2700.0))
    supposed = Focals(dict.fromkeys(names, 1600.0), "px", GRID, "", groups=(group,), one_zoom=True)
    assert bundle_of(detections, supposed).of_one_zoom(supposed.groups) is expected


@pytest.mark.slow
def test_photos_of_one_zoom_share_a_focal_length_that_nobody_said(photos):
    done = calibrated(photos(OF_ONE))
    assert done.focals.one_zoom
    assert done.bundle is not None
    (f,) = set(done.focals.focal.values())
    assert f == pytest.approx(1600, rel=0.02)
    lens = done.calibration.fit.lens
    assert displaced(true_lens(), lens, [f], [1600.0]) < 3
    told = " ".join(done.shared())
    assert "All photos are taken to be of one zoom" in told
    assert "6 photos share f = " in told
    findings = [finding.about for finding in done.calibration.assessment.findings]
    assert "focal lengths of single photos" not in findings


@pytest.mark.slow
def test_photos_of_two_zooms_do_not(photos):
    done = calibrated(photos(FOCAL[3:9]))
    assert done.focals.one_zoom is False
    assert len(set(done.focals.focal.values())) == 6
    assert done.shared() == [
        "The photos are not all of one zoom: one focal length for all does not explain them."
    ]
    assert "similarity" in done.board_note  # and not that a folder is of one zoom


def test_where_photos_are_of_several_zooms_folders_may_be_of_one_each(photos):
    together, ways = photos(OF_ONE), ("exif", "folder", "similarity")
    apart = [dataclasses.replace(d, file=f"{i % 2}/{d.name}") for i, d in enumerate(together)]
    each = {d.name: 1.0 + i for i, d in enumerate(together)}
    for one_zoom, of_folder, of_folders in ((None, "folder", "folder"), (False, "similarity", "folder")):
        focals = Focals(each, "px", GRID, "", one_zoom=one_zoom)
        assert of_folder in sharing_options(together, focals, ways)
        assert of_folders in sharing_options(apart, focals, ways)
    assert sharing_options(apart, Focals(each, "px", GRID, "", one_zoom=True), ways) == ""


@pytest.mark.slow
def test_what_is_asked_for_is_not_supposed(photos):
    of = photos(OF_ONE)
    each = choose_focals(of, "plane")
    assert each.one_zoom is None
    assert len(set(each.focal.values())) > 1
    assert choose_focals(of).one_zoom
    known = [dataclasses.replace(d, focal=24.0) for d in of]
    assert choose_focals(known).one_zoom is None


@pytest.mark.parametrize(
    ("longest", "number", "precision", "may"),
    [
        (1.2, 0, 0.0, True),
        (1.4, 0, 0.0, False),  # two or three photos that differ by themselves
        (1.4, 5, 0.005, False),
        (1.4, 6, 0.005, True),  # of many, one may be far off alone
        (1.0, 12, 0.02, False),  # photos pull the common one apart
    ],
)
def test_what_speaks_against_one_zoom(longest, number, precision, may):
    group = FocalGroup(("a", "b"), 1.1, 0.0, (1.0, longest))
    assert may_be_of_one_zoom([group], number, precision) is may
