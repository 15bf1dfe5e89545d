"""Linear least squares for many poses, one board and one lens, in time that is linear in the photos.

Each row belongs to one corner of one photo: it depends on the six numbers of that photo's pose, on where
the corner is on the board, and on the lens. Poses are eliminated photo by photo (Schur complement), which
leaves a matrix of shape and lens alone. A corner is moved by the functions of the board's shape, linearly:
its columns by three coordinates are multiplied by them after sums over the photos. So all columns come from
9 products and one for each number of the lens.

Normal equations square the condition of the problem: float64 only.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Float, PyTree

from ._normal_solver import AbstractNormalSolver


class Unknowns(NamedTuple):
    """What is solved for.

    Attributes:
        poses: six numbers a photo.
        points: of each corner, its displacement from the board's shape. It stays 0: its columns are those
            from which the shape's are made.
        shape: coefficients of the shape.
        lens: a tree of arrays.
    """

    poses: Float[Array, "photo 6"]
    points: Float[Array, "corner 3"]
    shape: Float[Array, "function"]
    lens: PyTree


class Rows(NamedTuple):
    """Residuals: of the corners, and of what is known beforehand of shape and lens.

    Attributes:
        views: of each corner in each photo.
        shape: of the shape, a number for each of its own.
        lens: of the lens alone.
    """

    views: Float[Array, "photo corner 2"]
    shape: Float[Array, "function"]
    lens: Float[Array, "row"]


class Reduced(NamedTuple):
    """The normal equations: of the poses, and of shape and lens without the poses.

    Attributes:
        matrix: of shape and lens, poses eliminated.
        right: the right-hand side.
        prior: what `Rows.shape` and `Rows.lens` contribute to the matrix.
        of_photo: what each photo contributes to matrix and right-hand side.
        poses: inverse blocks of the poses, what couples them to shape and lens, and their right-hand side.
    """

    matrix: Float[Array, "common common"]
    right: Float[Array, "common"]
    prior: Float[Array, "common common"]
    of_photo: tuple[Float[Array, "photo common common"] | None, Float[Array, "photo common"]]
    poses: tuple[Array, Array, Array]


def reduced(
    jacobian: Any,
    rows: Rows,
    like: Unknowns,
    basis: Float[Array, "corner 3 function"],
    damping: Array,
    by_photo: bool = False,
) -> Reduced:
    """The normal equations of ``jacobian x = rows``, with `damping` added to the diagonal.

    Args:
        jacobian: maps `Unknowns` to `Rows`.
        rows: the right-hand side.
        like: the unknowns' shapes.
        basis: how each coefficient of the shape displaces each corner.
        damping: added to each unknown's diagonal entry.
        by_photo: whether to say what each photo contributes to the matrix.
    """
    by_pose, by_point, by_lens, own = _columns(jacobian, like)
    pose, point, lens = by_pose.views, by_point.views, by_lens.views  # (photo, corner, 2, columns)
    photos, functions = len(pose), basis.shape[2]
    wide = basis.reshape(-1, functions)

    def of_shape(values):  # (photo, corner, 3, some) to (photo, function, some)
        return jnp.einsum("pks,kf->pfs", values.reshape(photos, len(wide), -1), wide)

    def both(values):
        """Columns by points and by lens, times others, summed over each photo's rows."""
        by_shape = of_shape(jnp.einsum("pnri,pnrj->pnij", point, values))
        return jnp.concatenate([by_shape, jnp.einsum("pnri,pnrj->pij", lens, values)], axis=1)

    block = jnp.einsum("pnri,pnrj->pij", pose, pose)
    empty = jnp.trace(block, axis1=1, axis2=2) <= 0  # of photos that pad
    block = block + (damping + empty)[:, None, None] * jnp.eye(6)[None]
    inverse = jnp.linalg.inv(block)
    border = both(pose).swapaxes(1, 2)  # (photo, 6, common)
    solved = inverse @ border
    right_pose = jnp.einsum("pnri,pnr->pi", pose, rows.views)
    scores = both(rows.views[..., None])[..., 0] - jnp.einsum("pic,pi->pc", solved, right_pose)

    damped = damping * jnp.eye(border.shape[2])
    prior = jax.scipy.linalg.block_diag(jnp.diag(own**2), by_lens.lens.T @ by_lens.lens)
    of_prior = jnp.concatenate([own * rows.shape, by_lens.lens.T @ rows.lens])
    each = None
    if by_photo:
        moved = jnp.concatenate([jnp.einsum("pnrk,nkf->pnrf", point, basis), lens], axis=3)
        each = jnp.einsum("pnri,pnrj->pij", moved, moved) - jnp.einsum("pci,pcj->pij", border, solved)
    matrix = _summed(point, lens, basis) - jnp.einsum("pci,pcj->ij", border, solved)
    return Reduced(
        matrix + prior + damped,
        jnp.sum(scores, axis=0) + of_prior,
        prior,
        (each, scores),
        (inverse, border, right_pose),
    )


def _summed(point, lens, basis):
    """The matrix of shape and lens, of all photos together, before poses are eliminated."""
    corner = jnp.einsum("pnri,pnrj->nij", point, point)
    shape = jnp.einsum("nif,nij,njg->fg", basis, corner, basis)
    mixed = jnp.einsum("nif,nij->fj", basis, jnp.einsum("pnri,pnrj->nij", point, lens))
    return jnp.block([[shape, mixed], [mixed.T, jnp.einsum("pnri,pnrj->ij", lens, lens)]])


def _columns(jacobian, like):
    """The Jacobian's columns of each row: by its pose, by its corner and by the lens, the last axis.

    And the derivative of what is known of each coefficient of the shape.
    """
    lens, unravel = ravel_pytree(like.lens)
    along = jnp.eye(10 + lens.size)
    directions = Unknowns(
        jnp.broadcast_to(along[:, None, :6], (len(along), *like.poses.shape)),
        jnp.broadcast_to(along[:, None, 6:9], (len(along), *like.points.shape)),
        jnp.broadcast_to(along[:, 9:10], (len(along), *like.shape.shape)),
        jax.vmap(unravel)(along[:, 10:]),
    )
    out = jax.vmap(jacobian)(directions)  # at once: compiled once

    def columns(part):
        return jax.tree.map(lambda leaf: jnp.moveaxis(leaf[part], 0, -1), out)

    return columns(slice(6)), columns(slice(6, 9)), columns(slice(10, None)), out.shape[9]


def solution(matrix: Reduced, like: Unknowns) -> Unknowns:
    """The unknowns that solve the normal equations."""
    common = cho_solve((jnp.linalg.cholesky(matrix.matrix), True), matrix.right)
    inverse, border, right = matrix.poses
    poses = jnp.einsum("pij,pj->pi", inverse, right - border @ common)
    functions = len(like.shape)
    lens = ravel_pytree(like.lens)[1](common[functions:])
    return Unknowns(poses, like.points, common[:functions], lens)


class PoseSchur(AbstractNormalSolver):
    """Steps of a damped Gauss-Newton method for `Unknowns` and `Rows`, by `reduced` and `solution`.

    Attributes:
        basis: how each coefficient of the shape, in the units of the steps, displaces each corner.
    """

    basis: Float[Array, "corner 3 function"]

    def step(self, jacobian: Any, rows: Rows, like: Unknowns, damping: Array) -> Unknowns:
        """The unknowns of least squares."""
        return solution(reduced(jacobian, rows, like, self.basis, damping), like)
