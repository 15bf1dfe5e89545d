"""Zoom and focus together: tensor-product splines in 1/f and the focus.

At the same focal length, distortion changes with the focus distance. The paper's [31] fits a tensor-product
spline to the coefficients of images that were calibrated one by one; here its values are the unknowns of
the global energy, like the parameters of any other linear zoom model.
"""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, ScalarLike

from .._core.checks import checked_integer
from .._core.fields import check_increasing, check_positive, check_shapes, numbers
from .._core.types import AnyArray, Focal, Focus, traced
from ._bernstein import Pieces, cut
from ._splines import check_curvature, natural_basis, natural_controls, natural_curvature, spread
from .spline import SplineZoom
from .zoom import UNFITTED, AbstractFocusZoom, one_focus

_CELLS = 8
"""Into which the certificate cuts every interval of the focus: its controls are then near to values."""


class FocusSplineZoom(AbstractFocusZoom):
    """A tensor-product spline over zoom and focus for each coefficient [31].

    Natural cubic splines in 1/f, as in `SplineZoom`, whose values at the knots are natural cubic splines in
    the focus. Beyond the ends of the focus it is constant.

    Attributes:
        number: number of knots in 1/f, spread over the fitted focal lengths.
        focus_number: number of knots in the focus, likewise; with 1 the focus has no effect.
        parameters: the values at the knots, those of all focuses at the first knot in 1/f before the next;
            None until fitted.
        knots, curvature: of the spline in 1/f, as in `SplineZoom`.
        focus_knots, focus_curvature: the same of the spline in the focus.

    References:
        [31] of the paper.

    Example:
        >>> import jax.numpy as jnp
        >>> focal, focus = jnp.array([20.0, 50.0, 20.0, 50.0]), jnp.array([0.0, 0.0, 1.0, 1.0])
        >>> zoom = FocusSplineZoom(2, 2).prepare(focal, terms=1, focus=focus)
        >>> zoom.basis(20.0, 1.0).tolist()  # at 50 mm and both focuses, then at 20 mm
        [0.0, 0.0, 0.0, 1.0]
    """

    formula: ClassVar[str] = (
        "k_i(f, d) = sum over knots z of 1/f and e of the focus d of "
        "parameters[z * focus_number + e][i-1] S_z(1/f) T_e(d), S and T the cardinal natural cubic splines"
    )
    number: int = eqx.field(static=True, default=3, converter=lambda n: checked_integer("number", n, 1))
    focus_number: int = eqx.field(
        static=True, default=3, converter=lambda n: checked_integer("focus_number", n, 1)
    )
    parameters: Float[AnyArray, "basis terms"] | None = eqx.field(
        default=None, converter=numbers("parameters")
    )
    knots: Float[AnyArray, "zooms"] | None = eqx.field(default=None, converter=numbers("knots"))
    curvature: Float[AnyArray, "zooms zooms"] | None = eqx.field(
        default=None, converter=numbers("curvature")
    )
    focus_knots: Float[AnyArray, "focuses"] | None = eqx.field(
        default=None, converter=numbers("focus_knots")
    )
    focus_curvature: Float[AnyArray, "focuses focuses"] | None = eqx.field(
        default=None, converter=numbers("focus_curvature")
    )

    def __check_init__(self):
        """Check the knots, which increase, and that the rest is for as many."""
        zooms, focuses = self.number, self.focus_number
        check_shapes(
            {
                "knots": (self.knots, (zooms,)),
                "curvature": (self.curvature, (zooms, zooms)),
                "focus_knots": (self.focus_knots, (focuses,)),
                "focus_curvature": (self.focus_curvature, (focuses, focuses)),
                "parameters": (self.parameters, (zooms * focuses, "terms")),
            }
        )
        check_positive("knots", self.knots)
        check_increasing("knots", self.knots)
        check_increasing("focus_knots", self.focus_knots)
        check_curvature("curvature", self.curvature, self.knots)
        check_curvature("focus_curvature", self.focus_curvature, self.focus_knots)

    def prepare(self, focal: Focal, terms: int, focus: Focus | None = None) -> "FocusSplineZoom":
        """A spline of zeros, its knots spread over what is there."""
        if focus is None:
            raise ValueError(_NO_FOCUS)
        if not traced(focus) and (distinct := np.unique(np.asarray(focus)).size) < self.focus_number:
            raise ValueError(
                f"A spline with {self.focus_number} knots in the focus needs as many distinct focuses, but "
                f"there are {distinct}. Choose a smaller focus_number."
            )
        in_zoom = SplineZoom(number=self.number).prepare(focal, terms)
        focus_knots = jnp.asarray(spread(focus, self.focus_number))
        assert in_zoom.parameters is not None
        return FocusSplineZoom(
            number=self.number,
            focus_number=self.focus_number,
            parameters=jnp.tile(in_zoom.parameters, (self.focus_number, 1)),
            knots=in_zoom.knots,
            curvature=in_zoom.curvature,
            focus_knots=focus_knots,
            focus_curvature=natural_curvature(focus_knots),
        )

    def basis(self, focal: ScalarLike, focus: ScalarLike | None = None) -> Float[Array, "basis"]:
        """Products of the cardinal splines in 1/f and in the focus."""
        return jnp.kron(self._in_zoom().basis(focal), self._in_focus(focus))

    def at_focus(self, focus: ScalarLike) -> SplineZoom:
        """The spline in 1/f that this one is at one focus."""
        if self.parameters is None:
            raise ValueError(UNFITTED)
        weights = self._in_focus(focus)
        table = self.parameters.reshape(-1, weights.shape[0], self.parameters.shape[1])
        return eqx.tree_at(
            lambda zoom: zoom.parameters,
            self._in_zoom(),
            jnp.einsum("zdt,d->zt", table, weights, precision="highest"),
            is_leaf=lambda leaf: leaf is None,
        )

    def basis_pieces(self, focal_range: Float[AnyArray, "2"]) -> Pieces:
        """Those of the spline in 1/f, once for each control of the spline in the focus.

        A spline in the focus lies between its controls, and so do all coefficients between those of the
        splines in 1/f that the controls make.
        """
        in_zoom = self._in_zoom().basis_pieces(focal_range)
        knots, curvature = (jnp.asarray(_prepared(a)) for a in (self.focus_knots, self.focus_curvature))
        if knots.shape[0] == 1:
            weights = jnp.ones((1, 1), knots.dtype)
        else:
            intervals = natural_controls(knots, curvature)
            cells = jnp.asarray(cut(3, _CELLS), knots.dtype)
            weights = jnp.einsum("cij,kjb->kcib", cells, intervals, precision="highest")
            weights = weights.reshape(-1, knots.shape[0])
        controls = jnp.einsum("pcz,wd->wpczd", in_zoom.controls, weights, precision="highest")
        size = jnp.kron(in_zoom.size, jnp.max(jnp.abs(weights), axis=0))
        return Pieces(
            controls.reshape(-1, controls.shape[2], size.shape[0]),
            jnp.tile(in_zoom.ends, (weights.shape[0], 1)),
            in_zoom.focal_of,
            size,
        )

    def _in_zoom(self) -> SplineZoom:
        return SplineZoom(number=self.number, knots=_prepared(self.knots), curvature=self.curvature)

    def _in_focus(self, focus: ScalarLike | None) -> Float[Array, "focuses"]:
        if one_focus(focus) is None:
            raise ValueError(_NO_FOCUS)
        knots = _prepared(self.focus_knots)
        end = jnp.clip(jnp.asarray(focus, knots.dtype), knots[0], knots[-1])
        return natural_basis(knots, _prepared(self.focus_curvature), end)


_NO_FOCUS = (
    "This zoom model depends on the focus, which is missing here: call lens(f, focus) or "
    "lens.at_focus(focus)(f); for standard deviations, use std_of(fit, lambda lens: ...) with these."
)


def _prepared(value):
    if value is None:
        raise ValueError(UNFITTED)
    return value
