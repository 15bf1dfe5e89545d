"""Round trips through every distortion model: points are corrected, and must come back.

Directed, not only random: rings where Newton's method jumps between two points for ever, points at the
fold and at the centre, lenses that barely fold.
"""

import dataclasses
import math

import jax.numpy as jnp
import numpy as np

from zoomjax import Distortion
from zoomjax.models import AbstractRadial, BrownConrady, Division, RadialPolynomial

_LENGTH = 4096  # points of a lens
_ROUNDING = 64
"""Last digits of the radius, times the condition of the inverse, that a point may come back with."""

_LAST_DIGITS = 8
"""Of the radius: a point that differs by less is the same."""


@dataclasses.dataclass
class Count:
    """What became of the points.

    Attributes:
        tried: points.
        wrong: came back elsewhere, or from where nothing is corrected to.
        lost: have an inverse, and it was not found.
        cycles: of those tried, on which the plain method of Newton does not arrive in 60 steps.
    """

    tried: int = 0
    wrong: int = 0
    lost: int = 0
    cycles: int = 0

    def __iadd__(self, other: "Count") -> "Count":
        for field in dataclasses.fields(self):
            setattr(self, field.name, getattr(self, field.name) + getattr(other, field.name))
        return self


DISTORTION_MODELS = {
    "polynomial, 1 term": (RadialPolynomial(), 1),
    "polynomial, 2 terms": (RadialPolynomial(), 2),
    "polynomial, 3 terms": (RadialPolynomial(), 3),
    "division, 1 term": (Division(), 1),
    "division, 2 terms": (Division(), 2),
    "Brown-Conrady": (BrownConrady(), 2),
}


def random_coefficients(distortion_model, terms: int, rng: np.random.Generator) -> np.ndarray:
    """From nearly none to very strong; a third of them with the last term against the first."""
    k = rng.normal(size=terms) * 10 ** rng.uniform(-4, 0.3)
    if terms > 1 and rng.uniform() < 0.5:  # a slope that falls to nearly zero and rises again, or folds
        k[0] = rng.choice([-1, 1]) * rng.uniform(0.1, 1.5)
        k[1] = -rng.uniform(0.3, 0.5) * k[0] * (1 if k[0] > 0 else rng.uniform(0.5, 1.5) * k[0])
    if isinstance(distortion_model, BrownConrady):
        return np.append(k, rng.normal(size=2) * 10 ** rng.uniform(-5, -1.5))
    return k


def newton_cycles(distortion: Distortion, radius: np.ndarray) -> np.ndarray:
    """Of radii, normalised, those that the plain method of Newton does not find in 60 steps."""
    distortion_model = distortion.distortion_model
    if not isinstance(distortion_model, AbstractRadial):
        return radius[:0]
    k = np.asarray(distortion.coefficients)
    rho = radius * distortion_model.factor(radius**2, k)
    limit = float(distortion.monotone_radius)
    with np.errstate(all="ignore"):
        r = np.minimum(rho, limit)
        for _ in range(60):
            error, slope = distortion_model.equation(r, r * r, rho, k)
            r = np.clip(r - error / np.where(slope > 0, slope, 1), 0, limit)
        return radius[~(abs(r - radius) < 1e-6 * radius)]


def radii(distortion: Distortion, rng: np.random.Generator) -> tuple[np.ndarray, int]:
    """Distorted radii within the fold, of a lens of scale 1, and how many of them are in cycles."""
    limit = min(float(distortion.monotone_radius), 4.0)
    spread = limit * np.concatenate(
        [
            rng.uniform(size=_LENGTH // 2),
            1 - 10 ** rng.uniform(-16, -1, _LENGTH // 8),
            10 ** rng.uniform(-12, 0, _LENGTH // 8),
            [0.0, 1.0],
        ]
    )
    rings = newton_cycles(distortion, np.linspace(0, limit, 20 * _LENGTH)[1:])
    chosen = rng.choice(rings, min(len(rings), _LENGTH // 4), replace=False)
    return np.concatenate([spread, chosen, np.nextafter(chosen, 0)]), 2 * len(chosen)


def check(distortion: Distortion, radius: np.ndarray, angle: np.ndarray, compiled: bool) -> Count:
    """Correct points, look for them again, and count."""
    dtype = distortion.coefficients.dtype
    points = (radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)).astype(dtype)
    limit = np.asarray(distortion.monotone_radius)
    points[np.hypot(*points.T) > limit] = 0  # rounded beyond it; the shape stays, and JAX compiles once
    given = jnp.asarray(points) if compiled else points
    corrected = distortion.undistort(given)
    back = np.asarray(distortion.distort(corrected))
    mask = np.asarray(distortion.has_inverse(corrected))
    found = np.isfinite(back).all(axis=1)
    reachable = np.isfinite(np.asarray(corrected)).all(axis=1)
    # What is found must be corrected to the same place, in extended precision, and lie within the fold; or
    # be the point itself but for its last digits, of which each moves the corrected point next to a pole.
    wide = back.astype(np.longdouble)
    k = np.asarray(distortion.coefficients).astype(np.longdouble)
    with np.errstate(divide="ignore", invalid="ignore"):  # exactly at a pole
        again = distortion.distortion_model.correct((wide[:, 0], wide[:, 1]), (wide**2).sum(axis=1), k)
    again = np.stack(again, axis=1)
    rho = np.hypot(*np.asarray(corrected).astype(np.longdouble).T)
    r = np.hypot(*wide.T)
    slope = _steepness(distortion, np.asarray(r, float))
    size = rho + slope * r
    missed = np.hypot(*(again - np.asarray(corrected)).T)
    eps = np.finfo(dtype).eps
    with np.errstate(invalid="ignore"):
        elsewhere = ~(missed <= _ROUNDING * eps * size)
        elsewhere &= np.hypot(*(wide - points).T) > _LAST_DIGITS * eps * r
        wrong = found & (elsewhere | (r > limit * (1 + 4096 * eps)))
    wrong |= found != mask
    return Count(len(points), int(wrong.sum()), int((reachable & ~found).sum()))


def _steepness(distortion: Distortion, r: np.ndarray) -> np.ndarray:
    """What a relative error of the coefficients, and of r, does to the corrected radius, over r."""
    k = abs(np.asarray(distortion.coefficients, float))
    distortion_model = distortion.distortion_model
    orders = distortion_model.orders(len(k))
    changes = np.ones_like(r)
    for order, size in zip(orders, k, strict=True):
        changes += 6 * (order + 1) * size * r**order
    if isinstance(distortion_model, Division):
        factor = np.asarray(distortion_model.factor(r * r, np.asarray(distortion.coefficients, float)))
        return changes * factor**2
    return changes


def inverse_round_trips(count: int, seed: int) -> dict[str, dict[str, int]]:
    """About `count` round trips, in equal parts of all distortion models, dtypes and of NumPy and JAX."""
    rng = np.random.default_rng(seed)
    counts = {}
    for name, (distortion_model, terms) in DISTORTION_MODELS.items():
        for dtype in (np.float64, np.float32):
            total = Count()
            wanted = math.ceil(count / len(DISTORTION_MODELS) / 2)
            number = 0
            while total.tried < wanted:
                number += 1
                d = Distortion(
                    random_coefficients(distortion_model, terms, rng).astype(dtype),
                    np.zeros(2, dtype),
                    dtype(1),
                    distortion_model,
                )
                radius, cycles = radii(d, rng)
                radius = np.resize(radius, _LENGTH)  # one shape: JAX compiles once
                angle = rng.uniform(0, 2 * np.pi, len(radius))
                total += check(d, radius, angle, compiled=number % 2 == 0)
                total.cycles += min(cycles, _LENGTH)
            counts[f"{name}, {np.dtype(dtype).name}"] = dataclasses.asdict(total)
    return counts
