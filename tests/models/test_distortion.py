import equinox as eqx
import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.models.polynomial import RadialPolynomial

from .._reference import assert_derivatives_agree, fold_radius, undistorted

CENTRE, SCALE = np.array([319.5, 239.5]), 400.0
COEFFICIENTS = {  # all fold between 1.2 and 2 times the scale, in barrels and pincushions
    1: [-0.12],
    2: [0.1, -0.05],
    3: [-0.1, 0.03, -0.01],
    4: [0.08, -0.03, 0.02, -0.01],
}
METHODS = ["undistort", "distort"]


def distortion(k, dtype=np.float64):
    return zj.Distortion(jnp.asarray(k, dtype), jnp.asarray(CENTRE, dtype), jnp.asarray(SCALE, dtype))


def scaled(d, factor):
    return eqx.tree_at(lambda d: d.coefficients, d, factor * d.coefficients)


@pytest.fixture(
    scope="module", params=COEFFICIENTS.values(), ids=[f"{terms}terms" for terms in COEFFICIENTS]
)
def d(request):
    return distortion(request.param)


@pytest.fixture(scope="module")
def quadratic():
    """For what has nothing to do with the number of terms."""
    return distortion(COEFFICIENTS[2])


def rays(reach, number=12):
    """Points up to `reach` px from the centre in all directions, and the centre itself."""
    radius = np.linspace(0, reach, number)[:, None]
    angle = np.linspace(0, 2 * np.pi, 9)[None]
    return CENTRE + np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1).reshape(-1, 2)


def test_undistort_is_equation_1(d):
    points = rays(500)
    expected = undistorted(points, np.asarray(d.coefficients), CENTRE, SCALE)
    np.testing.assert_allclose(d.undistort(points), expected, rtol=1e-13, atol=1e-12)


def test_pixel_coefficients_are_for_radii_in_pixels(d):
    points = rays(500)
    expected = undistorted(points, np.asarray(d.pixel_coefficients), CENTRE, 1)
    np.testing.assert_allclose(d.undistort(points), expected, rtol=1e-13, atol=1e-12)


def test_distort_inverts_undistort_up_to_the_fold(d):
    points = rays(0.999 * float(d.monotone_radius))
    np.testing.assert_allclose(d.distort(d.undistort(points)), points, rtol=0, atol=1e-9)


def test_undistort_inverts_distort_up_to_the_fold(d):
    corrected = d.undistort(rays(0.999 * float(d.monotone_radius)))
    np.testing.assert_allclose(d.undistort(d.distort(corrected)), corrected, rtol=0, atol=1e-9)


def test_inverse_of_a_lens_that_never_folds_reaches_any_distance():
    d = distortion([0.2])
    assert d.monotone_radius == jnp.inf
    far = rays(1e5)
    np.testing.assert_allclose(d.undistort(d.distort(far)), far, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_zero_coefficients_change_nothing(method, d):
    np.testing.assert_allclose(getattr(scaled(d, 0), method)(rays(900)), rays(900), rtol=0, atol=1e-12)


@pytest.mark.parametrize("method", METHODS)
def test_centre_stays(method, d):
    np.testing.assert_array_equal(getattr(d, method)(CENTRE), CENTRE)


@pytest.mark.parametrize("method", METHODS)
def test_derivatives_with_respect_to_points(method, d):
    offsets = np.array([(0, 0), (1, 0), (0, 1e-9), (150, -90), (-300, 200)])
    assert_derivatives_agree(getattr(d, method), CENTRE + offsets, step=1e-2, rtol=1e-7)


@pytest.mark.parametrize("method", METHODS)
def test_derivatives_with_respect_to_coefficients(method, d):
    def mapped(k):
        return getattr(eqx.tree_at(lambda d: d.coefficients, d, k), method)(jnp.asarray(rays(380)))

    assert_derivatives_agree(mapped, d.coefficients, step=1e-5, rtol=1e-7)


def test_derivative_at_the_centre_is_the_identity(d):
    for method in METHODS:
        np.testing.assert_array_equal(jax.jacfwd(getattr(d, method))(jnp.asarray(CENTRE)), np.eye(2))


@pytest.mark.parametrize("method", METHODS)
def test_vmap_loop_and_whole_arrays_agree(method, d):
    function = getattr(d, method)
    points = jnp.asarray(rays(350))
    loop = np.stack([function(point) for point in points])
    np.testing.assert_allclose(function(points), loop, rtol=1e-13, atol=1e-12)
    np.testing.assert_allclose(jax.vmap(function)(points), loop, rtol=1e-13, atol=1e-12)


@pytest.mark.parametrize("method", [*METHODS, "has_inverse"])
def test_points_may_have_any_leading_shape(method, quadratic):
    function = getattr(quadratic, method)
    points = jnp.asarray(rays(350))
    grid = function(points.reshape(3, 4, 9, 2))
    np.testing.assert_allclose(grid, function(points).reshape(grid.shape), rtol=1e-13)  # other loops


@pytest.mark.parametrize("method", METHODS)
def test_vmap_over_distortions(method, d):
    points = jnp.asarray(rays(350))
    many = jax.vmap(lambda factor: scaled(d, factor))(jnp.array([0.0, 0.5, 1.0]))
    batched = jax.vmap(lambda d: getattr(d, method)(points))(many)
    for index in range(3):
        np.testing.assert_allclose(
            batched[index], getattr(scaled(d, 0.5 * index), method)(points), rtol=1e-13, atol=1e-12
        )


@pytest.mark.parametrize("method", METHODS)
def test_jit_and_eager_agree(method, quadratic):
    points = jnp.asarray(rays(350, 3)[::5])
    compiled = eqx.filter_jit(getattr(quadratic, method))(points)
    with jax.disable_jit():
        np.testing.assert_allclose(getattr(quadratic, method)(points), compiled, rtol=1e-13, atol=1e-12)


_compiled_radius = jax.jit(RadialPolynomial().monotone_radius)


@hypothesis.given(st.lists(st.integers(-500, 500).map(lambda n: n / 1000), min_size=1, max_size=4))
def test_monotone_radius_is_the_first_root_of_the_slope(k):
    slope = np.polynomial.Polynomial([1, *((2 * i + 3) * k_i for i, k_i in enumerate(k))])
    roots = slope.trim().roots()
    # Nearly double roots are a matter of rounding; keep to roots that are clearly real or complex.
    apart = [abs(a - b) for i, a in enumerate(roots) for b in roots[:i]]
    hypothesis.assume(min(apart, default=1) > 1e-3)
    np.testing.assert_allclose(_compiled_radius(jnp.array(k)), fold_radius(k), rtol=1e-9)


def test_monotone_radius_of_one_term_in_closed_form():
    np.testing.assert_allclose(distortion([-0.12]).monotone_radius, SCALE / np.sqrt(0.36), rtol=1e-14)


@pytest.fixture
def folding():
    """A barrel that folds at 0.91 times the scale, and corrected points within and beyond its reach."""
    d = distortion([-0.4])
    reach = float(d.undistort(CENTRE + np.array([d.monotone_radius, 0]))[0] - CENTRE[0])
    return d, rays(0.99 * reach, 4), rays(3 * reach, 7)[-27:]


def test_beyond_the_fold_is_nan_and_said_to_be(folding):
    d, within, beyond = folding
    assert d.has_inverse(within).all()
    assert not d.has_inverse(beyond).any()
    assert jnp.isfinite(d.distort(within)).all()
    assert jnp.isnan(d.distort(beyond)).all()


def test_points_beyond_the_fold_have_no_corrected_position(folding):
    d, _, _ = folding
    fold = float(d.monotone_radius)
    points = CENTRE + np.array([[0.999 * fold, 0], [0, -1.001 * fold], [fold, fold]])
    np.testing.assert_array_equal(jnp.isfinite(d.undistort(points)), [[True] * 2, [False] * 2, [False] * 2])

    def total(k):
        bent = eqx.tree_at(lambda d: d.coefficients, d, k)
        return jnp.nansum(bent.undistort(jnp.asarray(points)))

    alone = jax.grad(lambda k: distortion(k).undistort(jnp.asarray(points[0])).sum())(d.coefficients)
    np.testing.assert_allclose(jax.grad(total)(d.coefficients), alone, rtol=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_points_so_far_away_that_powers_overflow_have_no_inverse(dtype):
    d = distortion([0.1, 0.02], dtype)
    far = np.full(2, np.sqrt(np.finfo(dtype).max) * SCALE, dtype)
    for points in (far, jnp.asarray(far)):
        assert np.isnan(d.distort(points)).all()
        assert not d.has_inverse(points)
    assert not np.asarray(jax.jacrev(d.distort)(jnp.asarray(far))).any()


def test_points_that_are_not_finite_have_no_inverse(quadratic):
    points = jnp.array([[jnp.nan, 0.0], [jnp.inf, 0.0]])
    assert not quadratic.has_inverse(points).any()
    assert jnp.isnan(quadratic.distort(points)).any(axis=1).all()


def test_points_beyond_the_fold_leave_the_other_gradients_alone(folding):
    d, within, beyond = folding

    def total(coefficients, within, beyond):
        bent = eqx.tree_at(lambda d: d.coefficients, d, coefficients)
        points = jnp.concatenate([within, beyond])
        return jnp.sum(jnp.where(bent.has_inverse(points)[:, None], bent.distort(points), 0))

    gradients = jax.grad(total, (0, 1))
    beyond_too = gradients(d.coefficients, jnp.asarray(within), jnp.asarray(beyond))
    alone = gradients(d.coefficients, jnp.asarray(within), jnp.zeros((0, 2)))
    for mixed, pure in zip(beyond_too, alone, strict=True):
        assert jnp.isfinite(mixed).all()
        np.testing.assert_allclose(mixed, pure, rtol=1e-12)


@pytest.mark.parametrize("method", METHODS)
def test_float32_points_stay_float32(method, d):
    points = rays(380).astype(np.float32)
    mapped = getattr(d, method)(points)
    assert mapped.dtype == jnp.float32
    np.testing.assert_allclose(mapped, getattr(d, method)(rays(380)), rtol=0, atol=5e-4)


def test_float32_round_trip(d):
    points = rays(0.9 * float(d.monotone_radius)).astype(np.float32)
    np.testing.assert_allclose(d.distort(d.undistort(points)), points, rtol=0, atol=2e-3)


@pytest.mark.parametrize("method", METHODS)
def test_integer_points_are_taken_as_floats(method, quadratic):
    points = np.array([[0, 0], [10, 400], [639, 479]])
    mapped = getattr(quadratic, method)(points)
    assert mapped.dtype == jnp.float64
    np.testing.assert_array_equal(mapped, getattr(quadratic, method)(points.astype(float)))


@pytest.mark.parametrize("method", METHODS)
def test_no_points_give_no_points(method, quadratic):
    assert getattr(quadratic, method)(jnp.zeros((0, 2))).shape == (0, 2)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_what_comes_from_within_the_fold_goes_back(dtype):
    """Also from so near the fold that the corrected radius rounds to its largest value."""
    d = zj.Distortion(jnp.array([-0.3, 0.02], dtype), jnp.zeros(2, dtype), jnp.array(1, dtype))
    inside = np.linspace(0.999, 1, 4000, dtype=dtype) * np.asarray(d.monotone_radius)
    points = np.stack([0.6 * inside, 0.8 * inside], axis=-1).astype(dtype)
    assert np.isfinite(d.distort(d.undistort(points))).all()


NO_DISTORTION = {
    "scale below zero": ([0.1], [0, 0], jnp.array(-400.0)),
    "scale zero": ([0.1], [0, 0], jnp.array(0.0)),
    "scale NaN": ([0.1], [0, 0], jnp.array(np.nan)),
    "scale a word": ([0.1], [0, 0], "400"),
    "coefficients NaN": ([np.nan], [0, 0], 400.0),
    "coefficients infinite": (jnp.array([np.inf]), [0, 0], 400.0),
    "coefficients None": (None, [0, 0], np.array(400.0)),
    "coefficients words": (["a"], [0, 0], 400.0),
    "coefficients yes and no": ([True], [0, 0], 400.0),
    "coefficients objects": (np.array([0.1], object), [0, 0], 400.0),
    "coefficients complex": ([1j], [0, 0], 400.0),
    "coefficients of rows": ([[0.1], [0.2, 0.3]], [0, 0], 400.0),
    "coefficients of OpenCV": ([0.1, 0.0, 0.0, 0.0, 0.0], [0, 0], 400.0),
    "centre NaN": ([0.1], [np.nan, 0.0], 400.0),
    "centre None": ([0.1], None, np.array(400.0)),
}


@pytest.mark.parametrize("what", NO_DISTORTION)
@pytest.mark.usefixtures("unchecked")
def test_what_is_no_distortion_is_refused_by_name(what):
    with pytest.raises(ValueError, match=f"Argument {what.split()[0]} must"):
        zj.Distortion(*NO_DISTORTION[what])


@pytest.mark.parametrize("method", ["undistort", "distort"])
def test_gradients_of_single_points_under_vmap(method):
    """Where a compiled function is batched and then differentiated, value and derivative share an axis."""
    d = zj.Distortion(jnp.array([0.1, -0.02]), jnp.zeros(2), jnp.array(400.0))
    points = jnp.array([[10.0, 20.0], [-150.0, 80.0], [30.0, -200.0]])

    def total(points):
        return jax.vmap(lambda p: jnp.sum((getattr(d, method)(p) - p) * jnp.array([1.0, 2.0])))(
            points
        ).sum()

    whole = jax.grad(lambda p: jnp.sum((getattr(d, method)(p) - p) * jnp.array([[1.0, 2.0]])))(points)
    np.testing.assert_allclose(jax.grad(total)(points), whole, rtol=1e-12, atol=1e-14)
    each = jax.vmap(jax.hessian(lambda p: jnp.sum(getattr(d, method)(p) ** 2)))(points)
    assert each.shape == (3, 2, 2)
    np.testing.assert_allclose(each, jnp.swapaxes(each, 1, 2), rtol=1e-9, atol=1e-12)


FOLDING = {
    "polynomial": ([-0.4, 0.02], zj.models.RadialPolynomial()),
    "three terms": ([-0.4, 0.02, 0.001], zj.models.RadialPolynomial()),
    "Division": ([0.4], zj.models.Division()),
    "BrownConrady": ([-0.3, 0.001, -0.002], zj.models.BrownConrady()),
}
NOWHERE = {
    "beyond the fold": [2000.0, 1500.0],
    "at infinity": [np.inf, 3.0],
    "NaN": [np.nan, 2.0],
    "far away": [1e9, -1e9],
}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "case", ["polynomial", *(pytest.param(case, marks=pytest.mark.slow) for case in list(FOLDING)[1:])]
)
def test_what_has_no_value_takes_no_part_in_derivatives(case, method):
    """Masked, all derivatives are those without these points, and by these points zero."""
    k, distortion_model = FOLDING[case]
    own = jnp.array([[300.0, 200.0], [350.0, 300.0], [319.5, 239.5]])
    points = jnp.concatenate([own, jnp.array(list(NOWHERE.values()))])
    numbers = jnp.array([*k, *CENTRE, SCALE])

    def total(numbers, points):
        *k, x, y, scale = numbers
        moved = getattr(zj.Distortion(jnp.stack(k), jnp.stack([x, y]), scale, distortion_model), method)(
            points
        )
        return jnp.sum(jnp.sin(jnp.where(jnp.isfinite(moved), moved, 0) / 100))

    (by_numbers, by_points), (expected, by_own) = (
        jax.jit(jax.grad(total, argnums=(0, 1)))(numbers, at) for at in (points, own)
    )
    np.testing.assert_allclose(by_numbers, expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(by_points[:3], by_own, rtol=1e-9, atol=1e-15)
    np.testing.assert_array_equal(by_points[3:], 0)
    twice, expected = (jax.jit(jax.hessian(total))(numbers, at) for at in (points, own))
    np.testing.assert_allclose(twice, expected, rtol=1e-7, atol=1e-10)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("case", FOLDING)
def test_derivatives_are_zero_where_there_is_no_value(case, method):
    k, distortion_model = FOLDING[case]
    d = zj.Distortion(jnp.array(k), jnp.array(CENTRE), jnp.array(SCALE), distortion_model)
    points = jnp.array(list(NOWHERE.values()))
    assert not jnp.isfinite(getattr(d, method)(points)).all(axis=1).any()
    jacobian = jax.jit(jax.jacfwd(lambda d, points: getattr(d, method)(points), argnums=(0, 1)))(d, points)
    assert all(np.array_equal(leaf, np.zeros_like(leaf)) for leaf in jax.tree.leaves(jacobian))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("terms", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_a_focal_length_without_a_value_takes_no_part_in_derivatives(method, terms):
    """One out of range, and NaN, each for a point of its own and for a distortion."""
    zoom = zj.PolynomialZoom(0, jnp.array([[-0.1, 0.02, 0.001][:terms]]), jnp.array(20.0))
    shift = zj.PolynomialZoom(1, jnp.array([[0.0, 0.0], [0.01, 0.02]]), jnp.array(20.0))
    lens = zj.ZoomLens(
        zoom, jnp.array(CENTRE), jnp.array([20.0, 80.0]), (640, 480), shift=shift, focal_unit="px"
    )
    points = jnp.array([[300.0, 200.0], [350.0, 300.0], [10.0, 20.0], [30.0, 10.0]])
    focal = jnp.array([30.0, 50.0, 500.0, jnp.nan])

    def masked(values):
        return jnp.sum(jnp.where(jnp.isfinite(values), values, 0))

    def rays(lens, points, focal):
        camera = zj.models.Camera(lens)
        if method == "undistort":
            return masked(camera.rays(points, focal)[0])
        return masked(camera.project(jnp.concatenate([points, 100 + points[:, :1]], axis=1), focal)[0])

    def one_by_one(lens, points, focal):
        return masked(jax.vmap(lambda p, f: getattr(lens(f), method)(p))(points, focal))

    def together(lens, points, focal):
        return masked(getattr(lens, method)(points, focal))

    for total in (together, one_by_one, rays):
        gradient = jax.jit(jax.grad(total, argnums=(0, 1, 2)))
        found, expected = (gradient(lens, points[:n], focal[:n]) for n in (4, 2))
        for got, wanted in zip(*map(jax.tree.leaves, (found, expected)), strict=True):
            got = got if got.shape == wanted.shape else got[: len(wanted)]
            np.testing.assert_allclose(got, wanted, rtol=1e-9, atol=1e-12)
        np.testing.assert_array_equal(found[1][2:], 0)
        np.testing.assert_array_equal(found[2][2:], 0)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_points_that_come_from_next_to_a_pole_have_derivatives(dtype):
    """There no digit of the divisor is known: derivatives of the inverse were NaN beside a number."""

    def distorted(k, point):
        return zj.Distortion(k, jnp.zeros(2, dtype), jnp.ones((), dtype), zj.models.Division()).distort(
            point
        )

    k, direction = jnp.asarray([-0.2], dtype), np.array([0.6, 0.8])
    near, eps = True, np.finfo(dtype).eps
    for rho in np.logspace(1, 18, 35):
        point = jnp.asarray(rho * direction, dtype)
        by_k, by_point = (np.asarray(each) for each in jax.jacrev(distorted, argnums=(0, 1))(k, point))
        # r = rho (1 - r^2 / 5), so dr/dk = rho r^2 / (1 + 2 rho r / 5), and across, r / rho.
        r = 2 * rho / (1 + np.sqrt(1 + 0.8 * rho * rho))
        slope = r / rho / (1 + 0.4 * rho * r)
        exact = slope * np.outer(direction, direction) + r / rho * np.outer([0.8, -0.6], [0.8, -0.6])
        np.testing.assert_allclose(
            by_k[:, 0], rho * r * r / (1 + 0.4 * rho * r) * direction, rtol=20 * np.sqrt(eps)
        )
        np.testing.assert_allclose(by_point, exact, rtol=0, atol=2 * np.sqrt(eps))
        near = near and by_point.any()
    assert not near  # the last ones are those of the pole


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("case", ["paper's", "Division"])
def test_the_residual_is_two_last_digits_of_the_radius(case, dtype, truth, rng):
    """Of normalised points, as in benchmarks/results/pipeline.md, in long double; NumPy and compiled."""
    k = np.asarray(truth(58.0).coefficients if case == "paper's" else [-0.2], dtype)
    distortion_model = zj.models.RadialPolynomial() if case == "paper's" else zj.models.Division()
    d = zj.Distortion(k, np.zeros(2, dtype), np.ones((), dtype), distortion_model)
    z = rng.uniform(-0.7, 0.7, (100_000, 2)).astype(dtype)
    exact = z.astype(np.longdouble)
    for points in (z, jnp.asarray(z)):
        found = np.asarray(d.distort(points)).astype(np.longdouble)
        t = np.sum(found**2, axis=1)
        factor = 1 + sum(each * t ** (power + 1) for power, each in enumerate(k.astype(np.longdouble)))
        corrected = found * (factor if case == "paper's" else 1 / factor)[:, None]
        missed = np.hypot(*(corrected - exact).T)
        assert np.max(missed / np.spacing(np.hypot(*exact.T).astype(dtype))) <= 2


def test_an_empty_list_has_no_points():
    """As of a frame in which nothing was found."""
    d = zj.Distortion([0.1], [319.5, 239.5], 400.0)
    for found in (d.undistort([]), d.distort([]), d.undistort(np.zeros((0, 2)))):
        assert found.shape == (0, 2)
    assert d.has_inverse([]).shape == (0,)
    camera = zj.Camera(zj.scenes.nikkor_18_200(), pixel_pitch=0.0055)
    assert camera.rays([], 50.0)[0].shape == (0, 3)
    assert camera.project([], 50.0)[0].shape == (0, 2)
    with pytest.raises(ValueError, match="must have shape"):
        d.undistort([[]])
