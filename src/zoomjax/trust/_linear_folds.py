"""Cross-validation of zoom models that are linear in their parameters.

To the energy of eq. 13 a line adds only by way of the coefficients of its frame, so that one pass over the
lines at coefficients ``k_m`` gives each frame's share of the normal equations, N x N numbers, whatever the
zoom model; its own basis then makes ``sum_m B_m^T H_m B_m`` of them. Every fold starts from the fit of
all lines, where one to three damped Gauss-Newton steps are enough, and there is no covariance and no
certificate. Nothing is approximated: a fold's model is the one that `fit_zoom` (``invertible=False``) finds
on its lines.

Lines measured in the distorted image (`in_image`) have their distances divided by the stretch across the
line, which depends on the coefficients, too: by way of the line's normal as well.

Once: the compression, and each fold's basis. Per fold and step: one pass over the compressed lines. It is
NumPy, float64 whatever the lines' dtype: with sums as small as these, compiling would take longer than
50 folds of 12 models do.
"""

import collections
from collections.abc import Hashable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from .._core.programs import light_program
from ..fit.energy import prior_jacobian, prior_residuals, settings
from ..fit.image_metric import in_corrected
from ..lines.base import AbstractLines
from ..lines.buckets import bucketed_jit, padded_frames, padded_to
from ..models.model import Model
from ..models.zoom import AbstractPriorZoom, with_parameters
from ._lanes import Lanes, as_given, lanes_of, passed
from .folds import Folds, LineErrors

_MOST_STEPS = 40  # of Gauss-Newton: from the fit of all lines it takes 1 to 3, from zero 4 to 8


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
    ready = _Designs(small, left)
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


class Design(NamedTuple):
    """A prepared linear model on the frames: ``k_m = basis_m @ parameters``."""

    basis: np.ndarray  # (frame, basis)
    project: np.ndarray  # (basis, frame): from coefficients at the frames that are left to parameters
    precision: np.ndarray  # (parameter, parameter): of the prior, in the unit of eq. 13
    mean: np.ndarray  # (parameter,): of the prior


class _Designs:
    """Zoom models made ready for the frames that are left: for each row of `left`."""

    def __init__(self, lines: AbstractLines, left: np.ndarray):
        self._lines = lines
        self._rows, self._which = np.unique(left, axis=0, return_inverse=True)
        self._known: dict[Hashable, list[Any]] = {}

    def of(self, model: Model) -> tuple[list[Design | None], str]:
        """The designs, None where it cannot be made ready, and why the first of these cannot."""
        ready = self._ready(model.zoom, model.terms)
        made = [
            None if isinstance(of, str) else _design(self._lines, model.terms, of[0], left, of[1])
            for of, left in zip(ready, self._rows, strict=True)
        ]
        problems = [of for place in self._which.reshape(-1) if isinstance(of := ready[place], str)]
        return [made[place] for place in self._which.reshape(-1)], problems[0] if problems else ""

    def _ready(self, zoom, terms):
        """The models, and the values of their bases at all frames; or why there are none.

        Models without a prior have the same for any number of terms.
        """
        leaves, structure = jax.tree.flatten(zoom)
        own = terms if isinstance(zoom, AbstractPriorZoom) else None
        key = (structure, own, *((np.shape(leaf), np.asarray(leaf).tobytes()) for leaf in leaves))
        if key not in self._known:
            try:
                given = [np.asarray(values) for values in settings(zoom, self._lines)]
            except ValueError as error:
                return [str(error)] * len(self._rows)
            ready = [_prepared(zoom, terms, given, left) for left in self._rows]
            bare = [with_parameters(each, None) for each in ready if not isinstance(each, str)]
            values = iter(_values(bare, given))
            self._known[key] = [each if isinstance(each, str) else (each, next(values)) for each in ready]
        return self._known[key]


def _prepared(zoom, terms, given, left):
    """The zoom model made ready for the frames that are left, or why it cannot be."""
    try:
        focal, *focus = (values[left] for values in given)
        return zoom.prepare(focal, terms, *focus)
    except ValueError as error:
        return str(error)


def _design(lines, terms, zoom, left, values):
    """Of a model made ready, from the values of its basis at all frames."""
    size = values.shape[1]
    precision, mean = np.zeros((size * terms, size * terms)), np.zeros(size * terms)
    if isinstance(zoom, AbstractPriorZoom):
        whitener, of_zero = (np.asarray(part, float) for part in _whitener(lines, zoom))
        precision = whitener.T @ whitener
        mean = np.linalg.lstsq(whitener, -of_zero, rcond=None)[0]
    project = np.zeros((size, len(left)))
    project[:, left] = np.linalg.pinv(values[left])
    return Design(values, project, precision, mean)


def _values(zooms, given):
    """The values of each model's basis at all frames; of models that differ in numbers alone, at once."""
    every, alike = [*map(padded_frames, given)], collections.defaultdict(list)
    for place, zoom in enumerate(zooms):
        leaves, structure = jax.tree.flatten(zoom)
        alike[structure, *((np.shape(leaf), np.asarray(leaf).dtype) for leaf in leaves)].append(place)
    found: list[Any] = [None] * len(zooms)
    for places in alike.values():
        number = 1 << max(_FEWEST, (len(places) - 1).bit_length())
        several = [zooms[place] for place in places]
        stack = jax.tree.map(lambda *leaves, to=number: padded_to(np.stack(leaves), to), *several)
        values = np.asarray(_bases(stack, every, number), float)[:, : len(given[0])]
        for place, own in zip(places, values, strict=False):
            found[place] = own
    return found


_FEWEST = 5
"""Models at once, as a power of two: one compiled program for any number up to it."""


@light_program
def _bases(models, settings, number):
    """Of models without their parameters: one compiled program for any number of terms."""
    return jax.vmap(lambda model: jax.vmap(model.basis)(*settings), axis_size=number)(models)


@bucketed_jit()
def _whitener(lines, model):
    """What makes of the flattened parameters what their prior adds to the residuals, px; and of zeros."""
    return prior_jacobian(lines, model), prior_residuals(lines, model)


class _State(NamedTuple):
    """Of each fit: some parameters, the energy there, half its gradient, and its Gauss-Newton matrix.

    And how far a unit of each parameter moves the points, px^2, along their lines and across; and the
    lines' squares.
    """

    parameters: np.ndarray
    energy: np.ndarray
    gradient: np.ndarray
    matrix: np.ndarray
    moved: np.ndarray
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
    k, fits = [], []
    for some in _parted([designs[0] for designs in models], most):
        design, weight = _stacked(some), np.tile(lanes.weight, (len(some), 1))
        start = np.zeros((len(some), design.basis.shape[2], lanes.terms))
        state, good = _minimised(lanes, weight, design, start)
        for own, squares, matrix in zip(some, state.squares, state.matrix, strict=True):
            number, seen = own.mean.size, squares / lanes.counts
            found.append(Validated(seen, np.full(seen.shape, np.nan), matrix[:number, :number], 0))
        k += list(design.basis @ state.parameters)
        fits += good.tolist()
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
        start = design.project @ np.stack([k[model] for model, _, _ in some])
        state, good = _minimised(lanes, np.where(out, 0, lanes.weight), design, start)
        for (model, _, _), own, squares, fold_fits in zip(some, out, state.squares, good, strict=True):
            if fits[model] and fold_fits:
                found[model].unseen[own] = (squares / lanes.counts)[own]
            else:
                bad[model] += 1
    return [of._replace(bad=number) for of, number in zip(found, bad, strict=True)]


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
        np.zeros((fits, most, frames)),
        np.zeros((fits, numbers, numbers)),
        np.zeros((fits, numbers)),
    )
    for place, design in enumerate(designs):
        for several, own in zip(stack, design, strict=True):
            several[(place, *map(slice, own.shape))] = own
    return stack


def _minimised(lanes, weight, design, parameters):
    """The states of least energy near these parameters, one for each row of weights, and which are ones.

    Levenberg-Marquardt without damping, until a step fails. Directions that the lines do not determine are
    0 then, and not what lines that are left out have made of them.
    """
    in_frame = lanes.total(weight)
    share = np.zeros((len(weight), lanes.frames))
    # M of eq. 13 as of all lines, those left out included: a prior in `Design` is in the same unit.
    counted = max(np.sum(lanes.total(lanes.weight) > 0), 1)
    share[:, lanes.frame[lanes.starts]] = 1 / np.where(in_frame > 0, in_frame, 1) / counted
    weights = weight * share[:, lanes.frame] / lanes.counts
    eps = np.finfo(float).eps
    at, damping = _state(lanes, weights, design, parameters), np.zeros(len(weight))
    going, good = weight.any(axis=1) & np.isfinite(at.energy), np.zeros(len(weight), bool)
    for _ in range(_MOST_STEPS):
        if not going.any():
            break
        on = np.flatnonzero(going)
        here, own = _of(at, on), _of(design, on)
        move, decrease = _move(here, damping[on])
        there = _state(lanes, weights[on], own, here.parameters + move.reshape(here.parameters.shape))
        better = there.energy <= here.energy * (1 + 128 * eps)  # rounding must not reject the last step
        damping[on] = np.where(better, damping[on] / 10, np.maximum(10 * damping[on], 1e-3))
        for of, new in zip(at, there, strict=True):
            of[on[better]] = new[better]
        arrived = better & (decrease <= 16 * eps * there.energy)
        good[on[arrived]], going[on[arrived]] = True, False
    return _without_undetermined(at, good, lanes, weights, design), good


def _of(several, which):
    """Some of the fits."""
    return type(several)(*(of[which] for of in several))


def _move(at, damping):
    """The damped Gauss-Newton steps, and by how much they should lower the energy."""
    size, values, vectors, known = _directions(at)
    inverse = np.where(known, 1 / np.where(known, values + damping[:, None], 1), 0)
    along = np.einsum("bij,bi->bj", vectors, at.gradient / size)
    return -np.einsum("bij,bj->bi", vectors, inverse * along) / size, np.sum(inverse * along**2, axis=1)


def _directions(at):
    """The units of the parameters, eigenvalues and vectors of the matrix in them, and which are determined.

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
    return size, values, vectors, values > np.maximum(64 * eps * values[:, -1], lost)[:, None]


def _without_undetermined(at, good, lanes, weights, design):
    """The states of which nothing is left along directions that the lines do not determine."""
    on = np.flatnonzero(good)
    here = _of(at, on)
    size, _, vectors, known = _directions(here)
    some = ~known.all(axis=1)
    if not some.any():
        return at
    on, here, size, vectors, known = on[some], _of(here, some), size[some], vectors[some], known[some]
    flat = here.parameters.reshape(len(on), -1)
    along = np.einsum("bij,bi->bj", vectors, size * flat)
    left = np.einsum("bij,bj->bi", vectors, np.where(known, along, 0)) / size
    there = _state(lanes, weights[on], _of(design, on), left.reshape(here.parameters.shape))
    for of, new in zip(at, there, strict=True):
        of[on] = new
    return at


def _state(lanes, weights, design, parameters):
    """The lines' sums, put together as each model's basis says."""
    lines = passed(lanes, design.basis @ parameters)
    gradient = lanes.total(weights[:, None] * lines.gradient)
    matrix = lanes.total(weights[:, None, None] * lines.matrix)
    rows, flat = design.basis[:, lanes.frame[lanes.starts]], parameters.reshape(len(parameters), -1)
    away = flat - design.mean
    pulled = np.einsum("bij,bj->bi", design.precision, away)
    (fits, frames, size), terms = rows.shape, parameters.shape[2]
    moved = lanes.total(weights[:, None] * np.einsum("jjl->jl", lanes.gram[0] + lanes.gram[2])[1:])
    products = (rows[..., :, None] * rows[..., None, :]).reshape(fits, frames, -1)
    blocks = (matrix.reshape(fits, -1, frames) @ products).reshape(fits, terms, terms, size, size)
    return _State(
        parameters,
        np.einsum("bl,bl->b", weights, lines.squares) + np.einsum("bi,bi->b", away, pulled),
        (gradient @ rows).swapaxes(1, 2).reshape(fits, -1) + pulled,
        blocks.transpose(0, 3, 1, 4, 2).reshape(fits, flat.shape[1], -1) + design.precision,
        (moved @ rows**2).swapaxes(1, 2).reshape(fits, -1),
        lines.squares,
    )
