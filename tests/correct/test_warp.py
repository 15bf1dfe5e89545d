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


def tent(t):
    return jnp.maximum(1 - jnp.abs(t), 0)


def keys(t):
    """Catmull-Rom's kernel."""
    t = jnp.abs(t)
    outer = jnp.where(t < 2, ((-0.5 * t + 2.5) * t - 4) * t + 2, 0)
    return jnp.where(t <= 1, (1.5 * t - 2.5) * t * t + 1, outer)


def warped_plainly(image, d, kernel):
    """Every pixel of the image times its weight at `Distortion.distort` of the output's pixels."""
    height, width = image.shape
    x, y = jnp.meshgrid(jnp.arange(width), jnp.arange(height))
    at = d.distort(jnp.stack([x, y], axis=-1).astype(image.dtype))
    at = jnp.where(jnp.isfinite(at), at, -100)
    across = kernel(at[..., 0, None] - jnp.arange(width)[None, None])
    along = kernel(at[..., 1, None] - jnp.arange(height)[None, None])
    return jnp.einsum("...i,...j,ji->...", across, along, image)


TWICE = {
    "barrel": ([0.05, -0.01], zj.models.RadialPolynomial()),
    "three terms": ([-0.2, 0.1, -0.02], zj.models.RadialPolynomial()),
    "folding": ([-0.6], zj.models.RadialPolynomial()),
    "Division": ([-0.1, 0.01], zj.models.Division()),
    "BrownConrady": ([0.05, 0.004, -0.003], zj.models.BrownConrady()),
}


@pytest.mark.slow
@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
@pytest.mark.parametrize("case", TWICE)
def test_second_derivatives_are_those_of_plain_sums(rng, case, interpolation):
    """By all numbers of the distortion and one of the image, in reverse and forward alone."""
    k, distortion_model = TWICE[case]
    image = jnp.asarray(rng.random((7, 10)))
    numbers = jnp.array([*k, 4.81, 3.17, 6.1, 0.3])

    def square(warp, numbers):
        *k, x, y, scale, pixel = numbers
        d = zj.Distortion(jnp.stack(k), jnp.stack([x, y]), scale, distortion_model)
        return jnp.sum(warp(image.at[3, 5].set(pixel), d) ** 2)

    def ours(numbers):
        return square(lambda *at: zj.warp_image(*at, interpolation=interpolation), numbers)

    def plain(numbers):
        return square(
            lambda *at: warped_plainly(*at, {"linear": tent, "cubic": keys}[interpolation]), numbers
        )

    np.testing.assert_allclose(ours(numbers), plain(numbers), rtol=1e-8)
    expected = jax.jit(jax.hessian(plain))(numbers)
    most = 1e-6 * np.abs(expected).max()
    np.testing.assert_allclose(jax.jit(jax.hessian(ours))(numbers), expected, rtol=1e-6, atol=most)
    forward = jax.jit(jax.jacfwd(jax.jacfwd(ours)))(numbers)
    np.testing.assert_allclose(forward, expected, rtol=1e-6, atol=most)


def test_third_derivatives_of_positions():
    d, framing = LENSES[0], zj.Framing(jnp.ones(()), jnp.zeros(2), (3, 2))

    def ours(k):
        d_k = eqx.tree_at(lambda d: d.coefficients, d, k)
        return jnp.stack(sample_positions(d_k, framing, jnp.float64), axis=-1)

    def exact(k):
        x, y = jnp.meshgrid(jnp.arange(3.0), jnp.arange(2.0))
        return eqx.tree_at(lambda d: d.coefficients, d, k).distort(jnp.stack([x, y], axis=-1))

    third, expected = (
        jax.jit(jax.jacfwd(jax.jacfwd(jax.jacfwd(function))))(d.coefficients) for function in (ours, exact)
    )
    np.testing.assert_allclose(third, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


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


@pytest.mark.parametrize("interpolation", ["linear", pytest.param("cubic", marks=pytest.mark.slow)])
def test_the_gradient_of_a_vmap_is_the_sum_of_gradients(image, interpolation):
    """Batched before it is transposed: images, focal lengths or both."""
    zoom = zj.PolynomialZoom(1, jnp.array([[-0.1], [0.05]]), jnp.array(20.0))
    lens = zj.ZoomLens(zoom, jnp.array([23.7, 14.6]), jnp.array([20.0, 80.0]), SIZE)
    images, focal = jnp.stack([image, image[::-1]]), jnp.array([25.0, 60.0])

    def bright(lens, image, focal):
        return jnp.sum(zj.warp_image(image, lens(focal), interpolation=interpolation) ** 2)

    gradient = jax.jit(jax.grad(bright, argnums=(0, 1, 2)))
    for axes in ((None, 0, 0), (None, None, 0), (None, 0, None)):
        given = [lens, images if axes[1] == 0 else image, focal if axes[2] == 0 else focal[0]]
        mapped = jax.vmap(bright, axes)
        found = jax.jit(jax.grad(lambda *at, mapped=mapped: mapped(*at).sum(), argnums=(0, 1, 2)))(*given)
        each = [
            gradient(lens, images[i] if axes[1] == 0 else image, focal[i] if axes[2] == 0 else focal[0])
            for i in range(2)
        ]
        for index, axis in enumerate(axes):
            join = sum if axis is None else lambda leaves: jnp.stack(list(leaves))
            expected = jax.tree.map(lambda *leaves, join=join: join(leaves), *(one[index] for one in each))
            for got, wanted in zip(*map(jax.tree.leaves, (found[index], expected)), strict=True):
                np.testing.assert_allclose(got, wanted, rtol=1e-8, atol=1e-9)


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


OUTSIDE = {
    "inside of it": bent(0.0),
    "barrel": bent(-0.1),
    "pincushion": bent(0.2),
    "fold": bent(-0.6),
    "half a pixel aside": bent(0.0, centre=(23.5, 14.5)),
}


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
@pytest.mark.parametrize("case", OUTSIDE)
def test_a_border_without_a_number_is_where_the_border_is(image, case, interpolation):
    """Pixels that change with the border's value are those that are NaN; others are as before."""
    d = OUTSIDE[case]
    framing = zj.Framing(jnp.ones(()), jnp.array([-2.5, 0.25]), (54, 33))

    def warp(value, d=d):
        return zj.warp_image(image, d, framing=framing, interpolation=interpolation, border_value=value)

    zero, mixes = np.asarray(warp(0)), np.abs(np.asarray(warp(1e6) - warp(-1e6))) > 1e-6
    assert mixes.any()
    assert (~mixes).any()
    for border in (np.nan, np.inf, -np.inf, jnp.array(np.nan)):
        found = np.asarray(warp(border))
        np.testing.assert_array_equal(found[mixes], np.full(mixes.sum(), border))
        np.testing.assert_allclose(found[~mixes], zero[~mixes], rtol=0, atol=1e-9)
    gradient = jax.grad(lambda d: jnp.sum(jnp.where(mixes, 0, warp(np.nan, d))))(d)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


@pytest.mark.parametrize("value", [np.nan, 0.5, 2.0])
def test_a_border_value_may_be_traced(image, value):
    found = jax.jit(lambda image, value: zj.warp_image(image, LENSES[0], border_value=value))(image, value)
    expected = zj.warp_image(image, LENSES[0], border_value=value)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("value", [(0, 1), "white", jnp.zeros(3), None])
@pytest.mark.usefixtures("unchecked")
def test_a_border_value_is_one_number(image, value):
    with pytest.raises(ValueError, match="Argument border_value must be one number"):
        zj.warp_image(image, LENSES[0], border_value=value)


@pytest.mark.parametrize("value", [np.nan, 256, -1])
@pytest.mark.parametrize("function", [zj.warp_image, zj.undistort_image])
def test_a_border_value_is_one_of_the_image_s(image, function, value):
    bytes_ = np.asarray(255 * image).astype(np.uint8)
    bytes_ = bytes_ if function is zj.undistort_image else jnp.asarray(bytes_)
    with pytest.raises(ValueError, match="Argument border_value must be a value of uint8"):
        function(bytes_, LENSES[0], border_value=value)


def test_strict_promotion_of_dtypes(image):
    with jax.numpy_dtype_promotion("strict"):
        for dtype in (jnp.float32, jnp.bfloat16):
            assert zj.warp_image(image.astype(dtype), LENSES[0], border_value=0.5).dtype == dtype
        assert zj.warp_image((255 * image).astype(jnp.uint8), LENSES[0]).dtype == jnp.uint8
        jax.grad(lambda d: zj.warp_image(image, d).sum())(LENSES[0])


@pytest.mark.slow
def test_a_focal_length_out_of_range_gives_the_border_and_derivatives_of_zero(image):
    zoom = zj.PolynomialZoom(1, jnp.array([[-0.1], [0.05]]), jnp.array(20.0))
    lens = zj.ZoomLens(zoom, jnp.array([23.7, 14.6]), jnp.array([20.0, 80.0]), SIZE)

    def bright(lens, focal, image):
        return jax.vmap(lambda f: zj.warp_image(image, lens(f), border_value=0.25).sum())(focal)

    focal = jnp.array([20.0, 500.0, jnp.nan])
    assert bright(lens, focal, image)[1:].tolist() == [0.25 * image.size] * 2
    gradient = jax.grad(lambda *at: bright(*at).sum(), argnums=(0, 1, 2))
    found, expected = gradient(lens, focal, image), gradient(lens, focal[:1], image)
    np.testing.assert_array_equal(found[1][1:], 0)
    for got, wanted in zip(*(jax.tree.leaves((a[0], a[2])) for a in (found, expected)), strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-9, atol=1e-9)


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


SEVERAL = [(8, 240, 320, 3), (1, 240, 320, 1), (8, 3, 240, 320), (2, 1, 32, 48)]


@pytest.mark.parametrize("shape", SEVERAL)
def test_several_images_are_refused_by_a_sentence(shape):
    """Also where the lens is traced, and its size cannot tell."""
    for warp in (zj.warp_image, jax.jit(zj.warp_image)):
        with pytest.raises(
            ValueError, match=r"must be one image, .* as that of several: jax.vmap over the"
        ):
            warp(jnp.zeros(shape), LENSES[0])
    with pytest.raises(ValueError, match=r"must be one image, .* as that of several: one call for each"):
        zj.undistort_image(np.zeros(shape), LENSES[0])


@pytest.mark.parametrize("shape", [(30, 48, 4, 4), (30, 48, 2, 2), (30, 48, 25, 3), (30, 48, 1, 64)])
def test_channels_may_have_axes(shape):
    assert zj.warp_image(jnp.zeros(shape), LENSES[0]).shape == shape


@pytest.mark.usefixtures("unchecked")
def test_a_list_is_refused_by_a_sentence():
    with pytest.raises(ValueError, match=r"must be an array, but it is a list: jnp.asarray\(image\)"):
        zj.warp_image([[1.0, 2.0], [3.0, 4.0]], LENSES[0])


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


@pytest.mark.parametrize("border", [-9999.0, 1e9, -3.4e38])
@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_a_large_border_value_leaves_the_picture_its_digits(border, interpolation):
    image = jnp.asarray(np.random.default_rng(0).uniform(0, 1, (40, 60)), jnp.float32)
    d = zj.scenes.nikkor_18_200((60, 40))(24.0)
    plain = zj.warp_image(image, d, interpolation=interpolation)
    found = zj.warp_image(image, d, interpolation=interpolation, border_value=border)
    np.testing.assert_allclose(found[5:35, 5:55], plain[5:35, 5:55], atol=1e-6)


@pytest.mark.parametrize("dtype", [">u2", ">i2", ">f4", ">f8"])
def test_bytes_may_be_in_any_order(image, dtype, unchecked):
    """JAX itself refuses those of other machines."""
    other = np.asarray(100 * np.asarray(image), dtype)
    same = other.astype(other.dtype.newbyteorder("="))
    np.testing.assert_array_equal(zj.warp_image(other, LENSES[0]), zj.warp_image(same, LENSES[0]))


@pytest.mark.parametrize("dtype", ["uint32", "int32"])
def test_large_integers_stay_within_their_type(dtype):
    most = np.iinfo(dtype).max
    image = jnp.full((16, 24), most, dtype)
    corrected = zj.warp_image(
        image, zj.Distortion(jnp.array([0.0]), jnp.array([11.5, 7.5]), jnp.array(14.0))
    )
    assert corrected.dtype == image.dtype
    assert np.abs(np.asarray(corrected, float) / most - 1).max() < 1e-6


@pytest.mark.parametrize("dtype", ["int64", "uint64", ">i8"])
@pytest.mark.usefixtures("unchecked")
def test_integers_that_jax_cuts_off_are_refused(dtype):
    """Without float64 those of 64 bits become those of 32, whatever is in them."""
    d = zj.Distortion(np.array([0.0]), np.array([11.5, 7.5]), np.array(14.0))
    jax.config.update("jax_enable_x64", False)
    try:
        assert np.all(np.asarray(zj.warp_image(np.full((16, 24), 7, dtype), d)) == 7)
        with pytest.raises(ValueError, match=r"beyond those of u?int32.*image\.astype\(float\)"):
            zj.warp_image(np.full((16, 24), 2**40, dtype), d)
    finally:
        jax.config.update("jax_enable_x64", True)


def test_complex_images_are_refused():
    d = zj.Distortion(jnp.array([0.1]), jnp.array([11.5, 7.5]), jnp.array(14.0))
    with pytest.raises(ValueError, match="must hold real numbers"):
        zj.warp_image(jnp.zeros((16, 24), complex), d)
