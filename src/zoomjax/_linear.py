"""Linear least squares with many rows and few columns."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def least_squares(
    matrix: Float[Array, "row column"], right: Float[Array, "row"], *, floor: float
) -> Float[Array, "column"]:
    """The x of least ``|matrix x - right|``; directions that change it by no more than rounding stay zero.

    Rounding is counted from the largest singular value and `floor`, the size of what the rows were computed
    from. Solved with the small triangle of the whole table, so that the rows are read once.
    """
    triangle = jnp.linalg.qr(jnp.concatenate([matrix, right[:, None]], axis=1), mode="r")
    left, size, rows = jnp.linalg.svd(triangle[:, :-1], full_matrices=False)
    known = size > 64 * jnp.finfo(size.dtype).eps * (size[0] + floor)
    inverse = jnp.where(known, 1 / jnp.where(known, size, 1), 0)
    return rows.T @ (inverse * (left.T @ triangle[:, -1]))
