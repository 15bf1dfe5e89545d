"""Compressed lines in NumPy, and what coefficients of their frames make of them.

Small sums over all lines, float64 whatever the lines' dtype: compiling them would take longer.
"""

from typing import Any, NamedTuple

import numpy as np

from ..fit.image_metric import in_corrected
from ..fit.own_weights import counts_of
from ..fit.problem import LEAST_STRETCH
from ..lines.best_line import rounded_by


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
    rounding: float  # px: how far exact lines seem to be from straight
    moments: np.ndarray | None = (
        None  # (2 terms, 3, line): xx, xy and yy of r^(2i) z z^T, means; in the image
    )

    @property
    def terms(self) -> int:
        """The number N of coefficients."""
        return self.columns.shape[1] - 1

    def cut(self, terms: int) -> "Lanes":
        """The same for the first coefficients alone."""
        some, rows = slice(terms + 1), 2 * terms + 2
        columns = self.columns[:, some]
        if not columns[:, :, rows:].any():  # below the diagonal of a triangle there is nothing
            columns = np.ascontiguousarray(columns[:, :, :rows])
        moments = None if self.moments is None else self.moments[: 2 * terms]
        return self._replace(columns=columns, gram=self.gram[:, some, some], moments=moments)

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
    rounding = rounded_by(float(small.scale), float)
    return Lanes(columns, gram, frame, counts, weight, fold, starts, len(lines.focal), rounding, moments)


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
    matrix: Any  # of Gauss and Newton, an array; None where it is not wanted


def passed_for_gradient(lanes: Lanes, coefficients: np.ndarray) -> Pass:
    """As `passed`, without the matrix, in a third of the time; of lines measured in the corrected image."""
    squares, gradient, *_ = _straightened(lanes, _kappa(lanes, coefficients))
    return Pass(squares, gradient, None)


def _kappa(lanes, coefficients):
    """1 and the coefficients, of each line: (..., N + 1, line)."""
    ones = np.ones((*coefficients.shape[:-2], 1, lanes.frames))
    return np.concatenate([ones, np.swapaxes(coefficients, -1, -2)], axis=-2)[..., lanes.frame]


def _straightened(lanes, kappa):
    """Squares and gradient; moments of the corrected line, its direction, and what residuals are on A_j."""
    x, y = (np.einsum("jrl,...jl->...rl", one, kappa) for one in lanes.columns)
    sxx, sxy, syy = (np.einsum("...rl,...rl->...l", one, other) for one, other in ((x, x), (x, y), (y, y)))
    angle = np.arctan2(2 * sxy, sxx - syy) / 2
    c, s = np.cos(angle)[..., None, :], np.sin(angle)[..., None, :]
    across = c * y - s * x
    squares = np.einsum("...rl,...rl->...l", across, across)
    on_x, on_y = (np.einsum("jrl,...rl->...jl", one[1:], across) for one in lanes.columns)
    return squares, c * on_y - s * on_x, (sxx, sxy, syy), (c, s), (on_x, on_y)


def passed(lanes: Lanes, coefficients: np.ndarray) -> Pass:
    """One pass over the lines, at coefficients of the frames: (..., frame, N).

    With the direction t of a line and its normal n, the residuals are r = n.c and ``sum r (t.c) = 0``. A
    change of k_j turns the line, by the derivative of that sum, by ``phi_j = sum (t.A_j) r + (t.c)(n.A_j)``
    over ``sum (t.c)^2 - r^2``, and r changes by ``n.A_j - phi_j (t.c)``. Residuals, and with them energy
    and gradient, come from the triangles; the rest, which need not be exact, from their Gram matrices.
    """
    kappa = _kappa(lanes, coefficients)
    squares, gradient, (sxx, sxy, syy), (c, s), (on_x, on_y) = _straightened(lanes, kappa)
    (xx, xy, yy), yx = (gram[1:] for gram in lanes.gram), lanes.gram[1].swapaxes(0, 1)[1:]
    of_xx, of_xy, of_yx, of_yy = (np.einsum("ijl,...jl->...il", gram, kappa) for gram in (xx, xy, yx, yy))
    pull = c * c * of_yx + c * s * (of_yy - of_xx) - s * s * of_xy
    length = (c * c)[..., 0, :] * sxx + (2 * c * s)[..., 0, :] * sxy + (s * s)[..., 0, :] * syy
    apart = length - squares
    turn = (c * on_x + s * on_y + pull) / np.where(apart > 0, apart, np.inf)[..., None, :]
    xx, xy, yy = (gram[:, 1:] for gram in (xx, xy, yy))
    c2, cs, s2 = (of[..., None, :, :] for of in (c * c, c * s, s * s))
    matrix = c2 * yy - cs * (xy + xy.swapaxes(0, 1)) + s2 * xx
    cross = turn[..., :, None, :] * (pull - turn / 2 * length[..., None, :])[..., None, :, :]
    found = Pass(squares, gradient, matrix - cross - cross.swapaxes(-3, -2))
    return found if lanes.moments is None else _in_image(found, lanes.moments, kappa, c, s, turn)


def _in_image(found, moments, kappa, c, s, turn):
    """The same of residuals divided by the root of the stretch q: they change by ``(dr - r dq/2q) / q^½``.

    q is that of `image_metric`. It changes with k_j, and with the normal (-s, c), which turns.
    """
    xx, xy, yy = moments.swapaxes(0, 1)
    along_normal = s * s * xx - 2 * s * c * xy + c * c * yy
    by_angle = 2 * (s * c * (xx - yy) - (c * c - s * s) * xy)
    i, j = np.ogrid[: kappa.shape[-2], : kappa.shape[-2]]
    often, place = (2 * i + 2 * j + 4 * i * j)[..., None], np.maximum(i + j - 1, 0)
    every = (xx + yy)[place] + often * along_normal[..., place, :]
    every[..., 0, 0, :] = 1
    on_kappa = np.einsum("...ijl,...jl->...il", every, kappa)
    q = np.einsum("...il,...il->...l", kappa, on_kappa)[..., None, :]
    turned = np.einsum("...ijl,...jl->...il", often * by_angle[..., place, :], kappa)
    q_by_angle = np.einsum("...il,...il->...l", kappa, turned)[..., None, :]
    change = 2 * on_kappa[..., 1:, :] + q_by_angle * turn
    free = q > LEAST_STRETCH
    q = np.where(free, q, LEAST_STRETCH)
    change = np.where(free, change, 0) / (2 * q)
    squares, gradient = found.squares / q[..., 0, :], found.gradient / q
    cross = gradient[..., :, None, :] * change[..., None, :, :]
    matrix = found.matrix / q[..., None, :] - cross - cross.swapaxes(-3, -2)
    matrix += squares[..., None, None, :] * (change[..., :, None, :] * change[..., None, :, :])
    return Pass(squares, gradient - squares[..., None, :] * change, matrix)


def as_given(lines, values):
    """Of the lines in their own order, from `Lanes`."""
    given = np.empty_like(values)
    given[np.argsort(np.asarray(lines.frame), kind="stable")] = values
    return given
