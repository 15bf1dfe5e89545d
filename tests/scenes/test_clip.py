"""Rendered clips: the frames show what the truth says, by a formula of its own and by one another."""

import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.scenes import leaves, motion_clip, pan_and_zoom

SIZE = (160, 96)


def lens():
    """Barrel at the short end, by 3 px in the corners; the centre 2 px off."""
    zoom = zj.PolynomialZoom(1, jnp.array([[-0.02, 0.002], [-0.05, 0.01]]), jnp.array(120.0))
    return zj.ZoomLens(zoom, jnp.array([81.5, 46.0]), jnp.array([120.0, 300.0]), SIZE, "px")


def clip(frames=9, **options):
    return motion_clip(lens(), *pan_and_zoom(lens(), frames, pan=20), **options)


def hills(size=(640, 400)):
    """A smooth texture, and its formula: grey levels at places in px from its middle."""

    def level(u, v):
        return 120 + 50 * np.sin(u / 19) * np.cos(v / 23) + 40 * np.sin((u + 2 * v) / 41)

    u, v = np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in size))
    return np.rint(np.repeat(level(u, v)[..., None], 3, axis=2)).astype(np.uint8), level


@pytest.mark.parametrize("shutter", [0.0, 0.8])
def test_pixels_show_their_rays(shutter):
    texture, level = hills()
    made = clip(texture=texture, density=300.0, shutter=shutter)
    points = np.random.default_rng(0).integers(0, SIZE, (300, 2)).astype(float)
    for number, image in enumerate(made.frames()):
        x, y, z = made.rays(number, points).T
        u, v = 600 * x / (1 + z), 600 * y / (1 + z)
        within = (abs(u) < 318) & (abs(v) < 198)
        assert within.mean() > 0.8
        shown = image[points[:, 1].astype(int), points[:, 0].astype(int), 0]
        # Averaging over a pixel, and rounding twice.
        assert np.abs(shown - level(u, v))[within].max() < 3


@pytest.mark.parametrize("shutter", [0.0, 0.8])
def test_points_and_rays_are_inverse(shutter):
    made = clip(shutter=shutter, texture=leaves((64, 64)))
    points = np.random.default_rng(0).uniform(0, SIZE, (50, 2))
    for number in (0, 4, 8):
        rays = made.rays(number, points)
        np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1)
        np.testing.assert_allclose(made.points(number, rays), points, atol=1e-3 if shutter else 1e-9)
    assert np.isnan(made.points(0, -made.rays(0, points))).all()


def test_moving_things_cover_their_share_and_leave_the_rest():
    texture = leaves((512, 256))
    still, moving = (clip(texture=texture, moving=share, samples=1) for share in (0, 0.3))
    points = np.stack(np.meshgrid(*(np.arange(n) for n in SIZE)), axis=-1).reshape(-1, 2)
    shares = []
    for number, (one, two) in enumerate(zip(still.frames(), moving.frames(), strict=True)):
        on = moving.is_moving(number, points.astype(float)).reshape(SIZE[::-1])
        np.testing.assert_array_equal(one[~on], two[~on])
        assert (one[on] != two[on]).any(axis=-1).mean() > 0.5
        shares.append(on.mean())
    assert np.mean(shares) == pytest.approx(0.3, abs=0.06)
    assert not still.is_moving(0, points.astype(float)).any()


def test_captions_stay():
    made = clip(texture=leaves((512, 256)), caption=True, noise=3)
    points = np.stack(np.meshgrid(*(np.arange(n) for n in SIZE)), axis=-1).reshape(-1, 2)
    on = made.is_caption(points.astype(float)).reshape(SIZE[::-1])
    first, *_, last = made.frames()
    same = (first == last).all(axis=-1)
    assert 0.02 < same.mean() < 0.1
    assert on[same].mean() > 0.8  # elsewhere by chance
    assert not clip(texture=leaves((64, 64))).is_caption(points.astype(float)).any()


def test_noise_is_as_large_as_told_and_the_same_each_time():
    texture = np.full((64, 64, 3), 128, np.uint8)
    made = clip(texture=texture, noise=5, seed=3)
    first = next(made.frames())
    assert first.std() == pytest.approx(5, rel=0.05)
    np.testing.assert_array_equal(first, next(made.frames()))
    assert next(clip(texture=texture).frames()).tolist() == np.full((*SIZE[::-1], 3), 128).tolist()


def test_leaves_have_edges_of_all_sizes():
    texture = leaves((256, 128), seed=1)
    assert texture.shape == (128, 256, 3)
    assert len(np.unique(texture)) > 100
    steps = abs(np.diff(texture[..., 0].astype(int), axis=1)) > 8
    assert 0.02 < steps.mean() < 0.5


@pytest.mark.parametrize("frame", [-1, 4])
def test_frames_that_a_clip_does_not_have_are_refused(frame):
    """The camera stays where it is beyond the ends: another frame's rays were those of the last one."""
    made, points = clip(4), np.array([[20.0, 10.0]])
    for of in (made.rays, made.is_moving, made.points):
        with pytest.raises(IndexError, match=f"There is no frame {frame}: the frames are 0 to 3"):
            of(frame, np.array([[0.0, 0.0, 1.0]]) if of == made.points else points)
