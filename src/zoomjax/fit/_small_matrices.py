"""Products and inverses of many small matrices, one of each view, ray or line; and of a large one."""

import jax.numpy as jnp

_LARGE = 256
"""Rows of a matrix from which it is worth while to compute half of a symmetric product."""


def products(left, right):
    """Of each view, the sum over its two rows of the products of their columns.

    As loops that XLA fuses: a product of matrices with two rows would be a call each.
    """
    x, y = (left[:, row, :, None] * right[:, row, None, :] for row in (0, 1))
    return x + y


def line_products(left, right):
    """Of each line, the sum over its rows of the products of their columns."""
    return jnp.einsum("lri,lrj->lij", left, right)


def times(left, right):
    """Products of matrices of few columns and of few rows."""
    first, *others = (
        left[:, :, column, None] * right[:, None, column, :] for column in range(left.shape[2])
    )
    return sum(others, start=first)


def inverses(matrix):
    """Inverses of symmetric 2 x 2 or 3 x 3 matrices, and what gives them times its transpose."""
    inverse = _inverse(matrix[:, :2, :2])
    root = _root(inverse)
    if matrix.shape[2] == 2:
        return inverse, root
    across = matrix[:, :2, 2:]
    solved = times(inverse, across)
    left = matrix[:, 2, 2] - jnp.sum(across * solved, axis=(1, 2))
    left = jnp.where(left > 0, left, jnp.inf)
    column = jnp.pad(-solved, ((0, 0), (0, 1), (0, 0)), constant_values=1) / jnp.sqrt(left)[:, None, None]
    inverse, root = (jnp.pad(of, ((0, 0), (0, 1), (0, more))) for of, more in ((inverse, 1), (root, 0)))
    return inverse + column * column.swapaxes(1, 2), jnp.concatenate([root, column], axis=2)


def _inverse(matrix):
    """Inverses of symmetric 2 x 2 matrices."""
    a, b, d = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 1]
    determinant = a * d - b * b
    determinant = jnp.where(determinant > 0, determinant, jnp.inf)  # of a ray without views
    return _symmetric(d, -b, a) / determinant[:, None, None]


def _root(matrix):
    """Lower triangles L of symmetric 2 x 2 matrices L L^T."""
    first = jnp.sqrt(matrix[:, 0, 0])
    off = matrix[:, 0, 1] / jnp.where(first > 0, first, 1)
    last = jnp.sqrt(jnp.maximum(matrix[:, 1, 1] - off**2, 0))
    return jnp.stack([jnp.stack([first, 0 * off], 1), jnp.stack([off, last], 1)], 1)


def _symmetric(a, b, d):
    return jnp.stack([jnp.stack([a, b], 1), jnp.stack([b, d], 1)], 1)


def gram(rows):
    """``rows @ rows.T``, of which the half below the diagonal is a copy."""
    number = len(rows)
    if number < _LARGE:
        return rows @ rows.T
    first, last = rows[: number // 2], rows[number // 2 :]
    both = first @ last.T
    return jnp.block([[gram(first), both], [both.T, gram(last)]])
