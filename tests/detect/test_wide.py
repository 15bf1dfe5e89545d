"""Photographs that a lens bends strongly: the search for their distortion, and the lines found under it."""

import cv2
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.detect._edge_points import edge_points
from zoomjax.detect._frame_model import OneFrame, tangent_ratio
from zoomjax.detect._search import likely_angle
from zoomjax.detect._segments import fragments

SIZE = (480, 320)


def windows(square, *, noise=2.0, disc=True):
    """Rows of dark windows on a wall, three ledges, and a disc, through the lens of a corner's angle."""
    over = 3
    wide, high = SIZE[0] * over, SIZE[1] * over
    y, x = np.mgrid[0:high, 0:wide]
    scale = np.hypot(*SIZE) / 2
    z = (np.stack([x, y], axis=-1) + 0.5 - np.array([wide, high]) / 2) / over / scale
    flat = z * tangent_ratio(square * np.sum(z * z, axis=-1))[..., None]
    u, v = np.moveaxis(flat, -1, 0)
    u, v = u + 0.1 * v, v - 0.05 * u
    window = (abs((u / 0.22) % 1 - 0.5) < 0.25) & (abs((v / 0.3) % 1 - 0.5) < 0.25)
    wall = np.where(window, 60.0, 180.0)
    for ledge in (-0.48, 0.03, 0.42):
        wall[abs(v - ledge) < 0.02] = 110
    if disc:
        wall[(u - 0.2) ** 2 + (v + 0.1) ** 2 < 0.03] = 230
    small = cv2.GaussianBlur(cv2.resize(wall, SIZE, interpolation=cv2.INTER_AREA), (0, 0), 0.8)
    noisy = small + noise * np.random.default_rng(0).standard_normal(small.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("square", [-0.9, 0.0, 0.9, 1.5])
def test_the_distortion_is_found_before_any_line(square):
    found = likely_angle(fragments(edge_points(windows(square))), SIZE)
    assert abs(found - square) < 0.15


@pytest.mark.parametrize("square", [-0.9, 1.5])
def test_lines_become_straight_under_the_true_lens(square):
    """All of them, to the noise of edges, and longer than a window: joined across the gaps."""
    found = zj.EdgeDetector().find(windows(square))
    centre, scale = (np.array(SIZE) - 1) / 2, np.hypot(*SIZE) / 2
    assert len(found.lines) >= 12
    rough = []
    for line in found.lines:
        z = (line - centre) / scale
        flat = z * tangent_ratio(square * np.sum(z * z, axis=-1))[:, None] * scale
        rough.append(np.linalg.svd(flat - flat.mean(axis=0))[1][1] / np.sqrt(len(line)))
    assert np.median(rough) < 0.3
    assert max(rough) < 2.0
    assert 0 < found.unexplained < 0.6  # the disc, and windows by themselves


def test_the_model_of_an_angle_corrects_as_the_lens_does():
    model = OneFrame.of_angle(SIZE, 1.2)
    points = model.centre + np.array([[0.3, 0.2], [0.6, -0.5], [0.8, 0.55]]) * model.scale
    z = (points - model.centre) / model.scale
    exact = model.centre + (points - model.centre) * tangent_ratio(1.2 * np.sum(z * z, axis=-1))[:, None]
    np.testing.assert_allclose(model.undistort(points), exact, atol=0.01 * model.scale)


def test_stretch_is_the_gradient_of_the_corrected_offset():
    model = OneFrame(SIZE, (-0.4, -0.1), (0.02, -0.03))
    rng = np.random.default_rng(1)
    points = rng.uniform(0, 300, (20, 2))
    angle = rng.uniform(0, np.pi, 20)
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    slope = [
        np.sum((model.undistort(points + step) - model.undistort(points - step)) * normal, axis=-1) / 2e-4
        for step in 1e-4 * np.eye(2)
    ]
    np.testing.assert_allclose(model.stretch(points, normal), np.hypot(*slope), rtol=1e-6)


def test_slopes_are_the_derivatives_of_the_errors():
    """Of lines that are nearly straight, to which derivatives of the stretch add nothing."""
    model = OneFrame(SIZE, (-0.4, 0.05), (0.02, -0.03))
    rng = np.random.default_rng(2)
    middle, angle = rng.uniform((120, 80), (360, 240), (6, 2)), rng.uniform(0, np.pi, 6)
    way = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    straight = middle[:, None] + np.linspace(-110, 110, 24)[:, None] * way[:, None]
    points = straight.copy()
    for _ in range(200):
        points += (straight - model.undistort(points)) / 2
    points += rng.normal(0, 1e-2, points.shape)
    seen = model._seen(points)
    slopes = model._slopes(points, seen)
    for column, unit in enumerate(np.eye(4)):
        after, before = (
            OneFrame.of_values(SIZE, tuple(model.values + step * unit)).errors(points)
            for step in (1e-5, -1e-5)
        )
        # The sign of a normal is arbitrary.
        after, before = (
            np.sign(np.sum(each * seen.error, axis=1))[:, None] * each for each in (after, before)
        )
        np.testing.assert_allclose((after - before) / 2e-5, slopes[..., column], atol=0.2)


def test_the_model_is_fitted_to_bent_lines_but_not_to_arcs():
    """A fisheye about a centre that is not the image's, and two circles."""
    true = OneFrame(SIZE, (-0.45, -0.08), (0.03, -0.02))
    places = np.meshgrid(np.linspace(0, 479, 200), np.linspace(0, 319, 130))
    grid = np.stack(places, axis=-1).reshape(-1, 2)
    flat = true.undistort(grid)
    lines = []
    for axis in (0, 1):
        for place in np.linspace(np.quantile(flat[:, axis], 0.1), np.quantile(flat[:, axis], 0.9), 8):
            on = grid[abs(flat[:, axis] - place) < 0.6]
            if len(on) > 20:
                lines.append(on[np.argsort(on[:, 1 - axis])])
    turn = np.linspace(0, 3, 50)
    arcs = [np.stack([200 + r * np.cos(turn), 150 + r * np.sin(turn)], axis=-1) for r in (60, 90)]
    found = OneFrame.of_angle(SIZE, 1.0).fitted([*lines, *arcs])
    seen = grid[np.hypot(*(grid - true.centre).T) < 0.8 * true.scale]
    np.testing.assert_allclose(found.shift, true.shift, atol=0.01)
    error = found.undistort(seen) - found.centre - (true.undistort(seen) - true.centre)
    assert np.sqrt(np.mean(error**2)) < 0.02 * true.scale


def test_a_facade_is_found_whole(data):
    """That on which the paper's authors show their program: roof, ledges and columns of windows."""
    image = cv2.imread(str(data / "wide" / "building.png"))
    assert image is not None
    found = zj.EdgeDetector().find(image)
    assert len(found.lines) >= 40
    assert found.unexplained < 0.4
    roof = [line for line in found.lines if line[:, 1].min() < 60 and np.ptp(line[:, 0]) > 900]
    assert len(roof) >= 2
