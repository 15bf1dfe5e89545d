"""The radial polynomial (eq. 1-2), the default distortion model."""

from typing import Any, ClassVar

import numpy as np
from jaxtyping import Array, Float

from .._core.types import AnyArray, Elements
from .distortion_model import AbstractRadial, radial_factor, radial_orders, radial_rest, radial_slope


class RadialPolynomial(AbstractRadial):
    """The paper's radial polynomial ``L = 1 + k1 t + ... + kN t^N`` (eq. 1-2)."""

    formula: ClassVar[str] = (
        "corrected = centre + z * scale * (1 + k1 r^2 + ... + kN r^2N), "
        "z = (distorted - centre) / scale, r^2 = z.z"
    )
    more_terms: ClassVar[tuple[int, ...]] = (6, 7)  # 5 and 8 numbers are most likely OpenCV's

    def factor(self, squared: Float[AnyArray, "..."], k: Elements) -> Float[AnyArray, "..."]:
        """L."""
        return radial_factor(squared, k)

    def slope(self, squared: Float[AnyArray, "..."], k: Elements) -> Float[AnyArray, "..."]:
        """``1 + 3 k1 t + ... + (2N+1) kN t^N``."""
        return radial_slope(squared, k)

    def equation(self, r: Any, squared: Any, rho: Any, k: Elements) -> tuple[Any, Any]:
        """``r L(t) - rho``, as r - rho, which is exact near the root, and the rest."""
        return (r - rho) + r * radial_rest(squared, k), radial_slope(squared, k)

    def conditions(self, number: int) -> np.ndarray:
        """One: the slope."""
        return (2 * radial_orders(number) + 1)[None]

    def expansion_terms(self, number: int) -> int:
        """Its own."""
        return number

    def expansion(
        self, k: Elements, reach: Float[Array, ""]
    ) -> tuple[Float[AnyArray, "power"], Float[AnyArray, "tangential"]]:
        """Itself."""
        del reach
        return k, k[:0]
