"""Frames of a clip, far apart, compared with one another: points that look alike, and whole images.

Points are those of SIFT (Lowe 2004). Two of them match if each is the nearest of the other, and by far.
"""

import os
from collections.abc import Callable, Iterable

import cv2
import numpy as np
from jaxtyping import Float

from ..io.video_reader import decode_video
from .video import grey_frame

_SIDE = 960
"""px of the longer side of an image in which points are looked for, at most."""

_MOST = 800
"""Points in a frame."""

_BY_FAR = 0.75
"""Distance to the nearest over that to the second, at most."""

_WIDTH = 160
"""px of the images that are compared as a whole."""

_BLOCKS = (8, 5)
"""Parts of these, across and down."""

_GREY = 4.0
"""Grey levels: standard deviation of a part that shows something."""

_ALIKE = 0.5
"""Correlation of parts that show the same: of one in twenty that do not."""

_LEAST_PARTS = 6
_SHARE = 0.5  # of the parts, at least, that have to be alike: things move, captions stay

Points = Float[np.ndarray, "point 2"]


class KeyFrames:
    """Some frames of a clip, and what is found in them; the images are kept small.

    Args:
        clip: a video that PyAV decodes.
        frames: the numbers of some of those that can be decoded, from 0, as tracks number them.

    Raises:
        FileNotFoundError: there is no such clip.
        ValueError: it is no video, or does not have these frames.
    """

    def __init__(self, clip: str | os.PathLike[str], frames: Iterable[int]):
        """Decode the frames and look for points in them."""
        wanted, sift = set(frames), cv2.SIFT_create(nfeatures=_MOST)  # pyright: ignore[reportAttributeAccessIssue]
        self._points: dict[int, Points] = {}
        self._looks: dict[int, np.ndarray] = {}
        self._images: dict[int, np.ndarray] = {}
        with decode_video(clip) as (_, items):
            for frame, (_, _, image) in enumerate(items):
                if frame not in wanted:
                    continue
                grey = grey_frame(image())
                shrunk = max(max(grey.shape) / _SIDE, 1.0)
                size = [round(n / shrunk) for n in grey.shape[::-1]]
                small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
                places, looks = sift.detectAndCompute(small, None)
                factor = np.array(grey.shape[::-1]) / small.shape[::-1]
                points = np.array([place.pt for place in places], float).reshape(-1, 2)
                self._points[frame] = (points + 0.5) * factor - 0.5
                self._looks[frame] = np.zeros((0, 128), np.float32) if looks is None else looks
                self._images[frame] = small
        if missing := sorted(wanted - self._images.keys()):
            raise ValueError(
                f"Argument frames has {missing[0]}, but {os.fspath(clip)} has no such frame, or it cannot "
                "be decoded."
            )

    def matches(self, one: int, other: int) -> tuple[Points, Points]:
        """Points of one frame and points of another that look like them, px."""
        looks = self._looks[one], self._looks[other]
        if min(map(len, looks)) < 2:
            return np.zeros((0, 2)), np.zeros((0, 2))
        cosine = looks[0] @ looks[1].T
        squares = [np.sum(look**2, axis=1) for look in looks]
        apart = np.sqrt(np.maximum(squares[0][:, None] + squares[1] - 2 * cosine, 0))
        nearest, back = np.argmin(apart, axis=1), np.argmin(apart, axis=0)
        number = np.arange(len(nearest))
        two = np.partition(apart, 1, axis=1)[:, :2]
        good = (back[nearest] == number) & (two[:, 0] < _BY_FAR * two[:, 1])
        return self._points[one][good], self._points[other][nearest[good]]

    def alike(self, one: int, other: int, carry: Callable[[Points], Points], size: tuple[int, int]) -> bool:
        """Whether a frame shows what another one shows, in most of its parts that show something.

        Args:
            one: number of the frame that is carried.
            other: that of the one beside which it is put.
            carry: where `one` shows the points of `other`, NaN where it does not, px.
            size: of the frames, (width, height) px.
        """
        width, height = _WIDTH, max(round(_WIDTH * size[1] / size[0]), 1)
        scale = np.array(size) / (width, height)
        places = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
        there = carry((places + 0.5) * scale - 0.5)
        with np.errstate(invalid="ignore"):
            inside = np.all((there >= 0) & (there <= np.array(size) - 1), axis=1).reshape(height, width)
        shrunk = np.array(size) / self._images[one].shape[::-1]
        there = np.where(inside.reshape(-1, 1), (there + 0.5) / shrunk - 0.5, -1).astype(np.float32)
        there = there.reshape(height, width, 2)
        steps = np.linalg.norm(np.diff(there, axis=1), axis=-1)[inside[:, 1:] & inside[:, :-1]]
        if not len(steps):
            return False
        blur = max(0.4 * float(np.median(steps)), 0.3)  # so that samples have no aliases
        image = cv2.GaussianBlur(self._images[one], (0, 0), blur)
        x, y = np.ascontiguousarray(there.transpose(2, 0, 1))
        seen = cv2.remap(image, x, y, cv2.INTER_LINEAR)
        beside = cv2.resize(self._images[other], (width, height), interpolation=cv2.INTER_AREA)
        return _alike(seen.astype(float), beside.astype(float), inside)


def _alike(one, other, inside):
    """Whether most parts of two images are alike, of those that are inside and show something."""
    likeness = []
    for rows in np.array_split(np.arange(one.shape[0]), _BLOCKS[1]):
        for columns in np.array_split(np.arange(one.shape[1]), _BLOCKS[0]):
            part = np.ix_(rows, columns)
            good = inside[part]
            if good.mean() < 0.5:
                continue
            a, b = one[part][good], other[part][good]
            if min(a.std(), b.std()) > _GREY:
                likeness.append(np.mean((a - a.mean()) * (b - b.mean())) / (a.std() * b.std()))
    return len(likeness) >= _LEAST_PARTS and float(np.mean(np.array(likeness) > _ALIKE)) >= _SHARE
