"""Concatenation of data sets: frames of one camera as one set of lines."""

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeVar

import jax.numpy as jnp
import numpy as np

from .._core.arguments import check_kind
from .._core.types import AnyArray, traced
from ..lines.base import AbstractLines
from ..lines.compressed import CompressedLines
from ..lines.free_centre import AnyCentreLines
from ..lines.lines import Lines
from .problem import Problem, data_of, posed

SomeLines = TypeVar("SomeLines", bound=AbstractLines)


def concatenate(parts: Sequence[SomeLines]) -> SomeLines:
    """Concatenate lines of different frames. Frames of each part are numbered after those before.

    So frames can be compressed one by one, as they arrive or on several machines, and then fitted together:
    the fit is that of all lines at once. In contrast, `merge` adds *points* to the same lines of the same
    frames.

    Args:
        parts: one or more, all `Lines` or all compressed in the same way, of one camera: with the same
            image size, unit of focal lengths, centre of distortion and distortion model.

    Returns:
        One set of the same kind. The lines' `number`, their position in one list, is no longer known.

    Raises:
        TypeError: the parts are of different kinds.
        ValueError: there are no parts, or they differ in one of these properties or in the number of terms
            they were compressed for, or only some of them have a focus.

    Example:
        >>> import numpy as np
        >>> from zoomjax import compress
        >>> row = np.stack([np.arange(500.0), np.full(500, 20.0)], axis=-1)
        >>> small = [
        ...     compress(Lines.from_ragged([row, row + 1], [0, 0], [f], image_size=(640, 480)))
        ...     for f in (24, 70)
        ... ]
        >>> both = concatenate(small)
        >>> both.frame.tolist(), both.focal.tolist()
        ([0, 0, 1, 1], [24.0, 70.0])
    """
    if isinstance(parts, AbstractLines) or not isinstance(parts, Sequence):
        raise TypeError(
            "Argument parts must be a list of lines, [first, second], but its type is "
            f"{type(parts).__name__}."
        )
    if not parts:
        raise ValueError("Argument parts must hold one or more sets of lines, but it is empty.")
    for index, part in enumerate(parts):
        check_kind(f"parts[{index}]", part, (AbstractLines,))
    first: Any = parts[0]
    for index, part in enumerate(parts[1:], 1):
        if type(part) is not type(first):
            raise TypeError(
                f"Argument parts must hold one kind of lines, but parts[0] are {type(first).__name__} and "
                f"parts[{index}] {type(part).__name__}. Compress all of them, or none."
            )
        _check_same(first, part, index)
    if isinstance(first, Problem):
        return posed(concatenate(list(map(data_of, parts))), first.distortion_model, first.metric)  # pyright: ignore
    if not isinstance(first, Lines | CompressedLines | AnyCentreLines):
        raise TypeError(f"Lines of type {type(first).__name__} cannot be concatenated.")
    given: list[Any] = list(parts)
    starts = np.cumsum([0] + [part.focal.shape[0] for part in given[:-1]])
    own: dict[str, Any] = {}
    if isinstance(first, Lines):
        longest = max(part.mask.shape[1] for part in given)
        own["points"] = _joined([_padded(part.points, longest) for part in given])
        own["mask"] = _joined([_padded(part.mask, longest) for part in given])
    else:
        own["triangle"] = _joined([part.triangle for part in given])
    whole: Any = dataclasses.replace(
        first,
        **own,
        frame=_joined([part.frame + start for part, start in zip(given, starts, strict=True)]),
        focal=_joined([part.focal for part in given]),
        focus=None if first.focus is None else _joined([part.focus for part in given]),
        weight=None if all(part.weight is None for part in given) else _joined(map(_weight, given)),
        number=None,
    )
    return whole


def _check_same(first: AbstractLines, other: AbstractLines, index: int) -> None:
    """Refuse a part that is not of the first one's camera and kind."""
    facts = {
        "image size": (first.image_size, other.image_size),
        "unit of focal lengths": (first.focal_unit, other.focal_unit),
        "distortion model": (type(first.distortion_model).__name__, type(other.distortion_model).__name__),
        "number of terms": (getattr(first, "terms", None), getattr(other, "terms", None)),
        "kind of lines within": (_inner(first), _inner(other)),
        "focus": tuple("None" if lines.focus is None else "given" for lines in (first, other)),
    }
    if not traced((first.centre, other.centre)):
        facts["centre of distortion"] = (
            tuple(np.asarray(first.centre).tolist()),
            tuple(np.asarray(other.centre).tolist()),
        )
    for what, (one, two) in facts.items():
        if one != two:
            raise ValueError(
                f"Argument parts must hold lines of one camera, but the {what} of parts[0] is {one}, and "
                f"that of parts[{index}] is {two}."
            )


def _inner(lines: AbstractLines) -> str:
    return type(getattr(lines, "lines", lines)).__name__


def _weight(lines: AbstractLines) -> AnyArray:
    if lines.weight is not None:
        return lines.weight
    return jnp.ones(lines.frame.shape, jnp.asarray(lines.focal).dtype)


def _padded(array: AnyArray, longest: int) -> AnyArray:
    """With room for as many points in each line."""
    more = [(0, 0), (0, longest - array.shape[1]), *[(0, 0)] * (array.ndim - 2)]
    return np.pad(array, more) if isinstance(array, np.ndarray) else jnp.pad(array, more)


def _joined(arrays: Any) -> AnyArray:
    """One after the other; NumPy's stay so, for JAX may not hold their dtype."""
    arrays = list(arrays)
    if all(isinstance(array, np.ndarray) for array in arrays):
        return np.concatenate(arrays)
    return jnp.concatenate([jnp.asarray(array) for array in arrays])
