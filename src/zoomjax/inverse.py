"""The inverse of the radial function as a polynomial: where corrected pixels come from, fast.

Correcting an image asks, for each of millions of pixels at a corrected radius ρ, for the distorted
radius r with ``r L(r²) = ρ``. Their ratio depends on ``τ = ρ²`` alone and is smooth up to the fold. So
once per focal length a polynomial p is fitted to exact pairs (r L(r²), r), which cost no iteration, and
each pixel costs one evaluation: ``distorted = centre + (corrected - centre) p(τ)``. Where the polynomial is
not accurate enough it still starts two steps of Newton's method, and where those are not either there is
the exact inverse.

All of this happens once per distortion, in NumPy and float64, whatever JAX's precision: 0.4 ms, the
measurement of the error included.
"""

import dataclasses
import math

import numpy as np
from numpy.polynomial import chebyshev, polynomial

from .radial import Distortion

TOLERANCE = 0.01
"""px: the error up to which the polynomial stands in for the exact inverse: less than a third of the
1/32 px to which OpenCV's fixed-point maps round."""

_TRIALS = ((8, 0), (16, 2))
"""Degree, and steps of Newton's method after it, tried in this order. Degree 8 alone is enough for
photographic lenses (2e-4 px on the Nikkor 18-200). Near a fold the inverse has a square-root singularity
that no polynomial follows: there the steps help (5 % before it they reach 8e-4 px)."""


@dataclasses.dataclass(frozen=True)
class RadialInverse:
    """A polynomial for the ratio of distorted to corrected radius, with its measured error.

    Attributes:
        powers: coefficients of the powers of ``v = 2 τ/reach² - 1``, lowest first, float32.
        steps: steps of Newton's method that follow.
        coefficients: (k1, ..., kN) of the distortion, float32.
        reach: the corrected radius, normalised, up to which it holds; beyond it nothing is seen.
        error: the largest distance, px, between its distorted positions and the exact ones.
    """

    powers: np.ndarray
    steps: int
    coefficients: np.ndarray
    reach: float
    error: float


def fit_inverse(
    distortion: Distortion, radius: float, *, seen: float = math.inf, tolerance: float = TOLERANCE
) -> RadialInverse | None:
    """The polynomial for corrected points up to `radius` px from the centre; None if none is accurate.

    Args:
        distortion: with concrete values (this is NumPy, in float64).
        radius: px; beyond the fold's image nothing exists, and nothing is fitted.
        seen: the distorted radius, px, beyond which positions are of no interest: all off the image.
        tolerance: the largest error allowed, px.
    """
    k = np.asarray(distortion.coefficients, float)
    scale = float(distortion.scale)
    top = min(_first_radius(k, radius / scale), seen / scale)
    # Exact pairs, denser towards the end, where polynomials go wrong first.
    r = top * np.sin(np.linspace(0, np.pi / 2, 64)[1:])
    rho = _corrected(r, k)
    between = top * np.sin((np.arange(512) + 0.5) * np.pi / 1024)
    rho_between = _corrected(between, k)
    reach = float(rho[-1])
    squared = (rho_between**2).astype(np.float32)
    single = k.astype(np.float32)
    for degree, steps in _TRIALS:
        design = chebyshev.chebvander(2 * (rho / reach) ** 2 - 1, degree) * rho[:, None]
        fitted = np.linalg.lstsq(design, r, rcond=None)[0]
        powers = np.zeros(degree + 1, np.float32)
        trimmed = chebyshev.cheb2poly(fitted)
        powers[: len(trimmed)] = trimmed
        ratio = radius_ratio(squared, np.float32(reach), powers, steps, single)
        error = float(scale * np.max(np.abs(rho_between * ratio - between)))
        if error <= tolerance:
            return RadialInverse(powers, steps, single, reach, error)
    return None


def radius_ratio(squared, reach, powers, steps, k):
    """Distorted over corrected radius at squared corrected radii: the same code for NumPy and JAX."""
    ratio = _horner(powers, squared * (2 / (reach * reach)) - 1)
    for _ in range(steps):  # on q L(τ q²) - 1 = 0, in the ratio q
        t = squared * ratio * ratio
        ratio = ratio - (ratio * _horner(_with_one(k), t) - 1) / _horner(_with_one(k, slope=True), t)
    return ratio


def fold_radius(distortion: Distortion) -> float:
    """The monotone radius, px, of a concrete distortion, in float64; inf if it never folds.

    `Distortion.monotone_radius` is for tracing, in JAX's precision and on its device. Here eigenvalues from
    NumPy do: in float64 whatever JAX's setting, with nothing to compile, once for each frame of a video.
    """
    return float(distortion.scale) * _fold(np.asarray(distortion.coefficients, float))


def _horner(powers, x):
    """The polynomial with these coefficients, lowest first, in their own precision."""
    value = powers[-1] + 0 * x
    for power in powers[-2::-1]:
        value = value * x + power
    return value


def _with_one(k, slope=False):
    """Coefficients of L(t), or of the derivative of r L(r²), in the powers of t."""
    return [k.dtype.type(1), *((2 * i + 3 if slope else 1) * k[i] for i in range(len(k)))]


def _corrected(r, k):
    """``r L(r²)``."""
    return r * _horner(_with_one(k), r * r)


def _fold(k: np.ndarray) -> float:
    roots = polynomial.polyroots(np.trim_zeros(_with_one(k, slope=True), "b"))
    folds = roots.real[(abs(roots.imag) < 1e-9 * (1 + abs(roots.real))) & (roots.real > 0)]
    return math.sqrt(folds.min()) if folds.size else math.inf


def _first_radius(k: np.ndarray, rho: float) -> float:
    """A distorted radius just large enough to be corrected to `rho`, or that of the fold before it."""
    limit, end = _fold(k), rho
    while end < limit and _corrected(end, k) < rho:
        end *= 2
    r = np.linspace(0, min(end, limit), 1025)
    return float(r[min(np.searchsorted(_corrected(r, k), rho), 1024)])
