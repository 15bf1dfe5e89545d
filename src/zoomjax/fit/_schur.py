"""Linear least squares for many frames, many rays and one lens, in time that is linear in the frames.

Each row belongs to one view: it depends on the four numbers of its frame, on the two or three of its ray,
and on the lens; or to a line of a frame, and depends on no ray; or to a ray alone. Rays are eliminated
point by point (Schur complement). What is left couples frames that see a common ray. With frames in blocks
as long as the longest track, only neighbouring blocks are coupled, and a block Cholesky factorisation goes
from block to block; the lens is a border of few columns.

Normal equations square the condition of the problem: float64 only.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import cho_solve, solve_triangular
from jaxtyping import Array, Float

from ._columns import Columns, Rows, Unknowns, over_views
from ._normal_solver import AbstractNormalSolver
from ._small_matrices import gram, inverses, line_products, products, times
from ._structure import Structure

_SHARES = (1.0, 0.25, 0.0)
"""Of the step of a ray, that are tried."""


class Reduced(NamedTuple):
    """The normal equations without the rays.

    Attributes:
        diagonal, above: blocks of the frames' matrix, and those that couple each to the next.
        border: of frames and lens.
        corner: of the lens.
        right_frames, right_lens: the right-hand side.
        rays: what the rays are found from: the inverses of their blocks, what couples them to the frames
            of their views and to the lens, and their right-hand side.
    """

    diagonal: Float[Array, "block n n"]
    above: Float[Array, "block n n"]
    border: Float[Array, "block n lens"]
    corner: Float[Array, "lens lens"]
    right_frames: Float[Array, "block n"]
    right_lens: Float[Array, "lens"]
    rays: tuple[Array, Array, Array, Array]


def reduced_of(
    of_rows: Columns, rows: Rows, like: Unknowns, structure: Structure, damping: Array
) -> Reduced:
    """The normal equations of a Jacobian's columns times x being the rows.

    Args:
        of_rows: the Jacobian's columns.
        rows: the right-hand side.
        like: the unknowns' shapes.
        structure: which frame each view belongs to.
        damping: added to each unknown's diagonal entry.
    """
    _, by_frame, by_ray, by_lens = of_rows
    own, size = like.rays.shape[1], by_lens.lens.shape[1]
    of_frames, of_rays, of_lens, coupling = _of_views(of_rows, rows, own, size, structure)
    of_rays, to_lens, right_ray = jnp.split(of_rays, (own, own + size), axis=-1)
    of_rays = of_rays + damping * jnp.eye(own)[None]
    if by_ray.rays is not None and rows.rays is not None:
        of_rays = of_rays + jnp.einsum("tki,tkj->tij", by_ray.rays, by_ray.rays)
        right_ray = right_ray + jnp.einsum("tki,tk->ti", by_ray.rays, rows.rays)[..., None]
    inverse, root = inverses(of_rays)
    beside_rays = jnp.concatenate([to_lens, right_ray], axis=-1).swapaxes(1, 2)
    less = jnp.einsum("tik,tjk->ij", times(beside_rays, inverse)[:, :size], beside_rays)

    known = _padded(by_frame.frames**2 + damping, structure, 1.0)  # where there is no frame
    known = jnp.eye(4)[None] * known.reshape(-1, 1, 4)
    of_lines = jnp.concatenate([by_frame.lines, by_lens.lines, rows.lines[..., None]], axis=-1)
    of_lines = line_products(by_frame.lines, of_lines)
    of_frames = of_frames.at[structure.line_frame].add(of_lines).at[..., :4].add(known)
    diagonal, above, beside = _frame_blocks(of_frames, coupling, root, beside_rays, structure)
    about = jnp.concatenate([by_lens.frames, rows.frames[..., None]], axis=-1)
    beside = beside + _padded(by_frame.frames[..., None] * about, structure)

    corner = by_lens.lens.T @ by_lens.lens + damping * jnp.eye(size)
    corner = corner + of_lens[:, :size] - less[:, :size]
    right_lens = by_lens.lens.T @ rows.lens + of_lens[:, size] - less[:, size]
    for part, of in ((by_lens.lines, rows.lines), (by_lens.frames, rows.frames)):
        corner = corner + jnp.einsum("vri,vrj->ij", part, part)
        right_lens = right_lens + jnp.einsum("vri,vr->i", part, of)
    return Reduced(
        diagonal,
        above,
        beside[..., :size],
        corner,
        beside[..., size],
        right_lens,
        (inverse, coupling, to_lens.swapaxes(1, 2), right_ray[..., 0]),
    )


def _of_views(of_rows, rows, own, size, structure):
    """What views add to frames, rays and lens, each beside lens and right-hand side; and their coupling."""
    frames = structure.block * structure.blocks
    shapes = (frames, 4, 4 + size + 1), (structure.tracks, own, own + size + 1), (size, size + 1)

    def step(sums, number, there):
        by_frame, by_ray, by_lens = of_rows.split(number, there)
        beside = jnp.concatenate([by_lens, rows.views[number][..., None]], axis=-1)
        frame, track = structure.frame[number], structure.track[number]
        of_frame, of_ray = (
            products(of, jnp.concatenate([of, beside], axis=-1)) for of in (by_frame, by_ray)
        )
        sums = (
            sums[0].at[frame].add(of_frame),
            sums[1].at[track].add(of_ray, indices_are_sorted=True),
            sums[2] + jnp.einsum("vri,vrj->ij", by_lens, beside),
        )
        return sums, products(by_frame, by_ray)

    sums, coupling = over_views(len(structure.track), step, tuple(jnp.zeros(shape) for shape in shapes))
    return *sums, coupling


def _frame_blocks(of_frames, coupling, root, beside_rays, structure):
    """The frames' matrix and what is beside it, by blocks: their own parts, less what rays couple.

    A track begins in a block and ends in it or in the next: it couples frames of these two, by the products
    of its halves: what couples each of its views, times the `root` of its ray.
    """
    size, blocks, most, own = structure.block, structure.blocks, structure.most, root.shape[2]
    n, reach, place = 4 * size, size if blocks == 1 else 2 * size, jnp.arange(size)
    within = structure.frame - structure.begin * size

    def step(before, block):
        members, starting, of_frames = block

        def there(values, other=0):
            return values.at[members].get(mode="fill", fill_value=other)

        halves = times(there(coupling), root[there(structure.track)])
        here = there(structure.place, most)  # where there is none, it is dropped
        rows = jnp.zeros((reach, 4, most, own), root.dtype)
        rows = rows.at[there(within), :, here].set(halves, mode="drop").reshape(4 * reach, -1)
        of_rays = (of.at[starting].get(mode="fill", fill_value=0) for of in (beside_rays, root))
        of_rays = times(*of_rays).swapaxes(1, 2).reshape(most * own, -1)
        matrix, beside = gram(rows), rows @ of_rays
        left = jnp.zeros((size, 4, size, 4), root.dtype)
        left = left.at[place, :, place].set(of_frames[..., :4]).reshape(n, n) - before[0]
        right = of_frames[..., 4:].reshape(n, -1) - before[1]
        found = left - matrix[:n, :n], -matrix[:n, n:], right - beside[:n]
        return (matrix[n:, n:], beside[n:]), found

    by_block = of_frames.reshape(blocks, size, *of_frames.shape[1:])
    parts = structure.members, structure.starting, by_block
    columns = beside_rays.shape[1]
    if blocks == 1:
        _, (diagonal, _, beside) = step((0.0, 0.0), jax.tree.map(lambda leaf: leaf[0], parts))
        above = 0 * diagonal  # no constant, which XLA would fold for seconds
        return diagonal[None], above[None], beside[None]
    start = jnp.zeros((n, n), root.dtype), jnp.zeros((n, columns), root.dtype)
    return jax.lax.scan(step, start, parts)[1]


def _by_block(values, frame, structure):
    """What each view or line adds to its frame, summed, by blocks."""
    frames = structure.block * structure.blocks
    total = jnp.zeros((frames, *values.shape[1:]), values.dtype).at[frame].add(values)
    return total.reshape(structure.blocks, 4 * structure.block, *values.shape[2:])


def _padded(values, structure, filling=0.0):
    """Numbers of frames, by blocks."""
    more = ((0, structure.block * structure.blocks - len(values)), *((0, 0),) * (values.ndim - 1))
    values = jnp.pad(values, more, constant_values=filling)
    return values.reshape(structure.blocks, 4 * structure.block, *values.shape[2:])


def _factored(matrix):
    """Cholesky factors of the diagonal, and what couples each block to the one before, by blocks."""

    def step(before, blocks):
        diagonal, above, first = blocks
        coupling = jnp.where(first, 0, solve_triangular(before, above, lower=True))  # L^-1 O
        factor = jnp.linalg.cholesky(diagonal - coupling.T @ coupling)
        return factor, (factor, coupling)

    number = len(matrix.diagonal)
    shifted = jnp.roll(matrix.above, 1, axis=0)
    start = jnp.eye(matrix.diagonal.shape[1], dtype=matrix.diagonal.dtype)
    _, factors = jax.lax.scan(step, start, (matrix.diagonal, shifted, jnp.arange(number) == 0))
    return factors


def _solve_blocks(factors, right):
    """The solution of the frames' equations for the columns of a right-hand side, by blocks."""

    def forward(before, blocks):
        factor, coupling, right = blocks
        value = solve_triangular(factor, right - coupling.T @ before, lower=True)
        return value, value

    def backward(after, blocks):
        factor, coupling_of_next, value = blocks
        value = solve_triangular(factor, value - coupling_of_next @ after, lower=True, trans=1)
        return value, value

    factor, coupling = factors
    zero = 0 * right[0]  # no constant, which XLA would fold for a second where there is one block
    _, values = jax.lax.scan(forward, zero, (factor, coupling, right))
    following = jnp.roll(coupling, -1, axis=0).at[-1].set(0)
    _, values = jax.lax.scan(backward, zero, (factor, following, values), reverse=True)
    return values


def solution(matrix: Reduced, like: Unknowns, structure: Structure) -> Unknowns:
    """The unknowns that solve the normal equations."""
    lens, unravel = ravel_pytree(like.lens)
    right = jnp.concatenate([matrix.right_frames[..., None], matrix.border], axis=-1)
    solved = _solve_blocks(_factored(matrix), right)
    own, by_lens = solved[..., 0], solved[..., 1:]
    corner = matrix.corner - jnp.einsum("bni,bnj->ij", matrix.border, by_lens)
    right_lens = matrix.right_lens - jnp.einsum("bni,bn->i", matrix.border, own)
    of_lens = cho_solve((jnp.linalg.cholesky(corner), True), right_lens) if lens.size else right_lens
    frames = (own - by_lens @ of_lens).reshape(-1, 4)
    inverse, coupling, to_lens, right_ray = matrix.rays
    coupled = jnp.sum(coupling * frames[structure.frame][..., None], axis=1)
    right_ray = right_ray - jax.ops.segment_sum(coupled, structure.track, structure.tracks)
    right_ray = right_ray - jnp.einsum("tij,i->tj", to_lens, of_lens)
    rays = times(inverse, right_ray[..., None])[..., 0]
    return Unknowns(frames[: len(like.frames)], rays, unravel(of_lens))


def solution_of(matrix: Reduced, right: Unknowns, structure: Structure) -> Unknowns:
    """The unknowns for which the normal equations' matrix gives `right`."""
    inverse, coupling, to_lens, _ = matrix.rays
    solved = times(inverse, right.rays[..., None])[..., 0]
    coupled = jnp.sum(coupling * solved[structure.track][:, None, :], axis=2)
    own = _padded(right.frames, structure) - _by_block(coupled, structure.frame, structure)
    of_lens = ravel_pytree(right.lens)[0] - jnp.einsum("tij,tj->i", to_lens, solved)
    matrix = matrix._replace(
        right_frames=own, right_lens=of_lens, rays=(inverse, coupling, to_lens, right.rays)
    )
    return solution(matrix, right, structure)


def lens_equations(matrix: Reduced) -> tuple[Float[Array, "lens lens"], Float[Array, "block n lens"]]:
    """The lens's matrix without the frames, and how much their numbers fall where each of its rises.

    The latter by blocks.
    """
    by_lens = _solve_blocks(_factored(matrix), matrix.border)
    return matrix.corner - jnp.einsum("bni,bnj->ij", matrix.border, by_lens), by_lens


def covariances(
    matrix: Reduced, frames: int
) -> tuple[Float[Array, "frame 4 4"], Float[Array, "lens lens"], Float[Array, "frame 4 lens"]]:
    """Covariances of each frame's numbers, of the lens, and of both, for a noise of 1 in each row."""
    factors = _factored(matrix)
    by_lens = _solve_blocks(factors, matrix.border)
    corner = matrix.corner - jnp.einsum("bni,bnj->ij", matrix.border, by_lens)
    lens = jnp.linalg.inv(corner)
    factor, coupling = factors
    size = factor.shape[1]
    identity = jnp.eye(size, dtype=factor.dtype)

    def backward(after, blocks):  # selected inverse: S_i = T + (T O) S_{i+1} (T O)^T
        factor, coupling_of_next = blocks
        own = cho_solve((factor, True), identity)
        gain = solve_triangular(factor, coupling_of_next, lower=True, trans=1)
        value = own + gain @ after @ gain.T
        return value, value

    following = jnp.roll(coupling, -1, axis=0).at[-1].set(0)
    _, own = jax.lax.scan(backward, jnp.zeros_like(identity), (factor, following), reverse=True)
    blocks = own.reshape(len(own), size // 4, 4, size // 4, 4)
    place = jnp.arange(size // 4)
    own = blocks[:, place, :, place].swapaxes(0, 1).reshape(-1, 4, 4)[:frames]
    by_lens = by_lens.reshape(-1, 4, by_lens.shape[-1])[:frames]
    own = own + jnp.einsum("fij,jk,flk->fil", by_lens, lens, by_lens)
    return own, lens, -jnp.einsum("fij,jk->fik", by_lens, lens)


class Schur(AbstractNormalSolver):
    """Steps of a damped Gauss-Newton method for `Unknowns` and `Rows`, by `reduced_of` and `solution`.

    Where a ray's views disagree, a flat loss makes its step too long. All others would then wait until the
    damping is so high that it is not. So each ray goes only as far as its own rows like it, beside the full
    steps of frames and lens.

    Attributes:
        structure: which frame each view belongs to.
        columns_at: gives the Jacobian's `columns` where the unknowns are.
        rows_at: gives the rows there; None if all steps are taken as they are.
    """

    structure: Structure
    columns_at: Callable[[Unknowns], Columns]
    rows_at: Callable[[Unknowns], Rows] | None = None

    def step(self, at: Unknowns, jacobian: Any, rows: Rows, damping: Array) -> Unknowns:
        """The unknowns of least squares."""
        del jacobian
        matrix = reduced_of(self.columns_at(at), rows, at, self.structure, damping)
        found = solution(matrix, at, self.structure)
        return found if self.rows_at is None else self._held(self.rows_at, at, found)

    def _held(self, rows_at, at, found):
        """The step, shorter for rays whose rows are less with a shorter one."""

        def shorter(share):
            return found._replace(rays=share * found.rays)

        def squares(share):
            rows = rows_at(jax.tree.map(jnp.subtract, at, shorter(share)))
            of_views = jnp.sum(rows.views**2, axis=-1)
            total = jax.ops.segment_sum(of_views, self.structure.track, self.structure.tracks)
            return total if rows.rays is None else total + jnp.sum(rows.rays**2, axis=-1)

        shares = jnp.array(_SHARES)
        best = jnp.argmin(jnp.nan_to_num(jax.lax.map(squares, shares), nan=jnp.inf), axis=0)
        return shorter(shares[best][:, None])
