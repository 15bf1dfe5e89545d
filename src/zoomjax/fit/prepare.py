"""Preparation of a fit: the model, the compressed lines and the algebraic start."""

import equinox as eqx
import jax
import jax.numpy as jnp

from ..lines.base import AbstractLines
from ..lines.compressed import CompressedLines
from ..models.polynomial import RadialPolynomial
from ..models.zoom import terms_of
from .algebraic import compressed, small_of
from .defaults import zoom_or_default
from .energy import settings
from .image_metric import measured_as


def ready_model(lines, zoom, terms):
    """The model ready to be fitted to these lines, in their dtype, and its number of radial terms."""
    zoom = zoom_or_default(zoom)
    terms = terms_of(zoom, terms, lines.family)
    focal, *focus = settings(zoom, lines)
    size = lines.family.size(terms)
    prepared = zoom.prepare(focal, size, *focus)  # complains of too few focal lengths
    if zoom.parameters is None:
        return prepared, terms
    dtype = jnp.asarray(lines.focal).dtype
    arrays, rest = eqx.partition(zoom, eqx.is_inexact_array)
    return eqx.combine(jax.tree.map(lambda array: array.astype(dtype), arrays), rest), terms


def compressed_as_measured(lines, terms):
    """The lines compressed, measured as they were."""
    return measured_as(small_of(lines, terms), lines)


def algebraic_start(lines: AbstractLines, terms: int) -> CompressedLines | None:
    """What the algebraic estimate is made from; None for a family that it does not know."""
    return compressed(lines, terms) if isinstance(lines.family, RadialPolynomial) else None
