"""Polynomials by their Bernstein coefficients, between whose least and greatest they stay.

On an interval ``[low, high]`` a polynomial of degree n has n + 1 such *controls*. The first and the last
are its values at the ends; all of it lies between the least and the greatest, the closer the shorter the
interval. Controls are linear in the polynomial, and made here from sums of terms of one sign, so that they
have errors of a few last digits.
"""

import math
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, ScalarLike


class Pieces(eqx.Module):
    """The coefficients of a zoom model over a range of focal lengths, a polynomial in each piece of it.

    Attributes:
        controls: of the coefficients (or of basis functions that they are made of), or of polynomials that
            are nowhere above them, piece by piece.
        ends: of the pieces, in the variable in which they are polynomials.
        focal_of: from that variable to the focal length.
        size: for each coefficient, how large the numbers get that it is computed from, for rounding errors.
        exact: whether the controls are those of the coefficients, and not of what is below them.
    """

    controls: Float[Array, "piece control terms"]
    ends: Float[Array, "piece 2"]
    focal_of: Callable[[Array], Array] = eqx.field(static=True)
    size: Float[Array, "terms"]
    exact: bool = eqx.field(static=True, default=True)


def power_controls(low: ScalarLike, high: ScalarLike, degree: int) -> Float[Array, "control power"]:
    """The controls, on [low, high], of the powers 0 to `degree` of the variable."""
    ways = np.zeros((degree + 1, degree + 1, degree + 1))
    for place, power, highs in np.ndindex(ways.shape):
        if highs <= power:
            ways[place, power, highs] = (
                math.comb(place, highs)
                * math.comb(degree - place, power - highs)
                / math.comb(degree, power)
            )
    high = jnp.asarray(high)
    exponent = np.arange(degree + 1)
    lows = jnp.asarray(low) ** np.maximum(exponent[:, None] - exponent[None], 0)
    return jnp.sum(jnp.asarray(ways, high.dtype) * (lows * high ** exponent[None])[None], axis=-1)


def cut(degree: int, cells: int) -> Float[np.ndarray, "cell control control"]:
    """The matrices from controls on an interval to those on each of its equal `cells`."""

    def within(low, high):
        rows = []
        for place in range(degree + 1):
            row = np.ones(1)
            for end in [low] * (degree - place) + [high] * place:
                row = (1 - end) * np.append(row, 0) + end * np.append(0, row)
            rows.append(row)
        return np.stack(rows)

    return np.stack([within(cell / cells, (cell + 1) / cells) for cell in range(cells)])
