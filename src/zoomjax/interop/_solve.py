"""Which focal lengths and coefficients a file gets, and how far its reader is from the lens.

At each focal length the lens's own coefficients are taken where the tool's formula is ours, else the
formula is fitted anew. Between focal lengths the tool's own interpolation is run on the numbers of the
file, and more focal lengths are taken until that is within the tolerance, or gains nothing. What was
written is read again: the error that is reported is that of the file.
"""

import dataclasses
import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..models.brown_conrady import BrownConrady
from ..models.distortion import Distortion
from ..models.division import Division
from ..models.lens import ZoomLens
from ..models.polynomial import RadialPolynomial
from ..models.tables import TableZoom
from ._forms import AbstractForm, Form
from ._samples import Pairs, distortions, pairs
from .base import Export, Format, Import, InterpolatedFormat, Node, NodeFormat

_FEW = 5
"""Focal lengths at which formulas are compared."""

_NUMBERS = (2, 3, 5, 7, 9, 13, 17, 25, 33, 49, 65, 97, 129)
"""Of focal lengths that are tried."""

_BETWEEN = (0.12, 0.31, 0.5, 0.69, 0.88)
"""Where errors are looked at, between two focal lengths."""

_IDLE, _GAIN, _ENOUGH = 2, 0.95, 17
"""The search ends where so many tries have not brought the error below that share, with enough nodes."""

_APART = 1.001
"""Ratio of focal lengths that are told apart."""

_WRITTEN = 1 + 2e-8
"""Ratio of focal lengths that differ where they are written with nine digits."""


@dataclasses.dataclass(frozen=True)
class Solution:
    """The nodes of a file, and their errors, px (see `Report`)."""

    nodes: list[Node]
    at_nodes: float
    between: float | None

    @property
    def worst(self) -> float:
        """The greatest error anywhere."""
        return max(self.at_nodes, self.between or 0.0)


def solve(fmt: NodeFormat, job: Export) -> Solution:
    """The nodes of a file, by the best of the format's formulas: the first within the tolerance."""
    low, high = np.asarray(job.lens.focal_range, float) if job.focal is None else (0, 0)
    focal = np.array(job.focal) if job.focal is not None else np.geomspace(low, high, _FEW)
    if high <= low * _WRITTEN and job.focal is None:
        focal = focal[:1]
    maker = min(_makers(fmt, focal, job), key=lambda made: made[1])[0]
    if not isinstance(fmt, InterpolatedFormat) or len(focal) == 1:
        return Solution(*maker.nodes(focal), None)
    if job.focal is not None:
        return _checked(fmt, *maker.nodes(focal), job)
    tried: list[Solution] = []
    for focal in _places(fmt, job.lens, low, high):
        found = _checked(fmt, *maker.nodes(focal), job)
        if found.worst <= job.tolerance:
            return found
        tried.append(found)
        if found.at_nodes > job.tolerance and (found.between or 0.0) <= found.at_nodes + job.tolerance:
            break  # the formula is what is wrong, not the number of nodes
        worst = [solution.worst for solution in tried]
        idle = len(tried) > _IDLE and min(worst[-_IDLE:]) > _GAIN * min(worst[:-_IDLE])
        if idle and len(focal) >= _ENOUGH:
            break
    least = min(solution.worst for solution in tried)
    return next(solution for solution in tried if solution.worst <= least / _GAIN)


def _places(fmt: InterpolatedFormat, lens: ZoomLens, low: float, high: float) -> Iterator[np.ndarray]:
    """Focal lengths of the nodes, more and more: the lens's own, where it is a table, else spread out."""
    most, zoom = _NUMBERS[-1], lens.zoom
    if isinstance(zoom, TableZoom) and zoom.knots is not None:
        own = np.asarray(zoom.knots, float)
        own = 1 / own if zoom.inverse else own
        own = np.unique([low, *own[(own > low * _APART) & (own < high / _APART)], high])
        for place in range(1, len(own) - 1):
            own[place] = max(own[place], own[place - 1] * _WRITTEN)
        while len(own) <= most:
            yield own
            wide = own[1:] > own[:-1] * _APART
            if not wide.any():
                break
            own = np.sort(np.concatenate([own, (own[1:] + own[:-1])[wide] / 2]))
    for number in _NUMBERS:
        yield fmt.spread(low, high, number)


def _makers(fmt: NodeFormat, focal: np.ndarray, job: Export) -> list[tuple["_Maker", float]]:
    """A maker of nodes for each formula up to the first within the tolerance, and its error at some."""
    tried = []
    for form in fmt.forms(job.lens):
        tried.append((maker := _Maker(form, job), maker.nodes(focal)[1]))
        if tried[-1][1] <= job.tolerance:
            break
    return tried


class _Maker:
    """Makes the nodes of one formula, each once."""

    def __init__(self, form: AbstractForm, job: Export):
        self.form, self.job = form, job
        self.made: dict[float, tuple[Node, float]] = {}

    def nodes(self, focal: np.ndarray) -> tuple[list[Node], float]:
        """A node at each focal length, and the greatest error at one, px."""
        missing = np.array(sorted({float(f) for f in focal} - set(self.made)))
        if missing.size:
            each = distortions(self.job.lens, missing)
            ends = _from_to(self.form, each, missing, self.job)
            for f, distortion, pair in zip(missing, each, ends, strict=True):
                self.made[float(f)] = self._node(float(f), distortion, *pair)
        nodes, errors = zip(*(self.made[float(f)] for f in focal), strict=True)
        frames = self.job.frames or [None] * len(nodes)
        nodes = [dataclasses.replace(n, frame=frame) for n, frame in zip(nodes, frames, strict=True)]
        return nodes, max(errors)

    def _node(
        self, focal: float, distortion: Distortion, start: np.ndarray, end: np.ndarray
    ) -> tuple[Node, float]:
        centre = np.asarray(distortion.centre)
        theta = same(self.form, distortion)
        theta = self.form.fit(start, end) if theta is None else theta
        node = Node(focal, self.form, theta, centre)
        return node, _error(node, centre, start, end, self.job)


def _from_to(form: AbstractForm, each: list[Distortion], focal: np.ndarray, job: Export) -> list[Pairs]:
    """The points that a formula maps, and what to, in half diagonals from the centre."""
    found = pairs(each, job.lens.image_size, focal, all_rays=job.lens.shift is not None)
    return found if form.corrects else [(corrected, distorted) for distorted, corrected in found]


def _checked(fmt: InterpolatedFormat, nodes: list[Node], at_nodes: float, job: Export) -> Solution:
    """The solution of formats that interpolate: their reader is run between the nodes, and at them."""
    nodes = fmt.kept(nodes)
    focal = np.array([node.focal for node in nodes])
    numbers = np.array([fmt.foreign(node, job) for node in nodes])
    inside = np.concatenate([a + (b - a) * np.array(_BETWEEN) for a, b in itertools.pairwise(focal)])
    worst = {True: at_nodes, False: 0.0}
    tried = np.concatenate([focal, inside])
    each = distortions(job.lens, tried)
    ends = _from_to(nodes[0].form, each, tried, job)
    for place, (f, distortion, pair) in enumerate(zip(tried, each, ends, strict=True)):
        read = fmt.native(fmt.interpolate(focal, numbers, float(f)), float(f), nodes[0], job)
        at_node = place < len(focal)
        error = _error(read, np.asarray(distortion.centre), *pair, job)
        worst[at_node] = max(worst[at_node], error)
    return Solution(nodes, worst[True], worst[False] if len(focal) > 1 else None)


def _error(node: Node, centre: np.ndarray, start: np.ndarray, end: np.ndarray, job: Export) -> float:
    """The greatest distance, px, of what a node makes of points from what the lens makes of them."""
    offset = (centre - node.centre) / job.lens.scale
    distance = node.form.distances(node.theta, start + offset, end + offset)
    return float(distance.max() * job.lens.scale) if np.isfinite(distance).all() else np.inf


def error_written(fmt: Format, nodes: list[Node], job: Export, files: list[Path]) -> float:
    """The greatest error, px, of what files hold at their nodes, by the format's own reader.

    Args:
        fmt: the format.
        nodes: what was written.
        job: of the lens.
        files: one with all nodes, or one for each of them.
    """
    parts = [nodes] if len(files) == 1 else [[node] for node in nodes]
    focal = sorted({node.focal for node in nodes})
    exact = dict(zip(focal, distortions(job.lens, np.array(focal)), strict=True))
    ends: dict[AbstractForm, dict[float, Pairs]] = {}
    worst = 0.0
    for file, part in zip(files, parts, strict=True):
        of = tuple(node.focal for node in part)
        # In mm, where these are known.
        told = of if job.pixel_pitch is None else tuple(float(job.focal_mm(f)) for f in of)
        found = fmt.read(Import(file, (file,), job.lens.image_size, told)).nodes
        for node, f in zip(found, of, strict=True):
            assert isinstance(node, Node)
            if node.form not in ends:
                all_of_them = _from_to(node.form, list(exact.values()), np.array(focal), job)
                ends[node.form] = dict(zip(focal, all_of_them, strict=True))
            worst = max(worst, _error(node, np.asarray(exact[f].centre), *ends[node.form][f], job))
    return worst


def same(form: AbstractForm, distortion: Distortion) -> np.ndarray | None:
    """The lens's own coefficients for a formula that holds it, else None."""
    if not isinstance(form, Form) or not form.corrects:
        return None
    k, kind = np.asarray(distortion.coefficients, float), type(distortion.distortion_model)
    theta = np.zeros(len(form.orders))
    numerators, denominators, p = form.split(theta)  # views: what is written there is in theta
    if kind is RadialPolynomial and len(k) <= len(numerators):
        numerators[: len(k)] = k
    elif kind is Division and len(k) <= len(denominators):
        denominators[: len(k)] = k
    elif kind is BrownConrady and len(k) - 2 <= len(numerators) and form.tangential:
        numerators[: len(k) - 2], p[:] = k[:-2], k[-2:]
    else:
        return None
    return theta
