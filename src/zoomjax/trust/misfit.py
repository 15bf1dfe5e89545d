"""The misfit of a zoom model: what coefficients and centre of the lens are off it at any focal length.

The model leaves in each frame m a score ``b_m = -G_m (k_m - k(f_m))``, half the gradient of the frame's
energy (eq. 3) by its coefficients, with G_m the Gauss-Newton matrix. What all frames have in common that
the model does not follow is what a polynomial d(f) of higher degree in 1/f adds to it: one Gauss-Newton
step,

    min_d  sum_m v_m (b_m + G_m d(f_m))^T G_m^-1 (b_m + G_m d(f_m)),    v_m the frame's number of lines.

Of its squares W, ``q s^2`` come from noise and from errors of single photos, for q numbers and the variance
s^2 that is left. So the mean of ``d d^T`` over the frames, times ``1 - q s^2 / W`` where that is positive
(James and Stein 1961), is the covariance of the misfit; next to none remains when the model is right.

Two more things a lens may have that the model lacks are judged in the same way, each with the d(f) that
goes with it. Where h is that share, and V what noise makes of a step d, ``h^2 d d^T + h V`` is the mean of
the squares of what is really there.

- The *next coefficient*, linear in 1/f. Lines are hardly straighter for it, and it moves points by far
  more: a polynomial of two coefficients for a lens of OpenCV's model, whose coefficients bend where ours
  straighten, is off by ten times as much.
- *Another centre*, linear in 1/f too: of a given centre all of it, of a fitted one that it moves.

Last, a lens may be stronger or weaker at single focal lengths than a smooth curve has it: cameras refocus,
and focal lengths are wrong. That is a variance t^2 of the strength, ``t^2 k(f) k(f)^T``, from the scatter
of the focal lengths' strengths that the scatter of lines within photos, and of photos at one focal length,
does not explain. A band has t in full, where its noise is divided by the number of frames. So t counts only
as far as it exceeds what chance makes of it in 95 of 100 cases.

Known errors of the focal lengths leave scores, too. They are unknowns of known variance beside the noise,
and d(f) is sought by generalised least squares (see `_frame_scores.followed`).
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._core.arguments import kinds_checked
from .._core.types import of_known_values
from ..fit.distortion_models import with_distortion_model
from ..fit.energy import frame_coefficients
from ..fit.focal_lengths import Shared, Sigma, checked_sigma, effects_of_focal
from ..fit.moved_centre import for_terms
from ..fit.own_weights import own_weights
from ..fit.problem import data_of
from ..fit.result import ZoomFit
from ..fit.same_camera import check_lines_of, placed_as
from ..lines.base import AbstractLines
from ..lines.free_centre import AnyCentreLines
from ..models.polynomial import RadialPolynomial
from ..models.requirements import check
from ._frame_scores import RCOND, Followed, Frames, by_residuals, followed, of_frames, passes_of
from ._linearised import frame_normal_equations
from ._strengths import of_focal_lengths

FEWEST = 8
"""Frames: with fewer, the misfit cannot be told from errors of single photos, and counts as these."""

_LINEAR = 2
"""Numbers that the next coefficient has, and either coordinate of the centre: they are linear in 1/f."""


@kinds_checked
@of_known_values
def with_misfit(
    fit: ZoomFit, lines: AbstractLines, *, focal_sigma: Sigma = 0.0, shared: Shared = None
) -> ZoomFit:
    """Add the misfit of the zoom model to a fit, and so to all bands.

    The covariance of a fit says how uncertain the best model is, not how far the lens is from it. The
    misfit is estimated from what all frames have in common that the model does not follow, and from how
    much more single focal lengths differ from it than lines and photos do.

    Args:
        fit: the fit, with a zoom model of the focal length alone.
        lines: the lines that it was fitted to, with their weights and in their metric. Compressed for more
            terms than the fit has, or not compressed, they also say what the next coefficient would do;
            compressed for any centre, about whichever, what another centre would.
        focal_sigma, shared: the errors of the focal lengths that `zoomjax.fit.with_focal_sigma` was told:
            what they explain is no misfit.

    Returns:
        The fit with `misfit`: a covariance of the normalised coefficients, and of the next one where there
        is one to tell; zero where none is found. None, as before, where fewer than 8 frames have lines.
        With lines for any centre also with `off_centre`.

    Raises:
        ValueError: the lens depends on the focus; the lines are not those of the fit: of another image
            size, unit or number of frames; or `focal_sigma` or `shared` are not as there.

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
    polynomial = isinstance(lens.distortion_model, RadialPolynomial)
    passes = passes_of(placed, k) if polynomial else None
    frames = by_residuals(placed, k, lens.distortion_model) if passes is None else of_frames(passes)
    effects = np.zeros((*k.shape, 0))
    if np.any(checked_sigma(focal_sigma, lines.focal)):
        effects = effects_of_focal(fit, placed, focal_sigma, shared)
    if len(frames.focal) < FEWEST:
        return fit
    follows = followed(frames, effects[frames.there])
    misfit, off_centre = _common(frames, follows), None
    if passes is not None:
        own = of_focal_lengths(passes, k, frames, follows, effects[frames.there])
        misfit = misfit + np.pad(own, (0, len(misfit) - len(own)))
    if polynomial and lens.shift is None and isinstance(data_of(lines), AnyCentreLines):
        off_centre = _off_centre(fit, lines, k, frames, follows)
    dtype = fit.covariance.dtype
    return eqx.tree_at(
        lambda fit: (fit.misfit, fit.off_centre),
        fit,
        (jnp.asarray(misfit, dtype), None if off_centre is None else jnp.asarray(off_centre, dtype)),
        is_leaf=lambda leaf: leaf is None,
    )


def _common(seen: Frames, follows: Followed) -> Float[np.ndarray, "coefficients coefficients"]:
    """The covariance of what all frames have in common: of the model's terms, and of the next one."""
    frames, terms = follows.added.shape
    kept = _kept(follows.squares, len(follows.solve) * follows.variance)
    misfit = kept * follows.added.T @ follows.added / frames
    if seen.score.shape[1] == terms:
        return misfit
    return np.pad(misfit, (0, 1)) + _lacking(seen, follows, follows.basis[:, :_LINEAR])


def _lacking(
    seen: Frames, follows: Followed, own: Float[np.ndarray, "frame functions"]
) -> Float[np.ndarray, "numbers numbers"]:
    """The covariance of numbers that the model lacks, and of what its own then become.

    Args:
        seen: the frames, with scores by those numbers after the model's own.
        follows: the polynomial that the model's own numbers follow.
        own: the functions of 1/f of each number.
    """
    frames, terms = follows.added.shape
    if not own.size:
        return np.zeros((seen.score.shape[1],) * 2)
    score, matrix = seen.number[:, None] * seen.score, seen.number[:, None, None] * seen.matrix
    left = score + np.einsum("mij,mj->mi", matrix[..., :terms], follows.added)
    unknown = matrix[..., :terms] @ follows.unknown  # the scores by it
    column = np.einsum("mb,mie,mc->bice", follows.basis, matrix[:, :terms, terms:], own)
    column = column.reshape(len(follows.solve), -1)
    by_basis = np.einsum("mb,mig->big", follows.basis, unknown[:, :terms]).reshape(len(column), -1)
    by_own = np.einsum("mc,meg->ceg", own, unknown[:, terms:]).reshape(column.shape[1], -1)
    others = -follows.solve @ (column - by_basis @ by_own.T)
    # What a unit of each number changes: (frame, numbers, function of 1/f, number).
    more = score.shape[1] - terms
    change = np.zeros((frames, score.shape[1], own.shape[1], more))
    change[:, :terms] = np.einsum(
        "mb,bice->mice", follows.basis, others.reshape(-1, terms, *change.shape[2:])
    )
    for number in range(more):
        change[:, terms + number, :, number] = own
    change = change.reshape(frames, score.shape[1], -1)
    by_change = np.einsum("mip,mig->pg", change, unknown)
    known = np.einsum("mip,mij,mjq->pq", change, matrix, change, optimize=True) - by_change @ by_change.T
    noise = np.linalg.pinv(known, rcond=RCOND, hermitian=True)
    off = np.einsum("mig,mi->g", follows.unknown, left[:, :terms])
    pull = by_change @ off - np.einsum("mip,mi->p", change, left)
    step = noise @ pull
    kept = _kept(pull @ step, len(pull) * follows.variance)
    there = kept**2 * np.outer(step, step) + kept * follows.variance * noise
    return np.einsum("mip,pq,mjq->ij", change, there, change, optimize=True) / frames


def _off_centre(fit, lines, k, frames, follows) -> Float[np.ndarray, "both both"]:
    """The covariance of what coefficients and centre are off, since the centre may be elsewhere."""
    lens = fit.lens
    offset = (np.asarray(lens.centre) - np.asarray(lines.centre)) / lens.scale
    both = np.concatenate([k, np.broadcast_to(offset, (len(k), 2))], axis=1)
    few = for_terms(with_distortion_model(lines, lens.distortion_model), k.shape[1])
    score, matrix = frame_normal_equations(few, both)
    used = np.flatnonzero(np.bincount(np.asarray(lines.frame), own_weights(lines) > 0, minlength=len(k)))
    seen = Frames(score[used], matrix[used], frames.number, frames.focal, used, frames.noise)
    first = 0 if fit.joint is None else 1  # a fitted centre is where it is best, in the mean
    return _lacking(seen, follows, follows.basis[:, first:_LINEAR])


def _kept(found: float, expected: float) -> float:
    """The part of squares that is more than noise."""
    return float(max(1 - expected / found, 0)) if found > 0 else 0.0
