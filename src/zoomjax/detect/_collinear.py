"""Pieces of edges that lie on one straight line of the scene, under a model of the distortion.

All pieces are corrected. Two of them join, end to end, when

- both ends of the shorter one lie where the longer one's line says, within what the lines' and the model's
  uncertainty allow;
- the same side is brighter, with like contrast; or the brighter side flips, as at the corners of a
  checkerboard, and they touch, or each has flipped before; but not where either is an edge of a thin bar,
  whose other edge is meant;
- the gap is explained: no longer than some times the visible part of the shorter one, and, where it is
  long, than little more than that part; or it is outside the image;
- they do not run beside each other: the two edges of a thin bar stay two lines;
- each is the nearest such neighbour of the other.

What has joined is taken for pieces, and joins again: first with ends nearby, then with any. At last each
piece is left out of its line in turn, and stays only if the rest predicts it.
"""

import dataclasses

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from ._frame_model import OneFrame
from ._segments import Fragments
from ._units import Lines, Units, along_of, merged, units_of
from ._vectors import dot, norm

_POINT_ERROR = 0.25
"""px by which an edge point is off across the edge, its error being alike over some neighbours."""

_LIKE = 6
"""Neighbouring points whose errors are alike."""

_BLOOM = 1.0
"""px by which an edge may jump where its brighter side flips: bright parts grow on sensors."""

_SIGMAS = 3.0
_ROUGH = 0.6
"""px, RMS: a piece that is straighter is straight, however exact the model."""

_TURN = 0.02
"""rad by which a piece may be turned against its line, besides the uncertainty of both."""

_GAP = 2.5
"""Longest gap, in lengths of what is visible of the shorter side of it."""

_LONG_GAP = (0.06, 40.0)
"""Of the image's shorter side, and px; the larger counts: by no more a gap exceeds what is visible. Farther
off, edges of other things are on the same line by chance: that of a window, and that of a pier below it."""

_CORNER = 4.0
"""px that an edge loses at each end where it meets another: near corners there are no edge points."""

_TOUCH = 14.0
"""px between pieces of one edge whose brighter side flips: corners are blurred, and hold no points."""

_ACROSS = 2.0
"""px across the edge from one end to the other where the brighter side flips, at most. The two edges of a
bar are farther apart, however thin it is: by twice the standard deviation of all smoothing."""

_BAR = 5.0
"""px from an edge of a thin bar to the other one, at most: no tolerance is as wide."""

_WITHIN = (3, 10, 17)
"""Points from the end of a piece at which the other edge is looked for."""

_DIRECTION = 10.0
"""px that stand for a rad by which its normal is not opposite."""

_CONTRAST = 4.0
"""Greatest ratio of the contrasts of neighbours on a line."""

_OVERLAP = 4.0
"""px by which the ends of neighbours may pass each other."""

_ROUNDS = (24, 0)
"""The number of ends looked at for each end; 0: all of the `_MOST` longest units."""

_REPEATS = 3
"""Of each round, at most: until nothing joins."""

_CHECKS = 12
"""So many pieces of a line may go one by one; then all that are still off."""

_MOST = 1200
_LEAST = 10.0
"""px: shorter units join no line across more than their neighbourhood."""


def collinear(pieces: Fragments, model: OneFrame, sigma: float, barred: np.ndarray) -> np.ndarray:
    """(f,), for each piece the number of its line. What is not straight under the model is alone.

    Args:
        pieces: the pieces.
        model: the distortion.
        sigma: px by which lines may be bent because the model is not exact.
        barred: of the pieces, as `thin_bars` tells.
    """
    if not len(pieces.count):
        return np.zeros(0, int)
    units = units_of(pieces, model, barred)
    straight = np.flatnonzero(Lines.of(units.sums).roughness < max(2 * sigma, _ROUGH))
    units = Units(*(getattr(units, field.name)[straight] for field in dataclasses.fields(Units)))
    group = np.arange(len(straight))
    long = max(_LONG_GAP[0] * min(model.image_size), _LONG_GAP[1])
    for nearest in _ROUNDS:
        for _ in range(_REPEATS):
            whole = merged(units, group)
            pairs = _neighbours(whole, nearest) if nearest else _aligned(whole, sigma)
            line = _joined(whole, *_ordered(whole, *pairs), sigma, long)
            group = line[group]
            if len(line) == line.max(initial=-1) + 1:  # each by itself
                break
    label = np.full(len(pieces.count), -1)
    label[straight] = _checked(units, group, sigma)
    alone = label < 0
    label[alone] = label.max(initial=-1) + 1 + np.arange(alone.sum())
    return label


def thin_bars(pieces: Fragments) -> np.ndarray:
    """(f, 2), whether an edge with the other side brighter runs beside the first and the last points."""
    if not len(pieces.count):
        return np.zeros((0, 2), bool)
    steep = norm(pieces.gradient)[:, None]
    normal = _DIRECTION * pieces.gradient / np.maximum(steep, 1e-9)
    known = np.concatenate([pieces.points, normal], axis=1)[::2]
    inwards = np.minimum(_WITHIN, pieces.count[:, None] - 1)
    rows = np.stack([pieces.start[:, None] + inwards, (pieces.start + pieces.count - 1)[:, None] - inwards])
    asked = np.concatenate([pieces.points[rows], -normal[rows]], axis=-1)
    far = _tree(known).query(asked, distance_upper_bound=_BAR)[0]
    return np.isfinite(far).any(axis=-1).T


def _tree(points: np.ndarray) -> KDTree:
    """Of points that are asked for once: soon made."""
    return KDTree(points, compact_nodes=False, balanced_tree=False)


def _neighbours(units: Units, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of units of which ends are near."""
    tips = units.tips.reshape(-1, 2)
    if len(tips) < 4:
        return np.zeros(0, int), np.zeros(0, int)
    other = np.asarray(_tree(tips).query(tips, min(number, len(tips)))[1])
    return np.repeat(np.arange(len(tips)) // 2, other.shape[1]), other.ravel() // 2


def _aligned(units: Units, sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of the longest units of which one lies, roughly, on the other's line."""
    chosen = np.argsort(-units.length, kind="stable")[:_MOST]
    chosen = chosen[units.length[chosen] >= _LEAST]
    middle, normal, *_ = Lines.of(units.sums[chosen])
    offset, within = np.sum(normal * middle, axis=-1)[:, None], _SIGMAS * np.hypot(3 * sigma + 0.5, 0.5)
    near = [
        abs(normal @ units.ends[chosen, end].T - offset) < within * units.stretch[chosen, end]
        for end in (0, 1)
    ]
    first, second = np.nonzero(near[0] & near[1])
    return chosen[first], chosen[second]


def _ordered(units: Units, first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each pair once, the unit with more points first."""
    size = units.sums[:, 6]
    swap = (size[second] > size[first]) | ((size[second] == size[first]) & (second < first))
    longer, shorter = np.where(swap, second, first), np.where(swap, first, second)
    pair = np.sort(longer[longer != shorter] * len(size) + shorter[longer != shorter])
    pair = pair[np.diff(pair, prepend=-1) > 0]
    return pair // len(size), pair % len(size)


def _joined(
    units: Units, longer: np.ndarray, shorter: np.ndarray, sigma: float, long_gap: float
) -> np.ndarray:
    """(u,), the number of the line of each unit, after the pairs that may join have done so."""
    number = len(units.length)
    lines = Lines.of(units.sums)
    miss, keep = _on_line(units, lines, longer, shorter, sigma)
    longer, shorter, miss = longer[keep], shorter[keep], miss[keep]
    origin, way = lines.middle[longer][:, None], along_of(lines.normal)[longer][:, None]
    own, other = dot(units.ends[longer] - origin, way), dot(units.ends[shorter] - origin, way)
    after = other.mean(axis=1) > own.mean(axis=1)
    # The ends that meet: the longer one's, which is its last or first in this direction, and the other's.
    rows = np.arange(len(longer))
    meet = np.where(after, np.argmax(own, axis=1), np.argmin(own, axis=1))
    met = np.where(after, np.argmin(other, axis=1), np.argmax(other, axis=1))
    passed = np.where(after, 1, -1) * (own[rows, meet] - other[rows, met])
    scale = units.length[shorter] / np.maximum(np.ptp(other, axis=1), 1e-9)  # to px of the image
    gap = np.hypot(*(units.tips[longer, meet] - units.tips[shorter, met]).T)
    along = (own[:, 1] > own[:, 0]) == (other[:, 1] > other[:, 0])
    same = units.bright[longer, meet] * units.bright[shorter, met] * np.where(along, 1, -1) > 0
    same |= units.flips[longer] & units.flips[shorter]
    visible = np.minimum(units.sums[longer, 6], units.sums[shorter, 6])
    outside = units.leaves[longer, meet] & units.leaves[shorter, met]
    explained = np.maximum(np.minimum(_GAP * visible + 2 * _CORNER, long_gap + visible), _TOUCH)
    most = np.where(same, np.where(outside, np.inf, explained), _TOUCH)
    fits = (passed * scale < _OVERLAP) & (gap <= most)
    barred = units.barred[longer, meet] | units.barred[shorter, met]
    fits &= same | (~barred & (abs(miss[rows, met]) < _ACROSS))
    fits &= abs(units.contrast[longer, meet] - units.contrast[shorter, met]) < np.log(_CONTRAST)
    first, second = (2 * longer + meet)[fits], (2 * shorter + met)[fits]
    mutual = _mutual(first, second, gap[fits], 2 * number)
    first, second = first[mutual] // 2, second[mutual] // 2
    graph = coo_matrix((np.ones(len(first), bool), (first, second)), shape=(number, number))
    return connected_components(graph, directed=False)[1]


def _on_line(
    units: Units, lines: Lines, longer: np.ndarray, shorter: np.ndarray, sigma: float
) -> tuple[np.ndarray, np.ndarray]:
    """How far the shorter units' ends (p, 2) are off the longer ones' lines; whether they are on them."""
    miss, predicted = _predicted(lines.taken(longer), units.ends[shorter], units.stretch[shorter])
    # The error of a line's end is twice that of its middle.
    own = 2 * _POINT_ERROR * np.sqrt(_LIKE / units.sums[shorter, 6])
    limit = np.minimum(predicted, 2 * sigma + 0.5)
    allowed = _SIGMAS * np.sqrt(sigma**2 + limit**2 + own[:, None] ** 2)
    flips = np.any(units.bright[longer] != units.bright[shorter], axis=1)
    allowed += np.where(flips, _BLOOM, 0.0)[:, None]
    spread = np.hypot(2 * own, predicted[:, 1] - predicted[:, 0])
    turned = abs(miss[:, 1] - miss[:, 0]) < _SIGMAS * spread + _TURN * units.length[shorter]
    return miss, np.all(abs(miss) < allowed, axis=1) & turned


def _predicted(lines: Lines, ends: np.ndarray, stretch: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances (p, 2) of ends (p, 2, 2) from lines, and the lines' uncertainty there, px of the image."""
    offset = ends - lines.middle[:, None]
    along = dot(offset, along_of(lines.normal)[:, None])
    share = 1 / lines.weight[:, None] + along**2 / np.maximum(lines.spread, 1e-9)[:, None]
    miss = dot(offset, lines.normal[:, None]) / stretch
    return miss, _POINT_ERROR * np.sqrt(_LIKE * share) / stretch


def _mutual(first: np.ndarray, second: np.ndarray, gap: np.ndarray, number: int) -> np.ndarray:
    """Which pairs of ends are nearest to each other, among all pairs that they are in."""
    least = np.full(number, np.inf)
    np.minimum.at(least, first, gap)
    np.minimum.at(least, second, gap)
    return (gap <= least[first]) & (gap <= least[second])


def _checked(units: Units, group: np.ndarray, sigma: float) -> np.ndarray:
    """The groups, and -1 for units that the rest of their group does not predict.

    Of each group the unit that is off by most of its tolerances goes, and the others that are off are
    checked again: a long wrong one makes all others seem so.
    """
    group = group.copy()
    total = np.zeros((int(group.max(initial=-1)) + 1, 7))
    np.add.at(total, group, units.sums)
    some = np.arange(len(group))
    for left in range(_CHECKS, -1, -1):
        excess = _excess(units, total[group[some]], some, sigma)
        some, excess = some[excess > 1], excess[excess > 1]
        order = np.lexsort((-excess, group[some]))
        if left:
            order = order[np.flatnonzero(np.diff(group[some][order], prepend=-1))]
        gone = some[order]
        if not len(gone):
            break
        np.subtract.at(total, group[gone], units.sums[gone])
        group[gone] = -1
        some = some[group[some] >= 0]
    return group


def _excess(units: Units, total: np.ndarray, some: np.ndarray, sigma: float) -> np.ndarray:
    """By how many tolerances units are off what the rest predicts; 0 where that is less than the unit."""
    sums = units.sums[some]
    rest = total - sums
    several = rest[:, 6] > sums[:, 6]
    rest = np.where(several[:, None], rest, total)
    miss, predicted = _predicted(Lines.of(rest), units.ends[some], units.stretch[some])
    own = 2 * _POINT_ERROR * np.sqrt(_LIKE / sums[:, 6])
    allowed = _SIGMAS * np.sqrt(sigma**2 + predicted**2 + own[:, None] ** 2) + _BLOOM
    return np.where(several, np.max(abs(miss) / allowed, axis=1), 0.0)
