"""Focal length from oblique views of a plane of known geometry.

Points must be corrected (`Distortion.undistort`), as from a lens without distortion.

The plane is seen obliquely, at an unknown distance. With the principal point known, the homography
``H = (h1 h2 h3)`` from the plane to the image relative to that point gives two equations for w = 1/f²
(Zhang 2000): with ω = diag(w, w, 1),

    h1ᵀ ω h2 = 0,    h1ᵀ ω h1 - h2ᵀ ω h2 = 0.

Each homography is fitted to its points' distances in the image, by iterations that start from the linear
solution. The covariance of its entries becomes that of the two equations, by whose inverse they are
weighted; w is the generalised least-squares solution. The closer a view is to frontal, the less it
determines f, and the larger is its standard deviation. This f is the distance from the centre of projection
to the image, in px: for a lens that is focused at a distance d, it is ``d / (d - f)`` times eq. 14's.

Lines of a plane, such as markings of a sports pitch, can be used without known positions of points along
them. The homography is fitted to the points' distances from the images of their lines.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Num

from .._core.products import exact_products
from .._core.programs import light_program
from .._core.types import AnyArray, traced
from .estimate import FocalEstimate, as_mask, as_points_of, check_pairs, check_principal, estimate_of
from .homography import homography, homography_from_lines


def focal_from_planes(
    points: Num[AnyArray, "view point 2"] | list,
    plane: Num[AnyArray, "point 2"] | Num[AnyArray, "view point 2"] | list,
    *,
    principal: Num[AnyArray, "2"] | list | tuple,
    mask: Bool[AnyArray, "view point"] | None = None,
) -> tuple[FocalEstimate, FocalEstimate]:
    """Estimate the focal length from oblique views of a known plane, by Zhang's two constraints.

    Args:
        points: corrected positions in the images, px, one or more views, all at the same zoom, of at
            least 5 points, no 3 of 4 of them on a line. One view is enough if it is oblique.
        plane: the same points on the plane, in any unit: its size and place do not matter. (point, 2), or
            (view, point, 2) if views show other points, of one plane or of several.
        principal: the principal point, px; the centre of distortion is the usual choice.
        mask: which points are valid; by default all. Views without valid points have no part in the
            result; all others need at least 5.

    Returns:
        The estimate from all views together, and those from each view alone, in px. A view that does not
        determine a positive 1/f², being square to the plane within its noise, has focal length NaN and
        an infinite standard deviation.

    Raises:
        ValueError: shapes differ, a view has fewer than 5 points, `mask` does not hold booleans, or
            `principal` is not one point.

    References:
        Z. Zhang, "A flexible new technique for camera calibration", IEEE PAMI 22 (2000), section 3.1.

    Example:
        >>> import numpy as np
        >>> plane = np.stack(np.meshgrid(np.arange(5.0), np.arange(4.0)), axis=-1).reshape(-1, 2)
        >>> tilted = np.stack([0.8 * plane[:, 0], plane[:, 1], 10 + 0.6 * plane[:, 0]])
        >>> image = 800 * (tilted[:2] / tilted[2]).T
        >>> together, each = focal_from_planes(image[None], plane, principal=np.zeros(2))
        >>> print(round(float(together.focal), 1), each.focal.shape)
        800.0 (1,)
    """
    points, plane = as_points_of("points", points), as_points_of("plane", plane)
    if points.ndim != 3 or not len(points):
        raise ValueError(
            "Argument points must have shape (view, point, 2), with a view at least, but its shape is "
            f"{points.shape}."
        )
    if plane.ndim == 3 and len(plane) == len(points):
        check_pairs(points.shape[1:], plane.shape[1:], fewest=5)
    else:
        check_pairs(points.shape[1:], plane.shape, fewest=5)
        plane = jnp.broadcast_to(plane, points.shape)
    mask, principal = as_mask(mask, points.shape[:2]), as_points_of("principal", principal)
    check_principal(principal)
    if mask.shape != points.shape[:2]:
        raise ValueError(
            f"Argument mask must have shape (view, point), here {points.shape[:2]}, but its shape is "
            f"{mask.shape}."
        )
    if not traced(mask):
        counts = np.sum(np.asarray(mask), axis=1)
        few = counts[(counts > 0) & (counts < 5)]
        if few.size:
            raise ValueError(
                f"Views in argument mask must have at least 5 valid points, or none, but one has {few[0]}."
            )
    return _focal_from_planes(points, plane, mask, principal)


def focal_from_lines(
    points: Num[AnyArray, "line point 2"] | list,
    lines: Num[AnyArray, "line 2 2"] | list,
    *,
    principal: Num[AnyArray, "2"] | list | tuple,
    mask: Bool[AnyArray, "line point"] | None = None,
) -> FocalEstimate:
    """Estimate the focal length from one oblique view of known lines of a plane, by Zhang's two
    constraints.

    Positions of points along their lines need not be known. Use `jax.vmap` for many similar pictures.

    Args:
        points: corrected positions in the image, px: for each line those that are seen on it.
        lines: for each line two points of it, on the plane, in any unit: its size and place do not matter,
            nor whether the two are seen.
        principal: the principal point, px; the centre of distortion is the usual choice.
        mask: which points are valid; by default all. A line may have none.

    Returns:
        The focal length in px. It is NaN, and its standard deviation infinite, if the view does not
        determine a homography, or not a positive 1/f², being square to the plane within its noise. A
        homography takes 4 lines with 2 points each, no 3 of the lines parallel or through one point.

    Raises:
        ValueError: shapes differ, `mask` does not hold booleans, or `principal` is not one point.

    References:
        Z. Zhang, "A flexible new technique for camera calibration", IEEE PAMI 22 (2000), section 3.1.

    Example:
        >>> import numpy as np
        >>> lines = np.array([[[0, 0], [5, 0]], [[0, 3], [5, 3]], [[0, 0], [0, 3]], [[5, 0], [5, 3.0]]])
        >>> along = np.array([0.1, 0.5, 0.8])[:, None]
        >>> x, y = np.moveaxis(lines[:, :1] + along * (lines[:, 1:] - lines[:, :1]), -1, 0)
        >>> image = 800 * np.stack([0.8 * x, y], axis=-1) / (10 + 0.6 * x)[..., None]
        >>> print(round(float(focal_from_lines(image, lines, principal=np.zeros(2)).focal), 1))
        800.0
    """
    points, lines = as_points_of("points", points), as_points_of("lines", lines)
    mask, principal = as_mask(mask, points.shape[:2]), as_points_of("principal", principal)
    check_principal(principal)
    if points.ndim != 3 or points.shape != (*mask.shape, 2) or lines.shape != (len(points), 2, 2):
        raise ValueError(
            "Arguments points, mask and lines must have shapes (line, point, 2), (line, point) and "
            f"(line, 2, 2), but their shapes are {points.shape}, {mask.shape} and {lines.shape}."
        )
    return _focal_from_lines(points, mask, lines, principal)


@light_program
@exact_products
def _focal_from_planes(points, plane, mask, principal):
    counted = jnp.any(mask, axis=1)
    # Beforehand: a NaN in a quotient would be one in all derivatives.
    points, plane = (jnp.where(mask[..., None], of, 0) for of in (points, plane))
    # Views without points see what any camera can: a circle, so that their homographies are harmless.
    angle = 2 * jnp.pi * jnp.arange(points.shape[1], dtype=points.dtype) / points.shape[1]
    circle = jnp.broadcast_to(jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1), points.shape)
    present = mask.astype(points.dtype)

    def centred(points):
        """About the mean of each view's valid points, and 0 in place of the others."""
        number = jnp.maximum(jnp.sum(present, axis=1), 1)[:, None, None]
        mean = jnp.sum(points, axis=1, keepdims=True) / number
        return jnp.where(mask[..., None], points - mean, 0)

    def size(centred, axes):
        number = jnp.sum(present, axis=axes, keepdims=True)[..., None]
        squares = jnp.sum(centred**2, axis=(*axes, 2), keepdims=True)
        return jnp.sqrt(jnp.where(squares > 0, squares, 1) / jnp.maximum(number, 1))

    # One length for all views: then w and the equations are of the order of 1 in each.
    length = size(centred(points), (0, 1))
    image = jnp.where(mask[..., None], (points - principal[None, None]) / length, 0)
    length = length[0, 0, 0]
    plane = centred(plane)
    plane = plane / size(plane, (1,))
    image, plane = (jnp.where(counted[:, None, None], of, circle) for of in (image, plane))
    present = jnp.where(counted[:, None], present, 1)
    entries, root, squares = jax.vmap(homography)(image, plane, present)
    squares = jnp.where(counted, squares, 0)
    number = jnp.sum(mask, axis=1)

    def estimate(entries, root, squares, number, counted):
        return estimate_of(entries, root, jnp.sum(squares), jnp.sum(number), 2, length, counted)

    views = (entries, root, squares, number, counted)
    each = jax.vmap(estimate)(*(of[:, None] for of in views))
    return estimate(*views), each


@light_program
@exact_products
def _focal_from_lines(points, mask, lines, principal):
    extra = max(0, 9 - mask.size)  # with as many rows as the table below has columns, or more
    present = jnp.pad(mask.ravel(), (0, extra))[:, None]
    image = jnp.pad(points.reshape(-1, 2), ((0, extra), (0, 0)))
    any_line = jnp.broadcast_to(jnp.eye(2, dtype=lines.dtype), (extra, 2, 2))
    ends = jnp.concatenate([jnp.repeat(lines, mask.shape[1], axis=0), any_line])
    number = jnp.sum(present)
    image = jnp.where(present, image - principal[None], 0)
    middle = jnp.sum(image, axis=0, keepdims=True) / number
    length = jnp.sqrt(jnp.sum(jnp.where(present, image - middle, 0) ** 2) / number)
    entries, root, squares = homography_from_lines(image / length, present.astype(image.dtype), ends)
    return estimate_of(entries[None], root[None], squares, number, 1, length)
