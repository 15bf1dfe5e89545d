"""A power law for k1 (eq. 4, [14]): the only zoom model here that is not linear in its parameters."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float, ScalarLike

from .._core.fields import check_positive, check_shapes, numbers
from .._core.types import AnyArray, Coefficients, Focal, Scalar, traced
from ._bernstein import Pieces
from ._prepared import prepared, shortest, zero_parameters
from .zoom import AbstractZoom, check_distinct, one_focal

_POWER_PIECES = 128
"""Straight lines below a power law, in log f: over a tenfold zoom, and with d2 = -2, at most 2e-4 of its
largest value too low."""


class PowerZoom(AbstractZoom):
    """A power law for each coefficient, ``k = d0 + d1 c^d2`` with ``c = f / focal_ref`` (eq. 4, [14]).

    [14] uses it for k1 alone: ``fit_zoom(lines, zoom=PowerZoom(), terms=1)``.

    Attributes:
        parameters: rows d0, d1, d2; None until fitted.
        focal_ref: the shortest focal length fitted.

    Example:
        >>> import jax.numpy as jnp
        >>> law = PowerZoom(jnp.array([[0.01], [0.1], [-2.0]]), jnp.array(20.0))
        >>> round(float(law(jnp.array(40.0))[0]), 4)
        0.035
    """

    formula: ClassVar[str] = (
        "k_i(f) = d0 + d1 (f / focal_ref)^d2 with rows d0, d1, d2 of parameters[.][i-1]"
    )
    parameters: Float[AnyArray, "3 terms"] | None = eqx.field(default=None, converter=numbers("parameters"))
    focal_ref: Scalar | None = eqx.field(default=None, converter=numbers("focal_ref"))

    def __check_init__(self):
        """Check the parameters' shape: d0, d1 and d2 of each coefficient."""
        check_shapes({"parameters": (self.parameters, (3, "terms")), "focal_ref": (self.focal_ref, ())})
        check_positive("focal_ref", self.focal_ref)

    def prepare(self, focal: Focal, terms: int) -> "PowerZoom":
        """No distortion, with an exponent to start from that lenses have."""
        if not traced(focal):
            check_distinct("A power law", focal, 3)
        focal = jnp.asarray(focal)
        start = zero_parameters(3, terms, focal.dtype).at[2].set(-2)
        return PowerZoom(parameters=start, focal_ref=shortest(focal))

    def __call__(self, focal: ScalarLike) -> Coefficients:
        """The coefficients at one focal length."""
        focal = one_focal(focal)
        constant, factor, exponent = prepared(self.parameters)
        c = jnp.broadcast_to(jnp.asarray(focal) / prepared(self.focal_ref), exponent.shape)
        return constant + factor * c**exponent

    def pieces(self, focal_range: Float[AnyArray, "2"]) -> Pieces:
        """Straight lines in log f below the coefficients: tangents where those are convex, or chords."""
        constant, factor, exponent = jnp.asarray(prepared(self.parameters))
        low, high = jnp.log(jnp.asarray(focal_range) / prepared(self.focal_ref))
        x = low + (high - low) * jnp.linspace(0, 1, _POWER_PIECES + 1, dtype=factor.dtype)
        x = jnp.stack([x[:-1], x[1:]], axis=1)[..., None]  # (piece, end, 1)
        middle = jnp.mean(x, axis=1, keepdims=True)
        exponent = exponent[None, None]
        power, centre = jnp.exp(exponent * x), jnp.exp(exponent * middle)
        tangent = centre * (1 + exponent * (x - middle))
        controls = constant[None, None] + factor[None, None] * jnp.where(factor > 0, tangent, power)
        digits = 1 + jnp.abs(exponent) * jnp.max(jnp.abs(x))  # that the exponential loses
        size = jnp.abs(constant) + jnp.abs(factor) * jnp.max(power * digits, axis=(0, 1))
        ends = x[..., 0] + jnp.log(prepared(self.focal_ref))
        return Pieces(controls, ends, jnp.exp, size, exact=False)
