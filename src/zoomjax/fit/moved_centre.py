"""Lines as functions of the coefficients and, after them, of the centre of distortion.

`AnyCentreLines` are, under the radial polynomial. Under another radial model the points themselves are
corrected about the moved centre; or, compressed for any centre, the powers that stand for the model.
"""

import equinox as eqx

from ..lines.base import AbstractLines
from ..lines.free_centre import AnyCentreLines, compress_any_centre
from ..lines.lines import Lines
from ..models.polynomial import RadialPolynomial
from ..models.requirements import check
from .problem import Problem, data_of, posed


def for_any_centre(lines: AbstractLines, terms: int) -> AbstractLines:
    """The lines as functions of coefficients and the centre's offset, for so many coefficients.

    Raises:
        ValueError: the distortion model is not radial, or the lines are compressed about one centre.
    """
    check("fit_centre", family=lines.family)
    data = data_of(lines)
    if isinstance(data, Lines) and isinstance(lines.family, RadialPolynomial):
        data = compress_any_centre(data, terms)
    if not isinstance(data, Lines | AnyCentreLines):
        raise ValueError(
            "The centre is fitted to lines that are not compressed about one centre: pass the lines "
            "themselves, or compress_any_centre(lines)."
        )
    return posed(data, lines.family, lines.metric, any_centre=True)


def for_terms(lines: AbstractLines, terms: int) -> AbstractLines:
    """Lines of `for_any_centre` without what only more coefficients need."""
    data = data_of(lines)
    if not (isinstance(data, AnyCentreLines) and isinstance(lines.family, RadialPolynomial)):
        return lines
    few = data.for_terms(terms)
    return eqx.tree_at(data_of, lines, few) if isinstance(lines, Problem) else few
