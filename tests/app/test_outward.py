"""A lens at many focal lengths: what it is at each of them."""

import numpy as np
import pytest

from zoomjax import scenes
from zoomjax.app.outward import distortions_at, outward

POINTS = np.array([[0.0, 0.0], [100.0, 2000.0], [2143.5, 1423.5]])


@pytest.mark.parametrize("number", [0, 1, 5, 33])
def test_distortions_are_those_at_each_focal_length(number, compilations):
    lens, focal = scenes.nikkor_18_200(), np.linspace(21.0, 120.0, number)
    found = distortions_at(lens, focal)
    assert len(found) == number
    for distortion, f in zip(found, focal.tolist(), strict=True):
        assert isinstance(distortion.coefficients, np.ndarray)
        np.testing.assert_allclose(distortion.coefficients, lens(f).coefficients, rtol=1e-13)
        np.testing.assert_allclose(distortion.distort(POINTS), lens(f).distort(POINTS), rtol=1e-13)
    compilations()
    distortions_at(lens, focal[1:])
    assert compilations() <= (number == 33)  # one for up to 32, and one beyond


def test_barrel_distortion_is_corrected_outward():
    moved = outward(scenes.nikkor_18_200(), POINTS, [21.0, 100.0])
    assert moved.shape == (2, 3)
    assert moved[0, 0] > moved[0, 1] > 0
    np.testing.assert_allclose(moved[:, 2], 0, atol=1e-9)
