"""The misfit of a zoom model: nothing where the model is right, its size where it is not."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes
from zoomjax.trust import _frame_scores

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


@pytest.mark.slow
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


@eqx.filter_jit
def corner_of(lens, focal):
    """Where the corner is corrected to, px, along its direction from the middle of the image."""
    middle = (np.array(lens.image_size) - 1) / 2
    outward = -middle / np.linalg.norm(middle)
    return jax.vmap(lambda f: lens(f).undistort(jnp.zeros(2)) @ outward)(jnp.asarray(focal))


def ratio_and_std(fit, truth, focal=FOCAL):
    """The error of the corner, in standard deviations, and those, px."""
    std = np.asarray(zj.displacement_std(fit, np.zeros(2), focal=focal))
    return np.asarray(corner_of(fit.lens, focal) - corner_of(truth, focal)) / std, std


def noisy(lens, focal=FOCAL, seed=3):
    return zj.lines.compress_any_centre(
        scenes.board_lines(lens, focal, spacing=200.0, noise=0.3, seed=seed), 3
    )


@pytest.fixture(scope="module")
def off_centre(truth):
    """A lens whose centre of distortion is not the middle of the image."""
    return eqx.tree_at(lambda lens: lens.centre, truth, truth.centre + np.array([60.0, -40.0]))


@pytest.mark.slow
def test_a_centre_that_is_elsewhere_is_in_the_bands(off_centre):
    lines = noisy(off_centre)
    middle = (np.array(lines.image_size) - 1) / 2
    fit = zj.fit_zoom(lines, centre=tuple(middle.tolist()))
    wide = zj.trust.with_misfit(fit, lines)
    small = zj.trust.with_misfit(fit, lines.about(middle))
    assert wide.off_centre.shape == (4, 4)
    assert small.off_centre is None
    np.testing.assert_allclose(wide.misfit, small.misfit, rtol=1e-6, atol=1e-12)
    moved = lines.scale * np.sqrt(np.diag(wide.off_centre)[-2:])
    assert moved == pytest.approx([60.0, 40.0], rel=0.15)
    before, _ = ratio_and_std(small, off_centre)
    after, _ = ratio_and_std(wide, off_centre)
    assert np.abs(before).max() > 4
    assert np.abs(after).max() < 2


def test_a_centre_that_is_right_adds_next_to_none(off_centre):
    lines = noisy(off_centre)
    for centre in (tuple(np.asarray(off_centre.centre).tolist()), "fit"):
        fit = zj.fit_zoom(lines, centre=centre)
        _, before = ratio_and_std(fit, off_centre)
        _, after = ratio_and_std(zj.trust.with_misfit(fit, lines), off_centre)
        assert (after < 1.5 * before).all()


def strengths(truth, focal, deviation, seed=0):
    """The lens, stronger or weaker by chance at each of these focal lengths, which increase."""
    k = np.asarray(jax.vmap(truth.zoom)(jnp.asarray(focal)))
    scatter = 1 + deviation * np.random.default_rng(seed).standard_normal(len(k))
    table = zj.models.TableZoom(inverse=False, knots=jnp.asarray(focal), parameters=k * scatter[:, None])
    ends = jnp.asarray([focal[0], focal[-1]])
    return eqx.tree_at(lambda lens: (lens.zoom, lens.focal_range), truth, (table, ends))


MANY = np.geomspace(18.0, 200.0, 20)


def test_a_lens_that_differs_at_single_focal_lengths_has_that_in_its_bands(truth):
    lens = strengths(truth, MANY, 0.03)
    lines = zj.compress(scenes.board_lines(lens, MANY, spacing=200.0, noise=0.3, seed=3))
    fit = zj.fit_zoom(lines)
    wide = zj.trust.with_misfit(fit, lines)
    before, _ = ratio_and_std(fit, lens, MANY)
    after, _ = ratio_and_std(wide, lens, MANY)
    assert (np.abs(before) < 1.96).mean() < 0.8
    assert (np.abs(after) < 1.96).mean() >= 0.9


@pytest.mark.slow
def test_photos_of_one_focal_length_that_differ_are_no_other_lens(truth):
    """A board that is bent in each photo makes lenses of single photos differ, but not the lens."""
    several = np.sort(np.concatenate([FOCAL * (1 + 1e-4 * i) for i in range(4)]))
    seen = scenes.board_lines(strengths(truth, several, 0.03), several, spacing=200.0, noise=0.3, seed=3)
    alone = zj.compress(seen)
    same = eqx.tree_at(lambda lines: lines.focal, alone, jnp.repeat(jnp.asarray(FOCAL), 4))
    apart, together = (zj.trust.with_misfit(zj.fit_zoom(lines), lines).misfit for lines in (alone, same))
    assert float(jnp.trace(together)) < 0.3 * float(jnp.trace(apart))


def size_of(fit):
    return np.sqrt(np.diag(fit.misfit))


@pytest.mark.slow
@pytest.mark.parametrize("metric", [lambda lines: lines, zj.fit.in_image])
def test_by_residuals_it_is_what_it_is_by_moments(lines, metric):
    lines = metric(lines)
    fit = zj.fit_zoom(lines, zoom=zj.PolynomialZoom(degree=1))
    k = np.asarray(jax.vmap(fit.lens.zoom)(lines.focal))
    quickly = _frame_scores.of_frames(_frame_scores.passes_of(lines, k))
    by_residuals = _frame_scores.by_residuals(lines, k, fit.lens.distortion_model)
    for one, other in zip(quickly[:-1], by_residuals[:-1], strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-9 * np.abs(one).max())


@pytest.mark.slow
@pytest.mark.parametrize("distortion_model", [zj.models.Division(), zj.models.BrownConrady()])
def test_other_distortion_models_have_one_too(truth, distortion_model):
    """The scene is a polynomial's: what degree 1 misses of k1 is the same, up to Division's sign."""
    seen = scenes.board_lines(truth, FOCAL, spacing=200.0, noise=0.3, seed=3)
    small = zj.fit.compress_for(seen, distortion_model)
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


def with_wrong_focal_lengths(truth, sigma, seed=0, noise=0.3, model=None):
    """A fit to lines whose focal lengths are off by a part sigma, which its covariance knows."""
    seen = zj.compress(scenes.board_lines(truth, FOCAL, spacing=200.0, noise=noise, seed=seed), 3)
    wrong = np.asarray(FOCAL) * np.exp(sigma * np.random.default_rng(seed).standard_normal(len(FOCAL)))
    lines = eqx.tree_at(lambda lines: lines.focal, seen, jnp.asarray(wrong))
    fit = zj.fit_zoom(lines, terms=2, **({} if model is None else {"zoom": model}))
    return zj.fit.with_focal_sigma(fit, lines, focal_sigma=sigma * wrong), lines, sigma * wrong


INSIDE = FOCAL[2:-2]


@pytest.mark.parametrize("seed", range(4))
def test_known_errors_of_focal_lengths_are_no_misfit(truth, seed):
    fit, lines, sigma = with_wrong_focal_lengths(truth, 0.01, seed)
    _, before = ratio_and_std(fit, truth, INSIDE)
    _, unknown = ratio_and_std(zj.trust.with_misfit(fit, lines), truth, INSIDE)
    _, known = ratio_and_std(zj.trust.with_misfit(fit, lines, focal_sigma=sigma), truth, INSIDE)
    assert np.mean(unknown) > 1.3 * np.mean(before)
    assert np.mean(known) < 1.2 * np.mean(before)


@pytest.mark.slow
def test_beside_known_errors_a_misfit_is_found(truth):
    model = zj.PolynomialZoom(degree=1)
    fit, lines, sigma = with_wrong_focal_lengths(truth, 0.005, model=model)
    alone, beside = (zj.trust.with_misfit(fit, lines, focal_sigma=s).misfit for s in (0.0, sigma))
    assert float(jnp.trace(beside)) == pytest.approx(float(jnp.trace(alone)), rel=0.3)


@pytest.mark.slow
def test_errors_may_be_shared(truth):
    """Four photos at each focal length, wrong for all four: that is more than errors of single photos."""
    off = np.exp(0.01 * np.random.default_rng(2).standard_normal(len(FOCAL)))
    true, given = (np.repeat(f, 4) for f in (np.clip(FOCAL * off, FOCAL[0], FOCAL[-1]), np.asarray(FOCAL)))
    seen = zj.compress(scenes.board_lines(truth, true, spacing=200.0, noise=0.3, seed=2), 3)
    lines = eqx.tree_at(lambda lines: lines.focal, seen, jnp.asarray(given))
    fit, alike = zj.fit_zoom(lines, terms=2), np.repeat(np.arange(len(FOCAL)), 4)
    none, apart, together = (
        float(jnp.trace(zj.trust.with_misfit(fit, lines, focal_sigma=sigma, shared=shared).misfit))
        for sigma, shared in ((0.0, None), (0.01 * given, None), (0.01 * given, alike))
    )
    assert together < 0.5 * apart
    assert apart < 0.5 * none


def test_errors_of_focal_lengths_are_checked(truth, lines):
    fit = zj.fit_zoom(lines)
    with pytest.raises(ValueError, match="focal_sigma must be at least 0"):
        zj.trust.with_misfit(fit, lines, focal_sigma=-1.0)
    with pytest.raises(ValueError, match="shared must hold a number for each of the 12 frames"):
        zj.trust.with_misfit(fit, lines, focal_sigma=1.0, shared=np.arange(3))
