"""The stages of `fit_boards`: from a start to the fit, and what is known about it."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from .._core.arrays import as_jax
from .._core.programs import light_program, program, program_of_steps
from ..models.invertibility import Certificate, certificate_of
from ._board_rows import (
    LOSS,
    Data,
    Model,
    Stage,
    known_rows,
    moved,
    residuals_of,
    rows_of,
    scaled_steps,
    units_of,
)
from ._board_schur import PoseSchur, Rows, Structure, Unknowns, reduced, solved_boards
from ._board_shape import shape_of
from ._normal_solver import damped_solver
from ._views import EXACT, MEDIAN_OF_SIZE
from .covariance import of_clusters
from .result import RESULTS, is_status

_STAGES = (
    (1e-3, 2.0, Stage(0.0, 0.1, 1e-5, 1.0, change=3.0, damping=1e-3)),
    *((0.0, 1.0, Stage(0.0, 1.0, 3e-3, 1.0, change=0.3, damping=1e-6)),) * 5,
)
"""Stages, with the least noise in half image diagonals of the first one's loss, and by how much the loss is
wider than the noise before it. The first one hardly bends the board, and not from photo to photo."""

_LEAST_BEND = 1e-5
"""Standard deviation of photos' own bends from which a board keeps its shape, half longer sides."""

_SAME = 0.7  # of the noise before a stage: one that leaves less was not the last

_FLAT = 1e-9
"""Standard deviation of the coefficients of shape and bends of a board that is flat."""

_MOST_STEPS = 40  # of a stage

_NOTHING = 1e-9  # of what the parameter told best is told: this much is nothing


class Described(NamedTuple):
    """What is known of a fit.

    Attributes:
        covariance: of log f of each zoom, of the zoom model and of the centre.
        shape_std: standard deviation of each corner's place, half longer sides.
        shape: where the corners are.
        missed: residuals, px.
        inlier: which corners count.
        noise: standard deviation of a coordinate, px.
        determined: whether zoom model and centre are.
        certificate: of the lens over the focal lengths.
    """

    covariance: Float[Array, "lens lens"]
    shape_std: Float[Array, "board corner 3"]
    shape: Float[Array, "board corner 3"]
    missed: Float[Array, "photo corner 2"]
    inlier: Array
    noise: Float[Array, ""]
    certificate: Certificate


def in_stages(data: Data, model: Model, *, flat: bool = False) -> tuple[Model, Stage, Any, int]:
    """The fit, its last stage, the solver's status and its steps in all."""
    noise, total, bend = _noise(data, model), 0, None
    result: Any = RESULTS.successful
    stage = _STAGES[0][2]
    for number, (least, wider, stage) in enumerate(_STAGES):
        own = max(wider * float(noise), least * data.scale)
        stage = stage._replace(noise=own, bend=stage.bend if bend is None else bend)
        stage = _arrays(stage._replace(shape=_FLAT, bend=_FLAT) if flat else stage)
        before = noise
        model, noise, result, steps = _solved(data, model, stage)
        total += int(steps)
        if number > 0:
            bend = _bend_of(data, model)
            if is_status(result, RESULTS.successful) and float(noise) > _SAME * float(before):
                break
    last = stage._replace(noise=noise, bend=stage.bend if flat or bend is None else bend)
    return model, last, result, total


def located(data: Data, model: Model, noise: Array, bend: Array) -> tuple[Model, Array]:
    """Poses and own bends of photos, for a lens and a shape that are held, and the residuals, px."""
    noise = as_jax(np.maximum(noise, _noise(data, model)))
    for _ in range(3):
        stage = _arrays(Stage(noise, 1.0, bend, 0.0, change=0.01, damping=1e-6))
        before = noise
        model, noise, _, _ = _solved(data, model, stage)
        if float(noise) > _SAME * float(before):
            break
    return model, _residuals(data, model)


def _arrays(tree):
    """Numbers that the compiled program takes, and is not compiled for, whatever they come from."""
    return jax.tree.map(
        lambda leaf: as_jax(np.asarray(leaf, np.float64)) if eqx.is_inexact_array_like(leaf) else leaf, tree
    )


_residuals = program(residuals_of)


@program
def _noise(data, model):
    return _noise_of(data, residuals_of(data, model))


def _noise_of(data, missed):
    """The noise from the median of the residuals."""
    size = jnp.where(data.there, jnp.linalg.norm(missed, axis=-1), jnp.nan)
    return jnp.maximum(jnp.nan_to_num(jnp.nanmedian(size)) / MEDIAN_OF_SIZE, EXACT)


@program
def _bend_of(data, model):
    """The standard deviation of photos' own bends, from themselves."""
    photos = jnp.any(data.there, axis=1)
    squares = jnp.sum(jnp.where(photos[:, None], model.bend**2, 0))
    return jnp.maximum(jnp.sqrt(squares / (jnp.sum(photos) * model.bend.shape[1])), _LEAST_BEND)


@program_of_steps
def _solved(data, model, stage):
    """Poses, board and lens of least energy, the noise, the solver's status and its steps."""
    units = units_of(data, model, stage.noise)
    linear = PoseSchur(_structure(data, units, stage))
    solution = optx.least_squares(
        rows_of,
        damped_solver(linear, Unknowns, stage.change, stage.damping),
        jax.tree.map(jnp.zeros_like, units),
        args=(data, model, stage),
        max_steps=_MOST_STEPS,
        throw=False,
    )
    model = moved(model, scaled_steps(solution.value, data, model, stage))
    noise = _noise_of(data, residuals_of(data, model))
    steps = jnp.asarray(solution.stats["num_steps"], int)  # of no weak type, which is not kept on disk
    return model, noise, RESULTS.promote(solution.result), steps


@light_program
def described(
    data: Data, model: Model, stage: Stage, centre: Array, size: tuple[int, int], focal_range: Array
) -> Described:
    """Residuals, covariance and certificate of a fit."""
    units = units_of(data, model, jnp.asarray(stage.noise))
    zeros = jax.tree.map(jnp.zeros_like, units)
    missed = residuals_of(data, model)
    squared = jnp.sum(missed**2, axis=-1) / (stage.noise * LOSS) ** 2
    weight = 1 / (1 + squared)  # the derivative of the loss is this times the residual

    def linear(unknowns):
        steps = scaled_steps(unknowns, data, model, stage)
        there = moved(model, steps)
        views = residuals_of(data, there, steps.points) / stage.noise
        return Rows(weight[..., None] * views, *known_rows(data, there, stage))

    rows, jacobian = jax.linearize(linear, zeros)
    # (w J)^T r is the gradient, and w^2 J^T J the mean of its derivative over the directions of residuals.
    rows = rows._replace(views=missed / stage.noise)
    structure = _structure(data, units, stage)
    normal = reduced(jacobian, rows, zeros, structure, jnp.asarray(0.0))
    lens, of_boards = _of_photos(normal, structure, _alone(data, len(normal.lens)))
    own = ravel_pytree(units.lens)[0]
    variance = jax.vmap(structure.basis.variance)(of_boards)
    inlier = data.there & (squared < 9)  # beyond, the loss nearly ignores a corner
    count = 2 * jnp.sum(inlier)
    of_photos = units.poses.shape[1] * jnp.sum(jnp.any(data.there, axis=1))
    unknowns = of_photos + data.zooms + model.shape.size
    free = count / jnp.maximum(count - unknowns, 1)
    return Described(
        covariance=lens * jnp.outer(own, own),
        shape_std=jnp.sqrt(jnp.maximum(variance, 0)),
        shape=jax.vmap(shape_of, (None, None, 0))(data.places, data.basis, model.shape),
        missed=missed,
        inlier=inlier,
        noise=stage.noise * jnp.sqrt(free),
        certificate=certificate_of(
            model.zoom, centre, focal_range, size, distortion_model=model.distortion_model
        ),
    )


def _structure(data, units, stage):
    bend = units.poses[:, None, 6:] * data.basis.own[None]
    return Structure(data.basis.scaled(stage.free * units.shape[0, 0]), bend, data.board, data.members)


def _of_photos(normal, structure, alone):
    """Covariances of the lens and of the shapes: photos err each by itself, their corners together.

    Shapes are eliminated from the matrix and from each photo's score; and then what a photo has `alone`,
    its focal length where no other is of its zoom: the fit leaves it no score in that, which would say that
    nothing is uncertain. What is left is in parameters in which the matrix is the identity, as
    `of_clusters` takes them; how much larger it finds their covariance than that of independent corners
    holds for what photos have alone, too.
    """
    photos, functions = normal.photos, structure.basis.size
    gain = solved_boards(normal.shape, normal.mixed)  # shapes follow the lens by its negative
    matrix = normal.lens - jnp.einsum("bfi,bfj->ij", normal.mixed, gain)
    matrix, own, to_all = _shared(matrix, alone)
    back = jnp.linalg.inv(jnp.linalg.cholesky(matrix)) @ to_all.T
    along = gain[structure.board]
    score = photos.scores[:, functions:] - jnp.einsum("pfi,pf->pi", along, photos.scores[:, :functions])
    moved = jax.vmap(structure.basis.moved)(along)
    moved = (photos.lens - jnp.einsum("pnrk,pnki->pnri", photos.point, moved)) @ back.T

    def white(border):
        return (border[:, :, functions:] - border[:, :, :functions] @ along) @ back.T

    leverage = jnp.einsum("pnri,pnrj->pij", moved, moved)
    leverage = leverage - jnp.einsum("pci,pcj->pij", white(photos.border), white(photos.solved))
    score = score @ back.T
    there = jnp.sum(jnp.any(score != 0, axis=1))
    covariance = of_clusters(score, leverage, leverage, (2.0 * there - 1) * jnp.sum(~alone))
    independent = jnp.trace(jnp.sum(leverage, axis=0))
    size = jnp.maximum(jnp.trace(covariance) / jnp.where(independent > 0, independent, 1), 1)
    # What is known beforehand draws to its mean: by how much, in the mean.
    prior = normal.prior_lens + jnp.einsum("bfi,bf,bfj->ij", gain, normal.prior_shape, gain)
    inverse = back.T @ back + own
    lens = back.T @ covariance @ back + size * own + inverse @ prior @ inverse
    identity = jnp.broadcast_to(jnp.eye(functions), normal.shape.shape)
    shape = solved_boards(normal.shape, identity) * size + gain @ lens[None] @ gain.swapaxes(1, 2)
    return lens, shape


def _alone(data, size):
    """Which parameters of the lens only one photo has: log f of its zoom."""
    photos = jnp.any(data.there, axis=1)
    counts = jnp.zeros(len(data.smooth), int).at[data.zoom].add(photos)
    return jnp.zeros(size, bool).at[: len(counts)].set(counts == 1)


def _shared(matrix, alone):
    """The matrix without what photos have alone, the inverse of their block, and how they follow the rest.

    Of the same size: the matrix is the identity where they were, and the inverse is 0 elsewhere. A photo
    whose corners are all outliers tells nothing: its variance is next to infinite, without harm to others.
    """
    both, size = alone[:, None] & alone[None], jnp.diag(matrix)
    least = jnp.where(alone, _NOTHING * jnp.max(size), 1)
    block = jnp.where(both, matrix, 0) + jnp.diag(least)
    follow = jnp.linalg.solve(block, jnp.where(alone[:, None] & ~alone[None], matrix, 0))
    to_all = jnp.diag(1.0 * ~alone) - follow
    shared = to_all.T @ matrix @ to_all + jnp.diag(1.0 * alone)
    return shared, jnp.where(both, jnp.linalg.inv(block), 0), to_all
