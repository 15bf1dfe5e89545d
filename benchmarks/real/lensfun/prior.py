"""The prior of `SmoothZoom`, learned from the lenses."""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

import zoomjax as zj
from zoomjax.models.smooth import facts_of
from zoomjax.models.zoom import with_parameters

from .data import QUANTILES, SCALE, Frames, Lens, families, halves, read
from .models import (
    FEW,
    all_lenses,
    batches_of,
    fit_linear,
    inner,
    legendre,
    lens_error,
    solve_two,
    some_of,
)

DEGREE = zj.SmoothZoom().degree
TYPICAL = np.array([[20466.0, 20914.0], [20914.0, 23203.0]])
"""Second derivatives of a frame's energy, px^2: the median of all. Only sets the units of the search."""

UNIT = np.linalg.inv(np.linalg.cholesky(TYPICAL).T)
"""From px to coefficients, so that a frame's energy is about isotropic."""

OWN = 25
"""Numbers of a prior that knows nothing of a lens."""


class Prior(NamedTuple):
    """What is learned.

    Attributes:
        zoom: the prior of mean 0.
        weights: (fact, 7): what makes of the facts of a lens the mean of its first parameters, and the
            logarithm of what the error is multiplied by; no rows for a prior that knows none.
    """

    zoom: zj.SmoothZoom
    weights: Any

    def mean(self, facts):
        """(lens, 3, 2), for lenses of these facts (lens, fact)."""
        return (facts @ self.weights[:, :6]).reshape(-1, 3, 2)

    def factor(self, facts):
        """(lens,): of the error."""
        return jnp.exp(facts @ self.weights[:, 6])

    def of(self, facts) -> zj.SmoothZoom:
        """The prior of one lens."""
        if not self.weights.size:
            return self.zoom
        error = self.zoom.error * self.factor(facts)
        return dataclasses.replace(self.zoom, error=error, mean=jnp.asarray(self.mean(facts)[0]))


def facts_of_all(lenses: list[Lens]) -> np.ndarray:
    """What the conditioned prior knows of each lens: the ends of its range and the crop factor."""
    ends = [(lens.frames[0][0], lens.frames[-1][0], lens.crop) for lens in lenses]
    return np.array([facts_of(*of) for of in ends])


def no_facts(lenses: list[Any]) -> np.ndarray:
    """Nothing is known of any lens."""
    return np.zeros((len(lenses), 0))


def triangle_of(numbers, size):
    """A lower triangular matrix with a positive diagonal from as many numbers as it has."""
    matrix = jnp.zeros((size, size)).at[jnp.tril_indices(size)].set(numbers)
    return jnp.tril(matrix, -1) + jnp.diag(jnp.exp(jnp.diag(matrix)))


def prior_of(numbers, degree):
    """The prior that 25 numbers describe, and seven for each fact, in px and logarithms of px."""
    units = jnp.kron(jnp.eye(3), jnp.asarray(UNIT))
    quadratic = units @ triangle_of(numbers[:21], 6)
    beyond = UNIT @ triangle_of(numbers[21:24], 2)
    lower = [jnp.linalg.cholesky(matrix @ matrix.T) for matrix in (quadratic, beyond)]
    error = jnp.exp(numbers[24]) / SCALE
    zoom = zj.SmoothZoom(degree=degree, error=error, quadratic=lower[0], beyond=lower[1])
    weights = numbers[OWN:].reshape(-1, 7)
    return Prior(zoom, jnp.concatenate([weights[:, :6] @ units.T, weights[:, 6:]], axis=1))


def penalty_of(zoom):
    """The matrix of the prior's quadratic form in the energies' sum."""
    zero = zoom.prepare(jnp.array([1.0]), 2)
    flat = jnp.zeros(zero.parameters.size)
    rows = jax.jacfwd(
        lambda flat: with_parameters(zero, flat.reshape(zero.parameters.shape)).standardised()
    )(flat)
    return (SCALE * zoom.error) ** 2 * rows.T @ rows


@jax.jit
def fit_smooth(frames, facts, prior, reference=None):
    """A batch of lenses by a SmoothZoom, about their first focal lengths or others: beyond their mean."""
    reference = frames.focal[:, :1] if reference is None else reference[:, None]
    basis = legendre(reference / frames.focal, prior.zoom.degree)
    typical = jnp.einsum("lfa,lai->lfi", basis[..., :3], prior.mean(facts))
    beyond = frames._replace(k=frames.k - typical)
    penalty = prior.factor(facts)[:, None, None] ** 2 * penalty_of(prior.zoom)
    fitted, left_out, q = jax.vmap(fit_linear)(basis, beyond, penalty)
    return typical + fitted, typical + left_out, q


@partial(jax.jit, static_argnums=2)
def few_errors(frames, facts, number, prior, reference=None):
    """Mean energies of a batch of lenses where only some focal lengths are fitted: at the inner others."""
    fitted = some_of(frames, number)
    seen = frames._replace(second=jnp.where(fitted[..., None, None], frames.second, 0))
    k = fit_smooth(seen, facts, prior, reference)[0]
    return lens_error(frames, k, inner(frames) & ~fitted)


@partial(jax.jit, static_argnums=3)
@jax.value_and_grad
def prior_loss(numbers, batches, weights, degree):
    """How badly a prior predicts frames that are not fitted: the mean logarithm of the lenses' errors.

    One of all is left out, or all but a few. Not how unlikely the prior makes them: a few lenses with wild
    tables decide that, and the rest do worse.
    """
    prior = prior_of(numbers, degree)

    def of(errors):
        return weights @ jnp.log(jnp.concatenate(errors) + 0.01) / jnp.sum(weights)

    one = of([lens_error(frames, fit_smooth(frames, facts, prior)[1]) for frames, facts in batches])
    few = [of([few_errors(*batch, number, prior) for batch in batches]) for number in FEW]
    return (3 * one + 2 * sum(few) / len(FEW)) / 5 + 1e-4 * jnp.sum(numbers**2)


def learn(lenses: list[Frames], facts: np.ndarray, chosen: np.ndarray, degree: int = DEGREE) -> Prior:
    """The prior that predicts the frames left out of the chosen lenses best, by what is known of each."""

    def batches(chosen):
        return [(i, (frames, jnp.asarray(facts[i]))) for i, frames in batches_of(lenses, chosen)]

    members, every = zip(*batches(np.arange(len(lenses))), strict=True)
    weights = jnp.asarray(chosen[np.concatenate(members)], float)
    start = np.zeros(OWN + 7 * facts.shape[1])
    start[[0, 2, 5, 9, 14, 20]] = np.log(5)
    start[24] = -2
    found = scipy.optimize.minimize(
        lambda x: tuple(np.asarray(a, float) for a in prior_loss(x, every, weights, degree)),
        start,
        jac=True,
        method="L-BFGS-B",
        options={"maxiter": 120},
    )
    mine = [batch for _, batch in batches(np.flatnonzero(chosen))]
    return calibrated(prior_of(jnp.asarray(found.x), degree), mine)


def calibrated(prior: Prior, batches: list[tuple[Frames, Any]]) -> Prior:
    """The same prior and error, both so much larger or smaller that errors are as large as expected.

    Fits depend on their ratio alone. In the median over the frames left out, for a few lenses are wild.
    """
    ratios, zoom = [], prior.zoom
    for frames, facts in batches:
        _, left_out, q = fit_smooth(frames, facts, prior)
        d, chosen = left_out - frames.k, inner(frames)
        # (Q + 1/H)^-1 d = H (1 + Q H)^-1 d
        part = solve_two(jnp.eye(2) + q @ frames.second, d) / prior.factor(facts)[:, None, None] ** 2
        ratios.append(jnp.einsum("...fi,...fij,...fj->...f", d, frames.second, part)[chosen])
    expected = 2 * np.log(2)  # the median of chi squared with two degrees of freedom
    factor = jnp.sqrt(jnp.median(jnp.concatenate(ratios)) / expected) / (SCALE * zoom.error)
    larger = dataclasses.replace(
        zoom, error=factor * zoom.error, quadratic=factor * zoom.quadratic, beyond=factor * zoom.beyond
    )
    return Prior(larger, prior.weights)


def print_prior() -> None:
    """Learn the priors from all lenses: without, and with what is known of a lens."""
    lenses, _, data = read()
    for facts in (no_facts(lenses), facts_of_all(lenses)):
        prior = learn(data, facts, np.ones(len(lenses), bool))
        zoom = prior.zoom
        with np.printoptions(precision=4, suppress=True):
            print(f"error {float(zoom.error):.3g}")
            print(*map(np.asarray, (zoom.quadratic, zoom.beyond, prior.weights)), sep="\n")


def print_forms() -> None:
    """How much the degree matters, and what comes out if each half of the lenses chooses its own.

    In a half the degree is chosen by priors that one part of it learns and the other tests; so the lenses
    tested in the end have no part in the choice. (The family, Legendre polynomials with variances that fall
    with the fourth power of the order, was found with all lenses at hand.)
    """
    lenses, _, data = read()
    family, facts = families(lenses), no_facts(lenses)
    side, quarter = halves(family), halves(family, seed=7)

    def tested(prior, chosen):
        fits = all_lenses(data, partial(fit_smooth, prior=prior), facts=facts)
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
                    tested(learn(data, facts, mine & (quarter != part), degree), mine & (quarter == part))
                    ** 2
                    + 0.01
                )
                for mine in (side == half,)
                for part in (0, 1)
            ]
            inside[half][degree] = float(np.mean(np.concatenate(logs)))
            outside[half][degree] = tested(learn(data, facts, side == half, degree), side != half)
        both = np.concatenate([outside[half][degree] for half in (0, 1)])
        print(f"degree {degree}:", np.quantile(both, QUANTILES).round(3), flush=True)
    chosen = [min(inside[half], key=lambda degree: inside[half][degree]) for half in (0, 1)]
    both = np.concatenate([outside[half][chosen[half]] for half in (0, 1)])
    print(f"chosen in each half, {chosen}:", np.quantile(both, QUANTILES).round(3))
