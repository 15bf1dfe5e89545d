"""The football scene against a camera written out, and against its lens."""

import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes
from zoomjax.focal.pitch import PITCH_LINES
from zoomjax.scenes import broadcast


@pytest.fixture(scope="module")
def lens():
    return broadcast.broadcast_zoom()


@pytest.fixture(scope="module")
def focal(lens):
    return scenes.focal_sweep(3, *map(float, lens.focal_range))


@pytest.fixture(scope="module")
def lines(lens, focal):
    return broadcast.broadcast_lines(lens, focal, spacing=20)


def test_polynomials_are_the_published_ones(lens):
    """Section 5.2 at f = 100 mm, px."""
    k1, k2 = lens(100.0).pixel_coefficients
    assert k1 == pytest.approx(2.65e-8 - 8.88e-8 + 2.86e-8, rel=1e-6)
    assert k2 == pytest.approx(1.99e-14 + 3.07e-14 - 1.04e-14, rel=1e-6)


def test_corrected_by_its_lens_every_marking_is_straight(lens, lines):
    assert (zj.frame_rms(lines, lens) < 1e-9).all()
    assert (zj.frame_rms(lines, None) > 0.2).all()


def test_noise_is_what_is_asked_for(lens, focal):
    noisy = broadcast.broadcast_lines(lens, focal, noise=0.5)
    np.testing.assert_allclose(zj.frame_rms(noisy, lens), 0.5, rtol=0.05)


def test_points_are_within_the_image_and_evenly_spaced(lines):
    for points, mask in zip(lines.points, lines.mask, strict=True):
        line = np.asarray(points)[np.asarray(mask)]
        assert (line >= 0).all()
        assert (line <= [1919, 1079]).all()
        np.testing.assert_allclose(np.hypot(*np.diff(line, axis=0).T), 20, atol=2)


def test_corrected_points_are_the_markings_of_a_pinhole_camera(lens, focal, lines):
    """Each corrected line is the image of one marking, by a projection that shares no code with it."""
    f = float(focal[0])
    camera, target = np.array([20.0, 91.0, 27.0]), np.array([28.0, -14.0, 0.0])
    pan = np.arctan2(target[0] - camera[0], camera[1] - target[1])
    tilt = np.arctan2(camera[2], np.hypot(*(target - camera)[:2]))

    def project(x, y):
        across, ahead, below = x - camera[0], camera[1] - y, camera[2]
        across, ahead = (
            across * np.cos(pan) - ahead * np.sin(pan),
            across * np.sin(pan) + ahead * np.cos(pan),
        )
        below, ahead = (
            below * np.cos(tilt) - ahead * np.sin(tilt),
            below * np.sin(tilt) + ahead * np.cos(tilt),
        )
        return np.array([across, below]) / ahead * f / 36 * 1920 + [959.5, 539.5]

    for index in np.flatnonzero(np.asarray(lines.frame) == 0):
        line = np.asarray(lines.points[index])[np.asarray(lines.mask[index])]
        ends = np.asarray(lens(f).undistort(line[[0, -1]]))
        distances = []
        for start, end in PITCH_LINES.values():
            a, b = project(*start), project(*end)
            normal = np.array([a[1] - b[1], b[0] - a[0]]) / np.hypot(*(b - a))
            distances.append(np.max(abs((ends - a) @ normal)))
        assert min(distances) < 1e-6


def test_it_zooms_from_half_a_pitch_to_the_goal_area(lines):
    number = np.bincount(np.asarray(lines.frame))
    assert number[0] >= 9
    assert number[-1] >= 6
