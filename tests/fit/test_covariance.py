"""The covariance by NumPy, of few lines, and by a program, of many or under `jit`: the same formulas."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes
from zoomjax.fit import covariance
from zoomjax.fit.covariance import covariance_of, covariance_terms
from zoomjax.fit.energy import linearised

MODELS = {
    "quadratic": (zj.PolynomialZoom(), 2),
    "cubic": (zj.PolynomialZoom(degree=3), 3),
    "with a prior": (zj.models.SmoothZoom(), 2),
}


def lines_of(noise, terms=3, photos=6):
    scene = scenes.board_lines(
        scenes.nikkor_18_200(), scenes.focal_sweep(photos), spacing=200, noise=noise, seed=3
    )
    return zj.compress(scene, terms=terms)


@pytest.fixture
def by_program(monkeypatch):
    """What a function gives where no covariance is NumPy's."""

    def of(function):
        with monkeypatch.context() as patched:
            patched.setattr(covariance, "are_few", lambda arguments: False)
            return function()

    return of


@pytest.mark.parametrize("noise", [0.0, 0.3])
@pytest.mark.parametrize("name", MODELS)
def test_numpy_and_a_program_give_the_same_covariance(name, noise, by_program):
    zoom, terms = MODELS[name]
    lines = lines_of(noise)

    def fit():
        return zj.fit_zoom(lines, zoom=zoom, terms=terms)

    own, other = fit(), by_program(fit)
    assert isinstance(own.covariance, jax.Array)
    np.testing.assert_allclose(own.covariance, other.covariance, rtol=1e-9)
    apart = eqx.tree_at(lambda fit: fit.covariance, own, other.covariance)
    for one, another in zip(jax.tree.leaves(apart), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(one, another, rtol=1e-13, atol=1e-15)


def test_what_lines_do_not_determine_is_so_for_both(by_program):
    scene = lines_of(0.3)
    near = np.linalg.norm(np.asarray(scene.triangle)[:, 1:3, 1:3], axis=(1, 2))
    few = scene.weighted((near < np.quantile(near, 0.05)).astype(float))

    def fit():
        return zj.fit_zoom(few, zoom=zj.PolynomialZoom(degree=3), terms=3, invertible=False, throw=False)

    own, other = fit(), by_program(fit)
    assert own.result == other.result == zj.RESULTS.undetermined
    assert np.isinf(own.covariance).any()
    np.testing.assert_array_equal(np.isinf(own.covariance), np.isinf(other.covariance))


def test_numbers_that_are_none_end_as_in_a_program(by_program):
    lines = lines_of(0.3)
    spoiled = eqx.tree_at(lambda lines: lines.triangle, lines, lines.triangle.at[3, 1, 1].set(jnp.nan))

    def fit():
        return zj.fit_zoom(spoiled, throw=False)

    own, other = fit(), by_program(fit)
    assert own.result == other.result != zj.RESULTS.successful
    np.testing.assert_array_equal(np.isnan(own.covariance), np.isnan(other.covariance))


def test_the_covariance_keeps_the_precision_of_the_lines():
    single = jax.tree.map(
        lambda leaf: leaf.astype(np.float32) if leaf.dtype == np.float64 else leaf, lines_of(0.3)
    )
    fit = zj.fit_zoom(single)
    assert fit.covariance.dtype == np.float32
    np.testing.assert_allclose(fit.covariance, zj.fit_zoom(lines_of(0.3)).covariance, rtol=0.05, atol=1e-9)


def test_the_covariance_with_a_centre_is_numpys_too(by_program):
    scene = scenes.board_lines(
        scenes.nikkor_18_200(), scenes.focal_sweep(4), spacing=300, noise=0.3, seed=3
    )
    lines = zj.lines.compress_any_centre(scene)

    def fit():
        return zj.fit.fit_centre(lines)

    own, other = fit(), by_program(fit)
    assert (bool(own.determined), bool(other.determined)) == (True, True)
    np.testing.assert_allclose(own.covariance, other.covariance, rtol=1e-8)
    np.testing.assert_allclose(own.std, other.std, rtol=1e-8)


@pytest.mark.parametrize("name", MODELS)
def test_photos_count_together_or_not_in_both(name):
    zoom, terms = MODELS[name]
    lines = lines_of(0.3, terms)
    fitted = zj.fit_zoom(lines, zoom=zoom, terms=terms).lens.zoom
    known = covariance_terms(lines, fitted, linearised(lines, fitted))
    for photos in (True, False):
        one, whole = covariance_of(known, photos)
        other, also = covariance_of(jax.tree.map(np.asarray, known), photos)
        assert (bool(whole), bool(also)) == (True, True)
        np.testing.assert_allclose(other, one, rtol=1e-9)


@pytest.mark.parametrize(("rows", "columns"), [(3, 5), (5, 5), (70, 5), (1000, 5), (200, 30)])
def test_the_triangle_of_blocks_is_that_of_all_rows(rows, columns):
    table = np.random.default_rng(0).normal(size=(rows, 2, columns))
    found = covariance._triangle(table, np.ones((1, columns)))
    whole = np.concatenate([table.reshape(-1, columns), np.ones((1, columns))])
    assert found.shape == (columns, columns)
    np.testing.assert_allclose(found.T @ found, whole.T @ whole, rtol=1e-12, atol=1e-12)
