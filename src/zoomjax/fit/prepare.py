"""Preparation of a fit: the model, the compressed lines and the algebraic start."""

import equinox as eqx
import jax
import jax.numpy as jnp

from .._core.checks import checked_terms
from ..lines.base import AbstractLines
from ..lines.compressed import CompressedLines
from ..models.polynomial import RadialPolynomial
from .algebraic import compressed
from .energy import coefficients_by, settings
from .family_lines import FamilyLines
from .image_metric import ImageLines, in_image


def ready_model(lines, zoom, terms):
    """The model ready to be fitted to these lines, in their dtype, and its number of radial terms."""
    own = None if zoom.parameters is None else jax.eval_shape(coefficients_by, zoom, lines).shape[1]
    besides = lines.family.size(0)
    terms = (2 if own is None else own - besides) if terms is None else terms
    terms = checked_terms(terms, lines.family.most_terms)
    if own not in (None, terms + besides):
        raise ValueError(
            f"Argument terms is {terms}, but the parameters of zoom are for {own - besides}: leave terms "
            "out, or start from a model without parameters."
        )
    focal, *focus = settings(zoom, lines)
    prepared = zoom.prepare(focal, terms + besides, *focus)  # complains of too few focal lengths
    if own is None:
        return prepared, terms
    dtype = jnp.asarray(lines.focal).dtype
    arrays, rest = eqx.partition(zoom, eqx.is_inexact_array)
    return eqx.combine(jax.tree.map(lambda array: array.astype(dtype), arrays), rest), terms


def compressed_as_measured(lines, terms):
    """The lines compressed, measured as they were."""
    plain = lines.as_weighted() if isinstance(lines, ImageLines) else lines
    small = plain.compressed(terms) if isinstance(plain, FamilyLines) else compressed(plain, terms)
    return in_image(small) if isinstance(lines, ImageLines) else small


def algebraic_start(lines: AbstractLines, terms: int) -> CompressedLines | None:
    """What the algebraic estimate is made from; None for a family that it does not know."""
    return compressed(lines, terms) if isinstance(lines.family, RadialPolynomial) else None
