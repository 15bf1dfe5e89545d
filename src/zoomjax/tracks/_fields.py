"""Whether frames are woven of two fields: their even rows show one moment, their odd rows another.

In such a frame what moves is displaced from the one field to the other, by half of what it moves in a
frame's time. No pattern in the scene does that: it is where it is in both.
"""

import cv2
import numpy as np

from ._flow import Grey, Points

_EVERY = 4
"""Frames from one that is looked at to the next."""

_MOST = 60
"""Frames that are looked at."""

_SLOWEST, _FASTEST = 2.0, 40.0
"""px a frame, across: what is slower does not tell, and what is faster may not be found."""

_FEWEST = 12
"""Points that tell."""

_LEAST, _LARGEST = 0.2, 0.8
"""Of the displacement over the motion: it is a half, less where encoding blurs it, and 0 without fields."""

_SHARE, _FRAMES = 0.2, 3
"""Of the frames that tell, and number of them at least: so many have fields."""

_WINDOW = (21, 11)


class Fields:
    """Looks for fields in some of a clip's frames."""

    def __init__(self):
        self._told: list[bool] = []

    @property
    def found(self) -> bool:
        """Whether the clip has fields."""
        return sum(self._told) >= max(_FRAMES, _SHARE * len(self._told))

    def add(self, number: int, image: Grey, points: Points, moves: Points) -> None:
        """Look at the next frame, maybe: its number, itself, points, and their moves since the last."""
        speed = np.abs(moves[:, 0])
        tells = (speed > _SLOWEST) & (speed < _FASTEST)
        if number % _EVERY or len(self._told) >= _MOST or tells.sum() < _FEWEST:
            return
        displaced = _displaced(image, points[tells]) / moves[tells, 0]
        displaced = displaced[np.isfinite(displaced)]
        if len(displaced) >= _FEWEST:
            self._told.append(bool(_LEAST < abs(np.median(displaced)) < _LARGEST))


def _displaced(image: Grey, points: np.ndarray) -> np.ndarray:
    """How far points are displaced across, from the even rows to the odd ones, px; NaN if not found."""
    rows = len(image) // 2 * 2
    even, odd = (np.ascontiguousarray(image[first:rows:2]) for first in (0, 1))
    places = (points / np.array([1, 2])).astype(np.float32)
    options = {"winSize": _WINDOW, "maxLevel": 3}
    there, good, _ = cv2.calcOpticalFlowPyrLK(even, odd, places, places.copy(), **options)
    back, fine, _ = cv2.calcOpticalFlowPyrLK(odd, even, there, there.copy(), **options)
    found = (good.ravel() > 0) & (fine.ravel() > 0) & (np.abs(back - places).max(axis=1) < 0.5)
    return np.where(found, (there - places)[:, 0], np.nan)
