"""The default solver: the minima of optimistix' own, and how it gets there."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zoomjax.fit._least_squares import TriangularLevenbergMarquardt

SOLVER = TriangularLevenbergMarquardt(rtol=1e-9, atol=1e-9)
CLASSICAL = optx.LevenbergMarquardt(rtol=1e-9, atol=1e-9)


def rosenbrock(y, args):
    """Residuals in a tree of two shapes, of unknowns in a tree."""
    del args
    return {"steep": 10 * (y["b"] - y["a"] ** 2)[None, None], "flat": 1 - y["a"]}, None


def decay(y, times):
    """Distances of a sum of exponentials from one with other numbers, which it cannot reach."""
    return jnp.exp(-jnp.outer(times, y)).sum(axis=1) - 2 / (1 + times), None


def solve(function, start, args=None, solver=SOLVER, **options):
    """The solution, without raising."""
    return optx.least_squares(function, solver, start, args, has_aux=True, throw=False, **options)


def test_a_curved_valley_is_followed_to_its_end():
    found = solve(rosenbrock, {"a": jnp.array(-1.2), "b": jnp.array(1.0)})
    assert found.result == optx.RESULTS.successful
    np.testing.assert_allclose([found.value["a"], found.value["b"]], 1, atol=1e-9)


@given(st.lists(st.floats(0.05, 3), min_size=2, max_size=2))
def test_the_minimum_is_that_of_the_library(start):
    times = jnp.linspace(0, 5, 40)
    found, other = (
        solve(decay, jnp.array(start) + jnp.array([0, 3.5]), times, solver)
        for solver in (SOLVER, CLASSICAL)
    )
    assert found.result == optx.RESULTS.successful
    np.testing.assert_allclose(np.sort(found.value), np.sort(other.value), rtol=1e-5)


def test_steps_that_do_not_help_are_not_taken():
    def bent(y, args):
        return jnp.arctan(y) * jnp.array([1.0, 2.0]), None

    assert abs(3 - jnp.arctan(3.0) * (1 + 3.0**2)) > 9  # where Newton's step from 3 leads to
    found = solve(bent, jnp.array([3.0]))
    assert found.result == optx.RESULTS.successful
    np.testing.assert_allclose(found.value, 0, atol=1e-8)


def test_linear_problems_take_one_step_and_one_to_see_it(rng):
    matrix, right = rng.standard_normal((50, 4)), rng.standard_normal(50)
    found = solve(lambda y, args: (jnp.asarray(matrix) @ y - jnp.asarray(right), None), jnp.zeros(4))
    np.testing.assert_allclose(found.value, np.linalg.lstsq(matrix, right)[0], rtol=1e-9)
    assert found.stats["num_steps"] <= 4  # the start, the step, the rest that damping left, and no more


def test_float32_ends_where_rounding_does(rng):
    matrix = jnp.asarray(rng.standard_normal((20_000, 3)), jnp.float32)
    right = jnp.asarray(rng.standard_normal(20_000), jnp.float32)
    solver = TriangularLevenbergMarquardt(rtol=1e-6, atol=1e-6)
    found = solve(
        lambda y, args: (jnp.sin(matrix @ y) - right, None), jnp.zeros(3, jnp.float32), None, solver
    )
    assert found.value.dtype == jnp.float32
    assert found.result == optx.RESULTS.successful
    assert found.stats["num_steps"] < 20


def test_columns_without_effect_stay_where_they_are():
    found = solve(lambda y, args: (jnp.stack([y[0] - 2, 3 * y[0]]), None), jnp.array([0.0, 7.0]))
    assert found.result == optx.RESULTS.successful
    np.testing.assert_allclose(found.value, [0.2, 7.0], atol=1e-9)


@pytest.mark.parametrize("scale", [1.0, 1e2, 1e4])
@pytest.mark.parametrize("seed", range(6))
def test_dependent_columns_are_no_reason_to_go_on_for_ever(seed, scale):
    rng = np.random.default_rng(seed)
    matrix, right = scale * rng.standard_normal((2000, 5)), rng.standard_normal(2000)
    matrix[:, 4] = matrix[:, 0] - 2 * matrix[:, 2]
    found = solve(lambda y, args: (jnp.asarray(matrix) @ y - jnp.asarray(right), None), jnp.ones(5))
    assert found.result == optx.RESULTS.successful
    assert found.stats["num_steps"] < 40
    best = np.linalg.norm(matrix @ np.linalg.lstsq(matrix, right)[0] - right)
    np.testing.assert_allclose(np.linalg.norm(matrix @ found.value - right), best, rtol=1e-9)


def test_a_start_without_numbers_ends_at_once():
    found = solve(lambda y, args: (jnp.exp(y), None), jnp.array([1e4]))
    assert found.result == optx.RESULTS.nonfinite
    assert found.stats["num_steps"] == 1


@pytest.mark.parametrize("start", [jnp.nan, 1e200])
def test_what_is_not_finite_is_no_success(start):
    found = solve(lambda y, args: (jnp.exp(y) - 1, None), jnp.array([start]), max_steps=40)
    assert found.result != optx.RESULTS.successful


def test_too_few_steps_are_said():
    found = solve(rosenbrock, {"a": jnp.array(-1.2), "b": jnp.array(1.0)}, max_steps=3)
    assert found.result == optx.RESULTS.nonlinear_max_steps_reached


def test_each_of_a_batch_is_as_alone():
    starts = jnp.array([[0.2, 3.0], [0.5, 2.0], [2.9, 0.1]])
    times = jnp.linspace(0, 5, 40)
    batch = jax.vmap(lambda start: solve(decay, start, times).value)(starts)
    alone = jnp.stack([solve(decay, start, times).value for start in starts])
    np.testing.assert_allclose(batch, alone, rtol=1e-7)


def test_solutions_are_differentiable_by_what_they_depend_on():
    times = jnp.linspace(0, 5, 40)

    def fitted(shift):
        def function(y, args):
            residual, _ = decay(y, times)
            return residual + args * jnp.cos(times), None

        return jnp.sort(solve(function, jnp.array([0.2, 3.0]), shift).value)[0]

    slope, step = jax.grad(fitted)(0.01), 1e-4
    np.testing.assert_allclose(slope, (fitted(0.01 + step) - fitted(0.01 - step)) / (2 * step), rtol=1e-4)
