"""What each frame says of a zoom model that was fitted to all, and the polynomial that follows it.

The model leaves in each frame a score, half the gradient of the frame's energy (eq. 3) by its coefficients.
A polynomial of higher degree in 1/f takes away what the scores of all frames have in common: see `misfit`.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..fit.compression import compressed_as_measured
from ..fit.image_metric import in_corrected, measured_as
from ..fit.own_weights import own_weights
from ..lines.compressed import CompressedLines
from ..models.polynomial import RadialPolynomial
from ._lanes import Lanes, Pass, lanes_of, passed
from ._linearised import frame_normal_equations
from .folds import small_lines

_DEGREE = 6
"""Of the polynomial added, at most."""

RCOND = 1e-10
"""Of matrices: below it nothing is determined."""

_LEAST = 1e-9
"""Of the mean of squares, by which noise counts at least beside errors of the focal lengths."""

_ROUNDS, _SETTLED = 30, 1e-3
"""In which noise and those errors are told apart, and the change after which they are."""

_TINY = np.finfo(float).tiny


class Frames(NamedTuple):
    """The frames that have lines: score and matrix of each, its number of lines and its focal length."""

    score: Float[np.ndarray, "frame coefficients"]
    matrix: Float[np.ndarray, "frame coefficients coefficients"]
    number: Float[np.ndarray, "frame"]
    focal: Float[np.ndarray, "frame"]
    there: Int[np.ndarray, "frame"]
    """Which frames of the lines they are."""
    noise: float
    """What the square of a score is by chance, in units of its matrix, were lines independent; else 0."""


class Passes(NamedTuple):
    """Lines of the radial polynomial, in NumPy, which compiles nothing; what k gives for each."""

    lanes: Lanes
    at: Pass
    focal: Float[np.ndarray, "frame"]


def passes_of(lines, k) -> Passes:
    """With the next coefficient, if the lines are compressed for it."""
    plain, terms = in_corrected(lines), k.shape[1]
    most = plain.terms if isinstance(plain, CompressedLines) else RadialPolynomial().most_terms
    more = min(terms + 1, max(most, terms))
    small = measured_as(small_lines(plain, more), lines)
    lanes = lanes_of(small, np.zeros(len(small.frame), int), own_weights(small), more)
    return Passes(lanes, passed(lanes, np.pad(k, ((0, 0), (0, more - terms)))), np.asarray(small.focal))


def of_frames(passes: Passes) -> Frames:
    lanes, at, focal = passes
    total = lanes.total(lanes.weight)
    used = np.flatnonzero(total > 0)
    score, matrix = (
        np.moveaxis(lanes.total(lanes.weight / lanes.counts * of) / np.where(total > 0, total, 1), -1, 0)
        for of in (at.gradient, at.matrix)
    )
    number = lanes.total((lanes.weight > 0).astype(float))
    there = lanes.frame[lanes.starts][used]
    return Frames(
        score[used],
        matrix[used],
        number[used],
        focal[there],
        there,
        _noise(passes, matrix[used]),
    )


def _noise(passes: Passes, matrix: Float[np.ndarray, "frame coefficients coefficients"]) -> float:
    """See `Frames`, from the squares of the lines' own scores.

    What the lines of a frame have in common is not taken out. It adds little to so many squares, and with
    it whatever the effects of errors of the focal lengths have beyond first order counts as noise.
    """
    lanes, at, _ = passes
    on = lanes.weight > 0
    _, place = np.unique(lanes.frame[on], return_inverse=True)
    number, every = np.bincount(place), np.bincount(place, lanes.weight[on])
    score = at.gradient[:, on] * lanes.weight[on] / lanes.counts[on] / every[place]
    inverse = np.linalg.pinv(matrix, rcond=RCOND, hermitian=True)[place]
    squares = np.einsum("il,lij,jl->l", score, inverse, score)
    return float(squares @ number[place]) / (len(number) * len(score))


def by_residuals(lines, k, distortion_model):
    """Of any distortion model and metric."""
    small = compressed_as_measured(lines, k.shape[1] - distortion_model.num_coefficients(0))
    score, matrix = frame_normal_equations(small, k)
    number = np.bincount(np.asarray(small.frame), own_weights(small) > 0, minlength=len(k))
    used = np.flatnonzero(number > 0)
    return Frames(score[used], matrix[used], number[used], np.asarray(small.focal)[used], used, 0.0)


class Followed(NamedTuple):
    """The polynomial d(f) of the frames that count.

    Attributes:
        basis: (frame, function of 1/f).
        solve: the inverse of its normal equations.
        added: what it adds to the coefficients: (frame, coefficients).
        squares: what it takes away.
        variance: what a number takes away by chance.
        unknown: what the coefficients are off by errors of the focal lengths, in units of the unknown that
            takes up one of them: what is sought is not sought along these.
        left: the same by errors of one standard deviation each, that of them which d(f) does not take up.
    """

    basis: Float[np.ndarray, "frame functions"]
    solve: Float[np.ndarray, "numbers numbers"]
    added: Float[np.ndarray, "frame coefficients"]
    squares: float
    variance: float
    unknown: Float[np.ndarray, "frame coefficients error"]
    left: Float[np.ndarray, "frame coefficients error"]


def followed(seen: Frames, effects: Float[np.ndarray, "frame coefficients error"]) -> Followed:
    """The polynomial, where errors of the focal lengths have these effects E on the model's coefficients.

    They leave scores G E t, with t of variance 1, beside noise of covariance s^2 G: its inverse, times s^2,
    is ``G^-1 - E (s^2 + E^T G E)^-1 E^T`` by Woodbury's formula.
    """
    terms, size = effects.shape[1], min(_DEGREE + 1, np.unique(seen.focal).size, len(seen.focal) - 3)
    score = seen.number[:, None] * seen.score[:, :terms]
    own = seen.number[:, None, None] * seen.matrix[:, :terms, :terms]
    inverse = 1 / seen.focal
    place = 2 * (inverse - inverse.min()) / max(np.ptp(inverse), _TINY) - 1
    basis = np.polynomial.legendre.legvander(place, size - 1)
    normal = np.einsum("mb,mij,mc->bicj", basis, own, basis).reshape(size * terms, -1)
    pull = -np.einsum("mb,mi->bi", basis, score).reshape(-1)
    inverse_own = np.linalg.pinv(own, rcond=RCOND, hermitian=True)
    squares = np.einsum("mi,mij,mj->", score, inverse_own, score)
    by_effect = own @ effects
    height = np.einsum("mie,mig->eg", effects, by_effect, optimize=True)
    column = np.einsum("mb,mie->bie", basis, by_effect).reshape(size * terms, -1)
    along = np.einsum("mie,mi->e", effects, score)

    free = (len(seen.focal) - size) * terms
    least = max(seen.noise, _LEAST * squares / free, RCOND * np.max(np.diag(height), initial=0), _TINY)
    least = least if effects.size else 0.0

    def solved(variance):
        back = np.linalg.inv(np.linalg.cholesky(height + variance * np.eye(len(height))))
        known, off = column @ back.T, back @ along
        solve = np.linalg.pinv(normal - known @ known.T, rcond=RCOND, hermitian=True)
        less = pull + known @ off
        more = solve @ less
        taken = less @ more
        return back, known, solve, more, taken, max((squares - off @ off - taken) / free, least)

    back, known, solve, more, taken, variance = solved(squares)
    for _ in range(_ROUNDS if effects.size else 0):
        before = variance
        back, known, solve, more, taken, variance = solved(variance)
        if abs(variance - before) <= _SETTLED * before:
            break

    def of_frames(more):
        return np.einsum("mb,bie->mie", basis, more.reshape(size, terms, -1))

    left = effects - of_frames(solve @ (column - known @ (back @ height)))
    return Followed(basis, solve, of_frames(more)[..., 0], taken, variance, effects @ back.T, left)
