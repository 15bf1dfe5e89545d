"""Whether to fit the centre of distortion: how far from the middle few images may put it."""

import dataclasses

import equinox as eqx
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes
from zoomjax.app.calibrating import calibrate
from zoomjax.app.centre_found import CentreFound
from zoomjax.trust.centre_choice import choose_centre

SIZE = (1072, 712)
MIDDLE = (np.array(SIZE) - 1) / 2


def chosen(away, frames):
    """The choice for lines of a lens whose centre is so far from the middle of the image."""
    lens = scenes.nikkor_18_200(SIZE)
    aside = eqx.tree_at(lambda of: of.centre, lens, lens.centre + np.array([away, 0.0]))
    lines = scenes.board_lines(aside, np.full(frames, 24.0), spacing=20, noise=0.05)
    held = zj.lines.compress_any_centre(lines.about(MIDDLE))
    return held, choose_centre(held, zj.models.Model(zj.PolynomialZoom(degree=0), 2))


@pytest.mark.slow
@pytest.mark.parametrize(("away", "frames", "fitted"), [(10, 1, True), (60, 1, False), (60, 5, True)])
def test_few_images_put_the_centre_near_the_middle_or_nowhere(away, frames, fitted):
    held, choice = chosen(away, frames)
    assert bool(choice.found.determined)
    assert choice.fitted < choice.given
    assert choice.better is fitted
    assert (choice.far is None) is fitted
    centre = CentreFound.of(held, choice, choice.found if choice.better else None)
    told = centre.sentence
    if fitted:
        assert not centre.findings()
        assert told.startswith("The centre of distortion was fitted")
    else:
        assert choice.far == pytest.approx(60, abs=5)
        assert f"is {choice.far:.0f} px away" in told
        assert "give --centre X,Y" in told
        (finding,) = centre.findings()
        assert finding.verdict == "doubtful"
        assert f"a centre that is {choice.far:.0f} px away" in finding.found


@pytest.mark.slow
def test_a_far_centre_about_which_nothing_is_straighter_is_no_finding():
    held, choice = chosen(60, 1)
    not_straighter = dataclasses.replace(choice, fitted=2 * choice.given)
    assert not CentreFound.of(held, not_straighter, None).findings()
    # Of points beyond a fold, neither is known.
    unknown = dataclasses.replace(choice, fitted=np.nan, given=np.nan, far=None)
    assert "nan" not in CentreFound.of(held, unknown, None).sentence


@pytest.mark.slow
def test_a_calibration_whose_lines_want_another_centre_is_doubtful():
    """Unless it is given: then lines are straight about it."""
    lens = scenes.nikkor_18_200(SIZE)
    aside = eqx.tree_at(lambda of: of.centre, lens, lens.centre + np.array([60.0, 0.0]))
    lines = scenes.board_lines(aside, np.full(1, 24.0), spacing=20, noise=0.05).about(MIDDLE)
    found = calibrate(lines).assessment
    assert found.verdict != "good"
    assert "centre of distortion" in [finding.about for finding in found.findings]
    given = calibrate(lines, centre=tuple(np.asarray(aside.centre).tolist())).assessment
    assert given.verdict == "good"
