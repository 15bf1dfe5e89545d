"""Sub-pixel edge points: where the slope of the grey levels is steepest, pixel by pixel.

In the manner of Canny and Devernay: smooth, differentiate, keep the maxima of the slope across the edge,
refine each to a fraction of a pixel. Two things differ. The maximum is sought along the row or the column
that crosses the edge more steeply, not along the gradient: the profile of a straight edge along a row is
the profile across it, stretched, so nothing has to be interpolated, and a row or column gives one point.
And the peak is that of the Gaussian, not the parabola, through three slopes: an edge smoothed by a Gaussian
has a Gaussian slope, and Devernay's parabola is biased towards the pixel's centre by up to 0.03 px.

Work a pixel: one smoothing, two Sobel filters, one threshold, by OpenCV in bytes and 16-bit integers; all
else is done for the few pixels on edges.
"""

import dataclasses

import cv2
import numpy as np

from ._vectors import norm

_SMOOTHING = 1.0
"""px, standard deviation. With Sobel's own it makes 1.4: noise of 5 levels moves an edge
of 160 by 0.04 px."""

_APERTURE = 5
"""Of Sobel's filter. 3 is less of a Gaussian: errors without noise grow from 0.017 to 0.023 px."""

_TO_BYTE = 1 / 32
"""Takes the slope of the steepest edge there can be, 7600 in units of Sobel's filter, to a byte."""

_FLOOR = 320.0
"""Least slope of an edge, in those units: a sharp step of 11 grey levels. Below lies dither."""

_NOISE_LEVELS = 4.0
"""Least slope in standard deviations of the slope of the noise."""

_OF_STRONGEST = 0.1
"""Least slope as a share of the strong edges' (the 99.5th percentile of all slopes)."""

_STRIDE = 3.0
"""px along the edge to both sides at which it must still run the same way, or this is a corner."""

_TURN = np.radians(12)
_FADE = 0.6
_BORDER = 5


@dataclasses.dataclass(frozen=True)
class EdgePoints:
    """Points on edges, one a row or a column.

    Attributes:
        position: (n, 2), px.
        normal: (n, 2), unit vectors towards the brighter side.
        slope: (n,), how steep the grey levels are there, in one unit for all.
        pixel: (n, 2), the column and row of the pixel that holds each point.
        image_size: (width, height) px.
        polar: whether one side differs from the other, so that opposite normals are no neighbours.
    """

    position: np.ndarray
    normal: np.ndarray
    slope: np.ndarray
    pixel: np.ndarray
    image_size: tuple[int, int]
    polar: bool = True


def edge_points(grey: np.ndarray) -> EdgePoints:
    """All edge points of a grey image (height, width), uint8, but those near corners and crossings."""
    height, width = grey.shape
    smooth = cv2.GaussianBlur(grey, (0, 0), _SMOOTHING, borderType=cv2.BORDER_REPLICATE)
    slopes = [_slope(smooth, *order) for order in ((1, 0), (0, 1))]
    steep = [cv2.convertScaleAbs(slope, alpha=_TO_BYTE) for slope in slopes]
    strength = cv2.max(*steep)
    noise = _noise(slopes)
    least = _least_slope(strength, noise)
    _, strong = cv2.threshold(strength, min(least * _TO_BYTE, 254), 1, cv2.THRESH_BINARY)
    for side in (strong[:_BORDER], strong[-_BORDER:], strong[:, :_BORDER], strong[:, -_BORDER:]):
        side[:] = 0
    candidates = np.flatnonzero(strong.view(bool))
    flat = [slope.ravel() for slope in slopes]
    level = np.less(*(byte.ravel().take(candidates) for byte in steep))
    parts = [
        _maxima(candidates.compress(rows), flat[axis], axis, step)
        for rows, axis, step in ((~level, 0, 1), (level, 1, width))
    ]
    at, shift = (np.concatenate(part) for part in zip(*parts, strict=True))
    gradient = np.stack([slope.take(at) for slope in flat], axis=-1).astype(np.float32)
    length = norm(gradient)
    normal = gradient / length[:, None]
    keep = _runs_on(at, flat, normal, length, width, noise)
    at, shift, normal, length = (of.compress(keep, axis=0) for of in (at, shift, normal, length))
    pixel = np.stack([at % width, at // width], axis=-1)
    return EdgePoints(pixel + shift, normal.astype(float), length.astype(float), pixel, (width, height))


def _slope(smooth: np.ndarray, across: int, down: int) -> np.ndarray:
    """Sobel's filter, int16. With fractions for weights, which make the same integers, OpenCV takes vectors
    of the processor, and a third of the time of `cv2.Sobel`."""
    row, column = cv2.getDerivKernels(across, down, _APERTURE, ktype=cv2.CV_32F)
    return cv2.sepFilter2D(smooth, cv2.CV_16S, row / 4, column * 4)


def _noise(slopes: list[np.ndarray]) -> float:
    """Standard deviation of the slopes in flat parts, by their lower quartile: few edges are as flat."""
    thin = np.concatenate([np.abs(slope[::5, ::7]).ravel() for slope in slopes])
    return _quantile(thin, 0.25) / 0.3186


def _least_slope(strength: np.ndarray, noise: float) -> float:
    strong = _quantile(strength[::5, ::7].ravel(), 0.995) / _TO_BYTE
    return max(_FLOOR, _NOISE_LEVELS * noise, _OF_STRONGEST * strong)


def _quantile(levels: np.ndarray, share: float) -> float:
    """As `np.quantile` of small whole numbers, but counted, which is sooner done than sorting."""
    up_to = np.cumsum(np.bincount(levels))
    place = share * (len(levels) - 1)
    below, above = np.searchsorted(up_to, (int(place), int(place) + 1), side="right")
    return float(below + (place - int(place)) * (above - below))


def _maxima(at: np.ndarray, slope: np.ndarray, axis: int, step: int) -> tuple[np.ndarray, np.ndarray]:
    """Those pixels where the slope along an axis is steepest, and the peaks' shifts from there (n, 2), px.

    `step` leads from a pixel to the next one along the axis, in the flat array of slopes.
    """
    middle, before, after = (slope.take(at + side) for side in (0, -step, step))
    sign = np.sign(middle)
    for each in (middle, before, after):
        each *= sign
    peak = (middle > before) & (middle >= after) & (before > 0) & (after > 0)
    at = at[peak]
    low, mid, high = (np.log(value[peak].astype(float)) for value in (before, middle, after))
    shift = np.zeros((len(at), 2))
    shift[:, axis] = (high - low) / np.maximum(2 * (2 * mid - low - high), 1e-9)
    return at, np.clip(shift, -0.5, 0.5)


def _runs_on(at, flat, normal, length, width: int, noise: float) -> np.ndarray:
    """Whether the edge runs on the same way, and as steep, to both sides of each point."""
    row, column = at // width, at % width
    keep = np.ones(len(at), bool)
    tolerance = np.cos(np.minimum(_TURN + 4 * noise / length, np.radians(35)))
    for stride in (-_STRIDE, _STRIDE):
        x = np.rint(column - stride * normal[:, 1]).astype(np.intp)
        y = np.rint(row + stride * normal[:, 0]).astype(np.intp)
        there = y * width + x
        gx, gy = (slope.take(there).astype(np.float32) for slope in flat)
        other = np.sqrt(gx * gx + gy * gy)
        keep &= gx * normal[:, 0] + gy * normal[:, 1] > tolerance * other
        keep &= other > _FADE * length - 3 * noise
    return keep
