"""Lines as functions of the coefficients and, after them, of the centre of distortion.

`AnyCentreLines` are, under the radial polynomial. Under another radial model the points themselves are
corrected about the moved centre; or, compressed for any centre, the powers that stand for the model.
"""

import equinox as eqx

from ..lines.base import AbstractLines
from ..lines.free_centre import AnyCentreLines, compress_any_centre
from ..lines.lines import Lines
from ..models.polynomial import RadialPolynomial
from .problem import Problem, data_of, posed


def for_any_centre(lines: AbstractLines, terms: int) -> AbstractLines:
    """The lines as functions of coefficients and the centre's offset, for so many coefficients.

    Their distortion model has to be radial.

    Raises:
        ValueError: the lines are compressed about one centre.
    """
    return posed(_data(lines, terms), lines.distortion_model, lines.metric, any_centre=True)


def check_any_centre(lines: AbstractLines) -> None:
    """Check that a centre can be fitted to lines.

    Raises:
        ValueError: they are compressed about one centre.
    """
    if not isinstance(data_of(lines), Lines | AnyCentreLines):
        raise ValueError(
            "The centre is fitted to lines that are not compressed about one centre: pass the lines "
            "themselves, or compress_any_centre(lines)."
        )


def _data(lines, terms):
    """The data set of the lines in the form that serves any centre."""
    check_any_centre(lines)
    data = data_of(lines)
    if isinstance(data, Lines) and isinstance(lines.distortion_model, RadialPolynomial):
        return compress_any_centre(data, terms)
    return data


def for_terms(lines: AbstractLines, terms: int) -> AbstractLines:
    """Lines of `for_any_centre` without what only more coefficients need."""
    data = data_of(lines)
    if not (isinstance(data, AnyCentreLines) and isinstance(lines.distortion_model, RadialPolynomial)):
        return lines
    few = data.for_terms(terms)
    return eqx.tree_at(data_of, lines, few) if isinstance(lines, Problem) else few
