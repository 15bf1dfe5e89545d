"""The misfit of a zoom model: what the coefficients of the lens are off the model at any focal length.

The model leaves in each frame m a score ``b_m = -G_m (k_m - k(f_m))``, half the gradient of the frame's
energy (eq. 3) by its coefficients, with G_m the Gauss-Newton matrix. What all frames have in common that
the model does not follow is what a polynomial d(f) of higher degree in 1/f adds to it: one Gauss-Newton
step,

    min_d  sum_m v_m (b_m + G_m d(f_m))^T G_m^-1 (b_m + G_m d(f_m)),    v_m the frame's number of lines.

Of its squares W, ``q s^2`` come from noise and from errors of single photos, for q numbers and the variance
s^2 that is left. So the mean of ``d d^T`` over the frames, times ``1 - q s^2 / W`` where that is positive
(James and Stein 1961), is the covariance of the misfit; next to none remains when the model is right.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._core.arguments import kinds_checked
from .._core.types import of_known_values
from ..fit.compression import compressed_as_measured
from ..fit.energy import frame_coefficients, frame_normal_equations
from ..fit.image_metric import ImageLines
from ..fit.result import ZoomFit
from ..fit.same_camera import check_lines_of, placed_as
from ..lines.base import AbstractLines
from ..models.polynomial import RadialPolynomial
from ..models.requirements import check
from ._linear_folds import lanes_of, passed
from .folds import own_weights, small_lines

_FEWEST = 8
"""Frames: with fewer, the misfit cannot be told from errors of single photos, and counts as these."""

_DEGREE = 6
"""Of the polynomial added, at most."""


@kinds_checked
@of_known_values
def with_misfit(fit: ZoomFit, lines: AbstractLines) -> ZoomFit:
    """Add the misfit of the zoom model to a fit, and so to all bands.

    The covariance of a fit says how uncertain the best model is, not how far the lens is from it. The
    misfit is estimated from what all frames have in common that the model does not follow.

    Args:
        fit: the fit, with a zoom model of the focal length alone.
        lines: the lines that it was fitted to, with their weights and in their metric.

    Returns:
        The fit with `misfit`: a covariance of the normalised coefficients, zero where none is found. None,
        as before, where fewer than 8 frames have lines.

    Raises:
        ValueError: the lens depends on the focus; or the lines are not those of the fit: of another image
            size, unit or number of frames.

    Example:
        >>> from zoomjax import PolynomialZoom, compress, fit_zoom, scenes
        >>> focal = scenes.focal_sweep(12)
        >>> lines = compress(scenes.board_lines(scenes.nikkor_18_200(), focal, spacing=99, noise=0.1))
        >>> one, two = (
        ...     with_misfit(fit_zoom(lines, zoom=PolynomialZoom(degree=degree)), lines).misfit.trace()
        ...     for degree in (1, 2)
        ... )
        >>> bool(one > 20 * two)
        True
    """
    check_lines_of(fit, lines)
    lens = fit.lens
    check("with_misfit", zoom=lens.zoom)
    placed = placed_as(lens, lines)
    k = np.asarray(frame_coefficients(placed, lens.zoom), float)
    by_moments = isinstance(lens.family, RadialPolynomial) and not isinstance(placed, ImageLines)
    score, matrix, number, focal = (_quickly if by_moments else _by_residuals)(placed, k, lens.family)
    if len(focal) < _FEWEST:
        return fit
    misfit = _common(score, matrix, number, focal)
    return eqx.tree_at(
        lambda fit: fit.misfit,
        fit,
        jnp.asarray(misfit, fit.covariance.dtype),
        is_leaf=lambda leaf: leaf is None,
    )


class _Frames(NamedTuple):
    """The frames that have lines: score and matrix of each, its number of lines and its focal length."""

    score: Float[np.ndarray, "frame terms"]
    matrix: Float[np.ndarray, "frame terms terms"]
    number: Float[np.ndarray, "frame"]
    focal: Float[np.ndarray, "frame"]


def _quickly(lines, k, family):
    """Of the radial polynomial in the paper's metric, in NumPy: without compiling anything."""
    del family
    small = small_lines(lines, k.shape[1])
    lanes = lanes_of(small, np.zeros(len(small.frame), int), k.shape[1])
    total = lanes.total(lanes.weight)
    used = np.flatnonzero(total > 0)
    lines_at = passed(lanes, k)
    score, matrix = (
        np.moveaxis(lanes.total(lanes.weight / lanes.counts * of) / np.where(total > 0, total, 1), -1, 0)
        for of in (lines_at.gradient, lines_at.matrix)
    )
    number = lanes.total((lanes.weight > 0).astype(float))
    focal = np.asarray(small.focal)[lanes.frame[lanes.starts]]
    return _Frames(score[used], matrix[used], number[used], focal[used])


def _by_residuals(lines, k, family):
    """Of any distortion model and metric."""
    small = compressed_as_measured(lines, k.shape[1] - family.size(0))
    dtype = jnp.asarray(small.focal).dtype
    score, matrix = map(np.asarray, frame_normal_equations(small, jnp.asarray(k, dtype)))
    number = np.bincount(np.asarray(small.frame), own_weights(small) > 0, minlength=len(k))
    used = np.flatnonzero(number > 0)
    return _Frames(score[used], matrix[used], number[used], np.asarray(small.focal)[used])


def _common(
    score: Float[np.ndarray, "frame terms"],
    matrix: Float[np.ndarray, "frame terms terms"],
    number: Float[np.ndarray, "frame"],
    focal: Float[np.ndarray, "frame"],
) -> Float[np.ndarray, "terms terms"]:
    """The covariance of the misfit, of the frames that count."""
    frames, terms = score.shape
    score, matrix = number[:, None] * score, number[:, None, None] * matrix
    size = min(_DEGREE + 1, np.unique(focal).size, frames - 3)
    inverse = 1 / focal
    place = 2 * (inverse - inverse.min()) / max(np.ptp(inverse), np.finfo(float).tiny) - 1
    basis = np.polynomial.legendre.legvander(place, size - 1)
    normal = np.einsum("mb,mij,mc->bicj", basis, matrix, basis).reshape(size * terms, -1)
    pull = -np.einsum("mb,mi->bi", basis, score).reshape(-1)
    more = np.linalg.pinv(normal, rcond=1e-10, hermitian=True) @ pull
    added = basis @ more.reshape(size, terms)
    left = score + np.einsum("mij,mj->mi", matrix, added)
    squares = np.einsum("mi,mij,mj->", left, np.linalg.pinv(matrix, rcond=1e-10, hermitian=True), left)
    variance = squares / ((frames - size) * terms)
    found = pull @ more
    kept = max(1 - size * terms * variance / found, 0) if found > 0 else 0
    return kept * added.T @ added / frames
