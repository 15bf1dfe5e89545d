"""The distortion of one frame while its lines are being found: which edges run straight across the image?

A working model in NumPy: numbers of lines and points differ from frame to frame, and JAX would compile for
each. It is the division model with two terms, which follows lenses from strong pincushion to fisheyes,

    corrected = centre + (x - centre) / (1 + k1 t + k2 t^2),  t = |x - centre|^2 / scale^2,

and its centre. Distances of corrected points to their lines are divided by the local stretch across the
line, which makes them px of the image, where the noise is. Lines that do not become straight (arcs, folds
in a cloth) are weighted down as a whole.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ._vectors import dot

_PRIOR = np.array([1.0, 0.3, 0.05, 0.05])
"""Standard deviations of k1 and k2 about the start, and of the centre, in scales, before lines are seen."""

_TIED = np.array([0.03, 0.02, 0.01, 0.01])
"""The same about a model that other photos have determined."""

_STEPS = 6
_LEAST_SPREAD = 0.1
"""px: a spread of the lines' errors that noise alone gives. Below, no line is doubtful."""

_LEAST_DIVISOR = 0.12
"""Smallest 1 + k1 t + k2 t^2 at the corner: beyond, the lens sees more than a plane can show."""


@dataclasses.dataclass(frozen=True)
class OneFrame:
    """Radial distortion in images of one size.

    Attributes:
        image_size: (width, height) px.
        k: k1 and k2.
        shift: of the centre of distortion from that of the image, in scales.
        tied: whether other photos have determined it.
    """

    image_size: tuple[int, int]
    k: tuple[float, float] = (0.0, 0.0)
    shift: tuple[float, float] = (0.0, 0.0)
    tied: bool = False

    @classmethod
    def of_angle(cls, image_size: tuple[int, int], square: float) -> "OneFrame":
        """The model nearest to the lens of `_search`, by the square of the corner's angle."""
        k1 = -square / 3
        return cls(image_size, (k1, float(1 / tangent_ratio(np.array([square]))[0]) - 1 - k1))

    @classmethod
    def of_values(cls, image_size: tuple[int, int], values: Sequence[float]) -> "OneFrame":
        """The model of these values, as `values` gives them, which other photos have determined."""
        k1, k2, x, y = map(float, values)
        return cls(image_size, (k1, k2), (x, y), tied=True)

    @classmethod
    def of_correction(
        cls,
        image_size: tuple[int, int],
        centre: np.ndarray,
        undistort: Callable[[np.ndarray], np.ndarray],
        reach: float = 1.0,
    ) -> "OneFrame":
        """The model nearest to a radial correction of points (n, 2), px, about its centre.

        The farther from there the less it counts; beyond `reach`, in scales, or a fold, nothing does.
        """
        scale = float(np.hypot(*image_size)) / 2
        shift = (np.asarray(centre, float) - (np.array(image_size) - 1) / 2) / scale
        r = np.linspace(0.05, reach, 48)
        corner = np.where(shift > 0, -1.0, 1.0) * np.array(image_size) / (2 * scale)
        moved = np.asarray(undistort(np.asarray(centre) + scale * r[:, None] * corner))
        ratio = np.sum((moved - centre) * corner, axis=-1) / (scale * r)
        sound = np.isfinite(ratio) & (ratio > 0)
        sound &= np.append(True, np.diff(np.where(sound, r * ratio, -1.0)) > 0)
        sound = np.logical_and.accumulate(sound)
        if sound.sum() < 2:
            return cls(image_size)
        t, divisor = r[sound] ** 2, 1 / ratio[sound]
        columns = np.stack([t, t * t], axis=-1) * r[sound, None]
        k = np.linalg.lstsq(columns, (divisor - 1) * r[sound], rcond=None)[0]
        return cls.of_values(image_size, (*k, *shift))

    @property
    def values(self) -> tuple[float, float, float, float]:
        """k1, k2 and the shift."""
        return (*self.k, *self.shift)

    @property
    def scale(self) -> float:
        """px: half of the image's diagonal."""
        return float(np.hypot(*self.image_size)) / 2

    @property
    def centre(self) -> np.ndarray:
        """(2,), the centre of distortion, px."""
        return (np.array(self.image_size) - 1) / 2 + self.scale * np.array(self.shift)

    def undistort(self, points: np.ndarray) -> np.ndarray:
        """Corrected positions of points (..., 2), px."""
        x, y = self._normalised(points)
        divisor, (middle_x, middle_y) = self._divisor(x * x + y * y) / self.scale, self.centre
        return np.stack([middle_x + x / divisor, middle_y + y / divisor], axis=-1)

    def stretch(self, points: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """(...), by how much the surroundings of points are stretched along normals of corrected lines.

        Both are (..., 2): points in the image, unit normals in the corrected one.
        """
        x, y = self._normalised(points)
        t, on = x * x + y * y, x * normal[..., 0] + y * normal[..., 1]
        divisor = self._divisor(t)
        growth = -2 * (self.k[0] + 2 * self.k[1] * t) / divisor
        # |n + growth (z.n) z| / divisor, squared: what of z is along n counts twice.
        added = growth * on
        return np.sqrt(np.maximum(1 + added * (2 * on + added * t), 0)) / divisor

    def _normalised(self, points: np.ndarray) -> Iterator[np.ndarray]:
        """x and y, each (...), from the centre, in half diagonals."""
        return ((points[..., axis] - self.centre[axis]) / self.scale for axis in (0, 1))

    def _divisor(self, t: np.ndarray) -> np.ndarray:
        return np.maximum(1 + t * (self.k[0] + t * self.k[1]), _LEAST_DIVISOR)

    def fitted(self, lines: list[np.ndarray], samples: int = 24) -> "OneFrame":
        """The model that straightens lines, (n, 2) px each, best; this one if there is none.

        Levenberg and Marquardt's method on the distances to the lines, from the model as it is. `samples`
        of each line's points are used.
        """
        if not lines:
            return self
        points, length = samples_of(lines, samples), np.array([extent(line) for line in lines])
        start = model = self
        certain = (_TIED if self.tied else _PRIOR) ** -2.0
        damping = 1e-3
        seen = model._seen(points)
        weight = _weights(seen.error, length)
        loss = model._loss(seen.error, weight, start)
        for _ in range(_STEPS):
            slope = model._slopes(points, seen)
            apart = model._values() - start._prior_mean()
            hessian = np.einsum("l,lsk,lsj->kj", weight, slope, slope) + np.diag(certain)
            gradient = np.einsum("l,lsk,ls->k", weight, slope, seen.error) + apart * certain
            step = np.linalg.solve(hessian + damping * np.diag(np.diag(hessian)), gradient)
            other = model._at(model._values() - step)
            new = other._seen(points)
            new_loss = other._loss(new.error, weight, start)
            if not new_loss < loss or 1 + sum(other.k) <= _LEAST_DIVISOR:
                damping *= 10
                continue
            model, seen, damping = other, new, damping / 5
            weight = _weights(seen.error, length)
            loss = model._loss(seen.error, weight, start)
        return model

    def errors(self, points: np.ndarray) -> np.ndarray:
        """(l, s), distances of points (l, s, 2) to the best lines, to first order px of the image."""
        return self._seen(points).error

    def _seen(self, points: np.ndarray) -> "_Seen":
        corrected = self.undistort(points)
        # The first line is good enough for the stretch along its normal only.
        _, _, stretch = self._lines(points, corrected, np.ones(points.shape[:-1]))
        return _Seen(*self._lines(points, corrected, 1 / stretch**2))

    def _lines(self, points: np.ndarray, corrected: np.ndarray, weight: np.ndarray):
        """Corrected points about the mean of their line, its normals, and the stretch along these."""
        mean = np.sum(weight[..., None] * corrected, axis=1) / np.sum(weight, axis=1)[:, None]
        centred = corrected - mean[:, None]
        normal = normals(centred, weight)
        return centred, normal, self.stretch(points, np.broadcast_to(normal[:, None], points.shape))

    def _slopes(self, points: np.ndarray, seen: "_Seen") -> np.ndarray:
        """(l, s, 4), derivatives of the errors by the model's values, lines being the best ones for each.

        Lines take up the share of the derivatives that is along those by their offset and angle (Kaufman
        1975). That of the stretch is left out: it multiplies errors, which are small.
        """
        x, y = self._normalised(points)
        t = x * x + y * y
        divisor = self._divisor(t)
        outwards = x * seen.normal[:, :1] + y * seen.normal[:, 1:]
        pulled = np.where(divisor > _LEAST_DIVISOR, outwards / divisor**2, 0.0)
        growth = 2 * (self.k[0] + 2 * self.k[1] * t) * pulled
        by_shift = (
            growth * z - normal[:, None] / divisor for z, normal in zip((x, y), seen.normal.T, strict=True)
        )
        moved = np.stack([-t * pulled, -t * t * pulled, *by_shift], axis=-1) * self.scale
        along = seen.centred[..., 0] * seen.normal[:, 1:] - seen.centred[..., 1] * seen.normal[:, :1]
        slope = moved / seen.stretch[..., None]
        for column in (1 / seen.stretch, along / seen.stretch):
            unit = column / np.sqrt(np.sum(column**2, axis=1))[:, None]
            slope = slope - unit[..., None] * np.einsum("ls,lsk->lk", unit, slope)[:, None]
        return slope

    def _values(self) -> np.ndarray:
        return np.array(self.values)

    def _prior_mean(self) -> np.ndarray:
        return np.array(self.values if self.tied else [*self.k, 0.0, 0.0])

    def _at(self, values: np.ndarray) -> "OneFrame":
        k1, k2, x, y = map(float, values)
        return OneFrame(self.image_size, (k1, k2), (x, y), self.tied)

    def _loss(self, error: np.ndarray, weight: np.ndarray, start: "OneFrame") -> float:
        prior = (self._values() - start._prior_mean()) / (_TIED if start.tied else _PRIOR)
        return float(np.sum(weight[:, None] * error**2) + np.sum(prior**2))


class _Seen(NamedTuple):
    """Points (l, s, 2) under a model.

    Attributes:
        centred: (l, s, 2), corrected, about the mean of their line.
        normal: (l, 2), of the best lines.
        stretch: (l, s), along these.
    """

    centred: np.ndarray
    normal: np.ndarray
    stretch: np.ndarray

    @property
    def error(self) -> np.ndarray:
        """(l, s), distances to the lines, to first order px of the image."""
        return dot(self.centred, self.normal[:, None]) / self.stretch


def tangent_ratio(square: np.ndarray) -> np.ndarray:
    """``tan(x) / x`` for squares of x, ``tanh(x) / x`` where they are negative."""
    x = np.sqrt(np.maximum(abs(square), 1e-12))
    positive = square > 0
    if np.all(positive):
        return np.tan(x) / x
    return np.where(positive, np.tan(x), np.tanh(x)) / x if np.any(positive) else np.tanh(x) / x


def normals(centred: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
    """(l, 2), the unit normals of the best lines through points (l, s, 2) about their mean."""
    x, y = np.moveaxis(centred, -1, 0)
    w = np.ones(x.shape) if weight is None else weight
    wx, wy = w * x, w * y
    xx, xy, yy = (np.einsum("ls,ls->l", one, other) for one, other in ((wx, x), (wx, y), (wy, y)))
    angle = np.arctan2(2 * xy, xx - yy) / 2
    return np.stack([-np.sin(angle), np.cos(angle)], axis=-1)


def samples_of(lines: Sequence[np.ndarray], number: int) -> np.ndarray:
    """(l, number, 2), so many of the points of each line (n, 2), from its first to its last."""
    count = np.array([len(line) for line in lines])
    within = np.rint(np.arange(number) * ((count - 1) / (number - 1))[:, None]).astype(int)
    return np.concatenate(lines).take((np.cumsum(count) - count)[:, None] + within, axis=0)


def extent(line: np.ndarray) -> float:
    """px from the first point to the last."""
    return float(np.hypot(*(line[-1] - line[0])))


def _weights(error: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Of whole lines, by length and by Geman and McClure's function of their errors over the median."""
    rms = np.sqrt(np.mean(error**2, axis=1))
    spread = max(2 * float(np.median(rms)), _LEAST_SPREAD)
    return length / np.mean(length) / (1 + (rms / spread) ** 2) ** 2
