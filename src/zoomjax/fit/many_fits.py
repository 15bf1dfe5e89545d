"""Fits of many lenses at once, each to a data set of its own, as for a database of lenses.

A fit of some hundred lines is a few milliseconds of arithmetic, and as many of Python and JAX around it. So
data sets are padded to powers of two of lines (`buckets`), and those of one size are stacked. One program
goes through a stack, a data set after the other, and a thread for each core through the stacks.

A data set after the other, not side by side under ``vmap``: that takes as much arithmetic and more, as each
solver goes on until the last of the stack is done, has three times as much to compile, and two threads of
it stop for ever: LAPACK's calls for many matrices at once wait for threads that wait for them, too.

Once for each data set: padding and the zoom model made ready. A fit that is not certified to be invertible
is done again by the function itself.
"""

import contextlib
import os
from collections import defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._core.arguments import check_kind, kinds_checked
from .._core.programs import program
from .._core.types import of_known_values
from ..lines.base import AbstractLines
from ..lines.buckets import bucketed
from ..models.distortion_model import AbstractDistortionModel
from ..models.model import Model
from ..models.zoom import AbstractZoom
from ._least_squares import Solver, default_solver
from .minimise import fit_freely
from .prepare import asked_for, ready_model
from .result import RESULTS, ZoomFit, failed, of_given
from .robust import RobustFit, fit_robust, fit_robust_freely, robust_of_given
from .zoom import CentreArgument, about_centre, fit_zoom, is_to_be_fitted

_STACK = 16
"""Data sets in a stack. More of them save nothing, and leave a core idle at the end."""


class _Kind(NamedTuple):
    """A fit of many: of a padded data set, inside ``jit``; and of that, the part of what was given."""

    freely: Callable[..., Any]
    of_given: Callable[[Any, AbstractLines], Any]


_KINDS = {
    fit_zoom: _Kind(fit_freely, of_given),
    fit_robust: _Kind(fit_robust_freely, robust_of_given),
}


@overload
def many(
    lines: Sequence[AbstractLines],
    fit: Callable[..., ZoomFit] = ...,
    *,
    zoom: AbstractZoom | Model | None = ...,
    distortion_model: AbstractDistortionModel | None = ...,
    terms: int | None = ...,
    centre: CentreArgument | None = ...,
    solver: Solver | None = ...,
    max_steps: int = ...,
    invertible: bool = ...,
    throw: bool = ...,
) -> list[ZoomFit]: ...


@overload
def many(
    lines: Sequence[AbstractLines],
    fit: Callable[..., RobustFit],
    *,
    zoom: AbstractZoom | Model | None = ...,
    distortion_model: AbstractDistortionModel | None = ...,
    terms: int | None = ...,
    centre: CentreArgument | None = ...,
    solver: Solver | None = ...,
    max_steps: int = ...,
    invertible: bool = ...,
    throw: bool = ...,
) -> list[RobustFit]: ...


@kinds_checked
@of_known_values
def many(
    lines: Sequence[AbstractLines],
    fit: Callable[..., Any] = fit_zoom,
    *,
    zoom: AbstractZoom | Model | None = None,
    distortion_model: AbstractDistortionModel | None = None,
    terms: int | None = None,
    centre: CentreArgument | None = None,
    solver: Solver | None = None,
    max_steps: int = 256,
    invertible: bool = True,
    throw: bool = False,
) -> list[Any]:
    """Fit many lenses, each to its own lines: what ``[fit(one) for one in lines]`` gives, sooner.

    Args:
        lines: the data sets, of any sizes; compressed, by ``compress``, fits are much faster.
        fit: `fit_zoom` or `fit_robust`.
        zoom, distortion_model, terms, centre, solver, max_steps, invertible: as for `fit`, of all data
            sets. Fits of the centre (``centre="fit"``) are made one after the other, no sooner than without
            this function.
        throw: whether to raise if a solver fails. By default the results of the others are returned,
            and the `result` of that one says what happened.

    Returns:
        The fits, in the order of the data sets. Those of one image size, unit and form of lines share
        programs.

    Raises:
        ValueError: a data set has too few distinct focal lengths for the zoom model, or was compressed for
            fewer terms or about another centre; the message begins with its number. Nothing has been fitted
            then, unless the centre is.
        TypeError: `fit` is another function, or `lines` not a sequence of lines.
        RuntimeError: a solver failed (see `throw`).

    Example:
        >>> from zoomjax import compress, fit_zoom, scenes
        >>> lens = scenes.nikkor_18_200()
        >>> boards = [
        ...     compress(scenes.board_lines(lens, scenes.focal_sweep(n), spacing=200, noise=0.5))
        ...     for n in (4, 5)
        ... ]
        >>> [bool(abs(a.rms - fit_zoom(b).rms) < 1e-5) for a, b in zip(many(boards), boards)]
        [True, True]
    """
    if fit not in _KINDS:
        raise TypeError(
            "Argument fit must be fit_zoom or fit_robust. Call another function for one data set after the "
            "other: [function(one) for one in lines]."
        )
    sets = data_sets(lines)
    own: dict[str, Any] = {"zoom": zoom, "distortion_model": distortion_model, "terms": terms}
    fitted = is_to_be_fitted(centre, invertible=invertible)
    jobs = [_job(number, one, own, None if fitted else centre) for number, one in enumerate(sets)]
    fits: list[Any] = [None] * len(sets)
    for number, found, certified in () if fitted else _in_stacks(jobs, fit, solver, max_steps):
        if certified or not invertible:
            fits[number] = _KINDS[fit].of_given(found, sets[number])
    fits = jax.device_put(fits)
    options: dict[str, Any] = {"solver": solver, "max_steps": max_steps, "invertible": invertible}
    for number, one in enumerate(sets):
        if fits[number] is None:
            with of_set(number):
                fits[number] = fit(one, **own, **options, centre=centre, throw=False)
    if throw:
        _raise_failed(fits)
    return fits


def data_sets(lines: Any) -> list[AbstractLines]:
    """The data sets as a list.

    Raises:
        TypeError: they are none.
    """
    if isinstance(lines, AbstractLines) or not isinstance(lines, Sequence):
        raise TypeError(
            "Argument lines must be a list of data sets, [first, second], but its type is "
            f"{type(lines).__name__}."
        )
    for number, one in enumerate(lines):
        if not isinstance(one, AbstractLines):
            raise TypeError(
                "Argument lines must be a list of Lines or compress(lines), but the type of its element "
                f"{number} is {type(one).__name__}."
            )
        check_kind(f"lines[{number}]", one, (AbstractLines,))
    return list(lines)


class _Job(NamedTuple):
    """A data set padded, and its model made ready."""

    lines: AbstractLines
    model: Model
    unfitted: bool  # the model that was asked for
    stacked: bool  # or else it is too large, or on other devices


@contextlib.contextmanager
def of_set(number):
    """Errors begin with the number of the data set."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"Data set {number}: {error}") from error


def _job(number, one, own, centre):
    with of_set(number):
        placed, asked = asked_for(one, **own)
        model = ready_model(placed, asked)
        padded = bucketed(placed, closely=True)
        lines = about_centre(padded, centre)
    return _Job(lines, model, asked.zoom.parameters is None, padded is not placed)


def _in_stacks(jobs, fit, solver, max_steps):
    """Of each data set in a stack its number, its fit, of NumPy's arrays, and whether that is certified."""
    alike = defaultdict(list)
    for number, job in enumerate(jobs):
        if job.stacked:
            leaves, structure = jax.tree.flatten((job.lines, job.model))
            kinds = [(array.shape, array.dtype) for array in map(np.asarray, leaves)]
            alike[structure, *kinds].append(number)
    stacks = [
        [numbers[i : i + _STACK] for i in range(0, len(numbers), _STACK)] for numbers in alike.values()
    ]
    widest = jnp.result_type(float)

    def fitted(numbers):
        first = jobs[numbers[0]]
        rows = [jobs[number][:2] for number in numbers]
        rows += rows[-1:] * (_STACK - len(rows))  # one program for any number of them
        stack = jax.tree.map(lambda *leaves: np.stack(leaves), *rows)
        settings = (first.unfitted, default_solver(first.lines) if solver is None else solver, max_steps)
        found = _fit_each(_KINDS[fit].freely, stack, np.asarray(len(numbers)), settings)
        leaves, structure = jax.tree.flatten(found)
        every = zip(numbers, zip(*map(np.asarray, leaves), strict=True), strict=False)
        return [(number, *jax.tree.unflatten(structure, own)) for number, own in every]

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        # JAX's context managers, such as that for float64, hold in their own thread alone.
        alike_there = pool.submit(lambda: jnp.result_type(float) == widest).result()
        run = pool.map if alike_there else map
        # The first stack of each shape before all others, or every thread would compile the same program.
        for part in ([own[:1] for own in stacks], [own[1:] for own in stacks]):
            for found in run(fitted, [numbers for own in part for numbers in own]):
                yield from found


@program
def _fit_each(freely, stack, number, settings):
    """The fits of the first `number` data sets of a stack, and whether each is certified."""
    arrays, rest = eqx.partition(stack, eqx.is_array)
    unfitted, solver, max_steps = settings

    def one(arrays):
        lines, model = eqx.combine(arrays, rest)
        fit, (certified, _) = freely(lines, model, unfitted, solver, max_steps)
        return fit, certified

    shapes = jax.eval_shape(one, jax.tree.map(lambda leaf: leaf[0], arrays))
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    def one_if_there(job):
        index, arrays = job
        return jax.lax.cond(index < number, one, lambda _: nothing, arrays)

    return jax.lax.map(one_if_there, (jnp.arange(_STACK), arrays))


def _raise_failed(fits):
    results = [getattr(fit, "fit", fit).result for fit in fits]
    bad = [number for number, result in enumerate(results) if failed(result)]
    if bad:
        raise RuntimeError(
            f"{len(bad)} of {len(fits)} fits failed. Data set {bad[0]}: {RESULTS[results[bad[0]]]} With "
            "throw=False the others are returned."
        )
