"""Which zoom model and which centre of distortion `zoomjax calibrate` fits, and why."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..fit.centre import CentreFit
from ..fit.result import ZoomFit
from ..fit.zoom import CentreArgument
from ..lines.base import AbstractLines
from ..lines.lines import Lines
from ..models.brown_conrady import BrownConrady
from ..models.distortion_model import AbstractDistortionModel, checked_terms
from ..models.division import Division
from ..models.model import Model
from ..models.polynomial import RadialPolynomial
from ..models.requirements import refusal
from ..models.smooth import SmoothZoom
from ..models.spline import SplineZoom
from ..models.zoom import AbstractZoom, PolynomialZoom
from ..trust.assessment import Finding
from ..trust.between import FEWEST_CHECKED, zoom_places
from ..trust.centre_choice import CentreChoice
from ..trust.folds import focals_there
from ..trust.selection import Selection, select_model
from ..trust.staged_selection import select_in_stages
from .equipment import KnownLens
from .outward import outward

MODELS = ("auto", "polynomial", "smooth", "spline")
"""Zoom models by the names that `calibrate` takes; "auto" chooses."""

DISTORTION_MODELS: dict[str, AbstractDistortionModel] = {
    "radial": RadialPolynomial(),
    "division": Division(),
    "brown-conrady": BrownConrady(),
}
"""Distortion models by the names that `calibrate` takes, besides "auto", which chooses."""

STRONG: AbstractDistortionModel = Division()
"""The distortion model that competes with the polynomial for strong lenses."""

_SMOOTH_STRONG = Model(SmoothZoom(), 2, STRONG)
"""For two or three places in the zoom. To first order the coefficients of the division model are those of
the polynomial with the other sign, so that a prior without a mean is the same."""

_STRONG = 0.15
"""Displacement of a corner, in radii. Below it a polynomial with two terms and the division model with one
are nearly the same."""

_DEGREE, _TERMS = 2, 2
_MOST_DEGREE = 3
_KNOTS = (4, 6, 8)
_FOLDS = 10
_MANY_LINES = 300
"""From so many lines on three coefficients compete."""


@dataclasses.dataclass(frozen=True)
class WantedModel:
    """The model asked for: zoom model, number of coefficients and distortion model.

    Attributes:
        model: one of `MODELS`.
        degree: of the polynomials; None for the default.
        terms: number of coefficients; None for the default, or for a choice.
        distortion_model: one of `DISTORTION_MODELS`, or "auto" for the one of least cross-validation error.
            None: the radial polynomial; where the lens turns out to be a strong one, it competes with the
            division model.
        lens: what is known of the lens, for the prior of `SmoothZoom`.
    """

    model: str = "auto"
    degree: int | None = None
    terms: int | None = None
    distortion_model: str | None = None
    lens: KnownLens | None = None

    def __post_init__(self):
        """Check that the settings go together.

        Raises:
            ValueError: the model is unknown; a degree is given for another one than the polynomial; or the
                distortion model, or the prior of the zoom model, does not have so many terms.
        """
        if self.model not in MODELS:
            names = ", ".join(MODELS)
            raise ValueError(f"Argument model must be one of {names}, but it is {self.model!r}.")
        if self.degree is not None and self.model not in ("auto", "polynomial"):
            raise ValueError(f"Argument degree is for polynomials: leave it out for model {self.model}.")
        if self.distortion_model not in (None, "auto", *DISTORTION_MODELS):
            names = ", ".join(["auto", *DISTORTION_MODELS])
            raise ValueError(
                f"Argument distortion_model must be one of {names}, but it is {self.distortion_model!r}."
            )
        if self.terms is not None:
            checked_terms(self.terms, self.first_distortion_model.most_terms)
        if self.model == "smooth" and self.terms not in (None, _TERMS):
            raise ValueError(
                f"Argument model smooth has a prior for {_TERMS} coefficients: leave out argument terms."
            )
        if self.distortion_model not in (None, "radial", "division") and self.model == "smooth":
            raise ValueError(
                "Argument model smooth has no prior for this distortion model: leave out argument "
                "distortion_model."
            )

    @property
    def first_distortion_model(self) -> AbstractDistortionModel:
        """The distortion model, or, where it is to be chosen, the first one."""
        return DISTORTION_MODELS.get(self.distortion_model or "radial", RadialPolynomial())

    @property
    def smooth(self) -> SmoothZoom:
        """The `SmoothZoom`, with a prior for what is known of the lens, which is for the polynomial."""
        if self.lens is None or not isinstance(self.first_distortion_model, RadialPolynomial):
            return SmoothZoom()
        return self.lens.prior()

    @property
    def usual_centre(self) -> CentreArgument:
        """The centre of distortion where none is asked for."""
        return "image" if refusal("fit_centre", distortion_model=self.first_distortion_model) else "fit"

    def check_centre(self, centre: CentreArgument | None) -> None:
        """Refuse to fit the centre of a model that has none of its own.

        Raises:
            ValueError: it is to be fitted nevertheless.
        """
        if isinstance(centre, str) and centre == "fit" and self.usual_centre != "fit":
            raise ValueError(
                f'Argument centre cannot be "fit" with argument distortion_model {self.distortion_model}: '
                'give "image" or coordinates. (Its decentering does nearly the same as another centre.)'
            )

    def base(self, focal: Any) -> Model:
        """The model itself, or, where it is to be chosen, what lines are rejected and centred with."""
        distinct = np.unique(np.asarray(focal)).size
        terms = _TERMS if self.terms is None else self.terms
        if self.automatic:
            return Model(
                PolynomialZoom(degree=min(_DEGREE, distinct - 1)), terms, self.first_distortion_model
            )
        models: dict[str, AbstractZoom] = {
            "smooth": self.smooth,
            "spline": SplineZoom(number=min(_KNOTS[1], distinct)),
        }
        polynomial = PolynomialZoom(degree=_DEGREE if self.degree is None else self.degree)
        return Model(models.get(self.model, polynomial), terms, self.first_distortion_model)

    @property
    def automatic(self) -> bool:
        """Whether the model is to be chosen."""
        return self.model == "auto" and self.degree is None

    def most_terms(self, lines: Lines) -> int:
        """The largest number of coefficients that is fitted, compared or, for the misfit, thought of."""
        terms = self._terms(lines)
        return max(*terms, min(terms[0] + 1, RadialPolynomial.most_terms))

    def choose(self, lines: AbstractLines) -> Selection:
        """The model of least cross-validation error.

        Left out are focal lengths, or, with fewer than four, lines. Polynomials, splines of few knots and
        `SmoothZoom` compete with two coefficients, and then the best of them with one and, where there are
        many lines, with three. Of two or three places in the zoom none can be left out, and lines say
        nothing of what lies between: there `SmoothZoom` alone is taken, which knows what zoom lenses do.
        """
        distinct = np.unique(np.asarray(lines.focal)).size
        terms = self._terms(lines)
        if terms[0] == _TERMS and _has_few_places(lines):
            return select_in_stages(lines, [self.smooth], terms)
        degrees = range(min(_MOST_DEGREE + 1, distinct))
        zooms: list[AbstractZoom] = [PolynomialZoom(degree=degree) for degree in degrees]
        zooms += [SplineZoom(number=knots) for knots in _KNOTS if knots < distinct]
        zooms += [self.smooth] if distinct > 1 and terms[0] == _TERMS else []
        return select_in_stages(lines, zooms, terms)

    def choose_zoom(self, lines: AbstractLines) -> Selection:
        """The model of least cross-validation error under another distortion model than the polynomial.

        Each part that is left out takes a fit, so that few compete: polynomials with two coefficients, and
        with other numbers of them the one of degree 2, or of the highest degree that there is. For two or
        three places in the zoom see `choose`.
        """
        distinct, terms = np.unique(np.asarray(lines.focal)).size, self._terms(lines)
        if self.first_distortion_model == STRONG and terms[0] == _TERMS and _has_few_places(lines):
            return _selected(lines, [_SMOOTH_STRONG])
        degrees = range(min(_MOST_DEGREE + 1, distinct))
        pairs = [(degree, terms[0]) for degree in degrees]
        pairs += [(min(_DEGREE, distinct - 1), number) for number in terms[1:]]
        return _selected(
            lines, [Model(PolynomialZoom(degree=d), n, self.first_distortion_model) for d, n in pairs]
        )

    def choose_distortion_model(
        self, lines: AbstractLines, chosen: Model, compared: Sequence[Model]
    ) -> Selection:
        """The distortion model of least cross-validation error: of all, or of two for a strong lens.

        Args:
            lines: the lines, about their centre and with their weights.
            chosen: the model chosen under the radial polynomial.
            compared: what it was chosen from.
        """
        zoom = chosen.zoom
        if isinstance(zoom, SmoothZoom):  # its prior is for the radial polynomial
            zoom = PolynomialZoom(degree=min(_DEGREE, np.unique(np.asarray(lines.focal)).size - 1))
        numbers = dict.fromkeys([chosen.terms, *self._terms(lines)])
        several = list(DISTORTION_MODELS.values())[1:] if self.distortion_model == "auto" else [STRONG]
        others = [
            Model(zoom, number, other)
            for other in several
            for number in numbers
            if number <= other.most_terms
        ]
        if isinstance(chosen.zoom, SmoothZoom) and _has_few_places(lines):
            others = [_SMOOTH_STRONG]
        return _selected(lines, [*compared, *others])

    def is_beyond(self, fit: ZoomFit) -> bool:
        """Whether a fit of the radial polynomial is to compete with the division model.

        It is where it moves a corner by more than `_STRONG` of the way, or folds: a polynomial follows such
        lenses with many terms only.
        """
        if self.distortion_model is not None or self.model == "smooth":
            return False
        lens = fit.lens
        centre = np.asarray(lens.centre)
        last = np.array(lens.image_size) - 1
        corner = np.where(centre > last / 2, 0.0, last)
        moved = outward(lens, corner, [float(f) for f in lens.focal_range])
        return not bool(np.max(abs(moved)) < _STRONG * np.hypot(*(corner - centre)))

    def _terms(self, lines: Any) -> list[int]:
        """Numbers of coefficients, the first of which the zoom models are compared with."""
        if self.terms is not None or not self.automatic:
            return [_TERMS if self.terms is None else self.terms]
        return [_TERMS, 1, *([3] if len(lines.frame) >= _MANY_LINES else [])]


def _has_few_places(lines: AbstractLines) -> bool:
    """Whether lines are at two or three places in the zoom, of which none can be left out."""
    return 1 < len(zoom_places(focals_there(lines))) < FEWEST_CHECKED


def _selected(lines: AbstractLines, candidates: Sequence[Model]) -> Selection:
    """The candidate of least error, over focal lengths left out, or lines where there are few."""
    distinct = np.unique(np.asarray(lines.focal)).size
    folds = min(_FOLDS, distinct - 2) if distinct > 3 else _FOLDS
    if lines.weight is None:
        lines = lines.weighted(np.ones(lines.frame.shape))  # as in every fold: one compiled program
    return select_model(lines, candidates, folds=folds, rule="least")


@dataclasses.dataclass(frozen=True)
class CentreFound:
    """The centre of distortion of a calibration.

    Attributes:
        centre: px.
        std: its standard deviations, px; None where it was not fitted.
        how: "fitted", "image" or "given".
        sentence: how it was found, in words.
        straighter: how far from it, px, the one is about which lines that were not fitted are straighter,
            where that is farther than so few frames can tell; otherwise None.
    """

    centre: tuple[float, float]
    std: tuple[float, float] | None
    how: str
    sentence: str
    straighter: float | None = None

    def findings(self) -> list[Finding]:
        """What speaks against it: that lines are straightest about another one, far away."""
        if self.straighter is None:
            return []
        return [
            Finding(
                "centre of distortion",
                "doubtful",
                f"the lines are straightest about a centre that is {self.straighter:.0f} px away, as where "
                "they are bent or the image is cropped.",
                "Check that what was photographed is straight and flat, and photograph more of it; or give "
                "--centre X,Y if the centre is there.",
            )
        ]

    @classmethod
    def of(
        cls, lines: AbstractLines, choice: CentreChoice | None, found: CentreFit | None
    ) -> "CentreFound":
        """The centre of a calibration.

        Args:
            lines: about the centre that was given.
            choice: its comparison with a fitted one; None where there is none.
            found: the fitted one, if that is better.
        """
        x, y = (float(value) for value in np.asarray(lines.centre))
        middle = np.allclose((np.array(lines.image_size) - 1) / 2, (x, y), atol=1e-6)
        how, place = (
            ("image", f"the middle of the image, {_place(x, y)}") if middle else ("given", _place(x, y))
        )
        if choice is None and found is not None and found.determined:
            return cls._fitted(found, ".")
        if choice is None:
            return cls((x, y), None, how, f"The centre of distortion is taken as given: {place}.")
        if found is not None and found.determined:
            more = (
                f". Lines that were not fitted are {choice.fitted:.4f} px off straight about it, and "
                f"{choice.given:.4f} px about {place}."
            )
            return cls._fitted(found, more)
        why = "the lines do not determine another one"
        if found is None and choice.found.determined:
            why = (
                f"lines that were not fitted are {choice.fitted:.4f} px off straight about the fitted one, "
                f"and {choice.given:.4f} px about this"
            )
            if not math.isfinite(choice.fitted + choice.given):
                why = "not all points have a corrected position about this one and the fitted one"
        if found is None and choice.found.determined and choice.far is not None:
            why = (
                f"the one about which lines would be straightest is {choice.far:.0f} px away. With so "
                "few images that may also come from bent lines. If it is there, give --centre X,Y"
            )
        told = f"The centre of distortion was kept at {place}: {why}."
        return cls((x, y), None, how, told, choice.far if choice.fitted < choice.given else None)

    @classmethod
    def _fitted(cls, found: CentreFit, more: str) -> "CentreFound":
        """A fitted centre, and what else there is to say of it."""
        u, v = (float(value) for value in np.asarray(found.fit.lens.centre))
        std = (float(np.asarray(found.std)[0, 0]), float(np.asarray(found.std)[0, 1]))
        told = f"The centre of distortion was fitted: {_place(u, v)}, {_spread(std)}{more}"
        return cls((u, v), std, "fitted", told)

    def as_uncertain_as(self, fit: ZoomFit) -> "CentreFound":
        """The same with the standard deviations that a fit gives it, where it was fitted."""
        if self.std is None or fit.joint is None or fit.lens.shift is not None:
            return self
        x, y = fit.lens.scale * np.sqrt(np.diag(np.asarray(fit.joint))[-2:])
        std = (float(x), float(y))
        return dataclasses.replace(
            self, std=std, sentence=self.sentence.replace(_spread(self.std), _spread(std))
        )

    def summary(self) -> dict[str, Any]:
        """The same for JSON."""
        x, y = self.centre
        std = None if self.std is None else list(self.std)
        return {"x": x, "y": y, "std": std, "how": self.how, "sentence": self.sentence}


def _spread(std: tuple[float, float]) -> str:
    return f"\u00b1 {std[0]:.2g} and \u00b1 {std[1]:.2g} px"


def _place(x: float, y: float) -> str:
    return f"({x:.1f}, {y:.1f}) px"
