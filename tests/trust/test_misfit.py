"""The misfit of a zoom model: nothing where the model is right, its size where it is not."""

import jax
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes

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


def test_another_distortion_model_is_refused(truth):
    lines = scenes.board_lines(truth, FOCAL[:3], spacing=300.0, noise=0.3)
    fit = zj.fit_zoom(lines, zoom=zj.PolynomialZoom(degree=0), terms=1, family=zj.models.Division())
    with pytest.raises(ValueError, match="radial polynomial"):
        zj.trust.with_misfit(fit, lines)
