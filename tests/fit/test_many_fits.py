"""Many lenses at once: each as by itself."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import RESULTS
from zoomjax.fit import many
from zoomjax.fit.many_fits import data_sets

from .test_zoom import CENTRE, SIZE, distorted_lines


def boards(focal_lengths, seed=0, **options):
    """Data sets of one lens each, bent by as much as its number says."""
    made = []
    for index, focal in enumerate(focal_lengths):
        coefficients = jnp.array([[0.05, -0.01], [-0.15 - 0.02 * index, 0.03]])
        lens = zj.ZoomLens(
            zj.PolynomialZoom(1, coefficients, jnp.asarray(20.0)),
            jnp.asarray(CENTRE),
            jnp.array([20.0, 80.0]),
            SIZE,
        )
        lines = distorted_lines(lens, focal, offset=60.0, noise=0.2, seed=seed + index, **options)
        made.append(zj.compress(lines))
    return made


FOCAL = [np.geomspace(20, 80, number) for number in (3, 4, 5)]


@pytest.fixture(scope="module")
def sets():
    """Three data sets of other sizes: the first two share a program, the last has one of its own."""
    return [*boards(FOCAL[:2]), *boards(FOCAL[2:], number=20)]


def assert_same(got, wanted):
    assert jax.tree.structure(got) == jax.tree.structure(wanted)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(wanted), strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_each_fit_is_that_of_its_data_set_alone(sets):
    fits = many(sets)
    assert isinstance(fits[0].covariance, jax.Array)
    for fit, lines in zip(fits, sets, strict=True):
        assert_same(fit, zj.fit_zoom(lines))


@pytest.mark.slow
def test_a_robust_fit_rejects_in_each_data_set_what_it_rejects_alone(sets):
    mixed = []
    for focal, bad in zip(FOCAL[:2], (5, 30), strict=True):
        lines = distorted_lines(None, focal, offset=60.0, noise=0.2)
        bent = (
            jnp.asarray(lines.points)
            .at[bad]
            .add(8 * jnp.sin(jnp.linspace(0, 3, lines.points.shape[1]))[:, None])
        )
        mixed.append(zj.compress(eqx.tree_at(lambda lines: lines.points, lines, bent)))
    robust = many(mixed, zj.fit_robust)
    assert [fit.rejected.tolist() for fit in robust] == [[5], [30]]
    for fit, lines in zip(robust, mixed, strict=True):
        assert_same(fit, zj.fit_robust(lines))


def test_a_data_set_that_fails_harms_no_other(sets):
    broken = eqx.tree_at(lambda lines: lines.triangle, sets[1], sets[1].triangle.at[3].set(jnp.nan))
    first, second, third = many([sets[0], broken, sets[0]])
    assert second.result == RESULTS.nonfinite
    assert_same(first, zj.fit_zoom(sets[0]))
    assert_same(third, first)
    with pytest.raises(RuntimeError, match=r"1 of 2 fits failed. Data set 1: .* With throw=False"):
        many([sets[0], broken], throw=True)


@pytest.mark.slow
def test_a_lens_that_folds_is_refitted_as_alone(sets):
    zoom = zj.PolynomialZoom(2, jnp.array([[0.1, 0.0], [-0.1, 0.0], [-0.6, 0.1]]), jnp.asarray(20.0))
    lens = zj.ZoomLens(zoom, jnp.asarray(CENTRE), jnp.array([20.0, 80.0]), SIZE)
    folding = zj.compress(distorted_lines(lens, FOCAL[1], offset=120.0, noise=0.3, reach=0.45))
    usual, folded = many([sets[1], folding])
    assert usual.result == RESULTS.successful
    assert folded.result == RESULTS.constrained
    assert_same(folded, zj.fit_zoom(folding))
    assert many([folding], invertible=False)[0].result == RESULTS.folded


@pytest.mark.slow
def test_other_data_sets_compile_nothing(sets, compilations):
    many(sets)
    others = boards([np.geomspace(24, 70, number) for number in (4, 5, 3, 4, 5)], seed=9)
    compilations()
    assert len(many(others)) == 5
    assert compilations() == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {"zoom": zj.PolynomialZoom(degree=1), "terms": 1},
        {"zoom": zj.models.TableZoom()},
        {"distortion_model": zj.models.Division(), "terms": 1},
    ],
    ids=["degree", "table", "division"],
)
def test_options_are_those_of_the_fit(options):
    lines = compressed_for(options)
    for fit, one in zip(many(lines, **options), lines, strict=True):
        assert_same(fit, zj.fit_zoom(one, **options))


def compressed_for(options):
    """Data sets compressed as these options need them."""
    made = [distorted_lines(None, focal, offset=60.0, noise=0.2) for focal in FOCAL[:2]]
    if "distortion_model" in options:
        return [zj.fit.compress_for(lines, options["distortion_model"]) for lines in made]
    return [zj.compress(lines) for lines in made]


@pytest.mark.slow
def test_points_are_fitted_too():
    lines = [distorted_lines(None, focal, offset=60.0, noise=0.2, number=6) for focal in FOCAL[:2]]
    for fit, one in zip(many(lines, zoom=zj.PolynomialZoom(degree=1)), lines, strict=True):
        assert_same(fit, zj.fit_zoom(one, zoom=zj.PolynomialZoom(degree=1)))


def test_none_is_none():
    assert many([]) == []


def test_arguments_are_checked(sets):
    with pytest.raises(TypeError, match="list of data sets"):
        data_sets(sets[0])  # as `many` does, but for the checks that tests add
    with pytest.raises(TypeError, match="the type of its element 1 is str"):
        data_sets([sets[0], "lines.npz"])
    with pytest.raises(TypeError, match="must be fit_zoom or fit_robust"):
        many(sets, zj.fit_frames)  # pyright: ignore[reportCallIssue, reportArgumentType]
    with pytest.raises(ValueError, match=r"Data set 1: .* needs 5 or more distinct"):
        many([sets[2], sets[1]], zoom=zj.PolynomialZoom(degree=4))
    with pytest.raises(ValueError, match="must have known values"):
        jax.jit(lambda lines: many([lines]))(sets[0])
