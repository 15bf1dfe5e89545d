"""Another distortion model that follows the lines of a photo as well, and how far it is from this one.

Two terms of the radial polynomial follow the lines of a strong lens where there are few, though the lens is
rather that of the division model, and the other way about. Which of them is chosen is chance then, and what
they correct differently is not known. The division model is fitted to the same points, the distances in px
of the image, by Levenberg and Marquardt's method: some ten steps of a few ms, without a program to compile.
"""

import numpy as np

from ..models.distortion_model import AbstractDistortionModel
from ..models.division import Division
from ..models.polynomial import RadialPolynomial
from ._in_image import beyond, corrected, derivatives, over_image, residuals

_TERMS = 2
_CENTRE = 0.02
"""Standard deviation of a centre that lines do not tell, in half diagonals."""

_STEPS, _DONE = 12, 1e-6
_PROFILE = np.linspace(0.05, 0.9, 40)
"""Radii, in half diagonals, at which the first model is copied by the other."""


def apart_from_division(
    z: np.ndarray, k: np.ndarray, centre: np.ndarray, image_size: tuple[int, int]
) -> float:
    """px of the image beyond a homography, RMS over it, between a polynomial and the division model.

    Both are fitted to the lines. 0 if those are less straight under the division model.

    Args:
        z: (l, s, 2), points of lines from the centre, in half diagonals.
        k: the polynomial's coefficients.
        centre: px.
        image_size: (width, height) px.
    """
    own, other = RadialPolynomial(), Division()
    k, shift, lost = _fitted(own, z, k, np.zeros(2))
    squared = _PROFILE**2
    with np.errstate(all="ignore"):
        divisor = 1 / own.factor(squared, k[:, None]) - 1
    if not np.isfinite(divisor).all():
        return 0.0
    powers = squared[:, None] ** np.arange(1, _TERMS + 1)
    start = np.linalg.lstsq(powers * _PROFILE[:, None], divisor * _PROFILE, rcond=None)[0]
    other_k, other_shift, other_lost = _fitted(other, z, start, shift)
    if not other_lost <= lost:
        return 0.0
    scale = float(np.hypot(*image_size)) / 2
    over = (over_image(image_size) - centre) / scale
    at, by_point, _ = derivatives(own, over - shift, k, np.eye(len(k)))
    with np.errstate(all="ignore"):  # beyond a pole
        moved = corrected(other, over - other_shift, other_k) + other_shift - at - shift
    rows = beyond(at, by_point, moved[..., None])
    return scale * float(np.sqrt(np.sum(rows**2) / max(len(rows), 1)))


def _fitted(
    distortion_model: AbstractDistortionModel, z: np.ndarray, k: np.ndarray, shift: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """The coefficients and the centre of least squared distances, and their sum."""

    def at(values):
        own = np.broadcast_to(values[:-2], (len(z), len(k)))
        return residuals(
            distortion_model, z - values[-2:], own, np.broadcast_to(np.eye(len(k)), (len(z), *[len(k)] * 2))
        )

    values, damping = np.concatenate([k, shift]), 1e-3
    error, slope = at(values)
    lost = float(np.sum(error**2))
    usual = np.zeros(len(values))
    usual[-2:] = _CENTRE**-2.0
    for _ in range(_STEPS):
        normal = np.einsum("lsp,lsq->pq", slope, slope) + np.diag(usual * lost / error.size)
        step = np.linalg.lstsq(
            normal + damping * np.diag(np.diagonal(normal)),
            np.einsum("lsp,ls->p", slope, error),
            rcond=None,
        )[0]
        moved, moved_slope = at(values - step)
        less = float(np.sum(moved**2))
        if not less < lost:
            damping *= 10
            continue
        done = lost - less < _DONE * lost
        values, error, slope, lost, damping = values - step, moved, moved_slope, less, damping / 5
        if done:
            break
    return values[:-2], values[-2:], lost
