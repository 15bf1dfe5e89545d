"""The Brown-Conrady model: the radial polynomial with decentering, which is not radial."""

from typing import ClassVar

import numpy as np
from jaxtyping import Array, Float

from .._core.arrays import apart, namespace
from .._core.types import AnyArray, Elements
from ._roots import until
from .distortion_model import AbstractDistortionModel, Pair, first_root, radial_factor, radial_orders, times
from .polynomial import RadialPolynomial

_DIRECTIONS = 8
"""Half-planes that stand in for the length of (p1, p2): up to 8 % longer, and linear."""


class BrownConrady(AbstractDistortionModel):
    """Brown-Conrady: radial polynomial of N terms with decentering, coefficients ``(k1, ..., kN, p1, p2)``.

    With ``z = (x, y)`` and ``q = (p2, p1)`` the corrected point is ``z L(t) + t q + 2 (q.z) z``, that is

        x L(t) + 2 p1 x y + p2 (t + 2 x^2),    y L(t) + p1 (t + 2 y^2) + 2 p2 x y,

    with OpenCV's order of p1 and p2, but from distorted to corrected points.

    *It is invertible* on the disc of radius R, the `monotone_radius`, if ``min(L, (r L)') - 6 |q| r > 0``
    for r < R. For the Jacobian is symmetric: that of z L has the eigenvalues L (across) and (r L)' (along
    z), that of the rest, ``2 q z^T + 2 z q^T + 2 (q.z) I``, has ``4 q.z ± 2 |q| r``, none below ``-6 |q|
    r``. So it is positive definite, and ``(F(a) - F(b)).(a - b)``, the integral of the Jacobian's form over
    the segment between two points of the disc, is positive: F is injective. (A little beyond it may still
    be.)

    If, for the certificate, ``(r L)' > 6 |q| R`` up to R, then also ``L = 1/r int (r L)' > 6 |q| R``.
    """

    formula: ClassVar[str] = (
        "corrected = centre + scale * (z (1 + k1 r^2 + ... + kN r^2N) + r^2 q + 2 (q.z) z), "
        "z = (distorted - centre) / scale, r^2 = z.z, q = (p2, p1), coefficients (k1, ..., kN, p1, p2)"
    )

    def num_coefficients(self, terms: int) -> int:
        """Two more."""
        return terms + 2

    def orders(self, number: int) -> np.ndarray:
        """2, 4, ..., 2N, 1, 1."""
        return np.append(2 * radial_orders(number - 2), [1, 1])

    def correct(self, z: Pair, squared: Float[AnyArray, "..."], k: Elements) -> Pair:
        """``z L(t) + t q + 2 (q.z) z``."""
        *radial, qy, qx = apart(k)
        x, y = z
        factor = radial_factor(squared, radial) + 2 * (qx * x + qy * y)
        return x * factor + squared * qx, y * factor + squared * qy

    def monotone_radius(self, k: Elements) -> Float[AnyArray, "..."]:
        """The first root of ``min(L, (r L)') - 6 |q| r``."""
        xp, terms = namespace(k), len(k) - 2
        across = -6 * xp.sqrt(k[-1:] ** 2 + k[-2:-1] ** 2)
        powers = [across]  # of r, from the first on
        for index in range(terms):
            powers += [k[index : index + 1], 0 * across]
        rows = np.ones((2, 2 * terms + 1), int)
        rows[1, 1::2] = 2 * radial_orders(terms) + 1
        return first_root(rows, xp.concatenate(powers))

    def distort(self, z: Pair, k: Elements, monotone_radius: Float[AnyArray, "..."]) -> Pair:
        """By Newton's method from the inverse without decentering; see `_solve`."""
        xp = namespace(*z, k)
        finite = xp.isfinite(z[0]) & xp.isfinite(z[1])
        x, y, found = self._solve(xp.where(finite, z[0], 0), xp.where(finite, z[1], 0), k, monotone_radius)
        found = finite & found
        return xp.where(found, x, np.nan), xp.where(found, y, np.nan)

    def _solve(self, zx, zy, k, monotone_radius):
        """The point of the disc that is corrected to (zx, zy), and whether it was found.

        A step of Newton's method is halved until it comes nearer, and brought back to the disc.
        """
        xp, eps = namespace(zx, k), np.finfo(zx.dtype).eps
        qx, qy = k[-1], k[-2]
        slopes = times(2 * radial_orders(len(k) - 2), k[:-2])
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
            out = squared > monotone_radius * monotone_radius
            back = xp.where(out, monotone_radius / xp.sqrt(xp.where(out, squared, 1)), 1)
            new_x, new_y = new_x * back, new_y * back
            new = missed(new_x, new_y)
            better = new[2] < error
            kept = [
                xp.where(better, one, other)
                for one, other in zip((new_x, new_y, *new), (x, y, *state[3:]), strict=True)
            ]
            return kept[0], kept[1], xp.where(better, 1, length / 2), *kept[2:]

        radial = RadialPolynomial()
        reach = radial.reach(k[:-2], monotone_radius)
        shrunk = xp.where(size > reach * reach, reach * reach, size)
        q, _ = radial.ratio(shrunk, k[:-2], monotone_radius)
        q = q * xp.sqrt(shrunk / xp.where(size > 0, size, 1))
        q = xp.where(size > 0, q, 1)
        x, y = zx * q, zy * q
        state = (x, y, 0 * x + 1, *missed(x, y))
        x, y, _, _, _, error, *_ = until(xp, unfinished, step, state, 200)
        return x, y, error <= (64 * eps) ** 2 * xp.maximum(size, x * x + y * y)

    def conditions(self, number: int) -> np.ndarray:
        """The slope of the radius less ``6 q.d r``, for directions d of which one is nearly q's."""
        angle = 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
        across = -6 / np.cos(np.pi / _DIRECTIONS) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        slope = np.broadcast_to(2 * radial_orders(number - 2) + 1.0, (_DIRECTIONS, number - 2))
        return np.concatenate([slope, across], axis=1)

    def expansion_terms(self, number: int) -> int:
        """The radial ones."""
        return number - 2

    def expansion(
        self, k: Elements, reach: Float[Array, ""]
    ) -> tuple[Float[AnyArray, "power"], Float[AnyArray, "tangential"]]:
        """Itself."""
        del reach
        return k[:-2], k[-2:]
