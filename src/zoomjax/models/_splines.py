"""Interpolation between knots, as weights of the values there: hats, and natural cubic splines."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._core.arrays import as_jax
from .._core.fields import check_finite, known
from .._core.types import AnyArray, traced


def spread(
    values: Float[AnyArray, "value"], number: int | None, *, inverse: bool = False
) -> Float[AnyArray, "knot"]:
    """`number` of the distinct values, or all, increasing and spread evenly over their ranks.

    Or of their `inverse`; in NumPy where they are known, which compiles nothing.
    """
    values = values if traced(values) else np.asarray(values)
    values = 1 / values if inverse else values
    ordered = jnp.sort(values) if traced(values) else np.unique(values)
    if number is None:
        return ordered
    return ordered[np.round(np.linspace(0, ordered.shape[0] - 1, number)).astype(int)]


def place(
    knots: Float[AnyArray, "basis"], x: Float[Array, ""]
) -> tuple[Int[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Index of the interval that x lies in, how far along it, from 0 to 1, and its width."""
    knots = jnp.asarray(knots)
    if knots.shape[0] == 1:
        return jnp.asarray(0), jnp.zeros_like(x), jnp.ones_like(x)
    index = jnp.clip(jnp.searchsorted(knots, x) - 1, 0, knots.shape[0] - 2)
    width = knots[index + 1] - knots[index]
    known: Bool[Array, ""] = width > 0  # knots that coincide, as they may under a trace
    return index, jnp.where(known, x - knots[index], 0) / jnp.where(known, width, 1), width


def at_ends(
    knots: Float[AnyArray, "basis"], index: Int[Array, ""], first: Array, second: Array
) -> Float[Array, "basis"]:
    """A vector with two values, at the ends of an interval."""
    vector = jnp.zeros(knots.shape[0], jnp.result_type(first)).at[index].add(first)
    return vector.at[index + 1].add(second)  # beyond the only knot of a table of one: dropped


def natural_basis(
    knots: Float[AnyArray, "basis"], curvature: Float[AnyArray, "basis basis"], x: Float[Array, ""]
) -> Float[Array, "basis"]:
    """The cardinal natural splines at x, between the first and the last knot."""
    index, share, width = place(knots, x)
    bent = at_ends(knots, index, (1 - share) ** 3 - (1 - share), share**3 - share)
    bend = width**2 / 6 * jnp.matmul(bent, curvature, precision="highest")
    return at_ends(knots, index, 1 - share, share) + bend


def natural_controls(
    knots: Float[Array, "basis"], curvature: Float[Array, "basis basis"]
) -> Float[Array, "interval control basis"]:
    """The Bernstein coefficients of the cardinal natural splines in each interval between knots."""
    one = jnp.eye(knots.shape[0], dtype=knots.dtype)
    share = jnp.asarray([0, 1 / 3, 2 / 3, 1], knots.dtype)[None, :, None]
    bent = jnp.asarray([[0, 0], [2, 1], [1, 2], [0, 0]], knots.dtype)
    width = jnp.diff(knots)[:, None, None]
    straight = (1 - share) * one[:-1, None] + share * one[1:, None]
    neighbours = jnp.stack([curvature[:-1], curvature[1:]], axis=1)
    return straight - width**2 / 18 * jnp.einsum("cn,pnb->pcb", bent, neighbours, precision="highest")


def natural_curvature(knots: Float[AnyArray, "basis"]) -> Float[Array, "basis basis"]:
    """The matrix from values at the knots to the natural spline's second derivatives there."""
    return as_jax(_curvature(knots, jnp if traced(knots) else np))  # known ones compile nothing


def _curvature(knots: Any, xp: Any) -> Any:
    """The same, by NumPy or JAX."""
    knots = xp.asarray(knots)
    size, width = knots.shape[0], xp.diff(knots)
    if size < 3:
        return np.zeros((size, size), knots.dtype)

    def banded(*diagonals):
        one, two, three = (np.eye(size - 2, size, k, dtype=knots.dtype) for k in range(3))
        return diagonals[0][:, None] * one + diagonals[1][:, None] * two + diagonals[2][:, None] * three

    first, last = width[:-1], width[1:]
    system = banded(first / 6, (first + last) / 3, last / 6)
    second = banded(1 / first, -1 / first - 1 / last, 1 / last)
    return xp.pad(xp.linalg.solve(system[:, 1:-1], second), ((1, 1), (0, 0)))


def check_curvature(name: str, curvature: Any, knots: Any) -> None:
    """Raise ValueError where a matrix is not the `natural_curvature` of known knots, as of others."""
    check_finite(name, curvature)
    given, places = known(curvature), known(knots)
    if given is None or places is None or places.ndim != 1:
        return
    own = _curvature(places, np)
    if np.max(np.abs(given - own), initial=0) > _APART * np.max(np.abs(own), initial=0):
        raise ValueError(
            f"Argument {name} must be that of the natural spline through its knots, but it is of others: "
            "leave both out, and fit or prepare the model."
        )


_APART = 1e-3
"""Share by which curvatures may be apart, by rounding to float32."""
