"""Lines as functions of the coefficients and, after them, of the centre of distortion.

`AnyCentreLines` are, under the radial polynomial. Under another radial model the points themselves are
corrected about the moved centre; or, compressed for any centre, the powers that stand for the model.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._core.types import Centres
from ..lines.base import AbstractLines
from ..lines.free_centre import AnyCentreLines, compress_any_centre
from ..lines.lines import Lines, corrected_points
from ..lines.stretch import stretch_of_points
from ..models.requirements import check
from .family_lines import FamilyLines
from .image_metric import ImageLines, in_image
from .wrapper import AbstractWrapper, points_of, wrapped


class MovedLines(AbstractWrapper):
    """Lines of a radial model; the last two coefficients are the offset of the centre, normalised.

    Attributes:
        lines: the lines with their distortion model.
        frame, focal, focus, centre, image_size, focal_unit, weight: those of the lines.
    """

    def corrected(self, coefficients: Float[Array, "line size"]) -> Float[Array, "line rows 2"]:
        """Corrected points of each line about their mean, px, or rows with the same scatter."""
        points = points_of(self.lines)
        if isinstance(points, AnyCentreLines):
            return points.corrected(self._powers(coefficients))
        k, offset = coefficients[:, :-2], coefficients[:, -2:]
        assert isinstance(points, Lines)
        moved = jnp.asarray(points.points) - self.scale * offset[:, None]
        return corrected_points(eqx.tree_at(lambda of: of.points, points, moved), self.family, k)

    def squared_stretch(
        self, coefficients: Float[Array, "line size"], normals: Float[Array, "line 2"]
    ) -> Float[Array, "line"]:
        """The mean of ``|J^T n|^2`` over each line's points."""
        points = points_of(self.lines)
        if isinstance(points, AnyCentreLines):
            return points.squared_stretch(self._powers(coefficients), normals)
        assert isinstance(points, Lines)
        z = (jnp.asarray(points.points) - self.centre[None, None]) / self.scale - coefficients[:, None, -2:]
        of_line = jax.vmap(stretch_of_points, in_axes=(0, 0, 0, 0, None))
        return of_line(z, jnp.asarray(points.mask), coefficients[:, :-2], normals, self.family)

    def _powers(self, coefficients):
        """Those of the radial polynomial that is the model up to the corner farthest from each centre."""
        points = points_of(self.lines)
        assert isinstance(points, AnyCentreLines)
        needed = self.family.expansion_terms(coefficients.shape[1] - 2)
        if points.terms < needed:
            raise ValueError(
                f"{type(self.family).__name__} needs lines compressed for any centre and {needed} terms, "
                f"but they are for {points.terms}: compress_any_centre(lines, terms={needed}), or pass the "
                "lines themselves."
            )
        far = jnp.maximum(self.centre, jnp.asarray(self.image_size) - 1 - self.centre) / self.scale

        def of_line(k):
            reach = far + jnp.abs(k[-2:])
            return jnp.concatenate([jnp.asarray(self.family.expansion(k[:-2], reach @ reach)[0]), k[-2:]])

        return jax.vmap(of_line)(coefficients)

    def about(self, centre: Centres) -> AbstractLines:
        """The lines about a fixed centre of distortion, px: that of all frames, or of each frame."""
        return self.as_weighted().about(centre)

    def take(self, lines: Int[Array, "some"], present: Bool[Array, "some"]) -> "MovedLines":
        """The chosen lines as a data set of one frame."""
        return wrapped(MovedLines, self.as_weighted().take(lines, present))


def for_any_centre(lines: AbstractLines, terms: int) -> AbstractLines:
    """The lines as functions of coefficients and the centre's offset, for so many coefficients.

    Raises:
        ValueError: the distortion model is not radial, or the lines are compressed about one centre.
    """
    check("fit_centre", family=lines.family)
    if isinstance(lines, ImageLines):
        return in_image(for_any_centre(lines.as_weighted(), terms))
    if isinstance(lines, AnyCentreLines | MovedLines):
        return lines
    if isinstance(lines, Lines):
        return compress_any_centre(lines, terms)
    if isinstance(lines, FamilyLines) and isinstance(lines.lines, Lines | AnyCentreLines):
        return wrapped(MovedLines, lines)
    raise ValueError(
        "The centre is fitted to lines that are not compressed about one centre: pass the lines "
        "themselves, or compress_any_centre(lines)."
    )


def for_terms(lines: AbstractLines, terms: int) -> AbstractLines:
    """Lines of `for_any_centre` without what only more coefficients need."""
    if isinstance(lines, ImageLines):
        return in_image(for_terms(lines.as_weighted(), terms))
    return lines.for_terms(terms) if isinstance(lines, AnyCentreLines) else lines
