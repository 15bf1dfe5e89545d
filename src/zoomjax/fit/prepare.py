"""Preparation of a fit: the model that is asked for, made ready for the lines."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from ..lines.base import AbstractLines, SomeLines
from ..models.family import AbstractFamily
from ..models.model import Model
from ..models.zoom import AbstractZoom
from .defaults import DEFAULT_ZOOM
from .energy import settings
from .family_lines import with_family


def asked_for(
    lines: SomeLines,
    zoom: AbstractZoom | Model | None,
    terms: int | None = None,
    family: AbstractFamily | None = None,
) -> tuple[SomeLines, Model]:
    """The lines under the distortion model asked for, and the model: by default that of the paper.

    Raises:
        ValueError: `zoom` is a `Model`, and `terms` or `family` is given besides.
    """
    if isinstance(zoom, Model):
        if terms is not None or family is not None:
            raise ValueError(
                "Argument zoom is a Model, which has a number of terms and a distortion model of its own: "
                "leave out the arguments terms and family."
            )
        zoom, terms, family = zoom.zoom, zoom.terms, zoom.family
    placed: Any = lines if family is None else with_family(lines, family)
    return placed, Model(DEFAULT_ZOOM if zoom is None else zoom, terms, placed.family)


def ready_model(lines: AbstractLines, model: Model) -> Model:
    """The model ready to be fitted to these lines, in their dtype.

    Raises:
        ValueError: the zoom model needs more focal lengths, or the focus, which the lines do not have.
    """
    focal, *focus = settings(model.zoom, lines)
    prepared = model.zoom.prepare(focal, model.size, *focus)  # complains of too few focal lengths
    if model.zoom.parameters is None:
        return model.with_zoom(prepared)
    dtype = jnp.asarray(lines.focal).dtype
    arrays, rest = eqx.partition(model.zoom, eqx.is_inexact_array)
    return model.with_zoom(eqx.combine(jax.tree.map(lambda array: array.astype(dtype), arrays), rest))
