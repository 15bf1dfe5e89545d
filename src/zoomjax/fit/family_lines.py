"""Lines for a distortion model other than the radial polynomial."""

from .._core.arguments import kinds_checked
from .._core.checks import checked_terms
from ..lines.base import AbstractLines
from ..lines.compressed import compress
from ..lines.lines import Lines
from ..models.family import AbstractFamily
from .problem import Problem, posed


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
    return posed(lines, family)


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
    problem, terms = with_family(lines, family), checked_terms(terms)
    return problem.compressed(terms) if isinstance(problem, Problem) else compress(lines, terms)
