"""Which zoom model and which centre of distortion `zoomjax calibrate` fits, and why."""

import dataclasses
from typing import Any

import numpy as np

from ..fit.centre import CentreFit
from ..lines.base import AbstractLines
from ..lines.compressed import CompressedLines
from ..lines.lines import Lines
from ..models.smooth import SmoothZoom
from ..models.spline import SplineZoom
from ..models.zoom import AbstractZoom, PolynomialZoom
from ..trust.centre_choice import CentreChoice
from ..trust.selection import Candidate, Selection
from ..trust.staged_selection import select_in_stages

MODELS = ("auto", "polynomial", "smooth", "spline")
"""Zoom models by the names that `calibrate` takes; "auto" chooses."""

_DEGREE, _TERMS = 2, 2
_MOST_DEGREE = 3
_KNOTS = (4, 6, 8)
_MANY_LINES = 300
"""From so many lines on three coefficients compete."""


@dataclasses.dataclass(frozen=True)
class WantedModel:
    """A zoom model as asked for.

    Attributes:
        model: one of `MODELS`.
        degree: of the polynomials; None for the default.
        terms: number of coefficients; None for the default, or for a choice.
    """

    model: str = "auto"
    degree: int | None = None
    terms: int | None = None

    def __post_init__(self):
        """Check that the settings go together.

        Raises:
            ValueError: the model is unknown, or a degree is given for another one than the polynomial.
        """
        if self.model not in MODELS:
            names = ", ".join(MODELS)
            raise ValueError(f"Argument model must be one of {names}, but it is {self.model!r}.")
        if self.degree is not None and self.model not in ("auto", "polynomial"):
            raise ValueError(f"Argument degree is for polynomials: leave it out for model {self.model}.")

    def base(self, focal: Any) -> Candidate:
        """The model itself, or, where it is to be chosen, what lines are rejected and centred with."""
        distinct = np.unique(np.asarray(focal)).size
        terms = _TERMS if self.terms is None else self.terms
        if self.automatic:
            return Candidate(PolynomialZoom(degree=min(_DEGREE, distinct - 1)), terms)
        models: dict[str, AbstractZoom] = {
            "smooth": SmoothZoom(),
            "spline": SplineZoom(number=min(_KNOTS[1], distinct)),
        }
        polynomial = PolynomialZoom(degree=_DEGREE if self.degree is None else self.degree)
        return Candidate(models.get(self.model, polynomial), terms)

    @property
    def automatic(self) -> bool:
        """Whether the model is to be chosen."""
        return self.model == "auto" and self.degree is None

    def most_terms(self, lines: Lines) -> int:
        """The largest number of coefficients that is fitted or compared."""
        return max(self._terms(lines))

    def choose(self, lines: CompressedLines) -> Selection:
        """The model of least cross-validation error.

        Left out are focal lengths, or, with fewer than four, lines. Polynomials, splines of few knots and
        `SmoothZoom` compete with two coefficients, and then the best of them with one and, where there are
        many lines, with three.
        """
        distinct = np.unique(np.asarray(lines.focal)).size
        terms = self._terms(lines)
        degrees = range(min(_MOST_DEGREE + 1, distinct))
        zooms: list[AbstractZoom] = [PolynomialZoom(degree=degree) for degree in degrees]
        zooms += [SplineZoom(number=knots) for knots in _KNOTS if knots < distinct]
        zooms += [SmoothZoom()] if distinct > 1 and terms[0] == _TERMS else []
        return select_in_stages(lines, zooms, terms)

    def _terms(self, lines: Any) -> list[int]:
        """Numbers of coefficients, the first of which the zoom models are compared with."""
        if self.terms is not None or not self.automatic:
            return [_TERMS if self.terms is None else self.terms]
        return [_TERMS, 1, *([3] if len(lines.frame) >= _MANY_LINES else [])]


@dataclasses.dataclass(frozen=True)
class CentreFound:
    """The centre of distortion of a calibration.

    Attributes:
        centre: px.
        std: its standard deviations, px; None where it was not fitted.
        how: "fitted", "image" or "given".
        sentence: how it was found, in words.
    """

    centre: tuple[float, float]
    std: tuple[float, float] | None
    how: str
    sentence: str

    @classmethod
    def of(
        cls, lines: AbstractLines, choice: CentreChoice | None, found: CentreFit | None
    ) -> "CentreFound":
        """The centre of a calibration.

        Args:
            lines: about the centre that was given.
            choice: its comparison with a fitted one; None where that was not asked for.
            found: the fitted one, if that is better.
        """
        x, y = (float(value) for value in np.asarray(lines.centre))
        middle = np.allclose((np.array(lines.image_size) - 1) / 2, (x, y), atol=1e-6)
        how, place = (
            ("image", f"the middle of the image, {_place(x, y)}") if middle else ("given", _place(x, y))
        )
        if choice is None:
            return cls((x, y), None, how, f"The centre of distortion is taken as given: {place}.")
        if found is not None and found.determined:
            u, v = (float(value) for value in np.asarray(found.fit.lens.centre))
            std = (float(found.std[0, 0]), float(found.std[0, 1]))
            return cls(
                (u, v),
                std,
                "fitted",
                f"The centre of distortion was fitted: {_place(u, v)}, \u00b1 {std[0]:.2g} and \u00b1 "
                f"{std[1]:.2g} px. Lines that were not fitted are {choice.fitted:.4f} px off straight "
                f"about it, and {choice.given:.4f} px about {place}.",
            )
        why = "the lines do not determine another one"
        if found is None and choice.found.determined:
            why = (
                f"lines that were not fitted are {choice.fitted:.4f} px off straight about the fitted one, "
                f"and {choice.given:.4f} px about this"
            )
        return cls((x, y), None, how, f"The centre of distortion was kept at {place}: {why}.")

    def summary(self) -> dict[str, Any]:
        """The same for JSON."""
        x, y = self.centre
        std = None if self.std is None else list(self.std)
        return {"x": x, "y": y, "std": std, "how": self.how, "sentence": self.sentence}


def _place(x: float, y: float) -> str:
    return f"({x:.1f}, {y:.1f}) px"
