"""What `fit_boards` minimises: residuals of corners in the image, and what is known beforehand.

The unknowns are the pose of each photo and how its board bends beside its shape, the shape of each board
(`_board_shape`), log f of each zoom, the zoom model, and the centre of distortion. Corner X is ahead of
photo p as ``R_p X + t_p``; its residual is that of `_views`, in the image, with a Cauchy loss. Lengths are
half the board's longer side.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from ..models.distortion_model import AbstractDistortionModel
from ..models.zoom import AbstractPriorZoom, AbstractZoom, with_parameters
from ._board_schur import Rows, Unknowns
from ._board_shape import Basis, shape_of
from ._motion_start import turned
from ._views import flattened, product, view_residual

LOSS = 7.0
"""Of the noise: where the loss begins to flatten. Boards that bend a little from photo to photo leave more
than the noise: a photo is not to lose its weight for that, and a corner that is mistaken is."""

_PIN = 1e4
"""Weight of what is held: the log f of zooms without photos, as of padding, and a centre that is given."""


class Data(eqx.Module):
    """Grids, as the residuals need them.

    Attributes:
        points: about the centre that is given, or that of the image, px; 0 where there is none.
        there: which corners are seen.
        zoom, board: of each photo, the number of its zoom, and that of its board.
        members: of each board, its photos; padded with numbers that no photo has.
        places: of the corners on a flat board.
        basis: of its shape, and of what photos have beside it.
        smooth: rows of what makes log f a smooth curve in the label of the zooms, 0 without; and what they
            are for a focal length a zoom that is not there.
        zooms: how many of them there are; others pad.
        centre_std: standard deviation of the centre, half image diagonals, before there is any data.
        scale: half the image diagonal, px.
    """

    points: Float[Array, "photo corner 2"]
    there: Bool[Array, "photo corner"]
    zoom: Int[Array, "photo"]
    board: Int[Array, "photo"]
    members: Int[Array, "board member"]
    places: Float[Array, "corner 2"]
    basis: Basis
    smooth: Float[Array, "zoom zoom"]
    zooms: Int[Array, ""]
    centre_std: Float[Array, ""]
    scale: float = eqx.field(static=True)


class Model(eqx.Module):
    """Poses, the board and the lens.

    Attributes:
        rotation, position: of the board in each photo's camera.
        bend: coefficients of how it bends in each photo beside its shape.
        shape: coefficients of each board's shape.
        log_focal: of each zoom.
        zoom: the zoom model.
        offset: of the centre, half image diagonals.
        distortion_model: the distortion model.
    """

    rotation: Float[Array, "photo 3 3"]
    position: Float[Array, "photo 3"]
    bend: Float[Array, "photo own"]
    shape: Float[Array, "board function"]
    log_focal: Float[Array, "zoom"]
    zoom: AbstractZoom
    offset: Float[Array, "2"]
    distortion_model: AbstractDistortionModel


class Stage(NamedTuple):
    """How the noise is taken, and when to stop.

    Attributes:
        noise: standard deviation of a corner's coordinate, px.
        shape: standard deviation of the shape's coefficients before there is any data: 1, or less.
        bend: the same of what photos have beside it, half longer sides.
        free: 1, or 0 where lens and shape are held.
        change: a step that moves the residuals by less, in all and in units of the noise, is the last.
        damping: of the first step.
    """

    noise: float | Array
    shape: float | Array
    bend: float | Array
    free: float | Array
    change: float | Array
    damping: float | Array


def units_of(data: Data, model: Model, noise: Array) -> Unknowns:
    """How much of each unknown moves all corners that it belongs to by about the noise.

    Damping then treats a rotation, a focal length and a coefficient alike.
    """
    in_photo = jnp.maximum(jnp.sum(data.there, axis=1), 1)
    in_zoom = jnp.zeros(len(model.log_focal)).at[data.zoom].add(1.0 * in_photo)
    focal, half = jnp.exp(model.log_focal)[data.zoom], data.scale / 2
    of_photo = noise / jnp.sqrt(in_photo)
    across, along = of_photo / focal, of_photo / half
    poses = jnp.stack([across, across, along, across, across, along], axis=1)
    bends = jnp.broadcast_to((of_photo / half)[:, None], model.bend.shape)
    root = jnp.sqrt(jnp.maximum(jnp.sum(in_photo), 1))
    of_lens = noise / (half * root)
    zoom = jax.tree.map(lambda leaf: jnp.full(leaf.shape, of_lens), model.zoom.parameters)
    of_focal = noise / (half * jnp.sqrt(jnp.maximum(in_zoom, 1)))
    lens = (of_focal, zoom, jnp.full(2, of_lens))
    shape = jnp.full(model.shape.shape, jnp.minimum(1, 100 * of_lens))
    poses = jnp.concatenate([poses, bends], axis=1)
    return Unknowns(poses, jnp.ones((len(shape), len(data.places), 3)), shape, lens)


def moved(model: Model, steps: Unknowns) -> Model:
    """Poses, board and lens after steps."""
    log_focal, parameters, offset = steps.lens

    def rotation(matrix, step):
        return jax.vmap(lambda column: turned(column, step), 1, 1)(matrix)

    depth = model.position[:, 2:]
    return Model(
        rotation=jax.vmap(rotation)(model.rotation, steps.poses[:, :3]),
        position=model.position + depth * steps.poses[:, 3:6],
        bend=model.bend + steps.poses[:, 6:],
        shape=model.shape + steps.shape,
        log_focal=model.log_focal + log_focal,
        zoom=with_parameters(model.zoom, jax.tree.map(jnp.add, model.zoom.parameters, parameters)),
        offset=model.offset + offset,
        distortion_model=model.distortion_model,
    )


def residuals_of(
    data: Data, model: Model, points: Float[Array, "board corner 3"] | None = None
) -> Float[Array, "photo corner 2"]:
    """Residuals of all corners, px, with corners displaced by `points` from the board's shape."""
    focal = jnp.exp(model.log_focal)
    coefficients = jnp.asarray(jax.vmap(model.zoom)(focal))
    boards = jax.vmap(shape_of, (None, None, 0))(data.places, data.basis, model.shape)
    boards = boards if points is None else boards + points

    def photo(seen, there, zoom, board, rotation, position, bend):
        places = boards[board].at[:, 2].add(data.basis.own @ bend)

        def corner(point, place):
            ahead = product(rotation, place) + position
            return view_residual(
                point,
                focal[zoom],
                coefficients[zoom],
                model.offset,
                ahead,
                model.distortion_model,
                data.scale,
            )

        return jnp.where(there[:, None], jax.vmap(corner)(seen, places), 0)

    poses = (model.rotation, model.position, model.bend)
    return jax.vmap(photo)(data.points, data.there, data.zoom, data.board, *poses)


def rows_of(unknowns: Unknowns, args: tuple[Data, Model, Stage]) -> Rows:
    """All residuals, robust, in units of the noise; `unknowns` are steps in their `units_of`."""
    data, model, stage = args
    steps = scaled_steps(unknowns, data, model, stage)
    there = moved(model, steps)
    views = residuals_of(data, there, steps.points) / stage.noise
    squared = jnp.sum(views**2, axis=-1) / LOSS**2
    return Rows(views * flattened(squared)[..., None], *known_rows(data, there, stage))


def scaled_steps(unknowns: Unknowns, data: Data, model: Model, stage: Stage) -> Unknowns:
    """Steps from numbers in their `units_of`."""
    steps = jax.tree.map(jnp.multiply, unknowns, units_of(data, model, jnp.asarray(stage.noise)))
    held = jax.tree.map(lambda leaf: stage.free * leaf, (steps.shape, steps.lens))
    return Unknowns(steps.poses, steps.points, *held)


def known_rows(data: Data, model: Model, stage: Stage) -> tuple[Array, Array, Array]:
    """What is known beforehand of photos' own bends, of the shape, and of the lens."""
    seen = jnp.zeros(len(model.log_focal)).at[data.zoom].add(1.0 * jnp.any(data.there, axis=1)) > 0
    held = model.log_focal - jax.lax.stop_gradient(model.log_focal)  # where it is, of one that nobody sees
    rows = [
        data.smooth @ model.log_focal,
        jnp.where(seen, 0, _PIN * held),
        model.offset / data.centre_std,
        ravel_pytree(model.zoom.parameters)[0] * 1e-3,  # so that none is free where nothing tells it
    ]
    if isinstance(model.zoom, AbstractPriorZoom):
        rows.append(model.zoom.standardised())
    return model.bend / stage.bend, model.shape / stage.shape, jnp.concatenate(rows)
