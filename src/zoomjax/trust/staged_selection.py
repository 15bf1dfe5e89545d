"""Model selection in two stages: first the zoom model, then its number of coefficients."""

from collections.abc import Sequence

from ..fit.image_metric import in_corrected
from ..fit.zoom import fit_zoom
from ..lines.base import AbstractLines
from ..lines.best_line import rounded_by
from ..models.model import Model
from ..models.smooth import SmoothZoom
from ..models.zoom import AbstractZoom
from .comparison import compare_errors, errors_of_candidates
from .folds import folds_of
from .selection import Selection


def select_in_stages(
    lines: AbstractLines, zooms: Sequence[AbstractZoom], terms: Sequence[int], *, folds: int = 10
) -> Selection:
    """Select a zoom model with the first of the numbers of coefficients, and then that number.

    Far fewer candidates than all pairs; the candidate of least error, as with the rule "least". A zoom
    model whose prior is for another number of coefficients keeps its own.

    Args:
        lines: the lines, compressed for the largest of `terms`, in either metric.
        zooms: zoom models, specified but not fitted.
        terms: numbers of coefficients.
        folds: parts into which focal lengths are split, or lines where there are fewer than four.

    Raises:
        ValueError: no candidate can be compared.
    """
    parts, rounding = folds_of(lines, None, folds, 0), rounded_by(float(in_corrected(lines).scale), float)
    candidates = [Model(zoom, terms[0]) for zoom in zooms]
    errors = errors_of_candidates(lines, candidates, parts)
    _, best, chosen = compare_errors(candidates, errors, parts, "least", rounding)
    more = [Model(chosen.zoom, number) for number in terms[1:] if not isinstance(chosen.zoom, SmoothZoom)]
    errors += errors_of_candidates(lines, more, parts)
    candidates += more
    compared, best, chosen = compare_errors(candidates, errors, parts, "least", rounding)
    fit = fit_zoom(lines, zoom=chosen)
    return Selection(chosen, best, fit, compared, parts.hold_out, parts.number, "least")
