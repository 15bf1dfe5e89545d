"""Single frames of a clip: their times, and findings about those that repeat others or show nothing."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int

from ..fit.motion import MotionFit
from ..io.video_reader import decode_video
from ..tracks.repeats import originals, without_rests
from ..tracks.tracks import Tracks
from ..trust.assessment import Finding

BLIND = 0.2
"""Share of the frames that may show nothing: there f is interpolated, which is right for moments alone."""

_LOOSE = 0.2
"""Of the points of two frames that follow: where fewer are seen in both, these are not linked."""

_RANGES = 4
"""Of frames that are named; the number of others is told."""


def frames_of(clip: Path) -> np.ndarray:
    """Of each frame that can be decoded its number in the file and its time, s; NaN where it has none."""
    with decode_video(clip) as (_, frames):
        return np.array([(number, time) for number, time, _ in frames], float)


def repeated_frames(tracks: Tracks) -> int:
    """How many frames repeat the one before them though the camera moves, so that they are no moments."""
    first = without_rests(originals(tracks), tracks)
    return int(np.sum(first != np.arange(tracks.frames)))


def of_repeated(tracks: Tracks) -> Iterator[Finding]:
    """Frames that count once with the one before them."""
    if repeated := repeated_frames(tracks):
        yield Finding(
            "repeated frames",
            "good",
            f"{repeated} of {tracks.frames} frames repeat the one before, as after a change of the frame "
            "rate, and count once with it.",
            "Give the clip at the frame rate that it was filmed at, if you have it.",
        )


def of_blind(fit: MotionFit, numbers: Int[np.ndarray, "frame"]) -> Iterator[Finding]:
    """Frames whose f is not found, by their numbers."""
    blind = ~np.isfinite(np.asarray(fit.focal))
    if not blind.any():
        return
    few = np.mean(blind) <= BLIND
    one = int(np.sum(blind)) == 1
    yield Finding(
        "frames without points",
        "good" if few else "doubtful",
        f"{np.sum(blind)} {'' if few else f'of {len(blind)} '}frame{'s' * (not one)} "
        f"show{'s' * one} nothing that can be followed: {ranges(numbers[blind])}. "
        f"{'It' if one else 'They'} may be black, faded or blurred; f is interpolated there.",
        "Look at these frames in the corrected clip."
        if few
        else "Film a scene with detail everywhere, without blur, or cut these frames off.",
    )


def ranges(numbers: Int[np.ndarray, "some"]) -> str:
    """Frames in words: "frame 7", or "frames 3 to 9, 12 and 20 to 31"."""
    ends = np.flatnonzero(np.diff(numbers) != 1) + 1
    parts = [(int(part[0]), int(part[-1])) for part in np.split(numbers, ends)]
    told = [f"{low} to {high}" if high > low else f"{low}" for low, high in parts]
    if len(told) > _RANGES + 1:
        left = sum(high - low + 1 for low, high in parts[_RANGES:])
        told = [*told[:_RANGES], f"{left} others"]
    words = ", ".join(told[:-1]) + " and " * (len(told) > 1) + told[-1]
    return f"frame{'s' * (len(numbers) > 1)} {words}"


def of_dissolves(
    tracks: Tracks,
    follows: Bool[np.ndarray, "view"],
    shot: Int[np.ndarray, "frame"],
    numbers: Int[np.ndarray, "frame"],
) -> Iterator[Finding]:
    """Frames of a shot that no point that follows the camera links to those before them.

    Args:
        tracks: what was followed.
        follows: which of their views follow the model.
        shot: number of each frame's shot, -1 for frames without points.
        numbers: of frames.
    """
    track, frame = np.nonzero(np.asarray(tracks.mask))[0][follows], np.asarray(tracks.frame)
    frame = frame[np.asarray(tracks.mask)][follows]
    first, last = np.full(len(tracks.number), tracks.frames), np.zeros(len(tracks.number), int)
    np.minimum.at(first, track, frame)
    np.maximum.at(last, track, frame)
    seen = first < last
    ends = [np.bincount(of[seen], minlength=tracks.frames) for of in (first, last)]
    linked = np.cumsum(ends[0] - ends[1])[:-1]
    there = np.bincount(frame, minlength=tracks.frames)
    loose = (shot[:-1] == shot[1:]) & (shot[1:] >= 0)
    loose &= linked < _LOOSE * np.minimum(there[:-1], there[1:])
    if loose.any():
        yield Finding(
            "dissolves",
            "doubtful",
            f"next to nothing is seen both before and after {ranges(numbers[1:][loose])}: one picture may "
            "dissolve into another there, or blur or a near thing hide it, and f near it be wrong.",
            "Look at the clip there. If it dissolves, cut it, and leave out frames in which both are seen.",
        )
