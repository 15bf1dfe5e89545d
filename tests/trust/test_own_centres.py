"""The centre of distortion of single frames, from one step."""

import equinox as eqx
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes
from zoomjax.fit.image_metric import in_image
from zoomjax.trust.own_centres import own_centres

ASIDE = np.array([12.0, -8.0])


@pytest.fixture(scope="module")
def lens():
    there = scenes.nikkor_18_200((1072, 712))
    return eqx.tree_at(lambda lens: lens.centre, there, there.centre + ASIDE)


@pytest.fixture(scope="module")
def lines(lens):
    return scenes.board_lines(lens, scenes.focal_sweep(8, 20.56, 60.0), spacing=24, noise=0.2)


@pytest.fixture(scope="module")
def compressed(lines):
    return zj.lines.compress_any_centre(lines)


@pytest.fixture(scope="module")
def own(compressed):
    return own_centres(zj.fit_zoom(compressed, centre="fit"), compressed)


@pytest.mark.slow
@pytest.mark.parametrize("metric", [lambda lines: lines, in_image], ids=["corrected", "distorted"])
def test_a_step_is_nearly_a_fit(compressed, metric):
    """About the fitted centre, and about the middle of the image, 14 px away."""
    measured = metric(compressed)
    each = zj.fit.fit_frame_centres(measured)
    for centre in ("fit", "image"):
        own = own_centres(zj.fit_zoom(measured, centre=centre), measured)
        assert own is not None
        assert own.known.all()
        assert (np.abs(own.centre - np.asarray(each.each.centre)) < 0.3 * own.std).all()
        np.testing.assert_allclose(own.std, each.std, rtol=0.6)


def test_they_scatter_about_the_centre_as_they_say(lens, own):
    off = (own.centre - np.asarray(lens.centre)) / own.std
    assert 0.4 < np.sqrt(np.mean(off**2)) < 2


def test_a_frame_without_lines_has_none(compressed):
    some = compressed.weighted((np.asarray(compressed.frame) != 2).astype(float))
    own = own_centres(zj.fit_zoom(some, centre="image"), some)
    assert own is not None
    assert own.known.tolist() == [frame != 2 for frame in range(8)]
    assert np.isnan(own.centre[2]).all()


def test_lines_about_one_centre_tell_none(lines):
    small = zj.compress(lines)
    assert own_centres(zj.fit_zoom(small), small) is None


@pytest.mark.slow
def test_a_centre_that_moves_along_the_zoom_has_none_to_compare(compressed):
    moving = zj.fit.fit_centre(compressed, centre=zj.PolynomialZoom(degree=1)).fit
    assert moving.lens.shift is not None
    assert own_centres(moving, compressed) is None
