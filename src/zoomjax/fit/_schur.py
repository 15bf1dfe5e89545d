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
from jaxtyping import Array, Float, PyTree

from ._normal_solver import AbstractNormalSolver
from ._small_matrices import gram, inverses, line_products, products, times
from ._structure import Structure


class Unknowns(NamedTuple):
    """What is solved for.

    Attributes:
        frames: four numbers a frame: log f, and a rotation vector.
        rays: two numbers a ray, or three: the third is its lever.
        lens: a tree of arrays.
    """

    frames: Float[Array, "frame 4"]
    rays: Float[Array, "track own"]
    lens: PyTree


class Rows(NamedTuple):
    """Residuals: of the views, and of what is known beforehand of frames and lens.

    Attributes:
        views: of each view; they depend on its frame, its ray and the lens.
        lines: of each line; they depend on its frame and the lens.
        frames: of each frame, a number for each of its own; each depends on that one and the lens.
        lens: of the lens alone.
        rays: of each ray alone; None if nothing is known beforehand.
    """

    views: Float[Array, "view 2"]
    lines: Float[Array, "line some"]
    frames: Float[Array, "frame 4"]
    lens: Float[Array, "row"]
    rays: Float[Array, "track known"] | None = None


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


def reduced(jacobian: Any, rows: Rows, like: Unknowns, structure: Structure, damping: Array) -> Reduced:
    """The normal equations of ``jacobian x = rows``, with `damping` added to the diagonal.

    Args:
        jacobian: maps `Unknowns` to `Rows`.
        rows: the right-hand side.
        like: the unknowns' shapes.
        structure: which frame each view belongs to.
        damping: added to each unknown's diagonal entry.
    """
    return reduced_of(columns(jacobian, like), rows, like, structure, damping)


def reduced_of(
    of_rows: tuple[Rows, Rows, Rows], rows: Rows, like: Unknowns, structure: Structure, damping: Array
) -> Reduced:
    """The same of the Jacobian's `columns`."""
    by_frame, by_ray, by_lens = of_rows
    views, by_track = rows.views[..., None], structure.track

    def summed(of_views):
        return jax.ops.segment_sum(of_views, by_track, structure.tracks, indices_are_sorted=True)

    of_rays = summed(products(by_ray.views, by_ray.views)) + damping * jnp.eye(like.rays.shape[1])[None]
    coupling = products(by_frame.views, by_ray.views)
    to_lens = summed(products(by_lens.views, by_ray.views))
    right_ray = summed(products(by_ray.views, views))
    if by_ray.rays is not None and rows.rays is not None:
        of_rays = of_rays + jnp.einsum("tki,tkj->tij", by_ray.rays, by_ray.rays)
        right_ray = right_ray + jnp.einsum("tki,tk->ti", by_ray.rays, rows.rays)[..., None]
    inverse, root = inverses(of_rays)
    solved, lens_solved = times(inverse, right_ray), times(inverse, to_lens.swapaxes(1, 2))

    border = products(by_frame.views, by_lens.views) - times(coupling, lens_solved[by_track])
    right = (products(by_frame.views, views) - times(coupling, solved[by_track]))[..., 0]
    extra = jnp.eye(4)[None] * (by_frame.frames**2 + damping)[:, :, None]
    extra = extra.at[structure.line_frame].add(line_products(by_frame.lines, by_frame.lines))
    line_border = line_products(by_frame.lines, by_lens.lines)
    line_right = line_products(by_frame.lines, rows.lines[..., None])[..., 0]
    own = products(by_frame.views, by_frame.views)
    diagonal, above = _frame_blocks(own, times(coupling, root[by_track]), extra, structure)
    corner = by_lens.lens.T @ by_lens.lens + damping * jnp.eye(by_lens.lens.shape[1])
    for part in (by_lens.views, by_lens.lines, by_lens.frames):
        corner = corner + jnp.einsum("vri,vrj->ij", part, part)
    corner = corner - jnp.einsum("tik,tkj->ij", to_lens, lens_solved)
    right_lens = by_lens.lens.T @ rows.lens - jnp.einsum("tij,tj->i", to_lens, solved[..., 0])
    for part, of in zip((by_lens.views, by_lens.lines, by_lens.frames), rows[:3], strict=True):
        right_lens = right_lens + jnp.einsum("vri,vr->i", part, of)
    right = _by_block(right, structure.frame, structure)
    right = right + _by_block(line_right, structure.line_frame, structure)
    own_right = right + _padded(by_frame.frames * rows.frames, structure)
    border = _by_block(border, structure.frame, structure)
    known = _padded(by_frame.frames[..., None] * by_lens.frames, structure)
    return Reduced(
        diagonal,
        above,
        border + _by_block(line_border, structure.line_frame, structure) + known,
        corner,
        own_right,
        right_lens,
        (inverse, coupling, to_lens, right_ray[..., 0]),
    )


def columns(jacobian: Any, like: Unknowns) -> tuple[Rows, Rows, Rows]:
    """The Jacobian's columns of each row: by its frame, by its ray and by the lens; the last axis."""
    by_frame, by_ray, by_lens = derivatives(jacobian, like)
    own = jnp.diagonal(by_frame.frames, axis1=1, axis2=2)
    return by_frame._replace(frames=own), by_ray, by_lens


def derivatives(jacobian: Any, like: Unknowns) -> tuple[Any, Any, Any]:
    """What each number of all frames, each of all rays, and each of the lens does; the last axis.

    That is enough for what belongs to one frame and one ray, at most.
    """
    lens, unravel = ravel_pytree(like.lens)
    ray = slice(4, 4 + like.rays.shape[1])

    def column(along):
        frames, rays = (
            jnp.broadcast_to(along[part], of.shape)
            for part, of in ((slice(4), like.frames), (ray, like.rays))
        )
        return jacobian(Unknowns(frames, rays, unravel(along[ray.stop :])))

    # One after the other: all at once take longer, as what they need does not fit a cache.
    out = jax.lax.map(column, jnp.eye(ray.stop + lens.size))

    def those(part):
        return jax.tree.map(lambda leaf: jnp.moveaxis(leaf[part], 0, -1), out)

    return those(slice(4)), those(ray), those(slice(ray.stop, None))


def _frame_blocks(own, halves, extra, structure):
    """The frames' matrix by blocks: their own parts, less what the eliminated rays couple.

    A track begins in a block and ends in it or in the next: it couples frames of these two, by the products
    of its `halves`.
    """
    size, blocks, n = structure.block, structure.blocks, 4 * structure.block
    each = jnp.zeros((blocks * size, 4, 4), own.dtype).at[structure.frame].add(own)
    filled = jnp.broadcast_to(jnp.eye(4), (blocks * size - len(extra), 4, 4))  # no frames there
    each = (each + jnp.concatenate([extra, filled])).reshape(blocks, size, 4, 4)
    place = jnp.arange(size)
    diagonal = jnp.zeros((blocks, size, 4, size, 4), own.dtype)
    diagonal = diagonal.at[:, place, :, place].set(each.swapaxes(0, 1)).reshape(blocks, n, n)
    within = structure.frame - structure.begin * size
    reach = size if blocks == 1 else 2 * size

    def of_block(members):
        def there(values, other):
            return values.at[members].get(mode="fill", fill_value=other)

        rows = jnp.zeros((reach, 4, structure.most, halves.shape[2]), own.dtype)
        here = there(structure.place, structure.most)  # where there is none, it is dropped
        rows = rows.at[there(within, 0), :, here].set(there(halves, 0), mode="drop")
        return gram(rows.reshape(4 * reach, -1))

    coupled = jax.lax.map(of_block, structure.members)
    diagonal = diagonal - coupled[:, :n, :n]
    if blocks == 1:
        return diagonal, 0 * diagonal  # no constant, which XLA would fold for seconds
    diagonal = diagonal.at[1:].add(-coupled[:-1, n:, n:])
    return diagonal, -coupled[:, :n, n:]


def _by_block(values, frame, structure):
    """What each view or line adds to its frame, summed, by blocks."""
    frames = structure.block * structure.blocks
    total = jnp.zeros((frames, *values.shape[1:]), values.dtype).at[frame].add(values)
    return total.reshape(structure.blocks, 4 * structure.block, *values.shape[2:])


def _padded(values, structure):
    """Numbers of frames, by blocks."""
    more = ((0, structure.block * structure.blocks - len(values)), *((0, 0),) * (values.ndim - 1))
    return jnp.pad(values, more).reshape(structure.blocks, 4 * structure.block, *values.shape[2:])


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
    zero = jnp.zeros_like(right[0])
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
    """Steps of a damped Gauss-Newton method for `Unknowns` and `Rows`, by `reduced` and `solution`.

    `columns_at` gives the Jacobian's `columns` where the unknowns are.
    """

    structure: Structure
    columns_at: Callable[[Unknowns], tuple[Rows, Rows, Rows]]

    def step(self, at: Unknowns, jacobian: Any, rows: Rows, damping: Array) -> Unknowns:
        """The unknowns of least squares."""
        del jacobian
        matrix = reduced_of(self.columns_at(at), rows, at, self.structure, damping)
        return solution(matrix, at, self.structure)
