"""The division model, which describes strong barrel distortion with few terms."""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._core.arrays import namespace
from .._core.types import AnyArray, Elements
from .distortion_model import AbstractRadial, Pair, radial_factor, radial_orders, radial_rest, times


class Division(AbstractRadial):
    """Fitzgibbon's division model ``L = 1 / (1 + k1 t + ... + kN t^N)``: few terms for strong barrel
    distortion.

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
        """L; NaN next to a pole, where half of the divisor's digits, or more, are rounding.

        Compilers may compute it once for each coordinate, with different errors: the corrected point would
        not even lie in its direction.
        """
        xp, divisor = namespace(squared, k), radial_factor(squared, k)
        known = abs(divisor) > np.sqrt(np.finfo(divisor.dtype).eps)
        return xp.where(known, 1 / xp.where(known, divisor, 1), np.nan)

    def before_pole(self, z: Pair, k: Elements) -> tuple[Pair, Bool[AnyArray, "..."]]:
        """A point nearer to the centre by some roots of eps, where L is NaN."""
        xp, eps = namespace(*z, k), np.finfo(z[0].dtype).eps
        next_to = xp.isnan(self.factor(z[0] * z[0] + z[1] * z[1], k))
        nearer = xp.where(next_to, 1 - 4 * np.sqrt(eps), 1).astype(z[0].dtype)
        return (z[0] * nearer, z[1] * nearer), next_to

    def slope(self, squared: Float[AnyArray, "..."], k: Elements) -> Float[AnyArray, "..."]:
        """``(1 - k1 t - 3 k2 t^2 - ...) / (1 + k1 t + ...)^2``."""
        numerator = radial_factor(squared, times(1 - 2 * radial_orders(len(k)), k))
        return numerator / radial_factor(squared, k) ** 2

    def equation(self, r: Any, squared: Any, rho: Any, k: Elements) -> tuple[Any, Any]:
        """``r - rho (1 + k1 t + ...)``, without a pole; as r - rho, exact near the root, and the rest."""
        rest = radial_rest(squared, k)
        growth = radial_rest(squared, times(2 * radial_orders(len(k)) + 1, k)) - rest  # by r, times r
        return (r - rho) - rho * rest, 1 - rho / (r + (r == 0)) * growth

    def conditions(self, number: int) -> np.ndarray:
        """The numerator of the slope, and the divisor."""
        return np.stack([1 - 2 * radial_orders(number), np.ones(number, int)])

    def expansion_terms(self, number: int) -> int:
        """8, or its own number if that is more.

        The error of L up to the corner is that of rounding for weak distortion, and grows towards the pole.
        """
        return max(8, number)

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
