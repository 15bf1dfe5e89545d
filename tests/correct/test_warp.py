"""The differentiable warp: values against OpenCV and the formula, gradients against finite differences."""

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.correct.warp import sample_positions

SIZE = (48, 30)


def bent(*k, size=SIZE, centre=None, dtype=jnp.float64):
    centre = (np.array(size) - 1) / 2 + 0.3137 if centre is None else np.array(centre, float)
    return zj.Distortion(
        jnp.array(k, dtype), jnp.array(centre, dtype), jnp.array(np.hypot(*size) / 2, dtype)
    )


LENSES = [bent(0.2, 0.05), bent(-0.1, 0.02), bent(0.12), bent(-0.3), bent(-0.5, 0.4, -0.1), bent(0.0, 0.0)]


@pytest.fixture
def image(rng):
    return jnp.asarray(rng.uniform(size=(30, 48, 3)))


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("d", LENSES)
def test_positions_are_those_of_distort(d, dtype):
    framing = zj.correct.frame_output(d, SIZE, size=(60, 40))
    pixels = np.stack(np.meshgrid(np.arange(60), np.arange(40)), axis=-1).astype(float)
    exact = np.asarray(d.distort(framing.corrected(pixels)))
    found = np.stack(jax.jit(sample_positions, static_argnums=2)(d, framing, dtype), axis=-1)
    assert found.dtype == dtype
    exists = ~np.isnan(exact[..., 0])
    assert (np.abs(found[~exists]) > 1000).all()
    near = exists & (np.abs(found[..., 0]) < 1000)
    assert near.sum() >= exists.sum() - 8  # rounding decides on the fold itself
    tolerance = 1e-3 if dtype == jnp.float64 else 5e-3
    error = np.hypot(*np.moveaxis(found - exact, -1, 0))[near]
    assert np.quantile(error, 0.99) < tolerance / 10
    assert error.max() < 0.05


def exact_map(d, framing):
    pixels = np.stack(np.meshgrid(*map(np.arange, framing.size)), axis=-1).astype(float)
    return np.asarray(d.distort(framing.corrected(pixels)))


def test_half_pixel_convention_on_asymmetric_image(rng):
    d = bent(0.3, -0.1, size=(6, 4), centre=(3, 1))
    small = rng.uniform(size=(4, 6)).astype(np.float32)
    for keep in ("same", "all", "valid"):
        framing = zj.correct.frame_output(d, (6, 4), keep=keep, size=(7, 5))
        where = exact_map(d, framing).astype(np.float32)
        expected = cv2.remap(small, where, None, cv2.INTER_LINEAR, borderValue=0.4)
        result = zj.warp_image(jnp.asarray(small), d, framing=framing, border_value=0.4)
        np.testing.assert_allclose(result, expected, atol=1e-4)


@pytest.mark.parametrize("d", LENSES)
def test_bilinear_is_opencv_s(image, d):
    where = exact_map(d, zj.correct.frame_output(d, SIZE))
    where = np.where(np.isnan(where), -100, where).astype(np.float32)
    expected = cv2.remap(np.asarray(image, np.float32), where, None, cv2.INTER_LINEAR)
    result = np.asarray(zj.warp_image(image, d))
    assert result.dtype == np.float64
    assert np.quantile(abs(result - expected), 0.995) < 1e-3


def catmull_rom(image, x, y):
    """The textbook's kernel, one pixel at a time."""

    def kernel(t):
        t = abs(t)
        return 1.5 * t**3 - 2.5 * t**2 + 1 if t <= 1 else (-0.5 * t**3 + 2.5 * t**2 - 4 * t + 2) * (t < 2)

    total = 0.0
    for j in range(int(np.floor(y)) - 1, int(np.floor(y)) + 3):
        for i in range(int(np.floor(x)) - 1, int(np.floor(x)) + 3):
            if 0 <= j < image.shape[0] and 0 <= i < image.shape[1]:
                total = total + image[j, i] * kernel(x - i) * kernel(y - j)
    return total


def test_bicubic_is_catmull_rom(image):
    d = LENSES[0]
    where = exact_map(d, zj.correct.frame_output(d, SIZE))
    expected = np.array([[catmull_rom(np.asarray(image), *point) for point in row] for row in where])
    result = zj.warp_image(image, d, interpolation="cubic")
    np.testing.assert_allclose(result, expected, atol=1e-6)


def test_bicubic_reproduces_parabolas():
    """Catmull-Rom's kernel is exact for polynomials of degree 2; bilinear interpolation is not."""
    d = bent(0.1, -0.02)
    y, x = np.mgrid[:30, :48]
    image = jnp.asarray((x - 20.0) ** 2 + 0.5 * (y - 10.0) ** 2 + x * y)
    where = exact_map(d, zj.correct.frame_output(d, SIZE))
    u, v = where[..., 0], where[..., 1]
    expected = (u - 20) ** 2 + 0.5 * (v - 10) ** 2 + u * v
    inner = (u > 2) & (u < 45) & (v > 2) & (v < 27)
    cubic = np.asarray(zj.warp_image(image, d, interpolation="cubic"))
    np.testing.assert_allclose(cubic[inner], expected[inner], atol=1e-3)
    linear = np.asarray(zj.warp_image(image, d))
    assert np.abs(linear - expected)[inner].max() > 0.1


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
@pytest.mark.parametrize("d", LENSES[:2])
def test_gradients_are_finite_differences(rng, image, d, interpolation):
    """In random directions of the image, the coefficients and the centre; forward and reverse."""
    weights = jnp.asarray(rng.standard_normal(image.shape))

    def loss(image, d):
        return jnp.vdot(weights, zj.warp_image(image, d, interpolation=interpolation, border_value=0.5))

    gradient = jax.jit(jax.grad(loss, argnums=(0, 1)))(image, d)
    leaves, structure = jax.tree.flatten((image, d))
    step = 1e-7
    for chosen in range(len(leaves)):
        direction = [
            jnp.asarray(rng.standard_normal(leaf.shape)) * (i == chosen) for i, leaf in enumerate(leaves)
        ]
        ahead = structure.unflatten([a + step * b for a, b in zip(leaves, direction, strict=True)])
        behind = structure.unflatten([a - step * b for a, b in zip(leaves, direction, strict=True)])
        numeric = (loss(*ahead) - loss(*behind)) / (2 * step)
        reverse = sum(jnp.vdot(a, b) for a, b in zip(jax.tree.leaves(gradient), direction, strict=True))
        forward = jax.jvp(loss, (image, d), structure.unflatten(direction))[1]
        np.testing.assert_allclose(reverse, numeric, rtol=2e-5, atol=1e-5)
        np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_gradient_with_respect_to_the_image_is_the_adjoint(rng, image, interpolation):
    """Also where positions lie on the border, off the image, and where there is no inverse."""
    d = bent(-0.6)
    framing = zj.correct.frame_output(d, SIZE, size=(60, 40))

    def warp(image):
        return zj.warp_image(image, d, framing=framing, interpolation=interpolation)

    other = jnp.asarray(rng.standard_normal((40, 60, 3)))
    pulled = jax.vjp(warp, image)[1](other)[0]
    np.testing.assert_allclose(jnp.vdot(warp(image), other), jnp.vdot(image, pulled), rtol=1e-12)


def test_gradients_with_many_channels_are_those_of_single_ones(rng):
    many = jnp.asarray(rng.uniform(size=(30, 48, 6)))
    gradient = jax.jit(jax.grad(lambda d, image: jnp.sum(zj.warp_image(image, d) ** 2)))
    singles = [gradient(LENSES[0], many[..., i]) for i in range(6)]
    total = jax.tree.map(lambda *each: sum(each), *singles)
    for one, other in zip(jax.tree.leaves(gradient(LENSES[0], many)), jax.tree.leaves(total), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10)


def test_vmap_is_a_loop(image):
    several = jnp.stack([LENSES[0].coefficients, LENSES[1].coefficients])

    def warp(k, image):
        return zj.warp_image(image, eqx.tree_at(lambda d: d.coefficients, LENSES[0], k))

    images = jnp.stack([image, image[::-1]])
    batched = jax.vmap(warp)(several, images)
    for result, k, single in zip(batched, several, images, strict=True):
        np.testing.assert_allclose(result, warp(k, single), atol=1e-5)
    gradients = jax.vmap(jax.grad(lambda k, image: warp(k, image).sum()))(several, images)
    for result, k, single in zip(gradients, several, images, strict=True):
        np.testing.assert_allclose(result, jax.grad(lambda k: warp(k, single).sum())(k), rtol=1e-4)  # noqa: B023


def test_compiles_once_for_all_focal_lengths(image, compilations):
    zj.warp_image(image, LENSES[0])
    compilations()
    zj.warp_image(image, LENSES[1])
    assert compilations() == 0


def test_fold_is_border_and_has_finite_gradients(image):
    d = bent(-0.6)
    result = zj.warp_image(image, d, border_value=9.0)
    gone = np.isnan(exact_map(d, zj.correct.frame_output(d, SIZE))[..., 0])
    assert gone.mean() > 0.2
    assert (np.asarray(result)[gone] == 9).all()
    gradient = jax.grad(lambda d: zj.warp_image(image, d).sum())(d)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


def test_dtypes(image):
    d = LENSES[0]
    for dtype in (jnp.float32, jnp.bfloat16, jnp.float16):
        assert zj.warp_image(image.astype(dtype), d).dtype == dtype
    bytes_ = (255 * image).astype(jnp.uint8)
    result = zj.warp_image(bytes_, d)
    assert result.dtype == jnp.uint8
    expected = zj.undistort_image(np.asarray(bytes_), d)
    assert cv2.absdiff(np.asarray(result), expected).max() <= 1
    assert zj.warp_image(image[..., 0], d).shape == (30, 48)
    assert zj.warp_image(jnp.zeros((30, 48, 2, 2)), d).shape == (30, 48, 2, 2)


@pytest.mark.parametrize(
    ("image", "interpolation", "message"),
    [
        (jnp.zeros(4), "linear", "image"),
        (jnp.zeros((0, 4)), "linear", "image"),
        (jnp.zeros((4, 4)), "lanczos", 'interpolation must be "linear" or "cubic"'),
    ],
)
def test_bad_arguments(image, interpolation, message):
    with pytest.raises((ValueError, TypeError), match=message):
        zj.warp_image(image, LENSES[0], interpolation=interpolation)


@pytest.mark.slow
@pytest.mark.parametrize("k", [(1.290903, -0.486014), (0.55, -0.28), (-0.33, 0.0), (0.1, -0.02)])
def test_every_pixel_has_arrived(k):
    """Also where Newton's method jumps between two points for ever, and at the fold."""
    size = (160, 120)
    d = zj.Distortion(jnp.array(k), jnp.array([79.5, 59.5]), jnp.array(80.0))
    framing = zj.Framing(jnp.ones(()), jnp.zeros(2), size)
    x, y = sample_positions(d, framing, jnp.float64)
    pixels = np.stack(np.meshgrid(*map(np.arange, size)), axis=-1).astype(float)
    exact = d.distort(pixels)
    seen = np.isfinite(exact[..., 0])
    np.testing.assert_array_equal(np.asarray(x) > -1000, seen)
    again = d.undistort(np.stack([x, y], axis=-1)[seen])
    np.testing.assert_allclose(again, pixels[seen], rtol=0, atol=1e-9)
