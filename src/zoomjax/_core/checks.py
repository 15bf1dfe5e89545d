"""Checks of input, in one place: each returns the value in its plain form, or raises an error."""

import inspect
import math
import operator
import warnings
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .arrays import mixes_booleans, numeric
from .fields import refuse_masked

MOST_TERMS = 64
"""Coefficients of a polynomial in r^2 beyond which its powers are rounding, and its triangles memory."""


def checked_integer(name: str, value: Any, least: int, most: int | None = None) -> int:
    """An integer of at least `least`, and perhaps at most another, NumPy's kinds included, as Python's."""
    try:
        number = None if isinstance(value, bool) else operator.index(value)
    except TypeError:
        number = None
    if number is None or number < least:
        raise ValueError(f"Argument {name} must be an integer of at least {least}, but it is {value!r}.")
    if most is not None and number > most:
        raise ValueError(f"Argument {name} must be at most {most}, but it is {value!r}.")
    return number


def check_above(limit: float | int, **values: Any) -> None:
    """Each value a finite number above the limit, which is excluded."""
    for name, value in values.items():
        if not (_is_finite(value) and value > limit):
            raise ValueError(
                f"Argument {name} must be a finite number above {limit:g}, but it is {value!r}."
            )


def check_between(low: float | int, high: float | int, **values: Any) -> None:
    """Each value a finite number from low to high, which are included."""
    for name, value in values.items():
        if not (_is_finite(value) and low <= value <= high):
            most = f" to {high:g}" if high < math.inf else " or more"
            raise ValueError(
                f"Argument {name} must be a finite number of {low:g}{most}, but it is {value!r}."
            )


def _is_finite(value: Any) -> bool:
    try:
        return not isinstance(value, str | bytes | bool | np.bool_) and math.isfinite(value)
    except TypeError:
        return False


LARGEST = 2**31
"""px: from here on no format has images, and no array indices."""


def checked_size(size: Any, name: str = "image_size") -> tuple[int, int]:
    """(width, height) px."""
    try:
        if isinstance(size, str | bytes | bytearray):
            raise TypeError
        width, height = (math.nan if isinstance(side, str | bytes | bool) else float(side) for side in size)
    except (OverflowError, TypeError, ValueError):
        width = height = math.nan
    if not all(math.isfinite(side) and side == int(side) and side >= 1 for side in (width, height)):
        raise ValueError(f"Argument {name} must be two positive integers (w, h), but it is {size!r}.")
    if max(width, height) >= LARGEST:
        raise ValueError(f"Argument {name} must be below 2^31 px, as of any image, but it is {size!r}.")
    return int(width), int(height)


def checked_unit(focal_unit: Any) -> str:
    """The unit of focal lengths."""
    if focal_unit not in ("mm", "px"):
        raise ValueError(f'Argument focal_unit must be "mm" or "px", but it is {focal_unit!r}.')
    return str(focal_unit)


def checked_centre(centre: Any, size: tuple[int, int]) -> np.ndarray:
    """The centre of distortion, px; that of the image if None."""
    if centre is None:
        return (np.array(size) - 1) / 2
    middle = real_numbers(centre)
    if middle is None or middle.shape != (2,) or not np.isfinite(middle).all():
        raise ValueError(f"Argument centre must be two finite numbers, but it is {centre!r}.")
    if np.abs(middle).max() >= LARGEST:
        raise ValueError(f"Argument centre must be in px, below 2^31, but it is {centre!r}.")
    return middle


def checked_points(line: ArrayLike, index: int) -> np.ndarray:
    """The points of one line, (n, 2), in their dtype if it is float32 or float64."""
    array = real_numbers(line)
    if array is not None and array.size == 0:
        return np.zeros((0, 2), np.float32)
    if array is None or array.ndim != 2 or array.shape[1] != 2:
        refuse_masked(f"points[{index}]", line)
        what = np.asarray(line) if array is None else array
        raise ValueError(
            f"Argument points must hold (n, 2) arrays of real numbers, but line {index} has shape "
            f"{what.shape} and dtype {what.dtype}."
        )
    if not np.isfinite(array).all():
        bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
        raise ValueError(
            f"Argument points must be finite, but line {index} has {bad.size} NaN or infinite points "
            f"(the first at position {bad[0]}). Remove them."
        )
    return array


def checked_focal(focal: ArrayLike) -> np.ndarray:
    """The focal length of each frame, float64."""
    focals = real_numbers(focal)
    if focals is None or focals.ndim != 1 or not focals.size:
        raise ValueError(f"Argument focal must be a sequence with one number a frame, but it is {focal!r}.")
    good = np.isfinite(focals) & (focals > 0)
    if not good.all():
        bad = int(np.argmin(good))
        raise ValueError(
            f"Argument focal must hold finite positive numbers, but focal[{bad}] is {focals[bad]}."
        )
    return focals.astype(np.float64)


def checked_focus(focus: ArrayLike, frames: int) -> np.ndarray:
    """The focus of each frame, float64."""
    values = real_numbers(focus)
    if values is None or values.shape != (frames,) or not np.isfinite(values).all():
        raise ValueError(
            f"Argument focus must hold one finite number for each of the {frames} frames, but it is "
            f"{focus!r}."
        )
    return values.astype(np.float64)


def checked_frames(frame: ArrayLike, lines: int, frames: int) -> np.ndarray:
    """For each of the lines the index of its frame."""
    refuse_masked("frame", frame)
    index = np.asarray(frame)
    if lines == 0:
        raise ValueError("No usable line: argument points is empty.")
    if index.shape != (lines,) or not np.issubdtype(index.dtype, np.integer):
        raise ValueError(
            f"Argument frame must hold one integer for each of the {lines} lines, but its shape is "
            f"{index.shape} and its dtype {index.dtype}."
        )
    outside = (index < 0) | (index >= frames)
    if outside.any():
        bad = int(np.argmax(outside))
        raise ValueError(
            f"Argument frame must hold indices from 0 to {frames - 1}, one focal length each, but "
            f"frame[{bad}] is {index[bad]}."
        )
    return index


def usable_lines(arrays: list[np.ndarray], frames: np.ndarray, number_of_frames: int) -> np.ndarray:
    """Positions of the lines with 3 or more distinct points, of which every frame must have one."""
    usable = np.array([has_three_distinct(line) for line in arrays], bool)
    if not usable.any():
        raise ValueError(f"No usable line: none of the {len(arrays)} lines has 3 or more distinct points.")
    if not usable.all():
        warnings.warn(
            f"Dropped {np.sum(~usable)} of {len(arrays)} lines: they have fewer than 3 distinct "
            "points, which says nothing about straightness.",
            stacklevel=3,
        )
    empty = np.setdiff1d(np.arange(number_of_frames), frames[usable])
    if empty.size:
        raise ValueError(
            f"No line in {empty.size} of {number_of_frames} frames (the first are "
            f"{', '.join(map(str, empty[:5]))}). Leave those frames out of frame and focal."
        )
    return np.flatnonzero(usable)


def points_beyond(
    points: np.ndarray, mask: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """By how many px points are outside of the image, and which by more than noise takes them."""
    beyond = np.max(
        np.maximum(-points, points - (np.array(size) - 1)), axis=-1, where=mask[..., None], initial=0
    )
    return beyond, beyond > 0.01 * max(size)  # noise alone takes a few points some px out


def warn_of_points_outside(points: np.ndarray, mask: np.ndarray, size: tuple[int, int]) -> None:
    """Points far outside of the image mean a wrong image size, and with it a wrong centre and scale."""
    beyond, outside = points_beyond(points, mask, size)
    if outside.any():
        warnings.warn(
            f"{np.sum(outside):,} of {np.sum(mask):,} points lie outside of the image of {size[0]} x "
            f"{size[1]} px, by up to {np.max(beyond):.3g} px. Is image_size (width, height) right?",
            stacklevel=3,
        )


def centre_problem(centre: np.ndarray, size: tuple[int, int]) -> str | None:
    """That a centre of distortion, px, is outside of the image, which mostly is a mistake; None if not."""
    if not ((centre < -0.5) | (centre > np.array(size) - 0.5)).any():
        return None
    return (
        f"The centre of distortion, ({centre[0]:g}, {centre[1]:g}) px, is outside of the image of "
        f"{size[0]} x {size[1]} px. That is right for a crop of a larger image alone."
    )


def warn_of_units(points: np.ndarray, mask: np.ndarray, size: tuple[int, int]) -> None:
    """Lines that all lie within two px mean that coordinates are in units of the image's size."""
    across, down = np.ptp(points[mask], axis=0) if mask.any() else (np.inf, np.inf)
    if max(across, down) <= 2 < 0.1 * min(size):
        warnings.warn(
            f"All points lie within {across:.3g} x {down:.3g} px of an image of {size[0]} x {size[1]} px. "
            "Coordinates are pixels, from 0 in the middle of the first: are these in units of its size?",
            stacklevel=3,
        )


def has_three_distinct(line: np.ndarray) -> bool:
    """Whether points, (n, 2), are at three places or more."""
    if len(line) < 3:
        return False
    from_first = (line != line[0]).any(axis=1)
    if not from_first.any():
        return False
    second = line[np.argmax(from_first)]
    return bool((from_first & (line != second).any(axis=1)).any())


def real_numbers(values: Any) -> np.ndarray | None:
    """Real numbers as an array, half precision widened; None if they are something else, or masked."""
    if isinstance(values, np.ma.MaskedArray) or mixes_booleans(values):
        return None
    try:
        array = np.asarray(values)
    except ValueError:  # rows of different lengths
        return None
    if np.issubdtype(array.dtype, np.floating):
        return array.astype(np.float32) if array.dtype.itemsize < 4 else numeric(array)
    if array.dtype.kind in "iu":  # not spans of time, which are integers to NumPy
        return array.astype(np.float64)
    return array.astype(np.float64) if array.size == 0 else None


def warn_caller(message: str) -> None:
    """A warning that names the line that called this package, by whichever of its functions."""
    level, frame = 1, inspect.currentframe()
    while frame is not None and frame.f_globals.get("__name__", "").split(".")[0] in _INNER:
        level, frame = level + 1, frame.f_back
    warnings.warn(message, stacklevel=level)


_INNER = (__name__.split(".")[0], "contextlib", "functools", "jaxtyping", "beartype", "equinox")
"""Where frames between a caller and a warning are from: the package, and what wraps its functions."""
