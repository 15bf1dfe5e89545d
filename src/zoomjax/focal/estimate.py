"""Estimates of focal lengths with standard deviations; for a plane, from its homographies."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core.arrays import as_jax
from .._core.fields import booleans, check_finite, numbers
from .homography import matrix_of

_WEIGHINGS = 5
"""How often the two equations are weighted anew: their weights depend on w. The first 2 matter."""


class FocalEstimate(eqx.Module):
    """An estimate of a focal length with its standard deviation.

    Attributes:
        focal: the focal length, in the unit stated by the function; NaN if it is not determined.
        std: its standard deviation, same unit, propagated from the residuals, and for a homography also
            from its deviation from that of a camera; infinite if it is not determined. It does not include
            errors common to all points: a board that is not flat, remaining distortion, a wrong principal
            point.
        rms: root mean square distance, px, of the points from their positions, or from their lines, under
            the fitted plane.
    """

    focal: Float[Array, "*view"]
    std: Float[Array, "*view"]
    rms: Float[Array, "*view"]


def estimate_of(entries, root, squares, number, coordinates, length, counted=None):
    """From the homographies of views, with the sum of squares of all their points' distances.

    Each of the points has one or two coordinates that the homographies, of 8 unknowns each, should give.
    Lengths in the image are in units of length px. Views that are not `counted` have no part in it.
    """
    if counted is None:
        counted = jnp.ones(len(entries), bool)
    w, information, misfit = _inverse_square(entries, root, counted)
    # What one camera can see of the plane has 6 unknowns a view, and f.
    variance = (squares + misfit) / (coordinates * number - 6 * jnp.sum(counted) - 1)
    known = (w > 0) & (information > 0)
    w = jnp.where(known, w, 1)
    focal = length / jnp.sqrt(w)
    error = jnp.sqrt(variance / jnp.where(known, information, 1))
    return FocalEstimate(
        focal=jnp.where(known, focal, jnp.nan),
        std=jnp.where(known, focal / (2 * w) * error, jnp.inf),
        rms=jnp.sqrt(squares / number) * length,
    )


def _equations(entries):
    """The factors of w in Zhang's two equations, and what is added to them.

    Divided by what makes them the same for all multiples of the matrix: otherwise the choice of the entry
    that is 1, and with it of the plane's origin, would have a part in the weights.
    """
    h1, h2 = matrix_of(entries).T[:2]
    size = jnp.sum(h1[:2] ** 2 + h2[:2] ** 2)
    factor = jnp.stack([jnp.sum(h1[:2] * h2[:2]), jnp.sum(h1[:2] ** 2 - h2[:2] ** 2)])
    return factor / size, jnp.stack([h1[2] * h2[2], h1[2] ** 2 - h2[2] ** 2]) / size


def _inverse_square(entries, root, counted):
    """The generalised least-squares w of several views, for unit noise the inverse of its variance, and by
    how much the sum of squares would be larger if the homographies obeyed the equations exactly.
    """
    factor, constant = jax.vmap(_equations)(entries)  # (view, 2)
    factor, constant = (jnp.where(counted[:, None], of, 0) for of in (factor, constant))
    slopes = jax.vmap(jax.jacfwd(_equations))(entries)

    def solve(w):
        gradient = (w * slopes[0] + slopes[1]) @ root  # (view, 2, 8)
        spread = gradient @ gradient.swapaxes(1, 2)
        a, b, c = spread[:, 0, 0], spread[:, 0, 1], spread[:, 1, 1]
        weight = jnp.stack([c, -b, -b, a], axis=1).reshape(-1, 2, 2) / (a * c - b**2)[:, None, None]
        information = jnp.einsum("vi,vij,vj", factor, weight, factor)
        return -jnp.einsum("vi,vij,vj", factor, weight, constant) / information, information, weight

    w = -jnp.sum(factor * constant) / jnp.sum(factor**2)
    for _ in range(_WEIGHINGS - 1):
        w, *_ = solve(jnp.maximum(w, 0))
    w, information, weight = solve(jnp.maximum(w, 0))
    wrong = w * factor + constant
    return w, information, jnp.sum(wrong[:, :, None] * weight * wrong[:, None, :])


def as_points_of(name: str, points) -> jax.Array:
    """Points, or lists of them, as an array; ValueError if they hold something else."""
    return as_jax(numbers(name)(points))


def check_principal(principal) -> None:
    """One principal point, x and y; ValueError of anything else, which would be taken for both or all."""
    if np.shape(principal) != (2,):
        raise ValueError(
            f"Argument principal must be two numbers, x and y, px, but its shape is {np.shape(principal)}."
        )
    check_finite("principal", principal)


def as_mask(mask, shape: tuple[int, ...]) -> jax.Array:
    """Which points are valid, as an array of booleans; all if it is None."""
    mask = np.ones(shape, bool) if mask is None else booleans("mask")(mask)
    return as_jax(mask) if isinstance(mask, np.ndarray) else mask


def check_pairs(points: tuple[int, ...], plane: tuple[int, ...], *, fewest: int) -> None:
    """As many points in the image as on the plane, and enough of them, by the arrays' shapes."""
    if points != plane or len(plane) != 2 or plane[1] != 2 or plane[0] < fewest:
        raise ValueError(
            f"Points in the image and on the plane must be arrays (n, 2) of one shape, n >= {fewest}, but "
            f"their shapes are {points} and {plane}."
        )
