"""R of the columns of a line, with the derivative that fits need."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core.products import EXACT

_RUN = 1100  # points orthogonalised together: 7 columns of them fill a cache of 48 to 64 KB in float64


@jax.custom_jvp
def triangle(columns: Float[Array, "rows point"]) -> Float[Array, "rows rows"]:
    """R of the transposed argument, by modified Gram-Schmidt.

    On a CPU by runs of points, whose triangles are then reduced together; elsewhere of all points at once.
    `kernel` does the runs on a GPU, for the columns of a fixed centre.
    """
    if jax.default_backend() != "cpu":
        return _orthogonalise_apart(list(columns))
    size, points = columns.shape
    if points <= _RUN:
        return _orthogonalise(columns)
    runs = -(-points // _RUN)
    whole = points - points % runs
    triangles = jax.vmap(_orthogonalise, in_axes=1)(columns[:, :whole].reshape(size, runs, -1))
    # The few points left over join the triangles: padding thousands to fill a run is slow.
    return _orthogonalise(jnp.concatenate([triangles.reshape(-1, size).T, columns[:, whole:]], axis=1))


@triangle.defjvp
def _triangle_jvp(primals, tangents):
    """A tangent of R that is right for every function of ``R^T R``, which is all that the fits use.

    R itself has no derivative at an exactly straight line, whose columns are dependent; ``R^T R`` has.
    With ``A = Q R``, ``dR = Q^T dA`` (Q held fixed) gives ``R^T dR + dR^T R = A^T dA + dA^T A`` exactly.
    """
    [columns], [columns_dot] = primals, tangents
    r = triangle(columns)
    return r, tangent_of(r, columns, columns_dot)


def tangent_of(r, columns, columns_dot):
    """The tangent of R, of the columns and theirs."""
    return jnp.matmul(orthonormal(r, columns), columns_dot.T, precision=EXACT)


def orthonormal(
    r: Float[Array, "rows rows"], columns: Float[Array, "rows point"]
) -> Float[Array, "rows point"]:
    """The columns of Q, as rows; zero where R's are.

    Tangents of R are full matrices here. Of these the derivative of a triangular solve would take the upper
    triangle alone, and second derivatives of ``R^T R`` would be wrong.
    """
    kept = jnp.diagonal(r) != 0
    regular = r + jnp.diag(jnp.where(kept, 0, 1).astype(r.dtype))
    q = jax.lax.custom_linear_solve(
        lambda q: jnp.matmul(regular.T, q, precision=EXACT),
        columns,
        lambda _, right: jax.scipy.linalg.solve_triangular(regular, right, trans="T"),
        lambda _, right: jax.scipy.linalg.solve_triangular(regular, right),
    )
    return jnp.where(kept[:, None], q, 0)


_INDEPENDENT = 8
"""Least part of a column that the others do not have, in units in the last place of its norm. Below is
rounding, which a compiler may compute in one way here and in another there."""


def _orthogonalise(columns):
    """R of the transposed argument, by modified Gram-Schmidt.

    Its R is as accurate as Householder's (Björck 1967), which is all that is kept, and it is made of
    products of a few long vectors. Batched `jnp.linalg.qr` is slower.
    """
    size = columns.shape[0]
    rows = []
    removed = jnp.zeros(size, columns.dtype)  # the squared norm of what was taken from each column
    for done in range(size):
        products = jnp.matmul(columns, columns[0], precision=EXACT)
        inverse = inverse_norm(products[0], removed[0])
        row = products * inverse
        rows.append(jnp.pad(row, (done, 0)))
        removed = removed[1:] + row[1:] ** 2
        columns = columns[1:] - (row[1:] * inverse)[:, None] * columns[:1]
    return jnp.stack(rows)


def _orthogonalise_apart(columns):
    """The same for a list of columns.

    On a GPU the time goes into moving columns through memory. XLA fuses arrays that are each a column, and
    not rows of one: a step then reads the columns once, takes from them what they share with the last one
    that is done, writes them, and adds up the next products.
    """
    size = len(columns)
    rows = []
    removed = jnp.zeros(size, columns[0].dtype)
    for done in range(size):
        first, *rest = columns
        products = jnp.stack([jnp.sum(first * column) for column in columns])
        inverse = inverse_norm(products[0], removed[0])
        row = products * inverse
        rows.append(jnp.pad(row, (done, 0)))
        removed = removed[1:] + row[1:] ** 2
        shares = row[1:] * inverse
        columns = [column - share * first for column, share in zip(rest, shares, strict=True)]
    return jnp.stack(rows)


def inverse_norm(squared, removed):
    """The inverse norm of a column; zero if rounding is all that is left of it."""
    least = (_INDEPENDENT * float(jnp.finfo(squared.dtype).eps)) ** 2
    independent = squared > least * removed
    return jnp.where(independent, 1 / jnp.where(independent, jnp.sqrt(squared), 1), 0)
