"""Folds: which lines are left out together, and the weight of each line."""

from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float

from .._core.checks import checked_integer
from ..fit.compression import compressed
from ..fit.own_weights import own_weights
from ..fit.problem import Problem
from ..lines.base import AbstractLines
from ..lines.compressed import CompressedLines

HoldOut = Literal["focal", "frame", "line"]

_MOST_FOLDS = 50  # of focal lengths or frames, one each as long as there are no more
_LINE_FOLDS = 10


class Folds(NamedTuple):
    """What is left out together.

    Attributes:
        fold: of each line, from 0; -1 for lines that are never left out, as those that weigh nothing.
        unit: of each line, the focal length, frame or line it stands for; -1 as before.
        number: of folds.
        hold_out: what a unit is.
        weight: of each line, 0 for those that do not count.
        share: of each line in the energy of eq. 13: see `shares`.
    """

    fold: np.ndarray
    unit: np.ndarray
    number: int
    hold_out: HoldOut
    weight: np.ndarray
    share: np.ndarray


class LineErrors(NamedTuple):
    """The errors of a model on the lines of `Folds`.

    Attributes:
        seen: mean squared distance of each line, px^2, under the fit of all lines.
        unseen: the same under the fit that has not seen it. NaN where there is none.
        parameters: how many numbers the model has to follow the lines; those that a prior holds count
            as parts, ``tr (H + P)^-1 H``.
        problem: why there are NaNs, or nothing.
    """

    seen: np.ndarray
    unseen: np.ndarray
    parameters: float
    problem: str


def small_lines(lines: AbstractLines, terms: int) -> CompressedLines:
    """The lines compressed, for so many terms.

    Raises:
        TypeError: they are no lines, or have a distortion model or a metric of their own.
        ValueError: they are compressed already, for fewer terms; a point is not finite; or no line counts.
    """
    if isinstance(lines, Problem):
        raise TypeError(
            "Argument lines has a distortion model of its own, and here each candidate has one: pass the "
            "lines without with_distortion_model, and Model(zoom, terms, distortion_model)."
        )
    if not isinstance(lines, AbstractLines):
        raise TypeError(
            "Argument lines must be Lines (see Lines.from_ragged) or compress(lines), but its type is "
            f"{type(lines).__name__}."
        )
    small = compressed(lines, terms)
    if not np.isfinite(small.triangle).all():
        raise ValueError("Argument lines must hold finite points, but it holds NaN or infinite ones.")
    if not own_weights(small).any():
        raise ValueError(
            "Argument lines must have a usable line, but all have a weight of 0 or too few points."
        )
    return small


def folds_of(lines: AbstractLines, hold_out: HoldOut | None, folds: int | None, seed: int) -> Folds:
    """The parts of the lines that are left out in turn; see `select_model`.

    Raises:
        ValueError: the way of holding out is none, or there are too few focal lengths, frames or lines.
    """
    if hold_out not in (None, *get_args(HoldOut)):
        raise ValueError(f'Argument hold_out must be "focal", "frame" or "line", but it is {hold_out!r}.')
    frame, focal, weight = np.asarray(lines.frame), np.asarray(lines.focal), own_weights(lines)
    counted, share = weight > 0, _shares(frame, weight, len(focal))
    there = np.unique(frame[counted])
    distinct = np.unique(focal[there])
    if hold_out is None:
        hold_out = "focal" if len(distinct) > 3 else "line"
    rng = np.random.default_rng(checked_integer("seed", seed, 0))
    most = _LINE_FOLDS if hold_out == "line" else _MOST_FOLDS
    most = most if folds is None else checked_integer("folds", folds, 2)
    if hold_out == "line":
        # Every frame's lines over all folds, as evenly as can be.
        lines_there = np.flatnonzero(counted)
        order = lines_there[np.lexsort([rng.random(len(lines_there)), frame[counted]])]
        fold = np.full(len(frame), -1)
        fold[order] = np.arange(len(order)) % most
        unit = np.where(counted, np.arange(len(frame)), -1)
        return Folds(fold, unit, most, hold_out, weight, share)
    if hold_out == "frame":
        number, needed = len(there), "two or more frames"
        place = np.full(len(focal), -1)
        place[there[np.argsort(focal[there], kind="stable")]] = np.arange(number)  # however numbered
        place = place[frame]
    else:
        number, needed = (
            len(distinct) - 2,
            "4 or more distinct focal lengths, as both ends are never left out",
        )
        place = np.searchsorted(distinct, focal[frame]) - 1
    group = np.where(counted & (place >= 0) & (place < number), place, -1)
    if number < 2:
        raise ValueError(
            f'Argument hold_out is "{hold_out}", which needs {needed}; there are fewer. Use '
            'hold_out="line", or add images at other focal lengths.'
        )
    parts = min(most, number)
    fold = np.arange(number) if parts == number else rng.permutation(number) % parts
    fold = np.where(group >= 0, fold[group], -1)
    return Folds(fold, group, parts, hold_out, weight, share)


def shares(lines: AbstractLines) -> Float[np.ndarray, "line"]:
    """The part of each line in the energy of eq. 13: every frame that counts weighs the same."""
    return _shares(np.asarray(lines.frame), own_weights(lines), len(lines.focal))


def _shares(frame, own, frames):
    total = np.bincount(frame, own, minlength=frames)
    return own / (np.where(total > 0, total, 1) * max(np.sum(total > 0), 1))[frame]


def focals_there(lines: AbstractLines) -> Float[np.ndarray, "some"]:
    """The distinct focal lengths of frames of which a line counts."""
    counted = own_weights(lines) > 0
    return np.unique(np.asarray(lines.focal)[np.asarray(lines.frame)[counted]])
