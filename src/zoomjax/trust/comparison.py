"""Comparison of models by their errors on lines that were left out: see `selection`."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from ..fit.image_metric import in_corrected
from ..lines.base import AbstractLines
from ..lines.best_line import rounded_by
from ..lines.compressed import CompressedLines
from ..models.distortion_model import AbstractDistortionModel
from ..models.model import Model
from .cross_validation import errors_of_models
from .folds import Folds, LineErrors

Rule = Literal["one standard error", "least"]

TIE = 5e-4
"""Part of the error: candidates that differ by less are as good as each other, under the rule "least"."""


@dataclasses.dataclass(frozen=True)
class ComparedModel:
    """The figures of one candidate. All RMS are of the same lines, px; NaN where not available.

    Attributes:
        candidate: the candidate.
        parameters: effective number of parameters; a prior makes it smaller than the actual number.
        rms: RMS of the lines in the fit (in sample).
        held_out: cross-validated RMS: each line is measured by a fit without it.
        held_out_std: standard error of `held_out`.
        difference: difference of `held_out` from that of the best candidate.
        difference_std: standard error of `difference`, paired.
        problem: why it was not compared, in a sentence; empty if it was.
    """

    candidate: Model
    parameters: float = np.nan
    rms: float = np.nan
    held_out: float = np.nan
    held_out_std: float = np.nan
    difference: float = np.nan
    difference_std: float = np.nan
    problem: str = ""


def errors_of_candidates(
    lines: AbstractLines, candidates: Sequence[Model], parts: Folds
) -> list[LineErrors | str]:
    """The errors of each, or why there are none."""
    models, why = [c.with_parameters(None) for c in candidates], [""] * len(candidates)
    if isinstance(small := in_corrected(lines), CompressedLines):
        for place, model in enumerate(models):
            try:
                small.check_terms(model.terms)
            except ValueError as error:
                why[place] = str(error)
    found = iter(errors_of_models(lines, [m for m, no in zip(models, why, strict=True) if not no], parts))
    return [no or next(found) for no in why]


def compare(
    lines: CompressedLines,
    candidates: Sequence[Model],
    parts: Folds,
    forms: Mapping[AbstractDistortionModel, AbstractLines] | None = None,
    rule: Rule = "one standard error",
) -> tuple[tuple[ComparedModel, ...], Model, Model]:
    """The figures of each, the best candidate and the chosen one; see `select_model`.

    `forms` are the same lines for distortion models other than the radial polynomial.
    """
    errors: list[LineErrors | str] = [""] * len(candidates)
    for distortion_model in dict.fromkeys(c.distortion_model for c in candidates):
        places = [i for i, c in enumerate(candidates) if c.distortion_model == distortion_model]
        own = (forms or {}).get(distortion_model, lines)
        for i, of in zip(
            places, errors_of_candidates(own, [candidates[i] for i in places], parts), strict=True
        ):
            errors[i] = of
    return compare_errors(candidates, errors, parts, rule, rounded_by(float(lines.scale), float))


def compare_errors(candidates, errors, parts, rule, rounding=0.0):
    """The same of candidates whose errors, or why there are none, are known; and what they round by, px."""
    counted = (parts.unit >= 0) & (parts.share > 0)
    unit, share = parts.unit[counted], parts.share[counted] / parts.share[counted].sum()
    weight = np.bincount(unit, share)

    def by_unit(of_line):
        return np.bincount(unit, share * of_line[counted]) / np.where(weight > 0, weight, 1)

    unseen = {}
    for i, judged in enumerate(errors):
        if isinstance(judged, LineErrors) and not judged.problem:
            unseen[i] = by_unit(judged.unseen)
    if not unseen:
        reasons = {e if isinstance(e, str) else e.problem for e in errors}
        raise ValueError(f"No candidate can be compared. {' '.join(sorted(reasons))}")
    roots = {i: np.sqrt(weight @ own) for i, own in unseen.items()}
    least = min(roots.values())
    equal = [i for i in roots if roots[i] <= least + max(_ROUNDING * least, rounding)]
    best = min(equal, key=lambda i: round(errors[i].parameters, 6))  # of equal ones the simplest, the first
    compared = [
        _figures(candidate, judged, unseen.get(i), unseen[best], weight, by_unit)
        for i, (candidate, judged) in enumerate(zip(candidates, errors, strict=True))
    ]
    within = [v for v in compared if not v.problem and v.difference <= _allowed(v, rule, rounding)]
    chosen = min(within, key=lambda v: (round(v.parameters, 6), _in_digits(v.held_out))).candidate
    return tuple(compared), candidates[best], chosen


def _allowed(each, rule, rounding):
    """By how much a candidate may be above the best to be chosen."""
    own = each.difference_std if rule == "one standard error" else TIE * each.held_out
    return max(own, _ROUNDING * each.held_out, rounding)


_ROUNDING = 1e-9
"""Part of the error by which candidates differ that give the same coefficients at all frames."""


def _in_digits(error):
    """An error without its last digits, which are rounding: of equal ones the first candidate is taken."""
    return float(f"{error:.9g}")


def _figures(candidate, judged, unseen, best, weight, by_unit):
    if isinstance(judged, str):
        return ComparedModel(candidate, problem=judged)
    rms = float(np.sqrt(weight @ by_unit(judged.seen)))
    if unseen is None:
        return ComparedModel(candidate, judged.parameters, rms, problem=judged.problem)
    own, own_part = _root(weight, unseen)
    least, least_part = _root(weight, best)
    return ComparedModel(
        candidate,
        judged.parameters,
        rms,
        own,
        _standard_error(weight, own_part),
        own - least,
        _standard_error(weight, own_part - least_part),
    )


def _root(weight, squares):
    """The root of the mean, and what each of the squares does to it."""
    mean = weight @ squares
    root = float(np.sqrt(mean))
    return root, (squares - mean) / (2 * root if root > 0 else 1)


def _standard_error(weight, deviation):
    """Of a weighted mean, from the deviations of what it is the mean of."""
    number = np.sum(weight > 0)
    return float(np.sqrt(np.sum((weight * deviation) ** 2) * number / max(number - 1, 1)))
