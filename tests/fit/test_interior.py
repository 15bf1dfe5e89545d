"""Least squares under inequalities, on problems whose answers are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from zoomjax.fit._interior import implicit, least_squares_within

NORMALS = (
    jnp.array([[3.0, 4.0, 0.0]] * 4) / 5
)  # one plane, said four times: curvature is singular beside it


def slack(x):
    return NORMALS @ x - 1


def nearest(target):
    """The point of the half space nearest to `target`."""
    start = jnp.array([6.0, 8.0, 1.0])
    constant = jax.lax.stop_gradient(target)
    x, strength, reached, _ = least_squares_within(lambda x: x - constant, slack, start, 100)
    return implicit(lambda x: jnp.sum((x - target) ** 2) / 2, slack, x, strength), reached


def test_the_nearest_point_of_a_half_space():
    x, reached = nearest(jnp.array([-1.0, 0.5, 2.0]))
    assert reached
    np.testing.assert_allclose(x, [-1 + 1.2 * 0.6, 0.5 + 1.2 * 0.8, 2.0], atol=1e-6)


@pytest.mark.parametrize("strength", [1e-3, 1e-9, 1e-15])
def test_derivatives_where_active_inequalities_outweigh_everything(strength):
    """Of the nearest point: the projection onto the plane, however weak the barrier."""
    plane = NORMALS[0]
    multiplier = 1.2 / 4
    minimum = plane * (1 + strength / multiplier) + jnp.array([0.0, 0.0, 2.0])

    def point(target):
        energy = lambda x: jnp.sum((x - target) ** 2) / 2  # noqa: E731
        return implicit(energy, slack, minimum, jnp.full(4, multiplier) * slack(minimum))

    target = minimum - 1.2 * plane
    np.testing.assert_array_equal(point(target), minimum)
    expected = np.eye(3) - np.outer(plane, plane)
    atol = 10 * strength / multiplier**2 + 1e-14
    np.testing.assert_allclose(jax.jacfwd(point)(target), expected, atol=atol)
    np.testing.assert_allclose(jax.jacrev(point)(target), expected, atol=atol)


def test_what_the_energy_does_not_determine_stays():
    """And neither value nor derivative is NaN."""

    def point(target):
        return implicit(
            lambda x: (x[0] - target) ** 2 / 2, slack, jnp.array([2.0, 1.0, 0.0]), jnp.full(4, 1e-12)
        )

    np.testing.assert_array_equal(point(2.0), [2, 1, 0])
    assert np.isfinite(jax.jacfwd(point)(2.0)).all()
