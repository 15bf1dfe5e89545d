"""The centre of distortion that a calibration finds, and whether it moves along the zoom."""

import dataclasses

import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes
from zoomjax.app.calibrating import calibrate
from zoomjax.app.centre_found import CentreFound
from zoomjax.app.model_choice import WantedModel, one_centre
from zoomjax.app.outward import outward
from zoomjax.app.report import report
from zoomjax.lines import compress_any_centre
from zoomjax.models import Model
from zoomjax.models.zoom import with_parameters
from zoomjax.trust.bands import std_of
from zoomjax.trust.centre_choice import choose_centre

SIZE = (1072, 712)
FOCAL = scenes.focal_sweep(6)
DEGREE_2 = WantedModel("polynomial", 2)


def lens_whose_centre_moves(by):
    """From (12, -8) px off the middle at the longest focal length to so much farther at the shortest."""
    lens = scenes.nikkor_18_200(SIZE)
    places = np.array([[12.0, -8.0], [12.0 + by, -8.0]]) / float(lens.scale)
    inverse = 1 / np.array([FOCAL.max(), FOCAL.min()])
    slope = (places[1] - places[0]) / (inverse[1] - inverse[0])
    model = zj.PolynomialZoom(degree=1)
    values = np.stack([places[0] - inverse[0] * slope, slope])  # of 1 and of 1/f
    reference = model.prepare(FOCAL, 2)
    at = np.stack(
        [np.asarray(with_parameters(reference, one)(f)) for f in FOCAL[[0, -1]] for one in basis()]
    )
    wanted = np.stack([values[0] + values[1] / f for f in FOCAL[[0, -1]]])
    solved = np.linalg.solve(at.reshape(2, 4, 2).transpose(0, 2, 1).reshape(4, 4), wanted.ravel())
    return dataclasses.replace(lens, shift=with_parameters(reference, solved.reshape(2, 2)))


def basis():
    return np.eye(4).reshape(4, 2, 2)


def lines_of(lens, focal=FOCAL):
    return scenes.board_lines(lens, focal, spacing=12, noise=0.1).about((np.array(SIZE) - 1) / 2)


@pytest.mark.slow
def test_a_centre_that_moves_is_found_where_it_is():
    lens = lens_whose_centre_moves(15.0)
    found = calibrate(lines_of(lens), model=DEGREE_2, centre="moving")
    assert found.centre.how == "moving"
    off = np.asarray(found.fit.lens.centre_at(FOCAL)) - np.asarray(lens.centre_at(FOCAL))
    assert abs(off[0]).max() < 0.5  # where the distortion is strong
    assert abs(off).max() < 4
    assert found.assessment.verdict == "good"
    assert found.centre.sentence.startswith("The centre of distortion was fitted, and moves along the zoom")
    middle = 2 / (1 / float(FOCAL.min()) + 1 / float(FOCAL.max()))
    assert np.allclose(found.centre.centre, found.fit.lens.centre_at(middle))
    expected = std_of(found.fit, lambda lens: lens.centre_at(middle))
    assert found.centre.std == pytest.approx(np.asarray(expected).tolist())
    f, moved, _ = found.corner[0]
    corners = np.array([[0.0, 0.0], [1071.0, 0.0], [1071.0, 711.0], [0.0, 711.0]])
    assert abs(moved) == pytest.approx(abs(outward(found.fit.lens, corners, [f])).max())
    assert found.summary()["centre"]["how"] == "moving"
    page = report(found)
    assert "which moves along the zoom" in page
    assert found.centre.sentence in page


@pytest.mark.slow
@pytest.mark.parametrize(("by", "moves"), [(15.0, True), (0.0, False)])
def test_a_centre_that_does_not_move_stays_where_it_is(by, moves):
    held, model = compress_any_centre(lines_of(lens_whose_centre_moves(by))), Model(zj.PolynomialZoom(), 2)
    one, along = choose_centre(held, model), choose_centre(held, model, along=zj.PolynomialZoom(degree=1))
    assert along.given == pytest.approx(one.given)
    about = CentreFound.of(held, one, one.found)
    found = about.moving(one, along)
    assert (found.how == "moving") is moves
    assert (along.fitted < 0.99 * one.fitted) is moves
    if not moves:
        assert found.centre == about.centre
        assert "It was not found to move: lines that were not fitted are no straighter" in found.sentence


def test_one_focal_length_tells_no_movement():
    lines = lines_of(scenes.nikkor_18_200(SIZE), np.full(2, 24.0))
    with pytest.raises(ValueError, match="several focal lengths"):
        calibrate(lines, centre="moving")


@pytest.mark.parametrize(
    ("distortion_model", "told"), [("division", "radial polynomial"), ("brown-conrady", "decentering")]
)
def test_other_distortion_models_refuse_it(distortion_model, told):
    with pytest.raises(ValueError, match=told):
        WantedModel(distortion_model=distortion_model).check_centre("moving")


@pytest.mark.parametrize(
    ("centre", "one"), [("moving", "fit"), ("fit", "fit"), ("image", "image"), ((5.0, 6.0), (5.0, 6.0))]
)
def test_a_bundle_adjustment_has_one(centre, one):
    assert one_centre(centre) == one
