"""Grids that grow from one of scattered points, neighbour by neighbour.

From a first point, each neighbour is expected one step of the grid further. Steps follow those found last,
so that they bend with the lens and shrink with perspective. What is not there is left out, wherever it is:
spots that are hidden, or a board of which a part is outside of the image.
"""

from collections import deque
from collections.abc import Callable, Iterable

import cv2
import numpy as np

_NEAR = 0.3
"""How far, in steps of the grid, a point may be from where it is expected."""

_LOOKED_AT = 80
"""Points around a first one among which its steps are; 12 where any two may be neighbours."""

Linked = Callable[[int, int], bool]
"""Whether two points, by their numbers, may be neighbours in a grid."""


def nearest_of(centres: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """For each pixel the index of the centre nearest to it."""
    apart = np.ones(shape, np.uint8)
    x, y = np.rint(centres).astype(int).T
    apart[y, x] = 0
    _, label = cv2.distanceTransformWithLabels(
        apart, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    label = np.asarray(label, np.intp)
    index = np.zeros(label.max() + 1, np.int32)
    index[label[y, x]] = np.arange(len(centres))
    return index[label]


def largest_grid(
    centres: np.ndarray, nearest: np.ndarray, seeds: Iterable[int], linked: Linked | None = None
) -> dict[int, tuple[int, int]]:
    """Row and column of each point of the largest grid that grows from one of the seeds.

    Args:
        centres: the points (n, 2), px.
        nearest: for each pixel the point nearest to it.
        seeds: points to start from, one after the other; what has grown is no seed any more.
        linked: what neighbours have to fulfil; by default nothing.
    """
    best: dict[int, tuple[int, int]] = {}
    tried: set[int] = set()
    for seed in seeds:
        if seed in tried:
            continue
        place = _grown_from(seed, centres, nearest, linked)
        tried.update(place)
        if len(place) > len(best):
            best = place
        if 2 * len(best) > len(centres):
            break
    return best


def as_grid(centres: np.ndarray, place: dict[int, tuple[int, int]]) -> np.ndarray:
    """Centres by row and column, NaN where there is none."""
    index = np.array(list(place.values()))
    index -= index.min(axis=0)
    grid = np.full((*(index.max(axis=0) + 1), 2), np.nan)
    grid[index[:, 0], index[:, 1]] = centres[list(place)]
    return grid


def _grown_from(
    seed: int, centres: np.ndarray, nearest: np.ndarray, linked: Linked | None
) -> dict[int, tuple[int, int]]:
    """Row and column of each point that is reached from one point, step by step."""
    steps = _first_steps(seed, centres, linked)
    if steps is None:
        return {}
    place, taken = {seed: (0, 0)}, {(0, 0): seed}
    queue = deque([(seed, *steps)])
    while queue:
        spot, across, down = queue.popleft()
        row, column = place[spot]
        for i, j in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            there = (row + i, column + j)
            if there in taken:
                continue
            step = i * down + j * across
            other = _point_at(centres[spot] + step, nearest)
            if other is None or other in place:
                continue
            found = centres[other] - centres[spot]
            if np.hypot(*(found - step)) > _NEAR * min(np.hypot(*across), np.hypot(*down)):
                continue
            if linked is not None and not linked(spot, other):
                continue
            place[other], taken[there] = there, other
            queue.append((other, j * found if j else across, i * found if i else down))
    return place


def _first_steps(
    seed: int, centres: np.ndarray, linked: Linked | None
) -> tuple[np.ndarray, np.ndarray] | None:
    """From a point to the nearest other one, and to the nearest in a clearly other direction."""
    offsets = centres - centres[seed]
    others = np.argsort(np.hypot(*offsets.T), kind="stable")[1 : _LOOKED_AT + 1]
    if linked is None:
        others = others[:12]
    else:
        others = np.array([other for other in others.tolist() if linked(seed, other)], int)
    if not len(others):
        return None
    near = offsets[others]
    first = near[0]
    sine = abs(first[0] * near[:, 1] - first[1] * near[:, 0])
    other = near[sine > 0.6 * np.hypot(*first) * np.hypot(*near.T)]
    return (first, other[0]) if len(other) else None


def _point_at(position: np.ndarray, nearest: np.ndarray) -> int | None:
    """The point nearest to a position, px, that is within the image."""
    x, y = round(position[0]), round(position[1])
    inside = 0 <= y < nearest.shape[0] and 0 <= x < nearest.shape[1]
    return int(nearest[y, x]) if inside else None
