"""Lines for a distortion model other than the radial polynomial.

Fits use lines only through their corrected points (`AbstractLines.corrected`). Points are corrected by the
model's own formula. Compressed lines stand for powers, in which corrected points are linear: so are they in
the coefficients of `BrownConrady`, by the triangles for any centre, which hold all monomials; those of
`Division` become the 8 of a polynomial, as good as exact (`Division.expansion`).
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._core.arguments import kinds_checked
from .._core.checks import checked_terms
from .._core.types import Centres, traced
from ..lines.base import AbstractLines
from ..lines.compressed import CompressedLines, compress
from ..lines.free_centre import AnyCentreLines, compress_any_centre
from ..lines.lines import Lines, corrected_points
from ..lines.stretch import stretch_of_points
from ..models.family import AbstractFamily, AbstractRadial
from ..models.polynomial import RadialPolynomial
from .image_metric import ImageLines, in_image
from .wrapper import AbstractWrapper, wrapped


class FamilyLines(AbstractWrapper):
    """Lines that are corrected by a distortion model: made by `with_family` and `compress_family`.

    Attributes:
        lines: the lines.
        corrected_by: the distortion model.
        frame, focal, focus, centre, image_size, focal_unit, weight: those of the lines.
    """

    corrected_by: AbstractFamily

    @property
    def family(self) -> AbstractFamily:
        """What the coefficients mean."""
        return self.corrected_by

    def corrected(self, coefficients: Float[Array, "line terms"]) -> Float[Array, "line rows 2"]:
        """Corrected points of each line about their mean, px, or rows with the same scatter.

        Raises:
            ValueError: the lines were compressed for another family, or for fewer terms.
        """
        if isinstance(self.lines, Lines):
            return corrected_points(self.lines, self.family, coefficients)
        self._check(coefficients.shape[1])
        powers, tangential = self.expansion(coefficients)
        if isinstance(self.lines, AnyCentreLines):
            return self.lines.decentred(powers, tangential)
        return self.lines.corrected(powers)

    def _check(self, size):
        name = type(self.family).__name__
        needed = self.family.expansion_terms(size)
        enough = needed <= getattr(self.lines, "terms", 0)
        if isinstance(self.family, AbstractRadial):
            if not (isinstance(self.lines, CompressedLines) and enough):
                raise ValueError(
                    f"{name} needs lines compressed for {needed} terms about a fixed centre, but they are "
                    f"not: compress(lines, terms={needed}), or pass the lines themselves."
                )
        elif not (isinstance(self.lines, AnyCentreLines) and enough):
            raise ValueError(
                f"{name} is not radial, and needs lines compressed with all monomials for {needed} terms, "
                f"but are not: compress_any_centre(lines, terms={needed}), or pass the lines themselves."
            )

    def compressed(self, terms: int) -> "FamilyLines":
        """The same lines compressed, unless they are."""
        if not isinstance(self.lines, Lines):
            return self
        size = self.family.size(terms)
        reduce = compress if isinstance(self.family, AbstractRadial) else compress_any_centre
        small = reduce(self.lines, self.family.expansion_terms(size))
        return eqx.tree_at(lambda lines: lines.lines, self, small)

    def squared_stretch(
        self, coefficients: Float[Array, "line size"], normals: Float[Array, "line 2"]
    ) -> Float[Array, "line"]:
        """The mean of ``|J^T n|^2`` over each line's points."""
        if isinstance(self.family, AbstractRadial):
            return super().squared_stretch(coefficients, normals)
        if isinstance(self.lines, Lines):
            z = (jnp.asarray(self.lines.points) - self.centre[None, None]) / self.scale
            of_line = jax.vmap(stretch_of_points, in_axes=(0, 0, 0, 0, None))
            return of_line(z, jnp.asarray(self.lines.mask), coefficients, normals, self.family)
        self._check(coefficients.shape[1])
        assert isinstance(self.lines, AnyCentreLines)
        return self.lines.decentred_stretch(*self.expansion(coefficients), normals)

    def about(self, centre: Centres) -> "FamilyLines":
        """The same lines about another centre of distortion; see `AbstractLines.about`."""
        if isinstance(self.lines, AnyCentreLines) and not isinstance(self.family, AbstractRadial):
            same = not traced((self.centre, centre)) and np.array_equal(self.centre, centre)
            inside: Any = self.as_weighted()
            return self if same else _wrapped(inside.moved(centre), self.family)
        return _wrapped(self.as_weighted().about(centre), self.family)

    def take(self, lines: Int[Array, "some"], present: Bool[Array, "some"]) -> "FamilyLines":
        """The chosen lines as a data set of one frame."""
        return _wrapped(self.as_weighted().take(lines, present), self.family)


@kinds_checked
def with_family(lines: AbstractLines, family: AbstractFamily) -> AbstractLines:
    """The same lines, to be corrected by another distortion model.

    Args:
        lines: the lines, their compressed form, or either measured in the image.
        family: the distortion model.

    Example:
        >>> import jax.numpy as jnp, numpy as np
        >>> from zoomjax.models import Division
        >>> from zoomjax import frame_rms
        >>> row = np.stack([np.arange(500.0), np.full(500, 20.0)], axis=-1)
        >>> lines = Lines.from_ragged([row], [0], [24], image_size=(640, 480))
        >>> frame_rms(with_family(lines, Division()), jnp.array([[-0.1]])).shape
        (1,)
    """
    if isinstance(lines, ImageLines):
        return in_image(with_family(lines.as_weighted(), family))
    if isinstance(lines, FamilyLines):
        lines = lines.as_weighted()
    return lines if isinstance(family, RadialPolynomial) else _wrapped(lines, family)


@kinds_checked
def compress_family(lines: Lines, family: AbstractFamily, *, terms: int = 2) -> AbstractLines:
    """Compress lines exactly for any distortion model, as `compress` does for the radial polynomial.

    Args:
        lines: the lines; their `centre` is the centre the result is for.
        family: the distortion model to be fitted, which the result stores.
        terms: the largest number N of radial coefficients to be fitted.

    Example:
        >>> import numpy as np
        >>> from zoomjax.models import Division
        >>> from zoomjax import PolynomialZoom, fit_zoom
        >>> t = np.linspace(0.0, 479.0, 50)
        >>> bent = [np.stack([x + (t / 240 - 1) ** 2, t], axis=-1) for x in (9, 30, 599)]
        >>> lines = Lines.from_ragged(bent, [0] * 3, [50], image_size=(640, 480))
        >>> small = compress_family(lines, Division())
        >>> fit_zoom(small, zoom=PolynomialZoom(degree=0), terms=1).lens.family
        Division()
    """
    wrapped = with_family(lines, family)
    return (
        wrapped.compressed(checked_terms(terms))
        if isinstance(wrapped, FamilyLines)
        else compress(lines, terms)
    )


def _wrapped(lines, family):
    return wrapped(FamilyLines, lines, corrected_by=family)
