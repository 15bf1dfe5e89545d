"""Straight lines in frames of a clip that were fitted with its tracks: their frames, drawn."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..detect.batch import Detection
from ..io.video_reader import decode_video
from ..lines.lines import Lines
from .coefficients import finite
from .drawings import write_overlay
from .image_job import overlay_name

MOST = {"some": 200, "all": None, "none": 0}
"""Frames that are drawn, by the words of the option."""


def with_lines(found: Sequence[Detection]) -> list[Detection]:
    """Those that have lines."""
    return [detection for detection in found if detection.lines]


def lines_of_frames(
    found: Sequence[Detection], numbers: np.ndarray
) -> tuple[Lines, np.ndarray] | tuple[None, None]:
    """All lines, each f 1, and the places of their frames among those of these numbers in the file."""
    seen = with_lines(found)
    if not seen:
        return None, None
    lines = Lines.from_ragged(
        [line for detection in seen for line in detection.lines],
        np.repeat(np.arange(len(seen)), [len(detection.lines) for detection in seen]),
        np.ones(len(seen)),
        image_size=seen[0].image_size,
        focal_unit="px",
    )
    return lines, frames_with_lines(found, numbers)


def frames_with_lines(found: Sequence[Detection], numbers: np.ndarray) -> np.ndarray:
    """The place of each frame that has lines among the frames of these numbers in the file."""
    return np.searchsorted(numbers, [frame_number(detection.name) for detection in with_lines(found)])


def frame_number(name: str) -> int:
    """The number in the file of a frame with a name by `video_frames`."""
    return int(Path(name).stem.rpartition("-")[2])


def members(lines: Lines) -> list[np.ndarray]:
    """Of each frame the numbers of its lines."""
    return [np.flatnonzero(np.asarray(lines.frame) == frame) for frame in range(len(lines.focal))]


def image_rows(
    found: Sequence[Detection], lines: Lines, sigma: np.ndarray, rejected: np.ndarray
) -> list[dict[str, Any]]:
    """Each frame that has lines, for summary.json."""
    return [
        {
            "name": detection.name,
            "focal": float(focal),
            "focal_sigma": finite([std])[0],
            "lines": len(own),
            "rejected": int(rejected[own].sum()),
        }
        for detection, focal, std, own in zip(
            with_lines(found), np.asarray(lines.focal), sigma, members(lines), strict=True
        )
    ]


def draw_frames(
    clip: Path,
    found: Sequence[Detection],
    lines: Lines,
    rms: np.ndarray,
    rejected: np.ndarray,
    folder: Path,
    *,
    most: int | None = None,
) -> None:
    """Draw frames with their lines, as photos are, into a new folder: so many, evenly over the clip.

    Args:
        clip: the clip.
        found: what was found in its frames.
        lines: their lines, with points and frames in the same order.
        rms: of each line, px.
        rejected: whether each one does not count.
        folder: where to write the pictures.
        most: how many at most; None for all.
    """
    own = dict(zip((detection.name for detection in with_lines(found)), members(lines), strict=True))
    names = list(own)
    if most is not None and len(names) > most:
        names = [names[place] for place in np.linspace(0, len(names) - 1, most).round().astype(int)]
    limit = 4 * float(np.median(rms[~rejected])) if not rejected.all() else 1.0
    if not names:
        return
    place = {detection.name: place for place, detection in enumerate(found, start=1)}
    points = {detection.name: detection.lines for detection in found}
    wanted = {frame_number(name): name for name in names}
    folder.mkdir()
    with decode_video(clip) as (_, frames):
        for number, _, image in frames:
            if name := wanted.get(number):
                write_overlay(
                    folder / overlay_name(place[name], name),
                    image(),
                    points[name],
                    own[name],
                    rms=rms,
                    rejected=rejected,
                    limit=limit,
                )
