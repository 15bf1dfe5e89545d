"""Look-up tables: coefficients stored at some focal lengths [25], behind the zoom models' interface."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, ScalarLike

from .._core.arguments import check_flag
from .._core.fields import check_increasing, check_positive, check_shapes, numbers
from .._core.types import AnyArray, Focal
from ._bernstein import Pieces
from ._prepared import check_knots, checked_number, prepared, zero_parameters
from ._splines import at_ends, place, spread
from .zoom import AbstractLinearZoom


class TableZoom(AbstractLinearZoom):
    """A look-up table: coefficients stored at some focal lengths and interpolated linearly in between [25].

    Beyond its ends a table is constant.

    Attributes:
        number: number of entries, spread over the fitted focal lengths; None for one at each of them, which
            interpolates between the separate fits of the frames.
        inverse: whether to interpolate in 1/f, or in f.
        parameters: the entries; None until fitted.
        knots: 1/f, or f, of the entries, increasing.

    References:
        [25] of the paper.

    Example:
        >>> import jax.numpy as jnp
        >>> table = TableZoom(parameters=jnp.array([[0.1], [0.2]]), knots=jnp.array([1 / 50, 1 / 25]))
        >>> round(float(table(jnp.array(40.0))[0]), 4)
        0.125
    """

    formula: ClassVar[str] = (
        "k_i(f): parameters[.][i-1] at the knots, 1/f (or f, if not inverse), linear in between"
    )
    number: int | None = eqx.field(static=True, default=None, converter=checked_number)
    inverse: bool = eqx.field(static=True, default=True)
    parameters: Float[AnyArray, "basis terms"] | None = eqx.field(
        default=None, converter=numbers("parameters")
    )
    knots: Float[AnyArray, "basis"] | None = eqx.field(default=None, converter=numbers("knots"))

    def __check_init__(self):
        """Check the entries: a row of parameters for each of the knots, which increase."""
        check_flag("inverse", self.inverse)
        entries = "entries" if self.number is None else self.number
        check_shapes(
            {"knots": (self.knots, (entries,)), "parameters": (self.parameters, (entries, "terms"))}
        )
        check_positive("knots", self.knots)
        check_increasing("knots", self.knots)

    def prepare(self, focal: Focal, terms: int) -> "TableZoom":
        """A table of zeros, its entries at focal lengths that are there."""
        check_knots("A table", focal, self.number)
        knots = spread(focal, self.number, inverse=self.inverse)
        zeros = zero_parameters(knots.shape[0], terms, knots.dtype)
        return TableZoom(number=self.number, inverse=self.inverse, parameters=zeros, knots=knots)

    def basis(self, focal: ScalarLike) -> Float[Array, "basis"]:
        """Hats: 1 at one entry, falling to 0 at its neighbours."""
        knots = prepared(self.knots)
        x = 1 / jnp.asarray(focal) if self.inverse else jnp.asarray(focal)
        index, share, _ = place(knots, jnp.clip(x, knots[0], knots[-1]))
        return at_ends(knots, index, 1 - share, share)

    def basis_pieces(self, focal_range: Float[AnyArray, "2"]) -> Pieces:
        """The intervals between entries, in which it is linear: all of them, whatever the range."""
        del focal_range  # beyond its ends it is what it is there
        knots = jnp.asarray(prepared(self.knots))
        one = jnp.eye(knots.shape[0], dtype=knots.dtype)
        first, last = (one[:-1], one[1:]) if knots.shape[0] > 1 else (one, one)
        ends = jnp.stack([knots[:-1], knots[1:]], 1) if knots.shape[0] > 1 else jnp.stack([knots, knots], 1)
        focal_of = jnp.reciprocal if self.inverse else jnp.asarray
        return Pieces(jnp.stack([first, last], axis=1), ends, focal_of, jnp.ones_like(knots))
