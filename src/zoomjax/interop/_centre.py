"""The centre of distortion of maps, which do not say it: that about which a formula comes nearest to them.

Radial polynomials about one centre for all maps are tried first, then the same with decentering (Brown and
Conrady). The coefficients of each map are linear least squares for each centre that is tried.
"""

import math

import numpy as np
from scipy.optimize import least_squares

from ..models.brown_conrady import BrownConrady
from ..models.family import AbstractFamily
from ..models.polynomial import RadialPolynomial
from .base import Sampled

_TERMS = 3
"""Radial coefficients by which the centre is found."""

_FAR = 0.5
"""Half diagonals from the middle of the image, beyond which a centre is not believed."""

_LESS = 0.5
"""Share of the radial formula's error below which decentering is worth two coefficients more."""

_WELL = 0.01
"""px, below which the radial formula is good enough."""


def centre_and_family(
    nodes: list[Sampled], size: tuple[int, int], family: AbstractFamily | None
) -> tuple[np.ndarray, AbstractFamily]:
    """The centre of maps, px, and the distortion model; that which is nearer to them if it is None."""
    if family is not None:
        return _centre(nodes, size, isinstance(family, BrownConrady))[0], family
    centre, worst = _centre(nodes, size, False)
    if worst > _WELL:
        other, least = _centre(nodes, size, True)
        if least < _LESS * worst:
            return other, BrownConrady()
    return centre, RadialPolynomial()


def _centre(nodes: list[Sampled], size: tuple[int, int], tangential: bool) -> tuple[np.ndarray, float]:
    """The centre, px, and the greatest error of the formula about it, px."""
    middle, scale = (np.array(size) - 1) / 2, math.hypot(*size) / 2
    each = [((n.distorted - middle) / scale, (n.corrected - middle) / scale) for n in nodes]

    def residuals(shift: np.ndarray) -> np.ndarray:
        parts = []
        for distorted, corrected in each:
            z = distorted - shift
            t = np.sum(z * z, -1, keepdims=True)
            columns = [z * t ** (i + 1) for i in range(_TERMS)]
            if tangential:
                columns += [t * q + 2 * (z @ q)[:, None] * z for q in np.eye(2)]
            matrix = np.stack([column.ravel() for column in columns], -1)
            change = (corrected - distorted).ravel()
            parts.append(matrix @ np.linalg.lstsq(matrix, change, rcond=None)[0] - change)
        return np.concatenate(parts)

    found = least_squares(residuals, np.zeros(2), x_scale=0.01, diff_step=1e-6, xtol=1e-12, ftol=1e-12)
    shift = found.x if np.abs(found.x).max() < _FAR else np.zeros(2)
    worst = np.hypot(*residuals(shift).reshape(-1, 2).T).max()
    return middle + scale * shift, scale * float(worst)
