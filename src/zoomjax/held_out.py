"""Straightness of lines that a fit has not seen: cross-validation over focal lengths, frames or lines.

The lines are parted into folds. Each fold is left out in turn, its lines counting nothing, and measured by
the model of the others. To the energy of eq. 13 a line adds only by way of the coefficients of its frame,
so that one pass over the lines at coefficients ``k_m`` gives each frame's share of the normal equations,
N x N numbers, whatever the zoom model; its own basis then makes ``sum_m B_m^T H_m B_m`` of them. For models
that are linear in their parameters every fold starts from the fit of all lines, where one to three damped
Gauss-Newton steps are enough, and there is no covariance and no certificate. Nothing is approximated: a
fold's model is the one that `fit_zoom` (``invertible=False``) finds on its lines.

Once: the compression, and each fold's basis. Per fold and step: one pass over the compressed lines. It is
NumPy, float64 whatever the lines' dtype: with sums as small as these, compiling would take longer than
50 folds of 12 models do.
"""

from typing import Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from ._arguments import kinds_checked
from ._checks import checked_integer, checked_terms
from ._types import of_known_values
from .algebraic import compressed
from .compression import CompressedLines
from .energy import coefficients_by, line_residuals, prior_jacobian, settings
from .family_lines import FamilyLines
from .fit import RESULTS, fit_zoom
from .image_metric import ImageLines
from .lines import AbstractLines
from .zoom import AbstractLinearZoom, AbstractPriorZoom, AbstractZoom, PolynomialZoom, with_parameters

HoldOut = Literal["focal", "frame", "line"]

_MOST_FOLDS = 50  # of focal lengths or frames, one each as long as there are no more
_LINE_FOLDS = 10
_MOST_STEPS = 40  # of Gauss-Newton: from the fit of all lines it takes 1 to 3, from zero 4 to 8


class Folds(NamedTuple):
    """What is left out together.

    Attributes:
        fold: of each line, from 0; -1 for lines that are never left out.
        unit: of each line, the focal length, frame or line it stands for; -1 as before.
        number: of folds.
    """

    fold: np.ndarray
    unit: np.ndarray
    number: int


class Judged(NamedTuple):
    """A model on the lines of `Folds`.

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


@kinds_checked
@of_known_values
def held_out_zoom(
    lines: AbstractLines,
    *,
    zoom: AbstractZoom | None = None,
    terms: int = 2,
    hold_out: HoldOut = "frame",
    folds: int | None = None,
    seed: int = 0,
) -> Float[np.ndarray, "frame"]:
    """RMS, px, of each frame under zoom models fitted without it.

    By default one frame is left out at a time, and corrected as its focal length says by the model of all
    others. A frame at the shortest or longest focal length is extrapolated to, if no other has it.

    Args:
        lines: the lines, or, much faster, ``compress(lines)``.
        zoom, terms: as for `fit_zoom`.
        hold_out, folds, seed: as for `select_model`.

    Returns:
        The root of eq. 3 of each frame, of the lines left out. NaN where the model cannot be fitted to what
        is left, and for frames that are never left out.

    Example:
        >>> from zoomjax import synthetic, compress, fit_zoom
        >>> lines = compress(
        ...     synthetic.board_lines(
        ...         synthetic.nikkor_18_200(), synthetic.focal_sweep(5), spacing=200, noise=0.5
        ...     )
        ... )
        >>> bool((held_out_zoom(lines) ** 2).mean() > fit_zoom(lines).rms ** 2)
        True
    """
    terms = checked_terms(terms)
    zoom = PolynomialZoom() if zoom is None else zoom
    focal, *focus = settings(zoom, lines)
    zoom.prepare(focal, terms, *focus)  # complains of too few focal lengths
    small = small_lines(lines, terms)
    parts = folds_of(small, hold_out, folds, seed)
    judged = judge(small, zoom, terms, parts)
    return _by_frame(small, np.where(parts.fold >= 0, judged.unseen, np.nan))


@kinds_checked
@of_known_values
def held_out_frames(
    lines: AbstractLines, *, terms: int = 2, folds: int | None = None, seed: int = 0
) -> Float[np.ndarray, "frame"]:
    """RMS, px, of each frame's lines under fits of the other lines of that frame.

    What a frame by itself knows of lines that it has not seen: the noise, and what too few lines cost.

    Args:
        lines, terms: as for `fit_frames`.
        folds: into how many parts a frame's lines are parted; 10 by default.
        seed: of the parting.

    Returns:
        The root of eq. 3 of each frame, of all its lines, each as it was left out. NaN for a frame with
        fewer than two lines.
    """
    terms = checked_terms(terms)
    small = small_lines(lines, terms)
    parts = folds_of(small, "line", folds, seed)
    lanes = _lanes(small, parts.fold, terms)
    unseen = np.full(lanes.fold.shape, np.nan)
    one = _Design(np.ones((1, 1)), np.ones((1, 1)), np.zeros((terms, terms)))
    for frame in np.unique(lanes.frame):
        own = lanes.frame == frame
        alone = _Lanes(
            lanes.columns[..., own],
            lanes.gram[..., own],
            np.zeros(own.sum(), int),
            lanes.counts[own],
            lanes.weight[own],
            lanes.fold[own],
            starts=np.zeros(1, int),
            frames=1,
        )
        unseen[own] = _cross_validated(alone, [one] * (parts.number + 1))[1]
    return _by_frame(small, _as_given(small, unseen))


def small_lines(lines: AbstractLines, terms: int) -> CompressedLines:
    """The lines compressed, for so many terms.

    Raises:
        TypeError: they are no lines, or measured in another way than eq. 3.
        ValueError: they are compressed already, for fewer terms; a point is not finite; or no line counts.
    """
    if isinstance(lines, ImageLines | FamilyLines):
        raise TypeError(
            "Lines held out are measured in the corrected image, and by the radial polynomial: pass the "
            "lines without in_image or with_family. (select_model compares families, given "
            "Candidate(zoom, terms, family).)"
        )
    if not isinstance(lines, AbstractLines):
        raise TypeError(
            "Argument lines must be Lines (see Lines.from_ragged) or compress(lines), but its type is "
            f"{type(lines).__name__}."
        )
    small = compressed(lines, terms)
    if not np.isfinite(small.triangle).all():
        raise ValueError("Argument lines must hold finite points, but it holds NaN or infinite ones.")
    if not _own_weights(small).any():
        raise ValueError(
            "Argument lines must have a line that counts, but all have a weight of 0 or too few points."
        )
    return small


def folds_of(lines: CompressedLines, hold_out: HoldOut, folds: int | None, seed: int) -> Folds:
    """The parts of the lines that are left out in turn; see `select_model`.

    Raises:
        ValueError: the way of holding out is none, or there are too few focal lengths, frames or lines.
    """
    if hold_out not in get_args(HoldOut):
        raise ValueError(f'Argument hold_out must be "focal", "frame" or "line", but it is {hold_out!r}.')
    frame, focal = np.asarray(lines.frame), np.asarray(lines.focal)
    rng = np.random.default_rng(seed)
    most = _LINE_FOLDS if hold_out == "line" else _MOST_FOLDS
    most = most if folds is None else checked_integer("folds", folds, 2)
    if hold_out == "line":
        # Every frame's lines over all folds, as evenly as can be.
        order = np.lexsort([rng.random(len(frame)), frame])
        fold = np.empty(len(frame), int)
        fold[order] = np.arange(len(frame)) % most
        return Folds(fold, np.arange(len(frame)), most)
    if hold_out == "frame":
        group, number, needed = frame, len(focal), "two or more frames"
    else:
        distinct, place = np.unique(focal, return_inverse=True)
        number, needed = len(distinct) - 2, "4 distinct focal lengths or more, for both ends stay"
        group = np.where((place > 0) & (place <= number), place - 1, -1)[frame]
    if number < 2:
        raise ValueError(
            f'Argument hold_out is "{hold_out}", which takes {needed}; there are fewer. Ask for '
            'hold_out="line", or add images at other focal lengths.'
        )
    parts = min(most, number)
    fold = np.arange(number) if parts == number else rng.permutation(number) % parts
    return Folds(np.where(group >= 0, fold[group], -1), group, parts)


def judge(lines: CompressedLines | FamilyLines, zoom: AbstractZoom, terms: int, parts: Folds) -> Judged:
    """A model's errors on lines that it has seen and has not.

    Args:
        lines: from `small_lines`, or those lines with another family.
        zoom: a model without parameters.
        terms: its number of coefficients.
        parts: the folds.
    """
    if isinstance(zoom, AbstractLinearZoom) and isinstance(lines, CompressedLines):
        return _judge_linear(lines, zoom, terms, parts)
    return _judge_by_fits(lines, zoom, terms, parts)


def _by_frame(lines, of_line):
    """Root of the mean over each frame's lines, by their weights; NaN if one that counts is not known."""
    share, frame = shares(lines), np.asarray(lines.frame)
    kept = share > 0
    total, squares = (
        np.bincount(frame[kept], values[kept], minlength=len(lines.focal))
        for values in (share, share * of_line)
    )
    return np.sqrt(squares / np.where(total > 0, total, np.nan))


def shares(lines: CompressedLines) -> Float[np.ndarray, "line"]:
    """The part of each line in the energy of eq. 13: every frame that counts weighs the same."""
    frame, own = np.asarray(lines.frame), _own_weights(lines)
    total = np.bincount(frame, own, minlength=len(lines.focal))
    return own / (np.where(total > 0, total, 1) * max(np.sum(total > 0), 1))[frame]


def _own_weights(lines):
    own = np.ones(lines.frame.shape) if lines.weight is None else np.asarray(lines.weight, float)
    return np.where(_counts(lines) > 2, own, 0)


def _counts(lines):
    """Numbers of points; of `CompressedLines` in NumPy: of what JAX does once, most is compiling."""
    if not isinstance(lines, CompressedLines):
        return np.asarray(lines.counts)
    return np.round(np.asarray(lines.triangle)[:, 0, 0].astype(float) ** 2)


# ---- Models that are linear in their parameters


def _judge_linear(lines, zoom, terms, parts):
    lanes = _lanes(lines, parts.fold, terms)
    known: dict[bytes, _Design | str] = {}
    designs, problem = [], ""
    for fold in range(-1, parts.number):
        left = np.zeros(len(lines.focal), bool)
        left[lanes.frame[(lanes.weight > 0) & ((lanes.fold != fold) | (fold < 0))]] = True
        if (key := left.tobytes()) not in known:
            known[key] = _design(lines, zoom, left, terms)
        design = known[key]
        if isinstance(design, str):
            problem, design = problem or design, None
        designs.append(design)
    seen, unseen, everything, bad = _cross_validated(lanes, designs)
    if bad:
        problem = problem or f"{bad} of {parts.number} folds do not converge"
    matrix = everything.matrix
    share = np.linalg.pinv(matrix, hermitian=True) @ (matrix - designs[0].precision)
    return Judged(_as_given(lines, seen), _as_given(lines, unseen), float(np.trace(share)), problem)


def _as_given(lines, values):
    """Of the lines in their own order, from `_Lanes`."""
    given = np.empty_like(values)
    given[np.argsort(np.asarray(lines.frame), kind="stable")] = values
    return given


class _Design(NamedTuple):
    """A prepared linear model on the frames: ``k_m = basis_m @ parameters``."""

    basis: np.ndarray  # (frame, basis)
    project: np.ndarray  # (basis, frame): from coefficients at the frames that are left to parameters
    precision: np.ndarray  # (parameter, parameter): of the prior, in the unit of eq. 13


def _design(lines, zoom, left, terms):
    """The model as made ready for the frames that are left, or why it cannot be."""
    try:
        focal, *focus = map(np.asarray, settings(zoom, lines))
        model = zoom.prepare(focal[left], terms, *(values[left] for values in focus))
    except ValueError as error:
        return str(error)
    values = np.asarray(_basis_of(with_parameters(model, None), focal, *focus), float)
    size = values.shape[1]
    precision = np.zeros((size * terms, size * terms))
    if isinstance(model, AbstractPriorZoom):
        whitener = np.asarray(_whitener(lines, model), float)
        precision = whitener.T @ whitener
    project = np.zeros((size, len(focal)))
    project[:, left] = np.linalg.pinv(values[left])
    return _Design(values, project, precision)


_basis_of = eqx.filter_jit(lambda model, *settings: jax.vmap(model.basis)(*settings))
"""Of a model without its parameters: one compiled program for any number of terms."""


@eqx.filter_jit
def _whitener(lines, model):
    """What makes of the flattened parameters what their prior adds to the residuals, px."""
    return prior_jacobian(lines, model)


class _Lanes(NamedTuple):
    """The compressed lines, sorted by frame, float64: the last axis is the lines'."""

    columns: np.ndarray  # (2, terms + 1, rows, line), px: x and y of what goes with 1, k1, ..., kN
    gram: np.ndarray  # (3, terms + 1, terms + 1, line): xx, xy and yy, summed over rows
    frame: np.ndarray
    counts: np.ndarray
    weight: np.ndarray
    fold: np.ndarray

    starts: np.ndarray  # where each frame's lines begin
    frames: int  # how many there are, with or without lines

    def total(self, values: np.ndarray) -> np.ndarray:
        """Sums over the lines of each frame that has some."""
        return np.add.reduceat(values, self.starts, axis=-1)


def _lanes(lines, fold, terms):
    frame = np.asarray(lines.frame)
    order = np.argsort(frame, kind="stable")
    rows = np.asarray(lines.triangle, float)[order, 1:, 1 : 3 + 2 * terms] * lines.scale
    columns = rows.reshape(*rows.shape[:2], terms + 1, 2).transpose(3, 2, 1, 0)
    x, y = columns = np.ascontiguousarray(columns)
    gram = np.stack([np.einsum("irl,jrl->ijl", one, other) for one, other in ((x, x), (x, y), (y, y))])
    counts = np.maximum(_counts(lines), 1)
    frame, counts, weight, fold = (a[order] for a in (frame, counts, _own_weights(lines), np.asarray(fold)))
    starts = np.flatnonzero(np.diff(frame, prepend=-1))
    return _Lanes(columns, gram, frame, counts, weight, fold, starts, len(lines.focal))


class _Pass(NamedTuple):
    """What coefficients of the frames give for each line: the last axis."""

    squares: np.ndarray  # px^2
    gradient: np.ndarray  # half of it, by k1, ..., kN
    matrix: np.ndarray  # of Gauss and Newton


class _State(NamedTuple):
    """Some parameters, the energy there, half its gradient, and its Gauss-Newton matrix."""

    parameters: np.ndarray
    energy: float
    gradient: np.ndarray
    matrix: np.ndarray
    lines: _Pass


def _cross_validated(lanes, designs):
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

    Levenberg-Marquardt without damping, until a step fails. Directions that the lines do not determine stay
    as they are. `known` is the pass over the lines at the start, if it has been made.
    """
    in_frame = lanes.total(weight)
    share = np.zeros(lanes.frames)
    # M of eq. 13 as of all lines, those left out included: a prior in `_Design` is in the same unit.
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
                return at, True
        else:
            damping = max(10 * damping, 1e-3)
    return at, False


def _move(at, damping):
    """The damped Gauss-Newton step, and by how much it should lower the energy."""
    size = np.sqrt(np.maximum(np.diagonal(at.matrix), 0))  # rounding alone may be negative
    size = np.where(size > 0, size, 1)
    values, vectors = np.linalg.eigh(at.matrix / size[:, None] / size)
    known = values > 64 * np.finfo(float).eps * values[-1]
    inverse = np.where(known, 1 / np.where(known, values + damping, 1), 0)
    along = vectors.T @ (at.gradient / size)
    return -(vectors @ (inverse * along)) / size, np.sum(inverse * along**2)


def _state(lanes, weights, design, parameters, known=None):
    """The lines' sums, put together as the model's basis says."""
    lines = _pass(lanes, design.basis @ parameters) if known is None else known
    gradient, matrix = (lanes.total(weights * a) for a in (lines.gradient, lines.matrix))
    rows, flat = design.basis[lanes.frame[lanes.starts]], parameters.reshape(-1)
    pulled = design.precision @ flat
    terms, size = len(gradient), rows.shape[1]
    products = (rows[:, :, None] * rows[:, None]).reshape(len(rows), -1)
    blocks = (matrix.reshape(-1, len(rows)) @ products).reshape(terms, terms, size, size)
    return _State(
        parameters,
        weights @ lines.squares + flat @ pulled,
        (gradient @ rows).T.reshape(-1) + pulled,
        blocks.transpose(2, 0, 3, 1).reshape(flat.size, flat.size) + design.precision,
        lines,
    )


def _pass(lanes, coefficients):
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
    return _Pass(squares, c * on_y - s * on_x, matrix - cross - cross.swapaxes(0, 1))


# ---- Other models


def _judge_by_fits(lines, zoom, terms, parts):
    """By a fit of its own for each fold, starting from that of all lines."""
    own = _own_weights(lines)
    everything = fit_zoom(lines, zoom=zoom, terms=terms, invertible=False, throw=False)
    seen = np.asarray(_squares(lines, everything.lens.zoom))
    unseen, failed = np.full(seen.shape, np.nan), 0
    problem = ""
    for fold in range(parts.number):
        kept = own * (parts.fold != fold)
        left = np.unique(np.asarray(lines.frame)[kept > 0])
        try:
            focal, *focus = (np.asarray(values)[left] for values in settings(zoom, lines))
            zoom.prepare(focal, terms, *focus)
        except ValueError as error:
            problem = problem or str(error)
            continue
        start = everything.lens.zoom
        fit = fit_zoom(lines.weighted(kept), zoom=start, invertible=False, throw=False)
        if fit.result in (RESULTS.successful, RESULTS.undetermined, RESULTS.folded):
            out = parts.fold == fold
            unseen[out] = np.asarray(_squares(lines, fit.lens.zoom))[out]
        else:
            failed += 1
    if failed:
        problem = problem or f"{failed} of {parts.number} folds do not converge"
    return Judged(seen, unseen, float(ravel_pytree(everything.lens.zoom.parameters)[0].size), problem)


@eqx.filter_jit
def _squares(lines, zoom):
    """Mean squared distance of each line, px^2."""
    corrected = lines.corrected(coefficients_by(zoom, lines)[lines.frame])
    return jnp.sum(jax.vmap(line_residuals)(corrected) ** 2, axis=1) / jnp.maximum(lines.counts, 1)
