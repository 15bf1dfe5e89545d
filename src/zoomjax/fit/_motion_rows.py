"""What `fit_motion` minimises: residuals of views in the image, and what is known beforehand.

The unknowns are log f and the rotation of each frame, a ray of each track, the zoom model, and the offset
of the centre of distortion. A ray X is seen in frame t at ``p = f_t (y1, y2)/y3`` with ``y = R_t X``, and
the point that was observed is corrected to c. The residual in the image is ``J^-1 (c - p)``, where J is the
derivative of the correction at the observed point: one step of Newton's method for the inverse, exact to
second order. Residuals have a Cauchy loss.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from ..models.family import AbstractFamily
from ..models.zoom import AbstractPriorZoom, AbstractZoom, with_parameters
from ._motion_start import Path, rotation_vector, shrunk_ray, turned
from ._schur import Rows, Unknowns
from ._structure import Structure

CAUCHY = 2.3849
"""Of the noise: where the loss begins to flatten; of normal errors it wastes a twentieth."""

_PIN = 1e3
"""Weight of what is redundant: log f of one frame beside the common factor is 0."""


class Stage(NamedTuple):
    """How the noise is taken, and when to stop.

    Attributes:
        parameters: standard deviation of each parameter of the zoom model before there is any data.
        centre: of the offset of the centre, half image diagonals.
        wider: times the noise that the residuals before the stage have: the loss is flat beyond.
        change: a step that moves the residuals by less, in all and in units of the noise, is the last.
            1 is the standard deviation of the estimate along the step.
        damping: of the first step.
        own: standard deviation of a frame's log f beside the common factor, from where the stage begins.
    """

    parameters: float
    centre: float
    wider: float
    change: float
    damping: float
    own: float


class Data(eqx.Module):
    """Tracks, as the residuals need them.

    Attributes:
        points: about the centre of the image, px.
        there: which views there are; others pad.
        structure: which track and frame each view belongs to.
        fixed: frames whose rotation is given: the first of each shot, and those that no track sees.
        pinned: the frame whose log f moves by the common factor alone; none where all are known.
        log_focal, log_std: what is known of log f beforehand; infinite standard deviations.
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
    scale: float = eqx.field(static=True)


class Model(eqx.Module):
    """What the unknowns are measured from: a path, and a lens."""

    path: Path
    zoom: AbstractZoom
    shift: AbstractZoom | None
    family: AbstractFamily


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
    of_lens = noise / (half * jnp.sqrt(jnp.sum(ones)))
    return Unknowns(
        noise / (lever * jnp.sqrt(jnp.maximum(in_frame, 1))[:, None]),
        jnp.broadcast_to((noise / (focal_of_ray * jnp.sqrt(in_ray)))[:, None], (structure.tracks, 2)),
        jax.tree.map(lambda leaf: jnp.full(leaf.shape, of_lens), _lens_parameters(model)),
    )


def _lens_parameters(model):
    """Those of the zoom model and of the centre's offset, and the common factor of focal lengths."""
    return model.zoom.parameters, None if model.shift is None else model.shift.parameters, jnp.zeros(())


def moved(model, steps):
    """The path and the lens after steps.

    One of them is a common factor of all focal lengths, by which angles shrink. It is redundant, and it is
    the direction that tracks determine worst: along it, the other unknowns change little.
    """
    parameters, offsets, factor = jax.tree.map(jnp.add, _lens_parameters(model), steps.lens)
    zoom = with_parameters(model.zoom, parameters)
    shift = None if model.shift is None else with_parameters(model.shift, offsets)
    path = scaled(model.path, factor)

    def ray(ray, start, step):
        return ray + step @ _tangents(start)

    def rotation(matrix, step):
        return jax.vmap(lambda column: turned(column, step), 1, 1)(matrix)

    rays = jax.vmap(ray)(path.rays, model.path.rays, steps.rays)
    rotations = jax.vmap(rotation)(path.rotation, steps.frames[:, 1:])
    return Path(path.log_focal + steps.frames[:, 0], rotations, rays), zoom, shift


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


def residuals_of(data, path, zoom, shift, family):
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


def averaged(data, model):
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


def rows_of(unknowns, args):
    """All residuals, robust, in units of the noise; `unknowns` are steps in their `units_of`."""
    data, model, noise, stage = args
    steps = jax.tree.map(jnp.multiply, unknowns, units_of(data, model, noise))
    path, zoom, shift = moved(model, steps)
    views = residuals_of(data, path, zoom, shift, model.family) / noise
    squared = jnp.sum(views**2, axis=-1, keepdims=True) / CAUCHY**2
    safe = jnp.where(squared > 1e-8, squared, 1.0)
    views = views * jnp.where(squared > 1e-8, jnp.sqrt(jnp.log1p(safe) / safe), 1 - squared / 4)
    return Rows(
        views,
        about_frames(data, path, unknowns, steps, stage),
        about_lens(data, zoom, shift, unknowns, stage),
    )


def about_frames(data, path, unknowns, steps, stage):
    """What is known of frames: the first is the origin, and focal lengths may be given."""
    known = (path.log_focal - data.log_focal) / data.log_std
    own = jnp.where(data.pinned, _PIN * unknowns.frames[:, 0], steps.frames[:, 0] / stage.own)
    log_focal = jnp.where(jnp.isinf(data.log_std), own, known)
    return jnp.concatenate([log_focal[:, None], data.fixed[:, None] * unknowns.frames[:, 1:]], axis=1)


def about_lens(data, zoom, shift, unknowns, prior):
    """The prior of the lens, and that the common factor is 1 where all focal lengths are known."""
    factor = jnp.where(jnp.any(data.pinned), 0, _PIN * unknowns.lens[-1])
    rows = [ravel_pytree(zoom.parameters)[0] / prior.parameters, factor[None]]
    if shift is not None:
        rows.append(ravel_pytree(shift.parameters)[0] / prior.centre)
    if isinstance(zoom, AbstractPriorZoom):
        rows.append(zoom.standardised())
    return jnp.concatenate(rows)
