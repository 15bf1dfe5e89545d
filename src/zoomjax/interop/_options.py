"""Checks of the arguments of `write` and `read`, before a file is looked at."""

import dataclasses
import math
import warnings
from collections import Counter
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .._core.checks import real_numbers, warn_caller
from .._core.text import listed
from ..io.focal_track import FocalTrack
from ..models.about import RELATIVE, WIDTH_OF_FOCALS
from ..models.brown_conrady import BrownConrady
from ..models.distortion_model import AbstractDistortionModel, checked_terms
from ..models.division import Division
from ..models.lens import ZoomLens
from ..models.polynomial import RadialPolynomial
from .base import Format
from .stmap import CONVENTIONS, DIRECTIONS

_DISTORTION_MODELS = (RadialPolynomial, Division, BrownConrady)
"""Distortion models of lenses that are read."""

_CHOICES = {"convention": tuple(CONVENTIONS), "direction": DIRECTIONS, "focal_unit": ("mm", "px")}
"""What some arguments may be."""

_DIGITS = 9
"""Of focal lengths in files: those that agree so far are one."""


def check_options(fmt: Format, given: dict[str, Any]) -> None:
    """Raise ValueError where an option was given that the format does not use, or one that is wrong."""
    for name, value in given.items():
        if value is None:
            continue
        if name not in fmt.options and name != "focal_unit":  # which goes with focal
            raise ValueError(f"Argument {name} has no effect on the format {fmt.name}: leave it out.")
        if name in _CHOICES and value not in _CHOICES[name]:
            raise ValueError(
                f"Argument {name} must be one of {', '.join(_CHOICES[name])}, but it is {value!r}."
            )


def check_name(fmt: Format, path: Path, *, several: bool, known: Collection[str]) -> None:
    """Raise ValueError where a folder is named as a file of the format, or a file as one of another format.

    Args:
        fmt: the format.
        path: the name.
        several: whether it is of a folder.
        known: suffixes of all formats.
    """
    suffix = path.suffix.lower()
    if several and suffix in fmt.suffixes:
        raise ValueError(
            f"The format {fmt.name} is several files here, and {path} is to be their folder: give a name "
            f"without {path.suffix}."
        )
    if not several and suffix in known and suffix not in fmt.suffixes:
        raise ValueError(
            f"The format {fmt.name} is no {suffix} file, and as {path} nothing would recognise it: give a "
            f"name that ends in {fmt.suffixes[0]}."
        )


def warn_of_relative(lens: ZoomLens) -> None:
    """Warn of a lens of whose focal lengths only the ratios are known."""
    if lens.about.get("focal") == RELATIVE:
        warnings.warn(
            "The focal lengths of this lens are relative: only their ratios are known, and so are those of "
            "what is written. Calibrate again with a known focal length if their scale matters.",
            stacklevel=4,
        )


def labelled(lens: ZoomLens, focal: Any) -> ZoomLens:
    """A lens whose focal length nobody knew, with the one that is told now."""
    told = () if focal is None else positives("focal", focal)
    if len(told) != 1:
        raise ValueError(
            "Argument focal must be given, the one focal length of the lens: its photo did not have it."
        )
    about = {name: fact for name, fact in lens.about.items() if name not in ("focal", WIDTH_OF_FOCALS)}
    return dataclasses.replace(lens, focal_range=np.full(2, told[0]), about=about)


_SAME_PITCH = 0.01
"""Share by which widths of a pixel may differ and count as one: they are written with a few digits."""


def pitch_of(lens: ZoomLens, given: Any) -> float | None:
    """The width of a pixel that is given, mm, or the lens's own; a contradiction is told."""
    if given is None:
        return lens.pixel_pitch
    pitch, own = positive("pixel_pitch", given), lens.pixel_pitch
    if own is not None and max(pitch, own) > (1 + _SAME_PITCH) * min(pitch, own):
        warn_caller(
            f"The pixel pitch of this lens is {own:.4g} mm, and {pitch:.4g} mm is given: leave argument "
            "pixel_pitch out if the lens is right."
        )
    return pitch


def positive(name: str, value: Any) -> float:
    """A positive number."""
    number = float(value) if real_numbers(value) is not None and np.ndim(value) == 0 else math.nan
    if not (math.isfinite(number) and number > 0):
        raise ValueError(f"Argument {name} must be a positive number, but it is {value!r}.")
    return number


def check_model(terms: Any, distortion_model: Any) -> None:
    """Raise ValueError where a lens that is read cannot be of this distortion model."""
    if terms is not None:
        checked_terms(terms, AbstractDistortionModel.most_terms)
    if distortion_model is not None and not isinstance(distortion_model, _DISTORTION_MODELS):
        names = ", ".join(f"{kind.__name__}()" for kind in _DISTORTION_MODELS)
        raise ValueError(
            f"Argument distortion_model must be one of {names}, but it is {distortion_model!r}."
        )


def positives(name: str, values: Any) -> tuple[float, ...]:
    """One positive number or several."""
    numbers = real_numbers(values)
    found = np.zeros(0) if numbers is None else np.atleast_1d(numbers)
    if found.ndim != 1 or not (np.isfinite(found) & (found > 0)).all() or not found.size:
        raise ValueError(f"Argument {name} must hold positive numbers, but it is {values!r}.")
    return tuple(found.tolist())


def check_order(files: Sequence[Path], focal: Sequence[float] | None) -> None:
    """Raise ValueError where files are named by the focal lengths that are given, in another order."""
    try:
        named = [float(file.stem) for file in files]
    except ValueError:
        return
    if focal is not None and named != list(focal) and sorted(named) == sorted(focal):
        raise ValueError(
            "Argument focal must be in the order of the files, which their names say, "
            f"{listed((f'{value:g}' for value in named), 4)}, but it is {list(focal)}."
        )


def focal_lengths(
    fmt: Format, lens: ZoomLens, focal: Any, track: FocalTrack | None
) -> tuple[tuple[float, ...] | None, tuple[int, ...] | None]:
    """The focal lengths to write and their frames, each None where it is the format's to choose."""
    if track is not None:
        return _tracked(fmt, track, focal)
    if focal is None:
        low, high = np.asarray(lens.focal_range, float).tolist()
        if fmt.zoom == "interpolated":
            return None, None
        if low == high:
            return (low,), None
        raise ValueError(
            "Argument focal must be given, one focal length or several, or a track with one for each "
            f"frame: the format {fmt.name} does not interpolate between them."
        )
    values = positives("focal", focal)
    if fmt.zoom == "list":
        return values, None
    most, times = Counter(f"{value:.{_DIGITS}g}" for value in values).most_common(1)[0]
    if times > 1:
        raise ValueError(
            f"Argument focal must hold each focal length once for the format {fmt.name}, but {most} is "
            f"there {times} times."
        )
    return (tuple(sorted(values)) if fmt.zoom == "interpolated" else values), None


def _tracked(fmt: Format, track: FocalTrack, focal: Any) -> tuple[tuple[float, ...], tuple[int, ...]]:
    if focal is not None:
        raise ValueError("Argument track must be left out where argument focal is given: give one of them.")
    if fmt.zoom == "interpolated":
        raise ValueError(
            f"Argument track must be left out: the format {fmt.name} goes by the focal length, not by "
            "frames."
        )
    if track.by_time:
        raise ValueError("Argument track must be in frames (columns frame,focal), but it is in seconds.")
    first, last = math.ceil(track.position[0]), math.floor(track.position[-1])
    frames = range(first, last + 1)
    if not frames:
        raise ValueError(
            f"Argument track must reach over a whole frame, but it is from {track.position[0]:g} to "
            f"{track.position[-1]:g}."
        )
    return tuple(track.at(frame, math.nan) for frame in frames), tuple(frames)
