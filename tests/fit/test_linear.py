"""Linear least squares by Gram-Schmidt, against LAPACK."""

import jax.numpy as jnp
import numpy as np
import pytest

from zoomjax.fit._linear import gram_schmidt, solved, triangle_of


def wide(rows=40, columns=5, seed=0):
    """A matrix whose columns differ in size by 1e5 and are nearly dependent."""
    random = np.random.default_rng(seed)
    matrix = random.normal(size=(rows, columns)) * np.logspace(0, -5, columns)
    matrix[:, 1] = matrix[:, 0] + 1e-6 * matrix[:, 1]
    return matrix


def test_triangle_has_the_matrix_s_inner_products():
    matrix = wide()
    top, rest = jnp.asarray(matrix[:30]).reshape(5, 6, 5), jnp.asarray(matrix[30:])
    triangle = np.asarray(triangle_of([top, rest]))
    reference = np.linalg.qr(matrix)[1]
    reference *= np.sign(np.diag(reference))[:, None]
    np.testing.assert_allclose(triangle, reference, rtol=1e-8, atol=1e-20)


def test_solution_is_that_of_lapack():
    matrix, right = wide(), np.random.default_rng(1).normal(size=40)
    found = solved(*gram_schmidt(jnp.asarray(matrix)), jnp.asarray(right))
    np.testing.assert_allclose(found, np.linalg.lstsq(matrix, right, rcond=None)[0], rtol=1e-8)


def test_dependent_columns_have_rows_of_zeros_and_get_nothing():
    matrix = jnp.asarray([[1.0, 0.0, 2.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    units, triangle = gram_schmidt(matrix)
    assert not np.any(triangle[1])
    assert solved(units, triangle, jnp.asarray([1.0, 1.0, 0.0]))[1] == 0


@pytest.mark.parametrize("rows", [0, 2])
def test_parts_of_two_dtypes_are_taken_in_the_wider(rows):
    """As a model in float32 has a prior in float32, which may be empty, beside points in float64."""
    matrix, prior = wide(), np.eye(5, dtype=np.float32)[:rows]
    mixed = triangle_of([jnp.asarray(matrix), jnp.asarray(prior)])
    assert mixed.dtype == jnp.float64
    np.testing.assert_array_equal(
        mixed, triangle_of([jnp.asarray(matrix), jnp.asarray(prior, jnp.float64)])
    )
