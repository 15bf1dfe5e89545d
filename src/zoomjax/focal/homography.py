"""Homographies from a plane to its image, of least squares, from points or from points on lines.

The homography brings the points p as close as it can to the images of their lines. The
image of the line through e1 and e2 is m = H e1 × H e2, and p is ``m·p / hypot(m1, m2)`` away from it.
It is linear in G = H⁻¹ but for its denominator: ``l·G p = 0`` for the line l = e1 × e2 is the linear start.
"""

import jax
import jax.numpy as jnp

_ITERATIONS = 20
"""Gauss-Newton steps for a homography, at most. From the linear start 3 or 4 reach rounding."""

_SINGULAR = 1000
"""Singular values below as many roundings of the largest one are zero: of a Jacobian of a homography."""


def homography_from_lines(image, present, ends):
    """As `homography`, for points on the lines through the ends, in a unit of the plane of its own.

    NaN if it is not determined: if another homography has the same lines, in first order.
    """
    matrix, origin, unit = jax.lax.stop_gradient(_linear_homography(image, present, ends))
    entries = matrix.ravel()[:8]
    ends = _homogeneous((ends - origin[None, None]) / unit)

    def residual(entries):
        first, second = jnp.moveaxis(ends @ matrix_of(entries).T, 1, 0)
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


def homography(image, plane, present):
    """Eight entries (the last is 1), a root S of their covariance S Sᵀ for unit noise, and the squares.

    `present` is 1 for the points that count and 0 for others.
    """
    x, y = plane[:, 0], plane[:, 1]
    row = jnp.stack([x, y, jnp.ones_like(x)], axis=-1)
    none = jnp.zeros_like(row)
    table = (
        jnp.concatenate(
            [
                jnp.concatenate([row, none, -image[:, :1] * row], axis=1),
                jnp.concatenate([none, row, -image[:, 1:] * row], axis=1),
            ]
        )
        * jnp.tile(present, 2)[:, None]
    )
    vector = jnp.linalg.svd(table, full_matrices=False)[2][-1]
    # The last entry is the depth of the middle of the plane, which is in front of the camera.
    start = jax.lax.stop_gradient(vector[:8] / vector[8])

    def residual(entries):
        mapped = row @ matrix_of(entries).T
        return (present[:, None] * (mapped[:, :2] / mapped[:, 2:] - image)).ravel()

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


def matrix_of(entries):
    """The matrix of eight entries; the last is 1."""
    return jnp.append(entries, 1).reshape(3, 3)
