"""Linear least squares with many rows and few columns."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree


def least_squares(
    matrix: Float[Array, "row column"], right: Float[Array, "row"], *, floor: float
) -> Float[Array, "column"]:
    """The x of least ``|matrix x - right|``; directions that change it by no more than rounding stay zero.

    Rounding is counted from the largest singular value and `floor`, the size of what the rows were computed
    from. Solved with the small triangle of the whole table, so that the rows are read once.
    """
    triangle = triangle_of(jnp.concatenate([matrix, right[:, None]], axis=1))
    left, size, rows = jnp.linalg.svd(triangle[:, :-1], full_matrices=False)
    known = size > 64 * jnp.finfo(size.dtype).eps * (size[0] + floor)
    inverse = jnp.where(known, 1 / jnp.where(known, size, 1), 0)
    return rows.T @ (inverse * (left.T @ triangle[:, -1]))


def triangle_of(matrix: PyTree[Float[Array, "... column"]]) -> Float[Array, "column column"]:
    """R of the QR of a matrix with more rows than columns; see `gram_schmidt`.

    LAPACK starts threads on all cores for this, which takes many times as long. And its calls for several
    matrices at once, as under ``vmap``, stop for ever where two of them fill the threads they wait for.
    """
    return gram_schmidt(matrix)[1]


def gram_schmidt(
    matrix: PyTree[Float[Array, "... column"]],
) -> tuple[list[Float[Array, "column ..."]], Float[Array, "column column"]]:
    """Q, a column after the other, and R of a matrix by modified Gram-Schmidt.

    R has rows of zeros for columns that are dependent. Rows may be in several arrays, and along several
    axes of each: where they are spread over devices, sums over them are all that is exchanged.
    """
    parts = jax.tree.leaves(matrix)
    dtype = jnp.result_type(*parts)
    parts = [part.astype(dtype) for part in parts]

    columns = jnp.arange(parts[0].shape[-1])

    def reduce(left, column):
        own = [jax.lax.dynamic_index_in_dim(part, column, -1, keepdims=False) for part in left]
        products = _total(
            jnp.tensordot(o, p, o.ndim, precision="highest") for o, p in zip(own, left, strict=True)
        )
        norm = jnp.sqrt(products[column])
        inverse = jnp.where(norm > 0, 1 / jnp.where(norm > 0, norm, 1), 0)
        units, row = [part * inverse for part in own], products * inverse
        lasts = [(1,) * unit.ndim + (-1,) for unit in units]
        left = [
            jnp.where((columns == column).reshape(last), 0, part - unit[..., None] * row.reshape(last))
            for part, unit, last in zip(left, units, lasts, strict=True)
        ]
        return left, (units, row)

    _, (units, triangle) = jax.lax.scan(reduce, parts, columns)
    return units, triangle


def solved(
    orthogonal: list[Float[Array, "column ..."]],
    triangle: Float[Array, "column column"],
    right: PyTree[Float[Array, "..."]],
) -> Float[Array, "column"]:
    """The x of least ``|Q R x - right|``, with Q and R of `gram_schmidt`.

    Each column is taken off `right` before the next is looked at: so the error is that of Householder's QR
    (Björck 1967), though Q is orthogonal only as far as the condition allows.
    """

    def take_off(left, units):
        along = _total(jnp.vdot(u, rest, precision="highest") for u, rest in zip(units, left, strict=True))
        return [rest - along * unit for unit, rest in zip(units, left, strict=True)], along

    along = jax.lax.scan(take_off, jax.tree.leaves(right), orthogonal)[1]
    missing = jnp.diagonal(triangle) == 0
    regular = triangle + jnp.diag(missing.astype(triangle.dtype))
    return jax.scipy.linalg.solve_triangular(regular, along)


def _total(terms):
    return functools.reduce(jnp.add, terms)
