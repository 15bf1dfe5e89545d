"""The algebraic estimate: coefficients without iterations, as a start for fits or for use on its own.

For a straight line the 2 x 2 scatter of the corrected points has a zero eigenvalue, so its determinant
vanishes (Alvarez, Gómez and Sendra 2009, [9] of the paper). By Lagrange's identity the determinant is a
sum of squares, of the areas ``x_p y_q - x_q y_p`` spanned by pairs of points about their mean; to first
order each area is linear in the coefficients, and the minimiser is a linear least-squares solution.
Divided by the line's length squared the determinant is the squared distance to the line, so that the
weights of eq. 13 apply. It is computed on compressed lines, whose D - 1 rows have the same determinant
as the thousands of points.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core.arguments import kinds_checked
from .._core.checks import checked_terms
from ..lines.base import AbstractLines
from ..lines.compressed import CompressedLines, compress
from ..lines.lines import Lines
from ..models.lens import ZoomLens
from ..models.zoom import AbstractLinearZoom, PolynomialZoom, with_parameters
from ._linear import least_squares
from .energy import line_weights, prior_jacobian, settings
from .image_metric import ImageLines
from .result import lens_of


def compressed(lines: AbstractLines, terms: int) -> CompressedLines:
    """The lines, compressed unless they are already.

    For lines measured in the image (`in_image`), the lines underneath.
    """
    if isinstance(lines, ImageLines):
        lines = lines.as_weighted()
    if isinstance(lines, CompressedLines):
        lines.check_terms(terms)
        return lines
    if isinstance(lines, Lines):
        return compress(lines, terms)
    raise TypeError(
        f"Lines of type {type(lines).__name__} cannot be used here: pass Lines or compress(lines); after "
        "compress_any_centre(lines), pass .about(centre)."
    )


def algebraic_parameters(
    lines: CompressedLines, zoom: AbstractLinearZoom, terms: int
) -> Float[Array, "basis terms"]:
    """The parameters of a prepared linear zoom model that the algebraic estimate gives."""
    areas = jax.vmap(_areas, in_axes=(0, None))(lines.triangle, terms)  # (line, area, 1 + terms)
    areas = lines.scale * jnp.sqrt(line_weights(lines))[:, None, None] * areas
    basis = jax.vmap(zoom.basis)(*settings(zoom, lines))[lines.frame]  # (line, basis)
    columns = jnp.einsum("lat,lb->labt", areas[..., 1:], basis)
    unknowns = basis.shape[1] * terms
    prior = prior_jacobian(lines, with_parameters(zoom, jnp.zeros((basis.shape[1], terms), basis.dtype)))
    matrix = jnp.concatenate([columns.reshape(-1, unknowns), prior])
    right = jnp.concatenate([-areas[..., 0].reshape(-1), jnp.zeros(prior.shape[0], basis.dtype)])
    # Lines through the centre do not change the areas, px, whatever the coefficients: those stay zero.
    solution = least_squares(matrix, right, floor=lines.scale)
    return solution.reshape(basis.shape[1], terms)


def _areas(triangle, terms):
    """For one line the area of each pair of rows, constant and linear in k, over the line's length."""
    rows = triangle[1:, 1 : 3 + 2 * terms].reshape(-1, terms + 1, 2)
    x, y = rows[..., 0], rows[..., 1]
    first, second = np.triu_indices(triangle.shape[0] - 1, 1)
    # Order 0 with order j, both ways round: the derivative of the area with respect to k_j.
    linear = (
        x[first, :1] * y[second] - x[second, :1] * y[first]
        + x[first] * y[second, :1] - x[second] * y[first, :1]
    )  # fmt: skip
    areas = jnp.concatenate([linear[:, :1] / 2, linear[:, 1:]], axis=1)
    squared_length = jnp.sum(rows[:, 0] ** 2)
    return areas / jnp.sqrt(jnp.where(squared_length > 0, squared_length, 1))


@kinds_checked
def algebraic_zoom(
    lines: AbstractLines, *, zoom: AbstractLinearZoom | None = None, terms: int = 2
) -> ZoomLens:
    """Estimate a zoom lens algebraically, without iterations.

    Args:
        lines: the lines, or their compressed form.
        zoom: a model that is linear in its parameters; `PolynomialZoom` of degree 2 by default.
        terms: the number N of coefficients.

    References:
        L. Alvarez, L. Gómez, J. R. Sendra, "An algebraic approach to lens distortion by line
        rectification", J. Math. Imaging Vis. 35 (2009): [9] of the paper.
    """
    model = PolynomialZoom() if zoom is None else zoom
    terms = checked_terms(terms, lines.family.most_terms)
    focal, *focus = settings(model, lines)
    prepared = model.prepare(focal, terms, *focus)
    return _solve_zoom(compressed(lines, terms), prepared, terms)


@kinds_checked
def algebraic_frames(lines: AbstractLines, *, terms: int = 2) -> Float[Array, "frame terms"]:
    """Estimate the normalised coefficients of each frame separately, without iterations."""
    terms = checked_terms(terms, lines.family.most_terms)
    return _solve_frames(compressed(lines, terms), *lines.by_frame(), terms)


@eqx.filter_jit
def _solve_zoom(lines, zoom, terms):
    parameters = algebraic_parameters(lines, zoom, terms)
    return lens_of(lines, with_parameters(zoom, parameters))


@eqx.filter_jit
def _solve_frames(lines, chosen, present, terms):
    def solve(chosen, present):
        frame = lines.take(chosen, present)
        constant = PolynomialZoom(degree=0).prepare(frame.focal, terms)
        return algebraic_parameters(frame, constant, terms)[0]

    return jax.vmap(solve)(chosen, present)
