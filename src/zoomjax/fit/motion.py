"""Focal lengths, rotations and the lens of a camera that turns and zooms, from tracks alone.

What is minimised says `_motion_rows`. The solver is optimistix' Levenberg-Marquardt with a linear solver
made for this problem (`_schur`), in time that is linear in the number of frames. The start needs no guess
(`_motion_start`); from there the loss narrows, and the lens joins by a prior that widens.
"""

from typing import Any, NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import scipy.sparse.csgraph
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from .._core.arguments import kinds_checked
from .._core.checks import checked_terms
from .._core.types import AnyArray, of_known_values
from ..models.family import AbstractFamily
from ..models.invertibility import certificate_of
from ..models.lens import ZoomLens
from ..models.polynomial import RadialPolynomial
from ..models.zoom import (
    AbstractFocusZoom,
    AbstractZoom,
    PolynomialZoom,
)
from ..tracks.tracks import Tracks
from ._least_squares import RoundingTrustRegion
from ._motion_rows import (
    CAUCHY,
    Data,
    Model,
    Stage,
    about_frames,
    about_lens,
    averaged,
    moved,
    residuals_of,
    rows_of,
    scaled,
    units_of,
)
from ._motion_start import STARTS, starts_of, views_by_frame
from ._schur import Rows, Schur, Unknowns, covariances, reduced
from ._structure import bucket, padded, structure_of
from .result import RESULTS, ZoomFit, failed, judged

_MEDIAN_OF_SIZE = 1.1774  # of the length of a vector of two normal numbers


_STAGES = (
    Stage(0.3, 0.01, 4.0, change=1.0, damping=1e-3, own=0.05),
    Stage(1.0, 0.05, 1.0, change=3.0, damping=1e-4, own=0.05),
    *[Stage(1.0, 0.05, 1.0, change=0.1, damping=1e-7, own=0.05)] * 4,
)
"""They widen the prior of the lens and narrow the loss; they end where the noise and the solver do."""

_MOST_STEPS = 30  # of a stage

_LONGEST = 48
"""Frames of a track that share a ray. Longer ones are cut, so that only frames near each other are coupled:
that they show the same point says little more, and a cubic cost is saved."""

_INFLATION = 1 / 0.95  # of variances, by what the loss loses

_FREE = 10.0  # standard deviation of a frame's log f, beside the common factor, of which nothing is said
_FAILED = "The fit failed: turn and zoom farther, or fit fewer coefficients about the image's centre."

_UNKNOWN_SCALE = 0.1
"""Standard deviation of log f from which the focal lengths have no scale."""


class MotionFit(eqx.Module):
    """The lens and the path of a camera that turns and zooms.

    Attributes:
        fit: the lens, with focal lengths in px, and its uncertainty. `ZoomFit.rms` is of the distances
            between views and where the model puts them, px of the image, without those that it takes for
            mistakes; `ZoomFit.joint` includes the centre. Its result `undetermined` says that the tracks do
            not determine the scale of the focal lengths, as where the camera zooms and does not turn: only
            their ratios are known then, and the distortion straightens lines all the same.
        focal: focal length of each frame, px; NaN for a frame without tracks.
        focal_std: its standard deviation, px. Nearly all of it is a factor common to all frames.
        covariance: of the zoom model's parameters, of those of the centre's offset, and of the logarithm of
            that factor: that of the first frame.
        rotation: of each frame, from the scene to the camera, whose axes are x right, y down and z
            forward. The first frame's is the identity. So is that of the first frame after a cut, across
            which no track goes: how the camera turned between them is not known.
        shot: number of the shot that each frame belongs to, from 0: a new one begins with each cut; -1 for
            a frame without tracks.
        rays: direction of each track in the scene, of length 1.
        residual: distance between each view and where the model puts it, px; NaN for padding.
        noise: standard deviation of a coordinate of a point, px, from the median of the residuals.
    """

    fit: ZoomFit
    focal: Float[Array, "frame"]
    focal_std: Float[Array, "frame"]
    covariance: Float[Array, "all all"]
    rotation: Float[Array, "frame 3 3"]
    shot: Int[Array, "frame"]
    rays: Float[Array, "track 3"]
    residual: Float[Array, "track view"]
    noise: Float[Array, ""]

    @property
    def lens(self) -> ZoomLens:
        """The zoom lens."""
        return self.fit.lens

    @property
    def pan_and_tilt(self) -> Float[Array, "frame 2"]:
        """Angles of each frame to the right and up, degrees, from where the first of its shot looks."""
        x, y, z = self.rotation[:, 2].T
        return jnp.degrees(jnp.stack([jnp.arctan2(x, z), -jnp.arcsin(jnp.clip(y, -1, 1))], axis=1))

    def __call__(self, *_: Any, **__: Any) -> NoReturn:
        """Raise TypeError: call the lens of the fit instead."""
        raise TypeError("A MotionFit is not a lens: use fit.lens, as in fit.lens(2400.0).")


@kinds_checked
@of_known_values
def fit_motion(
    tracks: Tracks,
    *,
    zoom: AbstractZoom | None = None,
    family: AbstractFamily | None = None,
    terms: int = 2,
    shift: AbstractZoom | None = PolynomialZoom(degree=1),  # noqa: B008, it is frozen
    focal: Float[AnyArray, "frame"] | None = None,
    focal_std: float | Float[AnyArray, "frame"] = np.inf,
    throw: bool = True,
) -> MotionFit:
    """Fit focal lengths, rotations and a zoom lens to tracks of points that are far away or do not move.

    The camera turns about its entrance pupil, or about a point near it beside the distance of the scene,
    and zooms. Computed in float64, which has to be enabled.

    Args:
        tracks: the tracks.
        zoom: the zoom model; `PolynomialZoom` of degree 2 by default.
        family: the distortion model; `RadialPolynomial` by default.
        terms: the number N of radial distortion coefficients.
        shift: zoom model of the offset of the centre of distortion from the centre of the image: linear
            in 1/f by default; None if there is none.
        focal: focal lengths that are known beforehand, px; NaN where not.
        focal_std: their standard deviations, px.
        throw: whether to raise if the fit fails. Otherwise see `ZoomFit.result`. `undetermined` and
            `folded` never raise.

    Raises:
        ValueError: float64 is not enabled, or the number of known focal lengths is not that of the frames.
        RuntimeError: the fit failed (see `throw`).

    References:
        L. de Agapito, E. Hayman, I. Reid, "Self-calibration of rotating and zooming cameras", IJCV 2001.
        M. Brown, D. Lowe, "Automatic panoramic image stitching using invariant features", IJCV 2007.
    """
    if jnp.zeros(()).dtype != jnp.float64:
        raise ValueError(
            "fit_motion needs float64, and it is not enabled: call "
            'jax.config.update("jax_enable_x64", True) first.'
        )
    zoom = PolynomialZoom() if zoom is None else zoom
    if isinstance(zoom, AbstractFocusZoom):
        raise ValueError("Argument zoom depends on the focus, which tracks do not have.")
    family = RadialPolynomial() if family is None else family
    terms = checked_terms(terms, family.most_terms)
    known, known_std = _known_focal(focal, focal_std, tracks.frames)
    track, view = np.nonzero(np.asarray(tracks.mask))
    moment = np.asarray(tracks.frame)[track, view]
    shot = _shots(track, moment, tracks.frames)
    frames = bucket(tracks.frames)
    more = frames - tracks.frames
    structure = structure_of(_pieces(track, moment), moment, frames, min(_LONGEST, frames))
    wide = padded(structure)
    points = np.asarray(tracks.points, float)[track, view] - (np.array([tracks.image_size]) - 1) / 2
    views = len(wide.track) - len(points)
    data = Data(
        points=jnp.asarray(np.pad(points, ((0, views), (0, 0)))),
        there=jnp.arange(len(wide.track)) < len(points),
        structure=wide,
        fixed=jnp.asarray(
            np.pad((shot < 0) | (np.diff(shot, prepend=-1) > 0), (0, more), constant_values=1)
        ),
        pinned=_first((shot >= 0) & np.isinf(known_std), frames),
        log_focal=jnp.asarray(np.pad(np.log(known), (0, more))),
        log_std=jnp.asarray(np.pad(known_std / known, (0, more), constant_values=np.inf)),
        unknowns=jnp.asarray(4.0 * np.sum(shot >= 0) + 2 * structure.tracks),
        scale=tracks.scale,
    )
    paths, spreads = _started(data, views_by_frame(np.asarray(structure.track), moment, frames))
    parts, missed = _in_stages(data, paths, spreads, zoom, shift, family, terms, tracks.image_size)
    for name in ("focal", "focal_std", "rotation"):
        parts[name] = parts[name][: tracks.frames]
    parts["fit"] = eqx.tree_at(
        lambda fit: fit.frame_rms, parts["fit"], parts["fit"].frame_rms[: tracks.frames]
    )
    residual = jnp.full(np.shape(tracks.mask), jnp.nan).at[track, view].set(missed[: len(points)])
    rays = np.zeros((len(tracks.mask), 3))
    np.add.at(rays, track, np.asarray(parts.pop("rays"))[np.asarray(structure.track)])
    rays = jnp.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))
    fit = MotionFit(**parts, rays=rays, residual=residual, shot=jnp.asarray(shot, jnp.int32))
    return thrown_motion(fit) if throw else fit


def thrown_motion(fit: MotionFit) -> MotionFit:
    """The fit, raising RuntimeError where its solver failed."""
    if bool(failed(fit.fit.result)):
        raise RuntimeError(f"{_FAILED} {RESULTS[fit.fit.result]}")
    return fit


def _known_focal(focal, focal_std, frames):
    """Known focal lengths and standard deviations of all frames; 1 and infinity where there is none."""
    values = np.full(frames, np.nan) if focal is None else np.asarray(focal, float)
    if values.shape != (frames,):
        raise ValueError(
            f"Argument focal must have one number for each of the {frames} frames, NaN where it is not "
            f"known, but its shape is {values.shape}."
        )
    there = np.isfinite(values)
    if (values[there] <= 0).any() or not (np.asarray(focal_std) > 0).all():
        raise ValueError("Arguments focal and focal_std must be positive.")
    std = np.where(there, np.broadcast_to(focal_std, frames), np.inf)
    return np.where(there, values, 1.0), std


def _first(which, frames):
    """The first that is set, alone."""
    return jnp.asarray((np.arange(frames) == np.argmax(which)) & which.any())


def _shots(track, moment, frames):
    """The number of each frame's shot; -1 for frames without views. A track goes through no cut."""
    same = track[1:] == track[:-1]
    links = scipy.sparse.coo_array(
        (np.ones(same.sum()), (moment[:-1][same], moment[1:][same])), (frames,) * 2
    )
    _, names = scipy.sparse.csgraph.connected_components(links, directed=False)
    seen = np.bincount(moment, minlength=frames) > 0
    _, first, place = np.unique(names[seen], return_index=True, return_inverse=True)
    shot = np.full(frames, -1)
    shot[seen] = np.argsort(np.argsort(first))[place]
    return shot


def _pieces(track, moment):
    """Names of the tracks' pieces, each at most `_LONGEST` frames long, for each view."""
    _, first, number = np.unique(track, return_index=True, return_inverse=True)
    part = (moment - moment[first][number]) // _LONGEST
    return np.unique(np.stack([track, part]), axis=1, return_inverse=True)[1].ravel()


@eqx.filter_jit
def _started(data, by_frame):
    """The best chains of frames, scaled to focal lengths that are known, and their residuals' medians."""
    paths, spreads = starts_of(data.points, data.structure.tracks, 1.6 * data.scale, by_frame)

    def to_known(path):
        off = jnp.where(jnp.isinf(data.log_std), jnp.nan, data.log_focal - path.log_focal)
        return scaled(path, jnp.nan_to_num(jnp.nanmedian(off)))

    return jax.vmap(to_known)(paths), spreads


def _in_stages(data, paths, spreads, zoom, shift, family, terms, image_size):
    """The fit, with a prior of the lens that widens from stage to stage: the program is the same.

    The first stage goes from all starts. The one that leaves the least noise goes on.
    """
    tried = []
    for path, spread in zip(_each(paths), spreads, strict=True):
        focal = np.exp(np.asarray(path.log_focal))
        prepared = None if shift is None else shift.prepare(focal, 2)
        model = Model(path, zoom.prepare(focal, family.size(terms)), prepared, family)
        wide = spread / _MEDIAN_OF_SIZE * _STAGES[0].wider
        tried.append(_solved(data, model, wide, _arrays(_STAGES[0])))
    model, noise, result, steps = min(tried, key=lambda found: np.nan_to_num(found[1], nan=np.inf))
    for number, stage in enumerate(_STAGES[1:]):
        model, noise, result, steps = _solved(data, model, noise * stage.wider, _arrays(stage))
        if number > 0 and result == RESULTS.successful:
            break
    free = _arrays(_STAGES[-1]._replace(own=_FREE))
    return _described(data, model, noise, free, result, steps, image_size)


def _each(paths):
    """The paths in a stack."""
    return [jax.tree.map(lambda leaf, place=place: leaf[place], paths) for place in range(STARTS)]


def _arrays(stage):
    """Numbers that the compiled program takes, and is not compiled for."""
    return jax.tree.map(jnp.asarray, stage)


def _of_residuals(change):
    """The size of a change of the residuals. Steps are not asked: along weak directions they say little."""
    return jnp.zeros(()) if isinstance(change, Unknowns) else optx.two_norm(change)


@eqx.filter_jit
def _solved(data, model, noise, stage):
    """The path and the lens of least energy, the noise, the solver's status and its steps."""
    solver = optx.LevenbergMarquardt(
        rtol=0.0, atol=stage.change, norm=_of_residuals, linear_solver=Schur(data.structure)
    )
    solver = eqx.tree_at(lambda s: s.search, solver, RoundingTrustRegion(first_damping=stage.damping))
    model = eqx.tree_at(lambda m: m.path.rays, model, averaged(data, model))
    start = jax.tree.map(jnp.zeros_like, units_of(data, model, noise))
    solution = optx.least_squares(
        rows_of, solver, start, args=(data, model, noise, stage), max_steps=_MOST_STEPS, throw=False
    )
    steps = jax.tree.map(jnp.multiply, solution.value, units_of(data, model, noise))
    path, zoom, shift = moved(model, steps)
    size = jnp.linalg.norm(residuals_of(data, path, zoom, shift, model.family), axis=-1)
    rays = path.rays / jnp.linalg.norm(path.rays, axis=1, keepdims=True)
    size = jnp.where(data.there, size, jnp.nan)
    noise = jnp.maximum(jnp.nanmedian(size) / _MEDIAN_OF_SIZE, 1e-6)  # of tracks without noise
    there = Model(path._replace(rays=rays), zoom, shift, model.family)
    return there, noise, RESULTS.promote(solution.result), solution.stats["num_steps"]


@eqx.filter_jit
def _described(data, model, noise, stage, result, steps, image_size):
    """The fit with its residuals, covariance and status."""
    frames = len(model.path.log_focal)
    units = units_of(data, model, noise)
    zeros = jax.tree.map(jnp.zeros_like, units)

    def plain(unknowns):  # without the loss: its efficiency is in `inflation`
        steps = jax.tree.map(jnp.multiply, unknowns, units)
        path, zoom, shift = moved(model, steps)
        views = residuals_of(data, path, zoom, shift, model.family) / noise
        views = jnp.where(inlier[..., None], views, 0)
        frames = about_frames(data, path, unknowns, steps, stage)
        return Rows(views, frames, about_lens(data, zoom, shift, unknowns, stage))

    missed = residuals_of(data, model.path, model.zoom, model.shift, model.family)
    squared = jnp.sum(missed**2, axis=-1) / (noise * CAUCHY) ** 2
    inlier = data.there & (squared < 9)  # beyond, the loss nearly ignores a view
    rows, jacobian = jax.linearize(plain, zeros)
    matrix = reduced(jacobian, rows, zeros, data.structure, jnp.asarray(0.0))
    own, lens, both = covariances(matrix, frames)
    of_lens = ravel_pytree(units.lens)[0]
    lens = lens * jnp.outer(of_lens, of_lens)
    unit = units.frames[:, 0]
    log_variance = own[:, 0, 0] * unit**2 + 2 * both[:, 0, -1] * unit * of_lens[-1] + lens[-1, -1]
    count = 2 * jnp.sum(inlier)
    free = count / (count - data.unknowns - len(lens))
    inflation = _INFLATION * free
    zoom_size = ravel_pytree(model.zoom.parameters)[0].size
    joint, log_std = lens[:-1, :-1] * inflation, jnp.sqrt(log_variance * inflation)
    focal = jnp.exp(model.path.log_focal)
    unseen = jnp.zeros(frames).at[data.structure.frame].add(1.0 * data.there) == 0
    fitted = ZoomLens(
        zoom=model.zoom,
        centre=(jnp.asarray(image_size, jnp.float64) - 1) / 2,
        focal_range=jnp.stack(
            [jnp.min(focal, where=~unseen, initial=jnp.inf), jnp.max(focal, where=~unseen, initial=0)]
        ),
        image_size=image_size,
        focal_unit="px",
        shift=model.shift,
        family=model.family,
    )
    known = jnp.min(jnp.where(unseen, jnp.inf, log_std)) < _UNKNOWN_SCALE
    certificate = certificate_of(
        fitted.zoom, fitted.centre, fitted.focal_range, image_size, family=model.family, shift=model.shift
    )
    kept = jnp.where(inlier, jnp.sum(missed**2, axis=-1), 0)
    in_frame = [jnp.zeros(frames).at[data.structure.frame].add(leaf) for leaf in (kept, 1.0 * inlier)]
    rms = jnp.sqrt(jnp.sum(kept) / jnp.sum(inlier))
    fit = ZoomFit(
        lens=fitted,
        rms=rms,
        frame_rms=jnp.sqrt(in_frame[0] / in_frame[1]),
        covariance=joint[:zoom_size, :zoom_size],
        result=judged(fitted.zoom, result, known, certificate),
        steps=steps,
        certificate=certificate,
        rms_unconstrained=rms,
        joint=None if model.shift is None else joint,
    )
    parts = {
        "fit": fit,
        "focal": jnp.where(unseen, jnp.nan, focal),
        "focal_std": jnp.where(unseen, jnp.nan, focal * log_std),
        "covariance": lens * inflation,
        "rotation": model.path.rotation,
        "rays": model.path.rays,
        "noise": noise * jnp.sqrt(free),
    }
    return parts, jnp.linalg.norm(missed, axis=-1)
