"""What is known about a path and a lens that were fitted: a `MotionFit`'s parts, with their uncertainty."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from ..models.invertibility import certificate_of
from ..models.lens import ZoomLens
from ._motion_levers import common_lever, determined_levers
from ._motion_model import Data, Model, Noise, Stage, pinned, units_of
from ._motion_parallax import parallax_of
from ._motion_repeated import Pulls, common_errors_of
from ._motion_rows import (
    Counted,
    columns_of,
    line_residuals_of,
    line_squares_of,
    residuals_of,
    rows_of,
)
from ._schur import covariances, reduced_of
from .losses import CAUCHY, IGNORED, IGNORED_LINE
from .result import ZoomFit, judged

AS_GOOD = 1.3
"""Times as much of errors that views or lines have in common: what is less may be chance."""

_INFLATION = 1 / 0.95  # of variances, by what the loss loses

_LITTLE = 1e-9
"""Added to the diagonal: where one track alone links frames to others, they may turn about its ray."""


_FOLLOWED = 0.2
"""Share of a frame's views that have to follow the model: fewer may do so by chance, at any f."""

_UNKNOWN_SCALE = 0.1
"""Standard deviation of log f from which the focal lengths have no scale."""


class _Uncertainty(NamedTuple):
    """Of what is estimated.

    Attributes:
        lens: covariance of the lens's parameters, its offset's, the readout and the common log f.
        log_focal: variance of the logarithm of each frame's focal length.
        inflation: of the variance of points, by the unknowns that were fitted to them.
        pulls: how groups of frames pull at the lens, in units of what noise would do.
    """

    lens: Float[Array, "lens lens"]
    log_focal: Float[Array, "frame"]
    inflation: Float[Array, ""]
    pulls: Pulls


@eqx.filter_jit
def described(
    data: Data,
    model: Model,
    noise: Noise,
    stage: Stage,
    result: Any,
    steps: Any,
    group: Int[Array, "frame"],
) -> tuple[dict[str, Any], Float[Array, "view"], Pulls]:
    """The parts of a `MotionFit` by name, the sizes of the residuals of all views, px, and groups' pulls.

    The sizes, and the mean squares, are of residuals times the roots of their weights.

    Args:
        data: tracks and lines.
        model, noise: the fitted ones.
        stage: the last one, without what holds focal lengths to their neighbours.
        result, steps: of the solver.
        group: of each frame, the number of what tracks link.
    """
    missed = residuals_of(data, model)
    data = pinned(data, missed, noise)
    squared = jnp.sum(missed**2, axis=-1)
    inlier = data.there & (squared < (IGNORED * CAUCHY * noise.points) ** 2)
    focal = jnp.exp(model.path.log_focal)
    of_views = jnp.where(inlier, squared, 0), data.counted(inlier), data.counted(data.there)
    squares, followed, there = (
        jnp.zeros(len(focal)).at[data.structure.frame].add(leaf) for leaf in of_views
    )
    unseen = followed <= _FOLLOWED * there
    known = _uncertainty(data, model, noise, stage, missed, inlier, unseen, group)
    log_std = jnp.sqrt(known.log_focal)
    scaled = jnp.min(jnp.where(unseen, jnp.inf, log_std)) < _UNKNOWN_SCALE
    lens = lens_of(data, model, jnp.where(unseen, jnp.nan, focal))
    parts = {
        "fit": _fit_of(lens, known.lens[:-2, :-2], squares, followed, judge=(result, scaled), steps=steps),
        "focal": jnp.where(unseen, jnp.nan, focal),
        "focal_std": jnp.where(unseen, jnp.nan, focal * log_std),
        "covariance": known.lens,
        "rotation": model.path.rotation,
        "noise": noise.points * jnp.sqrt(known.inflation),
        "line_noise": jnp.asarray(jnp.nan) if data.lines is None else noise.lines,
        "readout": model.readout,
        "readout_std": jnp.sqrt(known.lens[-2, -2]),
    }
    if model.levers is None:
        parallax, parallax_std = parallax_of(data, model, noise, inlier)
        parts["parallax"] = jnp.sqrt(jnp.maximum(parallax, 0))
        parts["parallax_score"] = parallax / parallax_std
    return parts, jnp.linalg.norm(missed, axis=-1), known.pulls


def _uncertainty(
    data: Data,
    model: Model,
    noise: Noise,
    stage: Stage,
    missed: Float[Array, "view 2"],
    inlier: Bool[Array, "view"],
    unseen: Bool[Array, "frame"],
    group: Int[Array, "frame"],
) -> _Uncertainty:
    """By the rows of what follows the model, with what the loss loses and what tracks have in common."""
    units = units_of(data, model, noise)
    zeros = jax.tree.map(jnp.zeros_like, units)
    good = line_squares_of(data, line_residuals_of(data, model)) < (IGNORED_LINE * noise.lines) ** 2
    args, counted = (data, model, noise, stage), Counted(inlier, good)  # the loss is in the inflation

    def rows_at(unknowns):
        return rows_of(unknowns, args, counted)

    rows, of_rows = rows_at(zeros), columns_of(args, zeros, counted)
    matrix = reduced_of(of_rows, rows, zeros, data.structure, jnp.asarray(_LITTLE))
    own, lens, both = covariances(matrix, len(model.path.log_focal))
    of_lens = ravel_pytree(units.lens)[0]
    lens = lens * jnp.outer(of_lens, of_lens)
    unit = units.frames[:, 0]
    log_focal = own[:, 0, 0] * unit**2 + 2 * both[:, 0, -1] * unit * of_lens[-1] + lens[-1, -1]
    lens = _with_scale(data, lens, both[:, 0] * jnp.outer(unit, of_lens), log_focal, unseen)
    levers = determined_levers(model, matrix, units)
    if data.root is None or data.redundant is None:
        count = 2 * jnp.sum(inlier)
        free = count / (count - data.unknowns - len(lens) - levers)
    else:  # the noise is a mean by weights, and what is fitted takes from views by theirs
        weight = data.counted(inlier)
        telling = weight * data.redundant
        count = 2 * jnp.sum(telling)
        free = count / (count - data.unknowns - (len(lens) + levers) * _mean(telling, weight))
    squared = jnp.sum(missed**2, axis=-1) / (noise.points * CAUCHY) ** 2
    flat = jnp.where(inlier, 1 / (1 + squared), 0)  # of the loss: its slope over the residual
    pull = flat[:, None] * missed / noise.points
    common, pulls = common_errors_of(of_rows, rows._replace(views=pull), matrix, data.structure, group)
    kept = jnp.mean(flat**2, where=inlier) if data.root is None else _mean(flat**2, data.counted(inlier))
    usual = kept**2 * _INFLATION * free
    common, pulls = common / usual, _over(pulls, usual)
    inflation = _INFLATION * free * jnp.where(common > AS_GOOD, common, 1)
    lens, log_focal = lens * inflation, log_focal * inflation
    if model.levers is not None:
        guessed = common_lever(model, rows_at, of_rows, units, data.structure)
        lens = lens + jnp.outer(guessed.lens, guessed.lens)
        log_focal = log_focal + guessed.log_focal**2
    return _Uncertainty(lens, log_focal, free, pulls)


def _over(pulls: Pulls, variance: Array) -> Pulls:
    """The same in units in which pulls have this variance."""
    return pulls._replace(score=pulls.score / jnp.sqrt(variance), scatter=pulls.scatter / variance)


def _with_scale(data, lens, both, log_focal, unseen):
    """The covariance of the lens and the scale, which is that of the best known f where all are known."""
    best = jnp.argmin(jnp.where(jnp.isinf(data.log_std) | unseen, jnp.inf, log_focal))
    row = (lens[-1] + both[best]).at[-1].set(log_focal[best])
    told = lens.at[-1].set(row).at[:, -1].set(row)
    return jnp.where(jnp.any(data.pinned), lens, told)


def _mean(values, weight):
    return jnp.sum(weight * values) / jnp.sum(weight)


def lens_of(data: Data, model: Model, focal: Float[Array, "frame"]) -> ZoomLens:
    """The fitted lens, over the focal lengths that are known."""
    return ZoomLens(
        zoom=model.zoom,
        centre=(jnp.asarray(data.size, jnp.float64) - 1) / 2,
        focal_range=jnp.stack(
            [
                jnp.min(focal, where=~jnp.isnan(focal), initial=jnp.inf),
                jnp.max(focal, where=~jnp.isnan(focal), initial=0),
            ]
        ),
        image_size=data.size,
        focal_unit="px",
        shift=model.shift,
        distortion_model=model.distortion_model,
    )


def _fit_of(
    lens: ZoomLens,
    joint: Float[Array, "parameter parameter"],
    squares: Float[Array, "frame"],
    followed: Float[Array, "frame"],
    *,
    judge: tuple[Any, Bool[Array, ""]],
    steps: Any,
) -> ZoomFit:
    """The lens's own part.

    Args:
        lens: the lens.
        joint: covariance of its parameters and of its offset's.
        squares, followed: of each frame, the sum of squares of the views that follow, and of their weights.
        judge: the solver's result, and whether the focal lengths have a scale.
        steps: of the solver.
    """
    certificate = certificate_of(
        lens.zoom,
        lens.centre,
        lens.focal_range,
        lens.image_size,
        distortion_model=lens.distortion_model,
        shift=lens.shift,
    )
    rms = jnp.sqrt(jnp.sum(squares) / jnp.sum(followed))
    own = ravel_pytree(lens.zoom.parameters)[0].size
    return ZoomFit(
        lens=lens,
        rms=rms,
        frame_rms=jnp.sqrt(squares / followed),
        covariance=joint[:own, :own],
        result=judged(lens.zoom, *judge, certificate),
        steps=steps,
        certificate=certificate,
        rms_unconstrained=rms,
        joint=None if lens.shift is None else joint,
    )
