"""Fits of the centre of distortion, against truth and against the energy itself."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes
from zoomjax.models import BrownConrady, Model
from zoomjax.trust import selection

from ..conftest import LAST_BITS, NOISE, SEED

AWAY = np.array([20.0, -12.0])  # px from the image's centre
FOCAL = scenes.focal_sweep(4)


def seen(lens, noise=0.0):
    """Lines seen through a lens, taken to be about the image's centre."""
    lines = scenes.board_lines(lens, FOCAL, spacing=90.0, noise=noise, seed=SEED)
    width, height = lens.image_size
    middle = jnp.array([(width - 1) / 2, (height - 1) / 2])
    return eqx.tree_at(lambda data: data.centre, lines, middle)


@pytest.fixture(scope="module")
def aside(truth):
    return eqx.tree_at(lambda lens: lens.centre, truth, truth.centre + AWAY)


@pytest.fixture(scope="module")
def lines(aside):
    return zj.lines.compress_any_centre(seen(aside, NOISE))


@pytest.fixture(scope="module")
def found(lines):
    return zj.fit.fit_centre(lines)


@pytest.mark.slow
def test_without_noise_the_centre_is_the_true_one(aside):
    found = zj.fit.fit_centre(zj.lines.compress_any_centre(seen(aside)))
    np.testing.assert_allclose(found.fit.lens.centre, aside.centre, atol=1e-6)
    np.testing.assert_allclose(found.centre, np.broadcast_to(aside.centre, (4, 2)), atol=1e-6)
    assert found.determined
    assert found.fit.rms < 1e-7


def test_with_noise_it_is_the_true_one_within_its_deviations(aside, found):
    error = np.asarray(found.centre) - np.asarray(aside.centre)
    assert (abs(error) < 4 * np.asarray(found.std)).all()
    assert (found.std < 5).all()
    assert found.fit.rms < found.rms_fixed
    assert zj.RESULTS[found.fit.result] == ""


def test_it_is_the_minimum_of_the_energy(lines, found):
    """Over the centre, the lens being fitted anew about each."""
    best = found.fit.rms
    for step in np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]]):
        assert zj.fit_zoom(lines.about(found.centre[0] + step)).rms > best
    assert zj.fit_zoom(lines.about(found.centre[0])).rms == pytest.approx(float(best), rel=1e-9)


def test_fits_take_a_centre(aside, lines, found):
    fit = zj.fit_zoom(lines, centre="fit")
    np.testing.assert_allclose(fit.lens.centre, found.fit.lens.centre, atol=1e-9)
    np.testing.assert_allclose(fit.joint, found.covariance)
    kept = zj.fit_zoom(lines, centre="image")
    np.testing.assert_allclose(kept.rms, found.rms_fixed, rtol=1e-9)
    assert kept.joint is None
    told = zj.fit_zoom(lines, centre=tuple(np.asarray(aside.centre).tolist()))
    np.testing.assert_array_equal(told.lens.centre, aside.centre)
    assert fit.rms < told.rms < kept.rms


@pytest.mark.parametrize("centre", ["middle", (1.0,), (np.nan, 1.0)])
@pytest.mark.usefixtures("unchecked")
def test_a_centre_that_is_none_is_told(centre, lines):
    with pytest.raises(ValueError, match='must be "fit", "image" or two coordinates'):
        zj.fit_zoom(lines, centre=centre)
    with pytest.raises(ValueError, match="not compressed about one centre"):
        zj.fit_zoom(lines.about(lines.centre), centre="fit")


def test_lines_and_compressed_lines_give_one_answer(aside, found):
    again = zj.fit.fit_centre(seen(aside, NOISE))
    np.testing.assert_allclose(again.centre, found.centre, atol=1e-6)


@pytest.mark.slow
def test_deviations_are_those_of_many_draws(aside, lines):
    """Standard deviations of the centre, by drawing the noise anew."""
    clean = seen(aside)
    rng = np.random.default_rng(SEED)
    centres, deviations = [], []
    for _ in range(40):
        noise = np.asarray(clean.mask)[..., None] * rng.normal(0, NOISE, clean.points.shape)
        draw = eqx.tree_at(lambda data: data.points, clean, clean.points + noise)
        fit = zj.fit.fit_centre(zj.lines.compress_any_centre(draw))
        centres.append(fit.centre[0])
        deviations.append(fit.std[0])
    ratio = np.std(centres, axis=0, ddof=1) / np.sqrt(np.mean(np.square(deviations), axis=0))
    assert (abs(ratio - 1) < 0.35).all()  # three standard deviations of a ratio of 40 draws


@pytest.mark.slow
def test_a_centre_that_moves_is_followed(truth):
    shift = zj.PolynomialZoom(1, jnp.array([[0.0, 0.002], [0.01, -0.006]]), jnp.asarray(FOCAL.min()))
    moving = zj.ZoomLens(truth.zoom, truth.centre, truth.focal_range, truth.image_size, shift=shift)
    lines = seen(moving)
    found = zj.fit.fit_centre(lines, centre=zj.PolynomialZoom(degree=1))
    np.testing.assert_allclose(found.fit.lens.shift.parameters, shift.parameters, atol=1e-8)
    np.testing.assert_allclose(found.centre, jax.vmap(moving)(jnp.asarray(FOCAL)).centre, atol=1e-4)
    np.testing.assert_allclose(zj.frame_rms(lines, found.fit.lens), 0, atol=1e-6)
    point = np.array([1000.0, 300.0])
    np.testing.assert_allclose(
        found.fit.lens(FOCAL[1]).undistort(point), moving(FOCAL[1]).undistort(point), atol=1e-5
    )


@pytest.mark.slow
def test_each_frame_by_itself(aside, lines):
    found = zj.fit.fit_frame_centres(lines)
    assert found.determined.all()
    away = np.asarray(found.each.centre) - np.asarray(aside.centre)
    assert (abs(away) < 5 * np.asarray(found.std)).all()
    assert (found.each.frame_rms <= found.rms_fixed * (1 + 1e-9)).all()
    chosen, present = lines.by_frame()
    third = lines.take(jnp.asarray(chosen[2]), jnp.asarray(present[2]))
    alone = zj.fit.fit_centre(third, zoom=zj.PolynomialZoom(degree=0))
    np.testing.assert_allclose(found.each.centre[2], alone.centre[0], atol=1e-5)
    np.testing.assert_allclose(found.each.distortion(2).centre, found.each.centre[2])


@pytest.mark.slow
def test_where_the_lines_do_not_tell_it_stays():
    """Nothing is distorted here, so that there is no centre."""
    rng = np.random.default_rng(SEED)
    t = np.linspace(0.0, 479.0, 40)
    straight = [np.stack([np.full(40, x), t], axis=-1) for x in (9.0, 200.0, 450.0, 630.0)]
    straight += [np.stack([1.3 * t, np.full(40, y)], axis=-1) for y in (9.0, 200.0, 470.0)]
    bent = [line + 0.3 * rng.standard_normal(line.shape) for line in straight]
    lines = zj.Lines.from_ragged(bent, [0] * 7, [50.0], image_size=(640, 480))
    found = zj.fit.fit_centre(lines, zoom=zj.PolynomialZoom(degree=0), terms=1)
    assert not found.determined
    np.testing.assert_array_equal(found.fit.lens.centre, lines.centre)
    np.testing.assert_allclose(found.fit.rms, found.rms_fixed, rtol=1e-9)
    assert (found.std > 0.02 * lines.scale).any()


@pytest.mark.slow
def test_other_zoom_models_have_centres_too(lines):
    found = zj.fit.fit_centre(lines, zoom=zj.models.PowerZoom())
    assert found.determined
    assert found.fit.rms < found.rms_fixed


TAKEN = {
    "fit_zoom": lambda lines, **how: zj.fit_zoom(lines, **how),
    "fit_robust": lambda lines, **how: zj.fit_robust(lines, **how).fit,
    "many": lambda lines, **how: zj.fit.many([lines], **how)[0],
    "many, robust": lambda lines, **how: zj.fit.many([lines], zj.fit_robust, **how)[0].fit,
    "select_model": lambda lines, **how: zj.select_model(lines, [zj.PolynomialZoom(2)], **how).fit,
}


@pytest.mark.parametrize("name", TAKEN)
def test_a_given_centre_is_taken_by_all_fits(name, lines, aside):
    fit = TAKEN[name]
    given = fit(lines, centre=tuple(np.asarray(aside.centre).tolist()))
    np.testing.assert_array_equal(given.lens.centre, aside.centre)
    image = fit(lines, centre="image")
    np.testing.assert_array_equal(image.lens.centre, (np.array(lines.image_size) - 1) / 2)
    plain = fit(lines).lens(30.0).coefficients
    np.testing.assert_allclose(image.lens(30.0).coefficients, plain, rtol=LAST_BITS)
    assert given.rms < 0.99 * image.rms
    with pytest.raises(ValueError, match='must be "fit", "image" or two coordinates'):
        fit(lines, centre=(np.nan, 1.0))


@pytest.mark.parametrize("name", TAKEN)
def test_a_fitted_centre_is_that_of_fit_centre(name, lines, found):
    own = TAKEN[name](lines, centre="fit")
    # Weights make a difference, next to that which noise makes.
    tolerance = 0.3 * np.asarray(found.std[0]) if "robust" in name else 1e-9
    assert (np.abs(own.lens.centre - found.fit.lens.centre) < tolerance).all()
    assert own.joint is not None


@pytest.mark.slow
def test_frames_have_the_given_centre_or_each_its_own(lines, aside):
    given = zj.fit_frames(lines, centre=np.asarray(aside.centre))
    np.testing.assert_array_equal(given.centre, np.broadcast_to(aside.centre, given.centre.shape))
    assert given.rms < zj.fit_frames(lines, centre="image").rms
    own, known = zj.fit_frames(lines, centre="fit"), zj.fit.fit_frame_centres(lines)
    np.testing.assert_allclose(own.centre, known.each.centre, rtol=LAST_BITS)
    np.testing.assert_allclose(own.coefficients, known.each.coefficients, rtol=LAST_BITS)
    with pytest.raises(RuntimeError, match="The fit failed"):
        zj.fit_frames(lines, centre="fit", max_steps=1)
    assert np.isfinite(zj.fit_frames(lines, centre="fit", max_steps=1, throw=False).centre).all()


@pytest.mark.parametrize("fit", [zj.fit_zoom, zj.fit_robust, zj.fit_frames])
def test_what_need_not_be_invertible_has_no_fitted_centre(fit, lines):
    for one in (fit, lambda lines, **how: zj.fit.many([lines], fit, **how)):
        if one is not fit and fit is zj.fit_frames:
            continue
        with pytest.raises(ValueError, match="needs invertible=True"):
            one(lines, centre="fit", invertible=False)


def test_a_selection_says_at_once_that_no_centre_can_be_fitted(lines, monkeypatch):
    monkeypatch.setattr(selection, "compare", lambda *_: pytest.fail("candidates are compared first"))
    with pytest.raises(ValueError, match="not compressed about one centre"):
        zj.select_model(lines.about(lines.centre), centre="fit")
    decentred = Model(zj.PolynomialZoom(degree=1), distortion_model=BrownConrady())
    with pytest.raises(ValueError, match=r"Decentering .* fit one of them"):
        zj.select_model(lines, [zj.PolynomialZoom(degree=1), decentred], centre="fit")


def test_the_data_set_that_has_one_centre_alone_is_named(lines):
    with pytest.raises(ValueError, match=r"Data set 1: .*not compressed about one centre"):
        zj.fit.many([lines, lines.about(lines.centre)], centre="fit")


@pytest.fixture(scope="module")
def with_arcs(truth):
    """Lines of a lens whose centre is far off, and arcs among them."""
    lens = eqx.tree_at(lambda lens: lens.centre, truth, truth.centre + 4 * AWAY)
    straight = seen(lens, NOISE)
    points, bent = np.array(straight.points), np.arange(0, len(straight.points), 9)
    for line in bent:
        there = np.flatnonzero(straight.mask[line])
        along, way = np.linspace(-1, 1, len(there)), points[line, there[-1]] - points[line, there[0]]
        across = np.array([-way[1], way[0]]) / np.linalg.norm(way)
        points[line, there] += 6.0 * (1 - along**2)[:, None] * across
    return lens, bent, zj.lines.compress_any_centre(eqx.tree_at(lambda of: of.points, straight, points))


@pytest.mark.slow
def test_robust_fits_find_weights_and_centre_in_turn(with_arcs):
    lens, bent, lines = with_arcs
    fixed, free = zj.fit_robust(lines), zj.fit_robust(lines, centre="fit")
    assert set(free.rejected.tolist()) == set(bent.tolist()) != set(fixed.rejected.tolist())
    np.testing.assert_allclose(free.fit.lens.centre, lens.centre, atol=3)
    placed = lines.about(free.fit.lens.centre)
    of_line = zj.frame_rms(placed.weighted(free.weight), free.fit.lens)
    np.testing.assert_allclose(of_line, free.fit.frame_rms, rtol=1e-6)


@pytest.mark.slow
def test_a_robustly_fitted_centre_has_derivatives(with_arcs):
    _, _, lines = with_arcs

    def centre(weight):
        return zj.fit_robust(lines.weighted(weight), centre="fit", throw=False).fit.lens.centre

    weight = jnp.ones(lines.frame.shape)
    step = jnp.zeros_like(weight).at[4].set(1.0)
    value, moved = jax.jvp(centre, (weight,), (step,))
    np.testing.assert_allclose(value, centre(weight), atol=1e-6)
    h = 1e-3
    finite = (centre(weight + h * step) - centre(weight - h * step)) / (2 * h)
    np.testing.assert_allclose(moved, finite, rtol=0.05, atol=2e-4)
