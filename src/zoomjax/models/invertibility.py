"""Proof that a zoom lens is invertible: ``r L(r^2)`` increases over its whole image and focal range.

For the radial polynomial the slope of the radius is a polynomial in ``t = r^2``, with the coefficients of
the zoom model,

    g(t, f) = 1 + 3 k1(f) t + 5 k2(f) t^2 + ... + (2N+1) kN(f) t^N,

and it must be positive up to the farthest corner at every focal length of the range. Zoom models state
their coefficients as polynomials, piece by piece (`AbstractZoom.pieces`), so that g has Bernstein controls
in both variables, and lies above the least of them. In t nothing is lost for N = 1 and 2: the least value
of the parabola of each row of controls is known in closed form. Boxes whose bound is not good enough are
halved, the lowest first, which makes the bound better by a factor of four. Rounding errors are bounded by
the size of the numbers and subtracted.

Other distortion models state what must be positive likewise, linear in k
(`AbstractDistortionModel.conditions`).

Once per fit; a fit of a usual lens needs a few boxes, and 256 halvings are the most.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._core.arguments import kinds_checked
from .._core.programs import light_program
from .._core.types import AnyArray, Point, Scalar
from ._bernstein import Pieces, cut, power_controls
from .distortion_model import AbstractDistortionModel
from .lens import ZoomLens
from .polynomial import RadialPolynomial
from .zoom import AbstractZoom

_BUDGET = 256
"""Halvings. Of thousands of random models with a least slope of 1e-6, up to N = 4 and degree 5, none
needed more; usual lenses need fewer than ten."""

_TOLERANCE = 0.01
"""How far the bound may stay below the least slope found, once the question is decided."""

_ROUNDING = 16
"""Last digits, for each degree: enough for 40 halvings, one inside the other, to 1e-12 of a side."""

_SAMPLES = 65
"""Focal lengths looked at in a model that does not state its pieces."""

_CELLS = 16
"""Into which `slope_controls` cuts the radius and the focal range: then they are within some 0.01 of g."""


class Certificate(eqx.Module):
    """Whether a zoom lens is proved invertible over its image and focal range, and where it is closest to a
    fold.

    The slope is the derivative of the corrected with respect to the distorted radius: 1 without distortion,
    negative where the corrected image folds over. For `Division` it is the numerator of the slope, or the
    divisor where that is smaller; for `BrownConrady` the slope minus the largest effect of decentering.

    Attributes:
        certified: whether the slope is proved to be positive everywhere. If not, the lens folds, or is
            within rounding errors of a fold, or its zoom model does not state its `pieces`.
        least: a proved lower bound of the slope; -inf if there is no proof.
        slope: the smallest slope found. At most 0.01 above `least`, if that is finite.
        focal, radius: the focal length, and the distance from the centre in px, of that slope.
        stated: whether the zoom model states its `pieces`, so that there is a proof or a fold.
    """

    certified: Bool[Array, ""]
    least: Float[Array, ""]
    slope: Float[Array, ""]
    focal: Float[Array, ""]
    radius: Float[Array, ""]
    stated: bool = eqx.field(static=True)

    @property
    def folded(self) -> Bool[Array, ""]:
        """Whether a fold was found, or not ruled out though the zoom model states its pieces."""
        return ~self.certified & (self.stated | (self.slope <= 0))


@kinds_checked
def certify(lens: ZoomLens) -> Certificate:
    """Prove that a lens is invertible over its image, to the pixels' outer corners, and its focal range.

    The proof is rigorous and includes rounding errors. It succeeds for every lens that is invertible with a
    slope of at least 1e-6 in float64, 5e-3 in float32. (For a `PowerZoom` the slope must be above about
    1e-3 in both.)

    Example:
        >>> from zoomjax.scenes.board import nikkor_18_200
        >>> bool(certify(nikkor_18_200()).certified)
        True
    """
    return certificate_of(
        lens.zoom, lens.centre, lens.focal_range, lens.image_size, lens.shift, lens.distortion_model
    )


@light_program
def certificate_of(
    zoom: AbstractZoom,
    centre: Point,
    focal_range: Float[AnyArray, "2"],
    image_size: tuple[int, int],
    shift: AbstractZoom | None = None,
    distortion_model: AbstractDistortionModel = RadialPolynomial(),  # noqa: B008, it has no state
) -> Certificate:
    """`certify` for the parts of a lens; constant for differentiation."""
    zoom, centre, focal_range, shift = jax.lax.stop_gradient((zoom, centre, focal_range, shift))
    stated = _stated_pieces(zoom, focal_range, distortion_model)
    pieces = _sampled(zoom, focal_range) if stated is None else stated
    scale = math.hypot(*image_size) / 2
    reach = _squared_reach(centre, image_size)
    if shift is not None:
        path = shift.pieces(focal_range)
        stated = None if path is None else stated
        # As if the centre were farthest off at every focal length: a bound, and near enough.
        reach = _squared_reach(centre, image_size, scale * _farthest(path or _sampled(shift, focal_range)))
    nets = _slope_nets(pieces, reach, distortion_model)
    number = pieces.controls.shape[-1]
    largest = np.abs(distortion_model.conditions(number)).max(axis=0).astype(nets.dtype)
    size = 1 + jnp.sum(
        largest * reach ** (distortion_model.orders(number) / 2).astype(nets.dtype) * pieces.size
    )
    rounding = _ROUNDING * (nets.shape[1] + nets.shape[2]) * float(jnp.finfo(nets.dtype).eps) * size
    bound, slope, net, place = _search(nets, rounding)
    low, high = pieces.ends[net % pieces.ends.shape[0]]
    least = bound - rounding if stated is not None else jnp.full_like(bound, -jnp.inf)
    return Certificate(
        certified=least > 0,
        least=least,
        slope=slope,
        focal=pieces.focal_of(low + place[0] * (high - low)),
        radius=scale * jnp.sqrt(place[1] * reach),
        stated=stated is not None,
    )


def slope_controls(lens: ZoomLens) -> Float[Array, "control"]:
    """Numbers such that the slope is nowhere below the least of them, of a zoom model that states pieces.

    Linear, but for a constant, in the parameters of a linear zoom model. The centre must not move.
    """
    pieces = _stated_pieces(lens.zoom, lens.focal_range, lens.distortion_model)
    assert pieces is not None
    assert lens.shift is None
    nets = _slope_nets(pieces, _squared_reach(lens.centre, lens.image_size), lens.distortion_model)
    number, (_, rows, columns) = pieces.ends.shape[0], nets.shape
    along = cut(rows - 1, -(-_CELLS // number) if rows > 2 else 1)
    across = cut(columns - 1, _CELLS if columns > 2 else 1)
    return jnp.einsum(
        "aij,pjk,blk->piabl", along.astype(nets.dtype), nets, across.astype(nets.dtype), precision="highest"
    ).reshape(-1)


def _farthest(path: Pieces) -> Float[Array, "2"]:
    """How far a centre gets from where it is said to be, in x and y, rounded up."""
    rounding = _ROUNDING * path.controls.shape[1] * float(jnp.finfo(path.controls.dtype).eps)
    return jnp.max(jnp.abs(path.controls), axis=(0, 1)) + rounding * path.size


def _squared_reach(
    centre: Point, image_size: tuple[int, int], away: Float[Array, "2"] | float = 0.0
) -> Scalar:
    """The squared normalised distance of the farthest corner, pixels having an area, rounded up.

    `away` is how far, px, the centre may be off in x and y.
    """
    size, centre = np.array(image_size), jnp.asarray(centre)
    farthest = away + jnp.maximum(
        jnp.abs(centre + 0.5), jnp.abs(centre - (size - 0.5).astype(centre.dtype))
    )
    return (
        jnp.sum(farthest**2)
        * (4 / float(np.sum(size**2)))
        * (1 + 16 * float(jnp.finfo(farthest.dtype).eps))
    )


def _stated_pieces(
    zoom: AbstractZoom, focal_range: Float[AnyArray, "2"], distortion_model: AbstractDistortionModel
) -> Pieces | None:
    """`AbstractZoom.pieces`, if they are of use for this distortion model.

    Those that are below the coefficients bound only what grows with every coefficient.
    """
    pieces = zoom.pieces(focal_range)
    if pieces is None or pieces.exact:
        return pieces
    growing = bool((distortion_model.conditions(pieces.controls.shape[-1]) >= 0).all())
    return pieces if growing else None


def _slope_nets(
    pieces: Pieces, reach: Scalar, distortion_model: AbstractDistortionModel
) -> Float[Array, "net control column"]:
    """The controls of the model's conditions: of each piece, in its variable and in t from 0 to `reach`.

    One net a piece for the slope of the polynomial; all pieces, condition by condition, for others.
    """
    number = pieces.controls.shape[-1]
    orders = distortion_model.orders(number)
    powers = power_controls(jnp.zeros_like(reach), reach, int(orders.max()) // 2)
    # The radius itself, of decentering, is taken at its largest.
    powers = jnp.where((orders == 1)[None], jnp.sqrt(reach), powers[:, orders // 2])
    nets = [
        1 + jnp.einsum("pci,ti->pct", pieces.controls, powers * row[None], precision="highest")
        for row in distortion_model.conditions(number).astype(powers.dtype)
    ]
    return jnp.concatenate(nets)


def _sampled(zoom: AbstractZoom, focal_range: Float[AnyArray, "2"]) -> Pieces:
    """Some focal lengths, evenly in 1/f, as if they were all."""
    low, high = 1 / jnp.asarray(focal_range)[::-1]
    focal = 1 / (low + (high - low) * jnp.linspace(0, 1, _SAMPLES, dtype=low.dtype))
    controls = jnp.asarray(jax.vmap(zoom)(focal))[:, None]
    return Pieces(controls, jnp.stack([focal, focal], 1), jnp.asarray, jnp.max(jnp.abs(controls), (0, 1)))


class _Boxes(eqx.Module):
    """Boxes that cover all pieces, and the smallest slope found in them.

    `corner` is where a box begins in its piece, (v, s) from 0 to 1, and `extent` its sides.
    """

    nets: Float[Array, "box control column"]
    bound: Float[Array, "box"]
    piece: Any
    corner: Float[Array, "box 2"]
    extent: Float[Array, "box 2"]
    slope: Float[Array, ""]
    where: tuple[Any, Array]
    used: Any


def _search(nets, rounding):
    """Branch and bound: a lower bound of all nets, the smallest value found, in which piece, and where."""
    number = nets.shape[0]
    bound, value, place = jax.vmap(_examined)(nets)
    first = jnp.argmin(value)
    zero = jnp.where(
        nets[0, 0, 0] > 0, 0, 0
    )  # under shard_map it differs from device to device, as nets do
    boxes = _Boxes(
        nets=jnp.pad(nets, ((0, _BUDGET), (0, 0), (0, 0))),
        bound=jnp.pad(bound, (0, _BUDGET), constant_values=jnp.inf),
        piece=zero + jnp.pad(jnp.arange(number), (0, _BUDGET)),
        corner=jnp.broadcast_to(zero, (number + _BUDGET, 2)).astype(nets.dtype),
        extent=1 + jnp.broadcast_to(zero, (number + _BUDGET, 2)).astype(nets.dtype),
        slope=value[first],
        where=(first, place[first]),
        used=zero + number,
    )

    def unfinished(boxes):
        least = jnp.min(boxes.bound)
        decided = (least > rounding) | (boxes.slope <= 0)
        allowed = jnp.where(decided, _TOLERANCE * jnp.maximum(1, jnp.abs(boxes.slope)), rounding)
        return (boxes.slope - least > allowed) & (boxes.used < number + _BUDGET)

    def halve(boxes):
        box = jnp.argmin(boxes.bound)
        halves, side = _halves(boxes.nets[box])
        bound, value, place = jax.vmap(_examined)(halves)
        extent = boxes.extent[box] * jnp.where(side, 0.5, 1)
        corners = boxes.corner[box][None] + jnp.stack([0 * extent, jnp.where(side, extent, 0)])
        slots = jnp.stack([box, boxes.used])
        lower = jnp.argmin(value)
        better = value[lower] < boxes.slope
        piece = boxes.piece[box]
        here = (piece, corners[lower] + extent * place[lower])
        return _Boxes(
            nets=boxes.nets.at[slots].set(halves),
            bound=boxes.bound.at[slots].set(bound),
            piece=boxes.piece.at[slots].set(piece),
            corner=boxes.corner.at[slots].set(corners),
            extent=boxes.extent.at[slots].set(extent[None]),
            slope=jnp.minimum(value[lower], boxes.slope),
            where=jax.tree.map(lambda new, old: jnp.where(better, new, old), here, boxes.where),
            used=boxes.used + 1,
        )

    boxes = jax.lax.while_loop(unfinished, halve, boxes)
    return jnp.min(boxes.bound), boxes.slope, *boxes.where


def _examined(net):
    """A lower bound of a net's polynomial, a value that it takes, and where: (v, s), from 0 to 1."""
    bound, value, place = jax.vmap(_lowest)(net)
    ends = value[jnp.array([0, -1])]  # the other rows are no values
    end = jnp.argmin(ends)
    return jnp.min(bound), ends[end], jnp.stack([end.astype(net.dtype), place[-end]])


def _lowest(row):
    """A lower bound of the polynomial with these controls, a value that it takes, and where.

    The bound is that value, the least there is, up to degree 2.
    """
    ends = row[jnp.array([0, -1])]
    end = jnp.argmin(ends)
    value, place = ends[end], end.astype(row.dtype)
    if row.shape[0] < 3:
        return value, value, place
    if row.shape[0] > 3:
        return jnp.min(row), value, place
    fall, bend = row[0] - row[1], row[0] - 2 * row[1] + row[2]
    inside = (fall > 0) & (fall < bend)
    place = jnp.where(inside, fall / jnp.where(inside, bend, 1), place)
    value = jnp.where(inside, row[0] - fall * place, value)
    return value, value, place


def _halves(net):
    """The nets of both halves of a box, cut where it is bent more; and which side, v or s, is halved."""
    rows, columns = net.shape
    by_row, by_column = (
        jnp.einsum(subscripts, cut(size - 1, 2).astype(net.dtype), net, precision="highest")
        for subscripts, size in (("hij,jk->hik", rows), ("hij,kj->hki", columns))
    )
    if columns < 4:  # `_lowest` knows all about t
        return by_row, jnp.array([True, False])
    bent = [
        degree * jnp.max(jnp.abs(jnp.diff(net, 2, axis)), initial=0)
        for axis, degree in ((0, rows - 1), (1, columns - 1))
    ]
    side = bent[0] > bent[1]
    return jnp.where(side, by_row, by_column), jnp.stack([side, ~side])
