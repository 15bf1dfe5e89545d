"""The straight line of least squares through points about their mean: its normal, and their distances."""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Float

from .._core.products import exact_products

# The angle of a line, ½ atan2, jumps by half a turn at one direction: harmless to derivatives, but the
# residuals change sign there and finite differences across it are wrong. Left alone the jump sits at
# exactly vertical lines, the commonest there are; this turns it to 110.9° from the x axis.
_CUT = 0.73


@exact_products
def line_normal(centred: Float[Array, "rows 2"]) -> Float[Array, "2"]:
    """The unit normal of the total-least-squares line of points about their mean.

    Points without a direction (none, one, or an isotropic cloud) get a fixed normal, with zero gradient.
    """
    x, y = centred[:, 0], centred[:, 1]
    difference, product = x @ x - y @ y, 2 * (x @ y)
    cos, sin = math.cos(_CUT), math.sin(_CUT)
    along, across = cos * difference + sin * product, cos * product - sin * difference
    # Guard the input of atan2: at (0, 0) its gradient is NaN, and stays so through a where().
    directed = (along != 0) | (across != 0)
    twice = jnp.arctan2(jnp.where(directed, across, 0), jnp.where(directed, along, 1)) + _CUT
    return jnp.stack([-jnp.sin(twice / 2), jnp.cos(twice / 2)])


@exact_products
def line_residuals(centred: Float[Array, "rows 2"]) -> Float[Array, "rows"]:
    """Signed distances of points about their mean to their own best line, in their unit."""
    return centred @ line_normal(centred)


def rounded_by(scale: float, dtype: DTypeLike) -> float:
    """How far, px, exact lines seem to be from straight, of coordinates of such a size: some eps of it."""
    return _ROUNDING * float(np.finfo(dtype).eps) * scale


_ROUNDING = 8
"""Lines of exact scenes are off by up to 2 eps, compressed or not, in float32 and float64."""
