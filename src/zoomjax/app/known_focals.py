"""Focal lengths of some frames of a clip that are known before its motion is measured."""

import dataclasses
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ..detect.batch import Detection
from ..io.text_table import plain_number, read_text_table
from .clip_lines import frame_number
from .focal_sources import choose_focals, focal_sigmas
from .relative import is_relative_track

USUAL_STD = 0.01
"""Relative standard deviation of a known focal length where none is given: that of the rings of lenses."""

MEASURED = {"plane": "grid", "pitch": "pitch"}
"""What the frames themselves tell f by, and the detector that finds it."""

_ONE = re.compile(r"\s*([^@]*?)\s*@\s*([0-9]{1,9})\s*")


@dataclasses.dataclass(frozen=True)
class KnownFocals:
    """Focal lengths that are known.

    Attributes:
        frame: the number of each one's frame in the file, from 0, increasing.
        focal, std: the focal lengths and their standard deviations, px.
    """

    frame: Int[np.ndarray, "known"]
    focal: Float[np.ndarray, "known"]
    std: Float[np.ndarray, "known"]

    def of_frames(
        self, numbers: Float[np.ndarray, "frame"]
    ) -> tuple[Float[np.ndarray, "frame"], Float[np.ndarray, "frame"]]:
        """Focal lengths and standard deviations of the frames of these numbers, as `fit_motion` takes them.

        Raises:
            ValueError: one is known of a frame that is not there.
        """
        place = np.minimum(np.searchsorted(numbers, self.frame), len(numbers) - 1)
        missing = self.frame[numbers[place] != self.frame]
        if len(missing):
            raise ValueError(
                f"--known-focal is of frame {missing[0]}, which the clip does not have or which cannot be "
                f"decoded: its frames are {numbers[0]:.0f} to {numbers[-1]:.0f}."
            )
        focal, std = np.full(len(numbers), np.nan), np.full(len(numbers), np.inf)
        focal[place], std[place] = self.focal, self.std
        return focal, std

    def rows(self) -> list[dict[str, Any]]:
        """Each frame with what is known of it, for JSON."""
        return [
            {"frame": frame, "focal": focal, "sigma": std}
            for frame, focal, std in zip(
                self.frame.tolist(), self.focal.tolist(), self.std.tolist(), strict=True
            )
        ]


def measured_focals(found: Sequence[Detection], source: str) -> KnownFocals:
    """Focal lengths of frames of a clip from a flat board that they show, or the markings of a pitch.

    Frames have errors in common, as those of the correction, which is not known yet: focal lengths of a
    simulated pitch are off by up to 3 %, where the points' noise explains 0.3 %, and by 0.6 % in the mean.
    So each has a deviation of `USUAL_STD` more, and all of them count as one: times the square root of
    their number.

    Args:
        found: in frames by `video_frames`.
        source: one of `MEASURED`.

    Raises:
        ValueError: no frame tells its focal length.
    """
    try:
        told = choose_focals([detection for detection in found if detection.lines], source)
    except ValueError as error:
        raise ValueError(
            f"No frame tells its focal length by the {source}: leave --known-focal {source} out, or give "
            "one that you know, such as --known-focal 24@0."
        ) from error
    numbers = np.array([frame_number(name) for name in told.focal])
    focal, std = (np.array([of[name] for name in told.focal]) for of in (told.focal, told.deviation))
    order = np.argsort(numbers)
    std = np.sqrt(len(focal)) * np.hypot(std, USUAL_STD * focal)
    return KnownFocals(numbers[order], focal[order], std[order])


def known_focals(
    given: Sequence[str], *, unit: str | None = None, sigma: str | None = None, pitch: float | None = None
) -> KnownFocals:
    """Focal lengths from the words of the option.

    Args:
        given: each one a focal length and its frame, ``24@0``, or a CSV file ``frame,focal[,sigma]``.
        unit: of all of them, "mm" or "px"; by default mm.
        sigma: their standard deviation, in their unit or as a percentage; by default that of the file, or
            else `USUAL_STD`.
        pitch: the distance between pixels on the sensor, mm, which those in mm need.

    Raises:
        OSError: a file cannot be read.
        ValueError: one is none, or a frame is given twice, or the options do not go together.
    """
    scale = _px_per_unit(unit or "mm", pitch)
    parts = [_of_file(text) if text.lower().endswith(".csv") else _of_word(text) for text in given]
    frame, focal, std = (np.concatenate(of) for of in zip(*parts, strict=True))
    if sigma is not None:
        std = focal_sigmas(sigma, focal)
        if not (std > 0).all():
            raise ValueError(f"--focal-sigma of known focal lengths must be above 0, but it is {sigma}.")
    std = np.where(np.isnan(std), USUAL_STD * focal, std)
    order = np.argsort(frame, kind="stable")
    frame = frame[order]
    again = frame[1:][frame[1:] == frame[:-1]]
    if len(again):
        raise ValueError(f"--known-focal is given twice for frame {again[0]}: give it once.")
    return KnownFocals(frame, scale * focal[order], scale * std[order])


def _px_per_unit(unit: str, pitch: float | None) -> float:
    """How many px one of the unit is."""
    if unit == "px":
        if pitch is not None:
            raise ValueError("--pixel-pitch has no effect with --focal-unit px: leave it out.")
        return 1.0
    if pitch is None:
        raise ValueError(
            "--known-focal is in mm, and motion tells focal lengths in px: give --pixel-pitch, the "
            "distance between pixels on the sensor in mm, or focal lengths in px and --focal-unit px."
        )
    if not (np.isfinite(pitch) and pitch > 0):
        raise ValueError(f"--pixel-pitch must be a positive number of mm, but it is {pitch:g}.")
    return 1 / pitch


def _of_word(text: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    found = _ONE.fullmatch(text)
    focal = plain_number(found[1]) if found else None
    if found is None or focal is None:
        raise ValueError(
            f"--known-focal is {text!r}. Give a focal length and the number of its frame, from 0, such as "
            "24@0; a CSV file with the columns frame,focal or frame,focal,sigma; or plane or pitch."
        )
    if focal <= 0:
        raise ValueError(f"--known-focal must be a positive focal length, but it is {text}.")
    return np.array([int(found[2])]), np.array([focal]), np.array([np.nan])


def _of_file(path: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    if is_relative_track(path):
        raise ValueError(
            f"The focal lengths of {path} are relative: only their ratios are known, and --known-focal "
            "needs one that is measured."
        )
    table = read_text_table(
        path, "known focal lengths", numbers=("frame", "focal"), optional=("sigma",), gaps=("sigma",)
    )
    frame, focal = table.integers("frame"), table.numbers["focal"]
    std = table.numbers.get("sigma", np.full(len(focal), np.nan))
    table.check("frame", frame >= 0, "a number from 0")
    table.check("focal", focal > 0, "a positive number")
    if "sigma" in table.numbers:
        table.check("sigma", ~(std <= 0), "a positive number")
    return frame, focal, std
