"""What all lines have in common that are reduced to one triangle each."""

import dataclasses
from typing import TypeVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._core.checks import checked_size
from .._core.fields import check_shapes, integers, numbers, settings
from .._core.types import Focal, Focus, FrameIndex, LineNumber, LineWeight, Point
from .base import AbstractLines, one_frame

SomeTriangles = TypeVar("SomeTriangles", bound="AbstractTriangles")


class AbstractTriangles(AbstractLines):
    """Lines reduced to a triangle each: R of columns that are made of their points.

    The first row carries the number of points and their mean, the others the points about their mean.
    """

    triangle: Float[Array, "line rows rows"] = eqx.field(converter=numbers("triangle"))
    frame: FrameIndex = eqx.field(converter=integers("frame"))
    focal: Focal = eqx.field(converter=settings("focal"))
    centre: Point = eqx.field(converter=numbers("centre"))
    image_size: tuple[int, int] = eqx.field(static=True, converter=checked_size)
    focal_unit: str = eqx.field(static=True)
    number: LineNumber | None = eqx.field(default=None, converter=integers("number"))
    weight: LineWeight | None = eqx.field(default=None, converter=numbers("weight"))
    focus: Focus | None = eqx.field(default=None, converter=settings("focus"))

    def __check_init__(self):
        """Check that the shapes agree."""
        check_shapes(
            {
                "triangle": (self.triangle, ("line", "rows", "rows")),
                "frame": (self.frame, ("line",)),
                "number": (self.number, ("line",)),
            }
        )

    @property
    def counts(self) -> Float[Array, "line"]:
        """Number of points of each line."""
        return jnp.round(self.triangle[:, 0, 0] ** 2)

    def take(self: SomeTriangles, lines: Int[Array, "some"], present: Bool[Array, "some"]) -> SomeTriangles:
        """The chosen lines as a data set of one frame."""
        triangle = jnp.where(present[:, None, None], self.triangle[lines], 0)
        return dataclasses.replace(self, triangle=triangle, **one_frame(self, lines, present))
