"""Which centre of distortion `zoomjax calibrate` found, and why."""

import dataclasses
import math
from typing import Any

import numpy as np

from ..fit.centre import CentreFit
from ..fit.result import ZoomFit
from ..lines.base import AbstractLines
from ..trust.assessment import Finding
from ..trust.bands import std_of
from ..trust.centre_choice import CentreChoice
from .outward import middle_focal

_BESIDE = ". Lines that"
"""After where a centre that moves goes."""


@dataclasses.dataclass(frozen=True)
class CentreFound:
    """The centre of distortion of a calibration.

    Attributes:
        centre: px.
        std: its standard deviations, px; None where it was not fitted.
        how: "fitted", "moving", "image" or "given". One that moves is that in the middle of the zoom.
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

    def moving(self, one: CentreChoice, along: CentreChoice) -> "CentreFound":
        """The same where it may move along the zoom, and whether it does.

        Args:
            one: the comparison of one fitted centre with the given one.
            along: that of one that moves.
        """
        still = one.fitted if one.better else one.given
        if not along.found.determined:
            return self.still("the lines do not determine how it moves")
        if along.far is not None:
            return self.still(f"it would be up to {along.far:.0f} px away, which so few images do not tell")
        if not math.isfinite(along.fitted + still):
            return self.still("not all points have a corrected position about this one and one that moves")
        if not along.fitted <= still:
            return self.still(
                "lines that were not fitted are no straighter about one that moves "
                f"({along.fitted:.4f} px, and {still:.4f} px about this)"
            )
        place, std, way = _way(along.found.fit)
        told = (
            f"{_BESIDE} were not fitted are {along.fitted:.4f} px off straight about it, and {still:.4f} "
            "px about one for all focal lengths."
        )
        return CentreFound(place, std, "moving", way + told)

    def still(self, why: str) -> "CentreFound":
        """The same, and why it was not found to move."""
        return dataclasses.replace(self, sentence=f"{self.sentence} It was not found to move: {why}.")

    def as_uncertain_as(self, fit: ZoomFit) -> "CentreFound":
        """The same with the standard deviations that a fit gives it, where it was fitted."""
        if self.std is None or fit.joint is None:
            return self
        if self.how == "moving":
            place, std, way = _way(fit)
            told = self.sentence[self.sentence.index(_BESIDE) :]
            return CentreFound(place, std, "moving", way + told)
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


def _way(fit: ZoomFit) -> tuple[tuple[float, float], tuple[float, float], str]:
    """The centre in the middle of the zoom, px, its standard deviations, and where it goes, in words."""
    lens = fit.lens
    low, high = (float(f) for f in np.asarray(lens.focal_range))
    at = np.array([low, middle_focal(lens), high])
    places = np.asarray(lens.centre_at(at)).tolist()
    stds = np.asarray(std_of(fit, lambda lens: lens.centre_at(at))).tolist()
    ends = [
        f"{_place(*places[end])}, {_spread((stds[end][0], stds[end][1]))}, at f = {at[end]:.4g} "
        f"{lens.focal_unit}"
        for end in (0, 2)
    ]
    way = f"The centre of distortion was fitted, and moves along the zoom: from {ends[0]} to {ends[1]}"
    return (places[1][0], places[1][1]), (stds[1][0], stds[1][1]), way


def _spread(std: tuple[float, float]) -> str:
    return f"\u00b1 {std[0]:.2g} and \u00b1 {std[1]:.2g} px"


def _place(x: float, y: float) -> str:
    return f"({x:.1f}, {y:.1f}) px"
