"""Focal lengths with errors: their effect on a lens, and their estimation from the lines.

A fit treats the focal lengths of the frames as exact. If they are wrong by t_m, in log f, its parameters
a change so that the gradient g of the energy stays zero (the implicit function theorem):

    da = R t,    R = -(dg/da)^-1 dg/dt,    and their covariance is larger by R diag(sigma^2 / f^2) R^T.

Frames meet in the energy only through their coefficients k_m = k(f_m): near the minimum it is a sum over
frames of quadratics in k_m, found by N + 1 gradients whatever the number of frames, and all derivatives
by a and t are those of that sum.

The other half is in `focal_fit`, which estimates the focal lengths from the lines, too: the functions here
that it needs minimise, over a and t together,

    E(a, t) + sum_m tau_m (t_m f_m / sigma_m)^2 .

That is the mode of the posterior if E_m / (2 tau_m), of each frame, is minus the logarithm of a likelihood:
tau_m is s^2 times the mean weight w_l of the frame's lines in eq. 13, s being the noise of a point that
is independent of the others. The fit's own covariance C tells s: with G = J^T J and h_l the leverages of
the lines, ``tr(G C) = s^2 sum_l w_l h_l``. So noise that is correlated along a line is taken into account.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, Num, ScalarLike

from .._core.arguments import kinds_checked
from .._core.fields import integers, real_argument
from .._core.types import AnyArray, Focal, traced
from ..lines.base import AbstractLines
from ..lines.buckets import bucketed_jit, of_frames
from ..models.requirements import check
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
from .family_lines import with_family
from .result import ZoomFit
from .same_camera import check_lines_of

Sigma = ScalarLike | Num[AnyArray, "frame"]

MOST_STEPS = 100
"""Of the joint minimisation, which takes 5 to 15."""

_LEAST_NOISE = 1e-3
"""px: points are not taken for better than that, or a scene without noise would leave the prior no say."""


@kinds_checked
def with_focal_sigma(
    fit: ZoomFit, lines: AbstractLines, *, focal_sigma: Sigma, shared: Int[AnyArray, "frame"] | None = None
) -> ZoomFit:
    """Add the uncertainty of the focal lengths to a fit's covariance, and so to all bands.

    Args:
        fit: the fit.
        lines: the lines that it was fitted to, with their weights; measured in the image, if they were.
        focal_sigma: standard deviation of the focal lengths, in the lines' unit: a number, or one per
            frame; 0 where they are exact. For focal lengths rounded to whole mm it is 0.29, 1/sqrt(12).
            Errors of frames are assumed to be independent, unless they are `shared`.
        shared: for each frame a number: frames of the same one share an error, as photos at one setting of
            the zoom whose focal length was measured once.

    Returns:
        The fit with `covariance` larger, to first order in the errors.

    Raises:
        ValueError: `focal_sigma` does not hold finite numbers of at least 0, one or one a frame; `shared`
            is not one number a frame; the lens has a centre that moves along the zoom; or the lines are
            not those of the fit: of another image size, unit or number of frames.

    Example:
        >>> from zoomjax import compress, displacement_std, fit_zoom, scenes
        >>> focal = scenes.focal_sweep(4)
        >>> lines = compress(scenes.board_lines(scenes.nikkor_18_200(), focal, spacing=99, noise=1))
        >>> exact = fit_zoom(lines)
        >>> rounded = with_focal_sigma(exact, lines, focal_sigma=0.29)
        >>> wide = [displacement_std(fit, focal[:2], focal=21.0) for fit in (exact, rounded)]
        >>> bool(wide[0] < wide[1])
        True
    """
    check_lines_of(fit, lines)
    sigma = checked_sigma(focal_sigma, lines.focal)
    if not traced(sigma) and not np.isfinite(sigma).all():
        raise ValueError(
            f"Argument focal_sigma must hold finite numbers, but it is {focal_sigma}. {UNKNOWN}"
        )
    check("with_focal_sigma", shift=fit.lens.shift)
    number = lines.focal.shape[0]
    together: Any = np.arange(number) if shared is None else integers("shared")(shared)
    if np.shape(together) != (number,):
        raise ValueError(
            f"Argument shared must hold a number for each of the {number} frames, but its shape is "
            f"{np.shape(together)}."
        )
    lines = with_family(lines, fit.lens.family).about(fit.lens.centre)
    own = (fit.lens.zoom, fit.covariance, fit.joint)
    return with_covariance(fit, *_widened_by(lines, *own, sigma, together))


def with_covariance(fit, covariance, joint):
    """A fit with other covariances: of the parameters, and of these with the centre."""
    return eqx.tree_at(
        lambda fit: (fit.covariance, fit.joint), fit, (covariance, joint), is_leaf=lambda leaf: leaf is None
    )


@bucketed_jit(frames=["sigma", "shared"], returns=[None, None])
def _widened_by(lines, zoom, own, joint, sigma, shared):
    """`_widened` by standard deviations of the focal lengths, of which some are wrong together."""
    relative = sigma / jnp.asarray(lines.focal)
    together = shared[:, None] == shared[None]
    return _widened(lines, zoom, own, joint, jnp.where(together, relative[:, None] * relative[None], 0))


UNKNOWN = (
    "Straight lines alone do not determine focal lengths: after a change of all focal lengths by an "
    "increasing function, another zoom model makes every line as straight. Take them from EXIF data or a "
    "table, or measure them from a board (focal_from_board) or a plane (focal_from_planes, "
    "focal_from_lines)."
)


def checked_sigma(focal_sigma: Any, focal: Focal) -> Float[AnyArray, "frame"]:
    """The standard deviation of each frame's focal length."""
    focal = jnp.asarray(focal)
    if focal_sigma is None:
        raise ValueError(f"Argument focal_sigma must be a number or one a frame, but it is None. {UNKNOWN}")
    sigma = jnp.asarray(real_argument("focal_sigma", focal_sigma), focal.dtype)
    if sigma.shape not in ((), focal.shape):
        raise ValueError(
            f"Argument focal_sigma must hold one number, or one for each of the {focal.shape[0]} frames, "
            f"but its shape is {sigma.shape}."
        )
    if not traced(sigma):
        if np.isnan(sigma).any():
            raise ValueError(f"Argument focal_sigma must hold numbers, but it is {focal_sigma}. {UNKNOWN}")
        if (np.asarray(sigma) < 0).any():
            raise ValueError(f"Argument focal_sigma must be at least 0, but it is {focal_sigma}.")
    return jnp.broadcast_to(sigma, focal.shape) if traced(sigma) else np.broadcast_to(sigma, focal.shape)


class _NearEnergy(NamedTuple):
    """Half the energy, up to a constant, near some coefficients of the frames."""

    coefficients: Float[Array, "frame terms"]
    gradient: Float[Array, "frame terms"]
    hessian: Float[Array, "frame terms terms"]

    def __call__(self, coefficients):
        d = coefficients - self.coefficients
        return jnp.sum(self.gradient * d) + jnp.einsum("mi,mij,mj->", d, self.hessian, d) / 2


def _near_energy(lines, coefficients) -> _NearEnergy:
    """A frame's energy depends on its own coefficients alone: a direction serves all frames at once."""
    gradient = jax.grad(lambda k: jnp.sum(residuals(lines, k) ** 2) / 2)

    def along(direction):
        return jax.jvp(gradient, (coefficients,), (jnp.broadcast_to(direction[None], coefficients.shape),))

    values, columns = jax.vmap(along)(jnp.eye(coefficients.shape[1], dtype=coefficients.dtype))
    return _NearEnergy(coefficients, values[0], jnp.moveaxis(columns, 0, 1))


def _response(lines, zoom) -> Float[Array, "parameter frame"]:
    """By how much the fitted parameters move with the logarithm of each frame's focal length."""
    flat, unravel = ravel_pytree(zoom.parameters)
    focal = jnp.asarray(lines.focal)
    near = _near_energy(lines, coefficients_by(zoom, lines))

    def half(flat, t):
        model = with_parameters(zoom, unravel(flat))
        prior = prior_residuals(lines, model)
        return near(coefficients_by(model, at_focal_lengths(lines, focal * jnp.exp(t)))) + (
            0 if prior is None else jnp.sum(prior**2) / 2
        )

    by_both = jax.jacfwd(jax.grad(half), argnums=(0, 1))
    hessian, mixed = by_both(flat, jnp.zeros_like(focal))
    return -_inverse(hessian) @ mixed


def _inverse(matrix):
    """Of a symmetric matrix, in units of its diagonal; what it does not determine stays as it is."""
    size = jnp.sqrt(jnp.maximum(jnp.diagonal(matrix), 0))
    size = jnp.where(size > 0, size, 1)
    return jnp.linalg.pinv(matrix / size[:, None] / size[None], hermitian=True) / size[:, None] / size[None]


def _widened(lines, zoom, covariance, joint, of_focal):
    """The covariance, and that with the centre, enlarged by that of the logarithms of the focal lengths.

    Wrong focal lengths also show as errors that the lines of a photo share, for which the covariance allows
    already: only what goes beyond that is added. A fitted centre is held where it is.
    """
    response = _response(lines, zoom)
    weighted, jacobian = linearised(lines, zoom)
    by_line, _ = parameter_covariance(lines, zoom, weighted, jacobian, photos=False)
    infinite = jnp.isinf(jnp.diagonal(covariance)) | jnp.isinf(jnp.diagonal(by_line))
    known = ~(infinite[:, None] | infinite[None])
    own, by_line = (jnp.where(known, matrix, 0) for matrix in (covariance, by_line))
    size = jnp.sqrt(jnp.maximum(jnp.diagonal(own), 0))
    unit = jnp.where(size > 0, size, 1)
    both = unit[:, None] * unit[None]
    shared = _positive_part((own - by_line) / both)
    of_focal = jnp.where(known, response @ of_focal @ response.T, 0) / both
    more = _positive_part(of_focal - shared) * both
    wider = jnp.where(known, covariance + more, covariance)
    if joint is None:
        return wider, None
    number = wider.shape[0]
    return wider, joint.at[:number, :number].add(jnp.where(known, more, 0))


def _positive_part(matrix):
    """A symmetric matrix without its negative eigenvalues."""
    values, vectors = jnp.linalg.eigh(matrix)
    return (vectors * jnp.maximum(values, 0)[None]) @ vectors.T


def _prior_weights(lines, zoom) -> Float[Array, "frame"]:
    """tau of each frame, px^2: see the module."""
    weighted, jacobian = linearised(lines, zoom)
    covariance, _ = parameter_covariance(lines, zoom, weighted, jacobian, photos=False)
    known = jnp.isfinite(jnp.diagonal(covariance))
    covariance = jnp.where(known[:, None] & known[None], covariance, 0)
    weights, frames = line_weights(lines), lines.focal.shape[0]
    squares = jnp.einsum("lrp,lrq->lpq", jacobian, jacobian)
    gauss_newton = jnp.sum(squares, axis=0)
    leverage = jnp.einsum("lpq,qp->l", squares, _inverse(gauss_newton))
    noise = jnp.trace(gauss_newton @ covariance) / jnp.sum(weights * leverage)
    total, share = (jax.ops.segment_sum(v, lines.frame, frames) for v in (leverage, weights * leverage))
    mean_weight = share / jnp.where(total > 0, total, 1)
    return jnp.maximum(noise, _LEAST_NOISE**2) * mean_weight


class _Joint(NamedTuple):
    """Half the joint energy's derivatives by the parameters and the frames' standardised t."""

    gradient: Float[Array, "unknown"]
    gauss_newton: Float[Array, "unknown unknown"]
    middle: Float[Array, "unknown unknown"]


def at_focal_lengths(lines, focal):
    """The lines with other focal lengths of their frames."""
    return eqx.tree_at(lambda lines: lines.focal, lines, focal)


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
    near = _near_energy(lines, coefficients(both))
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


@bucketed_jit(frames=["sigma"], returns=[of_frames, None, None, None], light=False)
def refined(lines, zoom, sigma):
    """The focal lengths, and the zoom model with them, by damped Gauss-Newton steps.

    And the number of steps, and whether the end is reached.
    """
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
        step = -_inverse(matrix + damping * jnp.diag(jnp.diagonal(matrix))) @ joint.gradient
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
def posterior(lines, zoom, covariance, joint, sigma, given):
    """Standard deviations of the focal lengths, given the lines and the prior, at the minimum.

    And the covariance of the parameters, and that with the centre, enlarged by it; and whether the zoom
    model is determined. Infinite is what neither lines nor prior determine: a focal length at which the
    coefficients are those nearby, or one that goes with another model. Without lines the prior is left.
    """
    relative = sigma / given
    known = jnp.isfinite(relative)
    spread = jnp.where(known, relative, 1)
    tau = _prior_weights(lines, zoom)
    near = _joint(lines, zoom, spread, known, tau, jnp.zeros_like(spread))
    inverse, free = _inverse(near.gauss_newton), _free(near.gauss_newton)
    number = free.shape[0] - relative.shape[0]
    both = (inverse @ near.middle @ inverse)[number:, number:]
    of_focal = spread[:, None] * both * spread[None]
    told = jnp.where(free[number:], jnp.inf, jnp.sqrt(jnp.diagonal(of_focal)))
    std = jnp.asarray(lines.focal) * jnp.where(counted_frames(lines), told, relative)
    covariance = _unknown(covariance, free[:number])
    if joint is not None:
        joint = _unknown(joint, jnp.pad(free[:number], (0, joint.shape[0] - number)))
    return std, *_widened(lines, zoom, covariance, joint, of_focal), ~jnp.any(free[:number])


def _free(matrix):
    """Which unknowns a symmetric matrix does not determine: directions that `_inverse` leaves out."""
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
