"""Distances in the image: their stretch against the Jacobian, and the bias that they remove."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes
from zoomjax.fit.image_metric import in_corrected

K = jnp.array([[0.1, -0.05], [0.02, 0.03], [-0.1, 0.01]])


DECENTRED = jnp.concatenate([K, jnp.array([[0.01, -0.004], [0.0, 0.006], [-0.01, 0.002]])], axis=1)


def stretch(lines, k, index, distortion_model=zj.models.RadialPolynomial()):  # noqa: B008, it has no state
    """Root of the mean of ``|J^T n|^2`` of one line, from the Jacobian at each of its points."""
    points = np.asarray(lines.points[index])[np.asarray(lines.mask[index])]
    coefficients = k[int(lines.frame[index])]
    d = zj.Distortion(coefficients, jnp.asarray(lines.centre), jnp.asarray(lines.scale), distortion_model)
    corrected = np.asarray(d.undistort(points))
    normal = np.linalg.svd(corrected - corrected.mean(axis=0))[2][1]
    across = [normal @ np.asarray(jax.jacfwd(d.undistort)(jnp.asarray(point))) for point in points]
    return np.sqrt(np.mean(np.sum(np.square(across), axis=1)))


def test_stretch_is_that_of_the_jacobian(ragged):
    paper, image = (np.asarray(zj.fit.residuals(lines, K)) for lines in (ragged, zj.fit.in_image(ragged)))
    ratio = np.linalg.norm(paper, axis=1) / np.linalg.norm(image, axis=1)
    expected = [stretch(ragged, K, index) for index in range(len(ragged.frame))]
    np.testing.assert_allclose(ratio, expected, rtol=1e-9)
    assert np.ptp(expected) > 0.02


@pytest.mark.slow
def test_the_stretch_of_a_model_that_is_not_radial_too(ragged):
    distortion_model = zj.models.BrownConrady()
    expected = [stretch(ragged, DECENTRED, index, distortion_model) for index in range(len(ragged.frame))]
    radial = [stretch(ragged, K, index) for index in range(len(ragged.frame))]
    assert np.abs(np.array(expected) - radial).max() > 1e-3
    paper = zj.fit.with_distortion_model(ragged, distortion_model)
    for lines in (zj.fit.in_image(paper), zj.fit.in_image(zj.fit.compress_for(ragged, distortion_model))):
        ratio = [
            np.linalg.norm(np.asarray(zj.fit.residuals(of, DECENTRED)), axis=1)
            for of in (in_corrected(lines), lines)
        ]
        np.testing.assert_allclose(ratio[0] / ratio[1], expected, rtol=1e-9)


def test_compressed_lines_are_measured_alike(ragged):
    full, small = (zj.fit.in_image(lines) for lines in (ragged, zj.compress(ragged)))
    for k in (K, 0 * K, K[:, :1]):
        np.testing.assert_allclose(zj.fit.frame_energy(small, k), zj.fit.frame_energy(full, k), rtol=1e-10)


def test_without_distortion_both_metrics_are_one(ragged):
    none = jnp.zeros((3, 2))
    np.testing.assert_allclose(
        zj.fit.frame_energy(zj.fit.in_image(ragged), none), zj.fit.frame_energy(ragged, none), rtol=1e-12
    )


def test_gradients_are_finite_differences(ragged):
    lines = zj.fit.in_image(zj.compress(ragged))
    gradient = jax.grad(lambda k: zj.fit.global_energy(lines, k))(K)
    for index in np.ndindex(K.shape):
        step = jnp.zeros_like(K).at[index].set(1e-5)
        difference = (zj.fit.global_energy(lines, K + step) - zj.fit.global_energy(lines, K - step)) / 2e-5
        np.testing.assert_allclose(gradient[index], difference, rtol=1e-5)


def test_wrapped_twice_is_wrapped_once(small):
    once = zj.fit.in_image(small)
    assert zj.fit.in_image(once) is once


def test_weights_and_centres_are_kept(noisy):
    weight = np.linspace(0, 1, len(noisy.frame))
    k = jnp.asarray(jax.vmap(scenes.nikkor_18_200().zoom)(noisy.focal))
    expected = zj.fit.frame_energy(zj.fit.in_image(noisy.weighted(weight)), k)
    weighted = zj.fit.in_image(noisy).weighted(weight)
    np.testing.assert_allclose(zj.fit.frame_energy(weighted, k), expected, rtol=1e-12)
    moved = weighted.about(noisy.centre + 5)
    aside = eqx.tree_at(lambda lines: lines.centre, noisy.weighted(weight), noisy.centre + 5)
    np.testing.assert_allclose(
        zj.fit.frame_energy(moved, k), zj.fit.frame_energy(zj.fit.in_image(aside), k), rtol=1e-12
    )


@pytest.mark.slow
def test_all_fits_take_them(noisy, small, fit):
    lines = zj.fit.in_image(small)
    zoom = zj.fit_zoom(lines)
    assert zj.RESULTS[zoom.result] == ""
    assert zoom.certificate.certified
    np.testing.assert_allclose(zj.frame_rms(lines, zoom.lens), zoom.frame_rms, rtol=1e-9)
    full = zj.fit_zoom(zj.fit.in_image(noisy))
    np.testing.assert_allclose(full.lens.zoom.parameters, zoom.lens.zoom.parameters, atol=1e-7)
    each = zj.fit_frames(lines)
    assert (each.frame_rms <= zoom.frame_rms * (1 + 1e-9)).all()
    robust = zj.fit_robust(lines)
    np.testing.assert_allclose(robust.fit.lens.zoom.parameters, zoom.lens.zoom.parameters, atol=0.02)
    # Near the paper's: the noise is half a pixel.
    np.testing.assert_allclose(zoom.rms, fit.rms, rtol=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("std", [0.3, 1.0, 2.0])
def test_noise_does_not_bias_the_lens(std):
    """The corner at both ends of the range, where the paper is off by two standard deviations at 2 px."""
    lens = scenes.nikkor_18_200((1072, 712))
    clean = scenes.board_lines(lens, scenes.focal_sweep(4), spacing=30.0)
    corner = jnp.zeros(2)

    def displacement(lens):
        corrected = jax.vmap(lambda f: lens(f).undistort(corner))(lens.focal_range)
        return jnp.linalg.norm(corrected - lens.centre[None], axis=1)

    @jax.jit
    def errors(keys, std):
        def one(key):
            # The same noise with both signs: in the mean all but the bias nearly cancels.
            draws = [zj.compress(scenes.with_noise(clean, key, std=sign * std)) for sign in (1, -1)]
            pairs = [[draw, zj.fit.in_image(draw)] for draw in draws]
            fits = [[zj.fit_zoom(lines, throw=False, invertible=False) for lines in pair] for pair in pairs]
            return jnp.array([[displacement(fit.lens) for fit in pair] for pair in fits])

        return jax.lax.map(one, keys) - displacement(lens)[None, None, None]

    error = np.asarray(errors(jax.random.split(jax.random.key(0), 30), jnp.asarray(std)))
    paper, image = error.mean(axis=(0, 1)) / error.std(axis=(0, 1))
    known_to = error.mean(axis=1).std(axis=0) / error.std(axis=(0, 1)) / np.sqrt(30)
    assert (known_to < 0.03).all()
    assert (abs(image) < 0.1).all()
    assert paper[0] < -0.9 * std
