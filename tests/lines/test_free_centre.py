"""Compression for any centre is exact about every centre."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.fit.energy import energy_by_frame, weighted_distances
from zoomjax.fit.moved_centre import for_terms
from zoomjax.fit.problem import data_of

from ..conftest import SEED

CENTRES = np.array([[330.0, 200.0], [319.5, 239.5], [250.0, 300.0]])  # of the three frames, px
K = jnp.array([[0.1, -0.05], [0.02, 0.03], [-0.1, 0.01]])


@pytest.fixture(scope="module")
def small(ragged):
    return zj.lines.compress_any_centre(ragged)


def with_offset(lines, k):
    """The errors of frames by coefficients that end with the centre's offset."""
    return energy_by_frame(lines, weighted_distances(lines, k))


def about(lines, centre):
    return eqx.tree_at(lambda data: data.centre, lines, jnp.asarray(centre))


@pytest.mark.parametrize("terms", [1, 2, 3])
def test_terms_are_those_asked_for(ragged, terms):
    small = zj.lines.compress_any_centre(ragged, terms)
    assert small.terms == terms
    np.testing.assert_array_equal(small.counts, ragged.counts)


@pytest.mark.slow
def test_what_more_terms_need_is_left_out_for_fewer(ragged, small):
    """And searches for the centre do so."""
    wide = zj.lines.compress_any_centre(ragged, 3)
    np.testing.assert_allclose(wide.for_terms(2).triangle, small.triangle, rtol=1e-9, atol=1e-12)
    assert small.for_terms(3) is small
    model = {"zoom": zj.PolynomialZoom(degree=0), "throw": False}
    found, expected = (zj.fit.fit_centre(lines, terms=2, **model) for lines in (wide, wide.for_terms(2)))
    np.testing.assert_allclose(found.fit.lens.centre, expected.fit.lens.centre, rtol=1e-9)
    np.testing.assert_allclose(found.fit.rms, expected.fit.rms, rtol=1e-12)
    searched = for_terms(zj.fit.in_image(wide), 2)
    np.testing.assert_array_equal(data_of(searched).triangle, wide.for_terms(2).triangle)


@pytest.mark.parametrize("centre", CENTRES)
def test_about_a_centre_it_is_the_compression_there(ragged, small, centre):
    there, expected = small.about(centre), zj.compress(about(ragged, centre))
    np.testing.assert_array_equal(there.centre, centre)
    for k in (K, 0 * K, K[:, :1]):
        np.testing.assert_allclose(
            zj.fit.frame_energy(there, k), zj.fit.frame_energy(expected, k), rtol=1e-12
        )


@pytest.mark.parametrize("kind", ["points", "compressed"])
def test_each_frame_may_have_its_own_centre(ragged, small, kind):
    lines = (ragged if kind == "points" else small).about(CENTRES)
    expected = [zj.fit.frame_energy(about(ragged, CENTRES[m]), K)[m] for m in range(3)]
    np.testing.assert_allclose(zj.fit.frame_energy(lines, K), expected, rtol=1e-12)


def test_the_offset_of_the_centre_comes_after_the_coefficients(ragged, small):
    offset = (CENTRES - np.asarray(small.centre)) / small.scale
    found = with_offset(small, jnp.concatenate([K, offset], axis=1))
    np.testing.assert_allclose(found, zj.fit.frame_energy(ragged.about(CENTRES), K), rtol=1e-12)


DECENTRED = jnp.concatenate([K, jnp.array([[0.01, -0.004], [0.0, 0.006], [-0.01, 0.002]])], axis=1)


@pytest.mark.parametrize("centre", [CENTRES[0], CENTRES], ids=["one", "each"])
def test_all_monomials_may_be_moved_to_another_centre(ragged, centre):
    """As a model needs that is not radial: the energy is that of the points about that centre."""
    distortion_model = zj.models.BrownConrady()
    lines = zj.fit.compress_for(ragged, distortion_model).about(centre)
    expected = zj.fit.frame_energy(
        zj.fit.with_distortion_model(ragged.about(centre), distortion_model), DECENTRED
    )
    np.testing.assert_allclose(zj.fit.frame_energy(lines, DECENTRED), expected, rtol=1e-11)
    jitted = jax.jit(lambda lines, k: zj.fit.frame_energy(lines.about(centre), k))
    again = jitted(zj.fit.compress_for(ragged, distortion_model), DECENTRED)
    np.testing.assert_allclose(again, expected, rtol=1e-11)


def test_derivatives_by_the_centre_are_those_of_the_points(ragged, small):
    def energy(offset, lines):
        offsets = jnp.broadcast_to(offset, (3, 2))
        if lines is small:
            return jnp.sum(with_offset(lines, jnp.concatenate([K, offsets], axis=1)))
        return jnp.sum(zj.fit.frame_energy(lines.about(lines.centre + lines.scale * offset), K))

    offset = jnp.array([0.02, -0.03])
    expected = jax.grad(energy)(offset, ragged)
    np.testing.assert_allclose(jax.grad(energy)(offset, small), expected, rtol=1e-9)
    step = 1e-6 * jnp.eye(2)
    difference = [(energy(offset + h, small) - energy(offset - h, small)) / 2e-6 for h in step]
    np.testing.assert_allclose(difference, expected, rtol=1e-5)


def test_moments_are_those_of_the_points(ragged, small):
    np.testing.assert_allclose(small.radial_moments(4), ragged.radial_moments(4), rtol=1e-10)


def test_a_frame_of_them_is_that_frame(ragged, small):
    chosen, present = small.by_frame()
    frame = small.take(jnp.asarray(chosen[1]), jnp.asarray(present[1]))
    np.testing.assert_allclose(
        with_offset(frame, jnp.concatenate([K[1:2], jnp.zeros((1, 2))], axis=1)),
        zj.fit.frame_energy(ragged, K)[1:2],
        rtol=1e-12,
    )


def test_float32_keeps_its_floor():
    """Of nearly straight lines, whose monomials all but coincide: the rounding of the points themselves."""
    rng = np.random.default_rng(SEED)
    t = np.linspace(0, 1, 400, dtype=np.float32)[:, None]
    ends = rng.uniform((0, 0), (4000, 3000), (6, 2, 2)).astype(np.float32)
    lines = zj.Lines.from_ragged(
        [a + t * (b - a) for a, b in ends], np.arange(6) % 2, np.float32([20, 50]), image_size=(4000, 3000)
    )
    small = zj.lines.compress_any_centre(lines)
    assert small.triangle.dtype == np.float32
    rms = np.sqrt(with_offset(small, jnp.zeros((2, 4), jnp.float32)))
    assert (rms < 2e-3).all()


def test_what_is_compressed_cannot_be_compressed_again(small, unchecked):
    with pytest.raises(TypeError, match="must be Lines"):
        zj.lines.compress_any_centre(small)


def test_lines_of_one_centre_have_no_other(ragged):
    small = zj.compress(ragged)
    assert small.about(ragged.centre) is small
    with pytest.raises(ValueError, match="compress_any_centre"):
        small.about(CENTRES[0])
