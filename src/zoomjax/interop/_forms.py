"""The formulas of other tools, and their minimax fit to pairs of points.

With few exceptions they are one rational form with decentering,

    G(z) = z (1 + n1 t + n2 t² + ...) / (1 + d1 t + d2 t² + ...) + t q + 2 (q.z) z,  t = z.z,  q = (p2, p1)

either from distorted to corrected points, as ours, or from corrected to distorted ones, as OpenCV's. The
second is no inverse of the first: coefficients are fitted anew, and never negated.

The fit minimises the greatest distance. It is a sequence of linear least squares: the weights of the points
are multiplied by their distances (Lawson's algorithm), the equation is multiplied by the denominator that
the solution before had, and a small ridge keeps numerator and denominator from cancelling each other. The
ridge makes the coefficients a smooth function of the data, so that they can be interpolated over the zoom.
"""

import abc
import dataclasses
from collections.abc import Callable
from typing import ClassVar

import numpy as np
from jaxtyping import Float

_STEPS = 40
"""Of Lawson's algorithm. Its greatest distance is then a few per cent above the least possible."""

_LESS, _PATIENCE = 0.99, 6
"""It ends where the greatest distance has not become so much less in that many steps."""

_RIDGE = 1e-5
"""Weight of the coefficients beside the RMS distance, both in half diagonals."""

_GOOD = 4e-7
"""Distance in half diagonals that needs no further steps: a thousandth of a pixel in images of 10 Mpx."""


class AbstractForm(abc.ABC):
    """A formula from points to points, with coefficients that are fitted.

    Attributes:
        corrects: whether it maps distorted to corrected points; else corrected to distorted ones.
        any_scale: whether the tool scales corrected images as it likes, so that distances count up to that.
    """

    corrects: bool
    any_scale: ClassVar[bool] = False

    @property
    @abc.abstractmethod
    def orders(self) -> Float[np.ndarray, "coefficient"]:
        """The power of the radius that each coefficient goes with."""

    @abc.abstractmethod
    def __call__(
        self, theta: Float[np.ndarray, "coefficient"], z: Float[np.ndarray, "point 2"]
    ) -> Float[np.ndarray, "point 2"]:
        """The mapped points."""

    @abc.abstractmethod
    def fit(
        self, start: Float[np.ndarray, "point 2"], end: Float[np.ndarray, "point 2"]
    ) -> Float[np.ndarray, "coefficient"]:
        """The coefficients that map points to others, with the least greatest distance."""

    def distances(
        self, theta: np.ndarray, start: Float[np.ndarray, "point 2"], end: Float[np.ndarray, "point 2"]
    ) -> Float[np.ndarray, "point"]:
        """How far the mapped points are from where they should be."""
        return np.hypot(*(self(theta, start) - end).T)

    def rescaled(self, theta: np.ndarray, ratio: float) -> np.ndarray:
        """The coefficients for another unit of the radius, `ratio` times as long."""
        return theta * ratio**self.orders


@dataclasses.dataclass(frozen=True)
class Form(AbstractForm):
    """The rational form with decentering, for radii in any unit.

    Coefficients are in one array: numerators, denominators, and p1, p2 if there are any.

    Attributes:
        numerators, denominators: the number of each.
        tangential: whether there are p1 and p2.
        corrects: whether it maps distorted to corrected points; else corrected to distorted ones.
    """

    numerators: int
    denominators: int = 0
    tangential: bool = False
    corrects: bool = False

    @property
    def orders(self) -> Float[np.ndarray, "coefficient"]:
        """The power of the radius that each coefficient goes with."""
        powers = [2 * (i + 1) for count in (self.numerators, self.denominators) for i in range(count)]
        return np.array([*powers, *[1, 1] * self.tangential], float)

    def split(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Numerators, denominators and (p1, p2), zeros if there are none."""
        end = self.numerators + self.denominators
        return (
            theta[: self.numerators],
            theta[self.numerators : end],
            theta[end:] if self.tangential else np.zeros(2),
        )

    def __call__(
        self, theta: Float[np.ndarray, "coefficient"], z: Float[np.ndarray, "point 2"]
    ) -> Float[np.ndarray, "point 2"]:
        """The mapped points."""
        numerators, denominators, (p1, p2) = self.split(theta)
        t = np.sum(z * z, axis=-1, keepdims=True)
        factor = _polynomial(t, numerators) / _polynomial(t, denominators)
        q = np.array([p2, p1])
        return z * (factor + 2 * (z @ q)[..., None]) + t * q

    def fit(
        self, start: Float[np.ndarray, "point 2"], end: Float[np.ndarray, "point 2"]
    ) -> Float[np.ndarray, "coefficient"]:
        """The coefficients that map points to others, with the least greatest distance."""
        t = np.sum(start * start, axis=-1)
        x, y = start.T
        tangents = [np.stack([2 * x * y, t + 2 * y * y], -1), np.stack([t + 2 * x * x, 2 * x * y], -1)]

        def equations(theta):
            before = _polynomial(t, self.split(theta)[1])[:, None]
            columns = [
                *(start * t[:, None] ** (i + 1) / before for i in range(self.numerators)),
                *(-end * t[:, None] ** (i + 1) / before for i in range(self.denominators)),
                *tangents[: 2 * self.tangential],
            ]
            return np.stack(columns, axis=-1), (end - start) / before

        return minimax(equations, lambda theta: self(theta, start) - end, len(self.orders))


def minimax(
    equations: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    error: Callable[[np.ndarray], np.ndarray],
    size: int,
) -> np.ndarray:
    """Coefficients with the least greatest error.

    Args:
        equations: the matrix (point, 2, coefficient) and right side (point, 2) of equations that are linear
            in the coefficients, given those of the step before.
        error: the error of each point, (point, 2).
        size: the number of coefficients.
    """
    theta = best = np.zeros(size)
    least, weight, since = np.inf, None, 0
    for _ in range(_STEPS):
        matrix, right = equations(theta)
        if weight is None:
            weight = np.full(len(right), 1 / len(right))
        rows = matrix.reshape(-1, size)
        weighted = rows.T * np.repeat(weight, 2)
        # The ridge bounds the condition of this matrix: square roots would gain nothing.
        theta = np.linalg.solve(weighted @ rows + _RIDGE**2 * np.eye(size), weighted @ right.ravel())
        distance = np.hypot(*error(theta).T)
        since = 0 if distance.max() < _LESS * least else since + 1
        if distance.max() < least:
            least, best = distance.max(), theta
        if not distance.max() > _GOOD or since == _PATIENCE:
            break
        weight = weight * distance
        weight = weight / weight.sum()
    return best


def _polynomial(t: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """``1 + c1 t + c2 t² + ...``."""
    return np.polynomial.polynomial.polyval(t, np.append(1.0, coefficients))
