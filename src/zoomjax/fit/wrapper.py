"""Lines in another shell: corrected by another distortion model, or measured in another metric."""

from typing import Any, TypeVar

import equinox as eqx
from jaxtyping import Array, Float

from .._core.types import Focal, Focus, FrameIndex, LineWeight, Point
from ..lines.base import AbstractLines, SomeLines
from ..lines.free_centre import AnyCentreLines
from ..models.family import AbstractFamily


class AbstractWrapper(AbstractLines):
    """Lines that are corrected or measured in another way; what they are stays as it is."""

    lines: AbstractLines
    frame: FrameIndex
    focal: Focal
    focus: Focus | None
    centre: Point
    image_size: tuple[int, int] = eqx.field(static=True)
    focal_unit: str = eqx.field(static=True)
    weight: LineWeight | None

    @property
    def family(self) -> AbstractFamily:
        """What the coefficients mean."""
        return self.lines.family

    @property
    def counts(self) -> Float[Array, "line"]:
        """Number of points of each line."""
        return self.lines.counts

    def second_moments(self, order: int) -> Float[Array, "line moment 2 2"]:
        """``sum_p r_p^(2i) z_p z_p^T`` of the points as they were seen."""
        return self.lines.second_moments(order)

    def as_weighted(self) -> AbstractLines:
        """The lines with the weights and focal lengths that these have been given."""
        return with_fields_of(self.lines, self)


SomeWrapper = TypeVar("SomeWrapper", bound=AbstractWrapper)


def wrapped(kind: type[SomeWrapper], lines: AbstractLines, **own: Any) -> SomeWrapper:
    """A wrapper of the lines, with their own properties and what it has besides."""
    names = ("frame", "focal", "focus", "centre", "image_size", "focal_unit", "weight")
    return kind(lines=lines, **{name: getattr(lines, name) for name in names}, **own)


def points_of(lines: AbstractLines) -> AbstractLines:
    """The lines without their wrappers."""
    while isinstance(lines, AbstractWrapper):
        lines = lines.lines
    return lines


def about_own_centre(lines: AbstractLines) -> AbstractLines:
    """The lines as functions of a distortion take them: those for any centre about the one they came with.

    For `AnyCentreLines`, wrapped or not, the last two coefficients are a centre's, whatever is given.
    """
    return lines.about(lines.centre) if isinstance(points_of(lines), AnyCentreLines) else lines


def with_fields_of(lines: SomeLines, other: AbstractLines) -> SomeLines:
    """The lines with the focal lengths, focus and weights of a wrapper of them."""
    return eqx.tree_at(
        lambda lines: (lines.focal, lines.focus, lines.weight),
        lines,
        (other.focal, other.focus, other.weight),
        is_leaf=lambda leaf: leaf is None,
    )
