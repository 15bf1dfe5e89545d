import math

import equinox as eqx
import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.models.distortion_model import radial_slope
from zoomjax.models.invertibility import Certificate, slope_controls

SIZE, CENTRE, RANGE = (640, 480), np.array([319.5, 239.5]), np.array([20.0, 120.0])
MODELS = {
    "polynomial": zj.PolynomialZoom(),
    "table": zj.models.TableZoom(),
    "table in f": zj.models.TableZoom(inverse=False),
    "table of one": zj.models.TableZoom(number=1),
    "spline": zj.models.SplineZoom(),
    "spline of two knots": zj.models.SplineZoom(number=2),
    "power law": zj.models.PowerZoom(),
    "two regions": zj.models.TwoRegionZoom(40.0),
}


def lens_of(zoom, centre=CENTRE, dtype=np.float64):
    return zj.ZoomLens(zoom, jnp.asarray(centre, dtype), jnp.asarray(RANGE, dtype), SIZE)


def polynomials(seed, number, degree, terms, spread=0.3):
    """Parameters of random zoom polynomials, half of which fold."""
    return spread * np.random.default_rng(seed).standard_normal((number, degree + 1, terms))


def certified(parameters, dtype=np.float64) -> Certificate:
    """Certificates of many zoom polynomials, about the shortest focal length."""

    def one(parameters):
        zoom = zj.PolynomialZoom(parameters.shape[0] - 1, parameters, jnp.asarray(RANGE[0], dtype))
        return zj.models.certify(lens_of(zoom, dtype=dtype))

    return eqx.filter_jit(lambda every: jax.lax.map(one, every, batch_size=500))(
        jnp.asarray(parameters, dtype)
    )


def slopes(parameters, u, t):
    """The slope of one model at all pairs of ``u = 20 / f`` and squared radii t."""
    degree, terms = parameters.shape[0] - 1, parameters.shape[1]
    order = 2 * np.arange(1, terms + 1) + 1
    return 1 + (u[:, None] ** np.arange(degree + 1)) @ (parameters * order) @ (
        t[None] ** np.arange(1, terms + 1)[:, None]
    )


def dense_least(parameters, number=41):
    u, t = np.linspace(RANGE[0] / RANGE[1], 1, number), np.linspace(0, 1, number)
    return np.array([slopes(one, u, t).min() for one in parameters])


def exact_least(parameters):
    """The least slope of one model, by a grid that closes in on it."""
    low, high = np.array([RANGE[0] / RANGE[1], 0.0]), np.ones(2)
    first, last = low, high
    for _ in range(12):
        u, t = (np.linspace(first[axis], last[axis], 101) for axis in (0, 1))
        values = slopes(parameters, u, t)
        i, j = np.unravel_index(values.argmin(), values.shape)
        here, step = np.array([u[i], t[j]]), (last - first) / 100
        first, last = np.maximum(here - 2 * step, low), np.minimum(here + 2 * step, high)
    return values.min()


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize(("degree", "terms"), [(2, 2), (1, 1), pytest.param(3, 3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("number", [10_000, pytest.param(100_000, marks=pytest.mark.exhaustive)])
def test_never_wrong_of_many_models(number, degree, terms, dtype):
    parameters = polynomials(degree, number, degree, terms).astype(dtype).astype(float)
    ours, least = certified(parameters, dtype), dense_least(parameters)
    assert (np.asarray(ours.least) <= least).all()
    np.testing.assert_array_equal(ours.certified, np.asarray(ours.least) > 0)
    assert not (np.asarray(ours.certified) & (least <= 0)).any()
    # What it refuses folds, but for a few that fold between the samples or next to it.
    assert (np.asarray(ours.certified) != (least > 0)).mean() < 5e-4
    assert 0.2 < np.mean(ours.certified) < 0.8
    # The smallest slope that it found is one.
    assert (np.asarray(ours.slope) >= np.asarray(ours.least)).all()


@pytest.mark.parametrize(
    ("degree", "terms", "margin"), [(0, 2, 1e-9), (2, 2, 1e-9), (4, 2, 1e-9), (2, 3, 1e-6), (3, 4, 1e-6)]
)
def test_decides_next_to_a_fold(degree, terms, margin):
    """Models scaled until their least slope is just above zero, or just below: none is taken wrong."""
    parameters = polynomials(7, 300, degree, terms)
    least = np.array([exact_least(one) for one in parameters])
    parameters, least = parameters[least < 0.9], least[least < 0.9]
    for sign in (1, -1):
        scaled = parameters * ((1 - sign * margin) / (1 - least))[:, None, None]
        ours = certified(scaled)
        assert (np.asarray(ours.certified) == (sign > 0)).all()


def test_decides_next_to_a_fold_in_float32():
    parameters = polynomials(7, 300, 2, 2)
    least = np.array([exact_least(one) for one in parameters])
    parameters, least = parameters[least < 0.9], least[least < 0.9]
    ours = certified(parameters * (0.995 / (1 - least))[:, None, None], np.float32)
    assert ours.least.dtype == jnp.float32
    assert np.mean(ours.certified) > 0.99
    assert not certified(parameters * (1.00001 / (1 - least))[:, None, None], np.float32).certified.any()


@pytest.mark.parametrize(("degree", "terms"), [(0, 1), (0, 2), (1, 2)])
def test_exact_where_nothing_has_to_be_halved(degree, terms):
    parameters = polynomials(3, 100, degree, terms)
    ours = certified(parameters)
    exact = [exact_least(one) for one in parameters]
    np.testing.assert_allclose(ours.least, exact, rtol=0, atol=1e-11)
    np.testing.assert_allclose(ours.slope, exact, rtol=0, atol=1e-11)


def fitted_model(model, seed=0, terms=2, spread=0.1):
    prepared = model.prepare(jnp.array([20.0, 24.0, 35.0, 45.0, 70.0, 120.0]), terms)
    random = spread * np.random.default_rng(seed).standard_normal(prepared.parameters.shape)
    return eqx.tree_at(lambda zoom: zoom.parameters, prepared, jnp.asarray(random))


@pytest.mark.parametrize("terms", [2, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_every_zoom_model_is_certified_as_it_is(model, terms):
    certify = eqx.filter_jit(zj.models.certify)
    focal = jnp.asarray(np.geomspace(*RANGE, 1001))
    t = jnp.linspace(0, 1, 101)
    outcomes = []
    for seed in range(6):
        zoom = fitted_model(model, seed, terms, spread=0.01 * 2**seed)
        ours = certify(lens_of(zoom))
        k = jax.vmap(zoom)(focal)
        least = float(jax.vmap(lambda k: radial_slope(t, k))(k).min())
        assert ours.least <= least + 1e-12
        assert ours.slope <= least + 0.011
        assert bool(ours.certified) == (ours.least > 0)
        there = radial_slope((ours.radius / 400) ** 2, zoom(ours.focal))
        jump = isinstance(model, zj.models.TwoRegionZoom) and abs(ours.focal - 40.0) < 1e-9
        assert jump or ours.slope == pytest.approx(float(there), abs=1e-3)
        outcomes.append(bool(ours.certified))
    assert 0 < sum(outcomes) < 6


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_pieces_are_the_coefficients(model):
    """Or, of a power law, just below."""
    for seed in range(4):
        zoom = fitted_model(model, seed)
        pieces = zoom.pieces(jnp.asarray(RANGE))
        degree = pieces.controls.shape[1] - 1
        for controls, (low, high) in zip(pieces.controls, pieces.ends, strict=True):
            for share in (0.3, 0.8) if high > low else ():
                weights = [
                    math.comb(degree, i) * share**i * (1 - share) ** (degree - i) for i in range(degree + 1)
                ]
                above = zoom(pieces.focal_of(low + share * (high - low))) - np.array(weights) @ controls
                allowed = 1e-3 if isinstance(model, zj.models.PowerZoom) else 1e-13
                assert ((above > -1e-13) & (above < allowed)).all()


def test_off_centre_the_farthest_corner_counts():
    zoom = zj.PolynomialZoom(0, jnp.array([[-0.25]]), jnp.asarray(20.0))
    centred, aside = (
        zj.models.certify(lens_of(zoom)),
        zj.models.certify(lens_of(zoom, CENTRE + np.array([-120, 90.0]))),
    )
    assert centred.certified
    assert centred.radius == pytest.approx(400)
    assert not aside.certified
    assert aside.radius == pytest.approx(np.hypot(440, 330))
    assert float(aside.slope) == pytest.approx(1 - 0.75 * (550 / 400) ** 2, rel=1e-9)


def test_coefficients_that_are_not_finite_are_not_certified():
    zoom = zj.PolynomialZoom(1, jnp.array([[0.1, jnp.nan], [0.0, 0.0]]), jnp.asarray(20.0))
    assert not zj.models.certify(lens_of(zoom)).certified


def test_is_a_constant_for_differentiation():
    def least(parameters):
        return zj.models.certify(lens_of(zj.PolynomialZoom(1, parameters, jnp.asarray(20.0)))).least

    np.testing.assert_array_equal(jax.grad(least)(jnp.array([[-0.1], [-0.1]])), np.zeros((2, 1)))


class SomeZoom(zj.models.AbstractLinearZoom):
    """A model that does not state its pieces: linear in log f."""

    parameters: jax.Array | None = None

    def prepare(self, focal, terms):
        return SomeZoom(jnp.zeros((2, terms)))

    def basis(self, focal):
        return jnp.stack([jnp.ones_like(focal), jnp.log(focal / 20.0)])


@pytest.mark.parametrize(("k1", "folds"), [(-0.2, False), (-0.4, True)])
def test_of_models_without_pieces_nothing_is_proved(k1, folds):
    ours = zj.models.certify(lens_of(SomeZoom(jnp.array([[k1], [0.05]]))))
    assert not ours.certified
    assert ours.least == -jnp.inf
    assert (ours.slope <= 0) == folds
    assert ours.focal == pytest.approx(20)


def test_slope_controls_bound_the_slope_closely():
    for parameters in polynomials(2, 50, 2, 2):
        zoom = zj.PolynomialZoom(2, jnp.asarray(parameters), jnp.asarray(20.0))
        controls = slope_controls(lens_of(zoom))
        least = exact_least(parameters)
        assert least - 0.02 <= controls.min() <= least + 1e-12


numbers = st.floats(-0.4, 0.4, allow_subnormal=False)


@hypothesis.given(
    st.tuples(*[numbers] * 6),
    st.floats(0, 1),
    st.floats(0, 1),
    st.floats(0, 1),
)
def test_there_and_back_inside_the_certificate(parameters, share, x, y):
    parameters = jnp.array(parameters).reshape(3, 2)
    lens = lens_of(zj.PolynomialZoom(2, parameters, jnp.asarray(20.0)))
    ours = zj.models.certify(lens)
    hypothesis.assume(ours.certified & (ours.least > 1e-6))
    focal = np.clip(1 / ((1 - share) / RANGE[0] + share / RANGE[1]), *RANGE)
    point = np.array([x * 640 - 0.5, y * 480 - 0.5])
    d = lens(float(focal))
    corrected = d.undistort(point)
    assert jnp.isfinite(corrected).all()
    assert d.has_inverse(corrected)
    np.testing.assert_allclose(d.distort(corrected), point, rtol=0, atol=1e-10 / float(ours.least))


def test_a_centre_that_moves_is_allowed_for(truth):
    """Invertible about the image's centre, but not about one that far from a corner."""
    k = jnp.array([[-0.31]])  # slope 1 - 0.93 t, 0.07 at the corner
    zoom = zj.PolynomialZoom(0, k, jnp.array(20.0))
    still = zj.ZoomLens(zoom, truth.centre, truth.focal_range, truth.image_size)
    assert zj.models.certify(still).certified
    for offset, certified in ((0.01, True), (0.1, False)):
        shift = zj.PolynomialZoom(1, jnp.array([[0.0, 0.0], [offset, 0.0]]), jnp.array(20.56))
        moving = eqx.tree_at(lambda lens: lens.shift, still, shift, is_leaf=lambda leaf: leaf is None)
        assert zj.models.certify(moving).certified == certified
