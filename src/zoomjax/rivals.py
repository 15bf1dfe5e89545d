"""The zoom models that the paper names as rivals of its polynomial, behind the same interface.

Look-up tables [25], splines, a power law (eq. 4, [14]) and polynomials in two regions (eq. 5, [30]). All
but the power law are linear in their parameters: they state a basis, and share the polynomial's solver.
"""

import functools
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, ScalarLike

from ._bernstein import Pieces
from ._checks import checked_integer
from ._fields import check_finite, check_increasing, check_positive, check_shapes, numbers
from ._splines import at_ends, natural_basis, natural_controls, natural_curvature, place, spread
from ._types import AnyArray, Coefficients, Focal, Scalar, of_known_values, traced
from .zoom import UNFITTED, AbstractLinearZoom, AbstractZoom, check_distinct, inverse_powers

_POWER_PIECES = 128
"""Straight lines below a power law, in log f: over a tenfold zoom, and with d2 = -2, at most 2e-4 of its
largest value too low."""


def _checked_number(number):
    return None if number is None else checked_integer("number", number, 1)


class TableZoom(AbstractLinearZoom):
    """A look-up table: coefficients stored at some focal lengths and interpolated linearly in between [25].

    Beyond its ends a table is constant.

    Attributes:
        number: of entries, spread over the focal lengths fitted; None for one at each of them, which then
            is frame by frame, interpolated.
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
    number: int | None = eqx.field(static=True, default=None, converter=_checked_number)
    inverse: bool = eqx.field(static=True, default=True)
    parameters: Float[AnyArray, "basis terms"] | None = eqx.field(
        default=None, converter=numbers("parameters")
    )
    knots: Float[AnyArray, "basis"] | None = eqx.field(default=None, converter=numbers("knots"))

    def __check_init__(self):
        """Check the entries: a row of parameters for each of the knots, which increase."""
        if not isinstance(self.inverse, bool):
            raise ValueError(f"Argument inverse must be True or False, but it is {self.inverse!r}.")
        entries = "entries" if self.number is None else self.number
        check_shapes(
            {"knots": (self.knots, (entries,)), "parameters": (self.parameters, (entries, "terms"))}
        )
        check_positive("knots", self.knots)
        check_increasing("knots", self.knots)

    def prepare(self, focal: Focal, terms: int) -> "TableZoom":
        """A table of zeros, its entries at focal lengths that are there."""
        _check_knots("A table", focal, self.number)
        knots = spread(1 / focal if self.inverse else focal, self.number)
        zeros = _zeros(knots.shape[0], terms, knots.dtype)
        return TableZoom(number=self.number, inverse=self.inverse, parameters=zeros, knots=knots)

    def basis(self, focal: ScalarLike) -> Float[Array, "basis"]:
        """Hats: 1 at one entry, falling to 0 at its neighbours."""
        knots = _prepared(self.knots)
        x = 1 / jnp.asarray(focal) if self.inverse else jnp.asarray(focal)
        index, share, _ = place(knots, jnp.clip(x, knots[0], knots[-1]))
        return at_ends(knots, index, 1 - share, share)

    def basis_pieces(self, focal_range: Float[AnyArray, "2"]) -> Pieces:
        """The intervals between entries, in which it is linear: all of them, whatever the range."""
        del focal_range  # beyond its ends it is what it is there
        knots = jnp.asarray(_prepared(self.knots))
        one = jnp.eye(knots.shape[0], dtype=knots.dtype)
        first, last = (one[:-1], one[1:]) if knots.shape[0] > 1 else (one, one)
        ends = jnp.stack([knots[:-1], knots[1:]], 1) if knots.shape[0] > 1 else jnp.stack([knots, knots], 1)
        focal_of = jnp.reciprocal if self.inverse else jnp.asarray
        return Pieces(jnp.stack([first, last], axis=1), ends, focal_of, jnp.ones_like(knots))


class SplineZoom(AbstractLinearZoom):
    """A natural cubic spline in 1/f for each coefficient, through values at its knots.

    Beyond its ends it continues along a straight line in 1/f.

    Attributes:
        number: of knots, spread over the focal lengths fitted; None for one at each of them.
        parameters: the values at the knots; None until fitted.
        knots: 1/f of the knots, increasing.
        curvature: from the values at the knots to the spline's second derivatives there.
    """

    formula: ClassVar[str] = (
        "k_i(f): the natural cubic spline in 1/f through parameters[.][i-1] at the knots"
    )
    number: int | None = eqx.field(static=True, default=None, converter=_checked_number)
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
        check_finite("curvature", self.curvature)

    def prepare(self, focal: Focal, terms: int) -> "SplineZoom":
        """A spline of zeros, its knots at focal lengths that are there."""
        _check_knots("A spline", focal, self.number)
        knots = spread(1 / focal, self.number)
        zeros = _zeros(knots.shape[0], terms, knots.dtype)
        curvature = natural_curvature(knots)
        return SplineZoom(number=self.number, parameters=zeros, knots=knots, curvature=curvature)

    def basis(self, focal: ScalarLike) -> Float[Array, "basis"]:
        """The cardinal splines: 1 at one knot, 0 at the others."""
        knots = _prepared(self.knots)
        x = 1 / jnp.asarray(focal)
        end = jnp.clip(x, knots[0], knots[-1])
        within = functools.partial(natural_basis, knots, _prepared(self.curvature))
        value, slope = jax.jvp(within, (end,), (jnp.ones_like(end),))
        return value + (x - end) * slope

    def basis_pieces(self, focal_range: Float[AnyArray, "2"]) -> Pieces:
        """Cubics between all neighbouring knots, and what of the range lies before and after them."""
        knots, curvature = (jnp.asarray(_prepared(a)) for a in (self.knots, self.curvature))
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
        start = _zeros(3, terms, focal.dtype).at[2].set(-2)
        return PowerZoom(parameters=start, focal_ref=jnp.min(focal))

    def __call__(self, focal: ScalarLike) -> Coefficients:
        """The coefficients at one focal length."""
        constant, factor, exponent = _prepared(self.parameters)
        c = jnp.broadcast_to(jnp.asarray(focal) / _prepared(self.focal_ref), exponent.shape)
        return constant + factor * c**exponent

    def pieces(self, focal_range: Float[AnyArray, "2"]) -> Pieces:
        """Straight lines in log f below the coefficients: tangents where those are convex, or chords."""
        constant, factor, exponent = jnp.asarray(_prepared(self.parameters))
        low, high = jnp.log(jnp.asarray(focal_range) / _prepared(self.focal_ref))
        x = low + (high - low) * jnp.linspace(0, 1, _POWER_PIECES + 1, dtype=factor.dtype)
        x = jnp.stack([x[:-1], x[1:]], axis=1)[..., None]  # (piece, end, 1)
        middle = jnp.mean(x, axis=1, keepdims=True)
        exponent = exponent[None, None]
        power, centre = jnp.exp(exponent * x), jnp.exp(exponent * middle)
        tangent = centre * (1 + exponent * (x - middle))
        controls = constant[None, None] + factor[None, None] * jnp.where(factor > 0, tangent, power)
        digits = 1 + jnp.abs(exponent) * jnp.max(jnp.abs(x))  # that the exponential loses
        size = jnp.abs(constant) + jnp.abs(factor) * jnp.max(power * digits, axis=(0, 1))
        ends = x[..., 0] + jnp.log(_prepared(self.focal_ref))
        return Pieces(controls, ends, jnp.exp, size, exact=False)


class TwoRegionZoom(AbstractLinearZoom):
    """Quadratics in 1/f, one where the lens is barrel and one where it is pincushion (eq. 5, [30]).

    The transcript's exponent -2 in eq. 5 is evidently a misprint for 2. [30] has k1 alone: ``terms=1``.
    The two need not meet: as published, the coefficients jump where the regions do.

    Attributes:
        crossover: the focal length that separates the regions; see `barrel_crossover`.
        parameters: rows c0, c1, c2 (of ``u^j``, ``u = focal_ref / f``) below the crossover, then above it.
        focal_ref: the shortest focal length fitted.

    Example:
        >>> import jax.numpy as jnp
        >>> parameters = jnp.array([[0.1], [0.0], [0.0], [-0.2], [0.0], [0.0]])
        >>> zoom = TwoRegionZoom(jnp.array(35.0), parameters, jnp.array(20.0))
        >>> float(zoom(jnp.array(24.0))[0]) > 0 > float(zoom(jnp.array(50.0))[0])
        True
    """

    formula: ClassVar[str] = (
        "k_i(f) = sum_j c_j (focal_ref / f)^j with c = parameters[0..2][i-1] for f < crossover, "
        "parameters[3..5][i-1] from there on"
    )
    crossover: Scalar | None = eqx.field(default=None, converter=numbers("crossover"))
    parameters: Float[AnyArray, "6 terms"] | None = eqx.field(default=None, converter=numbers("parameters"))
    focal_ref: Scalar | None = eqx.field(default=None, converter=numbers("focal_ref"))

    def __check_init__(self):
        """Check the parameters' shape: three rows for each region."""
        check_shapes(
            {
                "parameters": (self.parameters, (6, "terms")),
                "focal_ref": (self.focal_ref, ()),
                "crossover": (self.crossover, ()),
            }
        )
        check_positive("focal_ref", self.focal_ref)
        check_positive("crossover", self.crossover)

    def prepare(self, focal: Focal, terms: int) -> "TwoRegionZoom":
        """Zero polynomials in both regions."""
        if self.crossover is None:
            raise ValueError(
                "A TwoRegionZoom needs the focal length that separates its regions: with each = "
                "fit_frames(lines), TwoRegionZoom(barrel_crossover(lines.focal, each.coefficients[:, 0]))."
            )
        focal = jnp.asarray(focal)
        if not traced((focal, self.crossover)):
            below = np.asarray(focal < self.crossover)
            for side in (below, ~below):
                check_distinct("Each region of a TwoRegionZoom", np.asarray(focal)[side], 3)
        return TwoRegionZoom(
            crossover=self.crossover.astype(focal.dtype),
            parameters=_zeros(6, terms, focal.dtype),
            focal_ref=jnp.min(focal),
        )

    def basis(self, focal: ScalarLike) -> Float[Array, "basis"]:
        """``(1, u, u^2)`` in the region of this focal length, zero in the other."""
        u = _prepared(self.focal_ref) / jnp.asarray(focal)
        powers = jnp.stack([jnp.ones_like(u), u, u * u])
        below = jnp.asarray(focal) < _prepared(self.crossover)
        return jnp.concatenate([jnp.where(below, powers, 0), jnp.where(below, 0, powers)])

    def basis_pieces(self, focal_range: Float[AnyArray, "2"]) -> Pieces:
        """The two regions, as far as the range goes into them."""
        low, high = jnp.asarray(focal_range)
        ref, crossover = _prepared(self.focal_ref), _prepared(self.crossover)
        below = inverse_powers(ref, jnp.stack([low, jnp.clip(crossover, low, high)]), 2)
        above = inverse_powers(ref, jnp.stack([jnp.clip(crossover, low, high), high]), 2)
        first = jnp.where(low < crossover, below.controls, 0)
        second = jnp.where(high >= crossover, above.controls, 0)
        controls = jnp.concatenate(
            [jnp.pad(first, ((0, 0), (0, 0), (0, 3))), jnp.pad(second, ((0, 0), (0, 0), (3, 0)))]
        )
        size = jnp.concatenate([below.size, above.size])
        return Pieces(controls, jnp.concatenate([below.ends, above.ends]), jnp.reciprocal, size)


@of_known_values
def barrel_crossover(focal: Focal, k1: Float[AnyArray, "frame"]) -> float:
    """The focal length at which k1 changes its sign: where barrel distortion turns into pincushion.

    Args:
        focal: focal length of each frame.
        k1: first coefficient of each frame by itself, ``fit_frames(lines).coefficients[:, 0]``.

    Returns:
        The zero of k1, interpolated linearly in 1/f; that of the shortest focal length if there are more.

    Raises:
        ValueError: k1 has one sign throughout.
    """
    order = np.argsort(1 / np.asarray(focal))[::-1]
    inverse, value = 1 / np.asarray(focal)[order], np.asarray(k1)[order]
    changes = np.flatnonzero(value[:-1] * value[1:] < 0)
    if not changes.size:
        raise ValueError("k1 has one sign throughout: one region is enough, PolynomialZoom(degree=2).")
    i = changes[0]
    share = value[i] / (value[i] - value[i + 1])
    return float(1 / (inverse[i] + share * (inverse[i + 1] - inverse[i])))


def _check_knots(what: str, focal: Focal, number: int | None) -> None:
    if not traced(focal):
        check_distinct(what, focal, number or 1)


def _zeros(rows: int, terms: int, dtype: np.dtype) -> Float[Array, "rows terms"]:
    return jnp.asarray(np.zeros((rows, terms), dtype))


def _prepared(value):
    if value is None:
        raise ValueError(UNFITTED)
    return value
