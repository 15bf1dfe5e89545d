"""Fits of the radial polynomial to a table: least largest distance, by least squares with changing weights.

A table gives the corrected radius u of each distorted radius d, at some focal lengths. The polynomial is to
give ``m u = d (1 + k1 d^2 + ... + kN d^2N)``: the magnification m of each focal length is free where it is
the tool's own choice, because it leaves straight lines straight, and lensfun's own versions differ in it.
All is linear in the k and in m, which is eliminated. Weights grow where the distance is large (Lawson's
iteration), so that the largest distance falls. Radius 1 is the corner that is farthest from the centre;
errors are distances in the distorted image.

All is NumPy, for many fits at once: there is nothing to compile.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

_STEPS = 8
"""Of Lawson's iteration: more bring the largest distance down by little."""

_FLOOR = 1e-2
"""Least share of the largest distance by which a weight grows: points without error stay in the fit."""

_RIDGE = 1e-10
"""Of the normal equations, which are scaled."""

RADII = np.sin(np.linspace(0, np.pi / 2, 97)[1:])
"""Distorted radii: close to each other towards the corner, where polynomials of high degree move."""

_FITTED = slice(3, None, 4)
"""Those of a fit. Distances are looked at between them, too, where they are up to a tenth larger."""

_LEAST_SLOPE = 0.05
"""Of the table, distorted over corrected: where it is flatter, or folds, it is continued straight."""


class Targets(NamedTuple):
    """What a table gives at some focal lengths.

    Attributes:
        corrected: the corrected radius of each of `RADII`.
        slope: the derivative of the distorted by the corrected radius; 0 beyond where the table folds.
        scaled: whether the magnification of each focal length is free; else it is 1.
    """

    corrected: Float[np.ndarray, "focal radius"]
    slope: Float[np.ndarray, "focal radius"]
    scaled: bool = True

    @property
    def seen(self) -> Bool[np.ndarray, "focal radius"]:
        """Where the table gives a corrected radius, and not its straight continuation."""
        return self.slope > 0

    def at(self, index: Any) -> "Targets":
        """Those of an index of NumPy."""
        return Targets(self.corrected[index], self.slope[index], self.scaled)


def targets(polynomials: Float[np.ndarray, "focal power"], unit: float, *, scaled: bool = True) -> Targets:
    """Solve a table's polynomials from corrected to distorted radii at `RADII`.

    Args:
        polynomials: distorted over corrected radius, by powers of the corrected one, in the table's unit.
        unit: the radius of the farthest corner in that unit.
        scaled: whether the magnification of each focal length is free.
    """
    distorted = RADII * unit
    radius = distorted / polynomials[:, :1]
    for _ in range(_NEWTON):
        value, slope = _value(polynomials, radius)
        step = (value - distorted) / np.maximum(slope, _LEAST_SLOPE)
        step = np.clip(step, -_LONGEST * unit, _LONGEST * unit)
        radius = radius - step
        if abs(step).max() < 1e-10 * unit:
            break
    value, slope = _value(polynomials, radius)
    good = (abs(value - distorted) < 1e-9 * unit) & (slope > _LEAST_SLOPE)
    slope = np.where(np.cumprod(good, axis=1), slope, 0)
    return Targets(_continued(radius / unit, slope), slope, scaled)


_NEWTON = 30
_LONGEST = 0.1
"""Newton's steps, and the longest of them, in such radii: it starts near the root before any fold."""


def _value(polynomials, radius):
    """The distorted radius, and its derivative."""
    factor, slope = np.zeros_like(radius), np.zeros_like(radius)
    for power in reversed(range(polynomials.shape[1])):
        column = polynomials[:, power, None]
        factor, slope = factor * radius + column, slope * radius + (power + 1) * column
    return factor * radius, slope


def _continued(corrected, slope):
    """Straight on from the last radius that the table gives."""
    seen = slope > 0
    last = np.maximum(seen.sum(axis=1, keepdims=True) - 1, 0)
    end, rate = (np.take_along_axis(values, last, axis=1) for values in (corrected, slope))
    beyond = end + (RADII - RADII[last]) / np.maximum(rate, _LEAST_SLOPE)
    return np.where(seen, corrected, beyond)


def fit(
    columns: Float[np.ndarray, "fit focal radius parameter"], wanted: Targets
) -> Float[np.ndarray, "fit parameter"]:
    """The parameters with the least largest distance, of several fits at once.

    Args:
        columns: of each parameter, ``u - d`` at each focal length and of `RADII`.
        wanted: the table, with an axis for the fits in front.
    """
    scaled, columns, wanted = wanted.scaled, columns[..., _FITTED, :], wanted.at((..., _FITTED))
    weight = _in_image(wanted)
    rows, right, own = columns * weight[..., None], RADII[_FITTED] * weight, wanted.corrected * weight
    scale = np.sqrt(np.einsum("gfrp,gfrp->gp", rows, rows))
    rows = rows / scale[:, None, None]
    lawson, least = np.ones_like(right), np.full(len(right), np.inf)
    best = np.zeros(scale.shape)
    for _ in range(_STEPS):
        root = np.sqrt(lawson)
        parameters = _solved(rows * root[..., None], right * root, own * root, scaled)
        along = (rows @ parameters[:, None, :, None])[..., 0] + right
        distance = _distance(along, own, lawson, scaled)
        largest = distance.max(axis=(1, 2))
        best = np.where((largest < least)[:, None], parameters, best)
        least = np.minimum(largest, least)
        lawson = lawson * (distance / np.maximum(largest, 1e-15)[:, None, None] + _FLOOR)
        lawson = lawson / lawson.mean(axis=(1, 2), keepdims=True)
    return best / scale


def largest_distance(
    coefficients: Float[np.ndarray, "focal terms"], wanted: Targets
) -> Float[np.ndarray, "focal"]:
    """How far from the table polynomials put a point of the distorted image, at most, where the table sees.

    In radii of the farthest corner, and at the magnification of each focal length that is best for it, if
    that is free.
    """
    weight = np.where(wanted.seen, _in_image(wanted), 0)
    along = (RADII + coefficients @ powers(coefficients.shape[1]).T) * weight
    own = wanted.corrected * weight
    lawson, least = np.ones_like(along), np.full(len(along), np.inf)
    for _ in range(_STEPS):
        distance = _distance(along, own, lawson, wanted.scaled)
        largest = distance.max(axis=1)
        least = np.minimum(largest, least)
        lawson = lawson * (distance / np.maximum(largest, 1e-15)[:, None] + _FLOOR)
    return least


def powers(terms: int) -> Float[np.ndarray, "radius terms"]:
    """``d^3, d^5, ...`` at `RADII`: the columns of k1, k2, ..."""
    return RADII[:, None] ** (2 * np.arange(1, terms + 1) + 1)


def _in_image(wanted: Targets) -> Float[np.ndarray, "... radius"]:
    """From distances in the corrected to distances in the distorted image."""
    return np.maximum(wanted.slope, _LEAST_SLOPE)


def _solved(rows, right, own, scaled):
    """Weighted least squares, the magnifications eliminated."""
    if scaled:
        own = own / np.linalg.norm(own, axis=-1, keepdims=True)
        rows = rows - own[..., None] * (own[..., None, :] @ rows)
        right = right - own * np.einsum("gfr,gfr->gf", own, right)[..., None]
    else:
        right = right - own
    flat = rows.reshape(len(rows), -1, rows.shape[-1])
    matrix = np.swapaxes(flat, 1, 2) @ flat + _RIDGE * np.eye(rows.shape[-1])
    return -np.linalg.solve(
        matrix, np.einsum("gnp,gn->gp", flat, right.reshape(len(right), -1))[..., None]
    )[..., 0]


def _distance(along, own, weight, scaled):
    """Distances at the magnifications that are best in least squares, or at 1."""
    if not scaled:
        return abs(along - own)
    magnification = (weight * along * own).sum(-1) / (weight * own * own).sum(-1)
    return abs(along - magnification[..., None] * own)
