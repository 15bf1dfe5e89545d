"""Frames that repeat the one before them, as conversions of the frame rate make them.

A copy has the errors of its original: its points are where they were, to next to nothing. To
count both would say the same thing twice. It is the points that are compared, not the pixels: a copy that
was encoded anew differs in its pixels, and another picture of a thing at rest may not.
"""

import numpy as np
from jaxtyping import Float, Int

from .tracks import Tracks

_SAME = 0.005
"""px: points that have moved by less are where they were, with their errors, as matching them ends here."""

_STOP, _MOST = 0.1, 0.5
"""Nor does a camera stop for a moment: what moves by less than this share of the steps before and after,
and by so many px at most, is a copy whose errors are those of encoding it."""

_DRIFT = 3 * _SAME
"""px: copies in a row may be farther from the first, but no farther than that, or it goes slowly."""

_BESIDE = 3
"""Frames before and after in which those steps are."""

_SHARE = 0.75
"""Of the points, that have stayed: others may be mistakes."""

_LONGEST = 6
"""Frames that a conversion makes of one, at most."""

_SLOWING, _TURNING, _LEAST = 0.25, 0.6, 0.05
"""The step into such frames or out of them, beside the larger ones next to it, and in px: less is a camera
that stops or starts. About the end of a pan or of a zoom it is half of these, and if the frames are not the
same it has to be more."""

_FEWEST = 4
"""Points that tell."""


def originals(tracks: Tracks) -> Int[np.ndarray, "frame"]:
    """Of each frame the number of the first that shows the same, in a row: its own if it repeats none.

    Frames of a camera at rest are copies, too, where encoding has left nothing of their noise. Where each
    has noise of its own they are not.
    """
    track, frame, points = _views(tracks)
    steps = _steps(tracks)
    limits = _limits(steps)
    ends = np.searchsorted(np.sort(frame), np.arange(tracks.frames + 1))
    order, keys = np.argsort(frame, kind="stable"), track.astype(np.int64) * tracks.frames + frame

    def from_first(first: int, number: int) -> float:
        """How far most points have moved from one frame to another, px."""
        there = order[ends[number] : ends[number + 1]]
        wanted = keys[there] + first - number
        here = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        both = keys[here] == wanted
        moved = np.linalg.norm(points[there[both]] - points[here[both]], axis=1)
        return float(_most(moved, np.zeros(len(moved), int), 1)[0])

    first = np.arange(tracks.frames)
    for number in np.flatnonzero(steps < limits).tolist():
        begun = int(first[number - 1])
        if begun == number - 1 or from_first(begun, number) < max(limits[number], _DRIFT):
            first[number] = begun
    return first


def counted_once(tracks: Tracks) -> Tracks:
    """The same, with weights by which all views of a track in frames that show the same count as one.

    Weights are scaled so that the noise by which they are fitted is that of a view, however many there are
    in copies. Tracks without such views are returned as they are.
    """
    number = copies(originals(tracks), tracks)
    if not (number > 1).any():
        return tracks
    before = tracks.view_weights()
    before = np.ones(len(number)) if before is None else before
    weight = before / number
    track, frame, points = tracks.views()
    return Tracks.from_arrays(
        track,
        frame,
        points,
        image_size=tracks.image_size,
        frames=tracks.frames,
        weight=weight * (np.sum(before * weight) / np.sum(weight**2)),
    )


def without_rests(first: Int[np.ndarray, "frame"], tracks: Tracks) -> Int[np.ndarray, "frame"]:
    """The same, but frames of a camera that rests are their own: it stops slowly, and for longer.

    The others are no moments of their own: they stand for one that is not there, or fill up a rate.
    """
    steps = np.pad(_steps(tracks), 2, constant_values=np.inf)
    begins = np.unique(first)
    ends = np.append(begins[1:], len(first))
    around = steps[np.stack([begins + 1, begins + 2, ends + 2, ends + 3])]
    fastest = np.max(np.where(np.isfinite(around), around, 0), axis=0)
    least = np.minimum(around[1], around[2])  # one of them is not known at the ends of a clip and at cuts
    inner = steps[2:-2].copy()
    inner[begins] = 0
    same = np.maximum.reduceat(inner, begins) < _SAME
    moves = np.isfinite(least) & (least > np.maximum(np.where(same, _SLOWING, _TURNING) * fastest, _LEAST))
    short = ends - begins <= _LONGEST
    return np.where((moves & short)[np.searchsorted(begins, first)], first, np.arange(len(first)))


def _views(tracks):
    """Of each view the row of its track, which is its own whatever the track is called, frame and point."""
    mask = np.asarray(tracks.mask)
    return np.nonzero(mask)[0], np.asarray(tracks.frame)[mask], np.asarray(tracks.points, float)[mask]


def _steps(tracks) -> Float[np.ndarray, "frame"]:
    """How far most points have moved to each frame from the one before, px; infinite where few tell."""
    track, frame, points = _views(tracks)
    follows = (np.diff(track) == 0) & (np.diff(frame) == 1)
    moved = np.linalg.norm(np.diff(points, axis=0), axis=1)[follows]
    return _most(moved, frame[1:][follows], tracks.frames)


def _most(moved, frame, frames) -> Float[np.ndarray, "frame"]:
    """How far most points of each frame have moved, px; infinite where few tell."""
    order = np.lexsort((moved, frame))
    count = np.bincount(frame, minlength=frames)
    place = np.cumsum(count) - count + np.ceil(_SHARE * count).astype(int) - 1
    enough = count >= _FEWEST
    most = np.full(frames, np.inf)
    most[enough] = moved[order][place[enough]]
    return most


def _limits(steps) -> Float[np.ndarray, "frame"]:
    """How far the points of each frame may have moved if it is a copy, px."""
    known = np.where(np.isfinite(steps), steps, 0)
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(known, _BESIDE), _BESIDE).max(axis=1)
    around = np.minimum(windows[: len(steps)], windows[_BESIDE + 1 :])
    return np.maximum(np.minimum(_STOP * around, _MOST), _SAME)


def copies(first: Int[np.ndarray, "frame"], tracks: Tracks) -> Float[np.ndarray, "entry"]:
    """In how many of the frames that show the same each view's track is seen, as `Tracks.views` has them.

    Args:
        first: of `originals`.
        tracks: the tracks.
    """
    track, frame, _ = _views(tracks)
    _, place, count = np.unique(
        np.stack([track, first[frame]]), axis=1, return_inverse=True, return_counts=True
    )
    return count[place.ravel()].astype(float)
