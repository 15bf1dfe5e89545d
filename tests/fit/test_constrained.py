"""Fits whose best model folds: the best one that does not takes its place."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import zoomjax as zj
from zoomjax import RESULTS
from zoomjax.fit.constrained import LEAST_SLOPE
from zoomjax.models.invertibility import slope_controls

from .._reference import assert_derivatives_agree
from ..conftest import LAST_BITS, moved
from ..models.test_invertibility import SomeZoom
from .test_zoom import CENTRE, SIZE, distorted_lines, parameters

FOCAL = np.array([20.0, 25.0, 30.0, 40.0, 55.0, 80.0])


@pytest.fixture(scope="module")
def folding():
    """A lens that folds near the corners at its short end, and noisy lines in the middle of its images."""
    zoom = zj.PolynomialZoom(2, jnp.array([[0.1, 0.0], [-0.1, 0.0], [-0.6, 0.1]]), jnp.asarray(20.0))
    lens = zj.ZoomLens(zoom, jnp.asarray(CENTRE), jnp.array([20.0, 80.0]), SIZE)
    return distorted_lines(lens, FOCAL, offset=120.0, noise=0.3, reach=0.45)


@pytest.fixture(scope="module")
def lines(folding):
    return zj.compress(folding)


@pytest.fixture(scope="module")
def free(lines):
    return zj.fit_zoom(lines, invertible=False)


@pytest.fixture(scope="module")
def best(lines):
    return zj.fit_zoom(lines)


@pytest.mark.slow
def test_without_the_demand_the_fit_folds_and_says_where(free):
    assert free.result == RESULTS.folded
    assert not free.certificate.certified
    d = free.lens(float(free.certificate.focal))
    assert float(d.monotone_radius) < float(free.certificate.radius) <= 400.001
    assert free.rms_unconstrained == free.rms


def test_the_fit_is_invertible_and_says_what_that_cost(free, best):
    assert best.result == RESULTS.constrained
    assert "refitted to be invertible" in RESULTS[best.result]
    assert best.certificate.certified
    assert best.certificate.least == pytest.approx(LEAST_SLOPE, abs=1e-6)
    assert best.rms_unconstrained == free.rms
    assert free.rms < best.rms < 1.05 * free.rms
    assert best.steps > free.steps
    corner = best.lens(20.0).undistort(jnp.zeros(2))
    np.testing.assert_allclose(best.lens(20.0).distort(corner), [0, 0], atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("terms", [1, 2])
def test_there_is_no_better_one(terms, folding):
    """By SciPy, from no distortion, under the same inequalities."""
    lines = zj.compress(folding, terms)
    best = zj.fit_zoom(lines, terms=terms)
    zoom = best.lens.zoom

    def model(flat):
        return eqx.tree_at(lambda zoom: zoom.parameters, zoom, flat.reshape(3, terms))

    @jax.jit
    def slack(flat):
        lens = eqx.tree_at(lambda lens: lens.zoom, best.lens, model(flat))
        return slope_controls(lens) - LEAST_SLOPE

    energy = jax.jit(
        jax.value_and_grad(lambda flat: zj.fit.global_energy(lines, jax.vmap(model(flat))(lines.focal)))
    )
    slopes = np.asarray(jax.jacfwd(slack)(jnp.zeros(3 * terms)))
    solution = scipy.optimize.minimize(
        lambda flat: tuple(map(np.asarray, energy(flat))),
        np.zeros(3 * terms),
        jac=True,
        method="SLSQP",
        constraints=[
            {"type": "ineq", "fun": lambda flat: np.asarray(slack(flat)), "jac": lambda _: slopes}
        ],
        options={"ftol": 1e-12, "maxiter": 500},
    )
    assert solution.success
    assert float(best.rms) ** 2 == pytest.approx(solution.fun, rel=1e-8)
    assert slack(zoom.parameters.ravel()).min() > 0


def test_a_good_fit_stays_as_it_is_to_the_last_bit(small, fit):
    free = zj.fit_zoom(small, invertible=False)
    assert fit.result == RESULTS.successful
    assert fit.certificate.certified
    assert fit.rms_unconstrained == fit.rms
    for one, other in zip(jax.tree.leaves(fit), jax.tree.leaves(free), strict=True):
        np.testing.assert_allclose(one, other, rtol=LAST_BITS)


def test_good_frames_stay_as_they_are(small, frame_fits):
    free = zj.fit_frames(small, invertible=False)
    assert np.asarray(frame_fits.certificate.certified).all()
    for one, other in zip(jax.tree.leaves(frame_fits), jax.tree.leaves(free), strict=True):
        np.testing.assert_allclose(one, other, rtol=LAST_BITS)


@pytest.mark.slow
def test_frames_that_fold_become_invertible_and_others_stay(lines):
    free, best = zj.fit_frames(lines, invertible=False), zj.fit_frames(lines)
    folds = np.asarray(free.result == RESULTS.folded)
    assert 0 < folds.sum() < len(FOCAL)
    np.testing.assert_array_equal(best.result == RESULTS.constrained, folds)
    assert np.asarray(best.certificate.certified).all()
    np.testing.assert_array_equal(best.coefficients[~folds], free.coefficients[~folds])
    assert (np.asarray(best.frame_rms)[folds] > np.asarray(free.frame_rms)[folds]).all()
    assert best.rms_unconstrained == pytest.approx(float(free.rms))


RIVALS = {
    "table": zj.models.TableZoom(),
    "spline": zj.models.SplineZoom(4),
    "two regions": zj.models.TwoRegionZoom(35.0),
    "power law": zj.models.PowerZoom(),
}


@pytest.mark.slow
@pytest.mark.parametrize("terms", [1, 2])
@pytest.mark.parametrize("model", RIVALS.values(), ids=RIVALS)
def test_rivals_become_invertible_too(model, terms, folding):
    lines = zj.compress(folding, terms)
    free = zj.fit_zoom(lines, zoom=model, terms=terms, invertible=False)
    best = zj.fit_zoom(lines, zoom=model, terms=terms)
    assert free.result == RESULTS.folded
    assert best.result == RESULTS.constrained
    assert best.certificate.certified
    assert free.rms < best.rms < (1.05 if terms == 2 else 5) * free.rms


@pytest.mark.slow
def test_models_without_pieces_are_left_as_they_are(folding):
    lines = zj.compress(folding, 1)
    fit = zj.fit_zoom(lines, zoom=SomeZoom(), terms=1)
    assert fit.result == RESULTS.folded
    assert fit.certificate.slope < 0
    traced = eqx.filter_jit(lambda lines: zj.fit_zoom(lines, zoom=SomeZoom(), terms=1))(lines)
    np.testing.assert_allclose(parameters(traced), parameters(fit), rtol=1e-9)


@pytest.mark.slow
def test_robust_fits_are_invertible_unless_asked_not_to_be(lines):
    assert zj.fit_robust(lines).fit.result == RESULTS.constrained
    assert zj.fit_robust(lines, invertible=False).fit.result == RESULTS.folded


@pytest.mark.slow
def test_full_tensors_give_the_same(folding, best):
    full = zj.fit_zoom(folding)
    np.testing.assert_allclose(parameters(full), parameters(best), rtol=0, atol=1e-9)


@pytest.mark.slow
def test_float32(folding, best):
    single = jax.tree.map(
        lambda a: jnp.asarray(a, jnp.float32) if jnp.issubdtype(a.dtype, jnp.floating) else a, folding
    )
    fit = zj.fit_zoom(zj.compress(single))
    assert fit.result == RESULTS.constrained
    assert fit.certificate.certified
    assert fit.lens.zoom.parameters.dtype == jnp.float32
    assert float(fit.rms) == pytest.approx(float(best.rms), rel=1e-5)


# Under a trace, where both ways are compiled


def barrel_of(k):
    """A barrel, one distortion for all focal lengths, in few lines and points."""
    zoom = zj.PolynomialZoom(0, jnp.array([[k]]), jnp.asarray(20.0))
    lens = zj.ZoomLens(zoom, jnp.asarray(CENTRE), jnp.array([20.0, 80.0]), SIZE)
    return distorted_lines(lens, FOCAL[:1], offset=150.0, noise=0.5, reach=0.4, number=4, points=5)


@pytest.fixture(scope="module")
def barrel():
    """One that folds."""
    return barrel_of(-0.44)


@pytest.mark.slow
def test_differentiable_with_respect_to_the_points(barrel):
    """Where the slope is forced to be what it is it stays; the rest moves as with finite steps."""

    def fitted(points):
        small = zj.compress(moved(barrel, points), 2)
        return 100 * zj.fit_zoom(small, zoom=zj.PolynomialZoom(0)).lens.zoom.parameters.ravel()

    fit = zj.fit_zoom(zj.compress(barrel), zoom=zj.PolynomialZoom(0))
    assert fit.result == RESULTS.constrained
    np.testing.assert_allclose(jax.jit(fitted)(barrel.points), 100 * parameters(fit).ravel(), rtol=1e-7)
    assert_derivatives_agree(fitted, barrel.points, step=1e-2, rtol=1e-4)


def batch_of(*several):
    """Data sets of one shape as one with an axis more."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *several)


def conditions(jaxpr):
    """The predicates' shapes, and the size of what is computed, of all conditions in a program."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "cond":
            yield (
                equation.invars[0].aval.shape,
                max(len(str(branch)) for branch in equation.params["branches"]),
            )
        for value in jax.tree.leaves(equation.params, is_leaf=lambda p: hasattr(p, "eqns")):
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns"):
                yield from conditions(inner)


def test_under_vmap_the_search_stays_conditional(barrel):
    """Of the whole batch: as a choice for each of it, both would be computed for all, always."""
    small = zj.compress(barrel)
    zoom = zj.PolynomialZoom(0)

    def fitted(lines):
        return zj.fit_zoom(lines, zoom=zoom, throw=False).lens.zoom.parameters

    arrays, rest = eqx.partition(batch_of(small, small), eqx.is_array)
    program = jax.make_jaxpr(jax.vmap(lambda arrays: fitted(eqx.combine(arrays, rest))))(arrays)
    largest = max(conditions(program.jaxpr), key=lambda one: one[1])
    assert largest[0] == ()
    assert largest[1] > 20_000  # it holds the interior-point method


@pytest.mark.slow
def test_under_vmap_each_fit_is_what_it_is_alone(barrel):
    """Some of a batch fold and some do not; or none does."""
    folding, good = zj.compress(barrel, 1), zj.compress(barrel_of(-0.1), 1)
    zoom = zj.PolynomialZoom(0)

    def fitted(lines):
        return zj.fit_zoom(lines, zoom=zoom, terms=1, throw=False)

    assert fitted(folding).result == RESULTS.constrained
    assert fitted(good).result != RESULTS.constrained
    together = eqx.filter_jit(eqx.filter_vmap(fitted))
    for several in ((folding, good, folding), (good, good, good)):
        fits = together(batch_of(*several))
        for index, lines in enumerate(several):
            alone = fitted(lines)
            np.testing.assert_allclose(
                fits.lens.zoom.parameters[index], parameters(alone), rtol=1e-7, atol=1e-10
            )
            assert jax.tree.map(lambda leaf, index=index: leaf[index], fits.result) == alone.result
            np.testing.assert_allclose(fits.rms_unconstrained[index], alone.rms_unconstrained, rtol=1e-9)
