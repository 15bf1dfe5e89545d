"""Focal lengths, rotations and the lens of a camera that turns and zooms, from tracks alone.

The unknowns are log f and the rotation of each frame, a ray of each track, the zoom model, and the offset
of the centre of distortion. A ray X is seen in frame t at ``p = f_t (y1, y2)/y3`` with ``y = R_t X``, and
the point that was observed is corrected to c. The residual in the image is ``J^-1 (c - p)``, where J is the
derivative of the correction at the observed point: one step of Newton's method for the inverse, exact to
second order. Residuals have a Cauchy loss, with a scale from their median.

The solver is optimistix' Levenberg-Marquardt with a linear solver made for this problem (`_schur`), linear
in the number of frames. The start needs no guess (`_motion_start`); the lens joins by a prior that widens.
"""

from typing import Any, NamedTuple, NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import scipy.sparse.csgraph
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from .._core.arguments import kinds_checked
from .._core.checks import checked_terms
from .._core.types import AnyArray
from ..models.family import AbstractFamily
from ..models.invertibility import certificate_of
from ..models.lens import ZoomLens
from ..models.polynomial import RadialPolynomial
from ..models.zoom import (
    AbstractFocusZoom,
    AbstractPriorZoom,
    AbstractZoom,
    PolynomialZoom,
    with_parameters,
)
from ..tracks.tracks import Tracks
from ._least_squares import RoundingTrustRegion
from ._motion_start import Path, rotation_vector, shrunk_ray, start_of, turned, views_by_frame
from ._schur import (
    Rows,
    Schur,
    Structure,
    Unknowns,
    bucket,
    covariances,
    padded,
    reduced,
    structure_of,
)
from .result import RESULTS, ZoomFit, failed, judged

_CAUCHY = 2.3849
"""Of the noise: where the loss begins to flatten; 95 % efficient for normal errors."""

_MEDIAN_OF_SIZE = 1.1774  # of the length of a vector of two normal numbers


class _Stage(NamedTuple):
    """How the noise is taken, and when to stop.

    Attributes:
        parameters: standard deviation of each parameter of the zoom model before there is any data.
        centre: of the offset of the centre, half image diagonals.
        wider: times the noise that the residuals before the stage have: the loss is flat beyond.
        change: a step that moves the residuals by less, in all and in units of the noise, is the last.
            1 is the standard deviation of the estimate along the step.
        damping: of the first step.
    """

    parameters: float
    centre: float
    wider: float
    change: float
    damping: float


_STAGES = (
    _Stage(0.3, 0.01, 4.0, change=1.0, damping=1e-3),
    _Stage(1.0, 0.05, 1.0, change=3.0, damping=1e-4),
    *[_Stage(1.0, 0.05, 1.0, change=0.1, damping=1e-7)] * 4,
)
"""They widen the prior of the lens and narrow the loss; they end where the noise and the solver do."""

_MOST_STEPS = 30  # of a stage

_OWN = 0.05  # standard deviation of a frame's log f beside the common factor
_LONGEST = 48
"""Frames of a track that share a ray. Longer ones are cut, so that only frames near each other are coupled:
that they show the same point says little more, and a cubic cost is saved."""

_INFLATION = 1 / 0.95  # of variances, by what the loss loses

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
            that factor.
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

    def __call__(self, *_: Any, **__: Any) -> NoReturn:
        """Raise TypeError: call the lens of the fit instead."""
        raise TypeError("A MotionFit is not a lens: use fit.lens, as in fit.lens(2400.0).")


@kinds_checked
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
    if not jax.config.jax_enable_x64:
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
    data = _Data(
        points=jnp.asarray(np.pad(points, ((0, views), (0, 0)))),
        there=jnp.arange(len(wide.track)) < len(points),
        structure=wide,
        fixed=jnp.asarray(
            np.pad((shot < 0) | (np.diff(shot, prepend=-1) > 0), (0, more), constant_values=1)
        ),
        log_focal=jnp.asarray(np.pad(np.log(known), (0, more))),
        log_std=jnp.asarray(np.pad(known_std / known, (0, more), constant_values=np.inf)),
        unknowns=jnp.asarray(4.0 * np.sum(shot >= 0) + 2 * structure.tracks),
        scale=tracks.scale,
    )
    path, spread = _started(data, views_by_frame(np.asarray(structure.track), moment, frames))
    parts, missed = _in_stages(data, path, spread, zoom, shift, family, terms, tracks.image_size)
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
        raise RuntimeError(f"The fit failed. {RESULTS[fit.fit.result]}")
    return fit


class _Data(eqx.Module):
    """Tracks, as the residuals need them.

    Attributes:
        points: about the centre of the image, px.
        there: which views there are; others pad.
        structure: which track and frame each view belongs to.
        fixed: frames whose rotation is given: the first of each shot, and those that no track sees.
        log_focal, log_std: what is known of log f beforehand; infinite standard deviations.
        unknowns: how many numbers of frames and rays are fitted.
        scale: half the image diagonal, px.
    """

    points: Float[Array, "view 2"]
    there: Bool[Array, "view"]
    structure: Structure
    fixed: Bool[Array, "frame"]
    log_focal: Float[Array, "frame"]
    log_std: Float[Array, "frame"]
    unknowns: Float[Array, ""]
    scale: float = eqx.field(static=True)


class _Model(eqx.Module):
    """What the unknowns are measured from: a path, and a lens."""

    path: Path
    zoom: AbstractZoom
    shift: AbstractZoom | None
    family: AbstractFamily


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
    """The best chain of frames, scaled to focal lengths that are known, and its residuals' median."""
    path, spread = start_of(data.points, data.structure.tracks, 1.6 * data.scale, by_frame)
    off = jnp.where(jnp.isinf(data.log_std), jnp.nan, data.log_focal - path.log_focal)
    return _scaled(path, jnp.nan_to_num(jnp.nanmedian(off))), spread


def _in_stages(data, path, spread, zoom, shift, family, terms, image_size):
    """The fit, with a prior of the lens that widens from stage to stage: the program is the same."""
    focal = np.exp(np.asarray(path.log_focal))
    model = _Model(
        path,
        zoom.prepare(focal, family.size(terms)),
        None if shift is None else shift.prepare(focal, 2),
        family,
    )
    noise, result, steps = spread / _MEDIAN_OF_SIZE, None, None
    for number, stage in enumerate(_STAGES):
        model, noise, result, steps = _solved(data, model, noise * stage.wider, _arrays(stage))
        if number > 1 and result == RESULTS.successful:
            break
    return _described(data, model, noise, _arrays(_STAGES[-1]), result, steps, image_size)


def _arrays(stage):
    """Numbers that the compiled program takes, and is not compiled for."""
    return jax.tree.map(jnp.asarray, stage)


def _units(data, model, noise):
    """How much of each unknown moves all views that it belongs to by the noise, and no more.

    Damping then treats a focal length, a rotation, a ray and a coefficient alike.
    """
    structure, half = data.structure, data.scale / 2
    focal = jnp.exp(model.path.log_focal)
    ones = data.there.astype(float)
    in_frame = jnp.zeros(len(focal)).at[structure.frame].add(ones)
    in_ray = jax.ops.segment_sum(ones, structure.track, structure.tracks)
    in_ray = jnp.maximum(in_ray, 1)
    focal_of_ray = jax.ops.segment_sum(ones * focal[structure.frame], structure.track, structure.tracks)
    focal_of_ray = jnp.maximum(focal_of_ray / in_ray, 1.0)
    lever = jnp.stack([jnp.full(len(focal), half), focal, focal, jnp.full(len(focal), half)], axis=1)
    of_lens = noise / (half * jnp.sqrt(jnp.sum(ones)))
    return Unknowns(
        noise / (lever * jnp.sqrt(jnp.maximum(in_frame, 1))[:, None]),
        jnp.broadcast_to((noise / (focal_of_ray * jnp.sqrt(in_ray)))[:, None], (structure.tracks, 2)),
        jax.tree.map(lambda leaf: jnp.full(leaf.shape, of_lens), _lens_parameters(model)),
    )


def _lens_parameters(model):
    """Those of the zoom model and of the centre's offset, and the common factor of focal lengths."""
    return model.zoom.parameters, None if model.shift is None else model.shift.parameters, jnp.zeros(())


def _moved(model, steps):
    """The path and the lens after steps.

    One of them is a common factor of all focal lengths, by which angles shrink. It is redundant, and it is
    the direction that tracks determine worst: along it, the other unknowns change little.
    """
    parameters, offsets, factor = jax.tree.map(jnp.add, _lens_parameters(model), steps.lens)
    zoom = with_parameters(model.zoom, parameters)
    shift = None if model.shift is None else with_parameters(model.shift, offsets)
    path = _scaled(model.path, factor)

    def ray(ray, start, step):
        return ray + step @ _tangents(start)

    def rotation(matrix, step):
        return jax.vmap(lambda column: turned(column, step), 1, 1)(matrix)

    rays = jax.vmap(ray)(path.rays, model.path.rays, steps.rays)
    rotations = jax.vmap(rotation)(path.rotation, steps.frames[:, 1:])
    return Path(path.log_focal + steps.frames[:, 0], rotations, rays), zoom, shift


def _scaled(path, factor):
    """A path with all focal lengths larger by a factor, whose logarithm is given, and smaller angles."""
    shrunk = jnp.exp(-factor)

    def rotation(matrix):
        extra = (shrunk - 1) * rotation_vector(matrix)  # about the same axis
        return jax.vmap(lambda column: turned(column, extra), 1, 1)(matrix)

    rays = jax.vmap(shrunk_ray, (0, None))(path.rays, shrunk)
    return Path(path.log_focal + factor, jax.vmap(rotation)(path.rotation), rays)


def _tangents(ray):
    """Two vectors of length 1 across a ray."""
    helper = jnp.where(jnp.abs(ray[0]) < 0.7, jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 1.0, 0.0]))
    first = jnp.cross(ray, helper)
    first = first / jnp.linalg.norm(first)
    return jnp.stack([first, jnp.cross(ray, first)])


def _corrected(point, coefficients, offset, family, scale):
    """A point corrected, px about the centre of distortion, which is the principal point, too."""
    z = point / scale - offset
    return scale * jnp.stack(family.correct((z[0], z[1]), z @ z, coefficients))


def _view(point, focal, coefficients, offset, ahead, family, scale):
    """The residual of one view, px of the image."""

    def corrected(point):
        return _corrected(point, coefficients, offset, family, scale)

    depth = jnp.where(ahead[2] > 0.05, ahead[2], 0.05)
    missed = corrected(point) - focal * ahead[:2] / depth
    (a, b), (c, d) = jax.jacfwd(corrected)(point)
    determinant = a * d - b * c
    determinant = jnp.where(determinant > 0.05, determinant, 0.05)
    return jnp.stack([d * missed[0] - b * missed[1], a * missed[1] - c * missed[0]]) / determinant


def _views(data, path, zoom, shift, family):
    """Residuals of all views, px."""
    focal = jnp.exp(path.log_focal)
    coefficients = jax.vmap(zoom)(focal)
    offset = jnp.zeros((len(focal), 2)) if shift is None else jax.vmap(shift)(focal)

    def view(point, frame, track):
        ahead = _product(path.rotation[frame], path.rays[track])
        return _view(point, focal[frame], coefficients[frame], offset[frame], ahead, family, data.scale)

    views = jax.vmap(view)(data.points, data.structure.frame, data.structure.track)
    return jnp.where(data.there[:, None], views, 0)


def _product(matrix, vector):
    """A matrix times a vector, as a sum that XLA fuses with what uses it."""
    x, y, z = (matrix[:, column] * vector[column] for column in range(3))
    return x + y + z


def _averaged(data, model):
    """Each ray as the mean of the directions in which its views see it: a start, and near the best."""
    focal = jnp.exp(model.path.log_focal)
    coefficients = jax.vmap(model.zoom)(focal)
    offset = jnp.zeros((len(focal), 2)) if model.shift is None else jax.vmap(model.shift)(focal)

    def direction(point, frame):
        straight = _corrected(point, coefficients[frame], offset[frame], model.family, data.scale)
        ahead = jnp.concatenate([straight / focal[frame], jnp.ones(1)])
        return _product(model.path.rotation[frame].T, ahead) / jnp.linalg.norm(ahead)

    seen = jax.vmap(direction)(data.points, data.structure.frame)
    rays = jax.ops.segment_sum(seen, data.structure.track, data.structure.tracks)
    length = jnp.linalg.norm(rays, axis=1, keepdims=True)
    return jnp.where(length > 0, rays / jnp.where(length > 0, length, 1), jnp.array([0.0, 0.0, 1.0]))


def _rows(unknowns, args):
    """All residuals, robust, in units of the noise; `unknowns` are steps in their `_units`."""
    data, model, noise, stage = args
    steps = jax.tree.map(jnp.multiply, unknowns, _units(data, model, noise))
    path, zoom, shift = _moved(model, steps)
    views = _views(data, path, zoom, shift, model.family) / noise
    squared = jnp.sum(views**2, axis=-1, keepdims=True) / _CAUCHY**2
    safe = jnp.where(squared > 1e-8, squared, 1.0)
    views = views * jnp.where(squared > 1e-8, jnp.sqrt(jnp.log1p(safe) / safe), 1 - squared / 4)
    return Rows(views, _about_frames(data, path, unknowns, steps), _about_lens(zoom, shift, stage))


def _about_frames(data, path, unknowns, steps):
    """What is known of frames: the first is the origin, and focal lengths may be given.

    That log f hardly changes but by the common factor is said so weakly that it only parts the two.
    """
    known = (path.log_focal - data.log_focal) / data.log_std
    log_focal = jnp.where(jnp.isinf(data.log_std), steps.frames[:, 0] / _OWN, known)
    return jnp.concatenate([log_focal[:, None], data.fixed[:, None] * unknowns.frames[:, 1:]], axis=1)


def _about_lens(zoom, shift, prior):
    """The prior of the lens."""
    rows = [ravel_pytree(zoom.parameters)[0] / prior.parameters]
    if shift is not None:
        rows.append(ravel_pytree(shift.parameters)[0] / prior.centre)
    if isinstance(zoom, AbstractPriorZoom):
        rows.append(zoom.standardised())
    return jnp.concatenate(rows)


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
    model = eqx.tree_at(lambda m: m.path.rays, model, _averaged(data, model))
    start = jax.tree.map(jnp.zeros_like, _units(data, model, noise))
    solution = optx.least_squares(
        _rows, solver, start, args=(data, model, noise, stage), max_steps=_MOST_STEPS, throw=False
    )
    steps = jax.tree.map(jnp.multiply, solution.value, _units(data, model, noise))
    path, zoom, shift = _moved(model, steps)
    size = jnp.linalg.norm(_views(data, path, zoom, shift, model.family), axis=-1)
    rays = path.rays / jnp.linalg.norm(path.rays, axis=1, keepdims=True)
    size = jnp.where(data.there, size, jnp.nan)
    noise = jnp.maximum(jnp.nanmedian(size) / _MEDIAN_OF_SIZE, 1e-6)  # of tracks without noise
    moved = _Model(path._replace(rays=rays), zoom, shift, model.family)
    return moved, noise, RESULTS.promote(solution.result), solution.stats["num_steps"]


@eqx.filter_jit
def _described(data, model, noise, stage, result, steps, image_size):
    """The fit with its residuals, covariance and status."""
    frames = len(model.path.log_focal)
    units = _units(data, model, noise)
    zeros = jax.tree.map(jnp.zeros_like, units)

    def plain(unknowns):  # without the loss: its efficiency is in `inflation`
        steps = jax.tree.map(jnp.multiply, unknowns, units)
        path, zoom, shift = _moved(model, steps)
        views = _views(data, path, zoom, shift, model.family) / noise
        views = jnp.where(inlier[..., None], views, 0)
        return Rows(views, _about_frames(data, path, unknowns, steps), _about_lens(zoom, shift, stage))

    missed = _views(data, model.path, model.zoom, model.shift, model.family)
    squared = jnp.sum(missed**2, axis=-1) / (noise * _CAUCHY) ** 2
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
