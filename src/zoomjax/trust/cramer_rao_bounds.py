"""The Cramer-Rao bound: the smallest possible covariance of a lens estimated from given lines.

A point is seen at ``y = y0 + e``, e normal with a standard deviation of s px in x and in y. The true
point y0 is anywhere on the curve that the lens makes of a straight line, ``F = n . U(y0) - c = 0``, where
U is the correction, n = (-sin a, cos a) the line's normal and c its offset. Where on the curve is unknown,
so that of the point only the error across the curve tells anything. A change of F by dF moves the curve
by ``-dF / |grad F|`` across itself, and ``grad F = J^T n`` with the Jacobian J of U. A point's derivatives
by the model's parameters p, and by a and c, are therefore

    (n . dU/dp,  -t . U,  -1) / (s |J^T n|),        t the line's direction,

and the Fisher information is their sum of squares over points. A line's own a and c are eliminated by the
part of its column of derivatives that is orthogonal to theirs (the Schur complement). The inverse of the
sum over lines bounds the covariance of every unbiased estimate (Kay, Fundamentals of Statistical Signal
Processing I, 1993, section 3.7; for curves through noisy points, Chernov and Lesort 2004).

One Jacobian a point, once; nothing is fitted.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, ScalarLike

from .._core.arguments import kinds_checked
from .._core.fields import real_argument
from .._core.programs import light_program
from .._core.types import AnyArray, traced
from ..fit.same_camera import check_camera
from ..lines.best_line import line_normal
from ..lines.lines import Lines
from ..models.camera import px_of_focal_px
from ..models.lens import ZoomLens
from ..models.requirements import check
from ..models.sizes import at_focal
from ..models.zoom import with_parameters

_NODES = 8  # of Gauss and Legendre, along x, y and 1/f: exact where the square has a degree of at most 15


@kinds_checked
def cramer_rao(
    lens: ZoomLens, lines: Lines, *, std: Float[AnyArray, "line"] | ScalarLike
) -> Float[Array, "parameter parameter"]:
    """Cramer-Rao bound on the covariance of the zoom model's parameters, for any unbiased estimate.

    Args:
        lens: the true lens. Its centre is assumed to be known.
        lines: points without noise that this lens makes straight; see `scenes.board_lines`. Weights of
            lines are ignored.
        std: standard deviation, px, of the error of each coordinate of each point: one number for all
            lines, or one per line. Errors are normal and independent.

    Returns:
        The covariance of the flattened parameters, in the order of `ZoomFit.covariance`. Its diagonal is
        infinite if the lines do not determine them, or the lens folds at one of their points.

    Raises:
        ValueError: `std` is not positive and finite, or not one number or one a line; or the lines are from
            images of another size, or have focal lengths in another unit.

    Warns:
        UserWarning: lines at focal lengths outside of the range of the lens, which is extrapolated to them.

    Example:
        >>> from zoomjax import scenes
        >>> lens, focal = scenes.nikkor_18_200(), scenes.focal_sweep(3)
        >>> cramer_rao(lens, scenes.board_lines(lens, focal, spacing=99.0), std=0.5).shape
        (6, 6)
    """
    std = _checked(lens, lines, std)
    return _cramer_rao(lens, lines, std)


@light_program
def _cramer_rao(lens, lines, std):
    std = jnp.broadcast_to(jnp.asarray(std, lens.centre.dtype), lines.frame.shape)
    std = jnp.where(std > 0, std, jnp.nan)  # where it could not be checked: nothing is known
    focal = jnp.asarray(lines.focal)[lines.frame]
    each = (jnp.asarray(lines.points), lines.mask, focal, std)
    rows, most = jax.lax.map(lambda line: _derivatives(lens, *line), each, batch_size=64)
    # The triangle of the derivatives, not their squares: float32 has no room for the condition of those.
    triangle = jnp.linalg.qr(rows.reshape(-1, rows.shape[-1]), mode="r")
    size = jnp.linalg.norm(triangle, axis=0)
    eps = 64 * jnp.finfo(size.dtype).eps
    told = size > eps * jnp.sqrt(jnp.sum(most, axis=0))  # else rounding errors dominate
    size = jnp.where(told, size, 1)
    _, values, right = jnp.linalg.svd(triangle / size[None])
    determined = jnp.all(told) & (values[-1] > eps)
    root = right.T / jnp.where(determined, values, 1)[None] / size[:, None]
    unknown = jnp.diag(jnp.full_like(size, jnp.inf))
    return jnp.where(determined, root @ root.T, unknown)


@kinds_checked
def displacement_bound(
    lens: ZoomLens, lines: Lines, *, std: Float[AnyArray, "line"] | ScalarLike
) -> Float[Array, ""]:
    """Cramer-Rao lower bound on the RMS error of a fitted lens's displacements, px.

    The mean is over noise, image and focal range, as in `displacement_rms`, which computes the actual
    error.

    Args:
        lens, lines, std: as for `cramer_rao`, whose errors also apply.

    Returns:
        The bound; infinite where the lines do not determine the lens.

    Example:
        >>> from zoomjax import scenes
        >>> lens, focal = scenes.nikkor_18_200(), scenes.focal_sweep(3)
        >>> lines = scenes.board_lines(lens, focal, spacing=99.0)
        >>> bool(displacement_bound(lens, lines, std=0.5) < 0.3)
        True
    """
    std = _checked(lens, lines, std)
    return _displacement_bound(lens, lines, std)


@light_program
def _displacement_bound(lens, lines, std):
    flat, unravel = ravel_pytree(lens.zoom.parameters)
    points, focal, weight = _field(lens)

    def derivatives(f):
        return jax.jacfwd(lambda flat: _with(lens, unravel(flat))(f).undistort(points))(flat)

    rows = jax.vmap(derivatives)(focal)
    squared = jnp.einsum("fncp,fncq,fn->pq", rows, rows, weight)
    covariance = _cramer_rao(lens, lines, std)
    determined = jnp.all(jnp.isfinite(covariance))
    return jnp.sqrt(jnp.where(determined, jnp.sum(jnp.where(determined, covariance, 0) * squared), jnp.inf))


@kinds_checked
def displacement_rms(lens: ZoomLens, other: ZoomLens) -> Float[Array, ""]:
    """RMS distance between the corrections of two lenses, px, over image and focal range.

    The mean is over the first lens's image and over its focal range, uniform in 1/f. It is computed by
    Gauss-Legendre quadrature, exact for polynomials in 1/f of degree up to 7 with up to 3 terms.

    Raises:
        ValueError: the lenses are for images of different sizes, or their focal lengths have different
            units, or are px of images of different sizes.

    Example:
        >>> from zoomjax import scenes
        >>> lens = scenes.nikkor_18_200()
        >>> float(displacement_rms(lens, lens))
        0.0
    """
    for name in ("image_size", "focal_unit"):
        own, others = getattr(lens, name), getattr(other, name)
        if own != others:
            raise ValueError(
                f"Argument other must have the {name} of the first lens, {own}, but it has {others}."
                + (" lens_for_size gives a lens for another size." if name == "image_size" else "")
            )
    if lens.focal_unit == "px" and px_of_focal_px(lens) != px_of_focal_px(other):
        raise ValueError(
            "Argument other must have focal lengths in px of the same images, but one of the lenses was "
            "scaled by lens_for_size, which leaves them as they were: scale both, or none."
        )
    return _displacement_rms(lens, other)


@light_program
def _displacement_rms(lens, other):
    points, focal, weight = _field(lens)
    apart = jax.vmap(lambda f: at_focal(lens, f).undistort(points) - at_focal(other, f).undistort(points))(
        focal
    )
    return jnp.sqrt(jnp.sum(weight * jnp.sum(apart**2, axis=-1)))


def _checked(lens, lines, std):
    """Standard deviations of points, positive and finite, of lines that are the lens's."""
    check_camera(lens, lines)
    check("cramer_rao", zoom=lens.zoom)
    lens.check_range(lines.focal, stacklevel=4)
    std = jnp.asarray(real_argument("std", std))
    if std.shape not in ((), lines.frame.shape):
        raise ValueError(
            f"Argument std must hold one number, or one for each of the {lines.frame.shape[0]} lines, but "
            f"its shape is {std.shape}."
        )
    if not traced(std) and not (np.isfinite(std) & (np.asarray(std) > 0)).all():
        raise ValueError(f"Argument std must hold finite positive numbers, but it is {std}.")
    return std


def _with(lens, parameters):
    return eqx.tree_at(lambda lens: lens.zoom, lens, with_parameters(lens.zoom, parameters))


def _field(lens):
    """Points all over the image, focal lengths all over the range, and weights of the pairs, of sum 1."""
    nodes, weight = np.polynomial.legendre.leggauss(_NODES)
    share, weight = (1 + nodes) / 2, weight / 2
    dtype = jnp.asarray(lens.centre).dtype
    x, y = (jnp.asarray(side * share - 0.5, dtype) for side in lens.image_size)
    low, high = 1 / jnp.asarray(lens.focal_range, dtype)[::-1]
    points = jnp.stack(jnp.meshgrid(x, y), axis=-1).reshape(-1, 2)
    over_image = (weight[:, None] * weight).reshape(-1)
    weights = jnp.asarray(weight[:, None] * over_image, dtype)
    return points, 1 / (low + (high - low) * jnp.asarray(share, dtype)), weights


def _derivatives(lens, points, mask, focal, std):
    """A line's derivatives by the model's parameters, its angle and offset being unknown, a row a point.

    And for scale the squares, summed, of all that the parameters move, also along the line.
    """
    flat, unravel = ravel_pytree(lens.zoom.parameters)

    def corrected(flat, point):
        return at_focal(_with(lens, unravel(flat)), focal).undistort(point)

    there = mask.astype(points.dtype)
    seen = jnp.where(mask[:, None], points, lens.centre)
    position = jax.vmap(corrected, (None, 0))(flat, seen)
    middle = there @ position / jnp.maximum(jnp.sum(there), 1)
    centred = there[:, None] * (position - middle[None])
    normal = line_normal(centred)
    across = jax.vmap(lambda point: normal @ jax.jacfwd(corrected, 1)(flat, point))(seen)
    of_points = there / (std * jnp.linalg.norm(across, axis=1))
    moved = jax.vmap(lambda point: jax.jacfwd(corrected)(flat, point))(seen) * of_points[:, None, None]
    rows = jnp.einsum("c,pcq->pq", normal, moved)
    along = centred @ jnp.stack([normal[1], -normal[0]])
    # One after the other, made orthogonal, for that loses the fewest digits.
    own = _unit(of_points)
    rows = rows - jnp.outer(own, own @ rows)
    turned = along * of_points
    own = _unit(turned - own * (own @ turned))
    rows = rows - jnp.outer(own, own @ rows)
    return rows, jnp.sum(moved**2, axis=(0, 1))


def _unit(column):
    """A column of length 1, or of zeros."""
    squared = column @ column
    return column / jnp.sqrt(jnp.where(squared > 0, squared, 1))
