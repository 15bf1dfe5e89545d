"""What `fit_motion` minimises: residuals of views in the image, and what is known beforehand.

The unknowns are those of `_motion_model`. A ray X is ahead of frame t as ``R_t X``, less its lever along
the axis of the camera, and its residual that of `_views`, in the image, with a Cauchy loss. Where views
have weights, residuals are times their roots: all have the noise of a view of weight 1.

With a rolling shutter a row is seen before or after the middle of the image. f and R are then those of that
time, by a parabola through the frame and its neighbours.

Lines that are straight in the world enter by the distances of their corrected points to them, taken back
into the image likewise (`image_metric`), with a Cauchy loss of each line's mean square.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from ..lines.best_line import line_normal
from ..lines.stretch import radial_stretch
from ..models.zoom import AbstractPriorZoom
from ._columns import Columns, Rows, Unknowns, columns, derivatives, of_each
from ._motion_model import Data, Model, Noise, Stage, moved, units_of
from ._motion_start import turned
from ._views import corrected, flattened, product, view_residual
from .losses import CAUCHY, LINE

_PIN = 1e3
"""Weight of what is redundant: log f of one frame beside the common factor is 0."""


Args = tuple[Data, Model, Noise, Stage]


class Counted(NamedTuple):
    """What counts, in full. Otherwise there is a loss."""

    views: Bool[Array, "view"]
    lines: Bool[Array, "line"]


class _Rows(NamedTuple):
    """The camera at the rows of frames: what each frame has, and how it changes in a frame's time."""

    model: Model
    coefficients: tuple[Array, Array]
    offset: Array
    height: float

    def at(self, frame, point):
        """log f, coefficients, and the rotation vector since the middle row, where a point is seen."""
        time = self.model.readout * point[1] / self.height
        change = self.model.speed.over(frame, time)
        value, slope = self.coefficients
        log_focal = self.model.path.log_focal[frame] + change[0]
        return log_focal, value[frame] + change[0] * slope[frame], change[1:]


def _rows_of_frames(data, model):
    focal = jnp.exp(model.path.log_focal)
    coefficients = jax.jvp(jax.vmap(model.zoom), (focal,), (focal,))  # by log f
    offset = jnp.zeros((len(focal), 2)) if model.shift is None else jax.vmap(model.shift)(focal)
    return _Rows(model, coefficients, offset, data.size[1] - 1.0)


def residuals_of(
    data: Data, model: Model, lever: Float[Array, "track"] | None = None
) -> Float[Array, "view 2"]:
    """Residuals of all views, px, times the roots of their weights.

    `lever` is beside those of the model.
    """
    rows = _rows_of_frames(data, model)
    lever = jnp.zeros(data.structure.tracks) if lever is None else lever
    lever = lever if model.levers is None else lever + model.levers.value

    def view(number):
        point, frame, track = (
            data.points[number],
            data.structure.frame[number],
            data.structure.track[number],
        )
        log_focal, coefficients, turning = rows.at(frame, point)
        ahead = product(model.path.rotation[frame], model.path.rays[track])
        given = log_focal, coefficients, rows.offset[frame], ahead, turning, lever[track]
        return _weighted(data, number, _missed(data, model, point, *given))

    views = of_each(len(data.points), jax.vmap(view))
    return jnp.where(data.there[:, None], views, 0)


def _weighted(data, number, missed):
    """The residual of a view, px, times the root of its weight."""
    return missed if data.root is None else data.root[number] * missed


def _missed(data, model, point, log_focal, coefficients, offset, ahead, turning, lever):
    """The residual of a view, px. The camera has turned since it saw the middle row, and has a lever."""
    ahead = turned(ahead, turning).at[2].add(-lever)
    camera = jnp.exp(log_focal), coefficients, offset
    return view_residual(point, *camera, ahead, model.distortion_model, data.scale)


def line_residuals_of(data: Data, model: Model) -> Float[Array, "line row"]:
    """Distances of lines' corrected points to them, in the image, px, or rows with their sum of squares."""
    lines, moments = data.lines, data.moments
    if lines is None or moments is None:
        return jnp.zeros((0, 1))
    straight, powers = _corrected_lines(data, model, _rows_of_frames(data, model))
    normal = jax.vmap(line_normal)(straight)
    squared = jax.vmap(radial_stretch)(powers, normal, moments, lines.counts)
    distances = jnp.einsum("lrc,lc->lr", straight, normal)
    return distances / jnp.sqrt(jnp.maximum(squared, 0.01))[:, None]


def line_squares_of(data: Data, distances: Float[Array, "line row"]) -> Float[Array, "line"]:
    """Mean square of each line's distances, px^2; NaN where there is no line, or one of weight 0."""
    if data.lines is None:
        return jnp.zeros(0)
    free = jnp.where(data.lines.weight == 0, 0, data.lines.counts - 2)  # a line takes two
    return jnp.where(free > 0, jnp.sum(distances**2, axis=1) / jnp.maximum(free, 1), jnp.nan)


def line_planes_of(data: Data, model: Model) -> Float[Array, "line 3"]:
    """The normal of the plane through the camera that each line lies in, in the scene; of length 1."""
    lines = data.lines
    if lines is None:
        return jnp.zeros((0, 3))
    rows, frame = _rows_of_frames(data, model), data.structure.line_frame
    first = lines.triangle[:, 0]  # the sums of the monomials 1, x, y ... over a number
    middle = data.scale * first[:, 1:3] / jnp.where(first[:, :1] > 0, first[:, :1], 1)

    def plane(point, corrected_rows, frame):
        coefficients, offset = rows.coefficients[0][frame], rows.offset[frame]
        normal = line_normal(corrected_rows)
        seen = corrected(point, coefficients, offset, model.distortion_model, data.scale)
        across = jnp.append(normal, -normal @ seen / jnp.exp(model.path.log_focal[frame]))
        return product(model.path.rotation[frame].T, across / jnp.linalg.norm(across))

    return jax.vmap(plane)(middle, _corrected_lines(data, model, rows)[0], frame)


def _corrected_lines(data, model, rows):
    """Rows with the scatter of each line's corrected points, px, and the powers that correct it."""
    far = (jnp.asarray(data.size) - 1) / 2 / data.scale
    expand = jax.vmap(lambda k: jnp.asarray(model.distortion_model.expansion(k, far @ far)[0]))
    frame = data.structure.line_frame
    powers = expand(rows.coefficients[0])
    return data.lines.corrected(jnp.concatenate([powers, rows.offset], axis=1)), powers[frame]


def weighed(data: Data, noise: Noise, rows: Float[Array, "line row"]) -> Float[Array, "line row"]:
    """Each line's rows in units of the noise, times the root of its weight."""
    rows = rows / (noise.lines * jnp.sqrt(noise.repeated))
    weight = None if data.lines is None else data.lines.weight
    return rows if weight is None else jnp.sqrt(weight)[:, None] * rows


def averaged(data: Data, model: Model) -> Float[Array, "track 3"]:
    """Each ray as the mean of the directions in which its views see it: a start, and near the best."""
    rows = _rows_of_frames(data, model)

    def direction(number):
        point, frame = data.points[number], data.structure.frame[number]
        log_focal, coefficients, turning = rows.at(frame, point)
        straight = corrected(point, coefficients, rows.offset[frame], model.distortion_model, data.scale)
        ahead = turned(jnp.concatenate([straight / jnp.exp(log_focal), jnp.ones(1)]), -turning)
        seen = product(model.path.rotation[frame].T, ahead) / jnp.linalg.norm(ahead)
        return seen if data.root is None else data.root[number] ** 2 * seen

    seen = of_each(len(data.points), jax.vmap(direction))
    rays = jax.ops.segment_sum(seen, data.structure.track, data.structure.tracks)
    length = jnp.linalg.norm(rays, axis=1, keepdims=True)
    return jnp.where(length > 0, rays / jnp.where(length > 0, length, 1), jnp.array([0.0, 0.0, 1.0]))


def rows_of(unknowns: Unknowns, args: Args, counted: Counted | None = None) -> Rows:
    """All residuals, robust, in units of the noise; `unknowns` are steps in their `units_of`.

    Without the loss if it is given which of them count.
    """
    data, _, noise, _ = args
    views = _with_loss(residuals_of(data, _there(unknowns, args)) / noise.points, counted and counted.views)
    return _other_rows(unknowns, args, counted)._replace(views=views)


def _with_loss(views, counted):
    """Residuals of views, in units of the noise, with the loss or only those that count."""
    if counted is not None:
        return jnp.where(counted[..., None], views, 0)
    return views * flattened(jnp.sum(views**2, axis=-1) / CAUCHY**2)[..., None]


def _there(unknowns, args):
    """The path and the lens after steps."""
    data, model, noise, _ = args
    return moved(model, jax.tree.map(jnp.multiply, unknowns, units_of(data, model, noise)))


def _other_rows(unknowns, args, counted=None):
    """`rows_of` without the views."""
    data, model, noise, stage = args
    steps = jax.tree.map(jnp.multiply, unknowns, units_of(data, model, noise))
    there = moved(model, steps)
    lines = line_residuals_of(data, there)
    if counted is None:
        of_lines = jnp.nan_to_num(line_squares_of(data, lines)) / (noise.lines * LINE) ** 2
        lines = lines * flattened(of_lines)[:, None]
    else:
        lines = jnp.where(counted.lines[:, None], lines, 0)
    return Rows(
        jnp.zeros((0, 2)),
        weighed(data, noise, lines),
        about_frames(data, there.path, unknowns, steps, stage),
        about_lens(data, there, unknowns, stage),
        about_rays(there),
    )


def columns_of(args: Args, unknowns: Unknowns, counted: Counted | None = None) -> Columns:
    """The Jacobian's `columns` of `rows_of`.

    A view depends on the lens by way of its frame, and on rotation and ray by way of where its point is. So
    its derivatives by these few numbers are multiplied by what the unknowns do to them, which is known once
    for each frame and each ray.
    """
    others = columns(jax.linearize(lambda x: _other_rows(x, args, counted), unknowns)[1], unknowns)
    return others._replace(of_views=_view_columns(unknowns, args, counted))


class _Cameras(NamedTuple):
    """What the views of a frame have in common; or how it changes with the unknowns, the last axis."""

    log_focal: Array
    coefficients: Array
    slope: Array  # of the coefficients, by log f
    offset: Array
    rotation: Array


def _view_columns(unknowns, args, counted):
    """What gives those of views, by their numbers."""
    data, model, noise, _ = args

    def what_is_seen_by(unknowns):
        there = _there(unknowns, args)
        rows = _rows_of_frames(data, there)
        cameras = _Cameras(there.path.log_focal, *rows.coefficients, rows.offset, there.path.rotation)
        levers = jnp.zeros(len(there.path.rays)) if there.levers is None else there.levers.value
        return cameras, (there.path.rays, levers), there.readout

    known, change = jax.linearize(what_is_seen_by, unknowns)
    parts = derivatives(change, unknowns)
    changes = jax.tree.map(lambda *of: jnp.concatenate(of, axis=-1), *parts)

    def view(number):
        point, frame, track = (
            data.points[number],
            data.structure.frame[number],
            data.structure.track[number],
        )
        counts = None if counted is None else counted.views[number]
        of_frames, of_rays, readout = zip(known, changes, strict=True)
        camera, by_camera = (jax.tree.map(lambda leaf: leaf[frame], of) for of in of_frames)
        (ray, lever), (by_ray, by_lever) = (jax.tree.map(lambda leaf: leaf[track], of) for of in of_rays)

        def since_the_middle(readout):
            return model.speed.over(frame, readout * point[1] / (data.size[1] - 1.0))

        gone, faster = jax.jvp(since_the_middle, (readout[0],), (jnp.ones(()),))

        def missed(*given):
            missed = _weighted(data, number, _missed(data, model, point, *given))
            return _with_loss(missed / noise.points, counts)

        given = (
            camera.log_focal + gone[0],
            camera.coefficients + gone[0] * camera.slope,
            camera.offset,
            product(camera.rotation, ray),
            gone[1:],
            lever,
        )
        # One after the other: as loops that XLA fuses.
        by = [jax.jacfwd(missed, argnums=place)(*given) for place in range(len(given))]
        turned_ray = sum(by_camera.rotation[:, i] * ray[i] for i in range(3))
        moved_ray = sum(camera.rotation[:, i, None] * by_ray[i][None] for i in range(3))
        by_readout = (
            by[0] * faster[0]
            + sum(by[1][:, i] * faster[0] * camera.slope[i] for i in range(len(camera.slope)))
            + sum(by[4][:, i] * faster[1 + i] for i in range(3))
        )
        found = (
            by[0][:, None] * by_camera.log_focal[None]
            + _combined(by[1], by_camera.coefficients + gone[0] * by_camera.slope)
            + _combined(by[2], by_camera.offset)
            + _combined(by[3], turned_ray + moved_ray)
            + by_readout[:, None] * readout[1][None]
        )
        if model.levers is not None:
            found = found + by[5][:, None] * by_lever[None]
        return jnp.where(data.there[number], found, 0)

    return jax.vmap(view)


def _combined(by, changes):
    """The product of two small matrices, as a sum that XLA fuses with what uses it."""
    return sum(by[:, i, None] * changes[i][None] for i in range(len(changes)))


def about_frames(data, path, unknowns, steps, stage):
    """What is known of frames: the first is the origin, and focal lengths may be given."""
    known = (path.log_focal - data.log_focal) / data.log_std
    own = jnp.where(data.pinned, _PIN * unknowns.frames[:, 0], steps.frames[:, 0] / stage.own)
    log_focal = jnp.where(jnp.isinf(data.log_std), own, known)
    return jnp.concatenate([log_focal[:, None], data.fixed[:, None] * unknowns.frames[:, 1:]], axis=1)


def about_rays(model):
    """What is known of levers; None if there are none."""
    levers = model.levers
    return None if levers is None else ((levers.value - levers.mean) / levers.std)[:, None]


def about_lens(data, model, unknowns, prior):
    """The prior of the lens, and that the common factor is 1 where all focal lengths are known."""
    factor = jnp.where(jnp.any(data.pinned), 0, _PIN * unknowns.lens[-1])
    known, std = data.readout
    readout = (model.readout - known) / jnp.minimum(std, prior.readout)
    rows = [ravel_pytree(model.zoom.parameters)[0] / prior.parameters, readout[None], factor[None]]
    if model.shift is not None:
        rows.append(ravel_pytree(model.shift.parameters)[0] / prior.centre)
    if isinstance(model.zoom, AbstractPriorZoom):
        rows.append(model.zoom.standardised())
    return jnp.concatenate(rows)
