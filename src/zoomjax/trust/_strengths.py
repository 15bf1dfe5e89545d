"""How much stronger or weaker a lens is at single focal lengths than its zoom model has it: `misfit`."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ._frame_scores import Followed, Frames, Passes

_SURE = 1.645
"""Standard deviations below which chance stays in 95 of 100 cases."""

_TINY = np.finfo(float).tiny


def of_focal_lengths(
    passes: Passes,
    k: Float[np.ndarray, "frame coefficients"],
    seen: Frames,
    follows: Followed,
    effects: Float[np.ndarray, "frame coefficients error"],
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
    told = zooms[2] > 0
    if scatter.free < 1 or free < 1 or not scatter.ratio > 0 or told.sum() < 2:
        return np.zeros((terms, terms))
    pull, known, noise = zooms[:, told]
    # What the errors of focal lengths make of the strengths, and what d(f) leaves of that.
    by_errors = np.zeros((2, len(there), effects.shape[2]))
    for whole, of in zip(by_errors, (effects, follows.left), strict=True):
        np.add.at(whole, zoom, np.einsum("mi,mij,mje->me", k[used], seen.matrix[:, :terms, :terms], of))
    by_errors, left = by_errors[:, told] / known[:, None]
    by_noise = scatter.ratio * noise / known**2
    weight = 1 / (by_noise + np.sum(by_errors**2, axis=1))
    strengths = np.column_stack([-pull / known, left])
    squares = weight @ (strengths - np.average(strengths, axis=0, weights=weight)) ** 2
    chance = free * np.mean(weight * by_noise) + squares[1:].sum()
    chance = chance * (1 + _SURE * np.sqrt(2 / free + 2 / scatter.free))
    # The moment estimate of DerSimonian and Laird (1986), of what is beyond chance.
    beyond = max(squares[0] - chance, 0) / max(weight.sum() - (weight @ weight) / weight.sum(), _TINY)
    return beyond * k[used].T @ k[used] / len(used)


class _Scatter(NamedTuple):
    """How much more strengths scatter than independent points would have them; degrees of freedom."""

    ratio: float
    free: int


def _scatter(parts: Float[np.ndarray, "3 part"], group: Int[np.ndarray, "part"]) -> _Scatter:
    """Of pulls (see `of_focal_lengths`), within groups that share a strength."""
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
