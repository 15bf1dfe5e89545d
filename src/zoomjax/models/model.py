"""A model of a lens along the zoom, as one value: what fits take and `select_model` compares."""

import dataclasses
import typing
from typing import Any

import equinox as eqx
from jaxtyping import PyTree

from .._core.arguments import kinds_checked
from .distortion_model import AbstractDistortionModel
from .polynomial import RadialPolynomial
from .zoom import AbstractZoom, PolynomialZoom, terms_of, with_parameters

_POLYNOMIAL = RadialPolynomial()


class Model(eqx.Module):
    """A zoom model, its number of radial distortion coefficients, and the distortion model.

    ``fit_zoom(lines, zoom=Model(PolynomialZoom(degree=2), terms=1, distortion_model=Division()))`` fits it,
    as do the other fits; `select_model` compares several; `ZoomLens.model` is that of a lens.

    Attributes:
        zoom: the zoom model, specified or fitted, such as ``PolynomialZoom(degree=2)``.
        terms: N, of eq. 2; by default 2, or as many as a `zoom` with parameters has.
        distortion_model: the distortion model; by default the radial polynomial (eq. 2).

    Raises:
        TypeError: `zoom` or `distortion_model` is none.
        ValueError: there is no such number of coefficients, or the parameters of `zoom` are for another.

    Example:
        >>> from zoomjax.models import Division, Model
        >>> Model(PolynomialZoom(degree=1), terms=1, distortion_model=Division()).name
        'Division, degree 1, 1 term'
    """

    zoom: AbstractZoom
    terms: int = eqx.field(static=True)
    distortion_model: AbstractDistortionModel

    @kinds_checked  # with sentences of our own
    @typing.no_type_check
    def __init__(
        self,
        zoom: AbstractZoom,
        terms: int | None = None,
        distortion_model: AbstractDistortionModel = _POLYNOMIAL,
    ) -> None:
        """Check what it is made of."""
        self.zoom, self.distortion_model = zoom, distortion_model
        self.terms = terms_of(zoom, terms, distortion_model)

    @property
    def num_coefficients(self) -> int:
        """The number of all coefficients: the radial ones, and what the distortion model has besides."""
        return self.distortion_model.num_coefficients(self.terms)

    @property
    def name(self) -> str:
        """What it is called: "degree 2, 2 terms" if it is a polynomial in 1/f; others with their kind."""
        settings = [
            f"{field.name} {value}"
            for field in dataclasses.fields(self.zoom)
            if field.metadata.get("static") and (value := getattr(self.zoom, field.name)) is not None
        ]
        other: list[Any] = [self.zoom] * (not isinstance(self.zoom, PolynomialZoom))
        other += [self.distortion_model] * (not isinstance(self.distortion_model, RadialPolynomial))
        kind = [type(model).__name__ for model in other]
        return ", ".join([*kind, *settings, f"{self.terms} term{'s' * (self.terms > 1)}"])

    def with_zoom(self, zoom: AbstractZoom) -> "Model":
        """The same with another zoom model of as many coefficients: unlike the constructor unchecked."""
        return eqx.tree_at(lambda model: model.zoom, self, zoom)

    def with_parameters(self, parameters: PyTree) -> "Model":
        """The same with other parameters of the zoom model; None for one that is specified alone."""
        if parameters is None and self.zoom.parameters is None:
            return self
        return self.with_zoom(with_parameters(self.zoom, parameters))
