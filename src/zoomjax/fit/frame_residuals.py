"""The residuals of each frame, reduced without loss to a few numbers: what solvers minimise.

The residuals r of a frame depend on its own coefficients k alone, by derivatives J. In ``[r J] = Q R`` the
triangle R has one row more than there are coefficients, and stands for all rows: its first column s has
their sum of squares, and with the others, S, the gradient ``J^T r = S^T s`` and the Gauss-Newton matrix
``J^T J = S^T S`` are the same. s is the root of the frame's error, and zeros. So one pass over the rows
gives all that a step needs, whatever the solver, which sees a few numbers a frame.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._core.products import EXACT
from ..lines.base import AbstractLines
from ..lines.reduction import orthonormal
from .energy import by_own_coefficients


@eqx.filter_custom_jvp
def frame_residuals(
    lines: AbstractLines, coefficients: Float[Array, "frame size"]
) -> Float[Array, "frame row"]:
    """Numbers whose squares have the sums, first derivatives and Gauss-Newton matrices of the residuals'.

    All derivatives of the sum of squares are right; of the numbers themselves, the first.
    """
    return _triangles(lines, coefficients)[..., 0]


@frame_residuals.def_jvp
def _change(values, changes):
    lines, coefficients = values
    of_lines, of_coefficients = changes
    triangles = _triangles(lines, coefficients)
    change = jnp.zeros_like(triangles[..., 0])
    if of_coefficients is not None:
        change += jnp.einsum("mrk,mk->mr", triangles[..., 1:], of_coefficients, precision=EXACT)
    if jax.tree.leaves(of_lines):
        _, own = eqx.filter_jvp(lambda lines: _triangles(lines, coefficients)[..., 0], [lines], [of_lines])
        change += own
    return triangles[..., 0], change


def _triangles(lines, coefficients):
    """R of each frame."""
    weighted, jacobian = by_own_coefficients(lines, coefficients)
    table = jnp.concatenate([weighted[..., None], jacobian], axis=-1)
    return triangles_by_frame(table, lines.frame, coefficients.shape[0])


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def triangles_by_frame(
    table: Float[Array, "line row column"], frame: Int[Array, "line"], frames: int
) -> Float[Array, "frame column column"]:
    """R of the rows of each frame's lines, by modified Gram-Schmidt as in `gram_schmidt`."""

    columns = jnp.arange(table.shape[-1])

    def reduce(left, column):
        own = jax.lax.dynamic_index_in_dim(left, column, -1, keepdims=False)
        products = _sums("lr,lrc->lc", own, left, frame, frames)
        norm = jnp.sqrt(products[:, column])
        inverse = jnp.where(norm > 0, 1 / jnp.where(norm > 0, norm, 1), 0)[:, None]
        taken = own[..., None] * (products * inverse**2)[frame][:, None]
        return jnp.where((columns == column)[None, None], 0, left - taken), products * inverse

    _, rows = jax.lax.scan(reduce, table, columns)
    return jnp.swapaxes(rows, 0, 1)


@triangles_by_frame.defjvp
def _triangles_change(frames, values, changes):
    """``dR = Q^T dA`` with Q held fixed: right for every function of ``R^T R``, as that of `triangle`."""
    table, frame = values
    triangles = triangles_by_frame(table, frame, frames)
    units = jax.vmap(orthonormal)(triangles[frame], jnp.swapaxes(table, 1, 2))
    return triangles, _sums("lcr,lrd->lcd", units, changes[0], frame, frames)


def _sums(product, first, second, frame, frames):
    """Sums over the lines of each frame of products of two tables."""
    products = jnp.einsum(product, first, second, precision=EXACT)
    return jax.ops.segment_sum(products, frame, frames)
