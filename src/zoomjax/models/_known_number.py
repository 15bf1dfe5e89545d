"""How many coefficients a zoom model gives, as far as its arrays tell."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .registry import coefficients_shape
from .zoom import AbstractLinearZoom, AbstractZoom


def known_number(zoom: AbstractZoom | None) -> int | None:
    """How many coefficients a zoom model gives; None where its arrays are not there, or a batch."""
    leaves = jax.tree.leaves(zoom)
    if not isinstance(zoom, AbstractZoom) or not all(eqx.is_array(leaf) for leaf in leaves):
        return None
    if isinstance(zoom, AbstractLinearZoom) and zoom.parameters is not None:
        return zoom.parameters.shape[1] if zoom.parameters.ndim == 2 else None
    kinds = tuple((leaf.shape, np.dtype(leaf.dtype)) for leaf in leaves)
    return _number_of(jax.tree.structure(zoom), kinds, jnp.result_type(float))


@functools.lru_cache(maxsize=1024)
def _number_of(structure, kinds, _):
    """How many coefficients there are, of a model known by its shapes: to trace it takes milliseconds."""
    zoom = jax.tree.unflatten(structure, [jax.ShapeDtypeStruct(*kind) for kind in kinds])
    try:
        shape = coefficients_shape(zoom)
    except (jax.errors.JAXTypeError, IndexError, TypeError):  # that cannot be traced, or is a batch
        return None
    return shape[0] if len(shape) == 1 else None
