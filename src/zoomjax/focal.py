"""Focal lengths from a plane of known geometry.

Three ways, for corrected points (`Distortion.undistort`): pictures of a lens without distortion.

A board parallel to the sensor, at a known distance d: the image is the board times a magnification, and
eq. 14 of the paper, ``f = d r_c / (R + r_c)``, gives the focal length of the thin lens, which is focused
at the board. Here r_c / R is the scale of the similarity that best maps the board's points to the image.

A plane seen obliquely, at no known distance: with the principal point known, the homography
``H = (h1 h2 h3)`` from the plane to the image relative to that point gives two equations for w = 1/f²
(Zhang 2000): with ω = diag(w, w, 1),

    h1ᵀ ω h2 = 0,    h1ᵀ ω h1 - h2ᵀ ω h2 = 0.

Each homography is fitted to its points' distances in the image, by iterations that start from the linear
solution. The covariance of its entries becomes that of the two equations, by whose inverse they are
weighted; w is the generalised least-squares solution. The closer a view is to squarely, the less it says
about f, and the larger is its standard deviation. This f is the distance from the centre of projection to
the image, in px: for a lens that is focused at a distance d, it is ``d / (d - f)`` times eq. 14's.

Known lines of a plane, of which points are seen that nobody can tell where on the line they are: markings
of a sports pitch. The homography brings the points p as close as it can to the images of their lines. The
image of the line through e1 and e2 is m = H e1 × H e2, and p is ``m·p / hypot(m1, m2)`` away from it.
It is linear in G = H⁻¹ but for its denominator: ``l·G p = 0`` for the line l = e1 × e2 is the linear start.
Then as above.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ._types import AnyArray, Scalar

_ITERATIONS = 20
"""Gauss-Newton steps for a homography, at most. From the linear start 3 or 4 reach rounding."""

_SINGULAR = 1000
"""Singular values below as many roundings of the largest one are zero: of a Jacobian of a homography."""

_WEIGHINGS = 5
"""How often the two equations are weighted anew: their weights depend on w. The first 2 matter."""


class FocalEstimate(eqx.Module):
    """A focal length and how well it is known.

    Attributes:
        focal: the focal length, in the unit that the function says; NaN if it is not determined.
        std: its standard deviation, same unit, propagated from the residuals, and of a homography also from
            how far it is from a camera's; infinite if it is not determined. It knows nothing of errors that
            points share: a board that is not flat, distortion that is left in, another principal point.
        rms: root mean square distance, px, of the points from where the fitted plane puts them, or from
            where it puts their lines.
    """

    focal: Float[Array, "*view"]
    std: Float[Array, "*view"]
    rms: Float[Array, "*view"]


def focal_from_board(
    points: Float[AnyArray, "point 2"],
    board: Float[AnyArray, "point 2"],
    *,
    distance: float | int | Scalar,
    pixel: float | int | Scalar,
) -> FocalEstimate:
    """The focal length from one picture of a board parallel to the sensor: eq. 14.

    Args:
        points: corrected positions in the image, px, at least 3.
        board: the same points on the board, mm, x to the right and y downwards as seen by the camera;
            it may be turned in its plane and moved.
        distance: from the projection plane to the board, mm, > 0: eq. 14's d.
        pixel: side of a pixel on the sensor, mm, > 0. 1 is for points measured in mm.

    Returns:
        The focal length in mm. Residuals count as independent errors of the points' coordinates; those of
        distance, pixel and board are not included: f changes by as many per cent as the distance.

    Raises:
        ValueError: shapes differ, or there are fewer than 3 points.
        RuntimeError: a length is not positive, or all points of the board are one.

    References:
        Eq. 14 of the paper.

    Example:
        >>> import numpy as np
        >>> board = 10 * np.stack(np.meshgrid(np.arange(5.0), np.arange(4.0)), axis=-1).reshape(-1, 2)
        >>> image = board * 50 / (1000 - 50) / 0.005 + 100
        >>> print(round(float(focal_from_board(image, board, distance=1000, pixel=0.005).focal), 3))
        50.0
    """
    _check_pairs(points, board, fewest=3)
    # A similarity is one complex factor: its absolute value is px in the image per mm on the board.
    seen, known = _complex(points), _complex(board)
    seen, known = seen - jnp.mean(seen), known - jnp.mean(known)
    spread = jnp.sum(abs(known) ** 2)
    positive = (jnp.asarray(distance) > 0) & (jnp.asarray(pixel) > 0) & (spread > 0)
    spread = eqx.error_if(
        spread,
        ~positive,
        "Arguments distance and pixel must be positive, and the points of board must differ.",
    )
    factor = jnp.sum(jnp.conj(known) * seen) / spread
    squares = jnp.sum(abs(seen - factor * known) ** 2)
    ratio = abs(factor) * pixel  # r_c / R
    error = jnp.sqrt(squares / (2 * len(points) - 4) / spread) * pixel
    return FocalEstimate(
        focal=distance * ratio / (1 + ratio),
        std=distance * error / (1 + ratio) ** 2,
        rms=jnp.sqrt(squares / len(points)),
    )


def focal_from_planes(
    points: Float[AnyArray, "view point 2"],
    plane: Float[AnyArray, "point 2"],
    *,
    principal: Float[AnyArray, "2"],
) -> tuple[FocalEstimate, FocalEstimate]:
    """The focal length from oblique views of a known plane, by Zhang's two constraints.

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
        >>> print(round(float(together.focal), 3), each.focal.shape)
        800.0 (1,)
    """
    if points.ndim != 3 or not len(points):
        raise ValueError(
            "Argument points must have shape (view, point, 2), with a view at least, but its shape is "
            f"{points.shape}."
        )
    _check_pairs(points[0], plane, fewest=5)
    return _focal_from_planes(jnp.asarray(points), jnp.asarray(plane), jnp.asarray(principal))


def focal_from_lines(
    points: Float[AnyArray, "line point 2"],
    lines: Float[AnyArray, "line 2 2"],
    *,
    principal: Float[AnyArray, "2"],
    mask: Bool[AnyArray, "line point"] | None = None,
) -> FocalEstimate:
    """The focal length from one oblique view of known lines of a plane, by Zhang's two constraints.

    Where on its line each point is, need not be known. For many pictures alike use `jax.vmap`.

    Args:
        points: corrected positions in the image, px: for each line those that are seen on it.
        lines: for each line two points of it, on the plane, in any unit: its size and place do not matter,
            nor whether the two are seen.
        principal: the principal point, px; the centre of distortion is the usual choice.
        mask: which of the points there are; all, if it is not given. A line may have none.

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
        >>> print(round(float(focal_from_lines(image, lines, principal=np.zeros(2)).focal), 3))
        800.0
    """
    if mask is None:
        mask = jnp.ones(points.shape[:2], bool)
    if points.ndim != 3 or points.shape != (*mask.shape, 2) or lines.shape != (len(points), 2, 2):
        raise ValueError(
            "Arguments points, mask and lines must have shapes (line, point, 2), (line, point) and "
            f"(line, 2, 2), but their shapes are {points.shape}, {mask.shape} and {lines.shape}."
        )
    return _focal_from_lines(*map(jnp.asarray, (points, mask, lines, principal)))


@eqx.filter_jit
def _focal_from_planes(points, plane, principal):
    image = points - principal[None, None]
    plane = plane - jnp.mean(plane, axis=0, keepdims=True)
    # One length for all views: then w and the equations are of the order of 1 in each.
    length = jnp.sqrt(jnp.mean(jnp.sum((points - jnp.mean(points, axis=1, keepdims=True)) ** 2, axis=-1)))
    plane = plane / jnp.sqrt(jnp.mean(jnp.sum(plane**2, axis=-1)))
    entries, root, squares = jax.vmap(_homography, in_axes=(0, None))(image / length, plane)
    number = points.shape[1]

    def estimate(entries, root, squares):
        return _estimate(entries, root, jnp.sum(squares), squares.size * number, 2, length)

    each = jax.vmap(estimate)(entries[:, None], root[:, None], squares[:, None])
    return estimate(entries, root, squares), each


@eqx.filter_jit
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
    entries, root, squares = _homography_from_lines(image / length, present.astype(image.dtype), ends)
    return _estimate(entries[None], root[None], squares, number, 1, length)


def _homography_from_lines(image, present, ends):
    """As `_homography`, for points on the lines through the ends, in a unit of the plane of its own.

    NaN if it is not determined: if another homography has the same lines, in first order.
    """
    matrix, origin, unit = jax.lax.stop_gradient(_linear_homography(image, present, ends))
    entries = matrix.ravel()[:8]
    ends = _homogeneous((ends - origin[None, None]) / unit)

    def residual(entries):
        first, second = jnp.moveaxis(ends @ _matrix(entries).T, 1, 0)
        line = jnp.cross(first, second)
        across = jnp.sum(line * _homogeneous(image), axis=1) / jnp.hypot(line[:, 0], line[:, 1])
        return across * present[:, 0]

    sizes = jnp.linalg.svd(jax.lax.stop_gradient(jax.jacfwd(residual)(entries)), compute_uv=False)
    determined = sizes[-1] > _SINGULAR * jnp.finfo(entries.dtype).eps * sizes[0]
    return _refined(residual, jnp.where(determined, entries, jnp.nan))


def _linear_homography(image, present, ends):
    """A homography near that of least squares, from a plane with origin and unit of the last two.

    The origin is what is seen in the middle of the points, where depth is positive, and the unit what looks
    as large as the image's unit there.
    """
    total = jnp.sum(present)
    origin = jnp.sum(present[..., None] * ends, axis=(0, 1)) / (2 * total)
    ends = ends - origin[None, None]
    unit = jnp.sqrt(jnp.sum(present[..., None] * ends**2) / (2 * total))
    first, second = jnp.moveaxis(_homogeneous(ends / unit), 1, 0)
    line = jnp.cross(first, second)
    line = line / jnp.hypot(line[:, :1], line[:, 1:2])
    table = (line[:, :, None] * _homogeneous(image)[:, None, :]).reshape(-1, 9) * present
    to_plane = jnp.linalg.svd(table, full_matrices=False)[2][-1].reshape(3, 3)
    middle = jnp.append(jnp.sum(present * image, axis=0) / total, 1)
    place = to_plane @ middle
    place = place[:2] / place[2]
    columns = jnp.linalg.inv(to_plane)
    columns = columns[:, :2] / (columns[2] @ jnp.append(place, 1))  # the last one becomes the middle
    enlarged = jnp.linalg.det(columns[:2] - middle[:2, None] * columns[2:])
    scale = 1 / jnp.sqrt(abs(enlarged))
    matrix = jnp.concatenate([scale * columns, middle[:, None]], axis=1)
    return matrix, origin + unit * place, unit * scale


def _homogeneous(points):
    return jnp.concatenate([points, jnp.ones_like(points[..., :1])], axis=-1)


def _homography(image, plane):
    """Eight entries (the last is 1), a root S of their covariance S Sᵀ for unit noise, and the squares."""
    x, y = plane[:, 0], plane[:, 1]
    row = jnp.stack([x, y, jnp.ones_like(x)], axis=-1)
    none = jnp.zeros_like(row)
    table = jnp.concatenate(
        [
            jnp.concatenate([row, none, -image[:, :1] * row], axis=1),
            jnp.concatenate([none, row, -image[:, 1:] * row], axis=1),
        ]
    )
    vector = jnp.linalg.svd(table, full_matrices=False)[2][-1]
    # The last entry is the depth of the middle of the plane, which is in front of the camera.
    start = jax.lax.stop_gradient(vector[:8] / vector[8])

    def residual(entries):
        mapped = row @ _matrix(entries).T
        return (mapped[:, :2] / mapped[:, 2:] - image).ravel()

    return _refined(residual, start)


def _refined(residual, start):
    """The entries of least squares, a root of their covariance for unit noise, and the squares.

    All are NaN if the iterations do not converge: if the squares are least in a degenerate homography.
    Differentiable as the solution of "the gradient of the squares is 0", both ways and exactly: Gauss and
    Newton's approximation is in the steps alone.
    """

    def gradient(entries):
        return jax.grad(lambda entries: jnp.sum(residual(entries) ** 2) / 2)(entries)

    def step_and_root(entries):
        orthogonal, triangle = jnp.linalg.qr(jax.jacfwd(residual)(entries))
        sides = jnp.column_stack([orthogonal.T @ residual(entries), jnp.eye(8, dtype=entries.dtype)])
        # At once: XLA on few cores can wait forever for two of LAPACK's batches that run side by side.
        solved = jax.scipy.linalg.solve_triangular(triangle, sides)
        return solved[:, 0], solved[:, 1:]

    def advance(state):
        entries, _, count = state
        step, _ = step_and_root(entries)
        return entries - step, jnp.max(abs(step)), count + 1

    def solve(_, start):
        small = 64 * jnp.finfo(start.dtype).eps
        # Infinity is made of `start`, so that under shard_map it differs from device to device, too.
        return jax.lax.while_loop(
            lambda state: (state[1] > small) & (state[2] < _ITERATIONS),
            advance,
            (start, jnp.where(start[0] == start[0], jnp.inf, jnp.inf).astype(start.dtype), 0),
        )[0]

    def solve_linear(map, right):
        return jnp.linalg.solve(jax.jacfwd(map)(right), right)

    entries = jax.lax.custom_root(gradient, start, solve, solve_linear)
    step, root = step_and_root(entries)
    converged = jnp.max(step**2) < jnp.finfo(step.dtype).eps
    found = (entries, root, jnp.sum(residual(entries) ** 2))
    return jax.tree.map(lambda leaf: jnp.where(converged, leaf, jnp.nan), found)


def _estimate(entries, root, squares, number, coordinates, length):
    """From the homographies of views, with the sum of squares of all their points' distances.

    Each of the points has one or two coordinates that the homographies, of 8 unknowns each, should give.
    Lengths in the image are in units of length px.
    """
    w, information, misfit = _inverse_square(entries, root)
    # What one camera can see of the plane has 6 unknowns a view, and f.
    variance = (squares + misfit) / (coordinates * number - 6 * len(entries) - 1)
    known = (w > 0) & (information > 0)
    w = jnp.where(known, w, 1)
    focal = length / jnp.sqrt(w)
    error = jnp.sqrt(variance / jnp.where(known, information, 1))
    return FocalEstimate(
        focal=jnp.where(known, focal, jnp.nan),
        std=jnp.where(known, focal / (2 * w) * error, jnp.inf),
        rms=jnp.sqrt(squares / number) * length,
    )


def _matrix(entries):
    return jnp.append(entries, 1).reshape(3, 3)


def _equations(entries):
    """The factors of w in Zhang's two equations, and what is added to them.

    Divided by what makes them the same for all multiples of the matrix: otherwise the choice of the entry
    that is 1, and with it of the plane's origin, would have a part in the weights.
    """
    h1, h2 = _matrix(entries).T[:2]
    size = jnp.sum(h1[:2] ** 2 + h2[:2] ** 2)
    factor = jnp.stack([jnp.sum(h1[:2] * h2[:2]), jnp.sum(h1[:2] ** 2 - h2[:2] ** 2)])
    return factor / size, jnp.stack([h1[2] * h2[2], h1[2] ** 2 - h2[2] ** 2]) / size


def _inverse_square(entries, root):
    """The generalised least-squares w of several views, for unit noise the inverse of its variance, and by
    how much the sum of squares would be larger if the homographies obeyed the equations exactly.
    """
    factor, constant = jax.vmap(_equations)(entries)  # (view, 2)
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


def _complex(points):
    return points[:, 0] + 1j * points[:, 1]


def _check_pairs(points, plane, *, fewest: int) -> None:
    """As many points in the image as on the plane, and enough of them."""
    if points.shape != plane.shape or plane.ndim != 2 or plane.shape[1] != 2 or len(plane) < fewest:
        raise ValueError(
            f"Points in the image and on the plane must be arrays (n, 2) of one shape, n >= {fewest}, but "
            f"their shapes are {points.shape} and {plane.shape}."
        )
