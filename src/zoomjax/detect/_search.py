"""How bent a photograph is, before any edges are joined: an extended Hough transform.

The unknown is one number, the square of the angle a that the image's corner is off the axis of an
equidistant fisheye, which corrects a radius r, in halves of the diagonal, to ``tan(a r) / a``. Real
fisheyes are near it, all weaker barrel distortion is the same to first order, and negative squares,
``tanh``, are pincushion. (The division model with one term is not as near: its best for the upper and the
lower half of a fisheye's image differ.)

For each candidate all pieces of edges are corrected about the image's centre; every sample of a piece
votes, with its length, for the line through it in its direction, and the candidate counts the squares of
the votes. Where the straight lines of the scene become straight, the many pieces of one line, and the
whole of a long one, vote alike.

A line has an orientation and an offset, which is counted in px of the image: that of the line's foot,
where it is nearest to the centre.
"""

import cv2
import numpy as np

from .._core.arrays import places
from ._frame_model import tangent_ratio
from ._segments import Fragments, main_direction
from ._vectors import cross, dot, norm

_RANGE = (-2.0, 2.1)
"""Candidates, from strong pincushion to more than a fisheye's barrel distortion."""

_STEP = 0.1
"""From one candidate to the next."""

_CELL = (np.radians(0.4), 1.2)
"""Orientation, and offset at the scale `_HALF_DIAGONAL`. Larger cells cannot tell the rows of windows of a
facade apart, and take it for more bent than it is."""

_HALF_DIAGONAL = 700
"""px, of the image for which cells are given: others in proportion."""

_CELLS = int(np.pi / _CELL[0]), int(2.2 * _HALF_DIAGONAL / _CELL[1])
"""How many there are, by orientation and by offset."""

_SAMPLE = 8.0
"""px along a piece from one vote to the next; more where there are more than `_MOST` of them."""

_MOST = 6000
_LEAST_EXTENT = 8.0
"""px, of pieces that vote: shorter ones do not know their direction."""


def likely_angle(pieces: Fragments, image_size: tuple[int, int]) -> float:
    """The square of the corner's angle, as far as votes can tell; 0 without pieces."""
    point, direction, weight = _samples(pieces)
    if len(point) < 2:
        return 0.0
    middle, scale = (np.array(image_size) - 1) / 2, np.hypot(*image_size) / 2
    z = (point - middle) / scale
    candidates = _STEP * np.arange(round(_RANGE[0] / _STEP), round(_RANGE[1] / _STEP) + 1)
    t, pull, weight = np.maximum(dot(z, z), 1e-9), dot(z, direction), weight.astype(np.float32)
    votes, smooth = np.zeros((2, *_CELLS), np.float32)
    scores = []
    for square in candidates:
        cell = _cells(z, direction, t, pull, float(square))
        np.add.at(votes.reshape(-1), cell, weight)
        cv2.GaussianBlur(votes, (3, 3), 0.8, dst=smooth)
        scores.append(cv2.norm(smooth, cv2.NORM_L2SQR))
        votes.reshape(-1)[cell] = 0
    return float(candidates[int(np.argmax(scores))])


def _samples(pieces: Fragments) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points on pieces (n, 2), the directions there, and px of edge that each stands for."""
    if not len(pieces.count):
        return np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)
    mean = pieces.sums(pieces.points) / pieces.count[:, None]
    along_unit = main_direction(pieces, mean)
    aside = np.stack([-along_unit[:, 1], along_unit[:, 0]], axis=-1)
    offset, direction = pieces.points - pieces.each(mean), pieces.each(along_unit)
    along, across = dot(offset, direction), cross(direction, offset)
    # The best parabola, across = a + b along + c along^2, by its normal equations: one for all pieces.
    square = along * along
    powers = np.stack([np.ones_like(along), along, square, square * along, square * square], axis=-1)
    moments = pieces.sums(powers)
    matrix = moments[:, np.add.outer(np.arange(3), np.arange(3))]
    right = pieces.sums(across[:, None] * powers[:, :3])
    ridge = 1e-9 * np.einsum("fii->fi", matrix)
    bend = np.linalg.solve(matrix + ridge[:, None] * np.eye(3), right[..., None])[..., 0]
    length = along[pieces.start + pieces.count - 1] - along[pieces.start]
    length = np.where(abs(length) >= _LEAST_EXTENT, abs(length), 0.0)
    spacing = max(_SAMPLE, length.sum() / _MOST)
    number = np.ceil(length / spacing).astype(int)
    owner = np.repeat(np.arange(len(number)), number)
    within = places(number)
    low = np.minimum(along[pieces.start], along[pieces.start + pieces.count - 1])[owner]
    t = low + (within + 0.5) / number[owner] * length[owner]
    a, b, c = bend[owner].T
    point = mean[owner] + t[:, None] * along_unit[owner] + (a + t * (b + t * c))[:, None] * aside[owner]
    direction = along_unit[owner] + (b + 2 * t * c)[:, None] * aside[owner]
    direction /= norm(direction)[:, None]
    return point, direction, length[owner] / number[owner]


def _cells(z, direction, t, pull, square: float) -> np.ndarray:
    """Where samples vote for a candidate, in the flat array of cells.

    t and `pull` are z.z and z.direction, which are alike for all candidates.
    """
    ratio = tangent_ratio(square * t)
    growth = (1 - ratio) / t + square * ratio**2  # of the ratio, by r, over r
    pulled = growth * pull
    (x, y), (u, v) = z.T, (ratio * direction[:, axis] + pulled * z[:, axis] for axis in (0, 1))
    angle = np.arctan2(v, u)
    angle = np.where(angle < 0, angle + np.pi, angle)  # of a line, which has no first end
    offset = ratio * np.where(v < 0, -1, 1) * (u * y - v * x) / np.sqrt(u * u + v * v)
    a = np.sqrt(abs(square)) + 1e-9
    inverse = np.arctan(a * offset) if square > 0 else np.arctanh(np.clip(a * offset, -0.999, 0.999))
    rows, columns = _CELLS
    row = (angle / np.pi * rows).astype(int) % rows
    column = np.clip((inverse / a / 2.2 + 0.5) * columns, 0, columns - 1e-6).astype(int)
    return row * columns + column
