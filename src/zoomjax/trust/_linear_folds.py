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

from typing import Any, NamedTuple

import jax
import numpy as np

from .._core.programs import light_program
from ..fit.energy import prior_jacobian, prior_residuals, settings
from ..fit.image_metric import in_corrected
from ..fit.own_weights import counts_of
from ..fit.problem import LEAST_STRETCH
from ..lines.buckets import bucketed_jit, padded_frames
from ..models.zoom import (
    AbstractPriorZoom,
    with_parameters,
)
from .folds import LineErrors

_MOST_STEPS = 40  # of Gauss-Newton: from the fit of all lines it takes 1 to 3, from zero 4 to 8


def linear_errors(lines, model, parts):
    lanes = lanes_of(lines, parts.fold, parts.weight, model.terms)
    lines = in_corrected(lines)
    given = [np.asarray(values) for values in settings(model.zoom, lines)]
    known: dict[bytes, Design | str] = {}
    designs, problem = [], ""
    for fold in range(-1, parts.number):
        left = np.zeros(len(lines.focal), bool)
        left[lanes.frame[(lanes.weight > 0) & ((lanes.fold != fold) | (fold < 0))]] = True
        if (key := left.tobytes()) not in known:
            known[key] = _design(lines, model, given, left)
        design = known[key]
        if fold < 0 and isinstance(design, str):  # all lines: too few focal lengths, say
            raise ValueError(design)
        if isinstance(design, str):
            problem, design = problem or design, None
        designs.append(design)
    seen, unseen, everything, bad = cross_validated(lanes, designs)
    if bad:
        problem = problem or f"{bad} of {parts.number} folds do not converge"
    matrix = everything.matrix
    share = np.linalg.pinv(matrix, hermitian=True) @ (matrix - designs[0].precision)
    return LineErrors(as_given(lines, seen), as_given(lines, unseen), float(np.trace(share)), problem)


def as_given(lines, values):
    """Of the lines in their own order, from `Lanes`."""
    given = np.empty_like(values)
    given[np.argsort(np.asarray(lines.frame), kind="stable")] = values
    return given


class Design(NamedTuple):
    """A prepared linear model on the frames: ``k_m = basis_m @ parameters``."""

    basis: np.ndarray  # (frame, basis)
    project: np.ndarray  # (basis, frame): from coefficients at the frames that are left to parameters
    precision: np.ndarray  # (parameter, parameter): of the prior, in the unit of eq. 13
    mean: np.ndarray  # (parameter,): of the prior


def _design(lines, model, given, left):
    """The model as made ready for the frames that are left, or why it cannot be."""
    try:
        focal, *focus = (values[left] for values in given)
        zoom = model.zoom.prepare(focal, model.terms, *focus)
    except ValueError as error:
        return str(error)
    every = map(padded_frames, given)
    values = np.asarray(_basis_of(with_parameters(zoom, None), *every), float)[: len(left)]
    size = values.shape[1]
    precision, mean = np.zeros((size * model.terms, size * model.terms)), np.zeros(size * model.terms)
    if isinstance(zoom, AbstractPriorZoom):
        whitener, of_zero = (np.asarray(part, float) for part in _whitener(lines, zoom))
        precision = whitener.T @ whitener
        mean = np.linalg.lstsq(whitener, -of_zero, rcond=None)[0]
    project = np.zeros((size, len(left)))
    project[:, left] = np.linalg.pinv(values[left])
    return Design(values, project, precision, mean)


@light_program
def _basis_of(model, *settings):
    """Of a model without its parameters: one compiled program for any number of terms."""
    return jax.vmap(model.basis)(*settings)


@bucketed_jit()
def _whitener(lines, model):
    """What makes of the flattened parameters what their prior adds to the residuals, px; and of zeros."""
    return prior_jacobian(lines, model), prior_residuals(lines, model)


class Lanes(NamedTuple):
    """The compressed lines, sorted by frame, float64: the last axis is the lines'."""

    columns: np.ndarray  # (2, terms + 1, rows, line), px: x and y of what goes with 1, k1, ..., kN
    gram: np.ndarray  # (3, terms + 1, terms + 1, line): xx, xy and yy, summed over rows
    frame: np.ndarray
    counts: np.ndarray
    weight: np.ndarray
    fold: np.ndarray

    starts: np.ndarray  # where each frame's lines begin
    frames: int  # how many there are, with or without lines
    moments: np.ndarray | None = (
        None  # (2 terms, 3, line): xx, xy and yy of r^(2i) z z^T, means; in the image
    )

    def total(self, values: np.ndarray) -> np.ndarray:
        """Sums over the lines of each frame that has some."""
        return np.add.reduceat(values, self.starts, axis=-1)


def lanes_of(lines, fold, weight, terms):
    """The compressed lines, with the fold and the weight of each."""
    small: Any = in_corrected(lines)
    frame = np.asarray(lines.frame)
    order = np.argsort(frame, kind="stable")
    whole = np.asarray(small.triangle, float)[order, :, 1 : 3 + 2 * terms]
    rows = whole[:, 1:] * small.scale
    columns = rows.reshape(*rows.shape[:2], terms + 1, 2).transpose(3, 2, 1, 0)
    x, y = columns = np.ascontiguousarray(columns)
    gram = np.stack([np.einsum("irl,jrl->ijl", one, other) for one, other in ((x, x), (x, y), (y, y))])
    counts = np.maximum(counts_of(lines), 1)
    frame, counts, weight, fold = (a[order] for a in (frame, counts, weight, np.asarray(fold)))
    moments = _moments(whole, terms) / counts if lines.metric == "distorted" else None
    starts = np.flatnonzero(np.diff(frame, prepend=-1))
    return Lanes(columns, gram, frame, counts, weight, fold, starts, len(lines.focal), moments)


def _moments(rows, terms):
    """``sum r^(2i) z z^T`` of each line, i = 0 ... 2 N - 1, from the rows of its triangle: (i, 3, line)."""
    x, y = np.moveaxis(rows.reshape(*rows.shape[:2], terms + 1, 2), (3, 2), (0, 1))
    pairs = [(i - i // 2, i // 2) for i in range(2 * terms)]
    products = (x, x), (x, y), (y, y)
    return np.stack([[np.einsum("lr,lr->l", a[i], b[j]) for a, b in products] for i, j in pairs])


class Pass(NamedTuple):
    """What coefficients of the frames give for each line: the last axis."""

    squares: np.ndarray  # px^2
    gradient: np.ndarray  # half of it, by k1, ..., kN
    matrix: np.ndarray  # of Gauss and Newton


class _State(NamedTuple):
    """Some parameters, the energy there, half its gradient, and its Gauss-Newton matrix.

    And how far a unit of each parameter moves the points, px^2, along their lines and across.
    """

    parameters: np.ndarray
    energy: float
    gradient: np.ndarray
    matrix: np.ndarray
    moved: np.ndarray
    lines: Pass


def cross_validated(lanes, designs):
    """Each line's mean squared distance, seen and unseen; the state of all; the number of bad folds.

    The first of the designs is that of all lines, fitted from zero; fold f has the next, and starts there.
    A design of None has no fit.
    """
    first, terms = designs[0], lanes.columns.shape[1] - 1
    everything, good = _minimised(lanes, lanes.weight, first, np.zeros((first.basis.shape[1], terms)))
    k = first.basis @ everything.parameters
    seen = everything.lines.squares / lanes.counts
    unseen, bad = np.full(seen.shape, np.nan), 0
    for fold, design in enumerate(designs[1:]):
        out = lanes.fold == fold
        if design is None or not out.any():
            continue
        start = design.project @ k
        same = np.allclose(design.basis @ start, k, rtol=1e-12, atol=1e-14)
        known = everything.lines if same else None
        state, fold_good = _minimised(lanes, np.where(out, 0, lanes.weight), design, start, known)
        if good and fold_good:
            unseen[out] = (state.lines.squares / lanes.counts)[out]
        else:
            bad += 1
    return seen, unseen, everything, bad


def _minimised(lanes, weight, design, parameters, known=None):
    """The state of least energy near these parameters, and whether it is one.

    Levenberg-Marquardt without damping, until a step fails. Directions that the lines do not determine are
    0 then, and not what lines that are left out have made of them. `known` is the pass over the lines at
    the start, if it has been made.
    """
    in_frame = lanes.total(weight)
    share = np.zeros(lanes.frames)
    # M of eq. 13 as of all lines, those left out included: a prior in `Design` is in the same unit.
    counted = max(np.sum(lanes.total(lanes.weight) > 0), 1)
    share[lanes.frame[lanes.starts]] = 1 / np.where(in_frame > 0, in_frame, 1) / counted
    weights = weight * share[lanes.frame] / lanes.counts
    eps = np.finfo(float).eps
    at, damping = _state(lanes, weights, design, parameters, known), 0.0
    for _ in range(_MOST_STEPS if weight.any() and np.isfinite(at.energy) else 0):
        move, decrease = _move(at, damping)
        there = _state(lanes, weights, design, at.parameters + move.reshape(parameters.shape))
        if there.energy <= at.energy * (1 + 128 * eps):  # rounding must not reject the last step
            at, damping = there, damping / 10
            if decrease <= 16 * eps * at.energy:
                return _without_undetermined(at, lanes, weights, design), True
        else:
            damping = max(10 * damping, 1e-3)
    return at, False


def _move(at, damping):
    """The damped Gauss-Newton step, and by how much it should lower the energy."""
    size, values, vectors, known = _directions(at)
    inverse = np.where(known, 1 / np.where(known, values + damping, 1), 0)
    along = vectors.T @ (at.gradient / size)
    return -(vectors @ (inverse * along)) / size, np.sum(inverse * along**2)


def _directions(at):
    """The units of the parameters, eigenvalues and vectors of the matrix in them, and which are determined.

    What Gram matrices of lines lose to rounding is a part of what the parameters move, also along the
    lines: of lines through the centre the matrix holds nothing else.
    """
    eps = np.finfo(float).eps
    size = np.sqrt(np.maximum(np.diagonal(at.matrix), 0))  # rounding alone may be negative
    told = size**2 > 4 * eps * at.moved
    size = np.where(told, size, 1)
    values, vectors = np.linalg.eigh(np.where(told[:, None] & told, at.matrix, 0) / size[:, None] / size)
    lost = 4 * eps * np.max(at.moved / size**2, where=told, initial=0)
    return size, values, vectors, values > max(64 * eps * values[-1], lost)


def _without_undetermined(at, lanes, weights, design):
    """The state of which nothing is left along directions that the lines do not determine."""
    size, _, vectors, known = _directions(at)
    if known.all():
        return at
    along = vectors.T @ (size * at.parameters.reshape(-1))
    left = vectors @ np.where(known, along, 0) / size
    return _state(lanes, weights, design, left.reshape(at.parameters.shape))


def _state(lanes, weights, design, parameters, known=None):
    """The lines' sums, put together as the model's basis says."""
    lines = passed(lanes, design.basis @ parameters) if known is None else known
    gradient, matrix = (lanes.total(weights * a) for a in (lines.gradient, lines.matrix))
    rows, flat = design.basis[lanes.frame[lanes.starts]], parameters.reshape(-1)
    away = flat - design.mean
    pulled = design.precision @ away
    terms, size = len(gradient), rows.shape[1]
    moved = lanes.total(weights * np.einsum("jjl->jl", lanes.gram[0] + lanes.gram[2])[1:])
    products = (rows[:, :, None] * rows[:, None]).reshape(len(rows), -1)
    blocks = (matrix.reshape(-1, len(rows)) @ products).reshape(terms, terms, size, size)
    return _State(
        parameters,
        weights @ lines.squares + away @ pulled,
        (gradient @ rows).T.reshape(-1) + pulled,
        blocks.transpose(2, 0, 3, 1).reshape(flat.size, flat.size) + design.precision,
        (moved @ rows**2).T.reshape(-1),
        lines,
    )


def passed(lanes, coefficients):
    """One pass over the lines.

    With the direction t of a line and its normal n, the residuals are r = n.c and ``sum r (t.c) = 0``. A
    change of k_j turns the line, by the derivative of that sum, by ``phi_j = sum (t.A_j) r + (t.c)(n.A_j)``
    over ``sum (t.c)^2 - r^2``, and r changes by ``n.A_j - phi_j (t.c)``. Residuals, and with them energy
    and gradient, come from the triangles; the rest, which need not be exact, from their Gram matrices.
    """
    kappa = np.concatenate([np.ones((1, lanes.frames)), coefficients.T])[:, lanes.frame]
    (x, y), (xx, xy, yy) = lanes.columns, lanes.gram
    of_xx, of_xy, of_yy = (np.einsum("ijl,jl->il", gram, kappa) for gram in (xx, xy, yy))
    of_yx = np.einsum("jil,jl->il", xy, kappa)
    sxx, sxy, syy = (np.einsum("jl,jl->l", kappa, one) for one in (of_xx, of_xy, of_yy))
    angle = np.arctan2(2 * sxy, sxx - syy) / 2
    c, s = np.cos(angle), np.sin(angle)
    across = np.einsum("jrl,jl->rl", y, c * kappa) - np.einsum("jrl,jl->rl", x, s * kappa)
    squares = np.einsum("rl,rl->l", across, across)
    on_x, on_y = (np.einsum("jrl,rl->jl", one[1:], across) for one in (x, y))
    pull = c * c * of_yx[1:] + c * s * (of_yy[1:] - of_xx[1:]) - s * s * of_xy[1:]
    length = c * c * sxx + 2 * c * s * sxy + s * s * syy
    apart = length - squares
    turn = (c * on_x + s * on_y + pull) / np.where(apart > 0, apart, np.inf)
    xx, xy, yy = (gram[1:, 1:] for gram in (xx, xy, yy))
    matrix = c * c * yy - c * s * (xy + xy.swapaxes(0, 1)) + s * s * xx
    cross = turn[:, None] * (pull - turn / 2 * length)
    found = Pass(squares, c * on_y - s * on_x, matrix - cross - cross.swapaxes(0, 1))
    return found if lanes.moments is None else _in_image(found, lanes.moments, kappa, c, s, turn)


def _in_image(found, moments, kappa, c, s, turn):
    """The same of residuals divided by the root of the stretch q: they change by ``(dr - r dq/2q) / q^½``.

    q is that of `image_metric`. It changes with k_j, and with the normal (-s, c), which turns.
    """
    xx, xy, yy = moments.swapaxes(0, 1)
    along_normal = s * s * xx - 2 * s * c * xy + c * c * yy
    by_angle = 2 * (s * c * (xx - yy) - (c * c - s * s) * xy)
    i, j = np.indices((len(kappa), len(kappa)))
    often, place = (2 * i + 2 * j + 4 * i * j)[..., None], np.maximum(i + j - 1, 0)
    every = (xx + yy)[place] + often * along_normal[place]
    every[0, 0] = 1
    q = np.einsum("il,ijl,jl->l", kappa, every, kappa)
    q_by_angle = np.einsum("il,ijl,jl->l", kappa, often * by_angle[place], kappa)
    change = 2 * np.einsum("ijl,jl->il", every, kappa)[1:] + q_by_angle * turn
    free = q > LEAST_STRETCH
    q = np.where(free, q, LEAST_STRETCH)
    change = np.where(free, change, 0) / (2 * q)
    squares, gradient, matrix = (of / q for of in found)
    cross = gradient[:, None] * change
    matrix = matrix - cross - cross.swapaxes(0, 1) + squares * change[:, None] * change
    return Pass(squares, gradient - squares * change, matrix)
