"""The misfit of a zoom model: what the coefficients of the lens are off the model at any focal length.

The model leaves in each frame m a score ``b_m = -G_m (k_m - k(f_m))``, half the gradient of the frame's
energy (eq. 3) by its coefficients, with G_m the Gauss-Newton matrix. What all frames have in common that
the model does not follow is what a polynomial d(f) of higher degree in 1/f adds to it: one Gauss-Newton
step,

    min_d  sum_m v_m (b_m + G_m d(f_m))^T G_m^-1 (b_m + G_m d(f_m)),    v_m the frame's number of lines.

Of its squares W, ``q s^2`` come from noise and from errors of single photos, for q numbers and the variance
s^2 that is left. So the mean of ``d d^T`` over the frames, times ``1 - q s^2 / W`` where that is positive
(James and Stein 1961), is the covariance of the misfit; next to none remains when the model is right.

Beside it a radial polynomial lacks its next coefficient. What one that is linear in 1/f, with the d(f) that
goes with it, takes away of those squares is judged in the same way, and adds its own covariance.
Lines are hardly straighter for it, and it moves points by far more: a polynomial of two coefficients for a
lens of OpenCV's model, whose coefficients bend where ours straighten, is off by ten times as much.
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
from ..fit.image_metric import in_corrected, measured_as
from ..fit.own_weights import own_weights
from ..fit.result import ZoomFit
from ..fit.same_camera import check_lines_of, placed_as
from ..lines.base import AbstractLines
from ..lines.compressed import CompressedLines
from ..models.polynomial import RadialPolynomial
from ..models.requirements import check
from ._linear_folds import lanes_of, passed
from .folds import small_lines

_FEWEST = 8
"""Frames: with fewer, the misfit cannot be told from errors of single photos, and counts as these."""

_DEGREE = 6
"""Of the polynomial added, at most."""

_NEXT = 2
"""Numbers that the next coefficient has: it is linear in 1/f."""


@kinds_checked
@of_known_values
def with_misfit(fit: ZoomFit, lines: AbstractLines) -> ZoomFit:
    """Add the misfit of the zoom model to a fit, and so to all bands.

    The covariance of a fit says how uncertain the best model is, not how far the lens is from it. The
    misfit is estimated from what all frames have in common that the model does not follow.

    Args:
        fit: the fit, with a zoom model of the focal length alone.
        lines: the lines that it was fitted to, with their weights and in their metric. Compressed for more
            terms than the fit has, or not compressed, they also say what the next coefficient would do.

    Returns:
        The fit with `misfit`: a covariance of the normalised coefficients, and of the next one where there
        is one to tell; zero where none is found. None, as before, where fewer than 8 frames have lines.

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
    polynomial = isinstance(lens.family, RadialPolynomial)
    frames = _quickly(placed, k) if polynomial else _by_residuals(placed, k, lens.family)
    if len(frames.focal) < _FEWEST:
        return fit
    misfit = _common(frames, k.shape[1])
    return eqx.tree_at(
        lambda fit: fit.misfit,
        fit,
        jnp.asarray(misfit, fit.covariance.dtype),
        is_leaf=lambda leaf: leaf is None,
    )


class _Frames(NamedTuple):
    """The frames that have lines: score and matrix of each, its number of lines and its focal length."""

    score: Float[np.ndarray, "frame coefficients"]
    matrix: Float[np.ndarray, "frame coefficients coefficients"]
    number: Float[np.ndarray, "frame"]
    focal: Float[np.ndarray, "frame"]


def _quickly(lines, k):
    """Of the radial polynomial, in NumPy, which compiles nothing; with the next coefficient, if known."""
    plain, terms = in_corrected(lines), k.shape[1]
    most = plain.terms if isinstance(plain, CompressedLines) else RadialPolynomial().most_terms
    more = min(terms + 1, max(most, terms))
    small = measured_as(small_lines(plain, more), lines)
    lanes = lanes_of(small, np.zeros(len(small.frame), int), more)
    total = lanes.total(lanes.weight)
    used = np.flatnonzero(total > 0)
    lines_at = passed(lanes, np.pad(k, ((0, 0), (0, more - terms))))
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


def _common(seen: _Frames, terms: int) -> Float[np.ndarray, "coefficients coefficients"]:
    """The covariance of the misfit, of the frames that count: of the model's terms, and of the next one."""
    frames, size = len(seen.focal), min(_DEGREE + 1, np.unique(seen.focal).size, len(seen.focal) - 3)
    score, matrix = seen.number[:, None] * seen.score, seen.number[:, None, None] * seen.matrix
    inverse = 1 / seen.focal
    place = 2 * (inverse - inverse.min()) / max(np.ptp(inverse), np.finfo(float).tiny) - 1
    basis = np.polynomial.legendre.legvander(place, size - 1)
    own = matrix[:, :terms, :terms]
    normal = np.einsum("mb,mij,mc->bicj", basis, own, basis).reshape(size * terms, -1)
    solve = np.linalg.pinv(normal, rcond=1e-10, hermitian=True)
    pull = -np.einsum("mb,mi->bi", basis, score[:, :terms]).reshape(-1)
    more = solve @ pull
    added = basis @ more.reshape(size, terms)
    left = score + np.einsum("mij,mj->mi", matrix[..., :terms], added)
    inverse_own = np.linalg.pinv(own, rcond=1e-10, hermitian=True)
    squares = np.einsum("mi,mij,mj->", left[:, :terms], inverse_own, left[:, :terms])
    variance = squares / ((frames - size) * terms)
    misfit = _kept(pull @ more, size * terms * variance) * added.T @ added / frames
    if score.shape[1] == terms:
        return misfit
    # The next coefficient, and what the others then become: (frame, coefficients, function of 1/f).
    own_basis = basis[:, : min(_NEXT, size)]
    column = np.einsum("mb,mi,mc->bic", basis, matrix[:, :terms, terms], own_basis)
    others = -(solve @ column.reshape(size * terms, -1)).reshape(size, terms, -1)
    change = np.append(np.einsum("mb,bic->mic", basis, others), own_basis[:, None], axis=1)
    known = np.einsum("mc,mi,mid->cd", own_basis, matrix[:, terms], change)
    pull = -own_basis.T @ left[:, terms]
    step = np.linalg.pinv(known, rcond=1e-10, hermitian=True) @ pull
    added = change @ step
    return np.pad(misfit, (0, 1)) + _kept(pull @ step, len(pull) * variance) * added.T @ added / frames


def _kept(found: float, expected: float) -> float:
    """The part of squares that is more than noise."""
    return float(max(1 - expected / found, 0)) if found > 0 else 0.0
