"""Focal lengths from oblique views of flat grids: one a photo, or one for all photos of one zoom.

Photos of one zoom are known to be so, by their EXIF data or their folders, or are found by the focal
lengths that each has alone. Their homographies then determine one focal length together
(`focal_from_planes`). It is also that of photos of the zoom that show no grid, or show one squarely.

Estimates are compared in 1/f², in which Zhang's equations are linear. Of n photos with a standard deviation
each, the sum of squares about the common value, in those deviations, is expected to be n - 1. If it is
more, the photos have errors that the noise of their points does not explain, such as a board that is not
flat, and the standard deviation is multiplied by the root of the ratio.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import gammaincc

from ..detect.batch import Detection
from ..focal.estimate import FocalEstimate
from ..focal.plane import focal_from_planes
from ..lines.buckets import bucket
from ..models.distortion import Distortion

SHARED_BY = ("exif", "folder", "similarity")
"""How photos of one zoom are known or found."""

ONE_ZOOM = "one zoom"
"""All photos are of one, where nothing says which are: supposed, never asked for."""

MOST_UNCERTAIN = 0.2
"""Largest standard deviation, relative to the focal length, of an estimate that is used."""

_ALIKE, _SEVERAL = 1.3, 6
"""Ratio of the focal lengths that photos of one zoom have alone, from a board that may be bent; and the
number of photos from which it is not asked for."""

_OF_ONE_ZOOM = 0.012
"""Standard deviation of a common focal length, by photos, relative to it, up to which they may share it:
more than photos of one zoom of a real camera leave, and less than those with several at a longer one."""

_LEAST_DEPTH = 0.01
"""Part by which the depth of a grid's nodes differs where it tells a focal length. What the correction and
cells that are not quite square leave is as large in a view from the front, whatever the noise is."""

_UNLIKELY = 0.01
"""Probability of photos that differ by so much, or more, below which they do not share a focal length."""

_VIEWS, _OF_A_GROUP, _POINTS = (8, 32, 64, 128), (8, 32), (64, 128, 256)
"""Numbers of views, of those of one focal length, and of points of each, that programs are compiled for."""

_EXACT = 1e-9
"""Relative standard deviation below which focal lengths are not told apart."""


@dataclasses.dataclass(frozen=True)
class FocalGroup:
    """Photos that share a focal length.

    Attributes:
        names: of the photos.
        focal, std: their focal length and its standard deviation.
        alone: the shortest and the longest focal length of single photos; None if none has one.
        agree: whether those differ by no more than their standard deviations explain.
    """

    names: tuple[str, ...]
    focal: float
    std: float
    alone: tuple[float, float] | None = None
    agree: bool = True

    def spread(self) -> float:
        """How many times the shortest focal length of a single photo the longest is."""
        return 1.0 if self.alone is None else self.alone[1] / self.alone[0]

    def sentence(self, unit: str) -> str:
        """The group in words."""
        digits = max(0, -math.floor(math.log10(self.std))) if 0 < self.std < 1 else 0
        told = (
            f"{len(self.names)} photos share f = {self.focal:,.{digits}f} ± {self.std:,.{digits}f} {unit}"
        )
        if self.agree or self.alone is None:
            return f"{told}."
        low, high = self.alone
        return (
            f"{told}, but alone they give {low:,.0f} to {high:,.0f} {unit}: farther apart than "
            "their standard deviations explain."
        )


@dataclasses.dataclass(frozen=True)
class Sharing:
    """Which photos share a focal length.

    Attributes:
        how: one of `SHARED_BY`, or `ONE_ZOOM`.
        sigma: the standard deviations of focal lengths; None for those of the estimates.
    """

    how: str
    sigma: Callable[[np.ndarray], np.ndarray] | None = None

    def known(self, detections: Sequence[Detection]) -> np.ndarray | None:
        """A number for each image, the same for those of one zoom; None where that is to be found."""
        if self.how == "similarity":
            return None
        if self.how == ONE_ZOOM:
            return np.zeros(len(detections), int)
        numbers: dict[object, int] = {}
        keys = (
            (d.focal or d.name) if self.how == "exif" else (Path(d.file).parent if d.file else d.name)
            for d in detections
        )
        return np.array([numbers.setdefault(key, len(numbers)) for key in keys], int)


class Found(NamedTuple):
    """Focal lengths by the names of images, and which are shared."""

    focal: dict[str, FocalEstimate]
    groups: tuple[FocalGroup, ...] = ()


def focals_from_grids(
    detections: Sequence[Detection], corrections: Sequence[Distortion], sharing: Sharing | None = None
) -> Found:
    """The focal lengths that the grids in images determine well enough."""
    views = _views(detections, corrections)
    if views is None:
        return Found({})
    _, all_alone = focal_from_planes(views.points, views.plane, principal=np.zeros(2), mask=views.mask)
    each = jax.tree.map(lambda of: np.asarray(of)[: len(detections)], all_alone)
    focal, std, rms = (np.asarray(of) for of in (each.focal, each.std, each.rms))
    good = np.isfinite(focal) & (std < MOST_UNCERTAIN * np.nan_to_num(focal))
    alone = {int(i): jax.tree.map(lambda of, i=i: of[i], each) for i in np.flatnonzero(good)}
    if sharing is None:
        return Found({detections[i].name: estimate for i, estimate in alone.items()})
    if sharing.sigma is not None:
        std = np.where(good, sharing.sigma(np.where(good, focal, 1.0)), np.inf)
    numbers = sharing.known(detections)
    if numbers is None:
        numbers = np.arange(len(detections))
        numbers[good] = len(detections) + similar(focal[good], std[good])
    members = [np.flatnonzero(numbers == number) for number in dict.fromkeys(numbers.tolist())]
    most = max(map(len, members))
    found, groups = {}, []
    for group in members:
        if len(group) == 1:
            found |= {detections[i].name: alone[i] for i in group.tolist() if i in alone}
            continue
        together = _together(views, group[np.isfinite(rms[group])], most)
        if together is None:
            continue
        own = group[good[group]]
        squares = _squares(focal[own], std[own], float(together.focal))
        free = max(len(own) - 1, 1)
        wider = float(together.std) * math.sqrt(max(squares / free, 1.0))
        together = FocalEstimate(together.focal, jnp.asarray(wider), together.rms)
        names = tuple(detections[i].name for i in group.tolist())
        found |= dict.fromkeys(names, together)
        groups.append(
            FocalGroup(
                names,
                float(together.focal),
                wider,
                (float(focal[own].min()), float(focal[own].max())) if len(own) else None,
                bool(gammaincc(free / 2, squares / 2) > _UNLIKELY),
            )
        )
    return Found(found, tuple(sorted(groups, key=lambda group: group.focal)))


def may_be_of_one_zoom(groups: Sequence[FocalGroup], number: int = 0, precision: float = 0.0) -> bool:
    """Whether photos of which nothing is known may share a focal length.

    Where they are of several zooms, photos pull a common one apart, and few photos differ by themselves.

    Args:
        groups: with the focal lengths that photos have alone.
        number: of photos in a bundle adjustment with one focal length for all.
        precision: its standard deviation, relative to it.
    """
    alike = all(group.spread() < _ALIKE for group in groups)
    return precision < _OF_ONE_ZOOM and (alike or number >= _SEVERAL)


def similar(focal: np.ndarray, std: np.ndarray) -> np.ndarray:
    """A number for each focal length, the same for those that agree within their standard deviations.

    Neighbours in f are joined, the most alike first, as long as all of a group can be of one value.
    """
    if not len(focal):
        return np.zeros(0, int)
    order = np.argsort(focal, kind="stable")
    w, weight = 1 / focal[order] ** 2, 1 / _std_of_inverse(focal, std)[order] ** 2
    w = w - w.mean()  # so that few digits are lost
    # Of each group: its number, and the sums of weights, weighted values and their squares.
    sums = np.stack([np.ones(len(w)), weight, weight * w, weight * w**2], axis=1)
    while len(sums) > 1:
        joined = sums[:-1] + sums[1:]
        squares = np.maximum(joined[:, 3] - joined[:, 2] ** 2 / joined[:, 1], 0)
        likely = gammaincc((joined[:, 0] - 1) / 2, squares / 2)
        best = int(np.argmax(likely))
        if likely[best] < _UNLIKELY:
            break
        sums = np.concatenate([sums[:best], joined[best : best + 1], sums[best + 2 :]])
    numbers = np.empty(len(focal), int)
    numbers[order] = np.repeat(np.arange(len(sums)), sums[:, 0].astype(int))
    return numbers


def _std_of_inverse(focal: np.ndarray, std: np.ndarray) -> np.ndarray:
    """Standard deviations of 1/f²; above 0, as those of exact points are not."""
    return 2 * np.maximum(std, _EXACT * focal) / focal**3


def _squares(focal: np.ndarray, std: np.ndarray, common: float) -> float:
    """The sum of squared differences from a common focal length, in standard deviations."""
    off = (1 / focal**2 - 1 / common**2) / _std_of_inverse(focal, std)
    return float(off @ off) if len(off) > 1 else 0.0


class _Views(NamedTuple):
    """Nodes of grids, corrected and about the centre, px, and their places in the grid, steps.

    In arrays of one shape, and of few sizes, so that all is compiled once; images without a grid, and those
    that are not there, have no valid points.
    """

    points: np.ndarray
    plane: np.ndarray
    mask: np.ndarray


def _views(detections: Sequence[Detection], corrections: Sequence[Distortion]) -> _Views | None:
    """The nodes of all images; None if none has a grid."""
    known = [nodes(d, c) for d, c in zip(detections, corrections, strict=True)]
    most = max((len(of[0]) for of in known if of is not None), default=0)
    if not most:
        return None
    shape = (bucket(len(known), _VIEWS), bucket(most, _POINTS))
    views = _Views(np.zeros((*shape, 2)), np.zeros((*shape, 2)), np.zeros(shape, bool))
    for view, (of, correction) in enumerate(zip(known, corrections, strict=True)):
        if of is None or not np.isfinite(of[0]).all() or not _differ_in_depth(*of):
            continue
        points, places = of
        views.points[view, : len(points)] = points - np.asarray(correction.centre)
        views.plane[view, : len(points)] = places
        views.mask[view, : len(points)] = True
    return views


def _together(views: _Views, group: np.ndarray, most: int) -> FocalEstimate | None:
    """One focal length of several views, if they determine one; `most` views are in any group."""
    shape = bucket(most, _OF_A_GROUP)
    points, plane, mask = (np.zeros((shape, *of.shape[1:]), of.dtype) for of in views)
    points[: len(group)], plane[: len(group)] = views.points[group], views.plane[group]
    mask[: len(group)] = views.mask[group]
    if not mask.any():
        return None
    together, _ = focal_from_planes(points, plane, principal=np.zeros(2), mask=mask)
    focal, std = float(together.focal), float(together.std)
    return together if np.isfinite(focal) and std < MOST_UNCERTAIN * focal else None


def nodes(detection: Detection, correction: Distortion) -> tuple[np.ndarray, np.ndarray] | None:
    """Corrected nodes, px, and their positions in the grid, steps; None if there are too few."""
    if detection.nodes is None or not np.isfinite(np.asarray(correction.coefficients)).all():
        return None
    seen = np.isfinite(detection.nodes[..., 0])
    row, column = np.nonzero(seen)
    if np.unique(row).size < 3 or np.unique(column).size < 3:
        return None
    corrected = np.asarray(correction.undistort(detection.nodes[seen]))
    places = np.stack([column, row], axis=-1).astype(float)
    return corrected, places


def _differ_in_depth(points: np.ndarray, places: np.ndarray) -> bool:
    """Whether some nodes of a grid are farther away than others, by the homography of all."""
    image, plane = (((of - of.mean(axis=0)) / of.std(axis=0)) for of in (points, places))
    row, none = np.column_stack([plane, np.ones(len(plane))]), np.zeros((len(plane), 3))
    table = np.block([[row, none, -image[:, :1] * row], [none, row, -image[:, 1:] * row]])
    depth = row @ np.linalg.svd(table, full_matrices=False)[2][-1, 6:]
    return float(np.ptp(depth)) > _LEAST_DEPTH * abs(float(depth.mean()))
