"""Inverses on what breaks iterations: cycles of Newton's method, folds, points that nearly are at them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.models._roots import first_positive_root, increasing_root

CYCLES = [(1.290903, -0.486014), (0.41440674, -0.16653695), (0.55, -0.28)]
"""Invertible lenses in which plain Newton steps jump between two points for ever."""


def unit(k, dtype=np.float64, distortion_model=None):
    """A distortion whose lengths are normalised."""
    return zj.Distortion(
        np.asarray(k, dtype),
        np.zeros(2, dtype),
        np.ones((), dtype),
        distortion_model or zj.models.RadialPolynomial(),
    )


def on_axis(radius):
    return np.stack([radius, 0 * radius], axis=-1)


def plain_newton(d, rho, steps):
    """Newton's method held within the fold, as a user would write it."""
    r = np.minimum(rho, float(d.monotone_radius))
    for _ in range(steps):
        error, slope = d.distortion_model.equation(r, r * r, rho, np.asarray(d.coefficients))
        r = np.clip(r - error / np.where(slope > 0, slope, 1), 0, float(d.monotone_radius))
    return r


def cycling_radii(d, number=400_000):
    """Radii that plain Newton steps do not find: each comes back after two steps, or never settles."""
    # Near the fold it is slow, too, and the radius is not determined to the last digits.
    radius = np.linspace(0, 0.98 * float(d.monotone_radius), number)[1:]
    rho = np.asarray(d.undistort(on_axis(radius)))[:, 0]
    return radius[abs(plain_newton(d, rho, 60) - radius) > 1e-4]


@pytest.mark.parametrize("kind", [np.asarray, jnp.asarray], ids=["NumPy", "JAX"])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("k", CYCLES)
def test_points_on_which_newton_jumps_for_ever_are_found(k, dtype, kind):
    radius = cycling_radii(unit(k)).astype(dtype)
    assert radius.size > 3  # the ring is there
    d = unit(k, dtype)
    corrected = d.undistort(kind(on_axis(radius)))
    eps = np.finfo(dtype).eps
    assert d.has_inverse(corrected).all()
    np.testing.assert_allclose(d.undistort(d.distort(corrected)), corrected, rtol=4 * eps, atol=0)
    np.testing.assert_allclose(d.distort(corrected)[:, 0], radius, rtol=1e3 * eps)


def test_cycles_of_random_lenses_are_found():
    """Lenses with a strong bend between the centre and the fold, or nearly a fold."""
    rng = np.random.default_rng(0)
    rings = 0
    for _ in range(40):
        k = rng.uniform(0.1, 1.5)
        d = unit([k, -rng.uniform(0.3, 0.55) * k])
        radius = cycling_radii(d, 20_000)
        rings += radius.size > 0
        corrected = d.undistort(on_axis(radius))
        np.testing.assert_allclose(d.undistort(d.distort(corrected)), corrected, rtol=1e-15, atol=1e-15)
    assert rings > 10


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("k", [(-0.4,), (0.5, -0.3), (-0.6, 0.25, -0.2), (0.2, 0.1, -0.1, -0.02)])
def test_up_to_the_fold_and_one_step_beyond(k, dtype):
    d = unit(k, dtype)
    fold = d.monotone_radius
    eps = np.finfo(dtype).eps
    inside = fold * (1 - np.concatenate([[0], 2.0 ** np.arange(-np.log2(1 / eps) + 1, 0, 0.25)]))
    corrected = d.undistort(on_axis(inside.astype(dtype)))
    back = d.distort(corrected)
    np.testing.assert_allclose(d.undistort(back), corrected, rtol=4 * eps, atol=0)
    reach = corrected[:, 0].max()
    beyond = on_axis(reach * (1 + np.array([64 * eps, 1e-3, 1, 1e6], dtype)))
    assert not d.has_inverse(beyond).any()
    assert np.isnan(d.distort(beyond)).all()


def test_slopes_that_touch_zero():
    """(1 - t)² as the slope: it touches zero at r = 1, where the inverse exists and is infinitely steep."""
    d = unit([-2 / 3, 1 / 5])
    radius = 1 + np.array([-1e-1, -1e-3, -1e-5, 0, 1e-5, 1e-3, 1e-1])
    fold = float(d.monotone_radius)
    corrected = d.undistort(on_axis(radius))
    seen = radius <= fold
    np.testing.assert_array_equal(np.isfinite(corrected[:, 0]), seen)
    again = d.undistort(d.distort(corrected))
    np.testing.assert_allclose(again[seen], corrected[seen], rtol=1e-15)


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_first_root_is_that_of_dense_sampling(count, rng):
    polynomials = np.concatenate([np.ones((3000, 1)), rng.normal(size=(3000, count))], axis=1)
    ours = first_positive_root(polynomials[:, None])
    x = np.concatenate([np.linspace(0, 2, 4001)[1:], 2 * 10 ** np.linspace(0, 6, 4000)])
    negative = (polynomials @ x ** np.arange(count + 1)[:, None]) < 0
    first = np.where(negative.any(axis=1), x[np.argmax(negative, axis=1)], np.inf)
    assert (ours <= first).all()  # no sign change is missed
    with np.errstate(all="ignore"):
        value = np.abs(np.sum(polynomials * ours[:, None] ** np.arange(count + 1), axis=1))
        size = np.sum(abs(polynomials) * ours[:, None] ** np.arange(count + 1), axis=1)
    assert (np.isinf(ours) | (value <= 1e-9 * size)).all()  # and none is invented
    np.testing.assert_allclose(first_positive_root(jnp.asarray(polynomials)[:, None]), ours, rtol=1e-9)


def test_without_a_root_nothing_is_found():
    def never(q):
        return 0 * q - 1, 0 * q + 1

    for high in (2.0, np.inf):
        with np.errstate(all="ignore"):
            _, found = increasing_root(never, np.ones(3), lambda high=high: np.full(3, high))
        assert not found.any()
        _, found = jax.jit(lambda high: increasing_root(never, jnp.ones(3), lambda: high))(
            jnp.full(3, high)
        )
        assert not found.any()


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_nothing_is_corrected_to_the_other_side_of_a_pole(dtype):
    """Where the divisor is zero but for rounding its sign is anyone's guess."""
    d = unit([-0.02111666, -0.02492284], dtype, zj.models.Division())
    eps = np.finfo(dtype).eps
    beside = np.geomspace(eps, eps**0.25, 60, dtype=dtype)
    pole = d.monotone_radius * (1 + np.concatenate([-beside, [0], beside]).astype(dtype))
    angle = np.linspace(0, 1, len(pole), dtype=dtype)
    points = pole[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    corrected = d.undistort(points)
    known = np.isfinite(corrected).all(axis=1)
    assert (np.sum(corrected * points, axis=1)[known] > 0).all()
    assert 0 < known.sum() < len(pole)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("array", [np.asarray, jnp.asarray])
def test_a_divisor_that_is_nothing_but_rounding_gives_no_number(dtype, array):
    """It may be another one for each coordinate: some points at a pole were corrected to the side."""
    d = unit([-0.05616449, -2.22666717], dtype, zj.models.Division())
    eps = np.finfo(dtype).eps
    radius = d.monotone_radius * (1 - np.append(0, np.geomspace(eps, eps**0.25, 60)))
    angle = np.linspace(-2, 2, len(radius))
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1).astype(dtype)
    corrected = np.asarray(d.undistort(array(points)))
    known = np.isfinite(corrected).all(axis=1)
    assert known[-8:].all()
    assert not known[:4].any()
    assert np.hypot(*corrected[known].T).max() <= radius.max() / np.sqrt(eps)
    assert np.arctan2(*corrected[known].T) == pytest.approx(
        np.arctan2(*points[known].T), abs=8 * float(np.sqrt(eps))
    )


@pytest.mark.parametrize("kind", [np.asarray, jnp.asarray], ids=["NumPy", "JAX"])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize(
    ("k", "distortion_model"),
    [
        ((0.1, 0.02), "RadialPolynomial"),
        ((-0.15, 0.1), "RadialPolynomial"),
        ((0.1, 0.02, 0.03, 0.01), "RadialPolynomial"),
        ((0.1, 0.02, 0.001, 0.001), "BrownConrady"),
    ],
)
def test_points_whose_powers_overflow_have_their_inverse_or_none(k, distortion_model, dtype, kind):
    """An error that is infinite, beside a slope that is, too, is not one of rounding."""
    model = getattr(zj.models, distortion_model)()
    exponent = 0.99 * np.log10(float(np.finfo(dtype).max))
    rho = np.logspace(1, exponent, 200, dtype=dtype)
    found = np.asarray(unit(k, dtype, model).distort(kind(on_axis(rho))), np.float64)
    near = rho < 10 ** min(exponent / 4, 17)
    assert np.isfinite(found[near]).all()
    again = unit(k, np.float64, model).undistort(found[near])
    assert (np.linalg.norm(again - on_axis(rho[near]), axis=1) < 50 * np.finfo(dtype).eps * rho[near]).all()
    # Farther away some have none, but none is its own inverse: that is far nearer to the centre.
    assert not (np.linalg.norm(found, axis=1) > 0.2 * rho)[rho > 100].any()


def test_nan_ends_the_search():
    points = on_axis(np.array([0.5, 1.0]))
    d = eqx.tree_at(lambda d: d.coefficients, unit([0.0, 0.1]), np.array([np.nan, 0.1]))  # as under jit
    assert np.isnan(d.distort(points)).all()
    assert np.isnan(d.undistort(points)).all()
    assert np.isnan(d.monotone_radius)
    assert not unit([0.1]).has_inverse(np.array([[np.nan, 0.0], [np.inf, 1.0]])).any()


@pytest.mark.parametrize(
    "distortion_model",
    [zj.models.RadialPolynomial(), zj.models.Division(), zj.models.BrownConrady()],
    ids=lambda f: type(f).__name__,
)
def test_numpy_and_jax_agree(distortion_model, rng):
    k = np.array([-0.1, 0.03, 0.004, -0.003][: distortion_model.num_coefficients(2)])
    d = unit(k, distortion_model=distortion_model)
    points = rng.uniform(-1, 1, (500, 2))
    for method in ("undistort", "distort"):
        ours = getattr(d, method)(points)
        assert isinstance(ours, np.ndarray)
        np.testing.assert_allclose(ours, getattr(d, method)(jnp.asarray(points)), rtol=0, atol=1e-15)


def test_numpy_points_compile_nothing(compilations, rng):
    d = unit([-0.1, 0.03])
    compilations()
    for number in (1, 10, 1000):
        points = rng.uniform(-1, 1, (number, 2))
        d.undistort(d.distort(points))
        assert d.has_inverse(points).all()
    assert d.monotone_radius > 1
    assert compilations() == 0
