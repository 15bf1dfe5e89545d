"""Model selection for many lenses at once."""

import collections
from collections.abc import Sequence
from typing import Any

from .._core.types import of_known_values
from ..fit.many_fits import data_sets, many, of_set
from ..fit.zoom import CentreArgument, about_centre, is_to_be_fitted
from ..lines.base import AbstractLines
from ..models.model import Model
from ..models.zoom import AbstractZoom
from .comparison import Rule
from .folds import HoldOut
from .selection import Selection, choice_of, select_model


@of_known_values
def select_many(
    lines: Sequence[AbstractLines],
    candidates: Sequence[AbstractZoom | Model] | None = None,
    *,
    hold_out: HoldOut | None = None,
    folds: int | None = None,
    seed: int = 0,
    rule: Rule = "one standard error",
    centre: CentreArgument | None = None,
) -> list[Selection]:
    """Select a model for each of many lenses: what ``[select_model(one) for one in lines]`` gives, sooner.

    The models chosen are fitted by `many`, those that are alike together. What remains is mostly the
    comparison of the candidates, which is not made sooner: divide the data sets among processes for more.

    Args:
        lines: the data sets, of any sizes; compressed, by ``compress``, they are compared much faster.
        candidates, hold_out, folds, seed, rule, centre: as for `select_model`, of all data sets. With
            ``centre="fit"`` they are made one after the other, no sooner than without this function.

    Returns:
        The selections, in the order of the data sets. A solver that fails in the last fit raises nothing:
        its `fit.result` says what happened.

    Raises:
        ValueError: as `select_model`; the message begins with the number of the data set.
        TypeError: `lines` is not a sequence of lines, or a candidate has the wrong type.

    Example:
        >>> from zoomjax import compress, scenes
        >>> lens = scenes.nikkor_18_200()
        >>> boards = [
        ...     compress(scenes.board_lines(lens, scenes.focal_sweep(n), spacing=200, noise=0.2))
        ...     for n in (6, 8)
        ... ]
        >>> [
        ...     many.chosen.name == select_model(one).chosen.name
        ...     for many, one in zip(select_many(boards), boards)
        ... ]
        [True, True]
    """
    sets = data_sets(lines)
    how: Any = {"hold_out": hold_out, "folds": folds, "seed": seed, "rule": rule}
    found: list[Any] = []
    for number, one in enumerate(sets):
        with of_set(number):
            if is_to_be_fitted(centre):
                found.append(select_model(one, candidates, **how, centre=centre))
            else:
                found.append(choice_of(about_centre(one, centre), candidates, **how))
    if is_to_be_fitted(centre):
        return found
    alike = collections.defaultdict(list)
    for number, choice in enumerate(found):
        place = next(i for i, of in enumerate(choice.compared) if of.candidate is choice.chosen)
        alike[place, choice.chosen.name].append(number)
    for numbers in alike.values():
        fits = many([found[number].lines for number in numbers], zoom=found[numbers[0]].chosen)
        for number, fit in zip(numbers, fits, strict=True):
            found[number] = found[number].with_fit(fit)
    return found
