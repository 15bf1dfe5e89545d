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
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from .._core.arguments import kinds_checked
from .._core.types import of_known_values
from ..fit.compression import compressed_as_measured
from ..fit.distortion_models import with_distortion_model
from ..fit.energy import frame_coefficients, frame_normal_equations
from ..fit.image_metric import in_corrected, measured_as
from ..fit.moved_centre import for_terms
from ..fit.own_weights import own_weights
from ..fit.problem import data_of
from ..fit.result import ZoomFit
from ..fit.same_camera import check_lines_of, placed_as
from ..lines.base import AbstractLines
from ..lines.compressed import CompressedLines
from ..lines.free_centre import AnyCentreLines
from ..models.polynomial import RadialPolynomial
from ..models.requirements import check
from ._linear_folds import Lanes, Pass, lanes_of, passed
from .folds import small_lines

_FEWEST = 8
"""Frames: with fewer, the misfit cannot be told from errors of single photos, and counts as these."""

_DEGREE = 6
"""Of the polynomial added, at most."""

_LINEAR = 2
"""Numbers that the next coefficient has, and either coordinate of the centre: they are linear in 1/f."""

_SURE = 1.645
"""Standard deviations below which chance stays in 95 of 100 cases."""

_RCOND = 1e-10
"""Of matrices: below it nothing is determined."""

_TINY = np.finfo(float).tiny


@kinds_checked
@of_known_values
def with_misfit(fit: ZoomFit, lines: AbstractLines) -> ZoomFit:
    """Add the misfit of the zoom model to a fit, and so to all bands.

    The covariance of a fit says how uncertain the best model is, not how far the lens is from it. The
    misfit is estimated from what all frames have in common that the model does not follow, and from how
    much more single focal lengths differ from it than lines and photos do.

    Args:
        fit: the fit, with a zoom model of the focal length alone.
        lines: the lines that it was fitted to, with their weights and in their metric. Compressed for more
            terms than the fit has, or not compressed, they also say what the next coefficient would do;
            compressed for any centre, about whichever, what another centre would.

    Returns:
        The fit with `misfit`: a covariance of the normalised coefficients, and of the next one where there
        is one to tell; zero where none is found. None, as before, where fewer than 8 frames have lines.
        With lines for any centre also with `off_centre`.

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
    polynomial = isinstance(lens.distortion_model, RadialPolynomial)
    passes = _passed(placed, k) if polynomial else None
    frames = _by_residuals(placed, k, lens.distortion_model) if passes is None else _of_frames(passes)
    if len(frames.focal) < _FEWEST:
        return fit
    follows = _followed(frames, k.shape[1])
    misfit, off_centre = _common(frames, follows), None
    if passes is not None:
        own = _of_focal_lengths(passes, k, follows)
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


class _Frames(NamedTuple):
    """The frames that have lines: score and matrix of each, its number of lines and its focal length."""

    score: Float[np.ndarray, "frame coefficients"]
    matrix: Float[np.ndarray, "frame coefficients coefficients"]
    number: Float[np.ndarray, "frame"]
    focal: Float[np.ndarray, "frame"]


class _Passes(NamedTuple):
    """Lines of the radial polynomial, in NumPy, which compiles nothing; what k gives for each."""

    lanes: Lanes
    at: Pass
    focal: Float[np.ndarray, "frame"]


def _passed(lines, k) -> _Passes:
    """With the next coefficient, if the lines are compressed for it."""
    plain, terms = in_corrected(lines), k.shape[1]
    most = plain.terms if isinstance(plain, CompressedLines) else RadialPolynomial().most_terms
    more = min(terms + 1, max(most, terms))
    small = measured_as(small_lines(plain, more), lines)
    lanes = lanes_of(small, np.zeros(len(small.frame), int), own_weights(small), more)
    return _Passes(lanes, passed(lanes, np.pad(k, ((0, 0), (0, more - terms)))), np.asarray(small.focal))


def _of_frames(passes: _Passes) -> _Frames:
    lanes, at, focal = passes
    total = lanes.total(lanes.weight)
    used = np.flatnonzero(total > 0)
    score, matrix = (
        np.moveaxis(lanes.total(lanes.weight / lanes.counts * of) / np.where(total > 0, total, 1), -1, 0)
        for of in (at.gradient, at.matrix)
    )
    number = lanes.total((lanes.weight > 0).astype(float))
    return _Frames(score[used], matrix[used], number[used], focal[lanes.frame[lanes.starts]][used])


def _by_residuals(lines, k, distortion_model):
    """Of any distortion model and metric."""
    small = compressed_as_measured(lines, k.shape[1] - distortion_model.num_coefficients(0))
    dtype = jnp.asarray(small.focal).dtype
    score, matrix = map(np.asarray, frame_normal_equations(small, jnp.asarray(k, dtype)))
    number = np.bincount(np.asarray(small.frame), own_weights(small) > 0, minlength=len(k))
    used = np.flatnonzero(number > 0)
    return _Frames(score[used], matrix[used], number[used], np.asarray(small.focal)[used])


class _Followed(NamedTuple):
    """The polynomial d(f) of the frames that count.

    Attributes:
        basis: (frame, function of 1/f).
        solve: the inverse of its normal equations.
        added: what it adds to the coefficients: (frame, coefficients).
        squares: what it takes away.
        variance: what a number takes away by chance.
    """

    basis: Float[np.ndarray, "frame functions"]
    solve: Float[np.ndarray, "numbers numbers"]
    added: Float[np.ndarray, "frame coefficients"]
    squares: float
    variance: float


def _followed(seen: _Frames, terms: int) -> _Followed:
    frames, size = len(seen.focal), min(_DEGREE + 1, np.unique(seen.focal).size, len(seen.focal) - 3)
    score = seen.number[:, None] * seen.score[:, :terms]
    own = seen.number[:, None, None] * seen.matrix[:, :terms, :terms]
    inverse = 1 / seen.focal
    place = 2 * (inverse - inverse.min()) / max(np.ptp(inverse), _TINY) - 1
    basis = np.polynomial.legendre.legvander(place, size - 1)
    normal = np.einsum("mb,mij,mc->bicj", basis, own, basis).reshape(size * terms, -1)
    solve = np.linalg.pinv(normal, rcond=_RCOND, hermitian=True)
    pull = -np.einsum("mb,mi->bi", basis, score).reshape(-1)
    more = solve @ pull
    added = basis @ more.reshape(size, terms)
    left = score + np.einsum("mij,mj->mi", own, added)
    inverse_own = np.linalg.pinv(own, rcond=_RCOND, hermitian=True)
    squares = np.einsum("mi,mij,mj->", left, inverse_own, left)
    return _Followed(basis, solve, added, pull @ more, squares / ((frames - size) * terms))


def _common(seen: _Frames, follows: _Followed) -> Float[np.ndarray, "coefficients coefficients"]:
    """The covariance of what all frames have in common: of the model's terms, and of the next one."""
    frames, terms = follows.added.shape
    kept = _kept(follows.squares, len(follows.solve) * follows.variance)
    misfit = kept * follows.added.T @ follows.added / frames
    if seen.score.shape[1] == terms:
        return misfit
    return np.pad(misfit, (0, 1)) + _lacking(seen, follows, follows.basis[:, :_LINEAR])


def _lacking(
    seen: _Frames, follows: _Followed, own: Float[np.ndarray, "frame functions"]
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
    column = np.einsum("mb,mie,mc->bice", follows.basis, matrix[:, :terms, terms:], own)
    others = -(follows.solve @ column.reshape(len(follows.solve), -1)).reshape(column.shape)
    # What a unit of each number changes: (frame, numbers, function of 1/f, number).
    change = np.zeros((frames, score.shape[1], *column.shape[2:]))
    change[:, :terms] = np.einsum("mb,bice->mice", follows.basis, others)
    for number in range(score.shape[1] - terms):
        change[:, terms + number, :, number] = own
    change = change.reshape(frames, score.shape[1], -1)
    known = np.einsum("mip,mij,mjq->pq", change, matrix, change, optimize=True)
    noise = np.linalg.pinv(known, rcond=_RCOND, hermitian=True)
    pull = -np.einsum("mip,mi->p", change, left)
    step = noise @ pull
    kept = _kept(pull @ step, len(pull) * follows.variance)
    there = kept**2 * np.outer(step, step) + kept * follows.variance * noise
    return np.einsum("mip,pq,mjq->ij", change, there, change, optimize=True) / frames


def _off_centre(fit, lines, k, frames, follows) -> Float[np.ndarray, "both both"]:
    """The covariance of what coefficients and centre are off, since the centre may be elsewhere."""
    lens, dtype = fit.lens, jnp.asarray(lines.focal).dtype
    offset = (np.asarray(lens.centre) - np.asarray(lines.centre)) / lens.scale
    both = np.concatenate([k, np.broadcast_to(offset, (len(k), 2))], axis=1)
    few = for_terms(with_distortion_model(lines, lens.distortion_model), k.shape[1])
    score, matrix = map(np.asarray, frame_normal_equations(few, jnp.asarray(both, dtype)))
    used = np.flatnonzero(np.bincount(np.asarray(lines.frame), own_weights(lines) > 0, minlength=len(k)))
    seen = _Frames(score[used], matrix[used], frames.number, frames.focal)
    first = 0 if fit.joint is None else 1  # a fitted centre is where it is best, in the mean
    return _lacking(seen, follows, follows.basis[:, first:_LINEAR])


def _of_focal_lengths(
    passes: _Passes, k: Float[np.ndarray, "frame coefficients"], follows: _Followed
) -> Float[np.ndarray, "coefficients coefficients"]:
    """The covariance of how much stronger or weaker the lens is at single focal lengths.

    A strength y, as a part of the coefficients, adds ``G k y`` to a line's score, and so ``known y`` to its
    `pull`. Were its points independent, the pull would have the variance `noise`.
    """
    lanes, at, focal = passes
    on, terms = lanes.weight > 0, k.shape[1]
    frame = lanes.frame[on]
    used, place = np.unique(frame, return_inverse=True)
    share = lanes.weight[on] / lanes.counts[on] / np.bincount(place, lanes.weight[on])[place]
    matrix, of = np.moveaxis(at.matrix[:terms, :terms, on], -1, 0), k[frame]
    gradient = at.gradient[:terms, on].T + np.einsum("lij,lj->li", matrix, follows.added[place])
    known = share * np.einsum("li,lij,lj->l", of, matrix, of)
    variance = np.sum(at.squares[on]) / max(np.sum(lanes.counts[on] - 2), 1)
    lines = np.stack([share * np.einsum("li,li->l", of, gradient), known, variance * share * known])
    photos = _sums(lines, place)
    there, zoom = np.unique(focal[used], return_inverse=True)
    zooms = _sums(photos, zoom)
    scatter = max(_scatter(lines, place), _scatter(photos, zoom))
    free = len(there) - follows.basis.shape[1]
    seen = zooms[2] > 0
    if scatter.free < 1 or free < 1 or not scatter.ratio > 0 or seen.sum() < 2:
        return np.zeros((terms, terms))
    pull, known, noise = zooms[:, seen]
    chance = free * (1 + _SURE * np.sqrt(2 / free + 2 / scatter.free))
    # The moment estimate of DerSimonian and Laird (1986), of what is beyond chance.
    weight = known**2 / (scatter.ratio * noise)
    strength = -pull / known
    squares = weight @ (strength - np.average(strength, weights=weight)) ** 2
    beyond = max(squares - chance, 0) / max(weight.sum() - (weight @ weight) / weight.sum(), _TINY)
    return beyond * k[used].T @ k[used] / len(used)


class _Scatter(NamedTuple):
    """How much more strengths scatter than independent points would have them; degrees of freedom."""

    ratio: float
    free: int


def _scatter(parts: Float[np.ndarray, "3 part"], group: Int[np.ndarray, "part"]) -> _Scatter:
    """Of pulls (see `_of_focal_lengths`), within groups that share a strength."""
    whole = _sums(parts, group)
    pull, known, noise = parts
    every = np.where(whole[1] > 0, whole[1], 1)
    left = pull - (whole[0] / every)[group] * known
    share = known / every[group]
    expected = noise * (1 - 2 * share) + share**2 * whole[2][group]
    free = len(group) - len(every)
    return _Scatter(float(np.sum(left**2) / max(np.sum(expected), _TINY)) * (free > 0), free)


def _sums(
    parts: Float[np.ndarray, "3 part"], group: Int[np.ndarray, "part"]
) -> Float[np.ndarray, "3 group"]:
    return np.stack([np.bincount(group, of) for of in parts])


def _kept(found: float, expected: float) -> float:
    """The part of squares that is more than noise."""
    return float(max(1 - expected / found, 0)) if found > 0 else 0.0
