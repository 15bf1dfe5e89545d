"""Six hundred real zoom lenses: which zoom model predicts a focal length that was left out?

    pip install '.[bench]'
    python benchmarks/real/lensfun.py [--output FILE] [--prior | --forms]

The lensfun database (through the package `lensfunpy`, CC BY-SA 3.0; none of it is stored here) holds zoom
lenses that people calibrated by hand at several focal lengths. Its models map corrected to distorted radii,
``Rd = a Ru^4 + b Ru^3 + c Ru^2 + (1 - a - b - c) Ru`` (ptlens), ``k1 Ru^3 + (1 - k1) Ru`` (poly3) or
``Ru (1 + k1 Ru^2 + k2 Ru^4)`` (poly5), in units of half the shorter side. 15 upright and 10 level straight
lines of the scene are seen through each lens at each focal length, in images of 4288 x 2848 px, and every
zoom model of zoomjax is fitted to them: to all focal lengths, and to all but one interior one, on which it
is tested. (lensfunpy does not tell the aspect ratio of the images calibrated: all are taken to be 3:2.)

The prior of `SmoothZoom` is learned here, from half of the lenses for the other half; a lens that is in the
database under several names, or whose table is, is in one half only. `--prior` learns it from all instead
and prints the numbers that `zoomjax/models/smooth.py` has.

Once: lines, their compression, each frame's own optimum, and the second derivatives of its energy. Fits of
models linear in their parameters then are least squares of the frames' coefficients in that metric, which
have the answer without each frame in closed form, all lenses at once. What is reported is the true energy
of the lines left out; how far such fits are from `zoomjax.fit_zoom`, one by one, is measured too.
"""

import argparse
import importlib.metadata
import itertools
import json
import os
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.interpolate
import scipy.optimize

import zoomjax as zj
from zoomjax.fit.energy import line_residuals
from zoomjax.models.zoom import with_parameters

sys.path.append(str(Path(__file__).parents[1]))
from shared import RESULTS, machine

SIZE = (4288, 2848)
SCALE = float(np.hypot(*SIZE)) / 2
UPRIGHT, LEVEL, POINTS = 15, 10, 81
DRAWS = 2000
QUANTILES = (0.25, 0.5, 0.75, 0.9)


class Lens(NamedTuple):
    """A zoom of the database, by frame: focal length, model and its terms."""

    name: str
    crop: float
    frames: list[tuple[float, str, tuple[float, ...]]]


class Frames(NamedTuple):
    """A lens by frames: the energy of each, px^2, is ``energy + (k' - k)^T second (k' - k)``.

    Also a batch of lenses, with one more axis. Frames that only pad have zero second derivatives.
    """

    focal: Any  # (frame,), increasing; arrays of NumPy for one lens, of JAX for a batch
    k: Any  # (frame, 2), the optimum
    energy: Any  # (frame,)
    second: Any  # (frame, 2, 2)


def read_lenses() -> list[Lens]:
    """All rectilinear zooms with five or more calibrated focal lengths."""
    import lensfunpy

    lenses = []
    for lens in lensfunpy.Database().lenses:  # pyright: ignore[reportAttributeAccessIssue]
        frames = {c.focal: (c.focal, c.model.name, tuple(c.terms)) for c in lens.calib_distortion}
        if len(frames) >= 5 and lens.type.name == "RECTILINEAR":
            lenses.append(Lens(lens.model, lens.crop_factor, sorted(frames.values())))
    return lenses


def stretch(model: str, terms: tuple[float, ...], radius: np.ndarray) -> np.ndarray:
    """Distorted over corrected radius, at corrected radii in half the shorter side."""
    if model == "PTLENS":
        a, b, c = terms[:3]
        return ((a * radius + b) * radius + c) * radius + 1 - a - b - c
    if model == "POLY3":
        return terms[0] * radius**2 + 1 - terms[0]
    if model == "POLY5":
        return 1 + terms[0] * radius**2 + terms[1] * radius**4
    raise ValueError(f"The distortion model {model} is unknown.")


def see_lines(model: str, terms: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Straight lines through the lens: points, px, (line, point, 2), and which are in the image.

    They cross the image's axes at even distances, and are sampled evenly in the scene.
    """
    radius = np.linspace(0, 4, 1601)
    distorted = radius * stretch(model, terms, radius)
    falls = np.flatnonzero(np.diff(distorted) <= 0)
    end = falls[0] + 1 if falls.size else radius.size  # beyond this the lens folds
    half = (np.array(SIZE) - 1) / 2
    unit = SIZE[1] / 2
    corner = np.interp(np.hypot(*half) / unit, distorted[:end], radius[:end])
    points = []
    for axis, number in enumerate((UPRIGHT, LEVEL)):
        place = ((np.arange(number) + 0.5) / number * 2 - 1) * half[axis] / unit
        across = np.sign(place) * np.interp(np.abs(place), distorted[:end], radius[:end])
        grid = np.stack(np.meshgrid(across, np.linspace(-corner, corner, POINTS), indexing="ij"), -1)
        points.append(grid if axis == 0 else grid[..., ::-1])
    corrected = np.concatenate(points)
    distance = np.linalg.norm(corrected, axis=-1)
    seen = unit * corrected * stretch(model, terms, distance)[..., None]
    return seen + half, (np.abs(seen) <= half).all(-1) & (distance <= corner)


def make_lines(lenses: list[Lens]) -> zj.Lines:
    """The lines of all frames of all lenses."""
    frames = [frame for lens in lenses for frame in lens.frames]
    points, mask = (
        np.concatenate(a) for a in zip(*(see_lines(*frame[1:]) for frame in frames), strict=True)
    )
    return zj.Lines(
        points=jnp.asarray(np.where(mask[..., None], points, 0)),
        mask=jnp.asarray(mask),
        frame=jnp.asarray(np.repeat(np.arange(len(frames)), UPRIGHT + LEVEL)),
        focal=jnp.asarray([frame[0] for frame in frames]),
        centre=jnp.asarray((np.array(SIZE) - 1) / 2),
        image_size=SIZE,
        focal_unit="mm",
    )


@jax.jit
def frame_energies(triangle, k):
    """The true energy (eq. 3), px^2, of frames of compressed lines, for coefficients k (frame, 2)."""

    def one(triangle, k):
        return jnp.sum(frame_residuals(triangle, k) ** 2)

    return jax.lax.map(lambda a: one(*a), (triangle, k), batch_size=512)


def frame_residuals(triangle, k):
    """Residuals whose sum of squares is eq. 3, from the triangles (line, 7, 7) of a frame."""
    kappa = jnp.concatenate([jnp.ones(1), k])
    columns = triangle[:, 1:, 1:].reshape(triangle.shape[0], 6, 3, 2)
    rows = SCALE * jnp.einsum("lrjc,j->lrc", columns, kappa)
    distances = jax.vmap(line_residuals)(rows) / triangle[:, :1, 0]
    return distances / jnp.sqrt(triangle.shape[0])


@jax.jit
def second_derivatives(triangle, k):
    """Half of the Gauss-Newton matrices of the frames' energies."""

    def one(triangle, k):
        jacobian = jax.jacfwd(lambda k: frame_residuals(triangle, k))(k).reshape(-1, 2)
        return jacobian.T @ jacobian

    return jax.lax.map(lambda a: one(*a), (triangle, k), batch_size=512)


# Models linear in their parameters: all lenses at once, and without each frame in closed form


def legendre(u, degree):
    """Legendre's polynomials of 2u - 1, (..., degree + 1)."""
    return jnp.stack([*_legendre(2 * u - 1, degree)], axis=-1)


def _legendre(x, degree):
    low, high = jnp.ones_like(x), x
    for j in range(degree + 1):
        yield low
        low, high = high, ((2 * j + 3) * x * high - (j + 1) * low) / (j + 2)


@jax.custom_jvp
def inverse(matrix):
    """Of a positive definite matrix, by sweeps: LAPACK takes longer for a thousand small ones."""

    def sweep(i, matrix):
        pivot, row = matrix[i, i], matrix[i] / matrix[i, i]
        column = matrix[:, i]
        matrix = (matrix - column[:, None] * row[None]).at[i].set(row)
        return matrix.at[:, i].set(-column / pivot).at[i, i].set(1 / pivot)

    return jax.lax.fori_loop(0, matrix.shape[0], sweep, matrix)


@inverse.defjvp
def _inverse_jvp(primals, tangents):
    result = inverse(*primals)
    return result, -result @ tangents[0] @ result


def fit_linear(basis, frames, penalty):
    """One lens: coefficients (frame, 2) fitted to all frames, and to all but the frame itself.

    Without frame m the residual ``d = k - k_m`` becomes ``(1 - Q H)^-1 d``, with its second derivatives H
    and ``Q = basis_m G^-1 basis_m``, G those of the whole fit by the parameters; and Q becomes
    ``(1 - Q H)^-1 Q``, the third result: the covariance of the prediction, each frame's being 1/H.
    """
    size = 2 * basis.shape[1]
    matrix = jnp.einsum("fa,fij,fb->aibj", basis, frames.second, basis).reshape(size, size) + penalty
    right = jnp.einsum("fa,fij,fj->ai", basis, frames.second, frames.k).reshape(size)
    # Unit diagonal, and a ridge at rounding for models with as many parameters as frames.
    root = jnp.sqrt(jnp.diag(matrix))
    covariance = (
        inverse(matrix / root[:, None] / root[None] + 1e-13 * jnp.eye(size)) / root[:, None] / root[None]
    )
    fitted = basis @ (covariance @ right).reshape(-1, 2)
    q = jnp.einsum("fa,aibj,fb->fij", basis, covariance.reshape(-1, 2, size // 2, 2), basis)
    left = jnp.eye(2) - q @ frames.second
    return (
        fitted,
        frames.k + _solve_two(left, fitted - frames.k),
        jax.vmap(_solve_two, (None, -1), -1)(left, q),
    )


def _solve_two(matrix, right):
    """Batched 2 x 2 systems."""
    a, b, c, d = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 0], matrix[..., 1, 1]
    x, y = right[..., 0], right[..., 1]
    return jnp.stack([d * x - b * y, a * y - c * x], axis=-1) / (a * d - b * c)[..., None]


def inner(frames):
    """Which frames have a neighbour on both sides."""
    there = frames.second[..., 0, 0] > 0
    return (
        there
        & jnp.roll(there, 1, -1).at[..., 0].set(False)
        & jnp.roll(there, -1, -1).at[..., -1].set(False)
    )


def squared_error(frames, k):
    """The energy of each frame for other coefficients, as far as second derivatives tell."""
    d = k - frames.k
    return frames.energy + jnp.einsum("...fi,...fij,...fj->...f", d, frames.second, d)


def lens_error(frames, k):
    """The mean energy of a lens's interior frames."""
    chosen = inner(frames)
    return jnp.sum(jnp.where(chosen, squared_error(frames, k), 0), -1) / jnp.sum(chosen, -1)


def positions(frames):
    return frames.focal[..., :1] / frames.focal


@partial(jax.jit, static_argnums=1)
def fit_polynomials(frames, degree):
    """A batch of lenses by polynomials in 1/f."""
    nothing = jnp.zeros((2 * degree + 2,) * 2)
    return jax.vmap(fit_linear, in_axes=(0, 0, None))(legendre(positions(frames), degree), frames, nothing)


@partial(jax.jit, static_argnums=1)
def fit_chosen_degree(frames, degrees):
    """Each fit with the degree that predicts best within the frames it may see."""

    def chosen_among(frames, chosen):
        """Coefficients at all frames from the chosen ones alone."""
        second = jnp.where(chosen[:, None, None], frames.second, 0)
        seen = frames._replace(second=second)
        u = positions(frames)
        best, errors = [], []
        for degree in degrees:
            size = 2 * degree + 2
            fitted, left_out, _ = fit_linear(legendre(u, degree), seen, jnp.zeros((size, size)))
            d = left_out - frames.k
            error = jnp.einsum("fi,fij,fj->f", d, second, d)
            error = jnp.sum(jnp.where(inner(frames), error, 0))
            possible = (jnp.sum(chosen) > degree + 1) & jnp.isfinite(error)
            best.append(fitted)
            errors.append(jnp.where(possible, error, jnp.inf))
        return jnp.stack(best)[jnp.argmin(jnp.stack(errors))]

    def one(frames):
        there = frames.second[:, 0, 0] > 0
        number = there.shape[0]

        def leave(m):
            return chosen_among(frames, there & (jnp.arange(number) != m))[m]

        return chosen_among(frames, there), jax.lax.map(leave, jnp.arange(number)), None

    return jax.vmap(one)(frames)


# The prior of SmoothZoom

DEGREE = zj.SmoothZoom().degree


def triangle_of(numbers, size):
    """A lower triangular matrix with a positive diagonal from as many numbers as it has."""
    matrix = jnp.zeros((size, size)).at[jnp.tril_indices(size)].set(numbers)
    return jnp.tril(matrix, -1) + jnp.diag(jnp.exp(jnp.diag(matrix)))


def prior_of(numbers, degree):
    """The SmoothZoom that 25 numbers describe, in units in which a frame's energy is about isotropic."""
    unit = jnp.asarray(np.linalg.inv(np.linalg.cholesky(TYPICAL).T))  # from px to coefficients
    quadratic = jnp.kron(jnp.eye(3), unit) @ triangle_of(numbers[:21], 6)
    beyond = unit @ triangle_of(numbers[21:24], 2)
    lower = [jnp.linalg.cholesky(matrix @ matrix.T) for matrix in (quadratic, beyond)]
    return zj.SmoothZoom(
        degree=degree, error=jnp.exp(numbers[24]) / SCALE, quadratic=lower[0], beyond=lower[1]
    )


TYPICAL = np.array([[20466.0, 20914.0], [20914.0, 23203.0]])
"""Second derivatives of a frame's energy, px^2: the median of all. Only sets the units of the search."""


def penalty_of(zoom):
    """The matrix of the prior's quadratic form in the energies' sum."""
    zero = zoom.prepare(jnp.array([1.0]), 2)
    flat = jnp.zeros(zero.parameters.size)
    rows = jax.jacfwd(
        lambda flat: with_parameters(zero, flat.reshape(zero.parameters.shape)).standardised()
    )(flat)
    return (SCALE * zoom.error) ** 2 * rows.T @ rows


@jax.jit
def fit_smooth(frames, zoom):
    """A batch of lenses by a SmoothZoom."""
    basis = legendre(positions(frames), zoom.degree)
    return jax.vmap(fit_linear, in_axes=(0, 0, None))(basis, frames, penalty_of(zoom))


@partial(jax.jit, static_argnums=3)
@jax.value_and_grad
def prior_loss(numbers, batches, weights, degree):
    """How badly a prior predicts the frames left out: the mean logarithm of the lenses' errors.

    Not how unlikely it makes them: a few lenses with wild tables decide that, and the rest do worse.
    """
    zoom = prior_of(numbers, degree)
    errors = jnp.concatenate([lens_error(frames, fit_smooth(frames, zoom)[1]) for frames in batches])
    return weights @ jnp.log(errors + 0.01) / jnp.sum(weights) + 1e-4 * jnp.sum(numbers**2)


def learn(lenses: list[Frames], chosen: np.ndarray, degree: int = DEGREE) -> zj.SmoothZoom:
    """The prior that predicts the frames left out of the chosen lenses best."""
    members, batches = zip(*batches_of(lenses, np.arange(len(lenses))), strict=True)
    weights = jnp.asarray(chosen[np.concatenate(members)], float)
    start = np.zeros(25)
    start[[0, 2, 5, 9, 14, 20]] = np.log(5)
    start[24] = -2
    found = scipy.optimize.minimize(
        lambda x: tuple(np.asarray(a, float) for a in prior_loss(x, batches, weights, degree)),
        start,
        jac=True,
        method="L-BFGS-B",
        options={"maxiter": 120},
    )
    return calibrated(
        prior_of(jnp.asarray(found.x), degree),
        [lens for _, lens in batches_of(lenses, np.flatnonzero(chosen))],
    )


def calibrated(zoom: zj.SmoothZoom, batches: list[Frames]) -> zj.SmoothZoom:
    """The same prior and error, both so much larger or smaller that errors are as large as expected.

    Fits depend on their ratio alone. In the median over the frames left out, for a few lenses are wild.
    """
    ratios = []
    for frames in batches:
        _, left_out, q = fit_smooth(frames, zoom)
        d, chosen = left_out - frames.k, inner(frames)
        # (Q + 1/H)^-1 d = H (1 + Q H)^-1 d
        part = _solve_two(jnp.eye(2) + q @ frames.second, d)
        ratios.append(jnp.einsum("...fi,...fij,...fj->...f", d, frames.second, part)[chosen])
    expected = 2 * np.log(2)  # the median of chi squared with two degrees of freedom
    factor = jnp.sqrt(jnp.median(jnp.concatenate(ratios)) / expected) / (SCALE * zoom.error)
    return zj.SmoothZoom(
        degree=zoom.degree,
        error=factor * zoom.error,
        quadratic=factor * zoom.quadratic,
        beyond=factor * zoom.beyond,
    )


# Interpolation, and what is not linear: one fit after the other


def interpolate(frames: Frames, asked: np.ndarray, kind: str) -> np.ndarray:
    """Tables and splines through the frames' own coefficients: what fits with a knot at each frame are."""
    x = frames.focal if kind == "table in f" else 1 / frames.focal
    at = asked if kind == "table in f" else 1 / asked
    order = np.argsort(x)
    x, k = x[order], frames.k[order]
    if kind == "nearest frame":
        return k[np.argmin(np.abs(x[:, None] - at[None]), axis=0)]
    if kind == "monotone cubic in 1/f":
        return scipy.interpolate.PchipInterpolator(x, k)(at)
    if kind == "spline in 1/f":
        return scipy.interpolate.CubicSpline(x, k, bc_type="natural")(at)
    return np.stack([np.interp(at, x, column) for column in k.T], axis=-1)


def weighted(frames: Frames, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least squares in the energies' metric: of columns (..., frame, 2, parameter), and the energy."""
    matrix = np.einsum("...fip,fij,...fjq->...pq", columns, frames.second, columns, optimize=True)
    right = np.einsum("...fip,fij,fj->...p", columns, frames.second, frames.k, optimize=True)
    ridge = 1e-12 * np.einsum("...pp->...", matrix)[..., None, None] * np.eye(matrix.shape[-1])
    parameters = np.linalg.solve(matrix + ridge, right[..., None])[..., 0]
    return parameters, -np.einsum("...p,...p->...", parameters, right)


def power_columns(c: np.ndarray, exponents: np.ndarray) -> np.ndarray:
    """Of ``k_i = d0 + d1 c^d2``: (pair of exponents, frame, 2, 4)."""
    powers = c[None, :, None] ** exponents[:, None, :]
    columns = np.zeros((*powers.shape, 4))
    for i in (0, 1):
        columns[..., i, 2 * i] = 1
        columns[..., i, 2 * i + 1] = powers[..., i]
    return columns


def power_law(frames: Frames, asked: np.ndarray) -> np.ndarray:
    """PowerZoom: the best exponents by a search on ever finer grids, the rest by least squares."""
    shortest = frames.focal.min()
    centre, step = np.array([-3.0, -3.0]), 1.0
    for half in (6, 2, 2, 2, 2):
        grid = step * np.stack(np.meshgrid(*[np.arange(-half, half + 1)] * 2), -1).reshape(-1, 2)
        exponents = centre + grid
        exponents = np.where(np.abs(exponents) < 1e-6, 1e-6, exponents)
        _, energy = weighted(frames, power_columns(frames.focal / shortest, exponents))
        centre, step = exponents[np.nanargmin(energy)], step / 2
    parameters, _ = weighted(frames, power_columns(frames.focal / shortest, centre[None]))
    return (power_columns(asked / shortest, centre[None]) @ parameters[:, None, :, None])[0, ..., 0]


def two_regions(frames: Frames, asked: np.ndarray) -> np.ndarray | None:
    """TwoRegionZoom, where k1 changes its sign with three focal lengths or more on either side."""
    if not (np.diff(np.sign(frames.k[:, 0])) != 0).any():
        return None
    crossover = zj.models.barrel_crossover(frames.focal, frames.k[:, 0])
    result = np.zeros((len(asked), 2))
    for train, test in (
        (frames.focal < crossover, asked < crossover),
        (frames.focal >= crossover, asked >= crossover),
    ):
        if train.sum() < 3:
            return None
        u, at = (frames.focal.min() / x for x in (frames.focal[train], asked[test]))
        columns = np.einsum("fa,ij->fiaj", u[:, None] ** np.arange(3), np.eye(2)).reshape(len(u), 2, 6)
        parameters, _ = weighted(Frames(*(values[train] for values in frames)), columns)
        result[test] = at[:, None] ** np.arange(3) @ parameters.reshape(3, 2)
    return result


def one_by_one(lens: Frames, model: Callable[[Frames, np.ndarray], np.ndarray | None]):
    """Coefficients fitted to all frames, and to all but the frame itself, if interior; NaN: cannot be."""
    number = len(lens.focal)
    fitted, left_out = np.full((number, 2), np.nan), np.full((number, 2), np.nan)
    whole = model(lens, lens.focal)
    fitted = fitted if whole is None else whole
    for m in range(1, number - 1):
        rest = Frames(*(np.delete(values, m, axis=0) for values in lens))
        found = model(rest, lens.focal[m : m + 1])
        left_out[m] = np.nan if found is None else found[0]
    return fitted, left_out


# The study


def batches_of(lenses: list[Frames], chosen: np.ndarray) -> list[tuple[np.ndarray, Frames]]:
    """Lenses of like numbers of frames together, padded: their indices, and their frames."""
    sizes = np.array([len(lens.focal) for lens in lenses])
    result, low = [], 0
    for high in (8, 32, max(33, sizes.max())):
        members = chosen[(sizes[chosen] > low) & (sizes[chosen] <= high)]
        low = high
        if members.size:
            padded = [_padded(lenses[i], high) for i in members]
            result.append(
                (members, Frames(*(jnp.asarray(np.stack(values)) for values in zip(*padded, strict=True))))
            )
    return result


def _padded(lens: Frames, size: int) -> Frames:
    more = size - len(lens.focal)
    focal = np.pad(lens.focal, (0, more), mode="edge")
    return Frames(focal, *(np.pad(a, [(0, more)] + [(0, 0)] * (a.ndim - 1)) for a in lens[1:]))


def all_lenses(lenses: list[Frames], fit: Callable, chosen: np.ndarray | None = None) -> list[tuple]:
    """A batched fit of all lenses, or of some: fitted, left out of each."""
    chosen = np.arange(len(lenses)) if chosen is None else chosen
    result: list[Any] = [None] * len(lenses)
    for members, frames in batches_of(lenses, chosen):
        fitted, left_out = (np.asarray(k) for k in fit(frames)[:2])
        for row, i in enumerate(members):
            number = len(lenses[i].focal)
            result[i] = fitted[row, :number], left_out[row, :number]
    return result


def families(lenses: list[Lens]) -> np.ndarray:
    """For each lens the first one with the same table or the same name, directly or through others."""
    first = np.arange(len(lenses))
    for key in ([lens.name for lens in lenses], [str(lens.frames) for lens in lenses]):
        for value in set(key):
            same = [i for i, other in enumerate(key) if other == value]
            joined = np.isin(first, first[same])
            first[joined] = first[joined].min()
    return first


def halves(family: np.ndarray, seed: int = 0) -> np.ndarray:
    """0 or 1 for each lens, a family together."""
    names = np.unique(family)
    side = np.random.default_rng(seed).permutation(len(names)) % 2
    return side[np.searchsorted(names, family)]


class Bootstrap:
    """Resampled lenses, whole families at a time."""

    def __init__(self, family: np.ndarray):
        names, index = np.unique(family, return_inverse=True)
        draws = np.random.default_rng(1).multinomial(len(names), np.full(len(names), 1 / len(names)), DRAWS)
        self.weight = draws[:, index]  # (draw, lens)

    def quantile(self, values: np.ndarray, q: float) -> np.ndarray:
        """Of each draw, lenses without a value left out."""
        known = np.flatnonzero(np.isfinite(values))
        order = known[np.argsort(values[known])]
        total = np.cumsum(self.weight[:, order], axis=1)
        place = np.argmax(total >= q * total[:, -1:], axis=1)
        return values[order][place]

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Of each draw, lenses without a value left out."""
        known = np.isfinite(values)
        return self.weight[:, known] @ values[known] / self.weight[:, known].sum(1)


def interval(draws: np.ndarray) -> list[float]:
    return np.quantile(draws, [0.025, 0.975]).tolist()


def twice_calibrated(lenses: list[Lens], data: list[Frames], triangles: list[np.ndarray]) -> np.ndarray:
    """What two calibrations of the same lens disagree by, px, over sqrt(2): one value a pair and lens.

    Pairs of tables under one name, for sensors of different sizes. The smaller sees the middle of what the
    larger does: the larger's coefficients, in its radius, correct the smaller's lines at focal lengths that
    both have within 2 %; what is beyond the smaller's own optimum is the disagreement.
    """
    by_name = defaultdict(list)
    for i, lens in enumerate(lenses):
        by_name[lens.name].append(i)
    values = []
    for group in by_name.values():
        for i in group:
            for j in group:
                ratio = lenses[i].crop / lenses[j].crop
                if i == j or ratio > 1 or str(lenses[i].frames) == str(lenses[j].frames):
                    continue
                apart = np.abs(np.log(data[i].focal[:, None] / data[j].focal[None]))
                a, b = np.nonzero(apart < 0.02)
                if a.size:
                    k = data[i].k[a] * ratio ** np.array([2, 4])
                    excess = np.asarray(frame_energies(triangles[j][b], k)) - data[j].energy[b]
                    values.append(np.sqrt(np.mean(np.maximum(excess, 0)) / 2))
    return np.array(values)


def check_against_package(lines, lenses, data, zooms, fits, every=16):
    """Fits by zoomjax.fit_zoom, one by one, without one interior frame: RMS px of theirs and ours there."""
    start = np.cumsum([0] + [len(d.focal) for d in data])
    table = []
    for name, zoom in zooms.items():
        pairs = []
        for i in range(0, len(data), every):
            number = len(data[i].focal)
            if number > 8:  # each number of frames is one more program to compile
                continue
            m = number // 2
            triangle, focal = frames_of(lines, start[i] + np.delete(np.arange(number), m))
            small = zj.lines.CompressedLines(
                triangle=triangle.reshape(-1, 7, 7),
                frame=jnp.repeat(jnp.arange(number - 1), UPRIGHT + LEVEL),
                focal=focal,
                centre=lines.centre,
                image_size=SIZE,
                focal_unit="mm",
            )
            fit = zj.fit_zoom(small, zoom=zoom(i))
            k = np.stack([fit.lens.zoom(jnp.asarray(data[i].focal[m])), fits[name][i][1][m]])
            test, _ = frames_of(lines, np.array([start[i] + m] * 2))
            pairs.append(np.sqrt(np.asarray(frame_energies(test, jnp.asarray(k)))))
        difference = np.abs(np.diff(np.array(pairs), axis=1))
        table.append((name, len(pairs), float(np.median(difference)), float(np.max(difference))))
    return table


def frames_of(lines, frames):
    """Triangles (frame, line, 7, 7) and focal lengths of some frames of compressed lines."""
    whole = lines.triangle.reshape(-1, UPRIGHT + LEVEL, 7, 7)
    return whole[frames], lines.focal[frames]


def study() -> dict:
    """All measurements."""
    clock = time.perf_counter()
    times = {}

    def lap(name):
        nonlocal clock
        times[name] = time.perf_counter() - clock
        clock = time.perf_counter()
        print(f"{name}: {times[name]:.1f} s", flush=True)

    lenses, lines, data = read()
    triangle = frames_of(lines, ...)[0]
    start = np.cumsum([0] + [len(lens.focal) for lens in data])
    parts = np.split(np.asarray(triangle), start[1:-1])
    lap("lines, and each frame by itself")

    family = families(lenses)
    side = halves(family)
    # What is independent goes side by side: half of the time is compiling, which takes one core.
    with ThreadPoolExecutor(2) as pool:
        learned = list(pool.map(lambda part: learn(data, side != part), (0, 1)))
    lap("priors of both halves")

    def cross_fitted():
        smooth: list[Any] = [None] * len(data)
        for part, zoom in enumerate(learned):
            mine = all_lenses(data, partial(fit_smooth, zoom=zoom), np.flatnonzero(side == part))
            smooth = [new or old for new, old in zip(mine, smooth, strict=True)]
        return smooth

    kinds = ("nearest frame", "table in f", "table in 1/f", "spline in 1/f", "monotone cubic in 1/f")
    every_fit: dict[str, Callable[[], list]] = {
        **{f"degree {n}": partial(all_lenses, data, partial(fit_polynomials, degree=n)) for n in range(4)},
        "degree chosen inside": partial(all_lenses, data, partial(fit_chosen_degree, degrees=(1, 2, 3))),
        **{k: lambda k=k: [one_by_one(lens, partial(interpolate, kind=k)) for lens in data] for k in kinds},
        "power law": lambda: [one_by_one(lens, power_law) for lens in data],
        "two regions": lambda: [one_by_one(lens, two_regions) for lens in data],
        "SmoothZoom, other half's prior": cross_fitted,
        "SmoothZoom, as in the package": partial(
            all_lenses, data, partial(fit_smooth, zoom=zj.SmoothZoom())
        ),
    }
    with ThreadPoolExecutor(2) as pool:
        running = {name: pool.submit(fit) for name, fit in every_fit.items()}
    fits = {name: future.result() for name, future in running.items()}
    lap("fits")

    interior = np.concatenate([np.r_[False, np.ones(len(d.focal) - 2, bool), False] for d in data])

    def by_lens(frame_values, chosen):
        return np.array(
            [np.sqrt(np.mean(frame_values[a:b][chosen[a:b]])) for a, b in itertools.pairwise(start)]
        )

    every = np.ones(start[-1], bool)
    own = np.concatenate([d.k for d in data])
    rows, left_out = {}, {}
    bootstrap = Bootstrap(family)
    none = by_lens(np.asarray(frame_energies(triangle, np.zeros_like(own))), every)
    frames_alone = by_lens(np.concatenate([d.energy for d in data]), every)
    frames_inner = by_lens(np.concatenate([d.energy for d in data]), interior)
    for name, fit in fits.items():
        row: dict[str, Any] = {}
        for which, label in ((0, "in_sample"), (1, "left_out")):
            k = np.concatenate([pair[which] for pair in fit])
            chosen = every if which == 0 else interior
            error = by_lens(np.asarray(frame_energies(triangle, np.nan_to_num(k))), chosen)
            corner = by_lens((SCALE * np.sum(k - own, axis=1)) ** 2, chosen)
            error = np.where(np.isfinite(corner), error, np.nan)
            row["lenses"] = int(np.isfinite(error).sum())
            row[label] = {
                "rms": np.nanquantile(error, QUANTILES).tolist(),
                "median_interval": interval(bootstrap.quantile(error, 0.5)),
                "corner": np.nanquantile(corner, QUANTILES).tolist(),
            }
        left_out[name] = error
        rows[name] = row
    ours = left_out["SmoothZoom, other half's prior"]
    paired = {}
    for name, error in left_out.items():
        ratio = np.log(ours / error)
        paired[name] = {
            "lenses": int(np.isfinite(ratio).sum()),
            "ratio": float(np.exp(np.nanmean(ratio))),
            "ratio_interval": np.exp(interval(bootstrap.mean(ratio))).tolist(),
            "better": float(np.mean(ratio[np.isfinite(ratio)] < 0)),
            "differences": [
                [
                    float(np.quantile(ours[k], q) - np.quantile(error[k], q)),
                    *interval(
                        bootstrap.quantile(np.where(k, ours, np.nan), q) - bootstrap.quantile(error, q)
                    ),
                ]
                for k in (np.isfinite(error),)
                for q in QUANTILES
            ],
        }
    pairs = twice_calibrated(lenses, data, parts)
    lap("true energies and intervals")
    study_time, processor = sum(times.values()), time.process_time()
    check = check_against_package(
        lines,
        lenses,
        data,
        {
            "degree 2": lambda i: zj.PolynomialZoom(),
            "SmoothZoom, other half's prior": lambda i: learned[side[i]],
        },
        fits,
    )
    lap("comparison with fit_zoom")
    return {
        "lenses": len(lenses),
        "families": len(np.unique(family)),
        "tables": len({str(lens.frames) for lens in lenses}),
        "frames": int(start[-1]),
        "left_out": int(interior.sum()),
        "none": np.quantile(none, QUANTILES).tolist(),
        "frames_alone": np.quantile(frames_alone, QUANTILES).tolist(),
        "frames_alone_interior": np.quantile(frames_inner, QUANTILES).tolist(),
        "models": rows,
        "paired": paired,
        "twice": {"pairs": len(pairs), "rms": np.quantile(pairs, QUANTILES).tolist()},
        "check": check,
        "seconds": study_time,
        "processor": processor,
        "load": os.getloadavg()[1],
        "times": times,
    }


def read() -> tuple[list[Lens], zj.lines.CompressedLines, list[Frames]]:
    """The lenses, their lines compressed, and each frame by itself."""
    lenses = read_lenses()
    lines = zj.compress(make_lines(lenses))
    each = zj.fit_frames(lines, throw=False)
    second = second_derivatives(frames_of(lines, ...)[0], each.coefficients)
    cuts = np.cumsum([len(lens.frames) for lens in lenses])[:-1]
    values = (lines.focal, each.coefficients, each.frame_rms**2, second)
    parts = zip(*(np.split(np.asarray(value), cuts) for value in values), strict=True)
    return lenses, lines, [Frames(*part) for part in parts]


def print_prior() -> None:
    """Learn the prior from all lenses."""
    lenses, _, data = read()
    zoom = learn(data, np.ones(len(lenses), bool))
    with np.printoptions(precision=4, suppress=True):
        print(
            f"error {float(zoom.error):.3g}", np.asarray(zoom.quadratic), np.asarray(zoom.beyond), sep="\n"
        )


def print_forms() -> None:
    """How much the degree matters, and what comes out if each half of the lenses chooses its own.

    In a half the degree is chosen by priors that one part of it learns and the other tests; so the lenses
    tested in the end have no part in the choice. (The family, Legendre polynomials with variances that fall
    with the fourth power of the order, was found with all lenses at hand.)
    """
    lenses, _, data = read()
    family = families(lenses)
    side, quarter = halves(family), halves(family, seed=7)

    def tested(zoom, chosen):
        fits = all_lenses(data, partial(fit_smooth, zoom=zoom))
        errors = [
            float(np.sqrt(lens_error(Frames(*map(jnp.asarray, lens)), jnp.asarray(fit[1]))))
            for lens, fit, c in zip(data, fits, chosen, strict=True)
            if c
        ]
        return np.array(errors)

    inside: dict[int, dict[int, float]] = {0: {}, 1: {}}
    outside: dict[int, dict[int, np.ndarray]] = {0: {}, 1: {}}
    for degree in (4, 5, 6, 8):
        for half in (0, 1):
            logs = [
                np.log(
                    tested(learn(data, mine & (quarter != part), degree), mine & (quarter == part)) ** 2
                    + 0.01
                )
                for mine in (side == half,)
                for part in (0, 1)
            ]
            inside[half][degree] = float(np.mean(np.concatenate(logs)))
            outside[half][degree] = tested(learn(data, side == half, degree), side != half)
        both = np.concatenate([outside[half][degree] for half in (0, 1)])
        print(f"degree {degree}:", np.quantile(both, QUANTILES).round(3), flush=True)
    chosen = [min(inside[half], key=lambda degree: inside[half][degree]) for half in (0, 1)]
    both = np.concatenate([outside[half][chosen[half]] for half in (0, 1)])
    print(f"chosen in each half, {chosen}:", np.quantile(both, QUANTILES).round(3))


def markdown(r: dict) -> str:
    """The results as a page."""
    m = r["machine"]

    def row(name, figures, more=()):
        return f"| {name} | " + " | ".join([*(f"{x:.3f}" for x in figures), *more]) + " |"

    def between(ends, digits=3):
        return f"{ends[0]:.{digits}f} to {ends[1]:.{digits}f}"

    by_name = {
        name: (model["left_out"], model["in_sample"], model["lenses"])
        for name, model in r["models"].items()
    }
    order = sorted(by_name, key=lambda name: by_name[name][0]["rms"][1])
    page = [
        "# Six hundred real zoom lenses",
        "",
        f"`python benchmarks/real/lensfun.py`: {r['lenses']} rectilinear zooms of the lensfun database "
        f"(lensfunpy {m['lensfunpy']}) calibrated at five or more focal lengths, {r['frames']:,} in "
        "all, of which "
        f"{r['left_out']:,} are interior and left out in turn. {r['tables']} of the tables are "
        "distinct, and "
        f"{r['families']} families of lenses have neither a name nor a table in common: intervals (95 "
        "%) are by "
        f"bootstrap over families. {UPRIGHT + LEVEL} lines a focal length, seen in {SIZE[0]} × "
        f"{SIZE[1]} px, no noise "
        "but that of the calibrations. RMS distance to straightness, px, of each lens; quantiles over "
        "the lenses.",
        "",
        f"{m['cpu']}, {m['cores']} cores, {m['memory_GB']} GB; Python {m['python']}, jax {m['jax']}, numpy "
        f"{m['numpy']}, scipy {m['scipy']}; on {m['device']}. The study took {r['seconds']:.0f} s, "
        "compilation "
        f"included, and {r['processor']:.0f} s of processor time, on a machine with a load of "
        f"{r['load']:.1f} ("
        + ", ".join(
            f"{name} {seconds:.0f} s" for name, seconds in r["times"].items() if "fit_zoom" not in name
        )
        + ").",
        "",
        "## A focal length left out",
        "",
        "| | 25 % | median | 75 % | 90 % | interval of the median | corner, median | lenses |",
        "|---|---:|---:|---:|---:|---:|---:|---:|",
        row(
            "its own optimum (no model can do better)",
            r["frames_alone_interior"],
            ["", "0", str(r["lenses"])],
        ),
        *(
            row(
                name,
                by_name[name][0]["rms"],
                [
                    between(by_name[name][0]["median_interval"]),
                    f"{by_name[name][0]['corner'][1]:.2f}",
                    str(by_name[name][2]),
                ],
            )
            for name in order
        ),
        "",
        "`corner` is how far, px, the displacement at the image's corner is from that of the frame's "
        "own optimum. "
        "The prior of `SmoothZoom` was learned from the other half of the lenses, families kept "
        "together; as it "
        "is in the package it was learned from all of them, so that its row is in sample. What shape "
        "the prior has was found with all lenses at hand (see docs/zoom-models.md). Monotone cubics and "
        "the nearest frame are no models of the package; `degree chosen inside` takes the degree, 1 to "
        "3, that "
        "predicts best within the focal lengths it may see. Power law and two regions are fitted to k1 "
        "and k2.",
        "",
        "## Lens by lens",
        "",
        "`SmoothZoom` with the other half's prior against each model, on the same lenses: the "
        "geometric mean of the "
        "ratio of their errors, the part of the lenses on which it is better, and the difference of "
        "the quantiles, "
        "px, with paired intervals.",
        "",
        "| against | ratio | interval | better | 25 % | median | 75 % | 90 % |",
        "|---|---:|---:|---:|---:|---:|---:|---:|",
        *(
            f"| {name} | {p['ratio']:.3f} | {between(p['ratio_interval'])} | {100 * p['better']:.0f} % | "
            + " | ".join(f"{d:+.3f} ({low:+.3f} to {high:+.3f})" for d, low, high in p["differences"])
            + " |"
            for name in order
            if not name.startswith("SmoothZoom, other")
            for p in (r["paired"][name],)
        ),
        "",
        "## In sample",
        "",
        "| | 25 % | median | 75 % | 90 % | interval of the median | corner, median | lenses |",
        "|---|---:|---:|---:|---:|---:|---:|---:|",
        row("no correction", r["none"], ["", "", str(r["lenses"])]),
        row("frame by frame", r["frames_alone"], ["", "0", str(r["lenses"])]),
        *(
            row(
                name,
                by_name[name][1]["rms"],
                [
                    between(by_name[name][1]["median_interval"]),
                    f"{by_name[name][1]['corner'][1]:.2f}",
                    str(by_name[name][2]),
                ],
            )
            for name in order
            if by_name[name][1]["rms"][1] > r["frames_alone"][1] + 1e-3
        ),
        "",
        "Tables and splines with an entry at each focal length are frame by frame in sample.",
        "",
        "## The floor",
        "",
        f"{r['twice']['pairs']} times the database has a lens twice, calibrated by hand on sensors of "
        "different sizes. "
        "Corrected by the one calibration, lines of the other at the same focal lengths (within 2 %) "
        "are less "
        "straight than by its own; over √2, that is what one calibration is wrong by: "
        f"25 / 50 / 75 / 90 %: {' / '.join(f'{x:.3f}' for x in r['twice']['rms'])} px (two copies of "
        "the lens differ, "
        "too). The frame left out is one calibration, and the prediction is made from others: even the "
        "true curve "
        f"would be off by about {np.hypot(r['twice']['rms'][1], r['frames_alone_interior'][1]):.2f} px "
        "in the median, with "
        "what two coefficients cannot follow.",
        "",
        "## How far the study's fits are from those of fit_zoom",
        "",
        "Every 16th lens, if it has up to 8 focal lengths, its middle one left out: difference, px, of "
        "the RMS there. It is rounding, for the scene's lines are symmetric about the image's axes: "
        "their direction then does not depend on k, and the energy is exactly quadratic in it.",
        "",
        "| | fits | median | largest |",
        "|---|---:|---:|---:|",
        *(
            f"| {name} | {number} | {median:.0e} | {largest:.0e} |"
            for name, number, median, largest in r["check"]
        ),
        "",
    ]
    return "\n".join(page)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path, default=RESULTS / "lensfun.md")
    parser.add_argument("--prior", action="store_true", help="learn the prior from all lenses and print it")
    parser.add_argument("--forms", action="store_true", help="compare degrees of SmoothZoom and print them")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.prior:
        print_prior()
    elif options.forms:
        print_forms()
    else:
        versions = {"lensfunpy": importlib.metadata.version("lensfunpy")}
        measured = {"machine": machine() | versions, **study()}
        options.output.write_text(markdown(measured))
        options.output.with_suffix(".json").write_text(json.dumps(measured, indent=1) + "\n")
        print(options.output.read_text())
