"""Focal lengths, rotations and the lens of a camera that turns and zooms, from tracks alone.

What is minimised says `_motion_rows`. The solver is optimistix' Levenberg-Marquardt with a linear solver
made for this problem (`_schur`), in time that is linear in the number of frames. The start needs no guess
(`_motion_start`); from there the loss narrows, and the lens joins by a prior that widens
(`_motion_stages`). In a long clip that way is gone with a part of the tracks, and all of them join at its
end.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import eval_context
from jaxtyping import Float, Int

from .._core.arguments import kinds_checked
from .._core.types import AnyArray, traced
from ..lines.free_centre import AnyCentreLines
from ..lines.lines import Lines
from ..models.distortion_model import AbstractDistortionModel, checked_terms
from ..models.polynomial import RadialPolynomial
from ..models.requirements import check
from ..models.zoom import AbstractZoom, PolynomialZoom
from ..tracks.tracks import Tracks
from ._motion_apart import group_apart
from ._motion_begin import begins_near, from_earlier
from ._motion_gradient import sensitive
from ._motion_model import Model, Noise, scaled
from ._motion_problem import LONGEST_LOOP, Asked, Given, Problem, problem_of, relative, thinned
from ._motion_stages import begun, in_stages, with_all
from ._motion_start import starts_of, views_by_frame
from .contradiction import warn_of_contradiction, warn_of_other_lens, warn_of_other_scale
from .defaults import zoom_or_default
from .motion_fit import MotionFit, thrown_motion
from .result import RESULTS

LOOPS = LONGEST_LOOP
"""The most frames of a clip in which a camera that comes back closes a loop: tracks stay whole."""


@kinds_checked
def fit_motion(
    tracks: Tracks,
    *,
    zoom: AbstractZoom | None = None,
    distortion_model: AbstractDistortionModel | None = None,
    terms: int = 2,
    shift: AbstractZoom | None = PolynomialZoom(degree=1),  # noqa: B008, it is frozen
    lines: Lines | AnyCentreLines | None = None,
    line_frames: Int[AnyArray, "some"] | None = None,
    readout: float | int | None = None,
    focal: Float[AnyArray, "frame"] | None = None,
    focal_std: float | int | Float[AnyArray, "frame"] | None = None,
    begin: MotionFit | None = None,
    throw: bool = True,
) -> MotionFit:
    """Fit focal lengths, rotations and a zoom lens to tracks of points that are far away or do not move.

    The camera turns about its entrance pupil, or about a point near it beside the distance of the scene,
    and zooms. Where near points are seen to move otherwise than far ones, all is fitted again, and that is
    allowed for (`MotionFit.lever`). Computed in float64, which has to be enabled.

    Args:
        tracks: the tracks.
        zoom: the zoom model; `PolynomialZoom` of degree 2 by default.
        distortion_model: the distortion model; `RadialPolynomial` by default.
        terms: the number N of radial distortion coefficients.
        shift: zoom model of the offset of the centre of distortion from the centre of the image: linear
            in 1/f by default; None if there is none.
        lines: straight lines that are seen in the same frames, which weigh by their own noise; or these
            compressed about the centre of the image. Their focal lengths do not count, their weights do,
            beside other lines of the frame.
        line_frames: which of the tracks' frames each frame of the lines is; by default they are the same.
        readout: time from the first row to the last, in frames, -1 to 1: 0 for a global shutter. Fitted by
            default.
        focal: focal lengths that are known beforehand, px; NaN where not.
        focal_std: their standard deviations, px, above 0; needed if `focal` is given.
        begin: an earlier fit of the same models to other tracks of the clip, from which it begins in place
            of from nothing: it ends at the same fit, and sooner. Its shots stay shots where tracks go from
            one to the other, and its scenes stay scenes where none do.
        throw: whether to raise if the fit fails. Otherwise see `ZoomFit.result`. `undetermined` and
            `folded` never raise.

    Weights of views (`Tracks.weight`) are relative: times one factor, they change nothing but
    `MotionFit.noise`, which is that of a view of weight 1. Residuals count in units of their own noise,
    which is this over the root of the weight: in the loss, the estimate of the noise (a weighted median),
    the start and all standard deviations. Beside others of weight 1, a view of weight 1/2 tells half as
    much as they do, and one of weight 0 nothing: the fit is that without it. Equal weights are as none:
    they do not say that views repeat one another.

    What no track tells is near what is usual: parameters of the zoom model have a prior of mean 0 and
    standard deviation 1, those of the centre's offset of 0.05 half diagonals, and the readout of half a
    frame.

    Focal lengths, rotations, rays and lens are differentiable with respect to points, weights above 0,
    lines and known focal lengths by ``grad``, ``jvp`` and their kin, outside of ``jit`` and ``vmap``: by
    the implicit function theorem, with the noise by which residuals are weighted held as it is.

    Raises:
        ValueError: float64 is not enabled; no track has two views of a weight above 0, or they are in fewer
            frames than a model needs; the number of known focal lengths is not that of the frames; the
            lines are of other frames or images, or the distortion model is not radial; or `begin` is of
            another clip or other models.
        RuntimeError: the fit failed (see `throw`).

    Warns:
        UserWarning: known focal lengths are far from those that the tracks say, by the fit or by one
            without them, which is made if `begin` is not given; or shots that no track links contradict
            that they have one lens.

    References:
        L. de Agapito, E. Hayman, I. Reid, "Self-calibration of rotating and zooming cameras", IJCV 2001.
        M. Brown, D. Lowe, "Automatic panoramic image stitching using invariant features", IJCV 2007.
    """
    if jnp.zeros(()).dtype != jnp.float64:
        raise ValueError(
            "fit_motion needs float64, and it is not enabled: call "
            'jax.config.update("jax_enable_x64", True) first.'
        )
    zoom = zoom_or_default(zoom)
    check("fit_motion", zoom=zoom)
    distortion_model = RadialPolynomial() if distortion_model is None else distortion_model
    terms = checked_terms(terms, distortion_model.most_terms)
    given = relative(Given(tracks, lines, line_frames, focal, focal_std, begin))
    asked = Asked(zoom, distortion_model, terms, shift, readout)
    _check_known((given.tracks.frame, given.tracks.mask))
    _check_frames(given.tracks, asked)
    if not traced(given):
        return _fitted(given, asked, throw)[0]
    fit, model, noise = _constant(given, asked, throw)
    problem = problem_of(given, asked)
    return _with_model(fit, sensitive(problem.data, model, noise), problem)


def _check_known(given) -> None:
    """Raise ValueError if some values of what is given are traced."""
    if traced(given):
        raise ValueError(
            "Arguments of fit_motion must have known values, because its control flow depends on them, but "
            "some are traced: call it outside of jit and vmap. grad and jvp of it work there."
        )


def _check_frames(tracks: Tracks, asked: Asked) -> None:
    """Raise ValueError where the models need more focal lengths than there are frames with views."""
    seen = len(np.unique(np.asarray(tracks.frame)[np.asarray(tracks.mask)]))
    focal = np.arange(1.0, seen + 1)
    try:
        asked.zoom.prepare(focal, asked.distortion_model.num_coefficients(asked.terms))
        if asked.shift is not None:
            asked.shift.prepare(focal, 2)
    except ValueError as error:
        raise ValueError(f"Argument tracks has views in {seen} frames: {error}") from error


def _fitted(given: Given, asked: Asked, throw: bool) -> tuple[MotionFit, Model, Noise]:
    """The fit, and what derivatives of it are found from."""
    _check_known(given)
    with eval_context():  # ensure_compile_time_eval makes zeros and ranges of programs constants of them
        found = _solved_motion(given, asked)
    return (thrown_motion(found[0]), *found[1:]) if throw else found


def _solved_motion(given, asked):
    """The fit, the model that it is of, and the noise."""
    problem, frames = problem_of(given, asked), given.tracks.frames
    found = (from_earlier if begins_near(given) else _from_nothing)(given, asked, problem)
    parts, missed, pulls, model, noise = in_stages(problem.data, *found, problem.scene, problem.linked)
    parts["fit"] = eqx.tree_at(lambda fit: fit.frame_rms, parts["fit"], parts["fit"].frame_rms[:frames])
    if problem.data.root is not None:
        missed = missed / problem.data.root
        parts["noise"] = given.unit * parts["noise"]
    residual = jnp.full(np.shape(given.tracks.mask), jnp.nan)
    fit = MotionFit(
        **parts | {name: parts[name][:frames] for name in ("focal", "focal_std", "rotation")},
        rays=_rays_of(model, problem, len(given.tracks.mask)),
        residual=residual.at[problem.track, problem.view].set(missed[: len(problem.track)]),
        shot=jnp.asarray(problem.shot, jnp.int32),
        scene=jnp.asarray(problem.scene, jnp.int32),
        lever=_levers_of(model, problem, len(given.tracks.mask)),
        lever_std=jnp.zeros(()) if model.levers is None else model.levers.std,
        lever_mean=jnp.zeros(()) if model.levers is None else model.levers.mean,
    )
    if given.focal is not None:
        warn_of_contradiction(given, fit)
        if given.begin is None and np.isfinite(given.focal).any():  # else the earlier fit has told
            free = given._replace(focal=None, focal_std=None)
            warn_of_other_scale(given, fit, noise, _from_nothing(free, asked, problem_of(free, asked)))
    if fit.fit.result == RESULTS.successful:
        apart = group_apart(problem.data, model, noise, problem.linked, pulls)
        if apart is not None:
            warn_of_other_lens(apart, np.where(problem.linked == apart.group, problem.shot, -1))
    return fit, model, noise


def _from_nothing(given, asked, problem):
    """A model near the best and its noise, from tracks alone."""
    fewer = thinned(given)
    few = problem if fewer is None else problem_of(fewer, asked)
    if not all(np.array_equal(getattr(few, of), getattr(problem, of)) for of in ("shot", "linked")):
        few = problem  # what links two parts of a shot is missing
    by_frame = views_by_frame(few.piece, few.moment, len(few.data.log_focal))
    paths, spreads = _started(few.data, by_frame, jnp.asarray(part := _parts_of(few)))
    if not part.any():  # of one part, the last start is the first
        spreads = spreads[:-1]
    found = begun(few.data, paths, spreads, asked.zoom, asked.shift, asked.distortion_model, asked.terms)
    return found if few is problem else with_all(few.data, problem.data, *found)


def _rays_of(model, problem, tracks):
    """The direction of each track: the mean of those of its pieces; NaN where no view counts."""
    rays = jnp.zeros((tracks, 3)).at[problem.track].add(model.path.rays[problem.piece])
    seen = np.bincount(problem.track, minlength=tracks)[:, None] > 0
    if not seen.all():
        rays = jnp.where(seen, rays, 1.0)  # with derivatives of 0
    rays = rays / jnp.linalg.norm(rays, axis=1, keepdims=True)
    return rays if seen.all() else jnp.where(seen, rays, jnp.nan)


def _levers_of(model, problem, tracks):
    """The lever of each track, less their mean: that of its pieces; 0 if the model has none."""
    if model.levers is None:
        return jnp.zeros(tracks)
    ones = jnp.ones(len(problem.track))
    total, count = (
        jnp.zeros(tracks).at[problem.track].add(of)
        for of in (model.levers.value[problem.piece] - model.levers.mean, ones)
    )
    return total / jnp.maximum(count, 1)


@eqx.filter_custom_jvp
def _constant(given: Given, asked: Asked, throw: bool) -> tuple[MotionFit, Model, Noise]:
    """The fit, as a constant for derivatives."""
    return _fitted(given, asked, throw)


@_constant.def_jvp
def _no_change(values, changes):
    del changes
    found = _constant(*values)
    return found, jax.tree.map(lambda _: None, found)


def _with_model(fit: MotionFit, model: Model, problem: Problem) -> MotionFit:
    """The fit with focal lengths, rotations, rays, lens and readout of a model."""
    focal = jnp.exp(model.path.log_focal)[: len(fit.focal)]
    lens = eqx.tree_at(lambda lens: lens.zoom, fit.lens, model.zoom)
    if model.shift is not None:
        lens = eqx.tree_at(lambda lens: lens.shift, lens, model.shift)
    return eqx.tree_at(
        lambda fit: (fit.fit.lens, fit.focal, fit.rotation, fit.rays, fit.readout, fit.lever),
        fit,
        (
            lens,
            jnp.where(jnp.isnan(fit.focal), jnp.nan, focal),
            model.path.rotation[: len(fit.focal)],
            _rays_of(model, problem, len(fit.rays)),
            model.readout,
            _levers_of(model, problem, len(fit.rays)),
        ),
    )


@eqx.filter_jit
def _started(data, by_frame, part):
    """The best chains of frames, scaled to focal lengths that are known, and their residuals' medians.

    Each part that tracks link is scaled to those of its own frames; others as all of them are.
    """
    tracks, width = data.structure.tracks, 1.6 * data.scale
    track, frame = data.structure.track, data.structure.frame
    of_track = jnp.zeros(tracks, int).at[track].max(jnp.where(data.there, part[frame], 0))
    paths, spreads = starts_of(data.points, tracks, width, by_frame, (part, of_track), data.root)

    def to_known(path):
        off = jnp.where(jnp.isinf(data.log_std), jnp.nan, data.log_focal - path.log_focal)
        seen = jnp.isfinite(off)
        sums = [jax.ops.segment_sum(of, part, len(part)) for of in (jnp.where(seen, off, 0), 1.0 * seen)]
        mean = jnp.where(sums[1] > 0, sums[0] / sums[1], jnp.nan_to_num(jnp.nanmedian(off)))
        return scaled(path, mean[part], mean[of_track])

    return jax.vmap(to_known)(paths), spreads


def _parts_of(problem):
    """The number of each frame's part, as tracks link them, of all frames with those that fill up."""
    more = len(problem.data.log_focal) - len(problem.linked)
    return np.pad(np.maximum(problem.linked, 0), (0, more))
