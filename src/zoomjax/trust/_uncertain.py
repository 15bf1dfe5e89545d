"""What of a fitted lens is uncertain, as one vector of numbers, for derivatives by them."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, ScalarLike

from .._core.types import Coefficients, Focal
from ..models.zoom import AbstractZoom, with_parameters


def uncertain(fit):
    """What of a lens is uncertain, flattened; the lens that other such numbers make; their covariance.

    These are the parameters of the zoom model; after them the centre, if it was fitted; and then what the
    coefficients are off the model, 0 in the lens, if the misfit was estimated; and what they and the centre
    are off, if the centre may be elsewhere.
    """
    lens, covariance = fit.lens, fit.covariance
    centre = off = elsewhere = None
    if fit.joint is not None:
        covariance = fit.joint
        centre = lens.centre / lens.scale if lens.shift is None else lens.shift.parameters
    if fit.misfit is not None:
        covariance = jax.scipy.linalg.block_diag(covariance, fit.misfit)
        off = jnp.zeros(fit.misfit.shape[0], covariance.dtype)
    if fit.off_centre is not None:
        covariance = jax.scipy.linalg.block_diag(covariance, fit.off_centre)
        elsewhere = jnp.zeros(fit.off_centre.shape[0], covariance.dtype)
    flat, unravel = ravel_pytree((lens.zoom.parameters, centre, off, elsewhere))

    def lens_at(flat):
        parameters, centre, off, elsewhere = unravel(flat)
        if elsewhere is not None:
            more = elsewhere[:-2]
            off = more if off is None else off.at[: more.size].add(more)
        zoom = with_parameters(lens.zoom, parameters)
        zoom = zoom if off is None else _OffZoom(zoom=zoom, parameters=off)
        moved = eqx.tree_at(lambda lens: lens.zoom, lens, zoom)
        if centre is not None and lens.shift is None:
            moved = eqx.tree_at(lambda lens: lens.centre, moved, lens.scale * centre)
        elif centre is not None:
            moved = eqx.tree_at(lambda lens: lens.shift, moved, with_parameters(lens.shift, centre))
        if elsewhere is None:
            return moved
        return eqx.tree_at(lambda lens: lens.centre, moved, moved.centre + lens.scale * elsewhere[-2:])

    return flat, lens_at, covariance


class _OffZoom(AbstractZoom):
    """A zoom model off by the same coefficients at every focal length; it may have one more of them."""

    zoom: AbstractZoom
    parameters: Float[Array, "coefficients"]

    def prepare(self, focal: Focal, terms: int) -> "_OffZoom":
        return _OffZoom(zoom=self.zoom.prepare(focal, terms), parameters=jnp.zeros(terms))

    def __call__(self, *settings: ScalarLike) -> Coefficients:
        k = self.zoom(*settings)
        return self.parameters.at[: len(k)].add(k)
