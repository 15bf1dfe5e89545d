"""Focal lengths, rotations and the lens from tracks alone, beside the truth."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from zoomjax import PolynomialZoom, ZoomLens
from zoomjax.fit import RESULTS, fit_motion
from zoomjax.fit._motion_start import rotation_vector, shrunk_ray, turned
from zoomjax.scenes import motion_tracks, pan_and_zoom
from zoomjax.tracks import Tracks

SIZE, FRAMES = (1280, 720), 24


@pytest.fixture(scope="module")
def lens():
    zoom = PolynomialZoom(2, jnp.array([[0.02, 0.0], [-0.05, 0.01], [-0.15, 0.05]]), jnp.array(800.0))
    return ZoomLens(zoom, jnp.array([645.0, 356.0]), jnp.array([800.0, 2400.0]), SIZE, "px")


@pytest.fixture(scope="module")
def path(lens):
    return pan_and_zoom(lens, FRAMES, pan=25, tilt=6)


def tracked(lens, path, **options):
    return motion_tracks(lens, *path, views=50, life=12, seed=3, **options)


@pytest.fixture(scope="module")
def noisy(lens, path):
    return tracked(lens, path, noise=0.3)


@pytest.fixture(scope="module")
def fit(noisy):
    return fit_motion(noisy.tracks)


def displaced(lens, fit, focal):
    """RMS distance over the image of points corrected by the fitted lens and by the true one, px."""
    grid = np.stack(np.meshgrid(*(np.linspace(0, n - 1, 9) for n in SIZE)), -1).reshape(-1, 2)
    missed = [
        np.asarray(fit.lens(float(own)).undistort(grid)) - np.asarray(lens(float(true)).undistort(grid))
        for own, true in zip(np.asarray(fit.focal), focal, strict=True)
    ]
    # Where the centre of the corrected image is put is free: a shift of it turns the camera.
    missed = np.array(missed) - np.mean(missed, axis=1, keepdims=True)
    return float(np.sqrt(np.mean(np.sum(missed**2, axis=-1))))


def test_the_scene_is_seen_where_it_is(lens, path):
    focal, rotation = path
    scene = tracked(lens, path)
    tracks = scene.tracks
    for track in (0, 7, -1):
        for view in np.flatnonzero(np.asarray(tracks.mask)[track]):
            frame = int(tracks.frame[track, view])
            ahead = rotation[frame] @ scene.points[track]
            straight = np.asarray(lens.centre) + focal[frame] * ahead[:2] / ahead[2]
            corrected = lens(float(focal[frame])).undistort(np.asarray(tracks.points[track, view]))
            np.testing.assert_allclose(corrected, straight, atol=1e-8)


def test_tracks_give_focal_lengths_and_lens(lens, path, noisy, fit):
    focal, rotation = path
    assert fit.fit.result == RESULTS.successful
    assert abs(np.asarray(fit.focal) / focal - 1).max() < 0.01
    assert displaced(lens, fit, focal) < 0.6
    assert 0.25 < fit.noise < 0.35
    turned_back = np.asarray(fit.rotation) @ np.asarray(fit.rotation[0]).T
    true = rotation @ rotation[0].T
    angle = [
        np.linalg.norm(rotation_vector(jnp.asarray(a @ b.T)))
        for a, b in zip(turned_back, true, strict=True)
    ]
    assert max(angle) < 0.01


def test_the_standard_deviation_is_that_of_the_common_factor(path, fit):
    error = np.mean(np.asarray(fit.focal) / path[0] - 1)
    std = np.mean(np.asarray(fit.focal_std) / path[0])
    assert np.sqrt(fit.covariance[-1, -1]) == pytest.approx(std, rel=0.1)
    assert 1e-4 < std < 0.02
    assert abs(error) < 4 * std


@pytest.mark.slow
def test_things_that_move_do_little_harm(lens, path):
    fit = fit_motion(tracked(lens, path, noise=0.3, moving=0.2).tracks)
    assert abs(np.asarray(fit.focal) / path[0] - 1).max() < 0.02
    assert displaced(lens, fit, path[0]) < 1.2


def test_a_camera_that_does_not_turn_has_no_scale(lens, path):
    focal, rotation = path
    still = (focal, np.broadcast_to(rotation[0], rotation.shape))
    fit = fit_motion(tracked(lens, still, noise=0.3).tracks, throw=False)
    assert fit.fit.result != RESULTS.successful
    assert (np.asarray(fit.focal_std) / np.asarray(fit.focal)).min() > 0.02


def test_known_focal_lengths_give_the_scale(lens, path):
    focal, rotation = path
    still = (focal, np.broadcast_to(rotation[0], rotation.shape))
    known = np.where(np.arange(FRAMES) == 3, focal, np.nan)
    fit = fit_motion(
        tracked(lens, still, noise=0.3).tracks, focal=known, focal_std=1e-3 * focal, throw=False
    )
    assert abs(np.asarray(fit.focal) / focal - 1).max() < 0.01


def test_a_frame_without_tracks_does_not_matter(noisy, fit):
    tracks = noisy.tracks
    track, view = np.nonzero(np.asarray(tracks.mask))
    frame = np.asarray(tracks.frame)[track, view]
    without = frame != 10
    with pytest.warns(UserWarning, match="have one view"):
        fewer = Tracks.from_arrays(
            track[without],
            frame[without],
            np.asarray(tracks.points)[track, view][without],
            image_size=SIZE,
            frames=FRAMES,
        )
    other = fit_motion(fewer)
    seen = np.arange(FRAMES) != 10
    missed = (np.asarray(other.focal) - np.asarray(fit.focal))[seen]
    assert (abs(missed) < 3 * np.asarray(fit.focal_std)[seen]).all()
    assert np.isfinite(other.focal).tolist() == seen.tolist()


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"focal": np.array([1.0, 2.0])}, "one number for each"),
        ({"focal": np.full(FRAMES, -5.0)}, "must be positive"),
        ({"tracks": "clip.mp4"}, "tracks"),
    ],
)
def test_mistakes_are_told(noisy, changed, message):
    with pytest.raises((ValueError, TypeError), match=message):
        fit_motion(**({"tracks": noisy.tracks} | changed))


def test_rotations_there_and_back(rng):
    for size in (0.0, 1e-9, 1e-3, 1.0, 3.0):
        vector = size * np.array([0.6, -0.48, 0.64])
        matrix = jax.vmap(turned, (1, None), 1)(jnp.eye(3), jnp.asarray(vector))
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-14)
        np.testing.assert_allclose(rotation_vector(matrix), vector, atol=1e-9)


def test_rays_shrink_to_the_axis():
    ray = jnp.array([np.sin(0.4), 0.0, np.cos(0.4)])
    np.testing.assert_allclose(shrunk_ray(ray, jnp.array(0.5)), [np.sin(0.2), 0, np.cos(0.2)], atol=1e-15)
    axis = jnp.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(shrunk_ray(axis, jnp.array(0.5)), axis, atol=1e-15)
    assert np.isfinite(jax.jacfwd(shrunk_ray)(axis, jnp.array(0.5))).all()
