"""What `fit_motion` minimises: residuals of views in the image, and what is known beforehand.

The unknowns are log f and the rotation of each frame, a ray of each track, the zoom model, the offset of
the centre of distortion, and the time that the shutter takes from row to row. A ray X is ahead of frame t
as ``R_t X``, and its residual that of `_views`, in the image, with a Cauchy loss.

With a rolling shutter a row is seen before or after the middle of the image. f and R are then those of that
time, by a parabola through the frame and its neighbours.

Lines that are straight in the world enter by the distances of their corrected points to them, taken back
into the image likewise (`image_metric`), with a Cauchy loss of each line's mean square.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from ..lines.free_centre import AnyCentreLines
from ..lines.stretch import radial_stretch
from ..models.family import AbstractFamily
from ..models.zoom import AbstractPriorZoom, AbstractZoom, with_parameters
from ._motion_start import Path, rotation_vector, shrunk_ray, turned
from ._schur import Rows, Unknowns
from ._structure import Structure
from ._views import CAUCHY, corrected, flattened, product, view_residual
from .energy import line_normal

WRONG_LINE = 3.0
"""Times the noise: the RMS of a line's distances where its loss begins to flatten."""

_PIN = 1e3
"""Weight of what is redundant: log f of one frame beside the common factor is 0."""


class Stage(NamedTuple):
    """How the noise is taken, and when to stop.

    Attributes:
        parameters: standard deviation of each parameter of the zoom model before there is any data.
        centre: of the offset of the centre, half image diagonals.
        readout: of the time from the first row to the last, in frames, beside what is known of it.
        wider: times the noise that the residuals before the stage have: the loss is flat beyond.
        change: a step that moves the residuals by less, in all and in units of the noise, is the last.
            1 is the standard deviation of the estimate along the step.
        damping: of the first step.
        own: standard deviation of a frame's log f beside the common factor, from where the stage begins.
        fresh: 1 if rays begin as means of where their views see them, 0 if as they are.
    """

    parameters: float | Array
    centre: float | Array
    readout: float | Array
    wider: float | Array
    change: float | Array
    damping: float | Array
    own: float | Array
    fresh: float | Array = 0.0


class Noise(NamedTuple):
    """Standard deviations, px, and how many points of lines count as one.

    Attributes:
        points: of a coordinate of a track's points.
        lines: of a line's points across it.
        repeated: points of lines that say no more than one (`_motion_repeated`).
    """

    points: Array
    lines: Array
    repeated: float | Array = 1.0

    def wider(self, factor) -> "Noise":
        """Both standard deviations, times a factor."""
        return Noise(factor * self.points, factor * self.lines, self.repeated)


class Data(eqx.Module):
    """Tracks and lines, as the residuals need them.

    Attributes:
        points: about the centre of the image, px.
        there: which views there are; others pad.
        structure: which track and frame each view belongs to.
        fixed: frames whose rotation is given: the first of each shot, and those that no track sees.
        pinned: the frame whose log f moves by the common factor alone; none where all are known.
        log_focal, log_std: what is known of log f beforehand; infinite standard deviations.
        neighbours: of each frame, the frames before and after it in the same shot, or itself.
        readout: what is known of the readout, and its standard deviation.
        lines: about the centre of the image; None if there are none. `structure` has their frames.
        moments: second moments of the lines' points, as seen.
        unknowns: how many numbers of frames and rays are fitted.
        scale: half the image diagonal, px.
    """

    points: Float[Array, "view 2"]
    there: Bool[Array, "view"]
    structure: Structure
    fixed: Bool[Array, "frame"]
    pinned: Bool[Array, "frame"]
    log_focal: Float[Array, "frame"]
    log_std: Float[Array, "frame"]
    unknowns: Float[Array, ""]
    neighbours: Int[Array, "frame 2"]
    readout: Float[Array, "2"]
    lines: AnyCentreLines | None
    moments: Float[Array, "line moment 2 2"] | None
    scale: float = eqx.field(static=True)
    size: tuple[int, int] = eqx.field(static=True)


class Speed(NamedTuple):
    """Of log f and of the rotation vector, a column each: changes in a frame's time, and those of these."""

    first: Float[Array, "frame 4"]
    second: Float[Array, "frame 4"]

    def over(self, frame: Array, time: Array) -> Float[Array, "4"]:
        """The changes of a frame's log f and rotation in a time, in frames."""
        return time * (self.first[frame] + time / 2 * self.second[frame])


class Model(eqx.Module):
    """A path and a lens.

    Attributes:
        path: of the camera.
        zoom: the zoom model.
        shift: of the centre's offset; None if there is none.
        readout: time from the first row to the last, in frames.
        speed: of log f and of the rotation, by which rows differ. Fixed while a stage lasts.
        family: the distortion model.
    """

    path: Path
    zoom: AbstractZoom
    shift: AbstractZoom | None
    readout: Float[Array, ""]
    speed: "Speed"
    family: AbstractFamily


def speed_of(path: Path, neighbours: Int[Array, "frame 2"]) -> Speed:
    """How a path changes at each frame, from the frames before and after; not where there is none."""
    own = jnp.arange(len(neighbours))

    def change(start, end):
        turn = jax.vmap(lambda a, b: rotation_vector(a @ b.T))(path.rotation[end], path.rotation[start])
        return jnp.concatenate([(path.log_focal[end] - path.log_focal[start])[:, None], turn], axis=1)

    before, after = neighbours.T
    known = jnp.stack([before != own, after != own], axis=1)
    changes = jnp.stack([change(before, own), change(own, after)], axis=1)
    first = jnp.sum(changes, axis=1) / jnp.maximum(jnp.sum(known, axis=1), 1)[:, None]
    second = jnp.where(jnp.all(known, axis=1)[:, None], changes[:, 1] - changes[:, 0], 0)
    return Speed(first, second)


def units_of(data, model, noise):
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
    zooming, turning = model.speed.first[:, 0], model.speed.first[:, 1:]
    moving = jnp.mean((half * zooming) ** 2 + focal**2 * jnp.sum(turning**2, axis=1))
    root = jnp.sqrt(jnp.sum(ones))
    of_lens = noise.points / (half * root)
    of_ray = noise.points / (focal_of_ray * jnp.sqrt(in_ray))
    of_readout = 1 / (1 / data.readout[1] + jnp.sqrt(moving) / 3 * root / noise.points)
    zoom, shift, _, factor = _lens_parameters(model)
    zoom, shift, factor = jax.tree.map(lambda leaf: jnp.full(leaf.shape, of_lens), (zoom, shift, factor))
    return Unknowns(
        noise.points / (lever * jnp.sqrt(jnp.maximum(in_frame, 1))[:, None]),
        jnp.broadcast_to(of_ray[:, None], (structure.tracks, 2)),
        (zoom, shift, of_readout, factor),
    )


def _lens_parameters(model):
    """Those of the zoom model and of the centre's offset, the readout, and the common factor of f."""
    shift = None if model.shift is None else model.shift.parameters
    return model.zoom.parameters, shift, model.readout, jnp.zeros(())


def moved(model, steps):
    """The path and the lens after steps.

    One of them is a common factor of all focal lengths, by which angles shrink. It is redundant, and it is
    the direction that tracks determine worst: along it, the other unknowns change little.
    """
    parameters, offsets, readout, factor = jax.tree.map(jnp.add, _lens_parameters(model), steps.lens)
    path = scaled(model.path, factor)

    def ray(ray, start, step):
        return ray + step @ _tangents(start)

    def rotation(matrix, step):
        return jax.vmap(lambda column: turned(column, step), 1, 1)(matrix)

    rays = jax.vmap(ray)(path.rays, model.path.rays, steps.rays)
    rotations = jax.vmap(rotation)(path.rotation, steps.frames[:, 1:])
    return Model(
        path=Path(path.log_focal + steps.frames[:, 0], rotations, rays),
        zoom=with_parameters(model.zoom, parameters),
        shift=None if model.shift is None else with_parameters(model.shift, offsets),
        readout=readout,
        speed=model.speed,
        family=model.family,
    )


def scaled(path, factor):
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
    """Residuals of all views, px.

    `lever` is how far the entrance pupil is before the axis of rotation, over each point's distance.
    """
    rows = _rows_of_frames(data, model)
    lever = jnp.zeros(data.structure.tracks) if lever is None else lever

    def view(point, frame, track):
        log_focal, coefficients, turning = rows.at(frame, point)
        ahead = turned(product(model.path.rotation[frame], model.path.rays[track]), turning)
        ahead = ahead.at[2].add(-lever[track])
        camera = jnp.exp(log_focal), coefficients, rows.offset[frame]
        return view_residual(point, *camera, ahead, model.family, data.scale)

    views = jax.vmap(view)(data.points, data.structure.frame, data.structure.track)
    return jnp.where(data.there[:, None], views, 0)


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
        seen = corrected(point, coefficients, offset, model.family, data.scale)
        across = jnp.append(normal, -normal @ seen / jnp.exp(model.path.log_focal[frame]))
        return product(model.path.rotation[frame].T, across / jnp.linalg.norm(across))

    return jax.vmap(plane)(middle, _corrected_lines(data, model, rows)[0], frame)


def _corrected_lines(data, model, rows):
    """Rows with the scatter of each line's corrected points, px, and the powers that correct it."""
    far = (jnp.asarray(data.size) - 1) / 2 / data.scale
    expand = jax.vmap(lambda k: jnp.asarray(model.family.expansion(k, far @ far)[0]))
    frame = data.structure.line_frame
    powers = expand(rows.coefficients[0])[frame]
    return data.lines.corrected(jnp.concatenate([powers, rows.offset[frame]], axis=1)), powers


def weighed(data: Data, noise: Noise, rows: Float[Array, "line row"]) -> Float[Array, "line row"]:
    """Each line's rows in units of the noise, times the root of its weight."""
    rows = rows / (noise.lines * jnp.sqrt(noise.repeated))
    weight = None if data.lines is None else data.lines.weight
    return rows if weight is None else jnp.sqrt(weight)[:, None] * rows


def averaged(data: Data, model: Model) -> Float[Array, "track 3"]:
    """Each ray as the mean of the directions in which its views see it: a start, and near the best."""
    rows = _rows_of_frames(data, model)

    def direction(point, frame):
        log_focal, coefficients, turning = rows.at(frame, point)
        straight = corrected(point, coefficients, rows.offset[frame], model.family, data.scale)
        ahead = turned(jnp.concatenate([straight / jnp.exp(log_focal), jnp.ones(1)]), -turning)
        return product(model.path.rotation[frame].T, ahead) / jnp.linalg.norm(ahead)

    seen = jax.vmap(direction)(data.points, data.structure.frame)
    rays = jax.ops.segment_sum(seen, data.structure.track, data.structure.tracks)
    length = jnp.linalg.norm(rays, axis=1, keepdims=True)
    return jnp.where(length > 0, rays / jnp.where(length > 0, length, 1), jnp.array([0.0, 0.0, 1.0]))


def rows_of(unknowns: Unknowns, args: tuple[Data, Model, Noise, Stage]) -> Rows:
    """All residuals, robust, in units of the noise; `unknowns` are steps in their `units_of`."""
    data, model, noise, stage = args
    steps = jax.tree.map(jnp.multiply, unknowns, units_of(data, model, noise))
    there = moved(model, steps)
    views = residuals_of(data, there) / noise.points
    lines = line_residuals_of(data, there)
    squared = jnp.sum(views**2, axis=-1) / CAUCHY**2
    of_lines = jnp.nan_to_num(line_squares_of(data, lines)) / (noise.lines * WRONG_LINE) ** 2
    return Rows(
        views * flattened(squared)[:, None],
        weighed(data, noise, lines * flattened(of_lines)[:, None]),
        about_frames(data, there.path, unknowns, steps, stage),
        about_lens(data, there, unknowns, stage),
    )


def about_frames(data, path, unknowns, steps, stage):
    """What is known of frames: the first is the origin, and focal lengths may be given."""
    known = (path.log_focal - data.log_focal) / data.log_std
    own = jnp.where(data.pinned, _PIN * unknowns.frames[:, 0], steps.frames[:, 0] / stage.own)
    log_focal = jnp.where(jnp.isinf(data.log_std), own, known)
    return jnp.concatenate([log_focal[:, None], data.fixed[:, None] * unknowns.frames[:, 1:]], axis=1)


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
