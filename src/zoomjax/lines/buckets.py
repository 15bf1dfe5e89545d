"""Sizes that data sets are padded to, so that sets of other sizes share compiled programs.

XLA compiles a program for each shape of its arguments, in seconds, where a fit takes milliseconds. So lines
and frames are padded to a few sizes: with lines without points, which count as none (`line_weights`), and
with frames that repeat the last focal length and have no lines. Weights are written out, and what no fit
looks at is left away. Results are the same up to the order of sums, and are cut to what was there.

Lines are left as they are where padding would cost more than it saves, or cannot be: inside ``jit``, on a
GPU or several devices, and where the points themselves are many millions. Compress those.
"""

import dataclasses
import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, ParamSpec, TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Int

from .._core.programs import program, used_once
from .._core.types import AnyArray, traced
from .base import AbstractLines, SomeLines

_LINES = (64, 256, 1024, 2048, 4096)
_FRAMES = (8, 32, 64, 128)
_IN_FRAME = (16, 32, 64, 128, 256)
_POINTS = (64, 128, 256)
"""Sizes; a fit of so few lines takes a few milliseconds. Larger ones are four to each doubling."""

_LINES_ONCE = (256, 2048, 4096)
"""Sizes in a process that does each thing once or twice (`use_once`): twenty photos of a board share them
with thirty, which saves a minute, and some milliseconds more in each fit are not noticed."""

_MANY = 2**17
"""Numbers in the points, from which on lines, too, are padded to sizes that are closer together."""

_MOST = 2**22
"""Numbers in the points of lines that are padded: a copy of more takes as long as a part of a fit."""

_OF_LINES = ("triangle", "points", "mask", "frame", "weight", "number")
_OF_FRAMES = ("focal", "focus")
_OTHER = ("lines", "centre")

Cut = Callable[..., Any] | None
_Given = ParamSpec("_Given")
_Result = TypeVar("_Result")


def bucket(number: int, sizes: Sequence[int]) -> int:
    """The least of the sizes that holds so many; beyond the last, of four to each doubling."""
    if number <= sizes[-1]:
        return next(size for size in sizes if number <= size)
    step = (1 << (number - 1).bit_length()) // 8
    return -(-number // step) * step


def bucketed(lines: SomeLines, *, closely: bool = False) -> SomeLines:
    """The lines padded, their arrays by NumPy: see the module.

    The first lines and frames are those given; `of_lines` and `of_frames` cut results to them.

    Args:
        lines: the lines.
        closely: whether to pad to the next power of two, for work in which each row costs.
    """
    if not _paddable(lines):
        return lines
    number = lines.frame.shape[0]
    if closely:
        number = max(_LINES[0], 1 << (number - 1).bit_length())
    elif _are_many(lines):
        number = bucket(number, _LINES[:1])
    else:
        number = bucket(number, _LINES_ONCE if used_once() else _LINES)
    return _padded(lines, number, bucket(lines.focal.shape[0], _FRAMES))


class Frames(NamedTuple):
    """The lines of each frame, as `AbstractLines.by_frame` gives them, and which frames are no padding."""

    chosen: Int[AnyArray, "frame some"]
    present: Bool[AnyArray, "frame some"]
    there: Bool[AnyArray, "frame"]


def bucketed_frames(lines: SomeLines) -> tuple[SomeLines, Frames]:
    """The lines padded, and the lines of each frame; those of the last frame again for padding."""
    padded, (chosen, present) = bucketed(lines), lines.by_frame()
    there = np.arange(padded.focal.shape[0]) < lines.focal.shape[0]
    if padded is not lines:
        some = bucket(chosen.shape[1], _IN_FRAME)
        of_frames = (_with_zeros(array, len(chosen), some) for array in (chosen, present))
        chosen, present = (padded_to(array, len(there)) for array in of_frames)
    return padded, Frames(chosen, present, there)


def padded_frames(values: Any) -> np.ndarray:
    """What there is of each frame, padded as the frames of lines are."""
    return padded_to(values, bucket(len(values), _FRAMES))


def padded_to(values: Any, size: int, axis: int = 0) -> np.ndarray:
    """An array whose last element along an axis is repeated up to a size."""
    array = np.asarray(values)
    missing = size - array.shape[axis]
    if missing <= 0:
        return array
    last = np.repeat(np.take(array, [-1], axis), missing, axis)
    return np.concatenate([array, last], axis)


def of_lines(values: Any, lines: AbstractLines) -> Any:
    """Values of padded lines, cut to the lines there are; axis 0."""
    return _cut(values, lines.frame.shape[0])


def of_frames(values: Any, lines: AbstractLines) -> Any:
    """Values of padded frames, cut to the frames there are; axis 0."""
    return _cut(values, lines.focal.shape[0])


def bucketed_jit(
    *, frames: Sequence[str] = (), returns: Cut | Sequence[Cut] = None, light: bool = True
) -> Callable[[Callable[_Given, _Result]], Callable[_Given, _Result]]:
    """As `program` of a function whose first argument are lines, which arrive padded.

    Args:
        frames: names of other arguments that hold a row for each frame.
        returns: `of_lines`, `of_frames` or None, where nothing is to be cut: for the result, or for each of
            several.
        light: whether the work is small for small arguments.
    """

    def decorate(function: Callable[_Given, _Result]) -> Callable[_Given, _Result]:
        compiled, signature = program(function, light=light), inspect.signature(function)

        @functools.wraps(function)
        def call(*args: _Given.args, **kwargs: _Given.kwargs) -> _Result:
            given: dict[str, Any] = signature.bind(*args, **kwargs).arguments
            first, lines = next(iter(given.items()))
            by_frame = {name: given[name] for name in frames if given[name] is not None}
            if traced(by_frame) or (padded := bucketed(lines)) is lines:
                return compiled(*args, **kwargs)
            if any(np.shape(of)[:1] != lines.focal.shape for of in by_frame.values()):
                return compiled(*args, **kwargs)  # it says so; padding would make it look right
            given |= {name: padded_to(of, len(padded.focal)) for name, of in by_frame.items()}
            found: Any = compiled(**given | {first: padded})  # pyright: ignore[reportCallIssue]
            if returns is None or callable(returns):
                return found if returns is None else returns(found, lines)
            cut = (part if of is None else of(part, lines) for part, of in zip(found, returns, strict=True))
            return tuple(cut)  # pyright: ignore[reportReturnType]

        return call

    return decorate


def _are_many(lines):
    """Whether lines hold so many points that to pad them by much would take time."""
    points = getattr(lines, "points", None)
    inside = getattr(lines, "lines", None)
    return points.size > _MANY if points is not None else inside is not None and _are_many(inside)


def _paddable(lines):
    """Whether all arrays are known, on this machine's processor, and of moderate size."""
    known = (*_OF_LINES, *_OF_FRAMES, *_OTHER)
    for field in dataclasses.fields(lines):
        value = getattr(lines, field.name)
        if isinstance(value, AbstractLines):
            if not _paddable(value):
                return False
        elif not field.metadata.get("static", False):
            arrays = [leaf for leaf in jax.tree.leaves(value) if eqx.is_array_like(leaf)]
            if arrays and (field.name not in known or not all(map(is_here, arrays))):
                return False
    return True


def is_here(array: Any) -> bool:
    """Whether an array is known, on one processor, and of moderate size."""
    if isinstance(array, np.ndarray):
        return array.size <= _MOST
    return (
        isinstance(array, jax.Array)
        and not traced(array)
        and array.size <= _MOST
        and [device.platform for device in array.devices()] == ["cpu"]
    )


def _padded(lines, number, frames):
    """The lines with so many lines and frames."""
    new: dict[str, Any] = {}
    for field in dataclasses.fields(lines):
        name: str = field.name
        value: Any = getattr(lines, name)
        if isinstance(value, AbstractLines):
            new[name] = _padded(value, number, frames)
        elif name == "number" or (value is None and name != "weight"):
            new[name] = None
        elif name == "weight":
            dtype = np.asarray(lines.focal).dtype
            new[name] = _with_zeros(np.ones(lines.frame.shape, dtype) if value is None else value, number)
        elif value is not None and name in ("points", "mask"):
            points = bucket(value.shape[1], _POINTS)
            new[name] = _with_zeros(value, number, points)
        elif name in _OF_LINES:
            new[name] = _with_zeros(value, number)
        elif name in _OF_FRAMES:
            new[name] = padded_to(value, frames)
    names = list(new)
    return eqx.tree_at(
        lambda lines: [getattr(lines, name) for name in names],
        lines,
        [new[name] for name in names],
        is_leaf=lambda leaf: leaf is None,
    )


def _with_zeros(values, *shape):
    """An array with zeros after its elements along the first axes, up to a shape."""
    array = np.asarray(values)
    wanted = (*shape, *array.shape[len(shape) :])
    if wanted == array.shape:
        return array
    padded = np.zeros(wanted, array.dtype)
    padded[tuple(map(slice, array.shape))] = array
    return padded


def _cut(values, number):
    if values.shape[0] == number:
        return values
    if traced(values):
        return values[:number]
    return jax.device_put(np.asarray(values)[:number])  # without a program, as jnp.asarray would compile
