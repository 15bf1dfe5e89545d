"""Distortion of one frame: the paper's L (eq. 1-2), its inverse, and where the inverse exists.

With ``z = (x - c)/s`` the corrected point is ``c + s F(z)``. F is given by the distortion model, by default

    F(z) = z L(t),  L(t) = 1 + k1 t + k2 t^2 + ... + kN t^N,  t = z.z.

This module handles px, arrays of points and dtypes; formulas and inverses are in `distortion_model`.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._core.arrays import aligned, apart, finite, in_blocks, interleaved, namespace, once, together
from .._core.fields import host_numbers
from .._core.programs import optimised_program
from .._core.spread import spread
from .._core.types import AnyArray, Elements, Points, traced
from ._arguments import as_points, check_distortion
from .distortion_model import AbstractDistortionModel, AbstractRadial, Pair
from .polynomial import RadialPolynomial


class Distortion(eqx.Module):
    """Distortion of one frame (eq. 1-2) or of several frames, by default radial.

    ``undistort`` maps distorted to corrected points, the paper's L; ``distort`` is its inverse. Points
    are ``(x, y)`` px with (0, 0) at the centre of the top-left pixel, in arrays of any leading shape.

    NumPy arrays and lists give NumPy arrays, computed without compilation; JAX arrays give JAX arrays.
    Results have the points' dtype; integers give float64, half precision (which has steps of 0.5 px at
    1,000) gives float32.

    Several distortions in one, as from ``lens([24, 35, 50])``, have leading axes. Points then begin with
    the same axes: ``points[0]`` belong to the first. A single point is used for all.

    Attributes:
        coefficients: (k1, ..., kN), or those of another distortion model, for radii in units of `scale`.
        centre: centre of distortion, px.
        scale: length in px that is radius 1: half the image diagonal, unless stated otherwise.
        distortion_model: the distortion model of the coefficients.

    Example:
        >>> d = Distortion([0.1, -0.02], [319.5, 239.5], 400.0)
        >>> d.undistort([639.0, 479.0]).round(2).tolist()
        [664.49, 498.11]
    """

    coefficients: Float[AnyArray, "*batch terms"] = eqx.field(converter=host_numbers("coefficients"))
    centre: Float[AnyArray, "... 2"] = eqx.field(converter=host_numbers("centre"))
    scale: Float[AnyArray, "..."] = eqx.field(converter=host_numbers("scale"))
    distortion_model: AbstractDistortionModel = RadialPolynomial()

    def __check_init__(self):
        """Check shapes, and values where they are known."""
        check_distortion(self.coefficients, self.centre, self.scale, self.distortion_model)

    @property
    def pixel_coefficients(self) -> Float[AnyArray, "*batch terms"]:
        """The coefficients in the paper's units, ``k_i / scale^(2i)``, px^(-2i); p1 and p2 in px^-1."""
        order = self.distortion_model.orders(self.coefficients.shape[-1])
        scale = namespace(self.scale).asarray(self.scale)[..., None]
        lengths, order, k = aligned((scale, 0), (order, 0), (self.coefficients, 0))
        return k / lengths**order

    @property
    def monotone_radius(self) -> Float[AnyArray, "*batch"]:
        """Distance in px from the centre at which the distortion begins to fold; inf if it never does.

        For `BrownConrady` a lower bound: the distortion is certain not to fold up to there.
        """
        radius = self.scale * _limit(self.distortion_model, self.coefficients)
        xp, k = namespace(radius, self.coefficients), self.coefficients
        return xp.asarray(xp.where(xp.isnan(k).any(axis=-1), np.nan, radius))

    def undistort(self, points: Points) -> Float[AnyArray, "*points 2"]:
        """Correct distorted `points` (eq. 1).

        Beyond `monotone_radius` the result is NaN: the formula folds the plane over there, and two points
        would have the same corrected position. Derivatives are zero there. `certify` proves that a lens
        has no such points in its images.
        """
        return self._mapped("undistort", points)

    def distort(self, points: Points) -> Float[AnyArray, "*points 2"]:
        """Distort corrected `points`: the exact inverse of `undistort`.

        Iterated until the residual is at the level of rounding errors. Where there is no inverse within the
        monotone radius the result is NaN, its derivatives are zero, and `has_inverse` is False; so it is of
        points so far away that powers of radii overflow. Elsewhere derivatives are given by the implicit
        function theorem.
        """
        return self._mapped("distort", points)

    def has_inverse(self, points: Points) -> Bool[AnyArray, "*points"]:
        """Whether corrected `points` have a distorted point within the monotone radius."""
        return finite(self.distort(points)[..., 0])

    def _mapped(self, method, points):
        points = as_points(points)
        batch = self.coefficients.ndim - 1
        if batch and points.ndim > 1:
            leading = self.coefficients.shape[:batch]
            if points.shape[:batch] != leading or points.ndim == batch:
                raise ValueError(
                    f"Argument points must begin with the axes {leading} of the distortions, a set of "
                    f"points for each, but its shape is {points.shape}. ZoomLens.undistort(points, focal) "
                    "broadcasts both."
                )
        between = max(points.ndim - 1 - batch, 0)

        def spread(leaf, own):
            return leaf.reshape(*leaf.shape[:batch], *[1] * between, *leaf.shape[batch:]) if own else leaf

        k, centre, scale = (
            spread(leaf, leaf.ndim > own)
            for leaf, own in ((self.coefficients, 1), (self.centre, 1), (self.scale, 0))
        )
        return mapped(method, self.distortion_model, points, k, centre, scale)


def mapped(
    method: str, distortion_model: AbstractDistortionModel, points: Any, k: Any, centre: Any, scale: Any
) -> Any:
    """``undistort`` or ``distort`` for points and distortions that broadcast.

    In NumPy where everything is known and the points are NumPy's, else compiled.
    """
    if isinstance(points, np.ndarray) and not traced((k, centre, scale)):
        with np.errstate(all="ignore"):  # NaN and inf are answers
            # With one more axis, as NumPy makes plain numbers of arrays without any.
            leaves = ((points, 1), (np.asarray(k), 1), (np.asarray(centre), 1), (np.asarray(scale), 0))
            points, *distortion = (leaf[None] for leaf in aligned(*leaves))
            if method == "undistort":
                return _undistorted(points, distortion_model, *distortion)[0]
            at = _normal(_apart(points), *distortion, spreading=False)
            return together(
                *at.in_pixels(distortion_model.distort(at.z, at.k, distortion_model.monotone_radius(at.k)))
            )[0]
    return compiled(method, _given, jnp.asarray(points), (distortion_model, k, centre, scale))


@optimised_program
def compiled(
    method: str, distortion_of: Callable[[Any], Any], points: Float[Array, "... 2"], operands: Any
) -> Float[Array, "... 2"]:
    """``undistort`` or ``distort`` in JAX, of what a function says that the distortion is.

    Args:
        method: which of them.
        distortion_of: the distortion model, coefficients, centre and scale that the operands make.
            `distort` calls it again where Newton's steps do not arrive: coefficients of each point are then
            not kept in memory for the branch that is nearly never taken.
        points: px.
        operands: a pytree.
    """
    arrays, rest = eqx.partition(operands, eqx.is_array)
    function = _corrected if method == "undistort" else _distorted
    return function(lambda arrays: distortion_of(eqx.combine(arrays, rest)), points, arrays)


def _given(operands):
    distortion_model, *numbers = operands
    return distortion_model, *map(jnp.asarray, numbers)


class _Normal(NamedTuple):
    """Points and a distortion, aligned: each array broadcasts with the others.

    `own` are the coefficients in the shape of the distortion, `k` possibly in that of the points.
    """

    z: Pair
    k: Elements
    own: Elements
    centre: Pair
    scale: Any

    def in_pixels(self, z: Pair) -> Pair:
        """Normalised points in px."""
        return self.centre[0] + self.scale * z[0], self.centre[1] + self.scale * z[1]


def _normal(points, k, centre, scale, *, spreading=True) -> _Normal:
    """Of points (x, y) in px.

    If `spreading`, coefficients, centre and scale get the shape of the points: a gradient has then one sum
    over all points for each, all in one pass, and not one for each place where they are used. Without
    gradients it is better left: what depends on the distortion alone would be computed for each point.
    """
    leaves = ((points[0], 0), (points[1], 0), (k, 1), (centre, 1), (scale, 0))
    x, y, k, centre, scale = aligned(*((leaf.astype(points[0].dtype), own) for leaf, own in leaves))
    xp = namespace(k)
    own = xp.moveaxis(k, -1, 0)
    cx, cy = centre[..., 0], centre[..., 1]
    if not spreading:
        return _Normal(((x - cx) / scale, (y - cy) / scale), own, own, (cx, cy), scale)
    # JAX's know of symbolic shapes, for `jax.export`; and NumPy's do not wait for JAX.
    broadcast_shapes = (jnp if xp is jnp else np).broadcast_shapes
    shape = broadcast_shapes(x.shape, k.shape[:-1], centre.shape[:-1], scale.shape)
    cx, cy, scale, *k = spread([cx, cy, scale, *own], shape)
    z = (x - cx) / scale, (y - cy) / scale
    return _Normal(z, xp.stack(k) if k else xp.zeros((0, *shape), x.dtype), own, (cx, cy), scale)


def _apart(points):
    return points[..., 0], points[..., 1]


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _corrected(distortion_of, points, operands):
    """Corrected points; NaN, with derivatives of zero, beyond the monotone radius."""
    return _undistorted(points, *distortion_of(operands))


@_corrected.defjvp
def _corrected_jvp(distortion_of, primals, tangents):
    """Of c + s F(z), s z = x - c.

    Where there is no value slopes are those at the centre: a NaN, times a cotangent of zero, is NaN.
    The value is that of the same function: under vmap it must have its batch axis at the same place.
    """
    distortion_model = distortion_of(primals[1])[0]

    def normal(points, operands):
        at = _normal(_apart(points), *distortion_of(operands)[1:])
        return at.z, at.k, at.centre, at.scale

    (z, k, _, scale), (_, k_dot, centre_dot, scale_dot) = jax.jvp(normal, primals, tangents)
    at = _normal(_apart(primals[0]), *distortion_of(primals[1])[1:], spreading=False)
    squared, own = _constant(z[0] * z[0] + z[1] * z[1]), _constant(at.own)
    within = distortion_model.within(squared, own, digits=4) & (squared < np.inf)
    for coefficient in apart(own):
        within = within & jnp.isfinite(coefficient)
    x, y = (jnp.where(within, side, 0) for side in z)
    squared = x * x + y * y
    away = tuple(tangents[0][..., i] - centre_dot[i] for i in (0, 1))
    if isinstance(distortion_model, AbstractRadial):
        along = jnp.where(within, x * away[0] + y * away[1] - squared * scale_dot, 0)
        factor, bent = jax.jvp(distortion_model.factor, (squared, k), (2 * along, scale[None] * k_dot))
        within = within & (factor >= 0)
        factor = jnp.where(within, factor, 0)
        moved = factor * away[0] + x * bent, factor * away[1] + y * bent
    else:
        z_dot = (jnp.where(within, away[i] - (x, y)[i] * scale_dot, 0) for i in (0, 1))
        new, bent = jax.jvp(
            lambda x, y, k: distortion_model.correct((x, y), x * x + y * y, k),
            (x, y, k),
            (*z_dot, scale[None] * k_dot),
        )
        within = within & (x * new[0] + y * new[1] >= 0)
        moved = tuple(jnp.where(within, scale_dot * new[i] + bent[i], 0) for i in (0, 1))
    here = within.astype(x.dtype)
    moved = together(here * centre_dot[0] + moved[0], here * centre_dot[1] + moved[1])
    return _corrected(distortion_of, *primals), moved


def _undistorted(points, distortion_model, k, centre, scale):
    """Corrected points; NaN beyond the monotone radius."""
    at = _normal(_apart(points), k, centre, scale, spreading=False)
    xp, (x, y) = namespace(at.k), at.z
    squared = x * x + y * y
    within = distortion_model.within(squared, at.own, digits=4)
    if isinstance(distortion_model, AbstractRadial):
        factor = distortion_model.factor(squared, at.k)
        factor = once(xp.where(within & (factor >= 0), factor, np.nan))
        return interleaved(*at.in_pixels((x * factor, y * factor)))
    new_x, new_y = distortion_model.correct(at.z, squared, at.k)
    # An invertible correction is monotone, and never goes to the other side; at a pole rounding does.
    within = within & (x * new_x + y * new_y >= 0)
    return interleaved(*at.in_pixels((xp.where(within, new_x, np.nan), xp.where(within, new_y, np.nan))))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _distorted(distortion_of, points, operands):
    """Distorted points; NaN, with derivatives of zero, where there is no inverse.

    So ``where(has_inverse, distort, 0)`` has derivatives. At the fold itself they would be infinite, and
    are 1/eps of the dtype at most.
    """

    distortion_model, *distortion = distortion_of(operands)
    at = _normal(_apart(points), *distortion, spreading=False)
    if isinstance(distortion_model, AbstractRadial):
        q = _ratio(distortion_of, points, operands)
        return interleaved(*at.in_pixels((at.z[0] * q, at.z[1] * q)))
    return interleaved(
        *at.in_pixels(distortion_model.distort(at.z, at.k, distortion_model.monotone_radius(at.k)))
    )


def _ratio(distortion_of, points, operands):
    """The distorted radii over the corrected ones; NaN where there is no inverse.

    Newton's steps alone nearly always arrive. The rest is in a branch, and in blocks: what a program may
    need is taken from the system in each call where it is more than some 30 MB, whether it is used or not.
    Under vmap all branches are taken, and the loops in them end at once where all have arrived.
    """

    def normal():
        distortion_model, *distortion = distortion_of(operands)
        at = _normal(_apart(points), *distortion, spreading=False)
        return distortion_model, at.z[0] * at.z[0] + at.z[1] * at.z[1], at.k

    def certain():
        distortion_model, squared, k = normal()
        return in_blocks(partial(_settled, distortion_model), quick, squared, k)

    distortion_model, squared, k = normal()
    quick, arrived = distortion_model.quick_ratio(squared, k)
    quick = once(jnp.where(arrived, quick, jnp.nan))
    return jax.lax.cond(jnp.any(jnp.isnan(quick)), certain, lambda: quick)


def _settled(distortion_model, quick, squared, k):
    """Ratios of which those that are NaN are found for certain, if there are such."""

    def certain():
        q, found = distortion_model.ratio(squared, k, monotone_radius)
        return jnp.where(found, q, jnp.nan)

    monotone_radius = distortion_model.monotone_radius(k)
    settled = ~jnp.isnan(quick) | ~distortion_model.reaches(squared, k, monotone_radius)
    return jax.lax.cond(jnp.all(settled), lambda: quick, certain)


@_distorted.defjvp
def _distorted_jvp(distortion_of, primals, tangents):
    """By the implicit function theorem, whatever the iterations: F(z, k) = y, for normalised points.

    What brings them to their units and back is linear in them, and simpler so than as part of F.
    """
    w = _distorted(distortion_of, *primals)
    exists = jnp.isfinite(w[..., 0])

    def normal(points, operands):
        _, k, centre, scale = distortion_of(operands)
        kept, middle = aligned((exists, 0), (_constant(centre).astype(points.dtype), 1))
        points = tuple(jnp.where(kept, points[..., i], middle[..., i]) for i in (0, 1))
        at = _normal(points, jnp.where(jnp.isfinite(k), k, 0), centre, scale)
        return at.z, at.k, at.centre, at.scale

    distortion_model = distortion_of(primals[1])[0]
    (_, k, centre, scale), (y_dot, k_dot, centre_dot, scale_dot) = jax.jvp(normal, primals, tangents)
    z = tuple(jnp.where(exists, (w[..., i] - centre[i]) / scale, 0) for i in (0, 1))
    z, far = distortion_model.before_pole(z, k)
    y_dot = tuple(jnp.where(far, 0, side) for side in y_dot)
    squared = z[0] * z[0] + z[1] * z[1]
    # dF/dz dz = dy - dF/dk dk.
    by_k = jax.jvp(lambda k: distortion_model.correct(z, squared, k), (k,), (k_dot,))[1]
    moved, determinant = _solved(distortion_model, z, squared, k, (y_dot[0] - by_k[0], y_dot[1] - by_k[1]))
    weight = 1 / jnp.maximum(determinant, jnp.finfo(w.dtype).eps)
    return w, together(
        *(
            jnp.where(exists, centre_dot[i] + scale_dot * z[i] + scale * weight * moved[i], 0)
            for i in (0, 1)
        ),
    )


def _solved(distortion_model, z, squared, k, r):
    """The adjugate of ``dF/dz`` times r, and its determinant."""
    one, zero = jnp.ones_like(squared), jnp.zeros_like(squared)
    if isinstance(distortion_model, AbstractRadial):  # dF/dz = L + 2 L' z z^T
        factor, bend = jax.jvp(lambda t: distortion_model.factor(t, k), (squared,), (2 * one,))
        slope, along = factor + squared * bend, bend * (z[0] * r[0] + z[1] * r[1])
        return (slope * r[0] - along * z[0], slope * r[1] - along * z[1]), factor * slope

    def moved(*z):
        return distortion_model.correct(z, z[0] * z[0] + z[1] * z[1], k)

    def column(*direction):
        return jax.jvp(moved, z, direction)[1]

    (ax, ay), (bx, by) = column(one, zero), column(zero, one)
    return (by * r[0] - bx * r[1], ax * r[1] - ay * r[0]), ax * by - ay * bx


def _constant(array):
    """For derivatives."""
    return jax.lax.stop_gradient(array) if isinstance(array, jax.Array) else array


def _limit(distortion_model, k):
    if isinstance(k, np.ndarray):
        with np.errstate(all="ignore"):
            return distortion_model.monotone_radius(np.moveaxis(k[None], -1, 0))[0]
    return distortion_model.monotone_radius(_constant(jnp.moveaxis(k, -1, 0)))
