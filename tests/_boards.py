"""Photos of a board that is bent, by computation: lens, corners and the truth."""

import jax
import jax.numpy as jnp
import numpy as np

from zoomjax import PolynomialZoom, ZoomLens
from zoomjax.fit._board_shape import grid_places
from zoomjax.fit._motion_start import turned

SIZE, ROWS, COLUMNS = (1280, 720), 6, 8
FOCAL = np.repeat([1000.0, 1600.0, 2600.0], 6)
LABEL = np.repeat([1.0, 2.0, 3.0], 6)


def bent(height=0.1):
    """A board that is bent: a cylinder with a twist, half a step out of its plane, and 1 % too wide."""
    places, unit = grid_places(ROWS, COLUMNS)
    x, y = places.T
    z = height * (x**2 - 1 / 3 + 0.8 * x * y)  # its plane is where x^2 is 1/3 of the largest
    return np.stack([1.005 * x, y / 1.005, z], axis=1) * unit


def seen_through(lens, board, focal):
    """Corners of photos of a board, or of one each, from all sides; it fills most of the image."""
    grids, poses = [], []
    boards = np.broadcast_to(board, (len(focal), *board.shape[-2:]))
    for number, (f, board) in enumerate(zip(focal, boards, strict=True)):
        tilt = np.array([0.5 * np.cos(2.4 * number), 0.5 * np.sin(2.4 * number), 0.1 * np.sin(number)])
        rotation = np.asarray(jax.vmap(turned, (1, None), 1)(jnp.eye(3), jnp.asarray(tilt)))
        distance = f * COLUMNS / (0.55 * SIZE[0])
        shift = distance / f * 40 * np.array([np.cos(number), np.sin(number)])
        position = np.append(shift, distance)
        ahead = board @ rotation.T + position
        straight = np.asarray(lens.centre) + f * ahead[:, :2] / ahead[:, 2:]
        grids.append(np.asarray(lens(float(f)).distort(straight)).reshape(ROWS, COLUMNS, 2))
        poses.append((rotation, position))
    return np.stack(grids), poses


def true_lens():
    """A zoom lens, whose centre is not that of the image."""
    zoom = PolynomialZoom(2, jnp.array([[0.02, 0.0], [-0.05, 0.01], [-0.08, 0.03]]), jnp.array(1000.0))
    return ZoomLens(zoom, jnp.array([646.0, 355.0]), jnp.array([1000.0, 2600.0]), SIZE, "px")


def displaced(lens, fitted, fit_focal, focal):
    """RMS distance over the image of points corrected by the fitted lens and by the true one, px."""
    grid = np.stack(np.meshgrid(*(np.linspace(0, n - 1, 9) for n in SIZE)), -1).reshape(-1, 2)
    missed = [
        np.asarray(fitted(float(own)).undistort(grid)) - np.asarray(lens(float(true)).undistort(grid))
        for own, true in zip(np.asarray(fit_focal), focal, strict=True)
    ]
    return float(np.sqrt(np.mean(np.sum(np.square(missed), axis=-1))))
