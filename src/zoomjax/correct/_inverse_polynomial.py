"""The inverse of the radial function as a polynomial, for fast maps of source positions.

Correcting an image needs, for each of millions of pixels at a corrected radius ρ, the distorted radius r
with ``r L(r²) = ρ``. Their ratio depends on ``τ = ρ²`` alone and is smooth up to the fold. So
once per focal length a polynomial p is fitted to exact pairs (r L(r²), r), which cost no iteration, and
each pixel costs one evaluation: ``distorted = centre + (corrected - centre) p(τ)``. Where the polynomial is
not accurate enough it still starts two steps of Newton's method, and where those are not either there is
the exact inverse.

All of this happens once per distortion, in NumPy and float64, whatever JAX's precision, and takes little
beside the map.
"""

import dataclasses
import math

import numpy as np
from numpy.polynomial import chebyshev, polynomial

from ..models.distortion import Distortion
from ..models.distortion_model import AbstractRadial

TOLERANCE = 0.01
"""px: the error up to which the polynomial stands in for the exact inverse: less than a third of the
1/32 px to which OpenCV's fixed-point maps round."""

_TRIALS = ((8, 0), (16, 2))
"""Degree, and steps of Newton's method after it, tried in this order. Degree 8 alone is enough for
photographic lenses (benchmarks/results/correct.md has its error). Near a fold the inverse has a
square-root singularity that no polynomial follows: there the steps help."""

_MOST = float(np.finfo(np.float32).max) ** 0.5
"""Coefficients beyond which their products overflow in float32, so that nothing is seen."""


@dataclasses.dataclass(frozen=True)
class RadialInverse:
    """A polynomial for the ratio of distorted to corrected radius, with its measured error.

    Attributes:
        powers: coefficients of the powers of ``v = 2 τ/reach² - 1``, lowest first, float32.
        steps: steps of Newton's method that follow.
        distortion_model, coefficients: of the distortion, float32.
        reach: the corrected radius, normalised, up to which it holds; beyond it nothing is seen.
        error: the largest distance, px, between its distorted positions and the exact ones.
    """

    powers: np.ndarray
    steps: int
    distortion_model: AbstractRadial
    coefficients: np.ndarray
    reach: float
    error: float


def fit_inverse(
    distortion: Distortion, radius: float, *, seen: float = math.inf, tolerance: float = TOLERANCE
) -> RadialInverse | None:
    """The polynomial for corrected points up to `radius` px from the centre; None if none is accurate.

    None, too, where the distortion model is not radial.

    Args:
        distortion: with concrete values (this is NumPy, in float64).
        radius: px; beyond the fold's image nothing exists, and nothing is fitted.
        seen: the distorted radius, px, beyond which positions are of no interest: all off the image.
        tolerance: the largest error allowed, px.
    """
    distortion_model = distortion.distortion_model
    if not isinstance(distortion_model, AbstractRadial):
        return None
    k = np.asarray(distortion.coefficients, float)
    scale = float(distortion.scale)
    top = min(_first_radius(distortion_model, k, radius / scale), seen / scale)
    # Exact pairs, denser towards the end, where polynomials go wrong first.
    r = top * np.sin(np.linspace(0, np.pi / 2, 64)[1:])
    rho = _corrected(distortion_model, r, k)
    between = top * np.sin((np.arange(512) + 0.5) * np.pi / 1024)
    rho_between = _corrected(distortion_model, between, k)
    reach = float(rho[-1])
    squared = (rho_between**2).astype(np.float32)
    single = k.astype(np.float32)
    for degree, steps in _TRIALS:
        design = chebyshev.chebvander(2 * (rho / reach) ** 2 - 1, degree) * rho[:, None]
        fitted = np.linalg.lstsq(design, r, rcond=None)[0]
        powers = np.zeros(degree + 1, np.float32)
        trimmed = chebyshev.cheb2poly(fitted)
        powers[: len(trimmed)] = trimmed
        ratio = radius_ratio(squared, np.float32(reach), powers, steps, distortion_model, single)
        error = float(scale * np.max(np.abs(rho_between * ratio - between)))
        if error <= tolerance:
            return RadialInverse(powers, steps, distortion_model, single, reach, error)
    return None


def radius_ratio(squared, reach, powers, steps, distortion_model, k):
    """Distorted over corrected radius at squared corrected radii: the same code for NumPy and JAX."""
    ratio = _horner(powers, squared * (2 / (reach * reach)) - 1)
    for _ in range(steps):  # on q L(τ q²) - 1 = 0, in the ratio q
        error, slope = distortion_model.equation(ratio, squared * ratio * ratio, 1, k)
        ratio = ratio - error / slope
    return ratio


def fold_radius(distortion: Distortion) -> float:
    """The monotone radius, px, of a concrete distortion, in float64; inf if it never folds.

    `Distortion.monotone_radius` is for tracing, in JAX's precision and on its device. Here eigenvalues from
    NumPy do: in float64 whatever JAX's setting, with nothing to compile, once for each frame of a video.
    (For radial models only.)

    Raises:
        ValueError: coefficients are not finite, or so large that powers of them overflow in float32.
    """
    distortion_model, k = distortion.distortion_model, np.asarray(distortion.coefficients, float)
    if not (abs(k) <= _MOST).all():
        raise ValueError(
            f"No image can be corrected with coefficients of {k.tolist()}. Check the focal length: it must "
            "be near those that the lens was fitted to, in the lens's unit."
        )
    if not isinstance(distortion_model, AbstractRadial):
        return float(distortion.monotone_radius)
    return float(distortion.scale) * _fold(distortion_model, k)


def _horner(powers, x):
    """The polynomial with these coefficients, lowest first, in their own precision."""
    value = powers[-1] + 0 * x
    for power in powers[-2::-1]:
        value = value * x + power
    return value


def _corrected(distortion_model, r, k):
    """``r L(r²)``."""
    return r * distortion_model.factor(r * r, k)


def _fold(distortion_model: AbstractRadial, k: np.ndarray) -> float:
    """The first positive root of what must stay positive, as a radius."""
    first = math.inf
    for row in distortion_model.conditions(len(k)):
        roots = polynomial.polyroots(np.trim_zeros(np.append(1.0, row * k), "b"))
        folds = roots.real[(abs(roots.imag) < 1e-9 * (1 + abs(roots.real))) & (roots.real > 0)]
        first = min(first, folds.min(initial=math.inf))
    return math.sqrt(first)


def _first_radius(distortion_model: AbstractRadial, k: np.ndarray, rho: float) -> float:
    """A distorted radius just large enough to be corrected to `rho`, or that of the fold before it."""
    limit, end = _fold(distortion_model, k), rho
    while end < limit and _corrected(distortion_model, np.array([end]), k)[0] < rho:
        end *= 2
    r = np.linspace(0, min(end, limit), 1025)
    return float(r[min(np.searchsorted(_corrected(distortion_model, r, k), rho), 1024)])
