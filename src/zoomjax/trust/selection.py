"""Model selection: zoom model, degree, number of coefficients and distortion model.

More parameters always make the fitted lines straighter. The criterion is therefore the straightness of
lines that were left out of the fit (`cross_validation`). Their mean squared distance E has a standard
error, from the scatter over the focal lengths, frames or lines that were left out. Two models are measured
on the same ones, and most of the scatter is common to both. So differences are compared, paired:

    s^2 = n/(n-1) sum_u a_u^2 (d_u - d)^2,   d_u = E_u(model)/2R(model) - E_u(best)/2R(best),

a_u being the weight in eq. 13 of what was left out, d the mean, and R the root of E, so that s is of the
difference of two R, px. The one-standard-error rule (Breiman, Friedman, Olshen and Stone 1984) takes the
simplest of the models whose R is above the best one's by no more than s.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, get_args

import jax
import numpy as np

from .._core.arguments import kinds_checked
from .._core.types import of_known_values
from ..fit.distortion_models import compressed_under
from ..fit.image_metric import in_corrected, measured_as
from ..fit.moved_centre import check_any_centre
from ..fit.result import ZoomFit, failed
from ..fit.zoom import CentreArgument, about_centre, fit_zoom, is_to_be_fitted
from ..lines.base import AbstractLines
from ..lines.compressed import CompressedLines
from ..models.model import Model
from ..models.requirements import check
from ..models.smooth import SmoothZoom
from ..models.zoom import AbstractZoom, PolynomialZoom
from .comparison import TIE, ComparedModel, Rule, compare
from .folds import HoldOut, folds_of, small_lines

_TERMS = 3  # of the default candidates, at most
_DEGREES = 4


@dataclasses.dataclass(frozen=True)
class Selection:
    """The selected model, its fit, and the comparison of all candidates. ``print(selection)`` shows a
    table.

    Attributes:
        chosen: the simplest candidate within one standard error of the best.
        best: the candidate of least cross-validated error.
        fit: the fit of the chosen model to all lines.
        compared: the figures of all candidates, in their order.
        hold_out: what was left out: "focal", "frame" or "line".
        folds: number of folds.
        rule: by which the model was chosen.
    """

    chosen: Model
    best: Model
    fit: ZoomFit
    compared: tuple[ComparedModel, ...]
    hold_out: HoldOut
    folds: int
    rule: Rule = "one standard error"

    def rows(self) -> list[tuple[str, str, str, str, str, str]]:
        """The table: candidate, parameters, RMS as fitted and held out, difference to the best, mark."""
        return [self._row(each) for each in self.compared]

    def _row(self, v: ComparedModel) -> tuple[str, str, str, str, str, str]:
        if v.problem:
            return v.candidate.name, "", "", "", "", f"not compared: {v.problem.partition('. ')[0]}"
        return (
            v.candidate.name,
            f"{abs(round(v.parameters, 1)):.1f}".removesuffix(".0"),  # rounding may be below 0
            f"{v.rms:.4f}",
            f"{v.held_out:.4f} ± {v.held_out_std:.4f}",
            "best" if v.candidate is self.best else f"{v.difference:+.5f} ± {v.difference_std:.5f}",
            "chosen" if v.candidate is self.chosen else "",
        )

    def __str__(self) -> str:
        """The table as text."""
        rows = [COLUMNS, *self.rows()]
        width = [max(len(row[i]) for row in rows) for i in range(5)]
        lines = [
            "  ".join([row[0].ljust(width[0]), *map(str.rjust, row[1:5], width[1:]), row[5]]).rstrip()
            for row in rows
        ]
        return "\n".join([self.title, *lines])

    @property
    def title(self) -> str:
        """What the table shows."""
        what = {"focal": "inner focal lengths", "frame": "frames", "line": "lines"}[self.hold_out]
        return f"RMS distance to straight lines, px; {what} left out in {self.folds} parts"

    @property
    def why(self) -> str:
        """Why the chosen model is not the best one, in a sentence; empty if it is."""
        if self.chosen is self.best:
            return ""
        near = (
            f"no more than {100 * TIE:g} %, which is nothing,"
            if self.rule == "least"
            else "no more than one standard error of the difference"
        )
        return f"Of the models that are worse than the best by {near} that of fewest parameters is chosen."

    def summary(self) -> dict:
        """The figures, as plain numbers and strings that JSON can hold."""
        return {
            "chosen": self.chosen.name,
            "best": self.best.name,
            "hold_out": self.hold_out,
            "folds": self.folds,
            "candidates": [
                {"candidate": v.candidate.name}
                | {
                    field.name: None if isinstance(x, float) and not np.isfinite(x) else x
                    for field in dataclasses.fields(v)[1:]
                    for x in [getattr(v, field.name)]
                }
                for v in self.compared
            ],
        }


COLUMNS = ("candidate", "parameters", "fitted", "held out", "to the best", "")
"""Heads of `Selection.rows`."""


@kinds_checked
@of_known_values
def select_model(
    lines: AbstractLines,
    candidates: Sequence[AbstractZoom | Model] | None = None,
    *,
    hold_out: HoldOut | None = None,
    folds: int | None = None,
    seed: int = 0,
    rule: Rule = "one standard error",
    centre: CentreArgument | None = None,
) -> Selection:
    """Select a model by cross-validation, by default with the one-standard-error rule.

    Parts of the lines are left out in turn, and measured with the fit of the others. Of the candidates that
    are as good as the best within one standard error of the difference, the one with the fewest parameters
    is chosen, and fitted to all lines.

    Args:
        lines: the lines, or ``compress(lines, terms=3)``; either also measured in the image (`in_image`).
        candidates: zoom models, or `Model` for other `terms` than 2 or another distortion model. By
            default polynomials in 1/f of degree 0 to 3 with 1 to 3 coefficients (or as many as the lines
            are compressed for), and `SmoothZoom`.
        hold_out: what is left out. "focal": focal lengths with all of their frames, but never the shortest
            and the longest, so that nothing is extrapolated; this measures the interpolation between the
            photographed focal lengths, which is the purpose of the model. "frame": frames, also those at
            both ends, where the model extrapolates unless another frame has that focal length. "line": a
            part of the lines of each frame; this shows whether coefficients are determined, but little
            about focal lengths in between. By default "focal" with four or more distinct focal lengths, and
            "line" with fewer.
        folds: number of parts; by default one for each focal length or frame, but at most 50, and 10 parts
            of the lines.
        seed: random seed of the split, where parts hold more than one. The split depends on nothing else.
        rule: "one standard error", or "least": the candidate of least error, or, of those whose error is
            hardly above it, the one with the fewest parameters.
        centre: as for `fit_zoom`. With "fit", the model is chosen about the centre of the lines, the centre
            fitted with it, where the lines determine one, and the model chosen again about that: parts of
            the lines are compared about one centre. `Selection.fit` has the centre fitted with the model
            chosen.

    Returns:
        The selection. Candidates that cannot be fitted, to all lines or to a fold's, or of which a fold
        does not converge, are in its table with the reason.

        The fits of folds are not made invertible; the final fit is, by `fit_zoom`. Candidates that are
        linear in their parameters are cross-validated at hundreds of fits a second; others, and those of
        another distortion model, with a separate fit for each fold.

    Raises:
        ValueError: no candidate can be compared, nothing can be left out, or an argument is not one of
            those above.
        TypeError: `lines` or a candidate has the wrong type.

    References:
        L. Breiman, J. Friedman, R. Olshen, C. Stone, "Classification and regression trees" (1984), 3.4.3.

    Example:
        >>> from zoomjax import compress, scenes
        >>> scene = scenes.board_lines(
        ...     scenes.nikkor_18_200(), scenes.focal_sweep(8), spacing=100, noise=0.2
        ... )
        >>> select_model(compress(scene, terms=2)).chosen.name
        'degree 2, 2 terms'
    """
    how: Any = {"hold_out": hold_out, "folds": folds, "seed": seed, "rule": rule}
    if is_to_be_fitted(centre):
        return _about_fitted(lines, candidates, how)
    choice = choice_of(about_centre(lines, centre), candidates, **how)
    return choice.with_fit(fit_zoom(choice.lines, zoom=choice.chosen))


@dataclasses.dataclass(frozen=True)
class Choice:
    """A selection before the model chosen is fitted: its fields, and the lines to fit it to."""

    chosen: Model
    best: Model
    compared: tuple[ComparedModel, ...]
    hold_out: HoldOut
    folds: int
    rule: Rule
    lines: AbstractLines

    def with_fit(self, fit: ZoomFit) -> Selection:
        """The selection."""
        return Selection(self.chosen, self.best, fit, self.compared, self.hold_out, self.folds, self.rule)


def choice_of(
    lines: AbstractLines,
    candidates: Sequence[AbstractZoom | Model] | None,
    *,
    hold_out: HoldOut | None,
    folds: int | None,
    seed: int,
    rule: Rule,
) -> Choice:
    """The model chosen, of lines about the centre that they have; see `select_model`."""
    plain, models = in_corrected(lines), candidates_of(lines, candidates)
    if rule not in get_args(Rule):
        raise ValueError(f'Argument rule must be "one standard error" or "least", but it is {rule!r}.')
    own = plain.terms if isinstance(plain, CompressedLines) else max(c.terms for c in models)
    small = small_lines(plain, own)
    forms = {
        c.distortion_model: measured_as(compressed_under(c.distortion_model, plain, small, own), lines)
        for c in models
    }
    parts = folds_of(small, hold_out, folds, seed)
    compared, best, chosen = compare(small, models, parts, forms, rule)
    fitted = forms[chosen.distortion_model]
    return Choice(chosen, best, compared, parts.hold_out, parts.number, rule, fitted)


def candidates_of(
    lines: AbstractLines, candidates: Sequence[AbstractZoom | Model] | None
) -> tuple[Model, ...]:
    """The models that an argument names, or the default ones, as many as the lines are compressed for.

    Raises:
        TypeError: it is one model.
        ValueError: it is empty.
    """
    if isinstance(candidates, AbstractZoom | Model):
        raise TypeError(
            "Argument candidates must be a list of zoom models, [first, second], not one of them."
        )
    if candidates is None:
        plain = in_corrected(lines)
        return default_candidates(
            min(_TERMS, plain.terms) if isinstance(plain, CompressedLines) else _TERMS
        )
    models = tuple(c if isinstance(c, Model) else Model(c) for c in candidates)
    if not models:
        raise ValueError("Argument candidates must hold one or more zoom models, but it is empty.")
    return models


def _about_fitted(lines, candidates, how):
    """The selection about a centre that is fitted with the model chosen about that of the lines."""
    check_any_centre(lines)
    for each in candidates or ():  # whichever is chosen, its centre is fitted
        model = each if isinstance(each, Model) else Model(each)
        check("fit_centre", zoom=model.zoom, distortion_model=model.distortion_model)
    first = select_model(lines, candidates, **how)
    found = fit_zoom(lines, zoom=first.chosen, centre="fit", throw=False)
    if failed(found.result) or np.array_equal(found.lens.centre, lines.centre):
        return first
    again = select_model(lines.about(found.lens.centre), candidates, **how)
    same = again.chosen.name == first.chosen.name
    fit = found if same else fit_zoom(lines, zoom=again.chosen, centre="fit")
    return dataclasses.replace(again, fit=fit)


def default_candidates(terms: int = _TERMS) -> tuple[Model, ...]:
    """Polynomials of degree 0 to 3 with up to so many coefficients, and `SmoothZoom`."""
    return _candidates_in(terms, jax.dtypes.canonicalize_dtype(float))


@functools.cache
def _candidates_in(terms, dtype):
    """The same where the prior's arrays have this dtype, JAX's default: made once."""
    with jax.ensure_compile_time_eval():
        return _made_candidates(terms)


def _made_candidates(terms):
    polynomials = [
        Model(PolynomialZoom(degree=degree), number)
        for number in range(1, terms + 1)
        for degree in range(_DEGREES)
    ]
    return (*polynomials, *([Model(SmoothZoom(), 2)] if terms > 1 else []))
