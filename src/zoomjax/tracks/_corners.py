"""Corners of an image, spread over it: where tracks may begin."""

from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Float, UInt8

_BLOCK = 7
"""px a side of the square over which slopes are averaged."""


def best_corners(
    image: UInt8[np.ndarray, "height width"],
    cells: tuple[int, int],
    *,
    taken: Float[np.ndarray, "point 2"],
    apart: int,
    edge: int,
    weakest: float,
) -> tuple[Float[np.ndarray, "corner 2"], Float[np.ndarray, "corner"]]:
    """The strongest corner of each cell, in whole px, and its strength: at most one a cell.

    The strength is the mean square of the slope in the direction where it is least, (grey levels / px)^2
    (Shi, Tomasi 1994).

    Args:
        image: grey.
        cells: how many, across and down.
        taken: points that corners must be `apart` from, px.
        apart, edge: least distance from those and from the image's border, px.
        weakest: least strength.
    """
    strength = cv2.cornerMinEigenVal(image, _BLOCK, ksize=3) * (255 / 2) ** 2
    for x, y in taken:
        cv2.circle(strength, (round(x), round(y)), apart, 0.0, -1)
    height, width = image.shape
    columns = np.linspace(edge, width - edge, cells[0] + 1).astype(int)
    rows = np.linspace(edge, height - edge, cells[1] + 1).astype(int)
    best = np.zeros((0, 3))
    if min(height, width) > 2 * edge:
        parts = [
            (left, top, cv2.minMaxLoc(strength[top:bottom, left:right]))
            for top, bottom in pairwise(rows)
            for left, right in pairwise(columns)
            if right > left and bottom > top
        ]
        best = np.array([(left + x, top + y, value) for left, top, (_, value, _, (x, y)) in parts])
        best = best.reshape(-1, 3)
    best = best[best[:, 2] > weakest]
    return best[:, :2], best[:, 2]
