"""A lens at many focal lengths, and how far it moves a point outward: for tables, plots and reports."""

import dataclasses
from collections.abc import Iterable

import numpy as np

from ..lines.buckets import bucket, padded_to
from ..models.distortion import Distortion
from ..models.lens import ZoomLens
from ..models.sizes import at_focal

_FOCALS = (32, 128)
"""Numbers of focal lengths that a program is compiled for; larger ones are four to each doubling."""


def distortion_at(lens: ZoomLens, focal: Iterable[float]) -> Distortion:
    """The distortion at focal lengths, one or more, along the first axis, in NumPy's arrays."""
    focal = np.asarray(list(focal), float)
    both = at_focal(lens, padded_to(focal, bucket(len(focal), _FOCALS)))
    k, centre, scale = (np.asarray(of) for of in (both.coefficients, both.centre, both.scale))
    centre = centre if centre.ndim == 1 else centre[: len(focal)]
    return dataclasses.replace(both, coefficients=k[: len(focal)], centre=centre, scale=scale)


def distortions_at(lens: ZoomLens, focal: Iterable[float]) -> list[Distortion]:
    """The distortion at each focal length, in NumPy's arrays.

    As ``[lens(f) for f in focal]``, which runs an operation of JAX after the other for each.
    """
    focal = list(focal)
    if not focal:
        return []
    every = distortion_at(lens, focal)
    k, centre = every.coefficients, np.broadcast_to(every.centre, (len(focal), 2))
    return [
        dataclasses.replace(every, coefficients=k[place], centre=centre[place])
        for place in range(len(focal))
    ]


def middle_centre(lens: ZoomLens) -> np.ndarray:
    """The centre of distortion, px: in the middle of the zoom, in 1/f, if it moves along it."""
    return np.asarray(lens.centre_at(middle_focal(lens)))


def middle_focal(lens: ZoomLens) -> float:
    """The focal length in the middle of the zoom, in 1/f."""
    low, high = (float(f) for f in np.asarray(lens.focal_range))
    return 2 / (1 / low + 1 / high)


def outward(lens: ZoomLens, points: np.ndarray, focal: Iterable[float]) -> np.ndarray:
    """Displacement of points (..., 2) away from the centre of distortion, px, at each focal length, first.

    The centre is that at the focal length, if it moves along the zoom.
    """
    every = distortion_at(lens, focal)
    points = np.broadcast_to(points, (len(every.coefficients), *np.shape(points)))
    centre = np.asarray(every.centre).reshape(-1, *[1] * (points.ndim - 2), 2)
    before, after = points - centre, np.asarray(every.undistort(points)) - centre
    return np.hypot(after[..., 0], after[..., 1]) - np.hypot(before[..., 0], before[..., 1])
