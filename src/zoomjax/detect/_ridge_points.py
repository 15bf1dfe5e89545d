"""Sub-pixel points in the middle of bright, narrow ridges on grass: where markings are crossed.

A top-hat leaves what is brighter than its surroundings and narrow; its maxima along rows and columns are
where a ridge is crossed. There the profile of the grey levels is read, along the row or the column that
crosses the ridge more steeply. Its middle is midway between the two points at half of its height, each
above its own side's level: light grass on one side and dark on the other do not move it.

Work a pixel: a smoothing and a top-hat, by OpenCV in bytes; all else is done for the few pixels on ridges.
"""

import cv2
import numpy as np
from scipy.spatial import KDTree

from ._edge_points import EdgePoints
from ._grass import Grass

_SMOOTHING = 1.0
"""px, standard deviation."""

WIDEST = 0.02
"""Share of the image's shorter side that a marking may be wide."""

_FLOOR = 8.0
"""Least height of a ridge in grey levels."""

_OF_GRASS = 2.0
"""Least height as a multiple of what 85 % of the grass has."""

_BESIDE = np.array([2, 3, 4])
"""px beyond the points at half height, where a side's level and colour are read."""

_UNEVEN = 2.0
"""How much the sides may differ, as a share of the height above the brighter one."""

_WHITER = 0.7
"""Least rise of the weakest of the three colours, as a share of the rise of the grey level: grass lacks
blue, white does not, and yellow shirts and light patches of grass do. Markings have 1.1 to 2.2."""

_BORDER = 3
"""px along the image's border without points."""

_STEEP = 0.7
"""Cosine between a ridge's normal and the row or column that crosses it: at 45 degrees both do."""

_NEAR = 6.0
"""px, how far the points are that tell a ridge's direction."""

_SCATTER = 0.8
"""px across that direction, RMS, that they may have: more is a corner or no line."""


def ridge_points(image: np.ndarray, grass: Grass) -> EdgePoints:
    """Points in the middle of white ridges on the grass of an image (h, w, 3), uint8 BGR.

    One a row for steep ridges, one a column for level ones.
    """
    size = image.shape[1::-1]
    widest = WIDEST * min(size)
    reach = round(widest) + 2
    margin = reach + _BESIDE[-1] + 2  # profiles and what is beside them end within the padded image
    image = cv2.copyMakeBorder(image, margin, margin, margin, margin, cv2.BORDER_REPLICATE)
    grey = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), (0, 0), _SMOOTHING)
    hat = cv2.morphologyEx(grey, cv2.MORPH_TOPHAT, np.ones((reach, reach), np.uint8))
    hat = cv2.blur(hat, (3, 3))
    inside = (slice(margin, -margin), slice(margin, -margin))
    mask = np.zeros_like(hat)
    mask[inside] = grass.mask(size)
    least = _least_height(hat[inside], mask[inside])
    at = np.flatnonzero(cv2.threshold(cv2.min(hat, mask), least, 255, cv2.THRESH_BINARY)[1])
    parts = [_middles(image, grey, grass, hat, at, axis, reach) for axis in (0, 1)]
    position, axis, across = (np.concatenate(part) for part in zip(*parts, strict=True))
    normal, scatter = _directions(position)
    steep = abs(normal[np.arange(len(axis)), axis])
    keep = (steep > _STEEP) & (across * steep < widest) & (scatter < _SCATTER)
    position -= margin
    keep &= ((position > _BORDER) & (position < np.subtract(size, _BORDER + 1))).all(axis=1)
    position = position[keep]
    pixel, even = np.rint(position).astype(np.intp), np.ones(len(position))
    return EdgePoints(position, normal[keep], even, pixel, size, polar=False)


def _least_height(hat: np.ndarray, mask: np.ndarray) -> float:
    """Grey levels that a ridge must be high, by how uneven the grass is."""
    thin = hat[::7, ::7][mask[::7, ::7] > 0]
    return max(_FLOOR, _OF_GRASS * float(np.quantile(thin, 0.85))) if len(thin) else _FLOOR


def _middles(image, grey, grass: Grass, hat, at, axis: int, reach: int):
    """Middles (n, 2) px of the ridges crossed along an axis, that axis (n,), and their widths along it."""
    width = grey.shape[1]
    step = (1, width)[axis]
    flat, levels, colours = hat.ravel(), grey.ravel(), image.reshape(-1, 3)
    at = at[(flat[at] > flat[at - step]) & (flat[at] >= flat[at + step])]
    profile = levels[at + step * np.arange(-reach, reach + 1)[:, None]]
    lowest = np.maximum(profile[:reach].min(axis=0), profile[reach + 1 :].min(axis=0))
    peak = profile[reach].astype(np.float32)
    far, found = _crossings(profile, np.stack([(peak + lowest) / 2] * 2, axis=-1))
    at, profile, peak, far = at[found], profile[:, found], peak[found, None], far[found]
    beside = _BESIDE[:, None, None] + np.rint(far).astype(np.intp)
    beside = at[:, None] + step * beside * np.array([-1, 1])
    side, colour = levels[beside].mean(axis=0), colours[beside].mean(axis=0)
    height = peak[:, 0] - side.max(axis=1)
    far, found = _crossings(profile, (peak + side) / 2)
    shift = (far[:, 1] - far[:, 0]) / 2
    middle = at + step * np.rint(shift).astype(np.intp)
    found &= (height > _FLOOR) & (abs(side[:, 1] - side[:, 0]) < _UNEVEN * height)
    found &= grass.has_colour(np.rint(colour).astype(np.uint8).reshape(-1, 3)).reshape(-1, 2).all(axis=1)
    found &= colours[middle].min(axis=1) - colour.min(axis=-1).max(axis=1) > _WHITER * height
    # Flat ridges have several maxima side by side, with one middle.
    _, first = np.unique(middle[found], return_index=True)
    at, shift, far = (values[found][first] for values in (at, shift, far))
    position = np.stack([at % width, at // width], axis=-1).astype(float)
    position[:, axis] += shift
    return position, np.full(len(at), axis), far.sum(axis=1)


def _crossings(profile: np.ndarray, level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far from the middle profiles (2 r + 1, n) fall below levels (n, 2) on both sides; which do."""
    reach, number = profile.shape[0] // 2, profile.shape[1]
    ends, found = [], np.ones(number, bool)
    for side, part in enumerate((profile[reach::-1], profile[reach:])):
        below = part < level[:, side]
        first = np.maximum(below.argmax(axis=0), 1)
        before, after = (part[row, np.arange(number)].astype(float) for row in (first - 1, first))
        ends.append(first - 1 + (before - level[:, side]) / np.maximum(before - after, 1e-3))
        found &= below.any(axis=0) & ~below[0]
    return np.clip(np.stack(ends, axis=-1), 0, reach), found


def _directions(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals (n, 2) of what the points around each point make, and their RMS along these, px."""
    number = len(points)
    pairs = KDTree(points).query_pairs(_NEAR, output_type="ndarray")
    first, second = np.concatenate([pairs, pairs[:, ::-1]]).T
    x, y = (points[second] - points[first]).T

    def total(values):
        return np.bincount(first, values, number)

    count = total(np.ones(len(x))) + 1
    mx, my = total(x) / count, total(y) / count
    xx, xy, yy = (
        total(x * x) / count - mx * mx,
        total(x * y) / count - mx * my,
        total(y * y) / count - my * my,
    )
    angle = np.arctan2(2 * xy, xx - yy) / 2
    least = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)
    return np.stack([-np.sin(angle), np.cos(angle)], axis=-1), np.sqrt(np.maximum(least, 0))
