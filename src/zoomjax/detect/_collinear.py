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

A line is known by sums over its points (weights, first and second moments) that add up when pieces join,
with weights that make distances px of the image.
"""

import dataclasses

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from ._frame_model import OneFrame
from ._segments import Fragments, main_direction
from ._vectors import cross, dot, norm

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

_ROUNDS = (24, 24, 24, 0, 0, 0)
"""In each round, the number of ends looked at for each end; 0: all of the `_MOST` longest units."""

_MARGIN = 8.0
"""px from the image's edge within which an edge leaves the image: nearer there are no edge points."""

_CHECKS = 12
"""So many pieces of a line may go one by one; then all that are still off."""

_MOST = 1200
_LEAST = 10.0
"""px: shorter units join no line across more than their neighbourhood."""


@dataclasses.dataclass(frozen=True)
class _Units:
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
    units = _units(pieces, model, barred)
    _, _, roughness = _line(units.sums)
    straight = np.flatnonzero(roughness < max(2 * sigma, _ROUGH))
    units = _Units(*(getattr(units, field.name)[straight] for field in dataclasses.fields(_Units)))
    group = np.arange(len(straight))
    long = max(_LONG_GAP[0] * min(model.image_size), _LONG_GAP[1])
    for nearest in _ROUNDS:
        whole = _merged(units, group)
        pairs = _neighbours(whole, nearest) if nearest else _aligned(whole, sigma)
        group = _joined(whole, *_ordered(whole, *pairs), sigma, long)[group]
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
    tree = KDTree(known, compact_nodes=False, balanced_tree=False)  # sooner made, and asked once
    far = tree.query(asked, distance_upper_bound=_BAR)[0]
    return np.isfinite(far).any(axis=-1).T


def _units(pieces: Fragments, model: OneFrame, barred: np.ndarray) -> _Units:
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
    w, (x, y) = stretch**-2.0, corrected.T
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
    return _Units(
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


def _line(sums: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Middle (..., 2), unit normal (..., 2) and roughness, px of the image, of the best lines from sums."""
    w, wx, wy, wxx, wxy, wyy, n = np.moveaxis(sums, -1, 0)
    x, y = wx / w, wy / w
    xx, xy, yy = wxx - x * wx, wxy - x * wy, wyy - y * wy
    angle = np.arctan2(2 * xy, xx - yy) / 2
    least = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)
    normal = np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
    return np.stack([x, y], axis=-1), normal, np.sqrt(np.maximum(least, 0) / n)


def _along(normal: np.ndarray) -> np.ndarray:
    """Unit vectors (..., 2) along lines, from their normals."""
    return np.stack([normal[..., 1], -normal[..., 0]], axis=-1)


def _merged(units: _Units, group: np.ndarray) -> _Units:
    """The units of each group as one."""
    number = int(group.max(initial=-1)) + 1
    sums = np.zeros((number, 7))
    np.add.at(sums, group, units.sums)
    middle, normal, _ = _line(sums)
    along = np.einsum("uec,uc->ue", units.ends - middle[group, None], _along(normal)[group])
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
    return _Units(
        sums,
        middle[:, None] + place[picked][..., None] * _along(normal)[:, None],
        tips,
        units.stretch[unit, end],
        units.bright[unit, end] * forwards,
        units.contrast[unit, end],
        np.hypot(*(tips[:, 1] - tips[:, 0]).T),
        units.leaves[unit, end],
        flips,
        units.barred[unit, end],
    )


def _neighbours(units: _Units, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of units of which ends are near."""
    tips = units.tips.reshape(-1, 2)
    if len(tips) < 4:
        return np.zeros(0, int), np.zeros(0, int)
    other = np.asarray(KDTree(tips).query(tips, min(number, len(tips)))[1])
    return np.repeat(np.arange(len(tips)) // 2, other.shape[1]), other.ravel() // 2


def _aligned(units: _Units, sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of the longest units of which one lies, roughly, on the other's line."""
    chosen = np.argsort(-units.length, kind="stable")[:_MOST]
    chosen = chosen[units.length[chosen] >= _LEAST]
    middle, normal, _ = _line(units.sums[chosen])
    offset, within = np.sum(normal * middle, axis=-1)[:, None], _SIGMAS * np.hypot(3 * sigma + 0.5, 0.5)
    near = [
        abs(normal @ units.ends[chosen, end].T - offset) < within * units.stretch[chosen, end]
        for end in (0, 1)
    ]
    first, second = np.nonzero(near[0] & near[1])
    return chosen[first], chosen[second]


def _ordered(units: _Units, first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each pair once, the unit with more points first."""
    size = units.sums[:, 6]
    swap = (size[second] > size[first]) | ((size[second] == size[first]) & (second < first))
    longer, shorter = np.where(swap, second, first), np.where(swap, first, second)
    pair = np.sort(longer[longer != shorter] * len(size) + shorter[longer != shorter])
    pair = pair[np.diff(pair, prepend=-1) > 0]
    return pair // len(size), pair % len(size)


def _joined(
    units: _Units, longer: np.ndarray, shorter: np.ndarray, sigma: float, long_gap: float
) -> np.ndarray:
    """(u,), the number of the line of each unit, after the pairs that may join have done so."""
    number = len(units.length)
    middle, normal, _ = _line(units.sums)
    miss, keep = _on_line(units, longer, shorter, sigma)
    longer, shorter, miss = longer[keep], shorter[keep], miss[keep]
    origin, way = middle[longer][:, None], _along(normal)[longer][:, None]
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
    units: _Units, longer: np.ndarray, shorter: np.ndarray, sigma: float
) -> tuple[np.ndarray, np.ndarray]:
    """How far the shorter units' ends (p, 2) are off the longer ones' lines; whether they are on them."""
    miss, predicted = _predicted(units.sums[longer], units.ends[shorter], units.stretch[shorter])
    # The error of a line's end is twice that of its middle.
    own = 2 * _POINT_ERROR * np.sqrt(_LIKE / units.sums[shorter, 6])
    limit = np.minimum(predicted, 2 * sigma + 0.5)
    allowed = _SIGMAS * np.sqrt(sigma**2 + limit**2 + own[:, None] ** 2)
    flips = np.any(units.bright[longer] != units.bright[shorter], axis=1)
    allowed += np.where(flips, _BLOOM, 0.0)[:, None]
    spread = np.hypot(2 * own, predicted[:, 1] - predicted[:, 0])
    turned = abs(miss[:, 1] - miss[:, 0]) < _SIGMAS * spread + _TURN * units.length[shorter]
    return miss, np.all(abs(miss) < allowed, axis=1) & turned


def _predicted(sums: np.ndarray, ends: np.ndarray, stretch: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances (p, 2) of ends (p, 2, 2) from lines, and the lines' uncertainty there, px of the image."""
    middle, normal, _ = _line(sums)
    direction = _along(normal)
    offset = ends - middle[:, None]
    along = dot(offset, direction[:, None])
    w, wx, wy, wxx, wxy, wyy, _ = sums.T
    a, b = direction.T
    extent = a * a * (wxx - wx * wx / w) + 2 * a * b * (wxy - wx * wy / w) + b * b * (wyy - wy * wy / w)
    share = 1 / w[:, None] + along**2 / np.maximum(extent, 1e-9)[:, None]
    miss = dot(offset, normal[:, None]) / stretch
    return miss, _POINT_ERROR * np.sqrt(_LIKE * share) / stretch


def _mutual(first: np.ndarray, second: np.ndarray, gap: np.ndarray, number: int) -> np.ndarray:
    """Which pairs of ends are nearest to each other, among all pairs that they are in."""
    least = np.full(number, np.inf)
    np.minimum.at(least, first, gap)
    np.minimum.at(least, second, gap)
    return (gap <= least[first]) & (gap <= least[second])


def _checked(units: _Units, group: np.ndarray, sigma: float) -> np.ndarray:
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


def _excess(units: _Units, total: np.ndarray, some: np.ndarray, sigma: float) -> np.ndarray:
    """By how many tolerances units are off what the rest predicts; 0 where that is less than the unit."""
    sums = units.sums[some]
    rest = total - sums
    several = rest[:, 6] > sums[:, 6]
    rest = np.where(several[:, None], rest, total)
    miss, predicted = _predicted(rest, units.ends[some], units.stretch[some])
    own = 2 * _POINT_ERROR * np.sqrt(_LIKE / sums[:, 6])
    allowed = _SIGMAS * np.sqrt(sigma**2 + predicted**2 + own[:, None] ** 2) + _BLOOM
    return np.where(several, np.max(abs(miss) / allowed, axis=1), 0.0)
