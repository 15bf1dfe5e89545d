"""Model selection for many lenses at once."""

import collections
import contextlib
import functools
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from typing import Any

from .._core.executors import arrived, checked_executor, in_order, sent
from .._core.types import of_known_values
from ..fit.many_fits import data_sets, many, of_set
from ..fit.zoom import CentreArgument, about_centre, is_to_be_fitted
from ..lines.base import AbstractLines
from ..models.model import Model
from ..models.zoom import AbstractZoom
from .comparison import ComparedModel, Rule
from .folds import HoldOut
from .selection import Choice, Selection, candidates_of, choice_of, select_model

_IN_A_TASK = 8
"""Data sets in a task of an executor: some tenths of a second."""


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
    executor: Executor | None = None,
) -> list[Selection]:
    """Select a model for each of many lenses: what ``[select_model(one) for one in lines]`` gives, sooner.

    The models chosen are fitted by `many`, those that are alike together. What remains is mostly the
    comparison of the candidates, which takes one core: an `executor` divides it among processes.

    Args:
        lines: the data sets, of any sizes; compressed, by ``compress``, they are compared much faster.
        candidates, hold_out, folds, seed, rule, centre: as for `select_model`, of all data sets. With
            ``centre="fit"`` they are made one after the other, no sooner than without this function.
        executor: where candidates are compared, and centres fitted, some data sets a task; None: here.

    Returns:
        The selections, in the order of the data sets. A solver that fails in the last fit raises nothing:
        its `fit.result` says what happened.

    Raises:
        ValueError: as `select_model`; the message begins with the number of the data set.
        TypeError: `lines` is not a sequence of lines, or a candidate or `executor` has the wrong type.
        RuntimeError: the executor gave up.

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
    if executor is None:
        found: list[Any] = [*_each(sets, 0, candidates, centre, how)]
    else:
        found = [*_by_executor(checked_executor(executor), sets, candidates, centre, how)]
    if is_to_be_fitted(centre):
        return found
    alike = collections.defaultdict(list)
    for number, choice in enumerate(found):
        alike[_place(choice, choice.chosen), choice.chosen.name].append(number)
    for numbers in alike.values():
        fits = many([found[number].lines for number in numbers], zoom=found[numbers[0]].chosen)
        for number, fit in zip(numbers, fits, strict=True):
            found[number] = found[number].with_fit(fit)
    return found


def _place(found, model):
    """Of a model among the candidates."""
    return next(place for place, of in enumerate(found.compared) if of.candidate is model)


def _each(sets, first, candidates, centre, how) -> Iterator[Choice | Selection]:
    """What is chosen for each data set, numbered from `first`: with a fitted centre, the selection."""
    for number, one in enumerate(sets, first):
        with of_set(number):
            if is_to_be_fitted(centre):
                yield select_model(one, candidates, **how, centre=centre)
            else:
                yield choice_of(about_centre(one, centre), candidates, **how)


def _by_executor(executor, sets, candidates, centre, how) -> Iterator[Choice | Selection]:
    """The same on an executor, of the candidates here."""
    own, models = None if is_to_be_fitted(centre) else centre, []
    for number, one in enumerate(sets):
        with of_set(number):
            models.append(candidates_of(about_centre(one, own), candidates))
    task = functools.partial(_in_a_task, given=sent((candidates, centre)), how=how)
    parts = ((first, sent(sets[first : first + _IN_A_TASK])) for first in range(0, len(sets), _IN_A_TASK))
    with contextlib.closing(in_order(executor, task, parts)) as done:
        for one in done:
            if one.error is not None:
                raise one.error
            assert one.result is not None
            for number, back in enumerate(arrived(one.result), one.item[0]):
                yield _unpacked(back, models[number])


def _in_a_task(part, *, given, how):
    """`_each` of some of the data sets, for the way back."""
    (first, sets), (candidates, centre) = part, arrived(given)
    return [_packed(found) for found in _each(arrived(sets), first, candidates, centre, how)]


def _packed(found):
    """What was chosen, with the places of candidates in their stead: those there are known by identity."""
    compared = [vars(of) | {"candidate": place} for place, of in enumerate(found.compared)]
    models = {name: _place(found, getattr(found, name)) for name in ("chosen", "best")}
    return sent((type(found), vars(found) | models | {"compared": compared}))


def _unpacked(packed, candidates):
    """What was `_packed`, of these candidates."""
    kind, fields = packed
    compared = tuple(
        ComparedModel(**of | {"candidate": candidates[of["candidate"]]}) for of in fields["compared"]
    )
    models = {name: candidates[fields[name]] for name in ("chosen", "best")}
    return kind(**fields | models | {"compared": compared})
