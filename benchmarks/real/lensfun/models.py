"""The zoom models: coefficients fitted to all frames of a lens, and to all but each interior one.

Models linear in their parameters are least squares of the frames' coefficients in the metric of their
energies' second derivatives: they have the answer without each frame in closed form, all lenses at once.
Interpolation, and what is not linear, is one fit after the other.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.interpolate

import zoomjax as zj

from .data import Frames

FEW = (2, 3, 4)
"""Numbers of focal lengths that are fitted where few are known."""


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
        frames.k + solve_two(left, fitted - frames.k),
        jax.vmap(solve_two, (None, -1), -1)(left, q),
    )


def solve_two(matrix, right):
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


def some_of(frames, number):
    """A few of a lens's frames, from the first to the last, as evenly in 1/f as there are."""
    u, there = positions(frames), frames.second[..., 0, 0] > 0
    last = jnp.min(jnp.where(there, u, 1), axis=-1, keepdims=True)
    wanted = 1 + (last - 1) * jnp.linspace(0, 1, number)
    far = jnp.abs(jnp.where(there, u, jnp.inf)[..., None] - wanted[..., None, :])
    nearest = jnp.argmin(far, axis=-2)
    return jnp.any(jnp.arange(u.shape[-1])[:, None] == nearest[..., None, :], axis=-1)


def lens_error(frames, k, chosen=None):
    """The mean energy of a lens's interior frames, or of those chosen."""
    chosen = inner(frames) if chosen is None else chosen
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


def all_lenses(
    lenses: list[Frames],
    fit: Callable,
    chosen: np.ndarray | None = None,
    facts: np.ndarray | None = None,
) -> list[tuple]:
    """A batched fit of all lenses, or of some, also of the facts of each: fitted, left out of each."""
    chosen = np.arange(len(lenses)) if chosen is None else chosen
    result: list[Any] = [None] * len(lenses)
    for members, frames in batches_of(lenses, chosen):
        more = () if facts is None else (jnp.asarray(facts[members]),)
        fitted, left_out = (np.asarray(k) for k in fit(frames, *more)[:2])
        for row, i in enumerate(members):
            number = len(lenses[i].focal)
            result[i] = fitted[row, :number], left_out[row, :number]
    return result


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
    signs = np.sign(frames.k[:, 0][frames.k[:, 0] != 0])
    if not np.diff(signs).any():
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
