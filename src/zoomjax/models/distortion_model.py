"""Distortion models: formulas for the coefficients k of one frame, and their inverses.

A distortion model maps a normalised point ``z = (x - c)/s`` to the corrected point, up to the radius where
the map stops being invertible. Radial models have the form ``z L(t)``, ``t = z.z``, and define L; the rest
follows:

    RadialPolynomial    L = 1 + k1 t + k2 t^2 + ... + kN t^N                (eq. 1-2, the default)
    Division            L = 1 / (1 + k1 t + ... + kN t^N)
    BrownConrady        the polynomial, and p1, p2 for a decentred lens, which is not radial

The radius maps as ``r -> r L(r^2)``, and the `monotone_radius` is where that first stops growing; beyond it
the image folds over and no inverse exists. Inverses are iterated until their residual is at the level of
rounding errors, or are NaN; `distortion` differentiates them. A new distortion model is a final class of
`AbstractRadial` or `AbstractDistortionModel`; fits, certificates, files and images use these methods alone.

Formulas are written for one point, with coefficients ``k[0], k[1], ...``, in operations that NumPy and JAX
share. They are also called for many points at once: ``k`` then has further axes, which broadcast against
those of the points.
"""

import abc
from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

from .._core.arrays import apart, namespace
from .._core.checks import checked_integer
from .._core.types import AnyArray, Elements
from ._roots import first_positive_root, first_quadratic_root, increasing_root, newton_root

Pair = tuple[Float[AnyArray, "..."], Float[AnyArray, "..."]]
"""A point (x, y). Coordinates are taken apart once: gradients by slices of a stack are padded arrays."""


def radial_factor(
    squared_radius: Float[AnyArray, "..."], k: Elements | Sequence[Any]
) -> Float[AnyArray, "..."]:
    """L(t) of eq. 2 for normalised squared radii `t` and coefficients `k = (k1, ..., kN)`.

    The same code for NumPy and JAX, as all formulas of radial models.
    """
    return 1 + radial_rest(squared_radius, k)


def radial_rest(
    squared_radius: Float[AnyArray, "..."], k: Elements | Sequence[Any]
) -> Float[AnyArray, "..."]:
    """``L(t) - 1``, with its own digits: where L is near 1, it has more of them than L."""
    rest = 0 * squared_radius
    for number, coefficient in enumerate(reversed(apart(k))):
        rest = ((rest + coefficient) if number else coefficient) * squared_radius
    return rest


def radial_slope(squared_radius: Float[AnyArray, "..."], k: Elements) -> Float[AnyArray, "..."]:
    """The derivative of ``r L(r^2)`` with respect to r, at ``t = r^2``."""
    return radial_factor(squared_radius, times(2 * radial_orders(len(k)) + 1, k))


def radial_orders(terms: int) -> np.ndarray:
    """1, 2, ..., N."""
    return np.arange(1, terms + 1)


def times(factors: np.ndarray, k: Elements) -> Elements:
    """Each coefficient times a number of its own."""
    return factors.astype(k.dtype).reshape(-1, *[1] * (k.ndim - 1)) * k


def positive_up_to(
    x: Float[AnyArray, "..."], b: Float[AnyArray, "..."], c: Any = 0.0, *, digits: int
) -> Bool[AnyArray, "..."]:
    """Whether ``1 + b x + c x²`` is positive from 0 to x, up to some last digits; without a root.

    With ``B = b x`` and ``C = c x²`` it is positive at x if ``1 + B + C`` is. If there were roots before x
    nevertheless, then two: x is beyond the least value, so that ``2 C > -B``, and ``B² >= 4 C``; together
    with ``1 + B + C > 0`` this is ``B < -2``.
    """
    rounding = digits * np.finfo(x.dtype).eps
    linear, square = b * x, c * x * x
    positive = (1 + 2 * rounding) + linear + (1 - rounding) * square >= 0
    return positive & ((linear >= -2 - 2 * rounding) | (4 * square > linear * linear))


def first_root(rows: np.ndarray, k: Elements) -> Float[AnyArray, "..."]:
    """The first positive root of ``1 + sum_i rows[j, i] k_i x^i``, i from 1, over all rows j."""
    xp = namespace(k)
    if len(k) <= 2:  # element by element: XLA makes no copies
        first = first_quadratic_root(*times(rows[0], k))
        for row in rows[1:]:
            first = xp.minimum(first, first_quadratic_root(*times(row, k)))
        return first
    polynomials = xp.stack([xp.concatenate([xp.ones_like(k[:1]), times(row, k)]) for row in rows])
    return first_positive_root(xp.moveaxis(polynomials, (0, 1), (-2, -1)))


def checked_terms(terms: Any, most: int) -> int:
    """The number N of radial distortion coefficients, at most those that a distortion model takes."""
    number = checked_integer("terms", terms, 1)
    if number > most:
        raise ValueError(f"Argument terms must be at most {most}, but it is {number}.")
    return number


class AbstractDistortionModel(eqx.Module):
    """A distortion model: maps normalised points z, given coefficients k. It has no fields."""

    formula: ClassVar[str]
    most_terms: ClassVar[int] = 4
    more_terms: ClassVar[tuple[int, ...]] = ()
    """Radial coefficients that a distortion may have beyond those that fits to lines determine."""

    @abc.abstractmethod
    def num_coefficients(self, terms: int) -> int:
        """The number of coefficients of a model with `terms` radial ones."""

    @abc.abstractmethod
    def orders(self, number: int) -> np.ndarray:
        """The power of the radius that each coefficient goes with: a length in px has it as its unit."""

    @abc.abstractmethod
    def correct(self, z: Pair, squared: Float[AnyArray, "..."], k: Elements) -> Pair:
        """The corrected point, by formula, also beyond the monotone radius; `squared` is z.z."""

    @abc.abstractmethod
    def monotone_radius(self, k: Elements) -> Float[AnyArray, "..."]:
        """The radius up to which `correct` is invertible; inf if everywhere. Constant for derivatives."""

    @abc.abstractmethod
    def distort(self, z: Pair, k: Elements, monotone_radius: Float[AnyArray, "..."]) -> Pair:
        """The point within the monotone radius that is corrected to z; NaN where there is none."""

    def within(self, squared: Float[AnyArray, "..."], k: Elements, *, digits: int) -> Bool[AnyArray, "..."]:
        """Whether a squared radius is within the monotone radius, or beyond it by some last digits.

        Rounded, those are the same radius: what `distort` puts at the fold lies there.
        """
        return squared <= (self.monotone_radius(k) * (1 + digits * np.finfo(squared.dtype).eps)) ** 2

    def before_pole(self, z: Pair, k: Elements) -> tuple[Pair, Bool[AnyArray, "..."]]:
        """The point itself; of one next to a pole, another one nearby, at which `correct` gives numbers.

        For derivatives of the inverse: by k they go on smoothly to the pole. Also whether it is another
        one: what is corrected to there is so far away that the inverse hardly depends on it.
        """
        del k
        return z, namespace(*z).zeros(z[0].shape, bool)

    @abc.abstractmethod
    def conditions(self, number: int) -> np.ndarray:
        """Rows m such that it is invertible up to R where ``1 + sum_i m_i k_i r^o_i > 0`` for r up to R.

        o are the `orders`; where those are 1, r is to be R itself. Linear in k, for proofs and fits.
        """

    @abc.abstractmethod
    def expansion_terms(self, number: int) -> int:
        """How many powers of t `expansion` needs."""

    @abc.abstractmethod
    def expansion(
        self, k: Elements, reach: Float[Array, ""]
    ) -> tuple[Float[AnyArray, "power"], Float[AnyArray, "tangential"]]:
        """The distortion, up to ``t = reach``, as coefficients of powers of t, and (p1, p2) or none.

        Corrected points are linear in these: what compressed lines, and sums over points, can be used for.
        """


class AbstractRadial(AbstractDistortionModel):
    """A radial distortion model, ``z L(t)``."""

    @abc.abstractmethod
    def factor(self, squared: Float[AnyArray, "..."], k: Elements) -> Float[AnyArray, "..."]:
        """L at squared radii t."""

    @abc.abstractmethod
    def slope(self, squared: Float[AnyArray, "..."], k: Elements) -> Float[AnyArray, "..."]:
        """The derivative of ``r L(r^2)`` with respect to r."""

    @abc.abstractmethod
    def equation(self, r: Any, squared: Any, rho: Any, k: Elements) -> tuple[Any, Any]:
        """A number with the sign of ``r L(t) - rho``, smooth up to the fold, and its derivative by r.

        ``t = r^2`` is given; with ``t = (r rho)^2`` and 1 for rho, it is about the ratio of both radii.
        """

    def num_coefficients(self, terms: int) -> int:
        """`terms`."""
        return terms

    def orders(self, number: int) -> np.ndarray:
        """2, 4, ..., 2N."""
        return 2 * radial_orders(number)

    def correct(self, z: Pair, squared: Float[AnyArray, "..."], k: Elements) -> Pair:
        """``z L(t)``."""
        factor = self.factor(squared, k)
        return z[0] * factor, z[1] * factor

    def monotone_radius(self, k: Elements) -> Float[AnyArray, "..."]:
        """The first root of a condition in t."""
        return namespace(k).sqrt(first_root(self.conditions(len(k)), k))

    def reach(self, k: Elements, monotone_radius: Float[AnyArray, "..."]) -> Float[AnyArray, "..."]:
        """The corrected radius of the monotone radius; inf if there is none, or at a pole."""
        xp = namespace(k, monotone_radius)
        finite = xp.where(xp.isinf(monotone_radius), 0, monotone_radius)
        factor = self.factor(finite * finite, k)
        end = xp.isinf(monotone_radius) | ~((factor > 0) & (factor < np.finfo(factor.dtype).eps ** -0.5))
        return xp.where(end, np.inf, finite * factor)

    def within(self, squared: Float[AnyArray, "..."], k: Elements, *, digits: int) -> Bool[AnyArray, "..."]:
        """Of one or two coefficients of each point by their conditions, without a root for each."""
        one_for_all = k.ndim == 1 or k.shape[-1] == 1
        if one_for_all or len(k) > 2:
            return AbstractDistortionModel.within(self, squared, k, digits=digits)
        inside = squared >= 0  # not NaN
        for row in self.conditions(len(k)):
            inside = inside & positive_up_to(squared, *times(row, k), digits=2 * digits)
        return inside

    def ratio(
        self, squared: Float[AnyArray, "..."], k: Elements, monotone_radius: Float[AnyArray, "..."]
    ) -> tuple[Float[AnyArray, "..."], Bool[AnyArray, "..."]]:
        """The distorted radius over the corrected one, whose square is given, and whether there is one.

        It solves ``q L(t q^2) = 1``, which needs no root of the squared radius and is regular at 0.
        """
        xp = namespace(squared, k)
        exists = self.reaches(squared, k, monotone_radius)
        squared = xp.where(exists, squared, 0)
        farthest = (monotone_radius * (1 + 8 * np.finfo(squared.dtype).eps)) ** 2

        def high():
            off_centre = squared > 0
            return xp.where(off_centre, monotone_radius / xp.sqrt(xp.where(off_centre, squared, 1)), np.inf)

        q, found = increasing_root(
            self._of_ratio(squared, k), xp.ones_like(squared), high, lambda q: squared * q * q <= farthest
        )
        return q, exists & found

    def reaches(
        self, squared: Float[AnyArray, "..."], k: Elements, monotone_radius: Float[AnyArray, "..."]
    ) -> Bool[AnyArray, "..."]:
        """Whether a corrected point, of which the squared radius is given, can be reached."""
        eps = np.finfo(squared.dtype).eps
        # A few last digits beyond it are the same radius: what is corrected at the fold rounds to there.
        return namespace(squared, k).isfinite(squared) & (
            squared <= (self.reach(k, monotone_radius) * (1 + 8 * eps)) ** 2
        )

    def _of_ratio(self, squared, k):
        """The ratio's equation."""
        return lambda q: self.equation(q, squared * q * q, 1, k)

    def quick_ratio(
        self, squared: Float[AnyArray, "..."], k: Elements
    ) -> tuple[Float[AnyArray, "..."], Bool[AnyArray, "..."]]:
        """The `ratio` by Newton's steps alone, which need not arrive, and where they did."""
        return newton_root(
            self._of_ratio(squared, k),
            namespace(squared, k).ones_like(squared),
            lambda q: self.within(squared * q * q, k, digits=8),
        )

    def distort(self, z: Pair, k: Elements, monotone_radius: Float[AnyArray, "..."]) -> Pair:
        """By the `ratio` of the radii."""
        q, found = self.ratio(z[0] * z[0] + z[1] * z[1], k, monotone_radius)
        q = namespace(q).where(found, q, np.nan)
        return z[0] * q, z[1] * q
