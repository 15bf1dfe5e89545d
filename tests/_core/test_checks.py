"""Sizes and centres of images."""

import re

import numpy as np
import pytest

from zoomjax import scenes
from zoomjax._core.checks import LARGEST, MOST_TERMS, checked_centre, checked_integer, checked_size
from zoomjax.fit.zoom import given_centre
from zoomjax.lines import compress, compress_any_centre


@pytest.mark.parametrize("side", [LARGEST, 10**30, 10**400])
def test_sizes_beyond_all_images_are_refused(side):
    """Numbers of C overflowed: "Python int too large to convert to C long"."""
    with pytest.raises(ValueError, match="Argument image_size must be"):
        checked_size((side, 48))
    with pytest.raises(ValueError, match="Argument image_size must be"):
        scenes.nikkor_18_200((48, side))
    assert checked_size((LARGEST - 1, 1.0)) == (LARGEST - 1, 1)


@pytest.mark.parametrize("x", [1e300, -1e12])
def test_centres_beyond_all_images_are_refused(x):
    """Coefficients about them are no numbers, and that was what was told."""
    told = re.escape("Argument centre must be in px, below 2^31, but it is")
    with pytest.raises(ValueError, match=told):
        checked_centre([x, 0.0], (640, 480))
    with pytest.raises(ValueError, match="or two coordinates in px, but it is"):
        given_centre((x, 0.0), (640, 480), stacklevel=1)
    np.testing.assert_array_equal(checked_centre((-5000.0, 1e6), (640, 480)), [-5000, 1e6])


def test_more_terms_than_there_are_digits_are_refused():
    """A billion of them took all of the memory, or never came back."""
    assert checked_integer("terms", MOST_TERMS, 1, MOST_TERMS) == MOST_TERMS
    lines = scenes.board_lines(scenes.nikkor_18_200((64, 48)), scenes.focal_sweep(2), spacing=9)
    for reduced in (compress, compress_any_centre):
        with pytest.raises(ValueError, match="terms must be at most 64, but it is 10000"):
            reduced(lines, terms=10**30)
