"""Distortion applied again: positions against the formula, framings, folds, and mistakes."""

import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.correct.maps import OUTSIDE
from zoomjax.correct.redistort import redistort_image, redistortion_map

from .._clips import SIZE, lens, picture


@pytest.mark.parametrize("keep", ["same", "all", "valid", "grow"])
@pytest.mark.parametrize("focal", [20.0, 80.0])
def test_positions_are_those_of_undistort(keep, focal):
    d = lens()(focal)
    framing = zj.correct.frame_output(d, SIZE, keep=keep)
    x, y = redistortion_map(d, framing, SIZE)
    pixels = np.stack(np.meshgrid(*map(np.arange, SIZE)), axis=-1).astype(float)
    expected = (np.asarray(d.undistort(pixels)) - framing.origin) * framing.scale
    np.testing.assert_allclose(np.stack([x, y], -1), expected, atol=1e-4)


def test_grow_shows_all_at_scale_one():
    d = lens()(20.0)
    framing = zj.correct.frame_output(lens(), SIZE, keep="grow")
    assert float(framing.scale) == 1.0
    border = np.array(framing.size) - SIZE
    assert (border > 0).all()
    assert (border % 2 == 0).all()
    np.testing.assert_array_equal(framing.origin, -border / 2)
    corners = np.array([[0, 0], [SIZE[0] - 1, 0], [0, SIZE[1] - 1], [SIZE[0] - 1, SIZE[1] - 1]], float)
    spare = []
    for focal in np.linspace(20, 80, 7):
        shown = (np.asarray(lens()(float(focal)).undistort(corners)) - framing.origin) * framing.scale
        assert (shown >= 0).all()
        assert (shown <= np.array(framing.size) - 1).all()
        spare.append(shown.min(0))
    assert (np.min(spare, axis=0) < 1).all()  # and no pixel more than is needed
    grown = zj.undistort_image(picture(0), d, keep=framing)
    left, top = border // 2
    inner = grown[top : top + SIZE[1], left : left + SIZE[0]].astype(int)
    assert np.abs(inner - zj.undistort_image(picture(0), d)).max() <= 1  # positions are float32


def test_grow_needs_no_size_and_a_canvas_that_exists():
    with pytest.raises(ValueError, match='must be left out with keep="grow"'):
        zj.correct.frame_output(lens(), SIZE, keep="grow", size=(400, 300))
    huge = zj.Distortion(jnp.array([2e2]), (jnp.array(SIZE) - 1) / 2, jnp.array(np.hypot(*SIZE) / 2))
    with pytest.raises(ValueError, match=r'more than 32766 px a side\. Use keep="all"'):
        zj.correct.frame_output(huge, SIZE, keep="grow")


def test_beyond_a_fold_there_is_nothing():
    zoom = zj.PolynomialZoom(0, np.array([[-0.6]]), np.array(20.0))
    folding = zj.ZoomLens(zoom, lens().centre, lens().focal_range, SIZE)(30.0)
    x, _ = redistortion_map(folding, zj.correct.frame_output(folding, SIZE), SIZE)
    assert x[0, 0] == OUTSIDE
    assert x[SIZE[1] // 2, SIZE[0] // 2] == pytest.approx(SIZE[0] // 2, abs=1)
    with pytest.warns(UserWarning, match="not invertible"):
        image = redistort_image(picture(0) + 9, folding, border="replicate")
    assert image[0, 0] == 0


def test_mistakes_are_sentences():
    small = np.zeros((96, 160), np.uint8)
    framing = zj.correct.frame_output(lens(), SIZE, keep="grow")
    cases = {
        "its framing": lambda: redistort_image(small, lens(), focal=20.0, keep=framing),
        'made with "grow" of an image of 320 x 192 px. Give': lambda: redistort_image(
            small, lens(), focal=20.0, keep="grow"
        ),
        "needs a lens": lambda: redistort_image(small, lens((160, 96))(20.0), keep="grow"),
        "focal must be given": lambda: redistort_image(small, lens((160, 96))),
        "must be left out": lambda: redistort_image(small, lens((160, 96))(20.0), focal=20.0),
    }
    for message, call in cases.items():
        with pytest.raises(ValueError, match=message):
            call()
