"""Tracks with exact truth: where a rolling shutter sees points, and a pupil off its axis."""

import jax.numpy as jnp
import numpy as np
import pytest

from zoomjax import PolynomialZoom, ZoomLens, frame_rms
from zoomjax.scenes import motion_lines, motion_tracks, pan_and_zoom

SIZE = (640, 360)


@pytest.fixture(scope="module")
def lens():
    zoom = PolynomialZoom(1, jnp.array([[0.02], [-0.1]]), jnp.array(400.0))
    shift = PolynomialZoom(1, jnp.array([[0.01, -0.02], [0.01, 0.0]]), jnp.array(400.0))
    return ZoomLens(zoom, jnp.array([319.5, 179.5]), jnp.array([400.0, 1200.0]), SIZE, "px", shift=shift)


def views(scene):
    track, view = np.nonzero(np.asarray(scene.tracks.mask))
    points, frame = (np.asarray(leaf)[track, view] for leaf in (scene.tracks.points, scene.tracks.frame))
    return zip(track, frame, points, strict=True)


@pytest.mark.parametrize("pupil", [0.0, 0.4])
def test_a_point_is_seen_where_the_lens_puts_it(lens, pupil):
    focal, rotation = pan_and_zoom(lens, 12)
    scene = motion_tracks(lens, focal, rotation, views=10, life=6, pupil=pupil)
    for track, frame, point in views(scene):
        ahead = rotation[frame] @ scene.points[track] - [0, 0, pupil]
        distortion = lens(float(focal[frame]))
        straight = np.asarray(distortion.centre) + focal[frame] * ahead[:2] / ahead[2]
        np.testing.assert_allclose(distortion.undistort(point), straight, atol=1e-8)


def test_rows_of_a_rolling_shutter_are_seen_one_after_the_other(lens):
    focal = np.full(9, 800.0)
    angle = np.radians(0.5) * np.arange(9)  # the camera pans evenly
    a, b = np.cos(angle), np.sin(angle)
    rotation = np.stack([np.stack([a, 0 * a, -b], 1), [[0, 1, 0]] * 9, np.stack([b, 0 * a, a], 1)], axis=1)
    scene = motion_tracks(lens, focal, rotation, views=20, life=20, shutter=0.8)
    distortion = lens(800.0)
    for track, frame, point in views(scene):
        if not 0 < frame < 8:
            continue
        time = frame + 0.8 * (point[1] / 359 - 0.5)
        across, down, ahead = scene.points[track]
        pan = np.arctan2(across, ahead) - np.radians(0.5) * time
        depth = np.hypot(across, ahead)
        straight = 800 * np.array([np.tan(pan), down / depth / np.cos(pan)])
        there = np.asarray(distortion.undistort(point)) - np.asarray(distortion.centre)
        np.testing.assert_allclose(there, straight, atol=1e-3)


@pytest.mark.slow
def test_points_of_a_map_are_the_same_track_when_they_come_back(lens):
    focal, rotation = pan_and_zoom(lens, 40, pan=60)
    once, kept = (motion_tracks(lens, focal, rotation, views=20, life=5, returns=r) for r in (False, True))
    assert len(kept.points) < 0.5 * len(once.points)
    frame, mask = np.asarray(kept.tracks.frame), np.asarray(kept.tracks.mask)
    gaps = (np.diff(frame, axis=1) > 1) & mask[:, 1:]
    assert gaps.any()
    assert np.bincount(frame[mask]).max() <= 20
    for track, moment, point in views(kept):
        ahead = rotation[moment] @ kept.points[track]
        distortion = lens(float(focal[moment]))
        straight = np.asarray(distortion.centre) + focal[moment] * ahead[:2] / ahead[2]
        np.testing.assert_allclose(distortion.undistort(point), straight, atol=1e-8)


@pytest.mark.parametrize("k", [0.3, -0.05, -0.6], ids=["bends out of the image", "bends inwards", "folds"])
def test_lines_are_straight_in_the_scene_up_to_the_border(k):
    """What a strong lens bends out of the image lay on its border; and a fold was a NaN made an integer."""
    zoom = PolynomialZoom(0, jnp.array([[k]]), jnp.array(500.0))
    lens = ZoomLens(zoom, jnp.array([319.5, 239.5]), jnp.array([500.0, 800.0]), (640, 480), "px")
    lines = motion_lines(lens, np.array([500.0, 700.0]), number=1000)
    assert np.bincount(lines.frame).tolist() == [1000, 1000]
    np.testing.assert_allclose(frame_rms(lines, lens), 0, atol=1e-9)
    points = np.asarray(lines.points)[np.asarray(lines.mask)]
    assert (points > -1e-5).all()
    assert (points < np.array([639, 479]) + 1e-5).all()
