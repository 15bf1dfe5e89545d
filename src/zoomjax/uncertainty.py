"""How well the lines determine the parameters of a zoom model.

Covariance of the parameters from the Jacobian of the residuals, and which of them the lines do not
determine at all; work of one or two iterations of the fit, once after it.
"""

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from .energy import line_weights, prior_error, prior_jacobian
from .lines import AbstractLines
from .zoom import AbstractPriorZoom, AbstractZoom, with_parameters


def parameter_covariance(
    lines: AbstractLines,
    zoom: AbstractZoom,
    jacobian: Float[Array, "line rows parameter"],
    energy: Float[Array, ""],
) -> tuple[Float[Array, "parameter parameter"], Bool[Array, ""]]:
    """Covariance of the flattened parameters, and whether the lines determine them all.

    For the weights w of eq. 13, which are not the inverse variances, the covariance is the sandwich
    ``sigma^2 (J^T W J)^-1 (J^T W^2 J) (J^T W J)^-1``. It is made from the triangles of J and of the
    weighted J: the normal equations would square the condition number, which float32 has no room for.

    A parameter is *undetermined* where moving it changes the residuals by less than twice what noise in
    the points alone would feign: each point's error appears in the derivative by k_j, times r^(2j). (Lines
    through the centre have nothing else there, and would otherwise seem to determine k from their noise.)
    """
    weights = line_weights(lines)
    prior = prior_jacobian(lines, zoom)
    flat = jacobian.reshape(-1, jacobian.shape[-1])
    triangle, outer = (
        jnp.linalg.qr(rows, mode="r")
        for rows in (
            jnp.concatenate([flat, prior]),
            (jnp.sqrt(weights)[:, None, None] * jacobian).reshape(flat.shape),
        )
    )
    # Columns of unit length, so that one threshold serves parameters of any size.
    size = jnp.linalg.norm(triangle, axis=0)
    size = jnp.where(size > 0, size, 1)
    left, values, right = jnp.linalg.svd(triangle / size[None])
    good = values > 64 * jnp.finfo(values.dtype).eps
    reciprocal = jnp.where(good, 1 / jnp.where(good, values, 1), 0)
    back = right.T * reciprocal[None]  # to the parameters that change the residuals by one unit
    # Of the directions that change them so, those in which noise would feign more than half of it.
    feigned = _feigned(lines, zoom, weights, energy) / size[:, None] / size[None]
    shares, directions = jnp.linalg.eigh(back.T @ feigned @ back)
    doubtful = jnp.concatenate([back @ directions, right.T], axis=1)
    doubtful = doubtful / jnp.maximum(jnp.linalg.norm(doubtful, axis=0), jnp.finfo(size.dtype).tiny)[None]
    unknown = jnp.concatenate([shares >= 0.25, ~good])
    undetermined = jnp.any(unknown[None] & (jnp.abs(doubtful) > 0.05), axis=1)

    inverse = back @ left.T / size[:, None]
    spread = outer @ inverse
    freedom = jnp.sum(weights * (lines.counts - 2)) - jnp.sum(spread**2)
    undetermined = undetermined | (freedom <= 0)  # nothing is left over to tell the noise by
    half = inverse @ spread.T
    covariance = energy / jnp.where(freedom > 0, freedom, 1) * (half @ half.T)
    if isinstance(zoom, AbstractPriorZoom):
        # The prior draws the parameters to its mean: by how much, in the mean over what it expects.
        half = prior_error(lines, zoom) * inverse @ (prior @ inverse).T
        covariance = covariance + half @ half.T
    either = undetermined[:, None] | undetermined[None]
    infinite = jnp.where(jnp.eye(size.shape[0], dtype=bool), jnp.inf, 0)
    return jnp.where(either, infinite, covariance), ~jnp.any(undetermined)


def _feigned(lines, zoom, weights, energy):
    """What the points' own noise contributes to ``J^T J`` in the mean, by parameter and parameter."""
    flat, unravel = ravel_pytree(zoom.parameters)

    def coefficients_at(flat):
        return jax.vmap(with_parameters(zoom, unravel(flat)))(lines.focal)

    k = coefficients_at(flat)
    terms = k.shape[1]
    order = jnp.arange(terms + 1)
    moments = lines.radial_moments(2 * terms)[:, order[:, None] + order[None]] * weights[:, None, None]
    # The residuals have the noise of the corrected image, shrunk by L: divide by its mean square.
    kappa = jnp.concatenate([jnp.ones_like(k[:, :1]), k], axis=1)[lines.frame]
    variance_in_image = energy / jnp.einsum("li,lij,lj->", kappa, moments, kappa)
    by_parameter = jax.jacfwd(coefficients_at)(flat)[lines.frame]  # (line, terms, parameter)
    return variance_in_image * jnp.einsum("lip,lij,ljq->pq", by_parameter, moments[:, 1:, 1:], by_parameter)
