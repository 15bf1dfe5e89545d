"""Polynomials in two regions of focal lengths, barrel and pincushion (eq. 5, [30])."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, ScalarLike

from .._core.checks import checked_focal, real_numbers
from .._core.fields import check_positive, check_shapes, numbers
from .._core.types import AnyArray, Focal, Scalar, of_known_values, traced
from ._bernstein import Pieces
from ._prepared import prepared, shortest, zero_parameters
from .zoom import AbstractLinearZoom, check_distinct, inverse_powers


class TwoRegionZoom(AbstractLinearZoom):
    """Two quadratics in 1/f, for barrel and for pincushion distortion (eq. 5, [30]).

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
            parameters=zero_parameters(6, terms, focal.dtype),
            focal_ref=shortest(focal),
        )

    def basis(self, focal: ScalarLike) -> Float[Array, "basis"]:
        """``(1, u, u^2)`` in the region of this focal length, zero in the other."""
        u = prepared(self.focal_ref) / jnp.asarray(focal)
        powers = jnp.stack([jnp.ones_like(u), u, u * u])
        below = jnp.asarray(focal) < prepared(self.crossover)
        return jnp.concatenate([jnp.where(below, powers, 0), jnp.where(below, 0, powers)])

    def basis_pieces(self, focal_range: Float[AnyArray, "2"]) -> Pieces:
        """The two regions, as far as the range goes into them."""
        low, high = jnp.asarray(focal_range)
        ref, crossover = prepared(self.focal_ref), prepared(self.crossover)
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
    """Find the focal length at which barrel distortion turns into pincushion, where k1 changes its sign.

    Args:
        focal: focal length of each frame.
        k1: first coefficient of the separate fit of each frame, ``fit_frames(lines).coefficients[:, 0]``.
            Frames of which it is NaN, as of those without lines, do not count.

    Returns:
        The zero of k1, interpolated linearly in 1/f; the one of shortest focal length if there are several.

    Raises:
        ValueError: k1 does not change its sign, or is not one number a frame, NaN or finite; or a focal
            length is not positive.
    """
    focals, first = checked_focal(focal), real_numbers(k1)
    if first is None or first.shape != focals.shape or np.isinf(first).any():
        raise ValueError(
            f"Argument k1 must hold one number for each of the {len(focals)} frames, finite or NaN, but it "
            f"is {k1!r}. Of a fit it is fit_frames(lines).coefficients[:, 0]."
        )
    focals, first = focals[~np.isnan(first)], first[~np.isnan(first)]
    order = np.argsort(focals, kind="stable")
    inverse, value = 1 / focals[order], first[order]
    signed = np.flatnonzero(value)  # beside zeros
    changes = np.flatnonzero(np.diff(np.sign(value[signed])))
    if not changes.size:
        raise ValueError("k1 has one sign throughout: one region is enough, PolynomialZoom(degree=2).")
    before, after = signed[changes[0]], signed[changes[0] + 1]
    if after > before + 1:
        return float(1 / inverse[before + 1])  # exactly zero there
    share = value[before] / (value[before] - value[after])
    return float(1 / (inverse[before] + share * (inverse[after] - inverse[before])))
