"""Focal lengths refined from the lines, together with the zoom model: what `fit_focal` minimises.

Over the parameters a and the errors t of the logarithms of the focal lengths together, it is

    E(a, t) + sum_m tau_m (t_m f_m / sigma_m)^2 .

That is the mode of the posterior if E_m / (2 tau_m), of each frame, is minus the logarithm of a likelihood:
tau_m is s^2 times the mean weight w_l of the frame's lines in eq. 13, s being the noise of a point that
is independent of the others. The fit's own covariance C tells s: with G = J^T J and h_l the leverages of
the lines, ``tr(G C) = s^2 sum_l w_l h_l``. So noise that is correlated along a line is taken into account.

What the zoom model cannot follow goes into the focal lengths; and where these are as uncertain as they
differ, hardly anything holds them. So the result is compared with that at the given focal lengths, on
frames left out.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from ..lines.best_line import rounded_by
from ..lines.buckets import bucketed_jit, of_frames
from ..models.zoom import AbstractPriorZoom, with_parameters
from .covariance import parameter_covariance
from .energy import (
    coefficients_by,
    counted_frames,
    line_weights,
    linearised,
    prior_error,
    prior_residuals,
    residuals,
)
from .focal_lengths import at_focal_lengths, inverse_of, near_energy, widened_by_focal

MOST_STEPS = 300
"""Of the joint minimisation, which mostly takes 5 to 50; some that hardly tell noise from errors, 200."""

_PARTS = 5
"""That frames are left out in, to see whether refined focal lengths help."""

_LEAST_NOISE = 1e-3
"""px: points are not taken for better than that, or a scene without noise would leave the prior no say."""


def _prior_weights(lines, zoom) -> Float[Array, "frame"]:
    """tau of each frame, px^2: see the module."""
    linear = linearised(lines, zoom)
    covariance, _ = parameter_covariance(lines, zoom, linear, photos=False)
    known = jnp.isfinite(jnp.diagonal(covariance))
    covariance = jnp.where(known[:, None] & known[None], covariance, 0)
    weights, frames = line_weights(lines), lines.focal.shape[0]
    squares = jnp.einsum("lrp,lrq->lpq", linear.jacobian, linear.jacobian)
    gauss_newton = jnp.sum(squares, axis=0)
    leverage = jnp.einsum("lpq,qp->l", squares, inverse_of(gauss_newton))
    noise = jnp.trace(gauss_newton @ covariance) / jnp.sum(weights * leverage)
    total, share = (jax.ops.segment_sum(v, lines.frame, frames) for v in (leverage, weights * leverage))
    mean_weight = share / jnp.where(total > 0, total, 1)
    return jnp.maximum(noise, _LEAST_NOISE**2) * mean_weight


class _Joint(NamedTuple):
    """Half the joint energy's derivatives by the parameters and the frames' standardised t."""

    gradient: Float[Array, "unknown"]
    gauss_newton: Float[Array, "unknown unknown"]
    middle: Float[Array, "unknown unknown"]


def _focal_of(lines, relative, t):
    return jnp.asarray(lines.focal) * jnp.exp(relative * t)


def _joint(lines, zoom, relative, known, tau, t) -> _Joint:
    """At focal lengths moved by t standard deviations, of which `known` ones have a prior."""
    flat, unravel = ravel_pytree(zoom.parameters)
    number = flat.shape[0]

    def coefficients(both):
        model = with_parameters(zoom, unravel(both[:number]))
        return coefficients_by(model, at_focal_lengths(lines, _focal_of(lines, relative, both[number:])))

    def priors(both):
        own = prior_residuals(lines, with_parameters(zoom, unravel(both[:number])))
        on_focal = jnp.where(known, jnp.sqrt(tau) * both[number:], 0)
        return on_focal if own is None else jnp.concatenate([on_focal, own])

    both = jnp.concatenate([flat, t])
    near = near_energy(lines, coefficients(both))
    rows, prior_rows = jax.jacfwd(coefficients)(both), jax.jacfwd(priors)(both)
    of_prior = jnp.concatenate(
        [tau, jnp.full(prior_rows.shape[0] - tau.shape[0], _prior_noise(lines, zoom))]
    )
    return _Joint(
        gradient=jnp.einsum("mi,mip->p", near.gradient, rows) + priors(both) @ prior_rows,
        gauss_newton=jnp.einsum("mip,mij,mjq->pq", rows, near.hessian, rows) + prior_rows.T @ prior_rows,
        middle=jnp.einsum("m,mip,mij,mjq->pq", tau, rows, near.hessian, rows)
        + prior_rows.T @ (of_prior[:, None] * prior_rows),
    )


def _prior_noise(lines, zoom):
    """The variance that the residuals of a zoom model's own prior have."""
    return prior_error(lines, zoom) ** 2 if isinstance(zoom, AbstractPriorZoom) else 0.0


@bucketed_jit(frames=["sigma"], returns=[of_frames, None, None, None, None], light=False)
def refined(lines, zoom, sigma):
    """The focal lengths, and the zoom model with them, unless that makes other frames less straight.

    Frames are left out, a fifth at a time, and measured at their given focal lengths: under the model
    fitted at the given focal lengths of the others, and under that fitted together with them. Where the
    second is worse by more than one standard error, all focal lengths but those that nobody knows are kept.

    And the number of steps, whether the end is reached, and whether focal lengths were kept.
    """
    flat, unravel = ravel_pytree(zoom.parameters)
    weight = jnp.ones(lines.frame.shape, flat.dtype) if lines.weight is None else lines.weight
    fold, known = _folds(lines), jnp.isfinite(sigma)

    def run(asked):
        left_out, sigma = asked
        part = lines.weighted(weight * (fold[lines.frame] != left_out))
        focal, model, steps, reached = _jointly(part, zoom, sigma)
        squares = jnp.sum(residuals(lines, coefficients_by(model, lines)) ** 2, axis=1)
        told = (fold == left_out) & known
        error = jax.ops.segment_sum(jnp.where(told[lines.frame], squares, 0), lines.frame, fold.shape[0])
        return focal, ravel_pytree(model.parameters)[0], steps, reached, error

    fixed = jnp.where(known, 0, sigma)
    number = _PARTS + 1
    left_out = jnp.tile(jnp.arange(number) - 1, 2)  # none at first
    sigmas = jnp.repeat(jnp.stack([fixed, sigma]), number, axis=0)
    focal, flat, steps, reached, error = jax.lax.map(run, (left_out, sigmas))
    before, after = jnp.sum(error.reshape(2, number, -1)[:, 1:], axis=1)
    rounding = rounded_by(lines.scale, flat.dtype)
    kept = _worse(before, after, counted_frames(lines) & known, rounding)
    chosen = jnp.where(kept, 0, number)
    return focal[chosen], with_parameters(zoom, unravel(flat[chosen])), steps[chosen], reached[chosen], kept


def _worse(before, after, counted, rounding):
    """Whether the frames' errors have grown by more than a standard error of their sum, and by rounding."""
    number, difference = jnp.sum(counted), after - before
    total = jnp.sum(difference)
    least = jnp.sqrt(jnp.finfo(before.dtype).eps) * jnp.sum(before) + number * rounding**2
    off = jnp.where(counted, difference - total / jnp.maximum(number, 1), 0)
    error = jnp.sqrt(number / jnp.maximum(number - 1, 1) * jnp.sum(off**2))
    return total > jnp.maximum(error, least)


def _folds(lines):
    """The part that each frame belongs to: neighbours along the zoom are in different ones."""
    counted = counted_frames(lines)
    order = jnp.argsort(jnp.where(counted, jnp.asarray(lines.focal), jnp.inf))
    rank = jnp.zeros(counted.shape, int).at[order].set(jnp.arange(counted.shape[0]))
    return rank % _PARTS


def _jointly(lines, zoom, sigma):
    """The minimum of the joint energy, by damped Gauss-Newton steps: see the module."""
    relative = sigma / jnp.asarray(lines.focal)
    known = jnp.isfinite(relative)
    relative = jnp.where(known, relative, 1)
    flat, unravel = ravel_pytree(zoom.parameters)
    tolerance = jnp.sqrt(jnp.finfo(flat.dtype).eps)

    def model(flat):
        return with_parameters(zoom, unravel(flat))

    def energy(flat, t, tau):
        total = jnp.sum(
            residuals(
                lines, coefficients_by(model(flat), at_focal_lengths(lines, _focal_of(lines, relative, t)))
            )
            ** 2
        )
        prior = prior_residuals(lines, model(flat))
        return (
            total + jnp.sum(jnp.where(known, tau * t**2, 0)) + (0 if prior is None else jnp.sum(prior**2))
        )

    def turn(state):
        flat, t, damping, _, steps = state
        moved = at_focal_lengths(lines, _focal_of(lines, relative, t))
        tau = _prior_weights(moved, model(flat))
        joint = _joint(lines, model(flat), relative, known, tau, t)
        matrix = joint.gauss_newton
        step = -inverse_of(matrix + damping * jnp.diag(jnp.diagonal(matrix))) @ joint.gradient
        new_flat, new_t = flat + step[: flat.shape[0]], t + step[flat.shape[0] :]
        rounding = 128 * jnp.finfo(flat.dtype).eps
        better = energy(new_flat, new_t, tau) <= (1 + rounding) * energy(flat, t, tau)
        return (
            jnp.where(better, new_flat, flat),
            jnp.where(better, new_t, t),
            jnp.where(better, damping / 10, 10 * jnp.maximum(damping, 1e-4)).astype(damping.dtype),
            jnp.where(better, jnp.max(jnp.abs(step[flat.shape[0] :])), jnp.inf),
            steps + 1,
        )

    def goes_on(state):
        *_, change, steps = state
        return (change > tolerance) & (steps < MOST_STEPS)

    zero, inf = jnp.zeros_like(relative), jnp.asarray(jnp.inf, relative.dtype)
    start = (flat, zero, jnp.zeros_like(inf), inf, jnp.asarray(0))
    flat, t, _, change, steps = jax.lax.while_loop(goes_on, turn, start)
    reached: Bool[Array, ""] = change <= tolerance
    return _focal_of(lines, relative, t), model(flat), steps, reached


@bucketed_jit(frames=["sigma", "given"], returns=[of_frames, None, None, None])
def posterior(lines, zoom, covariance, joint, sigma, given, kept):
    """Standard deviations of the focal lengths, given the lines and the prior, at the minimum.

    And the covariance of the parameters, and that with the centre, enlarged by it; and whether the zoom
    model is determined. Infinite is what neither lines nor prior determine: a focal length at which the
    coefficients are those nearby, or one that goes with another model. Without lines the prior is left, and
    where the given focal lengths were kept.
    """
    relative = sigma / given
    known = jnp.isfinite(relative)
    spread = jnp.where(known, relative, 1)
    tau = _prior_weights(lines, zoom)
    near = _joint(lines, zoom, spread, known, tau, jnp.zeros_like(spread))
    inverse, free = inverse_of(near.gauss_newton), _free(near.gauss_newton)
    number = free.shape[0] - relative.shape[0]
    both = (inverse @ near.middle @ inverse)[number:, number:]
    of_focal = spread[:, None] * both * spread[None]
    prior = jnp.diag(jnp.where(known, relative**2, jnp.diagonal(of_focal)))
    of_focal = jnp.where(kept, prior, of_focal)
    told = jnp.where(free[number:], jnp.inf, jnp.sqrt(jnp.diagonal(of_focal)))
    std = jnp.asarray(lines.focal) * jnp.where(counted_frames(lines), told, relative)
    covariance = _unknown(covariance, free[:number])
    if joint is not None:
        joint = _unknown(joint, jnp.pad(free[:number], (0, joint.shape[0] - number)))
    wider = widened_by_focal(lines, zoom, covariance, joint, of_focal, refined=~kept)
    return std, *wider, ~jnp.any(free[:number])


def _free(matrix):
    """Which unknowns a symmetric matrix does not determine: directions that `inverse_of` leaves out."""
    size = jnp.sqrt(jnp.maximum(jnp.diagonal(matrix), 0))
    size = jnp.where(size > 0, size, 1)
    values, vectors = jnp.linalg.eigh(matrix / size[:, None] / size[None])
    eps = jnp.finfo(values.dtype).eps
    null = values <= 10 * values.shape[0] * eps * jnp.max(jnp.abs(values))  # as `pinv` has it
    return jnp.sum(jnp.where(null[None], vectors**2, 0), axis=1) > jnp.sqrt(eps)


def _unknown(covariance, free):
    """A covariance with infinite variances, and without covariances, of some of its unknowns."""
    there = jnp.where(free[:, None] | free[None], 0, covariance)
    return jnp.where(jnp.diag(free), jnp.inf, there)
