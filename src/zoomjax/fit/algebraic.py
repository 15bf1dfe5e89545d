"""The algebraic estimate: coefficients without iterations, as a start for fits or for use on its own.

For a straight line the 2 x 2 scatter of the corrected points has a zero eigenvalue, so its determinant
vanishes (Alvarez, Gómez and Sendra 2009, [9] of the paper). By Lagrange's identity the determinant is a
sum of squares, of the areas ``x_p y_q - x_q y_p`` spanned by pairs of points about their mean; to first
order each area is linear in the coefficients, and the minimiser is a linear least-squares solution.
Divided by the line's length squared the determinant is the squared distance to the line, so that the
weights of eq. 13 apply. It is computed on compressed lines, whose D - 1 rows have the same determinant
as the thousands of points. Under a distortion model that is not linear in its coefficients the rows, too,
are taken to first order in them.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core.arguments import kinds_checked
from .._core.programs import program
from ..lines.base import AbstractLines
from ..lines.buckets import bucketed, bucketed_frames, of_frames
from ..lines.compressed import CompressedLines
from ..models.lens import ZoomLens
from ..models.model import Model
from ..models.polynomial import RadialPolynomial
from ..models.zoom import AbstractLinearZoom, PolynomialZoom, with_parameters
from ._linear import least_squares
from .compression import compressed, small_of
from .energy import line_weights, prior_jacobian, prior_residuals, settings
from .prepare import asked_for, ready_model
from .result import lens_of


def algebraic_start(lines: AbstractLines, model: Model) -> CompressedLines | None:
    """What the algebraic estimate is made from; None for a model that has none."""
    if not (
        isinstance(model.zoom, AbstractLinearZoom) and isinstance(model.distortion_model, RadialPolynomial)
    ):
        return None
    return compressed(lines, model.terms)


def algebraic_parameters(lines: AbstractLines, model: Model) -> Float[Array, "basis size"]:
    """The parameters of a prepared model, linear in them, that the algebraic estimate gives."""
    zoom: Any = model.zoom
    terms, size = model.terms, model.num_coefficients
    rows = _triangle_rows(lines, terms) if isinstance(lines, CompressedLines) else _rows(lines, size)
    areas = jax.vmap(_areas)(*rows)  # (line, area, 1 + size)
    areas = lines.scale * jnp.sqrt(line_weights(lines))[:, None, None] * areas
    basis = jax.vmap(zoom.basis)(*settings(zoom, lines))[lines.frame]  # (line, basis)
    columns = jnp.einsum("lat,lb->labt", areas[..., 1:], basis)
    unknowns = basis.shape[1] * size
    nothing = with_parameters(zoom, jnp.zeros((basis.shape[1], size), basis.dtype))
    matrix = jnp.concatenate([columns.reshape(-1, unknowns), prior_jacobian(lines, nothing)])
    of_prior = prior_residuals(lines, nothing)
    known = [areas[..., 0].reshape(-1), *([] if of_prior is None else [of_prior])]
    right = -jnp.concatenate(known)
    # Lines through the centre do not change the areas, px, whatever the coefficients: those stay zero.
    solution = least_squares(matrix, right, floor=lines.scale)
    return solution.reshape(basis.shape[1], size)


def _triangle_rows(lines, terms):
    """x and y of each line's rows, (line, row, 1 + terms): without distortion, and what k1, ..., kN add."""
    rows = lines.triangle[:, 1:, 1 : 3 + 2 * terms]
    rows = rows.reshape(*rows.shape[:2], terms + 1, 2)
    return rows[..., 0], rows[..., 1]


def _rows(lines, size):
    """The same of any distortion model, to first order in its coefficients."""
    none = jnp.zeros((lines.focal.shape[0], size), jnp.asarray(lines.focal).dtype)

    def along(direction):
        return jax.jvp(lines.corrected, (none,), (jnp.broadcast_to(direction[None], none.shape),))

    straight, added = jax.vmap(along, out_axes=(None, -1))(jnp.eye(size, dtype=none.dtype))
    rows = jnp.concatenate([straight[..., None], added], axis=-1) / lines.scale
    return rows[:, :, 0], rows[:, :, 1]


def _areas(x, y):
    """For one line the area of each pair of rows, constant and linear in k, over the line's length."""
    first, second = np.triu_indices(x.shape[0], 1)
    # Order 0 with order j, both ways round: the derivative of the area with respect to k_j.
    linear = (
        x[first, :1] * y[second] - x[second, :1] * y[first]
        + x[first] * y[second, :1] - x[second] * y[first, :1]
    )  # fmt: skip
    areas = jnp.concatenate([linear[:, :1] / 2, linear[:, 1:]], axis=1)
    squared_length = jnp.sum(x[:, 0] ** 2 + y[:, 0] ** 2)
    return areas / jnp.sqrt(jnp.where(squared_length > 0, squared_length, 1))


@kinds_checked
def algebraic_zoom(
    lines: AbstractLines, *, zoom: AbstractLinearZoom | None = None, terms: int | None = None
) -> ZoomLens:
    """Estimate a zoom lens algebraically, without iterations.

    Args:
        lines: the lines, or their compressed form; for another distortion model `compress_for` makes it.
        zoom: a model that is linear in its parameters; `PolynomialZoom` of degree 2 by default. It is made
            ready anew: of a fitted one only the settings and the number of coefficients count.
        terms: the number N of coefficients: by default 2, or as many as a `zoom` with parameters has.

    References:
        L. Alvarez, L. Gómez, J. R. Sendra, "An algebraic approach to lens distortion by line
        rectification", J. Math. Imaging Vis. 35 (2009): [9] of the paper.
    """
    _, asked = asked_for(lines, zoom, terms)
    model = ready_model(lines, asked.with_parameters(None))
    return _solve_zoom(small_of(bucketed(lines), model.terms), model)


def algebraic_model(lines: AbstractLines, model: Model) -> Model:
    """A prepared model, linear in its parameters, with those of the algebraic estimate."""
    return model.with_zoom(_solve_zoom(small_of(lines, model.terms), model).zoom)


@kinds_checked
def algebraic_frames(lines: AbstractLines, *, terms: int = 2) -> Float[Array, "frame terms"]:
    """Estimate the normalised coefficients of each frame separately; lines as of `algebraic_zoom`."""
    model = Model(PolynomialZoom(degree=0), terms, lines.distortion_model)
    padded, frames = bucketed_frames(lines)
    return of_frames(_solve_frames(small_of(padded, model.terms), frames, model), lines)


@program
def _solve_zoom(lines, model):
    return lens_of(lines, with_parameters(model.zoom, algebraic_parameters(lines, model)))


@program
def _solve_frames(lines, frames, model):
    def solve(chosen, present):
        frame = lines.take(chosen, present)
        return algebraic_parameters(frame, ready_model(frame, model))[0]

    return jax.vmap(solve)(frames.chosen, frames.present)
