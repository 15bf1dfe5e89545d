"""Grids that grow from one of scattered points, neighbour by neighbour.

From a first point, each neighbour is expected one step of the grid further. Steps turn and shrink as the
last two in their row or column did, so that they follow lens and perspective. What is not there is left
out, wherever it is: spots that are hidden, or a board of which a part is outside of the image.
"""

from collections import deque
from collections.abc import Callable, Iterable

import cv2
import numpy as np

_NEAR = 0.3
"""How far, in steps of the grid, a point may be from where it is expected."""

_REACHES = (1.0, 0.75, 1.35)
"""Shares of the expected step at which a neighbour is looked for, where an edge has to lead to it: of a
board seen at a slant through a fisheye, squares next to each other may differ by half."""

_QUICKEST = 1.6
"""Most by which steps are expected to grow or shrink, from one to the next."""

_LOOKED_AT = 80
"""Points around a first one among which its steps are; 12 where any two may be neighbours."""

Linked = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Whether points and others (n,), by their numbers, may be neighbours in a grid."""


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
            line = [taken.get((row - back * i, column - back * j)) for back in (0, 1, 2)]
            step = _next_step(centres, line, i * down + j * across)
            near = _NEAR * (min(np.hypot(*across), np.hypot(*down)) if linked is None else np.hypot(*step))
            for reach in _REACHES[: 1 if linked is None else None]:
                other = _point_at(centres[spot] + reach * step, nearest)
                if other is None or other in place:
                    continue
                found = centres[other] - centres[spot]
                if np.hypot(*(found - reach * step)) > reach * near:
                    continue
                if linked is not None and not linked(np.array([spot]), np.array([other]))[0]:
                    continue
                place[other], taken[there] = there, other
                queue.append((other, j * found if j else across, i * found if i else down))
                break
    return place


def _next_step(centres: np.ndarray, line: list[int | None], otherwise: np.ndarray) -> np.ndarray:
    """The step that goes on from a point as those to it did, in a row or column that ends there.

    `line` are the point and those before it, the last first, as far as they are known.
    """
    if line[1] is None:
        return otherwise
    last = centres[line[0]] - centres[line[1]]
    if line[2] is None:
        return last
    before = centres[line[1]] - centres[line[2]]
    # Both as complex numbers: their ratio is a turn and a growth.
    change = complex(*last) / complex(*before)
    change *= np.clip(abs(change), 1 / _QUICKEST, _QUICKEST) / abs(change)
    step = complex(*last) * change
    return np.array([step.real, step.imag])


def _first_steps(
    seed: int, centres: np.ndarray, linked: Linked | None
) -> tuple[np.ndarray, np.ndarray] | None:
    """From a point to the nearest other one, and to the nearest in a clearly other direction."""
    offsets = centres - centres[seed]
    others = np.argsort(np.hypot(*offsets.T), kind="stable")[1 : _LOOKED_AT + 1]
    others = others[:12] if linked is None else others[linked(np.full(len(others), seed), others)]
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
