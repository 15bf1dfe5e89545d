import dataclasses
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial import Legendre

import zoomjax as zj
from zoomjax import scenes
from zoomjax.fit.energy import prior_residuals
from zoomjax.models.zoom import with_parameters

from ..conftest import LAST_BITS, moved

FOCAL = jnp.array([18.0, 24.0, 35.0, 70.0, 200.0])


def fitted(lines, error=None, **options):
    zoom = zj.SmoothZoom(**options) if error is None else zj.SmoothZoom(error=error, **options)
    return zj.fit_zoom(lines, zoom=zoom)


@pytest.fixture(scope="module")
def smooth(small):
    return fitted(small)


def random(zoom, seed=0):
    parameters = 0.1 * np.random.default_rng(seed).standard_normal((zoom.degree + 1, 2))
    return with_parameters(zoom.prepare(FOCAL, 2), jnp.asarray(parameters))


def variance_by_the_formula(zoom):
    """The prior's covariance of the flattened parameters, block by block."""
    low, high = (np.asarray(factor) @ np.asarray(factor).T for factor in (zoom.quadratic, zoom.beyond))
    size = 2 * (zoom.degree + 1)
    covariance = np.zeros((size, size))
    covariance[:6, :6] = low
    for j in range(3, zoom.degree + 1):
        covariance[2 * j : 2 * j + 2, 2 * j : 2 * j + 2] = (3 / j) ** 4 * high
    return covariance


def coefficients(fit, focal):
    return np.asarray(jax.vmap(fit.lens.zoom)(jnp.asarray(focal)))


# The model


def test_coefficients_are_legendre_series_in_one_over_f():
    zoom = random(zj.SmoothZoom())
    for f in (18.0, 31.0, 200.0):
        series = [Legendre(column)(2 * 18.0 / f - 1) for column in np.asarray(zoom.parameters).T]
        np.testing.assert_allclose(zoom(jnp.asarray(f)), series, rtol=1e-12)


def test_standardised_parameters_have_the_covariance_that_is_documented():
    zoom = random(zj.SmoothZoom(degree=5))
    flat = np.asarray(zoom.parameters).ravel()
    expected = flat @ np.linalg.solve(variance_by_the_formula(zoom), flat)
    np.testing.assert_allclose(jnp.sum(zoom.standardised() ** 2), expected, rtol=1e-10)


def test_a_priori_lenses_have_the_distortion_of_lenses():
    """Displacement at the corner: percents of the half diagonal, more where the focal length is short."""
    zoom = zj.SmoothZoom().prepare(FOCAL, 2)
    basis = jax.vmap(zoom.basis)(FOCAL)
    corner = np.kron(basis, np.ones((1, 2)))
    deviation = np.sqrt(np.einsum("fp,pq,fq->f", corner, variance_by_the_formula(zoom), corner))
    assert ((deviation > 0.005) & (deviation < 0.3)).all()
    assert deviation[0] == deviation.max()


@pytest.mark.parametrize("degree", [2, 3.5])
def test_degree_that_is_none_raises(degree, unchecked):
    with pytest.raises(ValueError, match="degree must be an integer of at least 3"):
        zj.SmoothZoom(degree=degree)


def test_terms_that_the_prior_is_not_for_raise():
    with pytest.raises(ValueError, match="prior of this SmoothZoom is for 2 terms, but 3"):
        zj.SmoothZoom().prepare(FOCAL, 3)


def test_a_prior_of_ones_own_is_for_its_terms():
    zoom = zj.SmoothZoom(quadratic=0.1 * jnp.eye(3), beyond=0.01 * jnp.eye(1))
    assert zoom.prepare(FOCAL, 1).parameters.shape == (7, 1)


def test_shapes_that_disagree_raise():
    with pytest.raises(ValueError, match="quadratic must have shape"):
        zj.SmoothZoom(beyond=jnp.eye(1))
    with pytest.raises(ValueError, match=r"parameters must have shape \(7, 2\)"):
        zj.SmoothZoom(parameters=jnp.zeros((3, 2)))


def test_model_that_was_only_specified_raises():
    with pytest.raises(ValueError, match="not fitted"):
        zj.SmoothZoom().standardised()


def test_file_keeps_model_and_prior(smooth, tmp_path):
    smooth.lens.save(tmp_path / "lens.json")
    loaded = zj.load_lens(tmp_path / "lens.json")
    for mine, theirs in zip(jax.tree.leaves(loaded), jax.tree.leaves(smooth.lens), strict=True):
        np.testing.assert_array_equal(mine, theirs)


# What is known of a lens

NIKKOR = zj.SmoothZoom.for_lens(18.0, 200.0, crop=1.5)


def test_a_mean_is_where_the_standardised_parameters_are_zero():
    zoom = NIKKOR.prepare(FOCAL, 2)
    parameters = jnp.zeros((7, 2)).at[:3].set(zoom.mean)
    assert not with_parameters(zoom, parameters).standardised().any()
    assert zoom.standardised().any()


def test_a_mean_of_zeros_is_none(small, smooth):
    zeros = fitted(small, mean=jnp.zeros((3, 2)), focal_ref=small.focal.min())
    one, other = zeros.lens.zoom.parameters, smooth.lens.zoom.parameters
    np.testing.assert_allclose(one, other, rtol=LAST_BITS)
    assert zj.SmoothZoom().mean is None


def test_with_much_weight_the_fit_is_the_mean(small):
    fit = zj.fit_zoom(small, zoom=dataclasses.replace(NIKKOR, error=1e3))
    np.testing.assert_allclose(fit.lens.zoom.parameters[:3], NIKKOR.mean, atol=1e-6)
    np.testing.assert_allclose(fit.lens.zoom.parameters[3:], 0, atol=1e-6)


def test_the_algebraic_estimate_goes_to_the_mean_too(small):
    held = zj.fit.algebraic_zoom(small, zoom=dataclasses.replace(NIKKOR, error=1e3))
    np.testing.assert_allclose(held.zoom.parameters[:3], NIKKOR.mean, atol=1e-6)


def test_a_known_lens_is_about_its_own_wide_end(small):
    """Photos may show a part of its range."""
    zoom = NIKKOR.prepare(FOCAL[2:], 2)
    assert zoom.focal_ref == 18.0
    fit = zj.fit_zoom(small, zoom=NIKKOR)
    assert fit.lens.zoom.focal_ref == 18.0 < small.focal.min()
    again = zj.fit_zoom(small, zoom=fit.lens.zoom)
    np.testing.assert_allclose(again.lens.zoom.parameters, fit.lens.zoom.parameters, atol=1e-9)


@pytest.mark.parametrize("known", [(16.0, 35.0, 1.0), (24.0, 70.0, 1.0), (18.0, 55.0, 1.5)])
def test_standard_zooms_are_a_priori_barrels_at_the_wide_end_and_cushions_at_the_long_one(known):
    shortest, longest, crop = known
    zoom = zj.SmoothZoom.for_lens(shortest, longest, crop=crop)
    zoom = with_parameters(zoom, jnp.zeros((7, 2)).at[:3].set(zoom.mean))
    assert 0.02 < jnp.sum(zoom(shortest)) < 0.1
    assert -0.02 < jnp.sum(zoom(longest)) < 0


def test_beyond_most_lenses_a_prior_is_that_of_the_last_ones():
    phone, usual = (zj.SmoothZoom.for_lens(10.0, 10.0 * r, crop=1.6) for r in (125.0, 15.0))
    assert eqx.tree_equal(phone, usual)


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ((0.0, 50.0, 1.5), "shortest"),
        ((np.nan, 50.0, 1.5), "shortest"),
        ((16.0, 16.0, 1.5), "longest"),
        ((16.0, np.inf, 1.5), "longest"),
        ((16.0, 50.0, -1.0), "crop"),
    ],
)
def test_a_lens_that_is_none_raises(given, named):
    shortest, longest, crop = given
    with pytest.raises(ValueError, match=f"Argument {named} must be a finite number above"):
        zj.SmoothZoom.for_lens(shortest, longest, crop=crop)


def test_a_mean_of_another_shape_raises():
    with pytest.raises(ValueError, match=r"mean must have shape \(3, 2\)"):
        zj.SmoothZoom(mean=jnp.zeros((2, 2)))


def drawn(zoom, seed):
    """A lens of such a prior, and lines that it sees at two focal lengths and at one between."""
    focal = np.array([18.0, 50.0, 200.0])
    zoom = zoom.prepare(focal, 2)
    rng = np.random.default_rng(seed)
    low = np.asarray(zoom.mean).ravel() + np.asarray(zoom.quadratic) @ rng.standard_normal(6)
    parameters = jnp.zeros((7, 2)).at[:3].set(low.reshape(3, 2))
    lens = zj.ZoomLens(
        with_parameters(zoom, parameters), jnp.array([319.5, 239.5]), jnp.array([18.0, 200.0]), (640, 480)
    )
    return lens, scenes.board_lines(lens, focal, spacing=60.0)


@pytest.mark.slow
def test_a_lens_like_others_of_its_kind_is_predicted_better_if_its_kind_is_known():
    """Lenses as the database has them, of which both ends are photographed."""
    worse = []
    for seed in range(6):
        lens, seen = drawn(NIKKOR, seed)
        lines = zj.compress(seen).weighted(np.where(np.asarray(seen.frame) == 1, 0.0, 1.0))
        at = jnp.asarray(50.0)
        apart = [
            jnp.sum(zj.fit_zoom(lines, zoom=zoom).lens.zoom(at) - lens.zoom(at))
            for zoom in (NIKKOR, zj.SmoothZoom())
        ]
        worse.append(np.abs(apart))
    known, unknown = np.mean(worse, axis=0)
    assert known < 0.9 * unknown


@pytest.mark.slow
def test_gradient_with_respect_to_the_mean(small):
    def corner(step):
        zoom = dataclasses.replace(NIKKOR, mean=NIKKOR.mean + step)
        return jnp.sum(zj.fit_zoom(small, zoom=zoom).lens.zoom(jnp.asarray(30.0)))

    at = jnp.asarray(0.0)
    difference = (corner(at + 1e-3) - corner(at - 1e-3)) / 2e-3
    np.testing.assert_allclose(jax.grad(corner)(at), difference, rtol=1e-4)


def test_files_have_the_mean_and_older_ones_load_without(small, smooth, tmp_path):
    lens = zj.fit_zoom(small, zoom=NIKKOR).lens
    lens.save(tmp_path / "lens.json")
    assert eqx.tree_equal(zj.load_lens(tmp_path / "lens.json"), lens)
    smooth.lens.save(tmp_path / "old.json")
    content = json.loads((tmp_path / "old.json").read_text())
    assert content["zoom"].pop("mean") is None
    (tmp_path / "old.json").write_text(json.dumps(content))
    assert eqx.tree_equal(zj.load_lens(tmp_path / "old.json"), smooth.lens)


# Fits with a prior


@pytest.mark.slow
def test_without_weight_the_fit_is_the_plain_one(small):
    """Degree 3 at four focal lengths: as many numbers as there are."""
    free = zj.fit_zoom(small, zoom=zj.PolynomialZoom(degree=3))
    held = fitted(small, error=1e-12, degree=3)
    focal = np.array([21.0, 25.0, 40.0, 120.0])
    np.testing.assert_allclose(coefficients(held, focal), coefficients(free, focal), atol=1e-8)
    np.testing.assert_allclose(held.rms, free.rms, rtol=1e-12)


def test_with_much_weight_the_fit_is_the_prior_mean(small):
    held = fitted(small, error=1e3)
    assert np.abs(coefficients(held, small.focal)).max() < 1e-6


@pytest.mark.slow
def test_the_fit_is_the_mode_of_the_posterior(small, smooth):
    def objective(flat):
        zoom = with_parameters(smooth.lens.zoom, flat.reshape(7, 2))
        return zj.fit.global_energy(small, jax.vmap(zoom)(small.focal)) + jnp.sum(
            prior_residuals(small, zoom) ** 2
        )

    flat = smooth.lens.zoom.parameters.reshape(-1)
    gradient, curvature = jax.grad(objective)(flat), jax.hessian(objective)(flat)
    assert (np.linalg.eigvalsh(curvature) > 0).all()
    np.testing.assert_allclose(np.linalg.solve(curvature, gradient), 0, atol=1e-8)


def repeated(lines, times):
    """The same frames many times over, as more photos at the same focal lengths are."""
    frames = lines.focal.shape[0]
    number = lines.frame.shape[0]
    return zj.lines.CompressedLines(
        triangle=jnp.tile(lines.triangle, (times, 1, 1)),
        frame=jnp.tile(lines.frame, times) + frames * jnp.repeat(jnp.arange(times), number),
        focal=jnp.tile(lines.focal, times),
        centre=lines.centre,
        image_size=lines.image_size,
        focal_unit=lines.focal_unit,
    )


@pytest.mark.slow
def test_many_frames_outweigh_the_prior(small):
    """What the prior changes falls in proportion to their number."""
    free = zj.fit_zoom(small, zoom=zj.PolynomialZoom(degree=3))

    def pull(times):
        held = fitted(repeated(small, times), degree=3)
        return np.abs(coefficients(held, small.focal) - coefficients(free, small.focal)).max()

    assert pull(40) == pytest.approx(pull(10) / 4, rel=0.2)


@pytest.mark.slow
def test_two_focal_lengths_are_enough(clean):
    """The prior bridges the gap better than the straight line that they determine."""
    kept = np.isin(np.asarray(clean.frame), [0, 3])
    two = zj.Lines(
        points=clean.points[kept],
        mask=clean.mask[kept],
        frame=clean.frame[kept] // 3,
        focal=clean.focal[jnp.array([0, 3])],
        centre=clean.centre,
        image_size=clean.image_size,
        focal_unit=clean.focal_unit,
    )
    lines = zj.compress(two)
    fit = fitted(lines)
    assert zj.RESULTS[fit.result] == ""
    straight = zj.fit_zoom(lines, zoom=zj.PolynomialZoom(degree=1))
    between, of_line = (zj.frame_rms(clean, one.lens)[1:3] for one in (fit, straight))
    assert (between < 0.6 * of_line).all()


def test_compressed_lines_have_the_same_fit(noisy, small, smooth):
    full = zj.fit_zoom(noisy, zoom=zj.SmoothZoom())
    np.testing.assert_allclose(full.lens.zoom.parameters, smooth.lens.zoom.parameters, atol=1e-8)
    np.testing.assert_allclose(full.covariance, smooth.covariance, rtol=1e-4, atol=1e-12)


def test_algebraic_estimate_has_the_prior_too(small, smooth):
    """Between the focal lengths, where nothing else tells."""
    middles = jnp.array([23.0, 35.0, 70.0])
    algebraic = jax.vmap(zj.fit.algebraic_zoom(small, zoom=zj.SmoothZoom()).zoom)(middles)
    np.testing.assert_allclose(algebraic, coefficients(smooth, middles), atol=3e-3)


def test_robust_fit_of_good_lines_is_the_plain_one(noisy, smooth):
    robust = zj.fit_robust(zj.compress(noisy), zoom=zj.SmoothZoom())
    assert not robust.rejected.size
    focal = np.array([21.0, 35.0, 70.0])
    np.testing.assert_allclose(coefficients(robust.fit, focal), coefficients(smooth, focal), atol=1e-3)


def test_covariance_is_that_of_the_posterior_where_noise_is_what_the_error_says(small):
    """Between the focal lengths it is larger than at them, and far more so without the middle ones."""
    fit = fitted(small)
    assert np.isfinite(fit.covariance).all()
    assert (np.linalg.eigvalsh(fit.covariance) > -1e-15).all()
    zoom = fit.lens.zoom

    def deviation(f):
        corner = np.kron(np.asarray(zoom.basis(jnp.asarray(f))), [1, 1])
        return np.sqrt(corner @ np.asarray(fit.covariance) @ corner)

    at = [deviation(float(f)) for f in small.focal]
    middles = 2 / (1 / np.asarray(small.focal)[1:] + 1 / np.asarray(small.focal)[:-1])
    between = [deviation(float(f)) for f in middles]
    assert min(between) > max(at)


@pytest.mark.slow
def test_gradient_of_the_fit_is_that_of_finite_differences(noisy):
    """With respect to a dilation of all points, through the implicit function theorem."""

    def corner(stretch):
        points = noisy.centre[None, None] + (noisy.points - noisy.centre[None, None]) * stretch
        lens = zj.fit_zoom(zj.compress(moved(noisy, points)), zoom=zj.SmoothZoom()).lens
        return jnp.sum(lens.zoom(jnp.asarray(30.0)))

    at = jnp.asarray(1.0)
    difference = (corner(at + 1e-4) - corner(at - 1e-4)) / 2e-4
    np.testing.assert_allclose(jax.grad(corner)(at), difference, rtol=1e-5)


@pytest.mark.slow
def test_gradient_with_respect_to_the_prior(small):
    def corner(error):
        return jnp.sum(fitted(small, error=error).lens.zoom(jnp.asarray(30.0)))

    error = jnp.asarray(1e-4)
    difference = (corner(1.01 * error) - corner(0.99 * error)) / (0.02 * error)
    np.testing.assert_allclose(jax.grad(corner)(error), difference, rtol=1e-2)


@pytest.mark.slow
def test_in_float32_it_is_the_same_to_its_tolerance(small, smooth):
    single = jax.tree.map(lambda a: a.astype(jnp.float32) if a.dtype == jnp.float64 else a, small)
    fit = zj.fit_zoom(single, zoom=zj.SmoothZoom())
    assert fit.lens.zoom.parameters.dtype == jnp.float32
    np.testing.assert_allclose(
        coefficients(fit, single.focal), coefficients(smooth, small.focal), atol=2e-4
    )


def test_models_without_a_prior_have_no_prior_residuals(small, fit):
    assert prior_residuals(small, fit.lens.zoom) is None


@pytest.mark.slow
def test_a_fitted_model_is_where_the_next_fit_starts(small, smooth):
    again = zj.fit_zoom(small, zoom=smooth.lens.zoom)
    np.testing.assert_allclose(again.lens.zoom.parameters, smooth.lens.zoom.parameters, atol=1e-9)
    assert eqx.tree_equal(again.lens.zoom.quadratic, smooth.lens.zoom.quadratic)
