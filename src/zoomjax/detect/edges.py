"""Detection of straight edges, however bent by the lens: stripes, squares, buildings, halls.

As in the paper's first experiment, sub-pixel edges (`_edge_points`) are linked into smooth pieces
(`_segments`). A Hough transform with distortion as one more unknown then tells how bent the photograph is
(`_search`). Under that model, in which lines of the scene are straight, pieces are joined to lines
(`_collinear`). The lines fit the model again (`_frame_model`), and both take turns, so that lines get
longer as the model gets better. The two edges of a stripe are separate lines.
"""

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np

from .._core.fields import refuse_masked_image
from ._collinear import collinear, thin_bars
from ._edge_points import edge_points
from ._frame_model import OneFrame, extent, samples_of
from ._joining import border_lines
from ._search import likely_angle
from ._segments import Fragments, fragments
from .base import AbstractDetector

_LEAST_FITTED = 0.1
"""Share of the image's shorter side that a line must extend over to inform the frame's distortion."""

_LEAST_LINES = 3
"""Number of such lines needed to estimate the distortion of a frame."""

_MOST_FITTED = 150
"""So many of the longest lines are enough to estimate it."""

_TURNS = (1.0, 0.6, 0.4)
"""px, at most, by which lines may be bent as the model is not exact, turn by turn; at least `_EXACT`."""

_EXACT = 0.15
_TIED = 0.3
"""The same, at most, of a model that other photos have told, after the first turn."""

_ROUGHEST = 4.0
"""Greatest RMS of a line, in such px of the last turn, and the least one that counts as rough."""

_STRONG = 0.05
"""Share of the image's shorter side from which on a piece of an edge should be explained by some line."""


@dataclasses.dataclass(frozen=True)
class Edges:
    """What `EdgeDetector.find` finds in an image.

    Attributes:
        lines: for each line an (n, 2) array of points, px, in order along it, the longest line first.
        unexplained: share, 0 to 1, of the length of all long and smooth edges that is on none of the lines.
            Arcs and branches add to it; where it is large, the lines are little of what there is.
        bend: how bent the image was taken to be when they were joined: k1 and k2 of the division model
            ``1 / (1 + k1 r^2 + k2 r^4)``, and the place of its centre from the image's, x and y, all
            lengths in halves of the image's diagonal.
    """

    lines: tuple[np.ndarray, ...]
    unexplained: float
    bend: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)


class EdgeDetector(AbstractDetector):
    """Detects straight edges in an image: borders of stripes, squares of a board, or anything straight.

    Thresholds adapt to the noise and contrast of the image. Pieces of one border become one line, also
    across occlusions and changes of which side is brighter.

    Attributes:
        least_length: share of the image's shorter side that a line must extend over, 0 to 1.
        least_cover: share of a line that must be visible, 0 to 1.

    Example:
        >>> from zoomjax.scenes.board import board_photo, nikkor_18_200
        >>> photo = board_photo(nikkor_18_200((1072, 712)), 127.36, blur=1, noise=2)
        >>> lines = EdgeDetector()(photo)
        >>> len(lines), lines[0].shape[1]
        (14, 2)
    """

    least_length: float = 0.2
    least_cover: float = 0.25

    def __check_init__(self):
        """Check that both are shares."""
        for name in ("least_length", "least_cover"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"Argument {name} must be 0 to 1, but it is {getattr(self, name)}.")

    def __call__(self, image: np.ndarray) -> list[np.ndarray]:
        """Detect edges with sub-pixel points, the longest line first.

        Args:
            image: (height, width[, 3]), uint8, grey or BGR, at least 32 px a side.

        Returns:
            For each line an (n, 2) array of ``(x, y)``, px, in order along the line.

        Raises:
            ValueError: the image is not such an array.
        """
        return list(self.find(image).lines)

    def find(self, image: np.ndarray, *, bend: Sequence[float] | None = None) -> Edges:
        """Detect edges, and say how bent the image is and how much of it the lines explain.

        Args:
            image: as for calls.
            bend: how bent it is, as `Edges.bend`, where other photos by the lens have told: it is not
                searched for, and hardly changes. None: it is searched for.

        Raises:
            ValueError: the image is not such an array, or `bend` not four finite numbers.
        """
        grey = as_grey(image)
        size = (grey.shape[1], grey.shape[0])
        if bend is not None and (len(bend) != 4 or not np.isfinite(bend).all()):
            raise ValueError(f"Argument bend must be four finite numbers, but it is {bend!r}.")
        pieces = fragments(edge_points(grey))
        if bend is None:
            model = OneFrame.of_angle(size, likely_angle(pieces, size))
        else:
            model = OneFrame.of_values(size, bend)
        barred = thin_bars(pieces)
        label, sigma = np.zeros(0, int), _TURNS[0] if bend is None else _TURNS[-1]
        for turn in _TURNS:
            sigma = min(sigma, turn)
            label = collinear(pieces, model, sigma, barred)
            long = _long(pieces, label, _LEAST_FITTED * min(size))
            if len(long) < _LEAST_LINES:
                break
            model = model.fitted(long)
            most = 1.0 if bend is None else _TIED  # lines of arcs are no measure of a model that is known
            sigma = float(np.clip(2 * np.median(_rms(long, model)), _EXACT, most))
        lines = border_lines(pieces, label)
        least, cover = self.least_length * min(size), self.least_cover
        good = np.array([_is_seen(line, least, cover) for line in lines], bool)
        seen = [line for line, keep in zip(lines, good, strict=True) if keep]
        good[good] = _rms(seen, model) <= _ROUGHEST * max(sigma, 0.25)
        found = _found(pieces, label, lines, good, min(size))
        return dataclasses.replace(found, bend=model.values)


def as_grey(image: np.ndarray) -> np.ndarray:
    """The grey levels of an image.

    Raises:
        ValueError: it is not (height, width[, 3]) bytes, or smaller than 32 px a side.
    """
    refuse_masked_image("image", image)
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
        kind = image.dtype if isinstance(image, np.ndarray) else type(image).__name__
        raise ValueError(
            f"Argument image must be an array of bytes (uint8), but it is {kind}. cv2.imread gives None "
            "where it cannot read a file."
        )
    if image.ndim not in (2, 3) or image.shape[2:] not in ((), (3,)) or min(image.shape[:2]) < 32:
        raise ValueError(
            "Argument image must be (height, width) or (height, width, 3), at least 32 px a side, but its "
            f"shape is {image.shape}."
        )
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image


def _long(pieces: Fragments, label: np.ndarray, least: float) -> list[np.ndarray]:
    """The longest lines, of at least so many px."""
    tips = np.concatenate([pieces.points[pieces.start], pieces.points[pieces.start + pieces.count - 1]])
    number = int(label.max(initial=-1)) + 1
    low, high = np.full((number, 2), np.inf), np.full((number, 2), -np.inf)
    np.minimum.at(low, np.tile(label, 2), tips)
    np.maximum.at(high, np.tile(label, 2), tips)
    large = np.hypot(*(high - low).T) >= least
    lines = border_lines(pieces, np.where(large[label], label, -1))
    return sorted((line for line in lines if extent(line) >= least), key=extent, reverse=True)[
        :_MOST_FITTED
    ]


def _is_seen(line: np.ndarray, least: float, cover: float) -> bool:
    """Whether a line is `least` px long, and a share of `cover` of it visible."""
    return bool(extent(line) >= least and len(line) >= cover * np.max(abs(line[-1] - line[0])))


def _found(
    pieces: Fragments, label: np.ndarray, lines: Sequence[np.ndarray], good: np.ndarray, side: int
) -> Edges:
    """The good lines, and what they leave of the strong long pieces."""
    names = np.unique(label)
    lines = [line for line, keep in zip(lines, good, strict=True) if keep]
    last = pieces.start + pieces.count - 1
    length = np.hypot(*(pieces.points[last] - pieces.points[pieces.start]).T)
    strong = length >= _STRONG * side
    on = np.isin(label, names[good])
    total = float(length[strong].sum())
    left = float(length[strong & ~on].sum()) / total if total else 0.0
    return Edges(tuple(sorted(lines, key=extent, reverse=True)), left)


def _rms(lines: Sequence[np.ndarray], model: OneFrame) -> np.ndarray:
    """(l,), px of the image about the best line, of all lines at once."""
    if not lines:
        return np.zeros(0)
    return np.sqrt(np.mean(model.errors(samples_of(lines, 64)) ** 2, axis=1))
