"""Linear least squares for many poses, some boards and one lens, in time that is linear in the photos.

Each row belongs to one corner of one photo: it depends on the six numbers of that photo's pose and how the
board bends in it, on where the corner is on the board, and on the lens. What photos have by themselves is
eliminated photo by photo (Schur complement), then the shape of each board. A corner is moved by the
functions of its board's shape, linearly: its columns by three coordinates are multiplied by them after sums
over the photos. So all columns come from 9 products and one for each number of the lens.

Normal equations square the condition of the problem: float64 only.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Float, Int, PyTree

from ._board_shape import Basis
from ._normal_solver import AbstractNormalSolver


class Unknowns(NamedTuple):
    """What is solved for.

    Attributes:
        poses: six numbers a photo, and how its board bends beside its shape.
        points: of each corner, its displacement from the board's shape. It stays 0: its columns are those
            from which the shape's are made.
        shape: coefficients of each board's shape.
        lens: a tree of arrays.
    """

    poses: Float[Array, "photo own"]
    points: Float[Array, "board corner 3"]
    shape: Float[Array, "board function"]
    lens: PyTree


class Rows(NamedTuple):
    """Residuals: of the corners, and of what is known beforehand of bends, shapes and lens.

    Attributes:
        views: of each corner in each photo.
        bend: of what photos have beside the shape, a number for each of their own.
        shape: of the shapes, a number for each of their own.
        lens: of the lens alone.
    """

    views: Float[Array, "photo corner 2"]
    bend: Float[Array, "photo bend"]
    shape: Float[Array, "board function"]
    lens: Float[Array, "row"]


class Structure(NamedTuple):
    """How shapes move corners.

    Attributes:
        basis: how each coefficient of a shape displaces each corner, in the units of the steps.
        bend: how those that each photo has beside them do, out of the plane, in the units of its steps.
        board: of each photo.
        members: of each board, its photos; padded with numbers that no photo has.
    """

    basis: Basis
    bend: Float[Array, "photo corner bend"]
    board: Int[Array, "photo"]
    members: Int[Array, "board member"]


class Photos(NamedTuple):
    """What photos contribute to the normal equations, each by itself.

    Attributes:
        point, lens: columns of the corners' rows, by coordinates of the corners and by the lens.
        inverse: of the block of what it has by itself, its pose and bend.
        border: of these, and of its board's shape and lens; `solved` is the inverse's product with it.
        right: right-hand side of these.
        scores: right-hand side of its board's shape and the lens, without these.
    """

    point: Float[Array, "photo corner 2 3"]
    lens: Float[Array, "photo corner 2 lens"]
    inverse: Float[Array, "photo own own"]
    border: Float[Array, "photo own both"]
    solved: Float[Array, "photo own both"]
    right: Float[Array, "photo own"]
    scores: Float[Array, "photo both"]


class Reduced(NamedTuple):
    """The normal equations of shapes and lens, without the poses.

    Attributes:
        shape: block of each board's shape.
        mixed: of it and the lens.
        lens: block of the lens.
        right_shape, right_lens: the right-hand side.
        prior_shape, prior_lens: what is known beforehand, in the blocks: a diagonal, and a matrix.
        photos: what each photo contributes.
    """

    shape: Float[Array, "board function function"]
    mixed: Float[Array, "board function lens"]
    lens: Float[Array, "lens lens"]
    right_shape: Float[Array, "board function"]
    right_lens: Float[Array, "lens"]
    prior_shape: Float[Array, "board function"]
    prior_lens: Float[Array, "lens lens"]
    photos: Photos


def reduced(
    jacobian: Any, rows: Rows, like: Unknowns, structure: Structure, damping: Float[Array, ""]
) -> Reduced:
    """The normal equations of ``jacobian x = rows``, with `damping` added to the diagonal.

    Args:
        jacobian: maps `Unknowns` to `Rows`.
        rows: the right-hand side.
        like: the unknowns' shapes.
        structure: how shapes move corners.
        damping: added to each unknown's diagonal entry.
    """
    by_pose, by_point, by_lens, of_bends, of_shapes = _columns(jacobian, like)
    columns = (by_pose.views, by_point.views, by_lens.views)
    photos = _photos(columns, rows, of_bends, structure, damping)
    basis, functions, boards = structure.basis, structure.basis.size, len(like.shape)

    def of_boards(values):
        return jax.ops.segment_sum(values, structure.board, boards)

    def board(own):
        """Of one board, from sums over its photos, and from them one by one."""
        corner, across, members = own
        border, solved = (
            _flat(of.at[members].get(mode="fill", fill_value=0)) for of in (photos.border, photos.solved)
        )
        both = border[:, :functions].T @ solved
        return basis.block(corner) - both[:, :functions], basis.summed(across) - both[:, functions:]

    corner = of_boards(_products(photos.point, photos.point))
    across = of_boards(_products(photos.point, photos.lens))
    shape, mixed = jax.lax.map(board, (corner, across, structure.members))
    lens = jnp.einsum("pnri,pnrj->ij", photos.lens, photos.lens) + by_lens.lens.T @ by_lens.lens
    lens = lens - _flat(photos.border[:, :, functions:]).T @ _flat(photos.solved[:, :, functions:])
    return Reduced(
        shape + jnp.eye(functions)[None] * (of_shapes**2 + damping)[:, :, None],
        mixed,
        lens + damping * jnp.eye(len(lens)),
        of_boards(photos.scores[:, :functions]) + of_shapes * rows.shape,
        jnp.sum(photos.scores[:, functions:], axis=0) + by_lens.lens.T @ rows.lens,
        of_shapes**2,
        by_lens.lens.T @ by_lens.lens,
        photos,
    )


def _photos(columns, rows, of_bends, structure, damping):
    """The blocks of what photos have by themselves, and what is left of each photo without it."""
    pose, point, lens = columns
    bends = point[..., 2:] * structure.bend[:, :, None, :]
    own = jnp.concatenate([pose, bends], axis=-1)
    views, priors = rows.views, jnp.pad(of_bends, ((0, 0), (pose.shape[-1], 0)))

    def both(values):
        """Columns by shape and by lens, times others, summed over each photo's rows."""
        by_shape = structure.basis.summed(_products(point, values))
        return jnp.concatenate([by_shape, jnp.einsum("pnri,pnrj->pij", lens, values)], axis=1)

    block = jnp.einsum("pnri,pnrj->pij", own, own)
    empty = jnp.trace(block, axis1=1, axis2=2) <= 0  # of photos that pad
    added = priors**2 + (damping + empty)[:, None]
    inverse = jnp.linalg.inv(block + added[:, :, None] * jnp.eye(own.shape[-1])[None])
    border = both(own).swapaxes(1, 2)
    solved = inverse @ border
    right = jnp.einsum("pnri,pnr->pi", own, views)
    right = right + priors * jnp.pad(rows.bend, ((0, 0), (pose.shape[-1], 0)))
    scores = both(views[..., None])[..., 0] - jnp.einsum("pic,pi->pc", solved, right)
    return Photos(point, lens, inverse, border, solved, right, scores)


def _products(left, right):
    """Of each corner in each photo, the sum over its two rows of the products of their columns.

    As loops that XLA fuses: a product of matrices with two rows would be a call each.
    """
    x, y = (left[:, :, row, :, None] * right[:, :, row, None, :] for row in (0, 1))
    return x + y


def _flat(values):
    """An array as a matrix of its last axis."""
    return values.reshape(-1, values.shape[-1])


def _columns(jacobian, like):
    """The Jacobian's columns of each row: by its pose, by its corner and by the lens, the last axis.

    And the derivatives of what is known of each coefficient of bends and shapes.
    """
    lens, unravel = ravel_pytree(like.lens)
    along = jnp.eye(10 + lens.size)
    photos, own = like.poses.shape
    poses = jnp.concatenate([along[:, :6], jnp.repeat(along[:, 9:10], own - 6, axis=1)], axis=1)
    directions = Unknowns(
        jnp.broadcast_to(poses[:, None], (len(along), photos, own)),
        jnp.broadcast_to(along[:, None, None, 6:9], (len(along), *like.points.shape)),
        jnp.broadcast_to(along[:, None, 9:10], (len(along), *like.shape.shape)),
        jax.vmap(unravel)(along[:, 10:]),
    )
    out = jax.lax.map(jacobian, directions)  # one after the other: what each needs stays in the caches

    def columns(part):
        return jax.tree.map(lambda leaf: jnp.moveaxis(leaf[part], 0, -1), out)

    return columns(slice(6)), columns(slice(6, 9)), columns(slice(10, None)), out.bend[9], out.shape[9]


def solution(matrix: Reduced, like: Unknowns, structure: Structure) -> Unknowns:
    """The unknowns that solve the normal equations."""
    sides = jnp.concatenate([matrix.right_shape[..., None], matrix.mixed], axis=2)
    solved = solved_boards(matrix.shape, sides)
    own, gain = solved[..., 0], solved[..., 1:]
    corner = matrix.lens - jnp.einsum("bfi,bfj->ij", matrix.mixed, gain)
    right = matrix.right_lens - jnp.einsum("bfi,bf->i", matrix.mixed, own)
    lens = cho_solve((jnp.linalg.cholesky(corner), True), right)
    shape = own - gain @ lens
    both = jnp.concatenate(
        [shape[structure.board], jnp.broadcast_to(lens, (len(structure.board), len(lens)))], 1
    )
    photos = matrix.photos
    poses = jnp.einsum("pij,pj->pi", photos.inverse, photos.right) - jnp.einsum(
        "pij,pj->pi", photos.solved, both
    )
    return Unknowns(poses, like.points, shape, ravel_pytree(like.lens)[1](lens))


def solved_boards(
    shape: Float[Array, "board function function"], sides: Float[Array, "board function side"]
) -> Float[Array, "board function side"]:
    """Solutions for each board's block, one after the other."""

    def board(of):
        return cho_solve((jnp.linalg.cholesky(of[0]), True), of[1])

    return jax.lax.map(board, (shape, sides))


class PoseSchur(AbstractNormalSolver):
    """Steps of a damped Gauss-Newton method for `Unknowns` and `Rows`, by `reduced` and `solution`."""

    structure: Structure

    def step(self, at: Unknowns, jacobian: Any, rows: Rows, damping: Array) -> Unknowns:
        """The unknowns of least squares."""
        like = jax.tree.map(jnp.zeros_like, at)
        return solution(reduced(jacobian, rows, like, self.structure, damping), like, self.structure)
