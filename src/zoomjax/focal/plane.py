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

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Bool, Num

from .._core.products import exact_products
from .._core.types import AnyArray
from ._homography import homography, homography_from_lines
from .estimate import FocalEstimate, as_points_of, check_pairs, estimate_of


def focal_from_planes(
    points: Num[AnyArray, "view point 2"] | list,
    plane: Num[AnyArray, "point 2"] | list,
    *,
    principal: Num[AnyArray, "2"] | list | tuple,
) -> tuple[FocalEstimate, FocalEstimate]:
    """Estimate the focal length from oblique views of a known plane, by Zhang's two constraints.

    Args:
        points: corrected positions in the images, px, one or more views, all at the same zoom, of at
            least 5 points, no 3 of 4 of them on a line. One view is enough if it is oblique.
        plane: the same points on the plane, in any unit: its size and place do not matter.
        principal: the principal point, px; the centre of distortion is the usual choice.

    Returns:
        The estimate from all views together, and those from each view alone, in px. A view that does not
        determine a positive 1/f², being square to the plane within its noise, has focal length NaN and
        an infinite standard deviation.

    Raises:
        ValueError: shapes differ, or there are fewer than 5 points.

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
    check_pairs(points[0], plane, fewest=5)
    return _focal_from_planes(points, plane, as_points_of("principal", principal))


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
        ValueError: shapes differ.

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
    if mask is None:
        mask = jnp.ones(points.shape[:2], bool)
    if points.ndim != 3 or points.shape != (*mask.shape, 2) or lines.shape != (len(points), 2, 2):
        raise ValueError(
            "Arguments points, mask and lines must have shapes (line, point, 2), (line, point) and "
            f"(line, 2, 2), but their shapes are {points.shape}, {mask.shape} and {lines.shape}."
        )
    return _focal_from_lines(points, jnp.asarray(mask), lines, as_points_of("principal", principal))


@eqx.filter_jit
@exact_products
def _focal_from_planes(points, plane, principal):
    image = points - principal[None, None]
    plane = plane - jnp.mean(plane, axis=0, keepdims=True)
    # One length for all views: then w and the equations are of the order of 1 in each.
    length = jnp.sqrt(jnp.mean(jnp.sum((points - jnp.mean(points, axis=1, keepdims=True)) ** 2, axis=-1)))
    plane = plane / jnp.sqrt(jnp.mean(jnp.sum(plane**2, axis=-1)))
    entries, root, squares = jax.vmap(homography, in_axes=(0, None))(image / length, plane)
    number = points.shape[1]

    def estimate(entries, root, squares):
        return estimate_of(entries, root, jnp.sum(squares), squares.size * number, 2, length)

    each = jax.vmap(estimate)(entries[:, None], root[:, None], squares[:, None])
    return estimate(entries, root, squares), each


@eqx.filter_jit
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
