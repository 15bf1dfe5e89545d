"""How far points scatter about a smooth curve through their own line.

The curves are polynomials of degree `_CURVE` along each line, once it is corrected. A line that is bent as
a whole is smooth: the noise is that of the edges alone.
"""

import dataclasses
from typing import Any

import numpy as np

from .._core.programs import light_program
from ..fit.energy import coefficients_by
from ..fit.problem import data_of, posed
from ..lines.base import AbstractLines
from ..lines.buckets import bucket, padded_frames
from ..lines.lines import Lines
from ..models.lens import ZoomLens

_CURVE = 5
_MOST_LINES, _LINES_AT_ONCE = 2000, 256  # enough to average over, and a few MB of memory
_LEAST_POINTS = 12  # of a line whose noise counts

_POINTS = (64, 256, 1024, 4096)
"""Numbers of points a line that a program is compiled for; larger ones are four to each doubling."""


def noise(lines: AbstractLines, lens: ZoomLens, counted: np.ndarray) -> float:
    """RMS distance, px, of corrected points to smooth curves through their lines.

    Args:
        lines: points under the distortion model of the lens, about its centre.
        lens: the lens.
        counted: numbers of the lines that count.

    Returns:
        NaN where no line has enough points.
    """
    chosen = counted[np.unique(np.linspace(0, len(counted) - 1, _MOST_LINES).astype(int))]
    squares = []
    for part in np.array_split(chosen, -(-len(chosen) // _LINES_AT_ONCE)):
        some = _some(lines, np.resize(part, _LINES_AT_ONCE))
        rows, there = np.asarray(_corrected(some, lens.zoom)), data_of(some).mask
        pairs = zip(rows[: len(part)], there[: len(part)], strict=True)
        squares += [_roughness(points[mask]) for points, mask in pairs if mask.sum() >= _LEAST_POINTS]
    return float(np.sqrt(np.mean(squares))) if squares else np.nan


def _some(lines: AbstractLines, chosen: np.ndarray) -> AbstractLines:
    """Some of the lines, with one number of points and frames for many data sets."""
    data = data_of(lines)
    assert isinstance(data, Lines)
    mask = np.asarray(data.mask)[chosen]
    most = int(np.max(np.flatnonzero(mask.any(axis=0)), initial=0)) + 1
    missing = bucket(most, _POINTS) - most
    points = np.pad(np.asarray(data.points)[chosen, :most], ((0, 0), (0, missing), (0, 0)))
    new: dict[str, Any] = {
        "points": points,
        "mask": np.pad(mask[:, :most], ((0, 0), (0, missing))),
        "frame": np.asarray(data.frame)[chosen],
        "focal": padded_frames(data.focal),
        "focus": None if data.focus is None else padded_frames(data.focus),
        "number": None,
        "weight": None,
    }
    return posed(dataclasses.replace(data, **new), lines.distortion_model, lines.metric)


@light_program
def _corrected(lines, zoom):
    return lines.corrected(coefficients_by(zoom, lines))


def _roughness(points: np.ndarray) -> float:
    """Variance, px^2, of points about a polynomial along the line through them."""
    points = points - points.mean(axis=0)
    along, across = (points @ np.linalg.eigh(points.T @ points)[1]).T[::-1]
    basis = np.polynomial.chebyshev.chebvander(along / (np.abs(along).max() or 1), _CURVE)
    rest = across - basis @ np.linalg.lstsq(basis, across, rcond=None)[0]
    return float(rest @ rest) / (len(across) - _CURVE - 1)
