"""Bands: what they say is what repeated noise does, and the delta method's own derivatives."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes

FOCAL = np.array([20.56, 51.0, 127.36])
POINTS = np.array([[0.0, 0.0], [4287.0, 2847.0], [3000.0, 400.0]])


# Against repeated noise


@pytest.mark.slow
@pytest.mark.parametrize(
    ("draws", "slack"), [(150, (9, 5)), pytest.param(1000, (3, 3), marks=pytest.mark.exhaustive)]
)
@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_bands_hold_the_truth_as_often_as_they_say(correlation, draws, slack):
    """Also where points err together along an edge; never less often than they say, beyond the slack.

    With few photos they hold it more often (benchmarks/results/trust.md), as they allow for what photos err
    by together.
    """
    from benchmarks.trust import Noise, board, corner_errors

    truth, scene = board((15, 11), 5, 12)
    errors, stds = corner_errors(truth, scene, Noise(correlation=correlation), draws)
    ratio = np.abs(errors) / stds["`fit.covariance`"]
    assert 68.3 - slack[0] < 100 * np.mean(ratio < 1) < 77.5 + slack[0]
    assert 95 - slack[1] < 100 * np.mean(ratio < 1.96) < 98 + slack[1]


@pytest.mark.slow
def test_a_photo_whose_lines_go_through_the_centre_tells_nothing_of_the_others():
    """Three photos decide all, and the fourth shows two lines there: noise makes all that it says."""
    from benchmarks.trust import SCENES, board

    _, scene = board(*SCENES["4 photos, few lines"])
    lines = zj.compress(scenes.with_noise(scene, jax.random.key(0), std=0.1))
    others = lines.weighted((np.asarray(lines.frame) != 3).astype(float))
    focal = np.asarray(lines.focal[:3])
    with_it, without = (
        zj.displacement_std(zj.fit_zoom(some), np.zeros(2), focal=focal) for some in (lines, others)
    )
    np.testing.assert_allclose(with_it, without, rtol=0.05)


# The delta method


def test_std_of_coefficients_is_that_of_the_polynomial(fit):
    """``phi C phi^T``, written out for the polynomial's parameters, row by row."""
    covariance = np.asarray(fit.covariance).reshape(3, 2, 3, 2)
    for f, std in zip(FOCAL, zj.trust.coefficient_std(fit, FOCAL), strict=True):
        phi = (float(fit.lens.zoom.focal_ref) / f) ** np.arange(3)
        expected = np.sqrt(np.einsum("a,aibi,b->i", phi, covariance, phi))
        np.testing.assert_allclose(std, expected, rtol=1e-9)


def test_displacement_is_uncertain_along_the_radius(fit):
    covariance = np.asarray(zj.trust.displacement_covariance(fit, POINTS, focal=FOCAL))
    std = np.asarray(zj.displacement_std(fit, POINTS, focal=FOCAL))
    assert covariance.shape == (3, 2, 2)
    for point, matrix, sigma in zip(POINTS, covariance, std, strict=True):
        outward = (point - fit.lens.centre) / np.linalg.norm(point - fit.lens.centre)
        np.testing.assert_allclose(matrix, sigma**2 * np.outer(outward, outward), atol=1e-12 * sigma**2)


def test_displacement_std_is_that_of_lenses_drawn_from_the_covariance(fit, rng):
    flat = np.asarray(fit.lens.zoom.parameters).ravel()
    drawn = rng.multivariate_normal(flat, np.asarray(fit.covariance), 4000, method="eigh")

    def corrected(parameters, f):
        lens = eqx.tree_at(lambda lens: lens.zoom.parameters, fit.lens, parameters.reshape(3, 2))
        return lens(f).undistort(jnp.asarray(POINTS))

    for f in FOCAL:
        seen = np.asarray(jax.vmap(corrected, (0, None))(jnp.asarray(drawn), jnp.asarray(f)))
        spread = np.linalg.norm(seen.std(axis=0), axis=-1)
        np.testing.assert_allclose(zj.displacement_std(fit, POINTS, focal=f), spread, rtol=0.04)


def test_bands_grow_beyond_the_range_that_was_fitted(fit):
    """They measure how uncertain a lens is there, where under `jit` the lens itself gives NaN."""
    longest = float(fit.lens.focal_range[1])
    low, high = zj.displacement_band(fit, np.zeros(2), focal=np.array([longest, 2 * longest]))
    assert np.isfinite(low).all()
    std = zj.displacement_std(fit, np.zeros(2), focal=np.array([longest, 2 * longest]))
    np.testing.assert_allclose(high - low, 2 * 1.96 * std, rtol=1e-3)
    assert std[1] > std[0]
    assert zj.trust.displacement_rms(fit.lens.extended(20.0, 2 * longest), fit.lens) < 1e-9


def test_shapes_broadcast(fit):
    assert zj.trust.coefficient_std(fit, 50.0).shape == (2,)
    assert zj.trust.coefficient_std(fit, np.full((4, 5), 50.0)).shape == (4, 5, 2)
    assert zj.displacement_std(fit, POINTS[0], focal=50.0).shape == ()
    assert zj.displacement_std(fit, POINTS[:, None], focal=FOCAL[:2]).shape == (3, 2)
    assert zj.trust.displacement_covariance(fit, POINTS[:, None], focal=FOCAL[:2]).shape == (3, 2, 2, 2)


def test_other_numbers_of_points_compile_nothing_and_change_nothing(fit, rng, compilations):
    focal = np.array([[20.0], [50.0], [100.0]])
    points = rng.uniform(0, 300, (5, 2))
    first = np.asarray(zj.displacement_std(fit, points, focal=focal))
    compilations()
    one = zj.displacement_std(fit, points[0], focal=np.array(20.0))
    np.testing.assert_allclose(one, first[0, 0], rtol=1e-12)
    assert zj.displacement_std(fit, points[1:4].reshape(3, 1, 2), focal=focal[:2, 0]).shape == (3, 2)
    assert compilations() == 0
    plain = eqx.filter_jit(lambda points, focal: zj.displacement_std(fit, points, focal=focal))
    np.testing.assert_allclose(first, plain(points, focal), rtol=1e-12)


def test_band_is_about_the_outward_displacement(fit):
    low, high = zj.displacement_band(fit, POINTS, focal=FOCAL, level=0.95)
    std = zj.displacement_std(fit, POINTS, focal=FOCAL)
    np.testing.assert_allclose(high - low, 2 * 1.959964 * std, rtol=1e-6)
    for point, f, a, b in zip(POINTS, FOCAL, low, high, strict=True):
        radius, corrected = (
            np.linalg.norm(p - fit.lens.centre) for p in (point, fit.lens(f).undistort(point))
        )
        assert (a + b) / 2 == pytest.approx(corrected - radius, abs=1e-9)


def test_std_of_anything_covers_the_inverse(fit):
    """To first order an error of the inverse is minus that of the lens over its stretch."""
    distortion = fit.lens(30.0)
    point = jnp.array([1000.0, 800.0])
    seen = distortion.distort(point)
    std = zj.trust.std_of(fit, lambda lens: lens(30.0).distort(point))
    covariance = zj.trust.displacement_covariance(fit, seen, focal=30.0)
    back = jnp.linalg.inv(jax.jacfwd(distortion.undistort)(seen))
    np.testing.assert_allclose(std, jnp.sqrt(jnp.diag(back @ covariance @ back.T)), rtol=1e-9)


def test_std_of_steps_is_not_known(fit):
    """Rounding, argmax and squares of what is estimated as 0 have a derivative of 0, and change."""

    def one(lens):
        return lens.zoom(30.0)[0]

    estimate = one(fit.lens)
    with pytest.warns(UserWarning, match="derivative is 0, as that of rounding") as told:
        std = zj.trust.std_of(
            fit,
            lambda lens: {
                "rounded": jnp.round(1e6 * one(lens)),
                "sound": one(lens),
                "squared": (one(lens) - estimate) ** 2,
                "constant": jnp.array(lens.image_size, float),
                "still": lens(30.0).undistort(lens.centre),
            },
        )
    assert told[0].filename == __file__
    assert np.isnan([std["rounded"], std["squared"]]).all()
    np.testing.assert_allclose(std["sound"], zj.trust.coefficient_std(fit, 30.0)[0])
    np.testing.assert_array_equal(std["constant"], 0)
    np.testing.assert_array_equal(std["still"], 0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        zj.trust.std_of(fit, one)


@pytest.mark.parametrize(
    ("function", "kind"),
    [
        (lambda lens: lens(30.0).has_inverse(np.zeros(2)), "bool"),
        (lambda lens: {"most": jnp.argmax(lens(30.0).coefficients)}, "int64"),
    ],
    ids=["booleans", "integers"],
)
def test_std_of_what_is_no_real_number_is_refused(fit, function, kind):
    """It ended with "a bytes-like object is required, not 'int'"."""
    with pytest.raises(ValueError, match=f"must return real numbers, .* returns {kind}"):
        zj.trust.std_of(fit, function)


@pytest.mark.parametrize(
    "zoom", [zj.models.TableZoom(number=3), zj.models.SplineZoom(number=3), zj.models.PowerZoom()]
)
def test_bands_of_every_zoom_model(zoom, small):
    fit = zj.fit_zoom(small, zoom=zoom)
    std = zj.displacement_std(fit, np.zeros(2), focal=FOCAL)
    assert std.shape == (3,)
    assert (np.isfinite(std) & (std > 0)).all()


def test_centre_is_certain_and_has_a_gradient(fit):
    centre = jnp.asarray(fit.lens.centre)
    assert zj.displacement_std(fit, centre, focal=50.0) == 0
    gradient = jax.grad(lambda point: zj.displacement_std(fit, point, focal=50.0))(centre)
    np.testing.assert_array_equal(gradient, 0)
    gradient = jax.grad(lambda point: zj.displacement_std(fit, point, focal=50.0))(centre + 100)
    assert np.isfinite(gradient).all()
    assert (gradient > 0).all()


def test_what_is_not_determined_is_infinite(fit):
    unknown = eqx.tree_at(lambda fit: fit.covariance, fit, jnp.where(jnp.eye(6, dtype=bool), jnp.inf, 0.0))
    assert np.isposinf(zj.trust.coefficient_std(unknown, FOCAL)).all()
    assert np.isposinf(zj.displacement_std(unknown, POINTS, focal=FOCAL)).all()
    low, high = zj.displacement_band(unknown, POINTS, focal=FOCAL)
    assert np.isneginf(low).all()
    assert np.isposinf(high).all()
    assert zj.displacement_std(unknown, unknown.lens.centre, focal=50.0) == 0
    covariance = zj.trust.displacement_covariance(unknown, POINTS[0], focal=50.0)
    np.testing.assert_array_equal(covariance, [[np.inf, 0], [0, np.inf]])


def test_points_that_are_none_raise(fit, unchecked):
    with pytest.raises(ValueError, match=r"must have shape \(\.\.\., 2\)"):
        zj.displacement_std(fit, np.zeros((4, 3)), focal=50.0)


# Rounding


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_bands_are_never_narrower_than_rounding_allows(dtype, truth):
    """Focal lengths that are nearly the same: parameters with huge variances, of which a small one is left.

    The band of a lens of one focal length, from the same lines, is what the band should be, at least.
    """
    scene = scenes.board_lines(truth, FOCAL[:1].repeat(4), spacing=400.0, noise=2.0, seed=5)
    corner = np.array([0.0, 0.0])
    outcomes = []
    for step in (1e-1, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4):
        focal = (20.56 + step * np.arange(4)).astype(dtype)
        lines = zj.Lines.from_ragged(
            [line.astype(dtype) for line in scene.to_ragged()],
            scene.frame,
            focal,
            image_size=scene.image_size,
        )
        # In float32 the lens is not determined, or the solver does not settle: then the bands are infinite.
        fit = zj.fit_zoom(zj.compress(lines), invertible=False, throw=dtype == np.float64)
        one = zj.fit_zoom(zj.compress(lines), zoom=zj.PolynomialZoom(degree=0))
        least = 0.5 * float(zj.displacement_std(one, corner, focal=focal[0]))
        std = zj.displacement_std(fit, corner, focal=focal)
        low, high = zj.displacement_band(fit, corner, focal=focal, level=0.6827)
        assert (std > least).all()
        assert ((high - low) / 2 > least).all()
        assert (
            jnp.diagonal(zj.trust.displacement_covariance(fit, corner, focal=focal), axis1=-2, axis2=-1) > 0
        ).all()
        assert (zj.trust.coefficient_std(fit, focal) > 0.5 * zj.trust.coefficient_std(one, focal[:1])).all()
        outcomes.append(float(std[0]))
    if dtype == np.float64:
        assert outcomes[0] < 10 * least  # and of use where there are digits left


# What has no number has no standard deviation


def test_nothing_is_certain_of_what_is_not_a_number(fit):
    """A derivative of zero of a NaN was a standard deviation of 0."""
    high = float(fit.lens.focal_range[1])
    corner = jnp.zeros(2)
    std = zj.trust.std_of(
        fit, lambda lens: jnp.stack([lens(f).undistort(corner) for f in (high, high + 1)])
    )
    np.testing.assert_array_equal(np.isnan(std), [[False, False], [True, True]])
    odd = np.array([[np.nan, 0.0], [np.inf, 0.0], [0.0, 0.0]])
    for found in (
        zj.displacement_std(fit, odd, focal=30.0),
        *zj.displacement_band(fit, odd, focal=30.0),
        zj.trust.displacement_covariance(fit, odd, focal=30.0)[:, 0, 0],
    ):
        np.testing.assert_array_equal(np.isfinite(found), [False, False, True])


def test_nothing_is_certain_beyond_the_fold():
    folding = zj.ZoomLens(zj.PolynomialZoom(0, [[-0.5]], 20.0), [319.5, 239.5], [20.0, 20.0], (640, 480))
    lines = scenes.board_lines(
        scenes.nikkor_18_200((640, 480)), np.array([20.56, 30.0]), spacing=40.0, noise=0.3
    )
    fit = zj.fit_zoom(zj.compress(lines), zoom=zj.PolynomialZoom(degree=0), terms=1)
    fit = eqx.tree_at(lambda fit: fit.lens, fit, folding)
    points = np.array([[320.0, 300.0], [0.0, 0.0]])
    assert np.isnan(np.asarray(folding(20.0).undistort(points))[:, 0]).tolist() == [False, True]
    assert np.isnan(zj.displacement_std(fit, points, focal=20.0)).tolist() == [False, True]


@pytest.mark.parametrize("focal", [np.nan, np.inf, 0.0, -30.0, [30.0, -1.0]])
def test_focal_lengths_that_are_none_are_refused(fit, focal):
    for call in (
        lambda f: zj.displacement_std(fit, POINTS[0], focal=f),
        lambda f: zj.displacement_band(fit, POINTS[0], focal=f),
        lambda f: zj.trust.displacement_covariance(fit, POINTS[0], focal=f),
        lambda f: zj.trust.coefficient_std(fit, f),
    ):
        with pytest.raises(ValueError, match="focal must be finite and positive"):
            call(np.asarray(focal))
        assert np.isnan(jax.jit(call)(jnp.asarray(focal))).any()


@pytest.mark.parametrize("focal", ["35", True, None, ["35"]])
def test_focal_lengths_that_are_no_numbers_are_refused(fit, focal, unchecked):
    with pytest.raises(ValueError, match="focal must hold real numbers"):
        zj.trust.coefficient_std(fit, focal)


@pytest.mark.parametrize("level", [0, 1, 1.5, -0.5, 95, np.nan, [0.9, 0.95], "0.9", True])
def test_levels_that_are_none_are_refused(fit, level, unchecked):
    with pytest.raises(ValueError, match="level must be a number between 0 and 1"):
        zj.displacement_band(fit, np.zeros(2), focal=50.0, level=level)


def test_a_band_is_about_the_centre_at_its_focal_length(fit):
    """Which moves along the zoom where the lens has a shift: 3 % of the scale, 77 px, at the short end."""
    shift = zj.PolynomialZoom(1, [[0.0, 0.0], [0.03, -0.02]], FOCAL[0])
    moving = eqx.tree_at(lambda fit: fit.lens.shift, fit, shift, is_leaf=lambda leaf: leaf is None)
    for f in FOCAL:
        d = moving.lens(float(f))
        near = np.asarray(d.centre) + np.array([3.0, 4.0])
        away = np.hypot(*(np.asarray(d.undistort(near)) - np.asarray(d.centre))) - 5
        low, high = zj.displacement_band(moving, near, focal=f)
        assert float(low) < away < float(high)
