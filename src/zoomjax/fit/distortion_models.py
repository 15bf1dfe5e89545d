"""Lines for a distortion model other than the radial polynomial."""

from .._core.arguments import kinds_checked
from .._core.checks import MOST_TERMS, checked_integer
from ..lines.base import AbstractLines
from ..lines.compressed import CompressedLines, compress
from ..lines.lines import Lines
from ..models.distortion_model import AbstractDistortionModel
from ..models.polynomial import RadialPolynomial
from .problem import Problem, posed


@kinds_checked
def with_distortion_model(lines: AbstractLines, distortion_model: AbstractDistortionModel) -> AbstractLines:
    """The same lines, to be corrected by another distortion model.

    Args:
        lines: the lines, their compressed form, or either measured in the image.
        distortion_model: the one by which points are corrected, such as ``Division()``.

    Example:
        >>> import jax.numpy as jnp, numpy as np
        >>> from zoomjax.models import Division
        >>> from zoomjax import frame_rms
        >>> row = np.stack([np.arange(500.0), np.full(500, 20.0)], axis=-1)
        >>> lines = Lines.from_ragged([row], [0], [24], image_size=(640, 480))
        >>> frame_rms(with_distortion_model(lines, Division()), jnp.array([[-0.1]])).shape
        (1,)
    """
    return posed(lines, distortion_model)


@kinds_checked
def compress_for(
    lines: Lines, distortion_model: AbstractDistortionModel, *, terms: int = 2
) -> AbstractLines:
    """Compress lines exactly for any distortion model, as `compress` does for the radial polynomial.

    Args:
        lines: the lines; their `centre` is the centre the result is for.
        distortion_model: the distortion model to be fitted, which the result stores.
        terms: the largest number N of radial coefficients to be fitted.

    Example:
        >>> import numpy as np
        >>> from zoomjax.models import Division
        >>> from zoomjax import PolynomialZoom, fit_zoom
        >>> t = np.linspace(0.0, 479.0, 50)
        >>> bent = [np.stack([x + (t / 240 - 1) ** 2, t], axis=-1) for x in (9, 30, 599)]
        >>> lines = Lines.from_ragged(bent, [0] * 3, [50], image_size=(640, 480))
        >>> small = compress_for(lines, Division())
        >>> fit_zoom(small, zoom=PolynomialZoom(degree=0), terms=1).lens.distortion_model
        Division()
    """
    terms = checked_integer("terms", terms, 1, MOST_TERMS)
    problem = with_distortion_model(lines, distortion_model)
    return problem.compressed(terms) if isinstance(problem, Problem) else compress(lines, terms)


def compressed_under(
    distortion_model: AbstractDistortionModel, lines: AbstractLines, small: CompressedLines, terms: int
) -> AbstractLines:
    """The lines compressed for a distortion model; `small`: those for the radial polynomial."""
    if isinstance(distortion_model, RadialPolynomial):
        return small
    return (
        compress_for(lines, distortion_model, terms=terms)
        if isinstance(lines, Lines)
        else with_distortion_model(small, distortion_model)
    )
