"""The prior of `SmoothZoom`, learned from the lenses."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

import zoomjax as zj
from zoomjax.models.zoom import with_parameters

from .data import QUANTILES, SCALE, Frames, families, halves, read
from .models import (
    FEW,
    all_lenses,
    batches_of,
    fit_linear,
    inner,
    legendre,
    lens_error,
    positions,
    solve_two,
    some_of,
)

DEGREE = zj.SmoothZoom().degree
TYPICAL = np.array([[20466.0, 20914.0], [20914.0, 23203.0]])
"""Second derivatives of a frame's energy, px^2: the median of all. Only sets the units of the search."""


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


@partial(jax.jit, static_argnums=1)
def few_errors(frames, number, zoom):
    """Mean energies of a batch of lenses where only some focal lengths are fitted: at the inner others."""
    fitted = some_of(frames, number)
    seen = frames._replace(second=jnp.where(fitted[..., None, None], frames.second, 0))
    return lens_error(frames, fit_smooth(seen, zoom)[0], inner(frames) & ~fitted)


@partial(jax.jit, static_argnums=3)
@jax.value_and_grad
def prior_loss(numbers, batches, weights, degree):
    """How badly a prior predicts frames that are not fitted: the mean logarithm of the lenses' errors.

    One of all is left out, or all but a few. Not how unlikely the prior makes them: a few lenses with wild
    tables decide that, and the rest do worse.
    """
    zoom = prior_of(numbers, degree)

    def of(errors):
        return weights @ jnp.log(jnp.concatenate(errors) + 0.01) / jnp.sum(weights)

    one = of([lens_error(frames, fit_smooth(frames, zoom)[1]) for frames in batches])
    few = [of([few_errors(frames, number, zoom) for frames in batches]) for number in FEW]
    return (3 * one + 2 * sum(few) / len(FEW)) / 5 + 1e-4 * jnp.sum(numbers**2)


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
        part = solve_two(jnp.eye(2) + q @ frames.second, d)
        ratios.append(jnp.einsum("...fi,...fij,...fj->...f", d, frames.second, part)[chosen])
    expected = 2 * np.log(2)  # the median of chi squared with two degrees of freedom
    factor = jnp.sqrt(jnp.median(jnp.concatenate(ratios)) / expected) / (SCALE * zoom.error)
    return zj.SmoothZoom(
        degree=zoom.degree,
        error=factor * zoom.error,
        quadratic=factor * zoom.quadratic,
        beyond=factor * zoom.beyond,
    )


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
