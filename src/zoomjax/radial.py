"""Radial distortion of one frame: the paper's L (eq. 1-2), its inverse, and where that exists.

With ``z = (x - c)/s`` and ``t = z.z``, the corrected point is ``c + s z L(t)``,

    L(t) = 1 + k1 t + k2 t^2 + ... + kN t^N.

The radius maps as ``r -> r L(r^2)``, whose derivative is ``1 + 3 k1 t + ... + (2N+1) kN t^N``. The
*monotone radius* is where that first vanishes; beyond it the image folds over and no inverse
exists. The inverse is iterated to convergence, per point, and differentiated by the implicit function
theorem.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ._types import Coefficients, Point, Points, Scalar


def radial_factor(squared_radius: Float[Array, "*batch"], k: Coefficients) -> Float[Array, "*batch"]:
    """L(t) of eq. 2 for normalised squared radii `t` and coefficients `k = (k1, ..., kN)`."""
    factor = jnp.zeros_like(squared_radius)
    for coefficient in k[::-1]:
        factor = (factor + coefficient) * squared_radius
    return 1 + factor


def radial_slope(squared_radius: Float[Array, "*batch"], k: Coefficients) -> Float[Array, "*batch"]:
    """The derivative of ``r L(r^2)`` with respect to r, at ``t = r^2``."""
    order = jnp.arange(1, k.shape[0] + 1, dtype=k.dtype)
    return radial_factor(squared_radius, (2 * order + 1) * k)


def _polynomial(coefficients: Float[Array, "n"], x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Evaluate ``sum_i coefficients[i] x^i`` (Horner)."""
    value = jnp.zeros_like(x)
    for coefficient in coefficients[::-1]:
        value = value * x + coefficient
    return value


def _first_root_in_unit_interval(coefficients: Float[Array, "n"]) -> Float[Array, ""]:
    """The smallest root in (0, 1] of a polynomial that is positive at 0, or inf.

    The roots of each derivative cut the interval into pieces on which the next one is monotone, so
    that bisection in each piece finds every sign change: exact for any degree, no eigenvalues (which
    JAX has on the CPU alone), a fixed amount of work set by the degree and the dtype.
    """
    dtype = coefficients.dtype
    steps = jnp.finfo(dtype).nmant + 3
    derivatives = [coefficients]
    while derivatives[-1].shape[0] > 2:
        c = derivatives[-1]
        derivatives.append(c[1:] * jnp.arange(1, c.shape[0], dtype=dtype))
    knots = jnp.asarray([0, 1], dtype)
    found = jnp.asarray([False])
    for c in reversed(derivatives):
        values = _polynomial(c, knots)
        # A zero inside counts as negative, so that a root on a knot is not lost; one at the end does not.
        positive = (values > 0).at[-1].set(values[-1] >= 0)
        found = positive[:-1] != positive[1:]

        def halve(_, bracket, c=c, falling=positive[:-1]):
            low, high = bracket
            middle = (low + high) / 2
            before_root = (_polynomial(c, middle) > 0) == falling
            return jnp.where(before_root, middle, low), jnp.where(before_root, high, middle)

        low, high = jax.lax.fori_loop(0, steps, halve, (knots[:-1], knots[1:]))
        # Where there is no root in a piece its right end stands in: a harmless extra knot.
        roots = jnp.where(found, (low + high) / 2, knots[1:])
        knots = jnp.concatenate([knots[:1], roots, knots[-1:]])
    return jnp.min(jnp.where(found, knots[1:-1], jnp.inf))


@jax.jit
def monotone_radius(k: Coefficients) -> Float[Array, ""]:
    """The normalised radius up to which ``r L(r^2)`` increases; inf if it does so everywhere.

    A constant for differentiation. For N = 1 it is ``1/sqrt(-3 k1)``, or inf for ``k1 >= 0``.
    """
    k = jax.lax.stop_gradient(jnp.asarray(k))
    order = jnp.arange(k.shape[0] + 1, dtype=k.dtype)
    slope = jnp.concatenate([jnp.ones(1, k.dtype), (2 * order[1:] + 1) * k])
    # Up to t = 2, and from t = 1 on as the reversed polynomial in 1/t = 1 - y, so that the search again
    # starts from its known end. They overlap, or rounding could hide a root at the seam from both.
    near, far = jax.vmap(_first_root_in_unit_interval)(jnp.stack([slope * 2**order, _reflect(slope[::-1])]))
    seen = far < 1 - 4096 * jnp.finfo(k.dtype).eps  # or 1/t is nothing but rounding
    far = jnp.where(seen, 1 / jnp.where(seen, 1 - far, 1), jnp.inf)
    return jnp.sqrt(jnp.where(jnp.isfinite(near), 2 * near, far))


def _reflect(coefficients: Float[Array, "n"]) -> Float[Array, "n"]:
    """The coefficients of ``p(1 - y)``, from those of ``p(x)``, both in increasing order."""
    reflected = jnp.zeros_like(coefficients)
    for coefficient in coefficients[::-1]:  # Horner, multiplying by (1 - y)
        shifted = jnp.concatenate([jnp.zeros(1, coefficients.dtype), reflected[:-1]])
        reflected = (reflected - shifted).at[0].add(coefficient)
    return reflected


@jax.custom_jvp
def inverse_radius(rho: Float[Array, ""], k: Coefficients, limit: Float[Array, ""]) -> Float[Array, ""]:
    """The r in [0, limit] with ``r L(r^2) = rho``, for one `rho` that has one.

    `limit` is the monotone radius of `k`, a constant for differentiation.

    Newton's method kept inside a bracket by bisection, until a step no longer changes r. Fixed
    counts of plain Newton or fixed-point steps, as elsewhere, are wrong by up to hundreds of pixels
    near a fold without a word. Outside its domain the result is an end of the bracket: callers mask.
    """
    eps = jnp.finfo(rho.dtype).eps

    def mapped(r):
        return r * radial_factor(r * r, k)

    def too_low(high):
        return (mapped(high) < rho) & jnp.isfinite(high)

    start = jnp.maximum(rho, 1)
    high = jax.lax.while_loop(lambda high: jnp.isinf(limit) & too_low(high), lambda high: 2 * high, start)
    high = jnp.where(jnp.isinf(limit), high, limit)

    def unfinished(state):
        _, _, _, change, count = state
        return (change > 0) & (count < 200)

    def step(state):
        r, low, high, _, count = state
        error = mapped(r) - rho
        low, high = jnp.where(error < 0, r, low), jnp.where(error < 0, high, r)
        slope = radial_slope(r * r, k)
        newton = r - error / jnp.where(slope > 0, slope, 1)
        inside = (slope > 0) & (newton >= low) & (newton <= high)
        new = jnp.where(inside, newton, (low + high) / 2)
        change = jnp.where(jnp.abs(new - r) <= 2 * eps * new, 0, jnp.abs(new - r))
        return new, low, high, change, count + 1

    first = jnp.minimum(rho, high)
    state = (first, jnp.zeros_like(rho), high, jnp.ones_like(rho), 0)
    return jax.lax.while_loop(unfinished, step, state)[0]


@inverse_radius.defjvp
def _inverse_radius_jvp(primals, tangents):
    rho, k, limit = primals
    rho_dot, k_dot, _ = tangents
    r = inverse_radius(rho, k, limit)
    t = r * r
    slope = radial_slope(t, k)
    # d(r L) = 0 along the solution: slope dr + r sum_i t^i dk_i = d rho. At the fold itself the
    # slope is zero and the derivative truly infinite.
    return r, (rho_dot - r * (radial_factor(t, k_dot) - 1)) / slope


class Distortion(eqx.Module):
    """Radial distortion of one frame (eq. 1-2).

    ``undistort`` maps distorted to corrected points, the paper's L; ``distort`` is its inverse. Points
    are ``(x, y)`` px with (0, 0) at the centre of the top-left pixel, in arrays of any leading shape;
    results have the points' dtype.

    Attributes:
        coefficients: (k1, ..., kN), for radii in units of `scale`.
        centre: centre of distortion, px.
        scale: length in px that is radius 1: half the image diagonal, unless stated otherwise.

    Example:
        >>> import jax.numpy as jnp
        >>> d = Distortion(jnp.array([0.1, -0.02]), jnp.array([319.5, 239.5]), jnp.array(400.0))
        >>> d.undistort(jnp.array([639.0, 479.0])).round(2).tolist()
        [664.48..., 498.10...]
    """

    coefficients: Coefficients
    centre: Point
    scale: Scalar

    @property
    def pixel_coefficients(self) -> Coefficients:
        """The coefficients in the paper's units, ``k_i / scale^(2i)``, px^(-2i)."""
        order = jnp.arange(1, self.coefficients.shape[0] + 1)
        return self.coefficients / self.scale ** (2 * order)

    @property
    def monotone_radius(self) -> Float[Array, ""]:
        """Distance in px from the centre at which the distorted image begins to fold; inf if never."""
        return self.scale * monotone_radius(self.coefficients)

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
    limit = monotone_radius(k)
    mapped = jnp.vectorize(lambda z: function(z, k, limit), signature=signature)((points - centre) / scale)
    return mapped if mapped.ndim < points.ndim else centre + scale * mapped


def _undistort(z, k, limit):
    squared = z @ z
    # A few last digits beyond it are the same radius: what `distort` puts at the fold rounds to there.
    within = squared <= limit * limit * (1 + 8 * jnp.finfo(z.dtype).eps)
    return jnp.where(within, z * radial_factor(squared, k), jnp.nan)


def _has_inverse(z, k, limit):
    finite = jnp.where(jnp.isinf(limit), 0, limit)
    # A few last digits beyond it are the same radius: `undistort` of a point at the fold rounds to there.
    reach = finite * radial_factor(finite * finite, k) * (1 + 8 * jnp.finfo(z.dtype).eps)
    squared = z @ z
    return (jnp.isinf(limit) & jnp.isfinite(squared)) | (squared <= reach * reach)


def _distort(z, k, limit):
    squared = z @ z
    exists = _has_inverse(z, k, limit)
    # Guard the input of the root and of the quotient, not their output: a where() on a NaN result
    # still has a NaN gradient.
    regular = exists & (squared > 0)
    rho = jnp.sqrt(jnp.where(regular, squared, 1))
    r = inverse_radius(jnp.where(regular, rho, 0), k, limit)
    return z * jnp.where(regular, r / rho, jnp.where(exists, 1, jnp.nan))
