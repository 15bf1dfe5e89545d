"""Tracks found in the frames of a clip: corners that spread over the image, followed without drift.

Each track begins at a corner. Pyramidal Lucas-Kanade, there and back, leads from a frame to the next
(Bouguet 2001); from there the track is matched with the patch of the frame where it began, bent as the
camera's motion bends it (Shi, Tomasi 1994). So errors do not add up along a track. A track ends where it is
not like that patch any more, when its scale has changed by 1.4, or after its life; others begin.

Captions and logos stay in their place while the camera moves: such tracks are left out. Nothing is linked
across a cut. Memory holds two frames and the places of all points, whatever the clip's length.
"""

import hashlib
import os
import warnings
from collections.abc import Callable, Iterable

import cv2
import numpy as np
from jaxtyping import UInt8

from .._core.checks import checked_integer
from .._core.fields import refuse_masked_image
from ..io.video_reader import INTERLACED, decode_video, says_interlaced
from ._fields import Fields
from ._follow import Follower
from .repeats import counted_once
from .tracks import Tracks

_SOME = 8
"""One pixel of so many in each direction tells frames apart: all have noise, or move."""

_SHARE_AGAIN = 0.1
"""Of the frames, from which on it is said that they come again: fewer change little."""

_FEWEST = 4
"""Views of a frame that say anything: it has a focal length and three angles."""


def track_video(
    clip: str | os.PathLike[str],
    *,
    most: int = 200,
    life: int = 45,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Tracks:
    """Follow points through a clip: what a calibration from motion begins with.

    Frames may be repeated, as in conversions from 25 to 30 frames/s, black or blurred, and the clip may
    have cuts.

    Args:
        clip: a video that PyAV decodes, of any length.
        most: number of tracks at a time, at most; 4 or more.
        life: the most frames that a track is followed.
        progress: called after each frame with the number of frames done and announced (0 if unknown).

    Returns:
        The tracks, of two views at least. The error of a point is some 0.1 px at sharp corners; that of its
        track's first point is 0 by definition. Where frames repeat the one before, views have weights by
        which those of one point in them count as one.

    Raises:
        FileNotFoundError: there is no such clip.
        ValueError: it is no video, none of its frames decodes, it has fewer than two frames, or nothing in
            it can be followed.

    Warns:
        UserWarning: the clip is interlaced, its pixels are not square, it is one of several in its file, or
            some of its frames do not decode: frames of the tracks are numbered without these. Or many of
            its frames show what earlier ones do, and would count twice.
    """
    with decode_video(clip) as (announced, items):
        numbers = []

        def images() -> Iterable[UInt8[np.ndarray, "height width 3"]]:
            for number, _, image in items:
                numbers.append(number)
                yield image()
                progress(len(numbers), announced)

        try:
            tracks, has_fields, again = _followed(images(), most, life)
        except ValueError as error:
            raise ValueError(f"Cannot track points in {os.fspath(clip)}: {error}") from error
    if lost := numbers[-1] + 1 - len(numbers):
        warnings.warn(
            f"{lost} of {numbers[-1] + 1} frames of {os.fspath(clip)} cannot be decoded: the tracks number "
            "frames without them.",
            stacklevel=2,
        )
    if again:
        warnings.warn(f"In {os.fspath(clip)} {again}", stacklevel=2)
    if has_fields and not says_interlaced(clip):  # which is warned of
        warnings.warn(INTERLACED, stacklevel=2)
    return tracks


def track_frames(
    frames: Iterable[UInt8[np.ndarray, "height width *channels"]], *, most: int = 200, life: int = 45
) -> Tracks:
    """Follow points through images, as `track_video` through the frames of a clip.

    Args:
        frames: grey, or blue, green, red; all of one size.
        most: number of tracks at a time, at most; 4 or more.
        life: the most frames that a track is followed.

    Raises:
        ValueError: there are fewer than two frames, one is no such image, they differ in size, or nothing
            can be followed.

    Warns:
        UserWarning: frames are interlaced, or many of them show what earlier ones do.
    """
    tracks, has_fields, again = _followed(frames, most, life)
    if again:
        warnings.warn(f"In argument frames {again}", stacklevel=2)
    if has_fields:
        warnings.warn(INTERLACED, stacklevel=2)
    return tracks


def _followed(frames, most, life) -> tuple[Tracks, bool, str]:
    """The tracks, whether frames are woven of fields, and a sentence about those that come again."""
    most, life = checked_integer("most", most, _FEWEST), checked_integer("life", life, 2)
    follower, fields, seen = None, Fields(), _Seen()
    for image in frames:
        grey = grey_frame(image)
        size = (grey.shape[1], grey.shape[0])
        follower = Follower(size, most=most, life=life) if follower is None else follower
        if size != follower.size:
            raise ValueError(f"Frames of {follower.size} and of {size} px follow each other.")
        follower.add(grey)
        fields.add(follower.frame, grey, *follower.moves)
        seen.add(grey)
    number = 0 if follower is None else follower.frame + 1
    if follower is None or number < 2:
        raise ValueError("It has fewer than two frames.")
    track, frame, points = _enough(*follower.views())
    if not len(track):
        raise ValueError(
            "Nothing in it can be followed: it shows fewer than four corners at a time, or nothing but "
            "what stays in its place."
        )
    tracks = Tracks.from_arrays(track, frame, points, image_size=follower.size, frames=number)
    return counted_once(tracks), fields.found, seen.sentence(number)


class _Seen:
    """Counts frames that show to the last bit what earlier ones do, as where a clip is joined to its copy.

    Those that repeat the one before, and those of one colour, do not count.
    """

    def __init__(self):
        self._known: set[bytes] = set()
        self._last = b""
        self._again = 0

    def add(self, grey: np.ndarray) -> None:
        some = np.ascontiguousarray(grey[::_SOME, ::_SOME])
        shown = hashlib.blake2b(some.tobytes(), digest_size=16).digest()
        self._again += shown in self._known and shown != self._last and some.min() < some.max()
        self._known.add(shown)
        self._last = shown

    def sentence(self, number: int) -> str:
        if self._again < max(_SHARE_AGAIN * number, 2):
            return ""
        return (
            f"{self._again} of {number} frames show to the last bit what earlier ones do, as where a clip "
            "is joined to its copy. They count again, as if they were seen anew: leave them out."
        )


def _enough(track, frame, points) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The views in frames that have some: fewer tell no focal length, as in the dark end of a fade."""
    kept = np.ones(len(frame), bool)
    while kept.any():
        few = np.bincount(frame[kept], minlength=frame.max() + 1)[frame] < _FEWEST
        few |= np.bincount(track[kept & ~few], minlength=track.max() + 1)[track] < 2
        if not few[kept].any():
            break
        kept &= ~few
    return track[kept], frame[kept], points[kept]


def grey_frame(image: np.ndarray) -> np.ndarray:
    """A frame as (height, width) bytes; ValueError if it is no image of 8 bits."""
    refuse_masked_image("frames", image)
    shape = np.shape(image)
    flat = len(shape) == 2 or shape[2:] in ((1,), (3,), (4,))
    if getattr(image, "dtype", None) != np.uint8 or not flat:
        what = f"{shape}, {image.dtype}" if isinstance(image, np.ndarray) else type(image).__name__
        raise ValueError(
            "Argument frames must hold images (height, width) or (height, width, 3) of uint8, blue, green, "
            f"red, but one is {what}."
        )
    if len(shape) == 2:
        return image
    return image[..., 0] if shape[2] == 1 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
