import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.lines import compressed, reduction

from ..conftest import moved


def coefficients(rng, frames, terms=2):
    return jnp.asarray(0.1 * rng.standard_normal((frames, terms)))


@eqx.filter_jit
def normal_equations(lines, k):
    """The residual sum of squares, its gradient, and the Gauss-Newton matrix."""
    residuals = zj.fit.residuals(lines, k).ravel()
    jacobian = jax.jacfwd(lambda k: zj.fit.residuals(lines, k))(k).reshape(residuals.size, -1)
    return residuals @ residuals, jacobian.T @ residuals, jacobian.T @ jacobian


def assert_same_for_fits(first, second, k, rtol=1e-12):
    for one, other in zip(normal_equations(first, k), normal_equations(second, k), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=rtol * np.max(np.abs(other)))


def gram(lines):
    """``R^T R`` of each line, normalised to a unit diagonal: what determines all else."""
    r = lines.triangle
    product = jnp.einsum("lij,lik->ljk", r, r)
    size = jnp.sqrt(jnp.maximum(jnp.einsum("ljj->lj", product), 1e-300))
    return product / size[:, :, None] / size[:, None]


def assert_same_triangles(first, second):
    np.testing.assert_allclose(gram(first), gram(second), rtol=0, atol=1e-13)


def straight_lines(count=201):
    """Exactly vertical, horizontal and diagonal lines off the centre, in two frames."""
    t = np.linspace(20, 460, count)
    lines = [(40 + 0 * t, t), (t, 400 + 0 * t), (t, t), (600 - t, t / 2), (600 + 0 * t, t)]
    points = [np.stack(line, axis=-1) for line in lines]
    return zj.Lines.from_ragged(points, [0, 0, 1, 1, 1], [24.0, 70.0], image_size=(640, 480))


@pytest.mark.parametrize("terms", [1, 2, 3, 4])
def test_normal_equations_are_those_of_all_points(terms, ragged, rng):
    small = zj.compress(ragged, terms)
    assert small.triangle.shape == (9, 2 * terms + 3, 2 * terms + 3)
    for _ in range(3):
        assert_same_for_fits(small, ragged, coefficients(rng, 3, terms))


def test_normal_equations_of_the_papers_scene(noisy, small, rng):
    assert_same_for_fits(small, noisy, coefficients(rng, 4))


def test_lines_longer_than_a_run_of_points(rng):
    long = straight_lines(3001)
    long = moved(long, long.points + rng.standard_normal(long.points.shape))
    assert_same_for_fits(zj.compress(long), long, coefficients(rng, 2))


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_columns_apart_as_on_a_gpu_give_the_same_triangle(dtype, rng):
    """Also of straight lines, and through the centre, where both leave out the same columns."""
    eps = np.finfo(dtype).eps
    t = np.linspace(-0.4, 0.6, 301)
    lines = [np.stack([t, 0.3 * t]), np.stack([0 * t + 0.5, t]), np.stack([t, 0.1 + 0.05 * t**2])]
    lines.append(lines[0] + 1e-3 * rng.standard_normal(lines[0].shape))
    for z in lines:
        squared = np.sum(z * z, axis=0)
        columns = jnp.asarray(np.vstack([squared**0, z, squared * z, squared**2 * z]), dtype)
        one, other = (np.asarray(f(columns)) for f in (reduction._orthogonalise, apart))
        size = np.linalg.norm(one, axis=0)
        np.testing.assert_allclose(
            other.T @ other / np.outer(size, size), one.T @ one / np.outer(size, size), atol=20 * eps
        )
        np.testing.assert_array_equal(np.diag(one) > 0, np.diag(other) > 0)


def apart(columns):
    return reduction._orthogonalise_apart(list(columns))


@pytest.mark.parametrize("one", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("other", [jax.jacfwd, jax.jacrev])
def test_second_and_third_derivatives_are_those_of_the_columns_products(one, other, rng):
    """The tangents of R are full matrices, from which the next ones are made."""
    t = np.linspace(-0.4, 0.6, 40)
    z = jnp.asarray(np.stack([t, 0.1 + 0.3 * t]) + 1e-3 * rng.standard_normal((2, 40)))

    def products(of, move):
        moved = z + move[:2, None] + jnp.sin(7 * z + move[2]) * move[2]
        columns = compressed._columns(moved, jnp.ones(40), 2)
        r = of(columns)
        return jnp.matmul(r, jnp.ones(7)) @ jnp.matmul(r, jnp.arange(7.0))

    def exact(columns):
        return columns.T  # of which the products are those of R

    at = jnp.asarray([0.02, -0.03, 0.0])
    for derivative in (one(other(products, 1), 1), jax.jacfwd(one(other(products, 1), 1), 1)):
        expected = derivative(exact, at)
        np.testing.assert_allclose(
            derivative(reduction.triangle, at), expected, atol=1e-7 * jnp.max(jnp.abs(expected))
        )


def test_straight_lines_stay_straight_to_rounding():
    small = zj.compress(straight_lines())
    np.testing.assert_allclose(zj.frame_rms(small, None), 0, atol=1e-9)


def test_straight_lines_in_float32_stay_straight_to_its_rounding():
    lines = straight_lines()
    single = zj.Lines.from_ragged(
        [line.astype(np.float32) for line in lines.to_ragged()],
        lines.frame,
        lines.focal,
        image_size=(640, 480),
    )
    small = zj.compress(single)
    assert small.triangle.dtype == jnp.float32
    np.testing.assert_allclose(zj.frame_rms(small, None), 0, atol=1e-3)


def test_counts_and_moments_are_those_of_the_points(ragged):
    small = zj.compress(ragged)
    np.testing.assert_array_equal(small.counts, ragged.counts)
    np.testing.assert_allclose(small.radial_moments(5), ragged.radial_moments(5), rtol=1e-12)


def test_more_terms_serve_fewer(ragged, rng):
    large = zj.compress(ragged, 3)
    for terms in (1, 2, 3):
        assert_same_for_fits(large, ragged, coefficients(rng, 3, terms))


def test_fewer_terms_do_not_serve_more(ragged, rng):
    with pytest.raises(ValueError, match="compressed for 1 terms, but 2 are requested"):
        zj.fit.residuals(zj.compress(ragged, 1), coefficients(rng, 3, 2))


def test_no_terms_raise(ragged):
    with pytest.raises(ValueError, match="terms must be an integer of at least 1"):
        zj.compress(ragged, 0)


CUTS = (1, 38, 0, 5, 99, 14, 2, 33, 4)  # points of each line of `ragged` in the first of two chunks


def chunks(lines, rng):
    """The lines' points dealt out to two data sets; in the second some lines are empty."""
    second = jnp.asarray(rng.uniform(size=lines.mask.shape) < 0.4).at[::4].set(False)
    return [eqx.tree_at(lambda data: data.mask, lines, lines.mask & part) for part in (second, ~second)]


def test_chunks_merge_to_the_whole_in_either_order(ragged, rng):
    first, second = (zj.compress(chunk) for chunk in chunks(ragged, rng))
    whole = zj.compress(ragged)
    for merged in (zj.lines.merge(first, second), zj.lines.merge(second, first)):
        assert_same_triangles(merged, whole)
        assert_same_for_fits(merged, ragged, coefficients(rng, 3))
        np.testing.assert_array_equal(merged.counts, ragged.counts)


def test_chunks_of_few_points_a_line_merge_to_the_whole(ragged):
    """Chunk by chunk through `from_ragged`, of which each alone would drop lines, and other ones."""
    points = ragged.to_ragged()
    frame, focal, size = np.asarray(ragged.frame), np.asarray(ragged.focal), ragged.image_size
    halves = [[line[:k] for k, line in zip(CUTS, points, strict=True)]]
    halves += [[line[k:] for k, line in zip(CUTS, points, strict=True)]]
    parts = [
        zj.compress(zj.Lines.from_ragged(half, frame, focal, image_size=size, chunk=True))
        for half in halves
    ]
    assert_same_triangles(zj.lines.merge(*parts), zj.compress(ragged))


def test_chunks_that_lost_different_lines_do_not_merge(ragged):
    points = ragged.to_ragged()
    frame, focal, size = np.asarray(ragged.frame), np.asarray(ragged.focal), ragged.image_size
    parts = []
    for short in (5, 8):  # both seen in the last frame
        given = [line[:2] if index == short else line for index, line in enumerate(points)]
        given = [given[i] for i in np.argsort(frame, kind="stable")]
        with pytest.warns(UserWarning, match="Dropped 1"):
            parts.append(zj.compress(zj.Lines.from_ragged(given, np.sort(frame), focal, image_size=size)))
    with pytest.raises(ValueError, match="chunk=True"):
        zj.lines.merge(*parts)


def test_compressing_twice_is_refused(small, unchecked):
    with pytest.raises(TypeError, match="compressed already; pass the Lines"):
        zj.compress(small)


def test_merge_is_differentiable(ragged, rng):
    k = coefficients(rng, 3)
    parts = chunks(ragged, rng)

    def energy(points):
        return zj.fit.global_energy(
            zj.lines.merge(*(zj.compress(moved(part, points)) for part in parts)), k
        )

    np.testing.assert_allclose(
        jax.jit(jax.grad(energy))(ragged.points),
        jax.jit(jax.grad(lambda points: zj.fit.global_energy(moved(ragged, points), k)))(ragged.points),
        rtol=1e-9,
        atol=1e-12,
    )


def test_other_lines_do_not_merge(ragged, small):
    with pytest.raises(ValueError, match="Only triangles of the same lines"):
        zj.lines.merge(zj.compress(ragged), small)


@pytest.mark.parametrize("cores", [1, 2, 6, 64])
def test_number_of_cores_does_not_matter(cores, ragged, monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: cores)
    assert_same_triangles(zj.compress(ragged), eqx.filter_jit(zj.compress)(ragged))


def test_one_program_serves_all_cores(ragged, compilations, monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 3)
    zj.compress(ragged, terms=4)
    several = compilations()  # the reduction, and what puts the runs together
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    zj.compress(ragged, terms=4)
    assert several <= 1 + compilations()


def test_under_vmap(ragged):
    batched = jax.vmap(lambda points: zj.compress(moved(ragged, points)))(
        jnp.stack([ragged.points, ragged.points[:, ::-1]])
    )
    one = jax.tree.map(lambda leaf: leaf[0], batched)
    assert_same_triangles(one, zj.compress(ragged))


def energy(lines, points, centre, k, *, compressed):
    """The global energy as a function of points, centre and coefficients."""
    there = eqx.tree_at(lambda data: (data.points, data.centre), lines, (points, centre))
    return zj.fit.global_energy(zj.compress(there, k.shape[1]) if compressed else there, k)


SCENES = pytest.mark.parametrize("scene", ["bent", "straight"])


def scene_named(name, ragged):
    return ragged if name == "bent" else straight_lines(21)


@SCENES
def test_gradients_are_those_through_all_points(scene, ragged, rng):
    lines = scene_named(scene, ragged)
    full, small = (
        jax.jit(jax.grad(partial(energy, lines, compressed=compressed), (0, 1, 2)))
        for compressed in (False, True)
    )
    k = coefficients(rng, lines.focal.shape[0])
    for factor in (1, 0):  # 0: a straight line's residuals and gradients vanish
        at = (lines.points, lines.centre, factor * k)
        for one, other in zip(small(*at), full(*at), strict=True):
            assert jnp.isfinite(one).all()
            np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-9)


@SCENES
def test_second_derivatives_for_fits_are_those_through_all_points(scene, ragged, rng):
    """d/dpoint of d/dk: what the implicit function theorem needs of a fit."""
    lines = scene_named(scene, ragged)
    k = coefficients(rng, lines.focal.shape[0])

    def mixed(compressed):
        by_coefficient = jax.grad(partial(energy, lines, compressed=compressed), 2)
        return jax.jit(jax.jacrev(by_coefficient))(lines.points, lines.centre, k)

    full = mixed(False)
    np.testing.assert_allclose(mixed(True), full, rtol=0, atol=1e-9 * np.max(np.abs(full)))


@pytest.mark.slow
def test_lines_spread_over_devices_stay_where_they_are():
    """The same triangles, to rounding, without an exchange of points; energies exchange a sum a frame."""
    devices = "--xla_force_host_platform_device_count=4"
    ran = subprocess.run(
        [sys.executable, str(Path(__file__).parents[1] / "_sharded.py")],
        env={**os.environ, "XLA_FLAGS": devices, "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (ran.returncode, ran.stdout.strip()) == (0, "as on one device"), ran.stderr
