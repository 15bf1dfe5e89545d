"""Preparation of a fit: the model that is asked for, made ready for the lines."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..lines.base import AbstractLines, SomeLines
from ..models.distortion_model import AbstractDistortionModel
from ..models.model import Model
from ..models.zoom import AbstractZoom
from .defaults import DEFAULT_ZOOM
from .distortion_models import with_distortion_model
from .energy import settings
from .own_weights import frames_that_count


def asked_for(
    lines: SomeLines,
    zoom: AbstractZoom | Model | None,
    terms: int | None = None,
    distortion_model: AbstractDistortionModel | None = None,
) -> tuple[SomeLines, Model]:
    """The lines under the distortion model asked for, and the model: by default that of the paper.

    Raises:
        ValueError: `zoom` is a `Model`, and `terms` or `distortion_model` is given besides.
    """
    if isinstance(zoom, Model):
        if terms is not None or distortion_model is not None:
            raise ValueError(
                "Argument zoom is a Model, which has a number of terms and a distortion model of its own: "
                "leave out the arguments terms and distortion_model."
            )
        zoom, terms, distortion_model = zoom.zoom, zoom.terms, zoom.distortion_model
    placed: Any = lines if distortion_model is None else with_distortion_model(lines, distortion_model)
    return placed, Model(DEFAULT_ZOOM if zoom is None else zoom, terms, placed.distortion_model)


def ready_model(lines: AbstractLines, model: Model) -> Model:
    """The model ready to be fitted to these lines, in their dtype: for the frames that count.

    Raises:
        ValueError: the zoom model needs more focal lengths, or the focus, which the lines do not have.
    """
    prepared = prepared_for(lines, model.zoom, model.num_coefficients)  # complains of too few focal lengths
    if model.zoom.parameters is None:
        return model.with_zoom(prepared)
    dtype = jnp.asarray(lines.focal).dtype
    arrays, rest = eqx.partition(model.zoom, eqx.is_inexact_array)
    return model.with_zoom(eqx.combine(jax.tree.map(lambda array: array.astype(dtype), arrays), rest))


def prepared_for(lines: AbstractLines, zoom: AbstractZoom, size: int) -> AbstractZoom:
    """A zoom model of so many coefficients, for the frames that count, or for all, if those are too few.

    From others, such as photos left out for a wrong focal length, it takes neither its reference, which a
    prior is about, nor knots, which the lines would not determine.

    Raises:
        ValueError: all are too few, or the model needs the focus, which the lines do not have.
    """
    focal, *focus = settings(zoom, lines)
    counted = frames_that_count(lines)
    if counted is not None:
        try:
            return zoom.prepare(
                np.asarray(focal)[counted], size, *(np.asarray(of)[counted] for of in focus)
            )
        except ValueError:  # the fit of all then says that it is not determined
            pass
    return zoom.prepare(focal, size, *focus)
