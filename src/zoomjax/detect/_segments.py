"""Fragments: smooth pieces of edges, from points that follow one another.

Neighbouring points are linked when they lie along each other's edge and the edge has the same direction and
polarity at both. The connected components are curves without corners; a curve that is no gently bent line
is halved until its parts are, and what is short is dropped.
"""

import dataclasses

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from .._core.arrays import places
from ._edge_points import EdgePoints
from ._vectors import cross, dot

_NEIGHBOURS = [(dx, 0) for dx in (1, 2)] + [(dx, dy) for dy in (1, 2) for dx in range(-2, 3)]
"""Offsets, px, to half of the neighbours: those in front, when the image is read line by line."""

_TURN = np.cos(np.radians(15))
_ASIDE = 0.7
"""px across the edge from a point to the next."""

_LEAST_POINTS = 8
_HALVINGS = 8
"""How often what is crooked is halved before it is dropped."""

_CROOKED = 0.35
"""px, RMS about the best parabola: noise of 5 levels on an edge of 40 gives 0.2."""


@dataclasses.dataclass(frozen=True)
class Fragments:
    """Points in order along gently bent pieces of edges, piece after piece.

    Attributes:
        points: (n, 2), px.
        gradient: (n, 2), towards the brighter side of the edge, as long as the grey levels are steep.
        start: (f,), where each piece starts in `points`.
        count: (f,), its number of points.
    """

    points: np.ndarray
    gradient: np.ndarray
    start: np.ndarray
    count: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray, gradient: np.ndarray, count: np.ndarray) -> "Fragments":
        """Pieces of so many points each, one after the other."""
        return cls(points, gradient, np.cumsum(count) - count, count)

    def piece(self) -> np.ndarray:
        """(n,), the piece that each point belongs to."""
        return np.repeat(np.arange(len(self.count)), self.count)

    def each(self, values: np.ndarray) -> np.ndarray:
        """(n, ...), for each point the values (f, ...) of its piece."""
        return np.repeat(values, self.count, axis=0)

    def taken(self, order: np.ndarray, count: np.ndarray) -> "Fragments":
        """Pieces of so many of these points each, in this order."""
        return Fragments.of(self.points.take(order, axis=0), self.gradient.take(order, axis=0), count)

    def sums(self, values: np.ndarray) -> np.ndarray:
        """Sums of values (n, ...) over each piece."""
        if not len(self.start):
            return np.zeros((0, *values.shape[1:]))
        return np.add.reduceat(values, self.start, axis=0)


def fragments(edges: EdgePoints) -> Fragments:
    """The gently bent pieces of at least 8 points that the edge points make."""
    every = np.array([len(edges.position)])
    gradient = edges.normal * edges.slope[:, None]
    pieces = _ordered(Fragments.of(edges.position, gradient, every), _linked(edges))
    straight = []
    for _ in range(_HALVINGS + 1):
        if not len(pieces.start):
            break
        rms, second_half = _straightness(pieces)
        crooked = pieces.each(rms > _CROOKED)
        straight.append(pieces.taken(np.flatnonzero(~crooked), pieces.count[rms <= _CROOKED]))
        rest = np.flatnonzero(crooked)
        half = (2 * pieces.piece() + second_half)[rest]
        pieces = _ordered(pieces.taken(rest, pieces.count[rms > _CROOKED]), half)
    if not straight:
        return pieces
    names = ("points", "gradient", "count")
    return Fragments.of(*(np.concatenate([getattr(f, name) for f in straight]) for name in names))


def _linked(edges: EdgePoints) -> np.ndarray:
    """For each edge point the number of the curve that it is on."""
    number = len(edges.position)
    width, height = edges.image_size
    index = np.full(width * height, -1, np.int32)
    at = edges.pixel[:, 1] * width + edges.pixel[:, 0]
    index[at] = np.arange(number, dtype=np.int32)
    position, normal = edges.position.astype(np.float32), edges.normal.astype(np.float32)
    pairs = []
    for dx, dy in _NEIGHBOURS:
        other = index.take(at + (dy * width + dx))
        first = np.flatnonzero(other >= 0)
        second = other.take(first)
        step = position.take(second, axis=0) - position.take(first, axis=0)
        n = normal.take(first, axis=0)
        turn = dot(n, normal.take(second, axis=0))
        along = (turn if edges.polar else abs(turn)) > _TURN
        along &= abs(dot(n, step)) < _ASIDE
        pairs.append(np.stack([first.compress(along), second.compress(along)]))
    first, second = np.concatenate(pairs, axis=1)
    graph = coo_matrix((np.ones(len(first), bool), (first, second)), shape=(number, number))
    return connected_components(graph, directed=False)[1]


def _ordered(points: Fragments, label: np.ndarray) -> Fragments:
    """Pieces by label, each in order along its main direction, without the short ones."""
    count = np.bincount(label)
    long = count >= _LEAST_POINTS
    kept = np.flatnonzero(long[label])
    return in_order(points.taken(kept[np.argsort(label[kept], kind="stable")], count[long]))


def in_order(pieces: Fragments) -> Fragments:
    """The pieces, the points of each in order along its main direction."""
    if not len(pieces.count):
        return pieces
    mean = pieces.sums(pieces.points) / pieces.count[:, None]
    direction = main_direction(pieces, mean)
    along = dot(pieces.points - pieces.each(mean), pieces.each(direction))
    apart = pieces.piece() * (2 * np.ptp(along) + 1)
    return pieces.taken(np.argsort(apart + along, kind="stable"), pieces.count)


def main_direction(pieces: Fragments, mean: np.ndarray) -> np.ndarray:
    """(f, 2), unit vectors along which the pieces extend most."""
    x, y = (pieces.points[:, axis] - pieces.each(mean[:, axis]) for axis in (0, 1))
    xx, xy, yy = (pieces.sums(product) for product in (x * x, x * y, y * y))
    angle = np.arctan2(2 * xy, xx - yy) / 2
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _straightness(pieces: Fragments) -> tuple[np.ndarray, np.ndarray]:
    """RMS of each piece about its best parabola, px, and which points are in its second half."""
    each, count = pieces.each, pieces.count
    mean = pieces.sums(pieces.points) / count[:, None]
    direction, offset = each(main_direction(pieces, mean)), pieces.points - each(mean)
    along, across = dot(offset, direction), cross(direction, offset)
    along /= each(np.maximum(pieces.sums(abs(along)) / count, 1e-9))
    # The main direction has removed the mean and the slope: what is left of a parabola is its even part,
    # made orthogonal to those two.
    square = along**2
    second, third = pieces.sums(square), pieces.sums(square * along)
    bend = square - each(second / count) - each(third / second) * along
    part = pieces.sums(across * bend) / np.maximum(pieces.sums(bend**2), 1e-9)
    rms = np.sqrt(pieces.sums((across - each(part) * bend) ** 2) / count)
    return rms, places(count) >= each(count / 2)
