"""Families of distortions: what the coefficients k of one frame make of a point, and back.

A family maps a normalised point ``z = (x - c)/s`` to its corrected one, up to the radius where that stops
being invertible. Radial families have ``z L(t)``, ``t = z.z``, and state L; all else follows:

    RadialPolynomial    L = 1 + k1 t + k2 t^2 + ... + kN t^N                (eq. 1-2, the default)
    Division            L = 1 / (1 + k1 t + ... + kN t^N)
    BrownConrady        the polynomial, and p1, p2 for a decentred lens, which is not radial

The radius maps as ``r -> r L(r^2)``, and the *limit* is where that first stops growing; beyond it the image
folds over and no inverse exists. Inverses are iterated to convergence, per point, and differentiated by the
implicit function theorem. A new family is a final class of `AbstractRadial` or `AbstractFamily`; fits,
certificates, files and images go through these methods alone.
"""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ._types import AnyArray, Coefficients

_DIRECTIONS = 8
"""Half-planes that stand in for the length of (p1, p2): up to 8 % longer, and linear."""


def radial_factor(squared_radius: Float[AnyArray, "*batch"], k: Coefficients) -> Float[AnyArray, "*batch"]:
    """L(t) of eq. 2 for normalised squared radii `t` and coefficients `k = (k1, ..., kN)`.

    The same code for NumPy and JAX, as all of a radial family's formulas.
    """
    factor = 0 * squared_radius if len(k) == 0 else k[-1] * squared_radius
    for coefficient in k[-2::-1]:
        factor = (factor + coefficient) * squared_radius
    return 1 + factor


def radial_slope(squared_radius: Float[AnyArray, "*batch"], k: Coefficients) -> Float[AnyArray, "*batch"]:
    """The derivative of ``r L(r^2)`` with respect to r, at ``t = r^2``."""
    return radial_factor(squared_radius, (2 * _order(k.shape[0], k.dtype) + 1) * k)


def _order(terms: int, dtype: Any = int) -> np.ndarray:
    """1, 2, ..., N."""
    return np.arange(1, terms + 1, dtype=dtype)


class AbstractFamily(eqx.Module):
    """What coefficients k make of a normalised point z. It has no fields: the coefficients are k alone."""

    formula: ClassVar[str]

    @abc.abstractmethod
    def size(self, terms: int) -> int:
        """How many coefficients there are with `terms` radial ones."""

    @abc.abstractmethod
    def orders(self, size: int) -> np.ndarray:
        """The power of the radius that each coefficient goes with: a length in px has it as its unit."""

    @abc.abstractmethod
    def correct(
        self, z: Float[AnyArray, "*batch 2"], squared: Float[AnyArray, "*batch"], k: Coefficients
    ) -> Float[AnyArray, "*batch 2"]:
        """The corrected point, by formula, also beyond the limit; `squared` is z.z.

        Of NumPy arrays (..., 2) it is that of each point.
        """

    @abc.abstractmethod
    def limit(self, k: Coefficients) -> Float[Array, ""]:
        """The radius up to which `correct` is invertible; inf if everywhere. Constant for derivatives."""

    @abc.abstractmethod
    def distort(self, z: Float[Array, "2"], k: Coefficients, limit: Float[Array, ""]) -> Float[Array, "2"]:
        """The point within the limit that is corrected to z; NaN where there is none."""

    @abc.abstractmethod
    def has_inverse(
        self, z: Float[Array, "2"], k: Coefficients, limit: Float[Array, ""]
    ) -> Bool[Array, ""]:
        """Whether there is one."""

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
        self, k: Coefficients, reach: Float[Array, ""]
    ) -> tuple[Float[AnyArray, "power"], Float[AnyArray, "tangential"]]:
        """The distortion, up to ``t = reach``, as coefficients of powers of t, and (p1, p2) or none.

        Corrected points are linear in these: what compressed lines, and sums over points, can be used for.
        """


class AbstractRadial(AbstractFamily):
    """A family with ``z L(t)``."""

    @abc.abstractmethod
    def factor(self, squared: Float[AnyArray, "*batch"], k: Coefficients) -> Float[AnyArray, "*batch"]:
        """L at squared radii t."""

    @abc.abstractmethod
    def slope(self, squared: Float[AnyArray, "*batch"], k: Coefficients) -> Float[AnyArray, "*batch"]:
        """The derivative of ``r L(r^2)`` with respect to r."""

    @abc.abstractmethod
    def equation(self, r: Any, squared: Any, rho: Any, k: Coefficients) -> tuple[Any, Any]:
        """A number with the sign of ``r L(t) - rho``, smooth up to the limit, and its derivative by r.

        ``t = r^2`` is given; with ``t = (r rho)^2`` and 1 for rho, it is about the ratio of both radii.
        """

    def size(self, terms: int) -> int:
        """`terms`."""
        return terms

    def orders(self, size: int) -> np.ndarray:
        """2, 4, ..., 2N."""
        return 2 * _order(size)

    def correct(
        self, z: Float[AnyArray, "*batch 2"], squared: Float[AnyArray, "*batch"], k: Coefficients
    ) -> Float[AnyArray, "*batch 2"]:
        """``z L(t)``."""
        return z * self.factor(squared, k)[..., None]

    def limit(self, k: Coefficients) -> Float[Array, ""]:
        """The monotone radius: the first root of a condition in t."""
        k = jax.lax.stop_gradient(jnp.asarray(k))
        rows = self.conditions(k.shape[0]).astype(k.dtype) * k[None]
        return jnp.sqrt(first_positive_root(jnp.concatenate([jnp.ones_like(rows[:, :1]), rows], axis=1)))

    def reach(self, k: Coefficients, limit: Float[Array, ""]) -> Float[Array, ""]:
        """The corrected radius that the limit goes to; inf if there is none, or at a pole."""
        finite = jnp.where(jnp.isinf(limit), 0, limit)
        factor = self.factor(finite * finite, k)
        end = jnp.isinf(limit) | ~((factor > 0) & (factor < jnp.finfo(factor.dtype).eps ** -0.5))
        return jnp.where(end, jnp.inf, finite * factor)

    def has_inverse(
        self, z: Float[Array, "2"], k: Coefficients, limit: Float[Array, ""]
    ) -> Bool[Array, ""]:
        """Whether z is not beyond the `reach`."""
        squared = z @ z
        # A few last digits beyond it are the same radius: what is corrected at the fold rounds to there.
        reach = self.reach(k, limit) * (1 + 8 * jnp.finfo(z.dtype).eps)
        return jnp.isfinite(squared) & (squared <= reach * reach)

    def distort(self, z: Float[Array, "2"], k: Coefficients, limit: Float[Array, ""]) -> Float[Array, "2"]:
        """By `inverse_radius`."""
        squared = z @ z
        exists = self.has_inverse(z, k, limit)
        # Guard the input of the root and of the quotient, not their output: a where() on a NaN result
        # still has a NaN gradient.
        regular = exists & (squared > 0)
        rho = jnp.sqrt(jnp.where(regular, squared, 1))
        r = inverse_radius(self, jnp.where(regular, rho, 0), k, limit)
        return z * jnp.where(regular, r / rho, jnp.where(exists, 1, jnp.nan))


class RadialPolynomial(AbstractRadial):
    """``L = 1 + k1 t + ... + kN t^N``: the paper's (eq. 1-2)."""

    formula: ClassVar[str] = (
        "corrected = centre + z * scale * (1 + k1 r^2 + ... + kN r^2N), "
        "z = (distorted - centre) / scale, r^2 = z.z"
    )

    def factor(self, squared: Float[AnyArray, "*batch"], k: Coefficients) -> Float[AnyArray, "*batch"]:
        """L."""
        return radial_factor(squared, k)

    def slope(self, squared: Float[AnyArray, "*batch"], k: Coefficients) -> Float[AnyArray, "*batch"]:
        """``1 + 3 k1 t + ... + (2N+1) kN t^N``."""
        return radial_slope(squared, k)

    def equation(self, r: Any, squared: Any, rho: Any, k: Coefficients) -> tuple[Any, Any]:
        """``r L(t) - rho``."""
        return r * radial_factor(squared, k) - rho, radial_slope(squared, k)

    def conditions(self, size: int) -> np.ndarray:
        """One: the slope."""
        return (2 * _order(size) + 1)[None]

    def expansion_terms(self, size: int) -> int:
        """Its own."""
        return size

    def expansion(
        self, k: Coefficients, reach: Float[Array, ""]
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

    def factor(self, squared: Float[AnyArray, "*batch"], k: Coefficients) -> Float[AnyArray, "*batch"]:
        """L."""
        return 1 / radial_factor(squared, k)

    def slope(self, squared: Float[AnyArray, "*batch"], k: Coefficients) -> Float[AnyArray, "*batch"]:
        """``(1 - k1 t - 3 k2 t^2 - ...) / (1 + k1 t + ...)^2``."""
        numerator = radial_factor(squared, (1 - 2 * _order(k.shape[0], k.dtype)) * k)
        return numerator / radial_factor(squared, k) ** 2

    def equation(self, r: Any, squared: Any, rho: Any, k: Coefficients) -> tuple[Any, Any]:
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
        self, k: Coefficients, reach: Float[Array, ""]
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

    def correct(
        self, z: Float[AnyArray, "*batch 2"], squared: Float[AnyArray, "*batch"], k: Coefficients
    ) -> Float[AnyArray, "*batch 2"]:
        """``z L(t) + t q + 2 (q.z) z``."""
        q = k[:-3:-1]
        return z * (radial_factor(squared, k[:-2]) + 2 * (z @ q))[..., None] + squared[..., None] * q

    def limit(self, k: Coefficients) -> Float[Array, ""]:
        """The first root of ``min(L, (r L)') - 6 |q| r``."""
        k = jax.lax.stop_gradient(jnp.asarray(k))
        size = k.shape[0] - 2
        rows = jnp.zeros((2, 2 * size + 1), k.dtype).at[:, 0].set(1)
        rows = rows.at[:, 2::2].set(
            np.stack([np.ones(size), 2 * _order(size) + 1]).astype(k.dtype) * k[None, :-2]
        )
        return first_positive_root(rows.at[:, 1].set(-6 * jnp.linalg.norm(k[-2:])))

    def distort(self, z: Float[Array, "2"], k: Coefficients, limit: Float[Array, ""]) -> Float[Array, "2"]:
        """By Newton's method; see `_undecentred`."""
        finite = jnp.all(jnp.isfinite(z))
        z = jnp.where(finite, z, 0)
        w = _undecentred(z, k, limit)
        return jnp.where(finite & self._arrived(w, z, k), w, jnp.nan)

    def has_inverse(
        self, z: Float[Array, "2"], k: Coefficients, limit: Float[Array, ""]
    ) -> Bool[Array, ""]:
        """Whether Newton's method finds it."""
        return jnp.all(jnp.isfinite(self.distort(z, k, limit)))

    def _arrived(self, w, z, k):
        missed = self.correct(w, w @ w, k) - z
        return missed @ missed <= (256 * jnp.finfo(z.dtype).eps) ** 2 * jnp.maximum(z @ z, w @ w)

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
        self, k: Coefficients, reach: Float[Array, ""]
    ) -> tuple[Float[AnyArray, "power"], Float[AnyArray, "tangential"]]:
        """Itself."""
        del reach
        return k[:-2], k[-2:]


def _polynomial(coefficients: Float[Array, "n"], x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Evaluate ``sum_i coefficients[i] x^i`` (Horner)."""
    value = jnp.zeros_like(x)
    for coefficient in coefficients[::-1]:
        value = value * x + coefficient
    return value


def _first_root_in_unit_interval(coefficients: Float[Array, "n"]) -> Float[Array, ""]:
    """The smallest root in (0, 1] of a polynomial that is positive at 0, or inf.

    The roots of each derivative cut the interval into pieces on which the next one is monotone, so
    that bisection in each piece finds every sign change: exact for any degree, no eigenvalues (which
    JAX has on the CPU alone), a fixed amount of work set by the degree and the dtype.
    """
    dtype = coefficients.dtype
    steps = jnp.finfo(dtype).nmant + 3
    derivatives = [coefficients]
    while derivatives[-1].shape[0] > 2:
        c = derivatives[-1]
        derivatives.append(c[1:] * jnp.arange(1, c.shape[0], dtype=dtype))
    knots = jnp.asarray([0, 1], dtype)
    found = jnp.asarray([False])
    for c in reversed(derivatives):
        values = _polynomial(c, knots)
        # A zero inside counts as negative, so that a root on a knot is not lost; one at the end does not.
        positive = (values > 0).at[-1].set(values[-1] >= 0)
        found = positive[:-1] != positive[1:]

        def halve(_, bracket, c=c, falling=positive[:-1]):
            low, high = bracket
            middle = (low + high) / 2
            before_root = (_polynomial(c, middle) > 0) == falling
            return jnp.where(before_root, middle, low), jnp.where(before_root, high, middle)

        low, high = jax.lax.fori_loop(0, steps, halve, (knots[:-1], knots[1:]))
        # Where there is no root in a piece its right end stands in: a harmless extra knot.
        roots = jnp.where(found, (low + high) / 2, knots[1:])
        knots = jnp.concatenate([knots[:1], roots, knots[-1:]])
    return jnp.min(jnp.where(found, knots[1:-1], jnp.inf))


@jax.jit
def first_positive_root(polynomials: Float[Array, "row n"]) -> Float[Array, ""]:
    """The smallest positive root of polynomials that are 1 at 0, coefficients upwards; inf without one."""
    power = jnp.arange(polynomials.shape[1], dtype=polynomials.dtype)

    def first(c):
        # Up to x = 2, and from x = 1 on as the reversed polynomial in 1/x = 1 - y, so that the search again
        # starts from its known end. They overlap, or rounding could hide a root at the seam from both.
        near, far = jax.vmap(_first_root_in_unit_interval)(jnp.stack([c * 2**power, _reflect(c[::-1])]))
        seen = far < 1 - 4096 * jnp.finfo(c.dtype).eps  # or 1/x is nothing but rounding
        far = jnp.where(seen, 1 / jnp.where(seen, 1 - far, 1), jnp.inf)
        return jnp.where(jnp.isfinite(near), 2 * near, far)

    return jnp.min(jax.vmap(first)(polynomials))


def _reflect(coefficients: Float[Array, "n"]) -> Float[Array, "n"]:
    """The coefficients of ``p(1 - y)``, from those of ``p(x)``, both in increasing order."""
    reflected = jnp.zeros_like(coefficients)
    for coefficient in coefficients[::-1]:  # Horner, multiplying by (1 - y)
        shifted = jnp.concatenate([jnp.zeros(1, coefficients.dtype), reflected[:-1]])
        reflected = (reflected - shifted).at[0].add(coefficient)
    return reflected


@jax.custom_jvp
def inverse_radius(
    family: AbstractRadial, rho: Float[Array, ""], k: Coefficients, limit: Float[Array, ""]
) -> Float[Array, ""]:
    """The r in [0, limit] with ``r L(r^2) = rho``, for one `rho` that has one.

    `limit` is that of the family at `k`, a constant for differentiation.

    Newton's method kept inside a bracket by bisection, until a step no longer changes r. Fixed
    counts of plain Newton or fixed-point steps, as elsewhere, are wrong by up to hundreds of pixels
    near a fold without a word. Outside its domain the result is an end of the bracket: callers mask.
    """
    eps = jnp.finfo(rho.dtype).eps

    def equation(r):
        return family.equation(r, r * r, rho, k)

    def too_low(high):
        return (equation(high)[0] < 0) & jnp.isfinite(high)

    start = jnp.maximum(rho, 1)
    high = jax.lax.while_loop(lambda high: jnp.isinf(limit) & too_low(high), lambda high: 2 * high, start)
    high = jnp.where(jnp.isinf(limit), high, limit)

    def unfinished(state):
        _, _, _, change, count = state
        return (change > 0) & (count < 200)

    def step(state):
        r, low, high, _, count = state
        error, slope = equation(r)
        low, high = jnp.where(error < 0, r, low), jnp.where(error < 0, high, r)
        newton = r - error / jnp.where(slope > 0, slope, 1)
        inside = (slope > 0) & (newton >= low) & (newton <= high)
        new = jnp.where(inside, newton, (low + high) / 2)
        change = jnp.where(jnp.abs(new - r) <= 2 * eps * new, 0, jnp.abs(new - r))
        return new, low, high, change, count + 1

    first = jnp.minimum(rho, high)
    state = (first, jnp.zeros_like(rho), high, jnp.ones_like(rho), 0)
    return jax.lax.while_loop(unfinished, step, state)[0]


@inverse_radius.defjvp
def _inverse_radius_jvp(primals, tangents):
    family, rho, k, limit = primals
    _, rho_dot, k_dot, _ = tangents
    r = inverse_radius(family, rho, k, limit)
    # d(r L) = 0 along the solution: slope dr + r (dL/dk) dk = d rho. At the fold itself the slope is
    # zero and the derivative truly infinite.
    _, factor_dot = jax.jvp(lambda k: family.factor(r * r, k), (k,), (k_dot,))
    return r, (rho_dot - r * factor_dot) / family.slope(r * r, k)


@jax.custom_jvp
def _undecentred(z: Float[Array, "2"], k: Coefficients, limit: Float[Array, ""]) -> Float[Array, "2"]:
    """The point w of the disc within `limit` that `BrownConrady` corrects to z, or one that misses it.

    Newton's method from the inverse without decentering, a step halved until it comes nearer, and brought
    back to the disc.
    """
    correct = BrownConrady().correct
    eps = jnp.finfo(z.dtype).eps

    def missed(w):
        return correct(w, w @ w, k) - z

    def unfinished(state):
        _, error, length, count = state
        return (error @ error > (2 * eps) ** 2 * (z @ z)) & (length > 1e-5) & (count < 200)

    def step(state):
        w, error, length, count = state
        new = w - length * _solved(jax.jacfwd(missed)(w), error)
        squared = new @ new
        out = squared > limit * limit
        new = new * jnp.where(out, limit / jnp.sqrt(jnp.where(out, squared, 1)), 1)
        new_error = missed(new)
        better = new_error @ new_error < error @ error
        return (
            jnp.where(better, new, w),
            jnp.where(better, new_error, error),
            jnp.where(better, 1, length / 2),
            count + 1,
        )

    radial = RadialPolynomial()
    squared = z @ z
    regular = squared > 0
    rho = jnp.sqrt(jnp.where(regular, squared, 1))
    start = inverse_radius(radial, jnp.minimum(rho, radial.reach(k[:-2], limit)), k[:-2], limit)
    start = z * jnp.where(regular, start / rho, 1)
    state = (start, missed(start), jnp.ones_like(rho), 0)
    return jax.lax.while_loop(unfinished, step, state)[0]


@_undecentred.defjvp
def _undecentred_jvp(primals, tangents):
    z, k, limit = primals
    z_dot, k_dot, _ = tangents
    w = _undecentred(z, k, limit)
    correct = BrownConrady().correct
    _, by_k = jax.jvp(lambda k: correct(w, w @ w, k), (k,), (k_dot,))
    return w, _solved(jax.jacfwd(lambda w: correct(w, w @ w, k))(w), z_dot - by_k)


def _solved(matrix, right):
    """The solution of two equations; zero where they have none."""
    (a, b), (c, d) = matrix
    determinant = a * d - b * c
    regular = determinant != 0
    solution = jnp.stack([d * right[0] - b * right[1], a * right[1] - c * right[0]])
    return jnp.where(regular, solution / jnp.where(regular, determinant, 1), 0)
