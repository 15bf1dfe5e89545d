"""By how much a correction stretches the image across a line: the mean of ``|J^T n|^2`` over its points.

J is the derivative of the correction, n the line's normal in the corrected image.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..models.distortion_model import AbstractDistortionModel


def radial_stretch(
    k: Float[Array, "terms"],
    normal: Float[Array, "2"],
    moments: Float[Array, "moment 2 2"],
    count: Float[Array, ""],
) -> Float[Array, ""]:
    """That of one line under the radial polynomial k, by second moments; 1 where there are no points."""
    terms = k.shape[0]
    kappa = jnp.concatenate([jnp.ones(1, k.dtype), k])
    i, j = np.indices((terms + 1, terms + 1))
    products = kappa[:, None] * kappa[None]
    radial = jnp.concatenate([count[None].astype(k.dtype), jnp.trace(moments, axis1=1, axis2=2)])
    across = jnp.concatenate([jnp.zeros(1, k.dtype), jnp.einsum("c,mcd,d->m", normal, moments, normal)])
    factor = jnp.asarray(2 * i + 2 * j + 4 * i * j, k.dtype)
    total = jnp.sum(products * (radial[i + j] + factor * across[i + j]))
    return jnp.where(count > 0, total / jnp.maximum(count, 1), 1)


def stretch_of_points(
    z: Float[Array, "point 2"],
    mask: Bool[Array, "point"],
    k: Float[Array, "size"],
    normal: Float[Array, "2"],
    distortion_model: AbstractDistortionModel,
) -> Float[Array, ""]:
    """That of one line under any distortion model, point by point; 1 where there are no points."""

    def corrected(x, y):
        return distortion_model.correct((x, y), x * x + y * y, k)

    x, y = jnp.where(mask[:, None], z, 0).T
    _, transposed = jax.vjp(corrected, x, y)
    by_x, by_y = transposed((jnp.full_like(x, normal[0]), jnp.full_like(y, normal[1])))
    total = jnp.sum(jnp.where(mask, by_x * by_x + by_y * by_y, 0))
    number = jnp.sum(mask)
    return jnp.where(number > 0, total / jnp.maximum(number, 1), 1)
