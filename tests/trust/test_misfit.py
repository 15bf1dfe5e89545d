"""The misfit of a zoom model: nothing where the model is right, its size where it is not."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes
from zoomjax.trust import misfit

FOCAL = scenes.focal_sweep(12)


@pytest.fixture(scope="module")
def lines(truth):
    return zj.compress(scenes.board_lines(truth, FOCAL, spacing=200.0, noise=0.3, seed=3))


def test_a_model_that_follows_the_lens_has_next_to_none(lines):
    fit = zj.fit_zoom(lines)
    wide = zj.trust.with_misfit(fit, lines)
    corner = np.zeros(2)
    before, after = (np.asarray(zj.displacement_std(x, corner, focal=FOCAL)) for x in (fit, wide))
    assert (after >= before * (1 - 1e-9)).all()
    assert (after < 1.5 * before).all()


def test_a_model_that_does_not_has_as_much_as_it_is_off(truth, lines):
    fit = zj.fit_zoom(lines, zoom=zj.PolynomialZoom(degree=1))
    wide = zj.trust.with_misfit(fit, lines)
    off = np.asarray(jax.vmap(truth.zoom)(FOCAL) - jax.vmap(fit.lens.zoom)(FOCAL))
    size = np.sqrt(np.mean(off**2, axis=0))
    assert np.sqrt(np.diag(wide.misfit)) == pytest.approx(size, rel=0.3)
    np.testing.assert_array_equal(wide.covariance, fit.covariance)


def test_few_frames_have_no_estimate(truth):
    few = zj.compress(scenes.board_lines(truth, FOCAL[:4], spacing=200.0, noise=0.3))
    fit = zj.fit_zoom(few)
    assert zj.trust.with_misfit(fit, few).misfit is None


@pytest.mark.parametrize("metric", [lambda lines: lines, zj.fit.in_image])
def test_a_coefficient_that_the_model_lacks_is_in_the_bands(truth, metric):
    """Of a lens of three coefficients, fitted with two: its corner is off by many standard deviations."""
    three = np.pad(np.asarray(truth.zoom.parameters), ((0, 0), (0, 1)))
    three[0, 2] = -0.02
    lens = eqx.tree_at(lambda lens: lens.zoom.parameters, truth, jnp.asarray(three))
    seen = scenes.board_lines(lens, FOCAL, spacing=200.0, noise=0.1, seed=3)
    lines = metric(zj.compress(seen, terms=3))
    fit = zj.fit_zoom(lines, terms=2)
    wide = zj.trust.with_misfit(fit, lines)
    corner = np.zeros(2)
    off = np.array(
        [np.linalg.norm(fit.lens(f).undistort(corner) - lens(f).undistort(corner)) for f in FOCAL]
    )
    before, after = (np.asarray(zj.displacement_std(x, corner, focal=FOCAL)) for x in (fit, wide))
    assert (off > 3 * before).mean() > 0.6
    assert (off < 2 * after).mean() > 0.9
    assert wide.misfit.shape == (3, 3)
    assert zj.trust.coefficient_std(wide, FOCAL).shape == (len(FOCAL), 2)
    two = metric(zj.compress(seen, terms=2))
    assert zj.trust.with_misfit(fit, two).misfit.shape == (2, 2)


def size_of(fit):
    return np.sqrt(np.diag(fit.misfit))


@pytest.mark.slow
@pytest.mark.parametrize("metric", [lambda lines: lines, zj.fit.in_image])
def test_by_residuals_it_is_what_it_is_by_moments(lines, metric):
    lines = metric(lines)
    fit = zj.fit_zoom(lines, zoom=zj.PolynomialZoom(degree=1))
    k = np.asarray(jax.vmap(fit.lens.zoom)(lines.focal))
    quickly, by_residuals = misfit._quickly(lines, k), misfit._by_residuals(lines, k, fit.lens.family)
    for one, other in zip(quickly, by_residuals, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-9 * np.abs(one).max())


@pytest.mark.slow
@pytest.mark.parametrize("family", [zj.models.Division(), zj.models.BrownConrady()])
def test_other_distortion_models_have_one_too(truth, family):
    """The scene is a polynomial's: what degree 1 misses of k1 is the same, up to Division's sign."""
    seen = scenes.board_lines(truth, FOCAL, spacing=200.0, noise=0.3, seed=3)
    small = zj.fit.compress_family(seen, family)
    fit = zj.fit_zoom(small, zoom=zj.PolynomialZoom(degree=1))
    own = zj.fit_zoom(zj.compress(seen), zoom=zj.PolynomialZoom(degree=1))
    found = size_of(zj.trust.with_misfit(fit, small))
    expected = size_of(zj.trust.with_misfit(own, zj.compress(seen)))
    assert found[0] == pytest.approx(expected[0], rel=0.4)
    if len(found) == 4:
        assert (found[2:] < 0.02 * found[0]).all()


@pytest.mark.slow
def test_nor_does_the_metric_matter(lines):
    fit = zj.fit_zoom(zj.fit.in_image(lines), zoom=zj.PolynomialZoom(degree=1))
    paper = zj.fit_zoom(lines, zoom=zj.PolynomialZoom(degree=1))
    found = size_of(zj.trust.with_misfit(fit, zj.fit.in_image(lines)))
    np.testing.assert_allclose(found, size_of(zj.trust.with_misfit(paper, lines)), rtol=0.2)
