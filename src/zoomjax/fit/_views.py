"""Views of points of a scene: how far the image is from where a camera would see them, robustly.

A point ahead of the camera, in its axes, is seen at ``p = f (x, y)/z``, and the point that was observed is
corrected to c. The residual in the image is ``J^-1 (c - p)``, where J is the derivative of the correction
at the observed point: one step of Newton's method for the inverse, exact to second order.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..models.distortion_model import AbstractDistortionModel
from .losses import CAUCHY, IGNORED

MEDIAN_OF_SIZE = 1.1774
"""Of the length of a vector of two normal numbers."""

EXACT = 1e-6
"""px: the least noise, of points without any."""

FAR = IGNORED * CAUCHY
"""Of the noise: beyond, the loss nearly ignores a view."""

_QUARTER = 1.5522
"""Of the length of a vector of two normal numbers: its median over its lower quartile."""

_ROUNDS = 8

_TIE = 1e-9
"""Of a sum of weights: what is nearer to a half than rounding may be is a half."""


def corrected(
    point: Float[Array, "2"],
    coefficients: Float[Array, "terms"],
    offset: Float[Array, "2"],
    distortion_model: AbstractDistortionModel,
    scale: float,
) -> Float[Array, "2"]:
    """A point corrected, px about the centre of distortion, which is the principal point, too."""
    z = point / scale - offset
    return scale * jnp.stack(distortion_model.correct((z[0], z[1]), z @ z, coefficients))


def view_residual(
    point: Float[Array, "2"],
    focal: Float[Array, ""],
    coefficients: Float[Array, "terms"],
    offset: Float[Array, "2"],
    ahead: Float[Array, "3"],
    distortion_model: AbstractDistortionModel,
    scale: float,
) -> Float[Array, "2"]:
    """The residual of one view, px of the image."""

    def straight(point):
        return corrected(point, coefficients, offset, distortion_model, scale)

    depth = jnp.where(ahead[2] > 0.05, ahead[2], 0.05)
    missed = straight(point) - focal * ahead[:2] / depth
    (a, b), (c, d) = jax.jacfwd(straight)(point)
    determinant = a * d - b * c
    determinant = jnp.where(determinant > 0.05, determinant, 0.05)
    return jnp.stack([d * missed[0] - b * missed[1], a * missed[1] - c * missed[0]]) / determinant


def product(matrix: Float[Array, "3 3"], vector: Float[Array, "3"]) -> Float[Array, "3"]:
    """A matrix times a vector, as a sum that XLA fuses with what uses it."""
    x, y, z = (matrix[:, column] * vector[column] for column in range(3))
    return x + y + z


def flattened(squared: Float[Array, "*some"]) -> Float[Array, "*some"]:
    """The root of ``log(1 + s)/s``: what residuals of square s are multiplied by for a Cauchy loss."""
    safe = jnp.where(squared > 1e-8, squared, 1.0)
    return jnp.where(squared > 1e-8, jnp.sqrt(jnp.log1p(safe) / safe), 1 - squared / 4)


def core_median(
    size: Float[Array, "*some"],
    there: Bool[Array, "*some"],
    weight: Float[Array, "*some"] | None = None,
) -> Float[Array, ""]:
    """The median of the sizes of residuals that are no mistakes; NaN if none is there.

    More than half of all points may be on things that move, and then the median of all is none of the
    noise. So it begins with the lower quartile, and goes on with the median of those that the loss counts.
    With weights both are of these: what hardly weighs hardly moves them.
    """
    if weight is not None:
        return _weighted_core_median(size, there, weight)
    ordered = jnp.sort(jnp.where(there, size, jnp.inf).ravel())
    number = jnp.sum(there)

    def median_of_first(count):
        below, above = (jnp.maximum(count - 1, 0) // 2, jnp.maximum(count, 1) // 2)
        return (ordered[below] + ordered[jnp.minimum(above, jnp.maximum(count, 1) - 1)]) / 2

    def again(median, _):
        limit = jnp.maximum(FAR / MEDIAN_OF_SIZE * median, EXACT)
        return median_of_first(jnp.searchsorted(ordered, limit, side="right")), None

    start = _QUARTER * ordered[number // 4]
    median, _ = jax.lax.scan(again, start, None, length=_ROUNDS)
    return jnp.where(number > 0, median, jnp.nan)


def _weighted_core_median(size, there, weight):
    """That of weights; equal ones give what none do."""
    size = jnp.where(there, size, jnp.inf).ravel()
    order = jnp.argsort(size)
    ordered, total = size[order], jnp.cumsum(jnp.where(there, weight, 0).ravel()[order])

    def at(share):
        return ordered[jnp.minimum(jnp.searchsorted(total, share), len(ordered) - 1)]

    def median_of_first(count):
        half = total[jnp.maximum(count - 1, 0)] / 2
        return (at(half * (1 - _TIE)) + at(half * (1 + _TIE))) / 2

    def again(median, _):
        limit = jnp.maximum(FAR / MEDIAN_OF_SIZE * median, EXACT)
        return median_of_first(jnp.searchsorted(ordered, limit, side="right")), None

    start = _QUARTER * at(total[-1] / 4 * (1 + _TIE))
    median, _ = jax.lax.scan(again, start, None, length=_ROUNDS)
    return jnp.where(total[-1] > 0, median, jnp.nan)
