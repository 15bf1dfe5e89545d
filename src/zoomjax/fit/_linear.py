"""Linear least squares with many rows and few columns."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


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


def triangle_of(matrix: Float[Array, "row column"]) -> Float[Array, "column column"]:
    """R of the QR of a matrix with more rows than columns; see `gram_schmidt`.

    LAPACK starts threads on all cores for this, which takes many times as long. And its calls for several
    matrices at once, as under ``vmap``, stop for ever where two of them fill the threads they wait for.
    """
    return gram_schmidt(matrix)[1]


def gram_schmidt(
    matrix: Float[Array, "row column"],
) -> tuple[Float[Array, "row column"], Float[Array, "column column"]]:
    """Q and R of a matrix by modified Gram-Schmidt; rows of zeros in R for columns that are dependent."""

    def reduce(left, column):
        own = left[:, column]
        products = jnp.matmul(own, left, precision="highest")
        norm = jnp.sqrt(products[column])
        inverse = jnp.where(norm > 0, 1 / jnp.where(norm > 0, norm, 1), 0)
        unit, row = own * inverse, products * inverse
        return (left - jnp.outer(unit, row)).at[:, column].set(0), (unit, row)

    _, (units, triangle) = jax.lax.scan(reduce, matrix, jnp.arange(matrix.shape[1]))
    return units.T, triangle


def solved(
    orthogonal: Float[Array, "row column"],
    triangle: Float[Array, "column column"],
    right: Float[Array, "row"],
) -> Float[Array, "column"]:
    """The x of least ``|Q R x - right|``, with Q and R of `gram_schmidt`.

    Each column is taken off `right` before the next is looked at: so the error is that of Householder's QR
    (Björck 1967), though Q is orthogonal only as far as the condition allows.
    """

    def take_off(left, unit):
        part = jnp.vdot(unit, left, precision="highest")
        return left - part * unit, part

    parts = jax.lax.scan(take_off, right, orthogonal.T)[1]
    missing = jnp.diagonal(triangle) == 0
    regular = triangle + jnp.diag(missing.astype(triangle.dtype))
    return jax.scipy.linalg.solve_triangular(regular, parts)
