"""Families of distortions: what the coefficients k of one frame make of a point, and back.

A family maps a normalised point ``z = (x - c)/s`` to its corrected one, up to the radius where that stops
being invertible. Radial families have ``z L(t)``, ``t = z.z``, and state L; all else follows:

    RadialPolynomial    L = 1 + k1 t + k2 t^2 + ... + kN t^N                (eq. 1-2, the default)
    Division            L = 1 / (1 + k1 t + ... + kN t^N)
    BrownConrady        the polynomial, and p1, p2 for a decentred lens, which is not radial

The radius maps as ``r -> r L(r^2)``, and the *limit* is where that first stops growing; beyond it the image
folds over and no inverse exists. Inverses are iterated until their residual is one of rounding, or are
NaN; `radial` differentiates them. A new family is a final class of
`AbstractRadial` or `AbstractFamily`; fits, certificates, files and images go through these methods alone.

Formulas are written for one point, with coefficients ``k[0], k[1], ...``, in operations that NumPy and JAX
share. They are also called for many points at once: ``k`` then has further axes, which broadcast against
those of the points.
"""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ._arrays import namespace
from ._roots import first_positive_root, first_quadratic_root, increasing_root, newton_root, until
from ._types import AnyArray, Elements

Pair = tuple[Float[AnyArray, "..."], Float[AnyArray, "..."]]
"""A point (x, y). Coordinates are taken apart once: gradients by slices of a stack are padded arrays."""

_DIRECTIONS = 8
"""Half-planes that stand in for the length of (p1, p2): up to 8 % longer, and linear."""


def radial_factor(squared_radius: Float[AnyArray, "..."], k: Elements) -> Float[AnyArray, "..."]:
    """L(t) of eq. 2 for normalised squared radii `t` and coefficients `k = (k1, ..., kN)`.

    The same code for NumPy and JAX, as all of a radial family's formulas.
    """
    factor = 0 * squared_radius if len(k) == 0 else k[-1] * squared_radius
    for coefficient in k[-2::-1]:
        factor = (factor + coefficient) * squared_radius
    return 1 + factor


def radial_slope(squared_radius: Float[AnyArray, "..."], k: Elements) -> Float[AnyArray, "..."]:
    """The derivative of ``r L(r^2)`` with respect to r, at ``t = r^2``."""
    return radial_factor(squared_radius, _times(2 * _order(len(k)) + 1, k))


def _order(terms: int) -> np.ndarray:
    """1, 2, ..., N."""
    return np.arange(1, terms + 1)


def _times(factors: np.ndarray, k: Elements) -> Elements:
    """Each coefficient times a number of its own."""
    return factors.astype(k.dtype).reshape(-1, *[1] * (k.ndim - 1)) * k


def _first_root(rows: np.ndarray, k: Elements) -> Float[AnyArray, "..."]:
    """The first positive root of ``1 + sum_i rows[j, i] k_i x^i``, i from 1, over all rows j."""
    xp = namespace(k)
    if len(k) <= 2:  # element by element: XLA makes no copies
        first = first_quadratic_root(*_times(rows[0], k))
        for row in rows[1:]:
            first = xp.minimum(first, first_quadratic_root(*_times(row, k)))
        return first
    polynomials = xp.stack([xp.concatenate([xp.ones_like(k[:1]), _times(row, k)]) for row in rows])
    return first_positive_root(xp.moveaxis(polynomials, (0, 1), (-2, -1)))


class AbstractFamily(eqx.Module):
    """What coefficients k make of a normalised point z. It has no fields: the coefficients are k alone."""

    formula: ClassVar[str]
    most_terms: ClassVar[int] = 4

    @abc.abstractmethod
    def size(self, terms: int) -> int:
        """How many coefficients there are with `terms` radial ones."""

    @abc.abstractmethod
    def orders(self, size: int) -> np.ndarray:
        """The power of the radius that each coefficient goes with: a length in px has it as its unit."""

    @abc.abstractmethod
    def correct(self, z: Pair, squared: Float[AnyArray, "..."], k: Elements) -> Pair:
        """The corrected point, by formula, also beyond the limit; `squared` is z.z."""

    @abc.abstractmethod
    def limit(self, k: Elements) -> Float[AnyArray, "..."]:
        """The radius up to which `correct` is invertible; inf if everywhere. Constant for derivatives."""

    @abc.abstractmethod
    def distort(self, z: Pair, k: Elements, limit: Float[AnyArray, "..."]) -> Pair:
        """The point within the limit that is corrected to z; NaN where there is none."""

    def quick_distort(
        self, z: Pair, k: Elements, limit: Float[AnyArray, "..."]
    ) -> tuple[Pair, Bool[AnyArray, "..."]] | None:
        """The same by a few steps that need not arrive, and where they did; None if there is no such way.

        Where all points arrive, which is nearly always, `distort` is not called.
        """
        del z, k, limit
        return None

    @abc.abstractmethod
    def conditions(self, size: int) -> np.ndarray:
        """Rows m such that it is invertible up to R where ``1 + sum_i m_i k_i r^o_i > 0`` for r up to R.

        o are the `orders`; where those are 1, r is to be R itself. Linear in k, for proofs and fits.
        """

    @abc.abstractmethod
    def expansion_terms(self, size: int) -> int:
        """How many powers of t `expansion` needs."""

    @abc.abstractmethod
    def expansion(
        self, k: Elements, reach: Float[Array, ""]
    ) -> tuple[Float[AnyArray, "power"], Float[AnyArray, "tangential"]]:
        """The distortion, up to ``t = reach``, as coefficients of powers of t, and (p1, p2) or none.

        Corrected points are linear in these: what compressed lines, and sums over points, can be used for.
        """


class AbstractRadial(AbstractFamily):
    """A family with ``z L(t)``."""

    @abc.abstractmethod
    def factor(self, squared: Float[AnyArray, "..."], k: Elements) -> Float[AnyArray, "..."]:
        """L at squared radii t."""

    @abc.abstractmethod
    def slope(self, squared: Float[AnyArray, "..."], k: Elements) -> Float[AnyArray, "..."]:
        """The derivative of ``r L(r^2)`` with respect to r."""

    @abc.abstractmethod
    def equation(self, r: Any, squared: Any, rho: Any, k: Elements) -> tuple[Any, Any]:
        """A number with the sign of ``r L(t) - rho``, smooth up to the limit, and its derivative by r.

        ``t = r^2`` is given; with ``t = (r rho)^2`` and 1 for rho, it is about the ratio of both radii.
        """

    def size(self, terms: int) -> int:
        """`terms`."""
        return terms

    def orders(self, size: int) -> np.ndarray:
        """2, 4, ..., 2N."""
        return 2 * _order(size)

    def correct(self, z: Pair, squared: Float[AnyArray, "..."], k: Elements) -> Pair:
        """``z L(t)``."""
        factor = self.factor(squared, k)
        return z[0] * factor, z[1] * factor

    def limit(self, k: Elements) -> Float[AnyArray, "..."]:
        """The monotone radius: the first root of a condition in t."""
        return namespace(k).sqrt(_first_root(self.conditions(len(k)), k))

    def reach(self, k: Elements, limit: Float[AnyArray, "..."]) -> Float[AnyArray, "..."]:
        """The corrected radius that the limit goes to; inf if there is none, or at a pole."""
        xp = namespace(k, limit)
        finite = xp.where(xp.isinf(limit), 0, limit)
        factor = self.factor(finite * finite, k)
        end = xp.isinf(limit) | ~((factor > 0) & (factor < np.finfo(factor.dtype).eps ** -0.5))
        return xp.where(end, np.inf, finite * factor)

    def ratio(
        self, squared: Float[AnyArray, "..."], k: Elements, limit: Float[AnyArray, "..."]
    ) -> tuple[Float[AnyArray, "..."], Bool[AnyArray, "..."]]:
        """The distorted radius over the corrected one, whose square is given, and whether there is one.

        It solves ``q L(t q^2) = 1``, which needs no root of the squared radius and is regular at 0.
        """
        xp = namespace(squared, k)
        exists = self._exists(squared, k, limit)
        squared = xp.where(exists, squared, 0)
        equation, within = self._of_ratio(squared, k, limit)

        def high():
            off_centre = squared > 0
            return xp.where(off_centre, limit / xp.sqrt(xp.where(off_centre, squared, 1)), np.inf)

        q, found = increasing_root(equation, xp.ones_like(squared), high, within)
        return q, exists & found

    def _exists(self, squared, k, limit):
        """Where there is a ratio."""
        eps = np.finfo(squared.dtype).eps
        # A few last digits beyond it are the same radius: what is corrected at the fold rounds to there.
        return namespace(squared, k).isfinite(squared) & (
            squared <= (self.reach(k, limit) * (1 + 8 * eps)) ** 2
        )

    def _of_ratio(self, squared, k, limit):
        """The ratio's equation, and whether it is within the limit."""
        farthest = (limit * (1 + 8 * np.finfo(squared.dtype).eps)) ** 2

        def equation(q):
            return self.equation(q, squared * q * q, 1, k)

        return equation, lambda q: squared * q * q <= farthest

    def distort(self, z: Pair, k: Elements, limit: Float[AnyArray, "..."]) -> Pair:
        """By the `ratio` of the radii."""
        return _scaled(z, *self.ratio(_square(z), k, limit))

    def quick_distort(
        self, z: Pair, k: Elements, limit: Float[AnyArray, "..."]
    ) -> tuple[Pair, Bool[AnyArray, "..."]]:
        """By Newton's steps alone."""
        squared = _square(z)
        exists = self._exists(squared, k, limit)
        squared = namespace(squared, k).where(exists, squared, 0)  # arrived at once
        equation, within = self._of_ratio(squared, k, limit)
        q, arrived = newton_root(equation, namespace(squared, k).ones_like(squared), within)
        return _scaled(z, q, exists & arrived), arrived


class RadialPolynomial(AbstractRadial):
    """``L = 1 + k1 t + ... + kN t^N``: the paper's (eq. 1-2)."""

    formula: ClassVar[str] = (
        "corrected = centre + z * scale * (1 + k1 r^2 + ... + kN r^2N), "
        "z = (distorted - centre) / scale, r^2 = z.z"
    )

    def factor(self, squared: Float[AnyArray, "..."], k: Elements) -> Float[AnyArray, "..."]:
        """L."""
        return radial_factor(squared, k)

    def slope(self, squared: Float[AnyArray, "..."], k: Elements) -> Float[AnyArray, "..."]:
        """``1 + 3 k1 t + ... + (2N+1) kN t^N``."""
        return radial_slope(squared, k)

    def equation(self, r: Any, squared: Any, rho: Any, k: Elements) -> tuple[Any, Any]:
        """``r L(t) - rho``."""
        return r * radial_factor(squared, k) - rho, radial_slope(squared, k)

    def conditions(self, size: int) -> np.ndarray:
        """One: the slope."""
        return (2 * _order(size) + 1)[None]

    def expansion_terms(self, size: int) -> int:
        """Its own."""
        return size

    def expansion(
        self, k: Elements, reach: Float[Array, ""]
    ) -> tuple[Float[AnyArray, "power"], Float[AnyArray, "tangential"]]:
        """Itself."""
        del reach
        return k, k[:0]


class Division(AbstractRadial):
    """``L = 1 / (1 + k1 t + ... + kN t^N)``: Fitzgibbon's, where a strong barrel needs few terms.

    One or two terms are usual. To first order its k1 is minus that of the polynomial. It is invertible up
    to the first pole, or the first zero of the numerator ``1 - k1 t - 3 k2 t^2 - ...`` of its slope.

    References:
        A. Fitzgibbon, "Simultaneous linear estimation of multiple view geometry and lens distortion",
        CVPR 2001.

    Example:
        >>> import jax.numpy as jnp
        >>> from zoomjax import Distortion
        >>> d = Distortion(jnp.array([-0.2]), jnp.zeros(2), jnp.array(100.0), Division())
        >>> d.undistort(jnp.array([100.0, 0.0])).tolist(), d.distort(jnp.array([125.0, 0.0])).tolist()
        ([125.0, 0.0], [100.0, 0.0])
    """

    formula: ClassVar[str] = (
        "corrected = centre + z * scale / (1 + k1 r^2 + ... + kN r^2N), "
        "z = (distorted - centre) / scale, r^2 = z.z"
    )

    def factor(self, squared: Float[AnyArray, "..."], k: Elements) -> Float[AnyArray, "..."]:
        """L."""
        return 1 / radial_factor(squared, k)

    def slope(self, squared: Float[AnyArray, "..."], k: Elements) -> Float[AnyArray, "..."]:
        """``(1 - k1 t - 3 k2 t^2 - ...) / (1 + k1 t + ...)^2``."""
        numerator = radial_factor(squared, _times(1 - 2 * _order(len(k)), k))
        return numerator / radial_factor(squared, k) ** 2

    def equation(self, r: Any, squared: Any, rho: Any, k: Elements) -> tuple[Any, Any]:
        """``r - rho (1 + k1 t + ...)``, which has no pole."""
        divisor = radial_factor(squared, k)
        growth = radial_slope(squared, k) - divisor  # by r, times r
        return r - rho * divisor, 1 - rho / (r + (r == 0)) * growth

    def conditions(self, size: int) -> np.ndarray:
        """The numerator of the slope, and the divisor."""
        return np.stack([1 - 2 * _order(size), np.ones(size, int)])

    def expansion_terms(self, size: int) -> int:
        """8, or its own number if that is more.

        The error of L up to the corner, measured: for |k1| up to 0.1 5e-14, to 0.3 3e-9, to 0.5 1.5e-6
        (of half the diagonal: 6e-4 px at 640 x 480); for (-0.3, -0.2), half way to the pole, 2e-5.
        """
        return max(8, size)

    def expansion(
        self, k: Elements, reach: Float[Array, ""]
    ) -> tuple[Float[AnyArray, "power"], Float[AnyArray, "tangential"]]:
        """L's Taylor polynomial T, and the interpolation of the rest in Chebyshev's nodes.

        The rest is ``(1 - D T)/D`` for the divisor D, and its first powers are known to vanish. It is small
        and so are its rounding errors, which powers through nodes multiply by 1e5: not those of L itself.
        """
        size, terms = k.shape[0], self.expansion_terms(k.shape[0])
        powers = jnp.asarray(reach, k.dtype) ** np.arange(1, terms + 1)
        scaled = k * powers[:size]  # now t is from 0 to 1
        series: list[Any] = [jnp.ones((), k.dtype)]
        for _ in range(terms):
            series.append(-sum(c * s for c, s in zip(scaled, series[::-1], strict=False)))
        # What 1 - D T is made of: its powers terms + 1, ..., terms + size.
        beyond = [
            -sum(scaled[j - 1] * series[terms + m - j] for j in range(m, size + 1))
            for m in range(1, size + 1)
        ]
        nodes = (1 - np.cos(np.pi * (np.arange(terms) + 0.5) / terms)) / 2
        t = nodes.astype(k.dtype)
        tail = sum(b * t**m for m, b in enumerate(beyond)) * t**terms / radial_factor(t, scaled)
        interpolation = np.linalg.inv(np.vander(nodes, increasing=True)).astype(k.dtype)
        rest = jnp.matmul(interpolation, tail, precision="highest")
        return (jnp.stack(series[1:]) + rest) / powers, k[:0]


class BrownConrady(AbstractFamily):
    """The radial polynomial of N terms and decentering: coefficients ``(k1, ..., kN, p1, p2)``.

    With ``z = (x, y)`` and ``q = (p2, p1)`` the corrected point is ``z L(t) + t q + 2 (q.z) z``, that is

        x L(t) + 2 p1 x y + p2 (t + 2 x^2),    y L(t) + p1 (t + 2 y^2) + 2 p2 x y,

    with OpenCV's order of p1 and p2, but from distorted to corrected points.

    *It is invertible* on the disc of radius R if ``min(L, (r L)') - 6 |q| r > 0`` for r < R, the `limit`.
    For the Jacobian is symmetric: that of z L has the eigenvalues L (across) and (r L)' (along z), that of
    the rest, ``2 q z^T + 2 z q^T + 2 (q.z) I``, has ``4 q.z ± 2 |q| r``, none below ``-6 |q| r``. So it is
    positive definite, and ``(F(a) - F(b)).(a - b)``, the integral of the Jacobian's form over the segment
    between two points of the disc, is positive: F is injective. (A little beyond it may still be.)

    If, for the certificate, ``(r L)' > 6 |q| R`` up to R, then also ``L = 1/r int (r L)' > 6 |q| R``.
    """

    formula: ClassVar[str] = (
        "corrected = centre + scale * (z (1 + k1 r^2 + ... + kN r^2N) + r^2 q + 2 (q.z) z), "
        "z = (distorted - centre) / scale, r^2 = z.z, q = (p2, p1), coefficients (k1, ..., kN, p1, p2)"
    )

    def size(self, terms: int) -> int:
        """Two more."""
        return terms + 2

    def orders(self, size: int) -> np.ndarray:
        """2, 4, ..., 2N, 1, 1."""
        return np.append(2 * _order(size - 2), [1, 1])

    def correct(self, z: Pair, squared: Float[AnyArray, "..."], k: Elements) -> Pair:
        """``z L(t) + t q + 2 (q.z) z``."""
        qx, qy = k[-1], k[-2]
        x, y = z
        factor = radial_factor(squared, k[:-2]) + 2 * (qx * x + qy * y)
        return x * factor + squared * qx, y * factor + squared * qy

    def limit(self, k: Elements) -> Float[AnyArray, "..."]:
        """The first root of ``min(L, (r L)') - 6 |q| r``."""
        xp, terms = namespace(k), len(k) - 2
        across = -6 * xp.sqrt(k[-1:] ** 2 + k[-2:-1] ** 2)
        powers = [across]  # of r, from the first on
        for index in range(terms):
            powers += [k[index : index + 1], 0 * across]
        rows = np.ones((2, 2 * terms + 1), int)
        rows[1, 1::2] = 2 * _order(terms) + 1
        return _first_root(rows, xp.concatenate(powers))

    def distort(self, z: Pair, k: Elements, limit: Float[AnyArray, "..."]) -> Pair:
        """By Newton's method from the inverse without decentering; see `_solve`."""
        xp = namespace(*z, k)
        finite = xp.isfinite(z[0]) & xp.isfinite(z[1])
        x, y, found = self._solve(xp.where(finite, z[0], 0), xp.where(finite, z[1], 0), k, limit)
        found = finite & found
        return xp.where(found, x, np.nan), xp.where(found, y, np.nan)

    def _solve(self, zx, zy, k, limit):
        """The point of the disc that is corrected to (zx, zy), and whether it was found.

        A step of Newton's method is halved until it comes nearer, and brought back to the disc.
        """
        xp, eps = namespace(zx, k), np.finfo(zx.dtype).eps
        qx, qy = k[-1], k[-2]
        slopes = _times(2 * _order(len(k) - 2), k[:-2])
        size = zx * zx + zy * zy

        def missed(x, y):
            """By how much, its square, and the Jacobian, which is symmetric."""
            squared = x * x + y * y
            along = 2 * (qx * x + qy * y)
            factor = radial_factor(squared, k[:-2]) + along
            bend = 0 * squared  # 2 dL/dt
            for slope in slopes[::-1]:
                bend = bend * squared + slope
            ex, ey = x * factor + squared * qx - zx, y * factor + squared * qy - zy
            a = factor + bend * x * x + 4 * qx * x
            b = bend * x * y + 2 * (qx * y + qy * x)
            d = factor + bend * y * y + 4 * qy * y
            return ex, ey, ex * ex + ey * ey, a, b, d

        def unfinished(state):
            x, y, length, _, _, error, *_ = state
            return (error > eps**2 * xp.maximum(size, x * x + y * y)) & (length > 1e-6)

        def step(state):
            x, y, length, ex, ey, error, a, b, d = state
            determinant = a * d - b * b
            scaled = length / xp.where(determinant > 0, determinant, 1)
            new_x, new_y = x - scaled * (d * ex - b * ey), y - scaled * (a * ey - b * ex)
            squared = new_x * new_x + new_y * new_y
            out = squared > limit * limit
            back = xp.where(out, limit / xp.sqrt(xp.where(out, squared, 1)), 1)
            new_x, new_y = new_x * back, new_y * back
            new = missed(new_x, new_y)
            better = new[2] < error
            kept = [
                xp.where(better, one, other)
                for one, other in zip((new_x, new_y, *new), (x, y, *state[3:]), strict=True)
            ]
            return kept[0], kept[1], xp.where(better, 1, length / 2), *kept[2:]

        radial = RadialPolynomial()
        reach = radial.reach(k[:-2], limit)
        shrunk = xp.where(size > reach * reach, reach * reach, size)
        q, _ = radial.ratio(shrunk, k[:-2], limit)
        q = q * xp.sqrt(shrunk / xp.where(size > 0, size, 1))
        q = xp.where(size > 0, q, 1)
        x, y = zx * q, zy * q
        state = (x, y, 0 * x + 1, *missed(x, y))
        x, y, _, _, _, error, *_ = until(xp, unfinished, step, state, 200)
        return x, y, error <= (64 * eps) ** 2 * xp.maximum(size, x * x + y * y)

    def conditions(self, size: int) -> np.ndarray:
        """The slope of the radius less ``6 q.d r``, for directions d of which one is nearly q's."""
        angle = 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
        across = -6 / np.cos(np.pi / _DIRECTIONS) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        slope = np.broadcast_to(2 * _order(size - 2) + 1.0, (_DIRECTIONS, size - 2))
        return np.concatenate([slope, across], axis=1)

    def expansion_terms(self, size: int) -> int:
        """The radial ones."""
        return size - 2

    def expansion(
        self, k: Elements, reach: Float[Array, ""]
    ) -> tuple[Float[AnyArray, "power"], Float[AnyArray, "tangential"]]:
        """Itself."""
        del reach
        return k[:-2], k[-2:]


def _square(z: Pair) -> Float[AnyArray, "..."]:
    """z.z."""
    return z[0] * z[0] + z[1] * z[1]


def _scaled(z: Pair, q: Float[AnyArray, "..."], found: Bool[AnyArray, "..."]) -> Pair:
    """``q z``, NaN where nothing was found."""
    q = namespace(*z, q).where(found, q, np.nan)
    return z[0] * q, z[1] * q
