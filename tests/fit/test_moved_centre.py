"""The centre of distortion under other radial models, and in the Sampson metric."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes
from zoomjax.fit.energy import energy_by_frame, weighted_distances
from zoomjax.fit.moved_centre import for_any_centre

CENTRE = np.array([560.0, 340.0])
SIZE = (1072, 712)
FOCAL = np.array([20.0, 30.0, 80.0])
DIVISION = zj.models.Division()
OFFSET = np.array([0.03, -0.02])
EACH = np.array([[-0.2, 0.01, *OFFSET], [-0.1, 0.0, *OFFSET], [0.02, 0.01, *OFFSET]])


@pytest.fixture(scope="module")
def barrel():
    zoom = zj.PolynomialZoom(1, jnp.array([[0.02], [-0.3]]), jnp.asarray(20.0))
    return zj.ZoomLens(zoom, jnp.asarray(CENTRE), jnp.array([20.0, 80.0]), SIZE, distortion_model=DIVISION)


@pytest.fixture(scope="module")
def lines(barrel):
    seen = scenes.board_lines(barrel, FOCAL, spacing=200.0, noise=0.1)
    return dataclasses.replace(seen, centre=jnp.asarray((np.array(SIZE) - 1) / 2))


def with_offset(lines, k):
    """The energy of coefficients that end with an offset of the centre."""
    return energy_by_frame(lines, weighted_distances(lines, k))


def forms(lines):
    """The same lines, corrected about a moved centre in all ways that there are."""
    own = zj.fit.with_distortion_model(lines, DIVISION)
    small = zj.fit.with_distortion_model(zj.lines.compress_any_centre(lines, 8), DIVISION)
    return [for_any_centre(of, 2) for of in (own, small)]


@pytest.mark.parametrize("measured", [lambda lines: lines, zj.fit.in_image], ids=["paper", "Sampson"])
def test_about_a_moved_centre_is_about_that_centre(lines, measured):
    moved = np.asarray(lines.centre) + lines.scale * OFFSET
    there = measured(zj.fit.with_distortion_model(lines.about(moved), DIVISION))
    expected = zj.fit.frame_energy(there, jnp.asarray(EACH[:, :2]))
    for form in forms(lines):
        found = with_offset(measured(form), jnp.asarray(EACH))
        np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_so_is_the_stretch_of_lines_compressed_for_any_centre(lines):
    small = zj.lines.compress_any_centre(lines)
    moved = np.asarray(lines.centre) + lines.scale * OFFSET
    expected = zj.fit.frame_energy(zj.fit.in_image(lines.about(moved)), jnp.asarray(EACH[:, :2]))
    found = with_offset(for_any_centre(zj.fit.in_image(small), 2), jnp.asarray(EACH))
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_too_few_powers_are_refused(lines):
    small = for_any_centre(
        zj.fit.with_distortion_model(zj.lines.compress_any_centre(lines, 2), DIVISION), 2
    )
    with pytest.raises(ValueError, match=r"compress_any_centre\(lines, terms=8\)"):
        with_offset(small, jnp.asarray(EACH))


def test_one_centre_that_is_given_is_not_fitted(lines):
    with pytest.raises(ValueError, match="not compressed about one centre"):
        zj.fit.fit_centre(zj.compress(lines))


@pytest.mark.slow
@pytest.mark.parametrize("measured", [lambda lines: lines, zj.fit.in_image], ids=["paper", "Sampson"])
def test_the_centre_of_a_division_model_is_found(lines, barrel, measured):
    seen = measured(zj.fit.with_distortion_model(lines, DIVISION))
    found = zj.fit.fit_centre(seen, zoom=zj.PolynomialZoom(1), terms=1)
    assert found.determined
    assert (np.abs(found.fit.lens.centre - CENTRE) < 4 * np.asarray(found.std[0])).all()
    assert found.fit.rms < found.rms_fixed
    assert found.fit.rms < 0.1
    again = zj.fit_zoom(seen, zoom=zj.PolynomialZoom(1), terms=1, centre="fit")
    np.testing.assert_allclose(again.lens.centre, found.fit.lens.centre, atol=1e-9)
    numbers = np.asarray(found.fit.lens.zoom.parameters - barrel.zoom.parameters).ravel()
    assert (np.abs(numbers) < 4 * np.sqrt(np.diag(found.fit.covariance))).all()


@pytest.mark.slow
def test_of_each_frame_too(lines):
    found = zj.fit.fit_frame_centres(lines, distortion_model=DIVISION, terms=1)
    known = np.asarray(found.determined)
    assert known[0]
    off = np.abs(np.asarray(found.each.centre) - CENTRE)
    assert (off[known] < 4 * np.asarray(found.std)[known]).all()
