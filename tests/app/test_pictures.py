"""Small pictures before and after the correction: how much of them can be seen."""

import cv2
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.app.pictures import before_after

SIZE = (480, 320)
BRIGHT = 250


def square(centre, k):
    """The sides, px, of a bright square of 80 px in the middle, before and after a correction."""
    image = np.full((SIZE[1], SIZE[0], 3), 60, np.uint8)
    image[120:200, 200:280] = BRIGHT
    distortion = zj.Distortion(np.array(k), np.array(centre), np.array(np.hypot(*SIZE) / 2))
    both = [cv2.imdecode(np.frombuffer(of, np.uint8), 0) for of in before_after(image, distortion)]
    assert all(picture is not None and picture.shape == SIZE[::-1] for picture in both)
    return [float(np.sqrt((picture > 200).sum())) for picture in both], both[1]


@pytest.mark.parametrize("k", [[0.0, 0.0], [0.05, 0.0], [-0.05, 0.0]])
def test_a_weak_lens_shows_all_of_the_picture(k):
    (before, after), _ = square((239.5, 159.5), k)
    assert before == pytest.approx(80, abs=1)
    assert after == pytest.approx(80 / (1 + max(k[0], 0)), rel=0.06)


def test_a_strong_lens_does_not_shrink_the_middle_to_nothing():
    """Its corners move out to 5 times their distance: all of it would show the square with 16 px a side."""
    (_, after), picture = square((239.5, 159.5), [1.0, 3.0])
    assert after == pytest.approx(40, rel=0.15)
    assert picture[159, 239] > 200  # and it stays in the middle
    assert (abs(picture.astype(int) - 128) < 8).mean() < 0.3  # little is empty
