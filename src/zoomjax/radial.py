"""Distortion of one frame: the paper's L (eq. 1-2), its inverse, and where that exists.

With ``z = (x - c)/s`` the corrected point is ``c + s F(z)``: F is the family's (`families`), by default

    F(z) = z L(t),  L(t) = 1 + k1 t + k2 t^2 + ... + kN t^N,  t = z.z.

Here are lengths in px, arrays of points and dtypes; formulas and inverses are there.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ._types import Coefficients, Point, Points, Scalar
from .families import AbstractFamily, RadialPolynomial


class Distortion(eqx.Module):
    """Distortion of one frame (eq. 1-2), radial unless its family says otherwise.

    ``undistort`` maps distorted to corrected points, the paper's L; ``distort`` is its inverse. Points
    are ``(x, y)`` px with (0, 0) at the centre of the top-left pixel, in arrays of any leading shape;
    results have the points' dtype.

    Attributes:
        coefficients: (k1, ..., kN), or those of another family, for radii in units of `scale`.
        centre: centre of distortion, px.
        scale: length in px that is radius 1: half the image diagonal, unless stated otherwise.
        family: what the coefficients mean.

    Example:
        >>> import jax.numpy as jnp
        >>> d = Distortion(jnp.array([0.1, -0.02]), jnp.array([319.5, 239.5]), jnp.array(400.0))
        >>> d.undistort(jnp.array([639.0, 479.0])).round(2).tolist()
        [664.48..., 498.10...]
    """

    coefficients: Coefficients
    centre: Point
    scale: Scalar
    family: AbstractFamily = RadialPolynomial()

    @property
    def pixel_coefficients(self) -> Coefficients:
        """The coefficients in the paper's units, ``k_i / scale^(2i)``, px^(-2i); p1 and p2 in px^-1."""
        order = jnp.asarray(self.family.orders(self.coefficients.shape[0]))
        return self.coefficients / self.scale**order

    @property
    def monotone_radius(self) -> Float[Array, ""]:
        """Distance in px from the centre at which the distorted image begins to fold; inf if never.

        For `BrownConrady` a bound of it: up to there it is certain not to.
        """
        return jnp.asarray(self.scale) * self.family.limit(self.coefficients)

    def undistort(self, points: Points) -> Float[Array, "*batch 2"]:
        """Corrected positions of distorted `points` (eq. 1).

        Beyond `monotone_radius` the result is NaN: there the formula folds the plane over, and two points
        would share one corrected position. `certify` proves that a lens has no such points in its images.
        """
        return _each(_undistort, "(c)->(c)", self, points)

    def distort(self, points: Points) -> Float[Array, "*batch 2"]:
        """Distorted positions of corrected `points`: the exact inverse of `undistort`.

        Where none exists within the monotone radius the result is NaN, and `has_inverse` is False.
        Derivatives are those of the implicit function theorem.
        """
        return _each(_distort, "(c)->(c)", self, points)

    def has_inverse(self, points: Points) -> Bool[Array, "*batch"]:
        """Whether corrected `points` are the image of a distorted point inside the monotone radius."""
        return _each(_has_inverse, "(c)->()", self, points)


@eqx.filter_jit
def _each(function, signature, distortion, points):
    """Apply a function of one point, normalised, to all of them, in the points' dtype."""
    points = jnp.asarray(points)
    if not jnp.issubdtype(points.dtype, jnp.floating):
        points = points.astype(jnp.result_type(float))
    if points.shape[-1:] != (2,):
        raise ValueError(f"Argument points must have shape (..., 2), but its shape is {points.shape}.")
    k, centre, scale = (
        jnp.asarray(leaf, points.dtype)
        for leaf in (distortion.coefficients, distortion.centre, distortion.scale)
    )
    centre = jnp.broadcast_to(centre, points.shape)
    family = distortion.family
    limit = family.limit(k)
    mapped = jnp.vectorize(lambda z: function(family, z, k, limit), signature=signature)(
        (points - centre) / scale
    )
    return mapped if mapped.ndim < points.ndim else centre + scale * mapped


def _undistort(family, z, k, limit):
    squared = z @ z
    # A few last digits beyond it are the same radius: what `distort` puts at the fold rounds to there.
    within = squared <= limit * limit * (1 + 8 * jnp.finfo(z.dtype).eps)
    return jnp.where(within, family.correct(z, squared, k), jnp.nan)


def _distort(family, z, k, limit):
    return family.distort(z, k, limit)


def _has_inverse(family, z, k, limit):
    return family.has_inverse(z, k, limit)
