"""What joins to lines: pieces of edges, or lines of such pieces, and the best straight line of each.

A line is known by sums over its points (weights, first and second moments) that add up when pieces join,
with weights that make distances px of the image.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from ._frame_model import OneFrame
from ._segments import Fragments, main_direction
from ._vectors import cross, dot

_MARGIN = 8.0
"""px from the image's edge within which an edge leaves the image: nearer there are no edge points."""


@dataclasses.dataclass(frozen=True)
class Units:
    """What joins: pieces, or lines of pieces. Corrected positions are from the centre of distortion.

    Attributes:
        sums: (u, 7), of the weights w, of w x, w y, w xx, w xy, w yy, and of ones, over corrected points.
        ends: (u, 2, 2), the first and the last point on the unit's line, corrected.
        tips: (u, 2, 2), the first and the last point in the image.
        stretch: (u, 2), there, across the unit.
        bright: (u, 2), 1 if the side of larger angles is brighter at that end, seen from the first to the
            last; or -1.
        contrast: (u, 2), logarithm of the slope of the grey levels.
        length: (u,), px in the image.
        leaves: (u, 2), whether the edge leaves the image there.
        flips: (u,), whether the brighter side changes within.
        barred: (u, 2), whether the edge is one of a thin bar there.
    """

    sums: np.ndarray
    ends: np.ndarray
    tips: np.ndarray
    stretch: np.ndarray
    bright: np.ndarray
    contrast: np.ndarray
    length: np.ndarray
    leaves: np.ndarray
    flips: np.ndarray
    barred: np.ndarray


class Lines(NamedTuple):
    """The best lines of units.

    Attributes:
        middle: (..., 2).
        normal: (..., 2), unit vectors.
        roughness: (...), RMS about the line, px of the image.
        weight: (...), the sum of the weights.
        spread: (...), the weighted sum of the squares of positions along the line, from its middle.
    """

    middle: np.ndarray
    normal: np.ndarray
    roughness: np.ndarray
    weight: np.ndarray
    spread: np.ndarray

    @classmethod
    def of(cls, sums: np.ndarray) -> "Lines":
        """From sums (..., 7)."""
        w, wx, wy, wxx, wxy, wyy, n = np.moveaxis(sums, -1, 0)
        x, y = wx / w, wy / w
        xx, xy, yy = wxx - x * wx, wxy - x * wy, wyy - y * wy
        angle = np.arctan2(2 * xy, xx - yy) / 2
        mean, half = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
        normal = np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
        rough = np.sqrt(np.maximum(mean - half, 0) / n)
        return cls(np.stack([x, y], axis=-1), normal, rough, w, mean + half)

    def taken(self, rows: np.ndarray) -> "Lines":
        """Those of these units."""
        return Lines(*(values.take(rows, axis=0) for values in self))


def units_of(pieces: Fragments, model: OneFrame, barred: np.ndarray) -> Units:
    """Each piece as a unit."""
    count = pieces.count[:, None]
    corrected = model.undistort(pieces.points) - model.centre
    straight = Fragments(corrected, pieces.gradient, pieces.start, pieces.count)
    first, last = pieces.start, pieces.start + pieces.count - 1
    mean = straight.sums(corrected) / count
    direction = main_direction(straight, mean)
    backwards = dot(corrected[last] - corrected[first], direction) < 0
    direction = np.where(backwards[:, None], -direction, direction)
    normal = np.stack([-direction[:, 1], direction[:, 0]], axis=-1)
    stretch = model.stretch(pieces.points, pieces.each(normal))
    w, (x, y) = 1 / stretch**2, corrected.T
    wx, wy = w * x, w * y
    moments = [straight.sums(values) for values in (w, wx, wy, wx * x, wx * y, wy * y)]
    sums = np.stack([*moments, pieces.count], axis=-1)
    ends = np.stack([corrected[first], corrected[last]], axis=1)
    ends -= np.einsum("uec,uc->ue", ends - mean[:, None], normal)[..., None] * normal[:, None]
    tips = np.stack([pieces.points[first], pieces.points[last]], axis=1)
    chord = tips[:, 1] - tips[:, 0]
    gradient = pieces.sums(pieces.gradient) / count
    side = np.sign(cross(chord, gradient))
    contrast = np.log(np.maximum(np.hypot(*gradient.T), 1e-9))
    inside = np.minimum(tips, np.subtract(model.image_size, 1) - tips).min(axis=-1)
    return Units(
        sums,
        ends,
        tips,
        np.stack([stretch[first], stretch[last]], axis=-1),
        np.stack([side, side], axis=-1),
        np.stack([contrast, contrast], axis=-1),
        np.hypot(*chord.T),
        inside < _MARGIN,
        np.zeros(len(pieces.count), bool),
        barred,
    )


def merged(units: Units, group: np.ndarray) -> Units:
    """The units of each group as one."""
    number = int(group.max(initial=-1)) + 1
    sums = np.zeros((number, 7))
    np.add.at(sums, group, units.sums)
    middle, normal, *_ = Lines.of(sums)
    along = np.einsum("uec,uc->ue", units.ends - middle[group, None], along_of(normal)[group])
    place = along.ravel()
    order = np.lexsort((place, np.repeat(group, 2)))
    cuts = np.flatnonzero(np.diff(np.repeat(group, 2)[order], prepend=-1))
    picked = np.stack([order[cuts], order[np.append(cuts[1:], len(order)) - 1]], axis=-1)
    unit, end = picked // 2, picked % 2  # (number, 2): at the first and the last place
    forwards = np.where(along[unit, 1] > along[unit, 0], 1, -1)
    tips = units.tips[unit, end]
    side = units.bright * np.sign(along[:, 1] - along[:, 0])[:, None]
    least, most = np.ones(number), -np.ones(number)
    np.minimum.at(least, group, side.min(axis=1))
    np.maximum.at(most, group, side.max(axis=1))
    flips = least < most
    np.logical_or.at(flips, group, units.flips)
    return Units(
        sums,
        middle[:, None] + place[picked][..., None] * along_of(normal)[:, None],
        tips,
        units.stretch[unit, end],
        units.bright[unit, end] * forwards,
        units.contrast[unit, end],
        np.hypot(*(tips[:, 1] - tips[:, 0]).T),
        units.leaves[unit, end],
        flips,
        units.barred[unit, end],
    )


def along_of(normal: np.ndarray) -> np.ndarray:
    """Unit vectors (..., 2) along lines, from their normals."""
    return np.stack([normal[..., 1], -normal[..., 0]], axis=-1)
