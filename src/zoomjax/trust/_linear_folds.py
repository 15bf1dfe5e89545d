"""Cross-validation of zoom models that are linear in their parameters.

To the energy of eq. 13 a line adds only by way of the coefficients of its frame, so that one pass over the
lines at coefficients ``k_m`` gives each frame's share of the normal equations, N x N numbers, whatever the
zoom model; its own basis then makes ``sum_m B_m^T H_m B_m`` of them. Every fold starts from the fit of
all lines, where few Gauss-Newton steps are enough, and there is no covariance and no certificate. Nothing
is approximated: a fold's model is the one that `fit_zoom` (``invertible=False``) finds on its lines.

Lines measured in the distorted image (`in_image`) have their distances divided by the stretch across the
line, which depends on the coefficients, too: by way of the line's normal as well.

Once: the compression, each model's basis, and a pass over the compressed lines at the fit of all lines, of
which each fold has the matrix of its own. Per fold and step: a pass, in the corrected image for energy and
gradient alone as long as the matrix at the start serves. It is NumPy, float64 whatever the lines' dtype:
with sums as small as these, compiling would take longer than 50 folds of 12 models do.
"""

import collections
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..fit.image_metric import in_corrected
from ..lines.base import AbstractLines
from ..models.model import Model
from ._designs import Design, Designs
from ._lanes import Lanes, as_given, lanes_of, passed, passed_for_gradient
from .folds import Folds, LineErrors

_MOST_STEPS = 40  # of Gauss-Newton: from the fit of all lines it takes 1 to 3, from zero 4 to 8
_MOST_KEPT = 8  # more, by the matrix at the start: such a step costs a third


def linear_errors(lines: AbstractLines, models: Sequence[Model], parts: Folds) -> list[LineErrors | str]:
    """The errors of each model on compressed lines, or why there are none. See `errors_of`."""
    if not models:
        return []
    most, small = max(model.terms for model in models), in_corrected(lines)
    lanes = lanes_of(lines, parts.fold, parts.weight, most)
    folds = np.arange(-1, parts.number)[:, None]  # the first: none is left out
    counts = (lanes.weight > 0) & ((lanes.fold != folds) | (folds < 0))
    left = np.zeros((len(folds), lanes.frames), bool)
    left[:, lanes.frame[lanes.starts]] = np.logical_or.reduceat(counts, lanes.starts, axis=1)
    ready = Designs(small, left)
    found: list[LineErrors | str] = [""] * len(models)
    alike = collections.defaultdict(list)
    for place, model in enumerate(models):
        designs, problem = ready.of(model)
        if designs[0] is None:  # of all lines: too few focal lengths, say
            found[place] = problem
        else:
            alike[model.terms].append((place, designs, problem))
    for terms, several in alike.items():
        results = cross_validated(lanes.cut(terms), [designs for _, designs, _ in several])
        for (place, designs, problem), (seen, unseen, matrix, bad) in zip(several, results, strict=True):
            told = problem or (f"{bad} of {parts.number} folds do not converge" if bad else "")
            share = np.linalg.pinv(matrix, hermitian=True) @ (matrix - designs[0].precision)
            seen, unseen = as_given(small, seen), as_given(small, unseen)
            found[place] = LineErrors(seen, unseen, float(np.trace(share)), told)
    return found


class _State(NamedTuple):
    """Of each fit: some parameters, the energy there, half its gradient, and its Gauss-Newton matrix.

    And how far a unit of each parameter moves the points, px^2, along their lines and across; and the
    lines' squares. The matrix and what is moved are None where they are those of another state.
    """

    parameters: np.ndarray
    energy: np.ndarray
    gradient: np.ndarray
    matrix: Any
    moved: Any
    squares: np.ndarray


class Validated(NamedTuple):
    """What cross-validation says of a model: see `cross_validated`."""

    seen: np.ndarray
    unseen: np.ndarray
    matrix: np.ndarray
    bad: int


def cross_validated(lanes: Lanes, models: Sequence[Sequence[Design | None]]) -> list[Validated]:
    """Of each model the lines' mean squared distances, seen and unseen; the matrix of all; the bad folds.

    The first of a model's designs is that of all lines, fitted from zero; fold f has the next, and starts
    there. A design of None has no fit. Fits of all models and folds are made together, as many as go into
    a cache.
    """
    most = max(1, _TOGETHER // lanes.fold.size)
    found: list[Validated] = []
    fits, parameters = [], []
    for some in _parted([designs[0] for designs in models], most):
        design, weight = _stacked(some), np.tile(lanes.weight, (len(some), 1))
        start = np.zeros((len(some), design.basis.shape[2], lanes.terms))
        state, good = _minimised(lanes, weight, design, start, passed(lanes, design.basis @ start))
        for own, squares, matrix in zip(some, state.squares, state.matrix, strict=True):
            number, seen = own.mean.size, squares / lanes.counts
            found.append(Validated(seen, np.full(seen.shape, np.nan), matrix[:number, :number], 0))
        fits += good.tolist()
        parameters += list(state.parameters)
    there = set(lanes.fold.tolist())
    jobs = [
        (model, fold, design)
        for model, designs in enumerate(models)
        for fold, design in enumerate(designs[1:])
        if design is not None and fold in there
    ]
    bad = [0] * len(models)
    for some in _parted(jobs, most):
        design = _stacked([design for _, _, design in some])
        out = lanes.fold == np.array([fold for _, fold, _ in some])[:, None]
        weight = np.where(out, 0, lanes.weight)
        # Folds of one model that are made ready alike start together.
        place: dict[Any, int] = {}
        start = np.zeros((len(some), design.basis.shape[2], lanes.terms))
        for left, (model, _, of) in zip(weight > 0, some, strict=True):
            if (model, id(of)) not in place:
                place[model, id(of)] = own = len(place)
                numbers = _start(of, models[model][0], parameters[model], lanes.frame[left])
                start[own, : len(numbers)] = numbers
        where = [place[model, id(of)] for model, _, of in some]
        first = [where.index(own) for own in range(len(place))]
        lines = passed(lanes, design.basis[first] @ start[: len(first)])
        state, good = _minimised(lanes, weight, design, start[where], _of(lines, where), keep=True)
        for (model, _, _), own, squares, fold_fits in zip(some, out, state.squares, good, strict=True):
            if fits[model] and fold_fits:
                found[model].unseen[own] = (squares / lanes.counts)[own]
            else:
                bad[model] += 1
    return [of._replace(bad=number) for of, number in zip(found, bad, strict=True)]


def _start(design, first, parameters, frame):
    """The parameters that come nearest to those of the first design, at frames that have lines."""
    parameters = parameters[: first.basis.shape[1]]
    if design is first:
        return parameters
    left = np.unique(frame)
    return np.linalg.pinv(design.basis[left]) @ (first.basis[left] @ parameters)


def _parted(jobs: Sequence[Any], most: int) -> Iterator[Any]:
    """Jobs in parts of so many."""
    return (jobs[begin : begin + most] for begin in range(0, len(jobs), most))


_TOGETHER = 1 << 16
"""Lines in as many fits at once: arrays of them all, of some coefficients, are half a megabyte each."""


def _stacked(designs: Sequence[Design]) -> Design:
    """Designs of one number of coefficients side by side; where they have fewer functions, with zeros."""
    frames, most = len(designs[0].basis), max(design.basis.shape[1] for design in designs)
    numbers, fits = max(design.mean.size for design in designs), len(designs)
    stack = Design(
        np.zeros((fits, frames, most)),
        np.zeros((fits, numbers, numbers)),
        np.zeros((fits, numbers)),
    )
    for place, design in enumerate(designs):
        for several, own in zip(stack, design, strict=True):
            several[(place, *map(slice, own.shape))] = own
    return stack


def _minimised(lanes, weight, design, parameters, lines, keep=False):
    """The states of least energy near these parameters, one for each row of weights, and which are ones.

    `lines` are passed at the parameters. Levenberg-Marquardt without damping, until a step fails; at first,
    if it is to `keep` it, by the matrix at the parameters, as long as no step fails. Directions that the
    lines do not determine are 0 then, and not what lines that are left out have made of them.
    """
    in_frame = lanes.total(weight)
    share = np.zeros((len(weight), lanes.frames))
    # M of eq. 13 as of all lines, those left out included: a prior in `Design` is in the same unit.
    counted = max(np.sum(lanes.total(lanes.weight) > 0), 1)
    share[:, lanes.frame[lanes.starts]] = 1 / np.where(in_frame > 0, in_frame, 1) / counted
    weights = weight * share[:, lanes.frame] / lanes.counts
    eps = np.finfo(float).eps
    at, damping = _state(lanes, weights, design, parameters, lines), np.zeros(len(weight))
    directions = _directions(at)
    going, good = weight.any(axis=1) & np.isfinite(at.energy), np.zeros(len(weight), bool)
    keep = keep and lanes.moments is None  # in the image the gradient comes with the matrix

    def state(on, parameters, of=passed):
        own = _of(design, on)
        return _state(lanes, weights[on], own, parameters, of(lanes, own.basis @ parameters))

    step, most = 0, _MOST_STEPS + _MOST_KEPT * keep
    while len(on := np.flatnonzero(going)) and step < most:
        here = _of(at, on)
        move, decrease = _move(here, _of(directions, on), damping[on])
        moved = here.parameters + move.reshape(here.parameters.shape)
        there = state(on, moved, passed_for_gradient if keep else passed)
        # Rounding must not reject the last step, nor that of exact lines.
        same = np.maximum(here.energy * (1 + 128 * eps), (np.sqrt(here.energy) + lanes.rounding) ** 2)
        better = there.energy <= same
        damping[on] = np.where(better, damping[on] / 10, np.maximum(10 * damping[on], 1e-3))
        _replace(at, on[better], _of(there, better))
        arrived = better & (decrease <= np.maximum(16 * eps * there.energy, lanes.rounding**2))
        good[on[arrived]], going[on[arrived]] = True, False
        on, step = np.flatnonzero(going), step + 1
        if keep and len(on) and (step == _MOST_KEPT or not better.all()):
            keep, damping[on] = False, 0
            _replace(at, on, state(on, at.parameters[on]))
        if not keep:
            _replace(directions, on, _directions(_of(at, on)))
    _forget_undetermined(at, good, design, state)
    return at, good


def _of(several, which):
    """Some of the fits; what they do not have stays None."""
    return type(several)(*(None if of is None else of[which] for of in several))


def _replace(several, which, others):
    """Put others in the place of some of the fits, in what the others have."""
    for of, new in zip(several, others, strict=True):
        if new is not None:
            of[which] = new


class _Directions(NamedTuple):
    """The units of parameters, eigenvalues and vectors of the matrix in them, and what is determined."""

    size: np.ndarray
    values: np.ndarray
    vectors: np.ndarray
    known: np.ndarray


def _move(at, directions, damping):
    """The damped Gauss-Newton steps, and by how much they should lower the energy."""
    size, values, vectors, known = directions
    inverse = np.where(known, 1 / np.where(known, values + damping[:, None], 1), 0)
    along = np.einsum("bij,bi->bj", vectors, at.gradient / size)
    return -np.einsum("bij,bj->bi", vectors, inverse * along) / size, np.sum(inverse * along**2, axis=1)


def _directions(at):
    """Of the matrices of these states.

    What Gram matrices of lines lose to rounding is a part of what the parameters move, also along the
    lines: of lines through the centre the matrix holds nothing else.
    """
    eps = np.finfo(float).eps
    size = np.sqrt(np.maximum(np.diagonal(at.matrix, axis1=1, axis2=2), 0))  # rounding may be negative
    told = size**2 > 4 * eps * at.moved
    size = np.where(told, size, 1)
    kept = np.where(told[:, :, None] & told[:, None], at.matrix, 0)
    values, vectors = np.linalg.eigh(kept / size[:, :, None] / size[:, None])
    lost = 4 * eps * np.max(at.moved / size**2, axis=1, where=told, initial=0)
    known = values > np.maximum(64 * eps * values[:, -1], lost)[:, None]
    return _Directions(size, values, vectors, known)


def _forget_undetermined(at, good, design, state):
    """Leave nothing along directions that the lines do not determine, in states that are good."""
    on = np.flatnonzero(good)
    # `_stacked` has added functions that are 0, which are no parameters.
    there = np.repeat(design.basis[on].any(axis=1), at.parameters.shape[2], axis=1)
    there |= np.diagonal(design.precision[on], axis1=1, axis2=2) > 0
    on = on[_directions(_of(at, on)).known.sum(axis=1) < there.sum(axis=1)]
    if not len(on):
        return
    here = state(on, at.parameters[on])  # with its own matrix
    size, _, vectors, known = _directions(here)
    along = np.einsum("bij,bi->bj", vectors, size * here.parameters.reshape(len(on), -1))
    flat = np.einsum("bij,bj->bi", vectors, np.where(known, along, 0)) / size
    _replace(at, on, state(on, flat.reshape(here.parameters.shape)))


def _state(lanes, weights, design, parameters, lines):
    """The lines' sums, put together as each model's basis says; a matrix only if the lines have theirs."""
    gradient = lanes.total(weights[:, None] * lines.gradient)
    rows, flat = design.basis[:, lanes.frame[lanes.starts]], parameters.reshape(len(parameters), -1)
    away = flat - design.mean
    pulled = np.einsum("bij,bj->bi", design.precision, away)
    matrix, moved = (
        (None, None) if lines.matrix is None else _matrix(lanes, weights, design, rows, lines.matrix)
    )
    return _State(
        parameters,
        np.einsum("bl,bl->b", weights, lines.squares) + np.einsum("bi,bi->b", away, pulled),
        (gradient @ rows).swapaxes(1, 2).reshape(len(flat), -1) + pulled,
        matrix,
        moved,
        lines.squares,
    )


def _matrix(lanes, weights, design, rows, of_lines):
    """The Gauss-Newton matrices by the parameters, and how far a unit of each moves the points."""
    (fits, frames, size), terms = rows.shape, of_lines.shape[1]
    of_frames = lanes.total(weights[:, None, None] * of_lines)
    products = (rows[..., :, None] * rows[..., None, :]).reshape(fits, frames, -1)
    blocks = (of_frames.reshape(fits, -1, frames) @ products).reshape(fits, terms, terms, size, size)
    matrix = blocks.transpose(0, 3, 1, 4, 2).reshape(fits, size * terms, -1) + design.precision
    moved = lanes.total(weights[:, None] * np.einsum("jjl->jl", lanes.gram[0] + lanes.gram[2])[1:])
    return matrix, (moved @ rows**2).swapaxes(1, 2).reshape(fits, -1)
