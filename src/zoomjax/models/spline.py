"""Natural cubic splines in 1/f, or f, through coefficients at some knots."""

import functools
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, ScalarLike

from .._core.fields import check_increasing, check_positive, check_shapes, numbers
from .._core.types import AnyArray, Focal
from ._bernstein import Pieces
from ._prepared import check_knots, checked_number, prepared, zero_parameters
from ._splines import check_curvature, natural_basis, natural_controls, natural_curvature, spread
from .zoom import AbstractLinearZoom


class SplineZoom(AbstractLinearZoom):
    """A natural cubic spline in 1/f for each coefficient, through values at its knots.

    Beyond its ends it continues along a straight line in 1/f.

    Attributes:
        number: number of knots, spread over the fitted focal lengths; None for one at each of them.
        parameters: the values at the knots; None until fitted.
        knots: 1/f of the knots, increasing.
        curvature: from the values at the knots to the spline's second derivatives there.
    """

    formula: ClassVar[str] = (
        "k_i(f): the natural cubic spline in 1/f through parameters[.][i-1] at the knots"
    )
    number: int | None = eqx.field(static=True, default=None, converter=checked_number)
    parameters: Float[AnyArray, "basis terms"] | None = eqx.field(
        default=None, converter=numbers("parameters")
    )
    knots: Float[AnyArray, "basis"] | None = eqx.field(default=None, converter=numbers("knots"))
    curvature: Float[AnyArray, "basis basis"] | None = eqx.field(
        default=None, converter=numbers("curvature")
    )

    def __check_init__(self):
        """Check the knots, which increase, and that the rest is for as many."""
        size = "knots" if self.number is None else self.number
        check_shapes(
            {
                "knots": (self.knots, (size,)),
                "curvature": (self.curvature, (size, size)),
                "parameters": (self.parameters, (size, "terms")),
            }
        )
        check_positive("knots", self.knots)
        check_increasing("knots", self.knots)
        check_curvature("curvature", self.curvature, self.knots)

    def prepare(self, focal: Focal, terms: int) -> "SplineZoom":
        """A spline of zeros, its knots at focal lengths that are there."""
        check_knots("A spline", focal, self.number)
        knots = spread(focal, self.number, inverse=True)
        zeros = zero_parameters(knots.shape[0], terms, knots.dtype)
        curvature = natural_curvature(knots)
        return SplineZoom(number=self.number, parameters=zeros, knots=knots, curvature=curvature)

    def basis(self, focal: ScalarLike) -> Float[Array, "basis"]:
        """The cardinal splines: 1 at one knot, 0 at the others."""
        knots = prepared(self.knots)
        x = 1 / jnp.asarray(focal)
        end = jnp.clip(x, knots[0], knots[-1])
        within = functools.partial(natural_basis, knots, prepared(self.curvature))
        value, slope = jax.jvp(within, (end,), (jnp.ones_like(end),))
        return value + (x - end) * slope

    def basis_pieces(self, focal_range: Float[AnyArray, "2"]) -> Pieces:
        """Cubics between all neighbouring knots, and what of the range lies before and after them."""
        knots, curvature = (jnp.asarray(prepared(a)) for a in (self.knots, self.curvature))
        within = natural_controls(knots, curvature)
        ends = jnp.stack([knots[:-1], knots[1:]], axis=1)
        # What follows on either side is straight; nothing where the range ends at the last knot.
        low, high = 1 / jnp.asarray(focal_range)[::-1]
        beyond = jnp.asarray(
            [[jnp.minimum(low, knots[0]), knots[0]], [knots[-1], jnp.maximum(high, knots[-1])]]
        )
        values = jax.vmap(jax.vmap(lambda x: self.basis(1 / x)))(beyond)
        share = jnp.asarray([0, 1 / 3, 2 / 3, 1], knots.dtype)[None, :, None]
        outside = (1 - share) * values[:, :1] + share * values[:, 1:]
        controls = jnp.concatenate([within, outside])
        size = jnp.max(jnp.abs(controls), axis=(0, 1))
        return Pieces(controls, jnp.concatenate([ends, beyond]), jnp.reciprocal, size)
