"""Fragments of one border, joined across gaps and crossings.

Two fragments belong to one border when an arc of a circle runs on from the end of one into the end of the
other: the angles from either's direction to the line between them are equal. A lens bends straight lines
gently, so the arc may not bend more than a circle of half the image's diagonal. Which side is brighter does
not count: along the border of a checkerboard it changes at every square.
"""

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from .._core.arrays import places
from ._segments import Fragments, in_order, main_direction
from ._vectors import cross, dot

_END = 40
"""Points of a fragment that tell its direction at an end: fewer if it is shorter."""

_NEAREST = 32
"""Ends looked at for each end: those of 4 stripes that cross make 16."""

_POINT_ERROR = 0.15
"""px, of a point across the edge: what the tolerance for directions is made of."""

_ANGLE = 0.01
"""Least tolerance for the difference of both angles, rad."""

_BLOOM = 0.5
"""px by which a border moves towards its darker side, as bright parts grow on sensors and by sharpening:
where the contrast flips, the border jumps by twice that."""

_ASIDE = 2.0
"""px by which one fragment may miss the arc from the other."""

_OVERLAP = 2.0
"""px by which the ends of fragments of one border may pass each other."""


def joined(pieces: Fragments, radius: float) -> np.ndarray:
    """(f,), for each fragment the number of the border that it is on.

    `radius`, px, is the least one of an arc: half the image's diagonal.
    """
    number = len(pieces.count)
    if number < 2:
        return np.arange(number)
    tip, middle, direction, error = (np.concatenate(both) for both in zip(*_ends(pieces), strict=True))
    nearest = min(_NEAREST, 2 * number)
    other = np.asarray(KDTree(tip).query(tip, nearest)[1])
    own = np.arange(2 * number)[:, None]
    chord = middle[other] - middle[own]
    length = np.maximum(np.hypot(*np.moveaxis(chord, -1, 0)), 1e-9)
    leave = _angle(direction[own], chord)
    enter = _angle(chord, -direction[other])
    gap = np.einsum("ekc,ekc->ek", tip[other] - tip[own], np.broadcast_to(direction[own], chord.shape))
    noise = np.hypot(error[own], error[other])
    miss = abs(leave - enter)
    fits = (other % number != own % number) & (gap > -_OVERLAP)
    fits &= (miss < _ANGLE + 4 * noise + 4 * _BLOOM / length) & (miss * length < 2 * _ASIDE)
    fits &= abs(leave + enter) / 2 < length / (2 * radius) + 2 * noise
    gap = np.where(fits, gap, np.inf)
    best = np.argmin(gap, axis=1)
    found = np.isfinite(gap[own[:, 0], best])
    partner = np.where(found, other[own[:, 0], best], -1)
    mutual = found & (partner[partner] == own[:, 0])
    first, second = own[mutual, 0] % number, partner[mutual] % number
    graph = coo_matrix((np.ones(len(first), bool), (first, second)), shape=(number, number))
    return connected_components(graph, directed=False)[1]


def border_lines(pieces: Fragments, border: np.ndarray) -> list[np.ndarray]:
    """The points of each border, in order along it; pieces of border -1 are on none."""
    of_pieces = np.argsort(border, kind="stable")
    of_pieces = of_pieces[border[of_pieces] >= 0]
    if not len(of_pieces):
        return []
    rows = np.repeat(pieces.start[of_pieces], pieces.count[of_pieces]) + places(pieces.count[of_pieces])
    _, label = np.unique(border[of_pieces], return_inverse=True)
    count = np.bincount(label, pieces.count[of_pieces]).astype(int)
    lines = in_order(pieces.taken(rows, count))
    return np.split(lines.points, lines.start[1:])


def _ends(pieces: Fragments) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """For the first ends, then the last ones: tip, middle and direction outwards, and its error, rad."""
    size = np.minimum(pieces.count, _END)
    ends = []
    for start, outwards in ((pieces.start, -1), (pieces.start + pieces.count - size, 1)):
        rows = np.repeat(start, size) + places(size)
        end = pieces.taken(rows, size)
        middle = end.sums(end.points) / size[:, None]
        direction = main_direction(end, middle)
        first, last = end.points[end.start], end.points[end.start + size - 1]
        forwards = np.sign(np.einsum("fc,fc->f", last - first, direction))
        direction *= (outwards * np.where(forwards == 0, 1, forwards))[:, None]
        extent = np.maximum(np.hypot(*(last - first).T), 1e-9)
        error = _POINT_ERROR * np.sqrt(12 / size) / extent
        ends.append((first if outwards < 0 else last, middle, direction, error))
    return ends


def _angle(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """From one vector to another, rad."""
    return np.arctan2(cross(first, second), dot(first, second))
