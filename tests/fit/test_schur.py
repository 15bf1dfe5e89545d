"""The linear solver of `fit_motion` beside a dense one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from zoomjax.fit import _columns
from zoomjax.fit._columns import Rows, Unknowns, columns
from zoomjax.fit._schur import Schur, covariances, reduced_of
from zoomjax.fit._structure import structure_of


def problem(rng, frames, tracks, longest, levers=False):
    """Rows that depend linearly on their frame, their ray and the lens, at random."""
    own = 3 if levers else 2
    first = rng.integers(0, frames - 1, tracks)
    count = np.minimum(rng.integers(2, longest + 1, tracks), frames - first)
    track = np.repeat(np.arange(tracks), count)
    frame = np.concatenate([f + np.arange(n) for f, n in zip(first, count, strict=True)])
    line_frame = rng.integers(0, frames, 12)
    structure = structure_of(track, frame, frames, line_frame=line_frame)
    line_of_frame, line_of_lens = (rng.normal(size=(12, 5, n)) for n in (4, 3))
    of_frame, of_ray, of_lens = (rng.normal(size=(len(track), 2, n)) for n in (4, own, 3))
    about, with_lens = rng.uniform(0.5, 2, (frames, 4)), rng.normal(size=(frames, 4, 3))

    def jacobian(x):
        views = jnp.einsum("vij,vj->vi", of_frame, x.frames[frame])
        views += jnp.einsum("vij,vj->vi", of_ray, x.rays[track]) + of_lens @ x.lens[0]
        lines = jnp.einsum("lij,lj->li", line_of_frame, x.frames[line_frame]) + line_of_lens @ x.lens[0]
        known = 0.7 * x.rays[:, 2:] if levers else None
        return Rows(views, lines, about * x.frames + with_lens @ x.lens[0], x.lens[0] / 3, known)

    like = Unknowns(jnp.zeros((frames, 4)), jnp.zeros((tracks, own)), (jnp.zeros(3), None))
    rows = jax.tree.map(lambda a: jnp.asarray(rng.normal(size=a.shape)), jacobian(like))
    return jacobian, rows, like, structure


@pytest.mark.parametrize("levers", [False, True])
@pytest.mark.parametrize(("frames", "longest"), [(30, 5), (9, 9), (3, 2), (17, 8)])
def test_steps_are_those_of_dense_least_squares(rng, frames, longest, levers):
    jacobian, rows, like, structure = problem(rng, frames, 40, longest, levers)
    flat, unravel = ravel_pytree(like)
    dense = jax.jacfwd(lambda x: ravel_pytree(jacobian(unravel(x)))[0])(flat)
    damping = 0.3
    damped = np.concatenate([dense, np.sqrt(damping) * np.eye(flat.size)])
    right = np.concatenate([ravel_pytree(rows)[0], np.zeros(flat.size)])
    expected = np.linalg.lstsq(damped, right)[0]

    solver = Schur(structure, lambda at: columns(jacobian, at))
    found = jax.jit(lambda rows: solver.step(like, jacobian, rows, jnp.asarray(damping)))(rows)
    np.testing.assert_allclose(ravel_pytree(found)[0], expected, atol=1e-9)


@pytest.mark.parametrize("chunk", [16, 7])
def test_chunks_of_views_change_no_step(rng, monkeypatch, chunk):
    jacobian, rows, like, structure = problem(rng, 17, 40, 8, levers=True)
    assert len(structure.track) % chunk > 0

    def step():
        solver = Schur(structure, lambda at: columns(jacobian, at))
        return jax.jit(lambda rows: solver.step(like, jacobian, rows, jnp.asarray(0.3)))(rows)

    expected = ravel_pytree(step())[0]
    monkeypatch.setattr(_columns, "CHUNK", chunk)
    np.testing.assert_allclose(ravel_pytree(step())[0], expected, atol=1e-10)


@pytest.mark.parametrize("levers", [False, True])
def test_covariances_are_blocks_of_the_dense_inverse(rng, levers):
    jacobian, rows, like, structure = problem(rng, 21, 60, 6, levers)
    flat, unravel = ravel_pytree(like)
    dense = np.asarray(jax.jacfwd(lambda x: ravel_pytree(jacobian(unravel(x)))[0])(flat))
    inverse = np.linalg.inv(dense.T @ dense)
    of_rows = columns(jacobian, like)
    matrix = jax.jit(lambda: reduced_of(of_rows, rows, like, structure, jnp.asarray(0.0)))()
    own, lens, both = covariances(matrix, 21)
    for frame in range(21):
        here = slice(4 * frame, 4 * frame + 4)
        np.testing.assert_allclose(own[frame], inverse[here, here], atol=1e-10)
        np.testing.assert_allclose(both[frame], inverse[here, -3:], atol=1e-10)
    np.testing.assert_allclose(lens, inverse[-3:, -3:], atol=1e-10)


def test_a_ray_goes_only_as_far_as_its_own_rows_like_it(rng):
    """Rows of ray 5 rise steeply where it goes far, of ray 7 in any way; all others are linear."""
    jacobian, rows, like, structure = problem(rng, 17, 40, 8)
    at = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), like)
    full = Schur(structure, lambda at: columns(jacobian, at)).step(at, jacobian, rows, jnp.asarray(1e-6))
    far = jnp.linalg.norm(full.rays, axis=1)
    limit = jnp.full(40, jnp.inf).at[5].set(0.5 * far[5]).at[7].set(0.0)

    def rows_at(x):
        change = jax.tree.map(jnp.subtract, x, at)
        beyond = jnp.maximum(jnp.linalg.norm(change.rays, axis=1) - limit, 0)
        linear = jax.tree.map(jnp.add, rows, jacobian(change))
        return linear._replace(views=linear.views + 1e3 * beyond[jnp.asarray(structure.track)][:, None])

    held = Schur(structure, lambda at: columns(jacobian, at), rows_at)
    found = jax.jit(lambda rows: held.step(at, jacobian, rows, jnp.asarray(1e-6)))(rows)
    share = np.linalg.norm(found.rays, axis=1) / np.asarray(far)
    np.testing.assert_allclose(share[[5, 7]], [0.25, 0.0])
    np.testing.assert_allclose(np.delete(share, [5, 7]), 1.0)
    np.testing.assert_allclose(found.frames, full.frames, rtol=1e-9)
    np.testing.assert_allclose(found.lens[0], full.lens[0], rtol=1e-9)


def test_a_lever_that_is_known_beforehand_holds_its_ray_too(rng):
    jacobian, rows, like, structure = problem(rng, 17, 40, 8, levers=True)
    full = Schur(structure, lambda at: columns(jacobian, at)).step(like, jacobian, rows, jnp.asarray(1e-6))

    def rows_at(x):
        linear = jax.tree.map(jnp.add, rows, jacobian(x))
        return linear._replace(rays=linear.rays + 1e3 * x.rays[:, 2:] * (jnp.arange(40) == 3)[:, None])

    held = Schur(structure, lambda at: columns(jacobian, at), rows_at)
    found = held.step(like, jacobian, rows, jnp.asarray(1e-6))
    share = np.linalg.norm(found.rays, axis=1) / np.linalg.norm(full.rays, axis=1)
    np.testing.assert_allclose(share, jnp.where(jnp.arange(40) == 3, 0.0, 1.0))
