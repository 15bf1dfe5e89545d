"""Which zoom model the command line takes."""

import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes
from zoomjax.app.calibrating import calibrate
from zoomjax.app.model_choice import WantedModel

LENS = scenes.nikkor_18_200((1072, 712))
FEW = {
    "two": (21.0, 120.0),
    "three": (21.0, 60.0, 120.0),
    "two, by the photo": (21.0, 21.2, 21.4, 119.0, 120.0, 121.0),
}


def lines_at(focal):
    return scenes.board_lines(LENS, np.array(focal), spacing=24.0, noise=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("focal", FEW.values(), ids=FEW)
def test_between_a_few_focal_lengths_the_prior_is_taken_and_its_bands_hold(focal):
    done = calibrate(lines_at(focal), centre="image")
    assert isinstance(done.fit.lens.zoom, zj.SmoothZoom)
    assert np.isfinite(done.rms_held_out).any() == (len(focal) > 3)  # extrapolation would say nothing
    corner = np.zeros(2)
    for f in (25.0, 35.0, 80.0):
        off = np.linalg.norm(done.fit.lens(f).undistort(corner) - LENS(f).undistort(corner))
        std = float(np.asarray(zj.displacement_std(done.fit, corner, focal=f)))
        assert off < 3 * std
        assert std < 0.3 * np.hypot(1072, 712) / 2  # some tenth of the way, and not without bound


@pytest.mark.slow
def test_nothing_else_competes_there():
    """Other models than the one with a prior do not compete, whatever their number of terms."""
    selection = calibrate(lines_at(FEW["two"]), centre="image").selection
    assert selection is not None
    assert [type(v.candidate.zoom).__name__ for v in selection.compared] == ["SmoothZoom"]


@pytest.mark.slow
@pytest.mark.parametrize("terms", [1, 3])
def test_other_numbers_of_terms_have_no_prior_and_are_doubtful(terms):
    done = calibrate(lines_at(FEW["two"]), model=WantedModel(terms=terms), centre="image")
    assert isinstance(done.fit.lens.zoom, zj.PolynomialZoom)
    assert done.assessment.verdict != "good"
    assert "few focal lengths" in {finding.about for finding in done.assessment.findings}


@pytest.mark.slow
def test_from_four_focal_lengths_on_polynomials_compete():
    selection = calibrate(lines_at((21.0, 35.0, 60.0, 120.0)), centre="image").selection
    assert selection is not None
    assert sum(isinstance(v.candidate.zoom, zj.PolynomialZoom) for v in selection.compared) > 3


@pytest.mark.slow
@pytest.mark.parametrize("model", ["auto", "smooth"])
def test_the_division_model_has_the_prior_too_and_is_doubtful(model):
    done = calibrate(
        lines_at(FEW["two"]), model=WantedModel(model, distortion_model="division"), centre="image"
    )
    lens = done.fit.lens
    assert isinstance(lens.zoom, zj.SmoothZoom)
    assert isinstance(lens.distortion_model, zj.models.Division)
    assert done.assessment.verdict != "good"
    off = np.linalg.norm(lens(35.0).undistort(np.zeros(2)) - LENS(35.0).undistort(np.zeros(2)))
    assert off < 3 * np.asarray(zj.displacement_std(done.fit, np.zeros(2), focal=35.0))
