"""Elements in blocks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax._core import arrays
from zoomjax._core.arrays import in_blocks


@pytest.mark.parametrize("shape", [(), (5,), (7,), (14,), (23,), (3, 9), (2, 4, 5)])
def test_blocks_give_what_the_whole_gives(shape, monkeypatch, rng):
    monkeypatch.setattr(arrays, "_BLOCK", 7)
    values = jnp.asarray(rng.normal(size=shape))
    one_for_all = jnp.asarray(rng.normal(size=(2, *[1] * len(shape))))
    own = jnp.asarray(rng.normal(size=(2, *shape)))
    last = jnp.asarray(rng.normal(size=shape[-1:]).reshape([1] * max(len(shape) - 1, 0) + [*shape[-1:]]))

    def function(values, *others):
        (a, b), (c, d), e = others
        return a * values + b + c * values**2 + d * e

    blocks = jax.jit(lambda *parts: in_blocks(function, *parts))(values, one_for_all, own, last)
    np.testing.assert_allclose(blocks, function(values, one_for_all, own, last), rtol=1e-14)


def test_arrays_that_may_be_sharded_stay_whole(monkeypatch):
    """Slices of what lies on several devices would have to be gathered."""
    monkeypatch.setattr(arrays, "_BLOCK", 7)

    def program():
        return str(
            jax.make_jaxpr(lambda values: in_blocks(lambda values: 2 * values, values))(jnp.zeros(20))
        )

    assert "dynamic_slice" in program()
    monkeypatch.setattr(jax, "device_count", lambda: 4)
    assert "dynamic_slice" not in program()


@pytest.mark.parametrize("batched", [False, True])
def test_points_beyond_the_fold_are_in_any_block(batched, rng):
    """More points than a block has; the first, a middle and the last one have no inverse."""
    number = 2 * arrays._BLOCK + 17
    d = zj.Distortion(jnp.array([-0.3, 0.02]), jnp.zeros(2), jnp.ones(()))
    points = rng.uniform(-0.3, 0.3, (number, 2))
    beyond = [0, arrays._BLOCK, number // 2, number - 1]
    points[beyond] = [2.0, 2.0]
    near_fold = [5, arrays._BLOCK - 1, number - 2]
    radius = float(d.monotone_radius)
    points[near_fold] = d.undistort(np.array([0.999999 * radius, 0.0]))
    compiled = jax.jit(jax.vmap(lambda p: d.distort(p)) if batched else lambda p: d.distort(p))
    found = np.asarray(compiled(jnp.asarray(points)[None])[0] if batched else compiled(jnp.asarray(points)))
    assert np.flatnonzero(np.isnan(found[:, 0])).tolist() == beyond
    np.testing.assert_allclose(found[near_fold], [[0.999999 * radius, 0.0]] * 3, atol=1e-9)
    np.testing.assert_allclose(found, d.distort(points), atol=1e-9)


POINTS = np.array([[10.0, 20.0], [30.0, 40.0], [50.0, 61.0]])
LENS = zj.ZoomLens(
    zj.PolynomialZoom(1, np.array([[0.0, 0.01], [0.1, 0.0]]), np.array(20.0)),
    np.array([31.5, 23.5]),
    np.array([20.0, 80.0]),
    (64, 48),
)
USES = {
    "undistort_image": lambda image, _: zj.undistort_image(image, LENS(24.0)),
    "redistort_image": lambda image, _: zj.correct.redistort_image(image, LENS(24.0)),
    "undistort": lambda _, points: LENS(24.0).undistort(points),
    "distort": lambda _, points: LENS(24.0).distort(points),
    "lens": lambda _, points: LENS(points[:, 0] + 20).coefficients,
    "Distortion": lambda _, points: zj.Distortion(points[0] / 1000, points[1], 40.0).undistort([[1.0, 2]]),
    "Lines": lambda _, points: (
        zj.Lines.from_ragged([points], [0], points[:1, 0], image_size=(64, 64)).points
    ),
    "Tracks": lambda _, points: (
        zj.tracks.Tracks.from_arrays(
            points[:2, 1].astype(points.dtype.str.replace("f", "i")) * 0,
            [0, 1],
            points[:2],
            image_size=(64, 64),
        ).points
    ),
}


@pytest.mark.parametrize("dtype", ["f4", "f8"])
@pytest.mark.parametrize("use", USES)
def test_numbers_in_another_order_of_bytes_are_the_same_numbers(use, dtype, rng):
    """As FITS files, PNM files and TIFF files of Motorola order give them; OpenCV takes no notice of it."""
    image = rng.uniform(size=(48, 64))
    native, other = ([a.astype(order + dtype) for a in (image, POINTS)] for order in "=>")
    expected, found = np.asarray(USES[use](*native)), np.asarray(USES[use](*other))
    np.testing.assert_array_equal(found, expected)
    assert found.dtype == expected.dtype


@pytest.mark.parametrize("dtype", ["u2", "i2", "u4", "i4", "f2"])
@pytest.mark.parametrize("use", ["undistort_image", "redistort_image"])
def test_pixels_in_another_order_of_bytes_are_the_same_pixels(use, dtype, rng):
    image = (1000 * rng.uniform(size=(48, 64, 3))).astype(dtype)
    found = USES[use](image.astype(">" + dtype), None)
    np.testing.assert_array_equal(found, USES[use](image, None))
    assert np.ptp(found.astype(float)) > 500
