"""Roots: the first positive one of polynomials, and that of an increasing function, for certain.

The same code for NumPy and JAX: operations are taken from the namespace of the arguments, and loops are
`repeat` and `until`. All functions work element by element on arrays of any leading shape.

The root of an increasing function costs four steps of Newton's method, which is all that photographic
lenses need. Points that have not arrived then go on in a bracket, where each step either halves the
residual or halves the bracket. Newton's method inside a bracket alone does not do that: it can jump
between two points for ever.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from .._core.arrays import namespace, once
from .._core.types import AnyArray

_NEWTON_STEPS = 4
"""Before the bracket: enough for float64 where the displacement is at most some 20 % of the radius."""

_MOST_STEPS = 300
"""In the bracket. At most twice the bits of a number are needed, as each step halves something."""


def repeat(xp: Any, count: int, body: Callable[[Any], Any], state: Any) -> Any:
    """The state after `count` calls of `body`."""
    if xp is jnp:
        return jax.lax.fori_loop(0, count, lambda _, state: body(state), state)
    for _ in range(count):
        state = body(state)
    return state


def until(
    xp: Any,
    unfinished: Callable[[Any], Bool[AnyArray, "..."]],
    body: Callable[[Any], Any],
    state: Any,
    most: int,
) -> Any:
    """The state where nothing is unfinished, or after `most` calls of `body`; the rest stays as it is."""

    def improve(state):
        active = unfinished(state)
        return jax.tree.map(lambda new, old: xp.where(active, new, old), body(state), state)

    if xp is jnp:
        return jax.lax.while_loop(
            lambda counted: jnp.any(unfinished(counted[0])) & (counted[1] < most),
            lambda counted: (improve(counted[0]), counted[1] + 1),
            (state, 0),
        )[0]
    for _ in range(most):
        if not np.any(unfinished(state)):
            break
        state = improve(state)
    return state


def first_positive_root(polynomials: Float[AnyArray, "... row n"]) -> Float[AnyArray, "..."]:
    """The smallest positive root of the polynomials in the rows; inf without one.

    Args:
        polynomials: coefficients upwards; the first is 1.
    """
    xp, size = namespace(polynomials), polynomials.shape[-1]
    if size <= 3:
        columns = (polynomials[..., index] for index in range(1, size))
        return xp.min(first_quadratic_root(*columns), axis=-1)
    power = _numbers(0, polynomials)
    # Up to x = 2, and from x = 1 on as the reversed polynomial in 1/x = 1 - y, so that the search again
    # starts from its known end. They overlap, or rounding could hide a root at the seam from both.
    both = xp.stack([polynomials * 2**power, _reflected(polynomials[..., ::-1])])
    near, far = _first_root_in_unit_interval(both)
    seen = far < 1 - 4096 * np.finfo(polynomials.dtype).eps  # or 1/x is nothing but rounding
    far = xp.where(seen, 1 / xp.where(seen, 1 - far, 1), np.inf)
    return xp.min(xp.where(xp.isfinite(near), 2 * near, far), axis=-1)


def _numbers(first, like):
    """Integers from `first` on along the last axis of an array, in its dtype and rank."""
    last = like.shape[-1]
    return np.arange(first, last, dtype=like.dtype).reshape(*[1] * (like.ndim - 1), last - first)


def first_quadratic_root(b: Any, c: Any = None) -> Any:
    """The smallest positive root of ``1 + b t + c t²``, in closed form without cancellation; or inf."""
    xp = namespace(b)
    c = 0 * b if c is None else c
    discriminant = b * b - 4 * c
    real = discriminant >= 0
    root = xp.sqrt(xp.where(real, discriminant, 0))
    # For b < 0 the sum below is positive, and so is the root, the smaller one if both are. For b >= 0 there
    # is a positive root only if c < 0.
    falling = b < 0
    first = real & falling
    second = ~falling & (c < 0)
    return xp.where(
        first,
        2 / xp.where(first, root - b, 1),
        xp.where(second, (root + b) / xp.where(second, -2 * c, 1), np.inf),
    )


def _evaluated(coefficients, x):
    """``sum_i coefficients[..., i] x^i`` at several x for each polynomial (Horner)."""
    value = 0 * x
    for index in reversed(range(coefficients.shape[-1])):
        value = value * x + coefficients[..., index, None]
    return value


def _first_root_in_unit_interval(coefficients: Float[AnyArray, "... n"]) -> Float[AnyArray, "..."]:
    """The smallest root in (0, 1] of a polynomial that is positive at 0, or inf.

    The roots of each derivative cut the interval into pieces on which the next one is monotone, so
    that bisection in each piece finds every sign change: exact for any degree, no eigenvalues (which
    JAX has on the CPU alone), a fixed amount of work set by the degree and the dtype.
    """
    xp, dtype = namespace(coefficients), coefficients.dtype
    steps = int(np.finfo(dtype).nmant) + 3
    derivatives = [coefficients]
    while derivatives[-1].shape[-1] > 2:
        c = derivatives[-1]
        derivatives.append(c[..., 1:] * _numbers(1, c))
    zero = 0 * coefficients[..., :1]
    start = knots = xp.concatenate([zero, zero + 1], axis=-1)
    found = zero > 1
    for c in reversed(derivatives):
        values = _evaluated(c, knots)
        # A zero inside counts as negative, so that a root on a knot is not lost; one at the end does not.
        positive = xp.concatenate([values[..., :-1] > 0, values[..., -1:] >= 0], axis=-1)
        falling = positive[..., :-1]
        found = falling != positive[..., 1:]

        def halve(bracket, c=c, falling=falling):
            low, high = bracket
            middle = (low + high) / 2
            before_root = (_evaluated(c, middle) > 0) == falling
            return xp.where(before_root, middle, low), xp.where(before_root, high, middle)

        low, high = repeat(xp, steps, halve, (knots[..., :-1], knots[..., 1:]))
        # Where there is no root in a piece its right end stands in: a harmless extra knot.
        roots = xp.where(found, (low + high) / 2, knots[..., 1:])
        knots = xp.concatenate([start[..., :1], roots, start[..., 1:]], axis=-1)
    return xp.min(xp.where(found, knots[..., 1:-1], np.inf), axis=-1)


def _reflected(coefficients: Float[AnyArray, "... n"]) -> Float[AnyArray, "... n"]:
    """The coefficients of ``p(1 - y)``, from those of ``p(x)``, both in increasing order."""
    xp, zero = namespace(coefficients), 0 * coefficients[..., :1]
    reflected = 0 * coefficients
    for index in reversed(range(coefficients.shape[-1])):  # Horner, multiplying by (1 - y)
        reflected = reflected - xp.concatenate([zero, reflected[..., :-1]], axis=-1)
        reflected = xp.concatenate(
            [reflected[..., :1] + coefficients[..., index, None], reflected[..., 1:]], axis=-1
        )
    return reflected


def newton_root(
    equation: Callable[[Any], tuple[Any, Any]],
    start: Float[AnyArray, "..."],
    within: Callable[[Any], Bool[AnyArray, "..."]] = lambda q: q == q,
    size: float = 1.0,
) -> tuple[Float[AnyArray, "..."], Bool[AnyArray, "..."]]:
    """Where four steps of Newton's method arrive, and whether that is the root of `increasing_root`.

    Cheap, one pass over the points: nearly always it is.
    """
    xp, rounding = namespace(start), _rounding(size, start.dtype)
    q = start
    error, slope = equation(q)
    for _ in range(_NEWTON_STEPS):
        q = q - error / xp.where(slope > 0, slope, 1)
        error, slope = equation(q)
    return q, (abs(error) <= rounding(q, slope)) & (q >= 0) & (slope >= 0) & within(q)


def increasing_root(
    equation: Callable[[Any], tuple[Any, Any]],
    start: Float[AnyArray, "..."],
    high: Callable[[], Float[AnyArray, "..."]],
    within: Callable[[Any], Bool[AnyArray, "..."]] = lambda q: q == q,
    size: float = 1.0,
) -> tuple[Float[AnyArray, "..."], Bool[AnyArray, "..."]]:
    """The q in [0, high] where an increasing function is zero, and whether it was found.

    Found means that the residual was looked at, and is that of rounding: at most some last digits of `size`
    and of ``q`` times the slope. Without a root in the interval, or with NaN, the answer is False.

    Args:
        equation: the function, negative at 0, and its derivative. It need not be increasing beyond `high`.
        start: where Newton's method starts.
        high: gives the end of the interval, which may be inf; called only if Newton's steps do not arrive.
        within: whether a q is not beyond that end, if this is cheaper to tell.
        size: of the numbers that the function is a difference of.
    """
    xp = namespace(start)
    q, arrived = once(newton_root(equation, start, within, size))
    if xp is np and arrived.all():
        return q, arrived
    end = high()
    q = xp.where(xp.isfinite(q) & (q > 0), xp.minimum(q, end), xp.minimum(start, end))
    return _in_bracket(xp, equation, _rounding(size, start.dtype), q, end)


def _rounding(size, dtype):
    """The residual of an exact root, as rounded.

    Never infinite: where the function overflows its slope does, too, and that is no root.
    """
    eps = np.finfo(dtype).eps
    return lambda q, slope: eps * (size + namespace(q).minimum(q * abs(slope), 1 / eps))


def _in_bracket(xp, equation, rounding, q, high):
    """The root in [0, high] and whether it was found, from any q in it, by steps that cannot fail."""
    eps = np.finfo(q.dtype).eps

    def unfinished(state):
        q, error, slope, low, high, _ = state
        # Comparisons with NaN are False, so that it ends, too.
        return (abs(error) > rounding(q, slope)) & (high - low > 2 * eps * high)

    def step(state):
        q, error, slope, low, high, least = state
        low, high = xp.where(error < 0, q, low), xp.where(error > 0, q, high)
        newton = q - error / xp.where(slope > 0, slope, 1)
        good = (slope > 0) & (abs(error) <= least / 2) & (newton > low) & (newton < high)
        new = xp.where(good, newton, (low + high) / 2)
        return new, *equation(new), low, high, xp.minimum(least, abs(error))

    error, slope = equation(q)
    open_end = xp.isinf(high) & (abs(error) > rounding(q, slope))
    high = until(
        xp,
        lambda high: open_end & (equation(high)[0] < 0) & xp.isfinite(high),
        lambda high: 2 * high,
        xp.where(xp.isinf(high), xp.maximum(q, 1), high),
        2000,
    )
    state = (q, error, slope, 0 * q, high, 0 * q + np.inf)
    q, error, slope, *_ = until(xp, unfinished, step, state, _MOST_STEPS)
    return q, abs(error) <= 8 * rounding(q, slope)
