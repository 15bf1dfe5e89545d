"""The centre of distortion of maps, which do not say it: that about which a formula comes nearest to them.

Radial polynomials about one centre for all maps are tried first, then about a centre that moves along the
zoom, linear in 1/f, then both with decentering (Brown and Conrady). The coefficients of each map are linear
least squares for each centre that is tried.
"""

import itertools
import math
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from ..models.brown_conrady import BrownConrady
from ..models.distortion_model import AbstractDistortionModel
from ..models.polynomial import RadialPolynomial
from .base import Sampled

_TERMS = 3
"""Radial coefficients by which the centre is found."""

_FAR = 0.5
"""Half diagonals from the middle of the image, beyond which a centre is not believed."""

_LESS = 0.5
"""Share of the error of a simpler formula below which one with more coefficients is worth them."""

_WELL = 0.01
"""px, below which a formula is good enough."""


class _Found(NamedTuple):
    """Centres of maps, px, (map, 2); the greatest error of the formula about them, px; the formula."""

    centres: np.ndarray
    worst: float
    formula: AbstractDistortionModel


def centres_and_model(
    nodes: list[Sampled], size: tuple[int, int], distortion_model: AbstractDistortionModel | None
) -> tuple[np.ndarray, AbstractDistortionModel]:
    """The centre of each map, px, and the distortion model; that which is nearest to them if it is None."""
    formulas = [RadialPolynomial(), BrownConrady()]
    if distortion_model is not None:
        formulas = [BrownConrady() if isinstance(distortion_model, BrownConrady) else RadialPolynomial()]
    best = _about(nodes, size, formulas[0], moves=False)
    for formula, moves in list(itertools.product(formulas, (False, True)))[1:]:
        if best.worst <= _WELL:
            break
        if moves and len(nodes) == 1:
            continue
        found = _about(nodes, size, formula, moves=moves)
        best = found if found.worst < _LESS * best.worst else best
    return best.centres, distortion_model or best.formula


def _about(
    nodes: list[Sampled], size: tuple[int, int], formula: AbstractDistortionModel, *, moves: bool
) -> _Found:
    """The centres about which a formula is nearest to maps: one for all, or linear in 1/f."""
    middle, scale = (np.array(size) - 1) / 2, math.hypot(*size) / 2
    each = [((n.distorted - middle) / scale, (n.corrected - middle) / scale) for n in nodes]
    x = 1 / np.array([node.focal for node in nodes])
    basis = np.stack([np.ones_like(x), x / x.max()], -1)[:, : 1 + moves]

    def residuals(flat: np.ndarray) -> np.ndarray:
        shifts = basis @ flat.reshape(-1, 2)
        return np.concatenate(
            [_residuals(*pair, by, formula) for pair, by in zip(each, shifts, strict=True)]
        )

    start = np.zeros(2 * basis.shape[1])
    found = least_squares(residuals, start, x_scale=0.01, diff_step=1e-6, xtol=1e-12, ftol=1e-12).x
    if np.abs(basis @ found.reshape(-1, 2)).max() > _FAR:
        found = start
    worst = np.hypot(*residuals(found).reshape(-1, 2).T).max()
    return _Found(middle + scale * basis @ found.reshape(-1, 2), scale * float(worst), formula)


def _residuals(
    distorted: np.ndarray, corrected: np.ndarray, shift: np.ndarray, formula: AbstractDistortionModel
) -> np.ndarray:
    """What a formula leaves of a map, about a centre that is shifted from that of its points."""
    z = distorted - shift
    t = np.sum(z * z, -1, keepdims=True)
    columns = [z * t ** (i + 1) for i in range(_TERMS)]
    if isinstance(formula, BrownConrady):
        columns += [t * q + 2 * (z @ q)[:, None] * z for q in np.eye(2)]
    matrix = np.stack([column.ravel() for column in columns], -1)
    change = (corrected - distorted).ravel()
    return matrix @ np.linalg.lstsq(matrix, change, rcond=None)[0] - change
