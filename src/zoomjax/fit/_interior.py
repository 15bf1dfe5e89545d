"""Least squares under inequalities, by a primal-dual interior-point method.

Minimise ``|r(x)|^2 / 2`` where ``slack(x) > 0``, element by element. Every iterate satisfies the
inequalities; the barrier ``-mu sum log slack`` keeps it from their border, and mu falls tenfold a step. A
step is Gauss-Newton's for residuals and barrier together, with multipliers z of the inequalities (so that
``z slack = mu`` at the minimum) in place of the barrier's own curvature, solved by QR of the stacked rows

    [ sqrt(z / slack) slack' ]        [ mu / sqrt(z slack) ]
    [           r'           ]  dx  = [        -r          ]

without forming products that would square the condition number. It points down the barrier function, so
that halving it ends.

Per step one Jacobian of the residuals and of the slack, and residuals again for each halving.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

_FALL = 0.1  # of mu at a step
_KEPT = 0.01  # of the slack that a step may not use up
_FLOOR = 1e-9  # of the first sum of squares: what is smaller is as good as zero
_FIRST = 0.1  # mu at the start, of the sum of squares, all inequalities together


class _State(NamedTuple):
    x: Float[Array, "unknown"]
    multiplier: Float[Array, "inequality"]
    finished: Bool[Array, ""]
    steps: Int[Array, ""]


def least_squares_within(
    residuals: Callable[[Float[Array, "unknown"]], Float[Array, "row"]],
    slack: Callable[[Float[Array, "unknown"]], Float[Array, "inequality"]],
    start: Float[Array, "unknown"],
    max_steps: int,
) -> tuple[Float[Array, "unknown"], Float[Array, "inequality"], Bool[Array, ""], Int[Array, ""]]:
    """The minimum, the barrier's strength ``z slack`` at each inequality, whether it is reached, and steps.

    Reached means that neither the inequalities nor the last step account for more than 1e-8 of the energy
    (1e-5 in float32).

    Args:
        residuals: r(x), differentiable.
        slack: what must be positive, differentiable.
        start: a point where it is.
        max_steps: the most steps.
    """
    single = start.dtype == jnp.float32
    tolerance = 1e-5 if single else 1e-8

    def merit(x, mu):
        gaps = slack(x)
        inside = jnp.all(gaps > 0)
        barrier = -mu * jnp.sum(jnp.log(jnp.where(gaps > 0, gaps, 1)))
        return jnp.where(inside, jnp.sum(residuals(x) ** 2) / 2 + barrier, jnp.inf)

    def step(state):
        x, z = state.x, state.multiplier
        r, jacobian = _linearised(residuals, x)
        gaps, slopes = _linearised(slack, x)
        triangle = _triangle(jnp.concatenate([jacobian, -r[:, None]], axis=1))
        energy = jnp.maximum(jnp.sum(r**2) / 2, _FLOOR * first)
        mu = _FALL * jnp.mean(z * gaps)
        barrier = jnp.concatenate(
            [jnp.sqrt(z / gaps)[:, None] * slopes, (mu / jnp.sqrt(z * gaps))[:, None]], axis=1
        )
        change = _solved(jnp.concatenate([_triangle(barrier), triangle]))
        sound = jnp.all(jnp.isfinite(change))
        change = jnp.where(sound, change, 0)
        moved = slopes @ change
        new_z = mu / gaps - z / gaps * moved
        length = _longest(gaps, moved)
        now = merit(x, mu)

        def too_long(length):
            worse = merit(x + length * change, mu) - now
            return ~(worse <= 128 * jnp.finfo(x.dtype).eps * jnp.abs(now)) & (length > 1e-9)

        length = jax.lax.while_loop(too_long, lambda length: length / 2, length)
        ahead = length * jnp.sum((triangle[:, :-1] @ change) ** 2)
        gap = jnp.sum(z * gaps)
        return _State(
            x=x + length * change,
            multiplier=z + _longest(z, new_z - z) * (new_z - z),
            finished=sound & (gap <= tolerance * energy) & (ahead <= tolerance * energy),
            steps=jnp.where(sound, state.steps + 1, max_steps),
        )

    def unfinished(state):
        return ~state.finished & (state.steps < max_steps)

    gaps = slack(start)
    first = jnp.sum(residuals(start) ** 2) / 2
    mu = _FIRST * first / gaps.shape[0]
    state = _State(start, mu / gaps, jnp.asarray(False), jnp.asarray(0))
    state = jax.lax.while_loop(unfinished, step, state)
    return state.x, state.multiplier * slack(state.x), state.finished, state.steps


def implicit(
    energy: Callable[[Float[Array, "unknown"]], Float[Array, ""]],
    slack: Callable[[Float[Array, "unknown"]], Float[Array, "inequality"]],
    minimum: Float[Array, "unknown"],
    strength: Float[Array, "inequality"],
) -> Float[Array, "unknown"]:
    """The same minimum, differentiable in the arguments of `energy` and `slack` (implicit differentiation).

    Derivatives are those of the minimum with the barrier at its last strength: active inequalities keep
    their slack, inactive ones have no influence. There is a kink where an inequality becomes active or
    inactive. Directions that the energy does not determine do not move.
    """
    minimum, strength = jax.lax.stop_gradient((minimum, strength))
    multiplier = strength / jax.lax.stop_gradient(slack(minimum))

    def conditions(point):
        x, z = point
        gaps, transposed = jax.vjp(slack, x)
        return jax.grad(energy)(x) - transposed(z)[0], z * gaps - strength

    def change(_, right):
        gaps, slopes = _linearised(slack, minimum)
        curvature = jax.jacfwd(jax.grad(lambda x: energy(x) - multiplier @ slack(x)))(minimum)
        x = _stationary(curvature, slopes, multiplier / gaps, right[0], right[1] / multiplier)
        return x, (right[1] - multiplier * (slopes @ x)) / gaps

    return jax.lax.custom_root(conditions, (minimum, multiplier), lambda _, start: start, change)[0]


def _stationary(curvature, slopes, weight, right, gaps):
    """The x of ``(curvature + slopes' W slopes) x = right + slopes' W gaps``, W the diagonal of weights.

    Weights of active inequalities may exceed the curvature by all digits of a number: the sum would lose
    it. So the system is solved along the singular vectors of ``sqrt(W) slopes``, where the large part is
    diagonal.
    """
    root = jnp.sqrt(weight)
    rows = jnp.concatenate([root[:, None] * slopes, jnp.zeros_like(curvature)])  # never fewer than unknowns
    left, size, directions = jnp.linalg.svd(rows, full_matrices=False)
    left = left[: root.shape[0]]
    matrix = directions @ curvature @ directions.T + jnp.diag(size**2)
    scale = jnp.sqrt(jnp.abs(jnp.diagonal(matrix)))
    scale = jnp.where(scale > 0, scale, 1)
    values, vectors = jnp.linalg.eigh(matrix / (scale[:, None] * scale[None]))
    known = jnp.abs(values) > 64 * jnp.finfo(values.dtype).eps
    inverse = jnp.where(known, 1 / jnp.where(known, values, 1), 0)
    turned = (directions @ right + size * (left.T @ (root * gaps))) / scale
    return directions.T @ (vectors @ (inverse * (vectors.T @ turned)) / scale)


def _solved(rows):
    """Least squares of ``[matrix, right]``, columns brought to one length; unknowns without rows stay."""
    size = jnp.linalg.norm(rows[:, :-1], axis=0)
    size = jnp.where(size > 0, size, 1)
    unknowns = size.shape[0]
    damping = jnp.finfo(rows.dtype).eps * jnp.eye(unknowns, unknowns + 1, dtype=rows.dtype)
    scaled = rows / jnp.append(size, 1)[None]
    triangle = jnp.linalg.qr(jnp.concatenate([scaled, damping]), mode="r")[:unknowns]
    return jax.scipy.linalg.solve_triangular(triangle[:, :-1], triangle[:, -1]) / size


def _linearised(function, x):
    """A function's value and derivative."""
    derivative, value = jax.jacfwd(lambda x: (function(x),) * 2, has_aux=True)(x)
    return value, derivative


def _triangle(rows):
    """R of the QR of many rows, by modified Gram-Schmidt: much faster than LAPACK for few columns."""

    def reduce(rows, column):
        products = jnp.matmul(rows[:, column], rows, precision="highest")
        norm = jnp.sqrt(products[column])
        row = jnp.where(norm > 0, products / jnp.where(norm > 0, norm, 1), 0)
        left = rows - jnp.outer(rows[:, column] / jnp.where(norm > 0, norm, 1), row)
        return left.at[:, column].set(0), row

    return jax.lax.scan(reduce, rows, jnp.arange(rows.shape[1]))[1]


def _longest(values, change):
    """The longest step, at most 1, after which positive values still are, and keep a share."""
    shrinking = change < 0
    ratio = jnp.where(shrinking, values / jnp.where(shrinking, -change, 1), jnp.inf)
    return jnp.minimum(1, (1 - _KEPT) * jnp.min(ratio))
