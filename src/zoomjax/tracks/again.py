"""Points of a clip found again where the camera comes back to them, so that tracks close loops.

A track ends when its point leaves the image, or after its life; the point may come back. Where a first
solution says where frames show it, the patch of the frame where its track began is matched there again,
bent as the solution bends it. What is like the patch is one more view of the track.
"""

import os
from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

from .._core.checks import checked_integer
from ..io.video_reader import decode_video
from ._follow import ALIKE, GROWTH
from ._patches import HALF, Patches
from .repeats import originals
from .tracks import Tracks
from .video import grey_frame

_NEAR = 4.0
"""px: how far the match may be from where the solution leads."""

_AWAY = 10
"""Frames after the last view of a track, from which it may be found again."""

_MOST = 400
"""Patches that are matched in a frame."""

_VIEWS = 5
"""Of a track that is worth it, at least."""

Points = Float[np.ndarray, "point 2"]
Carry = Callable[[np.ndarray, Points, int], Points]
"""Of frames' numbers and points in each, px, and another frame: where this shows the same, or NaN."""


class _Kept(NamedTuple):
    """Tracks that may be found again: their places among all, their patches, and their last frames."""

    track: np.ndarray
    patches: Patches
    last: np.ndarray


def find_again(
    clip: str | os.PathLike[str], tracks: Tracks, *, carry: Carry, every: int = 5, seed: int = 0
) -> Tracks:
    """Tracks with more views, in frames to which their points have come back.

    Args:
        clip: the video that was tracked.
        tracks: of `track_video`.
        carry: where a frame shows what others show: given the number of a frame for each point, the points
            there and the number of another frame, the points in this one, NaN where it does not show them.
        every: it is looked for them in one of so many frames.
        seed: of the choice, where there are more than are looked for.

    Returns:
        The same tracks, of which some have more views, after some frames without. Where views have weights,
        new ones have the largest of those of their track.
    """
    every = checked_integer("every", every, 1)
    mask, row = np.asarray(tracks.mask), np.arange(len(tracks.number))
    begins, counts = np.argmax(mask, axis=1), mask.sum(axis=1)
    first, anchors = np.asarray(tracks.frame)[row, begins], np.asarray(tracks.points, float)[row, begins]
    last = np.max(np.where(mask, np.asarray(tracks.frame), -1), axis=1)
    looked = set(originals(tracks)[::every].tolist())  # in none twice
    kept: _Kept | None = None
    more: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    rng = np.random.default_rng(checked_integer("seed", seed, 0))
    with decode_video(clip) as (_, items):
        for frame, (_, _, image) in enumerate(items):
            begun = np.flatnonzero((first == frame) & (counts >= _VIEWS))
            if not len(begun) and (frame not in looked or kept is None):
                continue
            grey = cv2.GaussianBlur(grey_frame(image()), (5, 5), 0.8)
            if kept is not None and frame in looked:
                ended = np.flatnonzero(kept.last < frame - _AWAY)
                found, points = _found(grey, frame, kept, ended, first, anchors, carry, rng)
                more.append((found, np.full(len(found), frame), points))
            if len(begun):
                new = _Kept(begun, Patches.cut(grey, anchors[begun]), last[begun])
                kept = new if kept is None else _joined(kept, new)
    return _with(tracks, more)


def _found(grey, frame, kept, ended, first, anchors, carry, rng):
    """Which tracks an image shows again, and where."""
    if len(ended) == 0:
        return np.zeros(0, int), np.zeros((0, 2))
    which = kept.track[ended]
    expected = carry(first[which], anchors[which], frame)
    height, width = grey.shape
    with np.errstate(invalid="ignore"):
        inside = np.all((expected > HALF + 2) & (expected < [width - HALF - 3, height - HALF - 3]), axis=1)
    seen = np.flatnonzero(inside)
    seen = rng.permutation(seen)[:_MOST]
    which, expected, ended = which[seen], expected[seen], ended[seen]
    sides = [carry(first[which], anchors[which] + side, frame) - expected for side in np.eye(2)]
    shapes = np.stack(sides, axis=-1)
    growth = np.sqrt(np.abs(np.linalg.det(np.nan_to_num(shapes))))
    good = np.isfinite(shapes).all(axis=(1, 2)) & (growth < GROWTH) & (growth > 1 / GROWTH)
    which, expected, shapes, ended = which[good], expected[good], shapes[good], ended[good]
    if len(which) == 0:
        return np.zeros(0, int), np.zeros((0, 2))
    points, likeness = kept.patches[ended].matched(grey, expected, shapes)
    good = (likeness > ALIKE) & (np.linalg.norm(points - expected, axis=1) < _NEAR)
    return which[good], points[good]


def _joined(kept, new):
    return _Kept(
        np.concatenate([kept.track, new.track]),
        kept.patches + new.patches,
        np.concatenate([kept.last, new.last]),
    )


def _with(tracks, more):
    """Tracks with more views: which, their frames and points."""
    number, frame, points = tracks.views()
    if not more:
        return tracks
    which, frames, places = (np.concatenate(parts) for parts in zip(*more, strict=True))
    weight = tracks.view_weights()
    if weight is not None:
        most = np.max(np.asarray(tracks.weight), axis=1, where=np.asarray(tracks.mask), initial=0)
        weight = np.concatenate([weight, most[which]])
    return Tracks.from_arrays(
        np.concatenate([number, np.asarray(tracks.number)[which]]),
        np.concatenate([frame, frames]),
        np.concatenate([points, places]),
        image_size=tracks.image_size,
        frames=tracks.frames,
        weight=weight,
    )
