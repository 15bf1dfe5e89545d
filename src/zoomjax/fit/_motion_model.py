"""What `fit_motion` fits: a path, rays and a lens, and the steps by which they change.

The unknowns are log f and the rotation of each frame, a ray of each track, the zoom model, the offset of
the centre of distortion, and the time that the shutter takes from row to row. Where a parallax is seen,
each track has a lever, too: how far the entrance pupil is before the axis of rotation, over the distance.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..lines.free_centre import AnyCentreLines
from ..models.distortion_model import AbstractDistortionModel
from ..models.zoom import AbstractZoom, with_parameters
from ._columns import Unknowns
from ._motion_start import Path, rotation_vector, shrunk_ray, turned
from ._structure import Structure
from ._views import FAR


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
        points: of a coordinate of a track's points, of a view of weight 1.
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
        pinned: the frame whose log f moves by the common factor alone (`pinned`); none where all are known.
        log_focal, log_std: what is known of log f beforehand; infinite standard deviations.
        neighbours: of each frame, the frames before and after it in the same shot, or itself.
        readout: what is known of the readout, and its standard deviation.
        lines: about the centre of the image; None if there are none. `structure` has their frames.
        moments: second moments of the lines' points, as seen.
        unknowns: how many numbers of frames and rays are fitted, by the weights of their views.
        scale: half the image diagonal, px.
        size: (width, height) of the image, px.
        root: root of the weight of each view, above 0, 1 for those that pad; None for equal weights.
        redundant: what each view's ray leaves of its residual's variance, over what it does with equal
            weights; None for these.
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
    root: Float[Array, "view"] | None = None
    redundant: Float[Array, "view"] | None = None

    def counted(self, views: Bool[Array, "view"]) -> Float[Array, "view"]:
        """How much each view counts: its weight, 1 if there are none; 0 for all but these views."""
        return 1.0 * views if self.root is None else jnp.where(views, self.root**2, 0)


def pinned(data: Data, missed: Float[Array, "view 2"], noise: Noise) -> Data:
    """The same, with that frame pinned which most views follow.

    One that does not fit the others would keep its f: to move it by the common factor, all others have to
    move back, and in a long clip that is too dear.

    Args:
        data: tracks and lines.
        missed: residuals of all views, px, times the roots of their weights.
        noise: of those that follow.
    """
    near = jnp.linalg.norm(missed, axis=-1) < FAR * noise.points
    follows = data.counted(data.there & near)
    count = jax.ops.segment_sum(follows, data.structure.frame, len(data.log_focal))
    best = jnp.argmax(jnp.where(jnp.isinf(data.log_std), count, -1))
    only = (jnp.arange(len(count)) == best) & jnp.any(data.pinned)
    return eqx.tree_at(lambda data: data.pinned, data, only)


class Speed(NamedTuple):
    """Of log f and of the rotation vector, a column each: changes in a frame's time, and those of these."""

    first: Float[Array, "frame 4"]
    second: Float[Array, "frame 4"]

    def over(self, frame: Array, time: Array) -> Float[Array, "4"]:
        """The changes of a frame's log f and rotation in a time, in frames."""
        return time * (self.first[frame] + time / 2 * self.second[frame])


class Levers(NamedTuple):
    """How far the entrance pupil is before the axis of rotation, over the distance of each track's point.

    Attributes:
        value: of each track.
        std: standard deviation from track to track, before there is any data.
        mean: what they have in common. It looks like a lens, and no track tells it: a guess.
        mean_std: standard deviation of that guess.
    """

    value: Float[Array, "track"]
    std: Float[Array, ""]
    mean: Float[Array, ""]
    mean_std: Float[Array, ""]


class Model(eqx.Module):
    """A path and a lens.

    Attributes:
        path: of the camera.
        zoom: the zoom model.
        shift: of the centre's offset; None if there is none.
        readout: time from the first row to the last, in frames.
        speed: of log f and of the rotation, by which rows differ. Fixed while a stage lasts.
        distortion_model: the distortion model.
        levers: of the tracks; None if all points are seen as if they were far away.
    """

    path: Path
    zoom: AbstractZoom
    shift: AbstractZoom | None
    readout: Float[Array, ""]
    speed: Speed
    distortion_model: AbstractDistortionModel
    levers: Levers | None = None


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
    ones = data.counted(data.there)
    in_frame = jnp.zeros(len(focal)).at[structure.frame].add(ones)
    in_ray = jax.ops.segment_sum(ones, structure.track, structure.tracks)
    in_ray = jnp.where(in_ray > 0, in_ray, 1)
    focal_of_ray = jax.ops.segment_sum(ones * focal[structure.frame], structure.track, structure.tracks)
    focal_of_ray = jnp.maximum(focal_of_ray / in_ray, 1.0)
    reach = jnp.stack([jnp.full(len(focal), half), focal, focal, jnp.full(len(focal), half)], axis=1)
    zooming, turning = model.speed.first[:, 0], model.speed.first[:, 1:]
    moving = jnp.mean((half * zooming) ** 2 + focal**2 * jnp.sum(turning**2, axis=1))
    root = jnp.sqrt(jnp.sum(ones))
    of_lens = noise.points / (half * root)
    of_ray = noise.points / (focal_of_ray * jnp.sqrt(in_ray))
    of_rays = jnp.broadcast_to(of_ray[:, None], (structure.tracks, 2))
    if model.levers is not None:
        of_lever = 1 / (1 / model.levers.std + half * jnp.sqrt(in_ray) / noise.points)
        of_rays = jnp.concatenate([of_rays, of_lever[:, None]], axis=1)
    of_readout = 1 / (1 / data.readout[1] + jnp.sqrt(moving) / 3 * root / noise.points)
    zoom, shift, _, factor = _lens_parameters(model)
    zoom, shift, factor = jax.tree.map(lambda leaf: jnp.full(leaf.shape, of_lens), (zoom, shift, factor))
    return Unknowns(
        noise.points / (reach * jnp.sqrt(jnp.where(in_frame > 0, in_frame, 1))[:, None]),
        of_rays,
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
    path = scaled(
        model.path, *(jnp.full(len(of), factor) for of in (model.path.log_focal, model.path.rays))
    )

    def ray(ray, start, step):
        return ray + step @ _tangents(start)

    def rotation(matrix, step):
        return jax.vmap(lambda column: turned(column, step), 1, 1)(matrix)

    rays = jax.vmap(ray)(path.rays, model.path.rays, steps.rays[:, :2])
    rotations = jax.vmap(rotation)(path.rotation, steps.frames[:, 1:])
    levers = model.levers
    if levers is not None:
        levers = levers._replace(value=levers.value + steps.rays[:, 2])
    return Model(
        path=Path(path.log_focal + steps.frames[:, 0], rotations, rays),
        zoom=with_parameters(model.zoom, parameters),
        shift=None if model.shift is None else with_parameters(model.shift, offsets),
        readout=readout,
        speed=model.speed,
        distortion_model=model.distortion_model,
        levers=levers,
    )


def scaled(path, factor, of_ray):
    """A path with focal lengths larger by factors, whose logarithms are given, and smaller angles.

    Args:
        path: the path.
        factor: of each frame.
        of_ray: of each track.
    """

    def rotation(matrix, shrunk):
        extra = (shrunk - 1) * rotation_vector(matrix)  # about the same axis
        return jax.vmap(lambda column: turned(column, extra), 1, 1)(matrix)

    rays = jax.vmap(shrunk_ray)(path.rays, jnp.exp(-of_ray))
    return Path(path.log_focal + factor, jax.vmap(rotation)(path.rotation, jnp.exp(-factor)), rays)


def _tangents(ray):
    """Two vectors of length 1 across a ray."""
    helper = jnp.where(jnp.abs(ray[0]) < 0.7, jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 1.0, 0.0]))
    first = jnp.cross(ray, helper)
    first = first / jnp.linalg.norm(first)
    return jnp.stack([first, jnp.cross(ray, first)])
