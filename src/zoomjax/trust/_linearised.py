"""Residuals of lines and their derivatives, for all that judges a fit by a step from it.

Compiled once, and shared: what is made of them is NumPy.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core.types import AnyArray
from ..fit.energy import by_own_coefficients, linearised, prior_jacobian, prior_residuals
from ..fit.own_weights import own_weights
from ..lines.base import AbstractLines
from ..lines.buckets import bucketed_jit, of_lines
from ..models.zoom import AbstractZoom


@bucketed_jit(returns=[of_lines, of_lines, None, None])
def by_parameters(
    lines: AbstractLines, zoom: AbstractZoom
) -> tuple[
    Float[Array, "line rows"],
    Float[Array, "line rows parameter"],
    Float[Array, "row parameter"],
    Float[Array, "parameter"],
]:
    """The weighted residuals, px, and their derivatives by the flattened parameters of a zoom model.

    And the derivatives of what its prior adds, and half the gradient of the sum of squares of that.
    """
    weighted, jacobian, *_ = linearised(lines, zoom)
    prior = prior_jacobian(lines, zoom)
    pulled = prior_residuals(lines, zoom)
    pull = jnp.zeros(prior.shape[1], prior.dtype) if pulled is None else prior.T @ pulled
    return weighted, jacobian, prior, pull


@bucketed_jit(frames=["coefficients"], returns=[of_lines, of_lines])
def by_coefficients(
    lines: AbstractLines, coefficients: Float[AnyArray, "frame size"]
) -> tuple[Float[Array, "line rows"], Float[Array, "line rows size"]]:
    """The weighted residuals, px, and their derivatives by the coefficients of each line's own frame.

    Of lines for any centre, coefficients end with the centre's offset.
    """
    return by_own_coefficients(lines, jnp.asarray(coefficients))


def frame_normal_equations(
    lines: AbstractLines, coefficients: Float[np.ndarray, "frame size"]
) -> tuple[Float[np.ndarray, "frame size"], Float[np.ndarray, "frame size size"]]:
    """Half the gradient of each frame's error (eq. 3) by its coefficients, and the Gauss-Newton matrix."""
    k = np.asarray(coefficients, jnp.asarray(lines.focal).dtype)
    weighted, jacobian = (np.asarray(of, float) for of in by_coefficients(lines, k))
    frame, used = np.asarray(lines.frame), own_weights(lines) > 0
    score, matrix = np.zeros(k.shape), np.zeros((*k.shape, k.shape[1]))
    np.add.at(score, frame, np.einsum("lr,lri->li", weighted, jacobian))
    np.add.at(matrix, frame, np.einsum("lri,lrj->lij", jacobian, jacobian))
    number = max(np.unique(frame[used]).size, 1)  # M of eq. 13
    return number * score, number * matrix
