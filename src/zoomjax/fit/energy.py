"""The energies of the paper: how far corrected points are from straight lines (eq. 3 and 13).

The parameters of the lines are eliminated (variable projection): given the coefficients, the best line
passes through the mean of the corrected points, with the normal of least variance, and the residual of a
point is its signed distance ``n . (x - mean)``. Residuals are differentiated through ``n``.

Weights are the paper's: a point counts ``1 / (M Nl(m) Np(l, m))``, so that every frame weighs the same,
and within it every line. The M frames are those that have a line of a weight above 0.
"""

import abc
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from .._core.arguments import kinds_checked
from .._core.fields import real_argument
from .._core.products import EXACT
from .._core.programs import light_program
from .._core.types import AnyArray
from ..lines.base import AbstractLines, check_rows
from ..lines.best_line import line_residuals
from ..lines.buckets import bucketed_jit, of_frames, of_lines
from ..lines.reduction import triangle
from ..models.zoom import (
    AbstractFocusZoom,
    AbstractPriorZoom,
    AbstractZoom,
    with_parameters,
)
from .problem import about_own_centre


def line_weights(lines: AbstractLines) -> Float[Array, "line"]:
    """``1 / (M Nl(m) Np(l, m))`` of eq. 13 for the points of each line, of the M frames that count.

    With weights v of the lines themselves ``v_l / (M Np(l, m) sum_l v_l)``, summed over the frame's lines.
    0 for lines that are not there. One or two points count as none: they are straight whatever the lens,
    and would only dilute their frame's mean. (`Lines` drops them; merged chunks may come with them.) A
    frame of which no line counts would dilute the mean over frames likewise: see `counted_frames`.
    """
    share, per_frame = _shares(lines)
    number = number_counted(per_frame > 0).astype(share.dtype)
    per_frame = jnp.where(per_frame > 0, per_frame, 1)
    return share / (number * per_frame[lines.frame] * jnp.maximum(lines.counts, 1))


def counted_frames(lines: AbstractLines) -> Bool[Array, "frame"]:
    """Which frames have a usable line: three points or more and a weight above 0."""
    return _shares(lines)[1] > 0


def number_counted(counted: Bool[Array, "frame"]) -> Int[Array, ""]:
    """M of eq. 13: the number of frames that count, but 1 if none does."""
    return jnp.maximum(jnp.sum(counted), 1)


def _shares(lines: AbstractLines) -> tuple[Float[Array, "line"], Float[Array, "frame"]]:
    """What each line counts beside the others of its frame, and the frames' sums."""
    counts = lines.counts
    share = (counts > 2).astype(counts.dtype)
    if lines.weight is not None:
        share = share * lines.weight
        largest = jnp.max(share)  # so that sums of large weights do not overflow
        share = share / jnp.where(largest > 0, largest, 1)
    return share, jax.ops.segment_sum(share, lines.frame, lines.focal.shape[0])


@kinds_checked
def residuals(lines: AbstractLines, coefficients: Float[Array, "frame terms"]) -> Float[Array, "line rows"]:
    """Weighted residuals, px, whose sum of squares is the global energy of eq. 13.

    Args:
        lines: the lines, or their compressed form.
        coefficients: normalised (k1, ..., kN) of each frame.
    """
    k = jnp.asarray(real_argument("coefficients", coefficients))
    return weighted_distances(about_own_centre(lines), k)


def weighted_distances(
    lines: AbstractLines, coefficients: Float[Array, "frame terms"]
) -> Float[Array, "line rows"]:
    """The same; of lines for any centre by coefficients that end with the centre's offset."""
    check_rows(coefficients, lines.focal)
    weights = line_weights(lines)
    counted = weights > 0  # the root has no derivative at 0
    roots = jnp.where(counted, jnp.sqrt(jnp.where(counted, weights, 1)), 0)
    return roots[:, None] * line_distances(lines, coefficients)


def line_distances(
    lines: AbstractLines, coefficients: Float[Array, "frame terms"]
) -> Float[Array, "line rows"]:
    """The same without the weights, px."""
    return jax.vmap(line_residuals)(lines.corrected(coefficients))


def settings(zoom: AbstractZoom, lines: AbstractLines) -> tuple[Float[AnyArray, "frame"], ...]:
    """The inputs of a zoom model for each frame: the focal length, and the focus if the model depends on
    it.

    Raises:
        ValueError: the model needs the focus, and the lines do not have it.
    """
    if not isinstance(zoom, AbstractFocusZoom):
        return (lines.focal,)
    if lines.focus is None:
        raise ValueError(
            f"A {type(zoom).__name__} needs the focus of each frame: Lines.from_ragged(..., focus=...), or "
            "choose a model of the focal length alone."
        )
    return lines.focal, lines.focus


def coefficients_by(zoom: AbstractZoom, lines: AbstractLines) -> Float[Array, "frame terms"]:
    """The coefficients of each frame, by a zoom model."""
    return jnp.asarray(jax.vmap(zoom)(*settings(zoom, lines)))


@bucketed_jit(returns=of_frames)
def frame_coefficients(lines: AbstractLines, zoom: AbstractZoom) -> Float[Array, "frame terms"]:
    """The same, compiled."""
    return coefficients_by(zoom, lines)


def prior_residuals(lines: AbstractLines, zoom: AbstractZoom) -> Float[Array, "row"] | None:
    """Residuals of the prior of a zoom model, px; None for a model without a prior."""
    prior = prior_of(zoom)
    return None if prior is None else prior_error(lines, prior) * prior.standardised()


def prior_of(zoom: AbstractZoom) -> AbstractPriorZoom | None:
    """The model with a prior that this one is, or that it is made of (`AbstractJointZoom`)."""
    zoom = zoom.first() if isinstance(zoom, AbstractJointZoom) else zoom
    return zoom if isinstance(zoom, AbstractPriorZoom) else None


class AbstractJointZoom(AbstractZoom):
    """A zoom model together with another model, fitted at once."""

    @abc.abstractmethod
    def first(self) -> AbstractZoom:
        """The zoom model, with its present parameters."""


def prior_error(lines: AbstractLines, zoom: AbstractPriorZoom) -> Float[Array, ""]:
    """The size, px, that a standardised parameter has among the residuals of eq. 13."""
    error = jnp.asarray(zoom.error)
    return lines.scale * error / jnp.sqrt(number_counted(counted_frames(lines)).astype(error.dtype))


size_of_prior = bucketed_jit()(prior_error)


def prior_jacobian(lines: AbstractLines, zoom: AbstractZoom) -> Float[Array, "row parameter"]:
    """Derivatives of `prior_residuals` by the flattened parameters; no rows for a model without a prior."""
    flat, unravel = ravel_pytree(zoom.parameters)
    if prior_of(zoom) is None:
        return jnp.zeros((0, flat.size), flat.dtype)
    return jax.jacfwd(lambda flat: prior_residuals(lines, with_parameters(zoom, unravel(flat))))(flat)


@kinds_checked
def frame_energy(lines: AbstractLines, coefficients: Float[Array, "frame terms"]) -> Float[Array, "frame"]:
    """The error of each frame, px^2: mean over its lines of the mean squared distance (eq. 3).

    NaN for a frame of which no line counts: its error is not known.
    """
    return _frame_energy(lines, jnp.asarray(real_argument("coefficients", coefficients)))


@bucketed_jit(frames=["coefficients"], returns=of_frames)
def _frame_energy(lines, coefficients):
    return energy_by_frame(lines, residuals(lines, coefficients))


def energy_by_frame(lines: AbstractLines, weighted: Float[Array, "line rows"]) -> Float[Array, "frame"]:
    """The error of each frame, px^2, from the weighted residuals; NaN for frames that do not count."""
    counted = counted_frames(lines)
    squares = jax.ops.segment_sum(jnp.sum(weighted**2, axis=1), lines.frame, counted.shape[0])
    return jnp.where(counted, number_counted(counted).astype(squares.dtype) * squares, jnp.nan)


@bucketed_jit(frames=["coefficients"], returns=of_lines)
def line_rms(lines: AbstractLines, coefficients: Float[Array, "frame terms"]) -> Float[Array, "line"]:
    """Root of the mean squared distance of each line's corrected points to it, px, whatever its weight."""
    return jnp.sqrt(_line_squares(lines, coefficients))


@bucketed_jit(returns=of_lines)
def line_squares(lines: AbstractLines, zoom: AbstractZoom) -> Float[Array, "line"]:
    """Mean squared distance of each line's corrected points to it, px^2, under a zoom model."""
    return _line_squares(lines, coefficients_by(zoom, lines))


@bucketed_jit(frames=["coefficients"], returns=of_lines)
def line_squares_by_frame(
    lines: AbstractLines, coefficients: Float[AnyArray, "frame terms"]
) -> Float[Array, "line"]:
    """The same under coefficients of each frame."""
    return _line_squares(lines, jnp.asarray(coefficients))


def _line_squares(lines, coefficients):
    distances = line_distances(lines, coefficients)
    return jnp.sum(distances**2, axis=1) / jnp.maximum(lines.counts, 1)


@kinds_checked
def global_energy(
    lines: AbstractLines, coefficients: Float[AnyArray, "frame terms"] | list
) -> Float[Array, ""]:
    """The global energy, px^2: the mean of the frames' errors (eq. 13)."""
    return _global_energy(lines, jnp.asarray(real_argument("coefficients", coefficients)))


@light_program
def _global_energy(lines, coefficients):
    return jnp.sum(residuals(lines, coefficients) ** 2)


def by_own_coefficients(
    lines: AbstractLines, coefficients: Float[Array, "frame size"]
) -> tuple[Float[Array, "line rows"], Float[Array, "line rows size"]]:
    """The residuals of `weighted_distances`, and their derivatives by the coefficients of their own frame.

    Residuals depend on no others: one direction serves all frames at once.
    """

    def along(direction):
        every = jnp.broadcast_to(direction[None], coefficients.shape)
        return jax.jvp(lambda k: weighted_distances(lines, k), (coefficients,), (every,))

    directions = jnp.eye(coefficients.shape[1], dtype=coefficients.dtype)
    return jax.vmap(along, out_axes=(None, -1))(directions)


class Linearised(NamedTuple):
    """The residuals of a zoom model, and how they and the coefficients follow its flattened parameters."""

    weighted: Float[Array, "line rows"]  # px, times the root of their weights
    jacobian: Float[Array, "line rows parameter"]
    k: Float[Array, "frame size"]
    by_parameter: Float[Array, "frame size parameter"]


def linearised(lines: AbstractLines, zoom: AbstractZoom) -> Linearised:
    """The residuals and their derivatives by the flattened parameters, a row a residual.

    Of a line with more rows than coefficients, and one, those of its triangle stand for them.
    """
    flat, unravel = ravel_pytree(zoom.parameters)

    def coefficients_at(flat):
        return (k := coefficients_by(with_parameters(zoom, unravel(flat)), lines)), k

    by_parameter, k = jax.jacfwd(coefficients_at, has_aux=True)(flat)
    weighted, own = by_own_coefficients(lines, k)
    if own.shape[1] > own.shape[2] + 1:
        columns = jnp.concatenate([weighted[:, None], jnp.swapaxes(own, 1, 2)], axis=1)
        triangles = jax.vmap(triangle)(columns)
        weighted, own = triangles[..., 0], triangles[..., 1:]
    jacobian = jnp.einsum("lrk,lkp->lrp", own, by_parameter[lines.frame], precision=EXACT)
    return Linearised(weighted, jacobian, k, by_parameter)
