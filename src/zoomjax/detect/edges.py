"""Detection of straight edges, such as the borders of stripes and squares.

As in the paper's first experiment, sub-pixel edges (`_edge_points`) are linked into smooth pieces
(`_segments`), and pieces of one border are joined by arcs (`_joining`). Then the distortion of the frame is
estimated from the longest borders (`_frame_model`). In the corrected image every border is a straight line,
and all pieces that lie on it are added. This is done twice. The two edges of a stripe are separate lines.
"""

import cv2
import numpy as np

from ._edge_points import edge_points
from ._frame_model import OneFrame, normals
from ._joining import border_lines, joined
from ._segments import Fragments, fragments
from .base import AbstractDetector

_LONG = 0.2
"""Share of the image's shorter side that a border must extend over to inform the frame's distortion."""

_LEAST_LINES = 3
"""Number of long borders needed to estimate the distortion of a frame."""

_ENOUGH = 100
"""Number of points that represent a line."""

_LEAST_TOLERANCE = 0.5
_GREATEST_TOLERANCE = 2.0
"""px, bounds of the distance at which a piece is still on a border: three times the borders' RMS."""


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
        grey = as_grey(image)
        size = (grey.shape[1], grey.shape[0])
        pieces = fragments(edge_points(grey))
        model = OneFrame(size)
        border = joined(pieces, model.scale)
        least = _LONG * min(size)
        tolerance = _GREATEST_TOLERANCE
        for _ in range(2):
            long = [line for line in border_lines(pieces, border) if _extent(line) >= least]
            if len(long) < _LEAST_LINES:
                break
            model.fit(long)
            rms = np.median([_rms(model.undistort(_few(line))) for line in long])
            tolerance = float(np.clip(3 * rms, _LEAST_TOLERANCE, _GREATEST_TOLERANCE))
            border = _absorbed(pieces, border, model, tolerance)
        return self._good(border_lines(pieces, border), model, tolerance, min(size))

    def _good(self, lines, model: OneFrame, tolerance: float, side: int) -> list[np.ndarray]:
        """The lines that are long, visible and straight enough, the longest first."""
        kept = []
        for line in lines:
            extent = _extent(line)
            if extent < self.least_length * side or len(line) < self.least_cover * _steps(line):
                continue
            if _rms(model.undistort(_few(line))) <= 2 * tolerance:
                kept.append((extent, line))
        kept.sort(key=lambda entry: -entry[0])
        return [line for _, line in kept]


def as_grey(image: np.ndarray) -> np.ndarray:
    """The grey levels of an image.

    Raises:
        ValueError: it is not (height, width[, 3]) bytes, or smaller than 32 px a side.
    """
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


def _absorbed(pieces: Fragments, border: np.ndarray, model: OneFrame, tolerance: float) -> np.ndarray:
    """The border of each piece, after the borders, the longest first, took all pieces that lie on them."""
    corrected = model.undistort(pieces.points)
    ends = corrected[pieces.start], corrected[pieces.start + pieces.count - 1]
    label = border[pieces.piece()]
    order = np.argsort(label, kind="stable")
    names, start = np.unique(label[order], return_index=True)
    groups = np.split(corrected[order], start[1:])
    groups = [_few(group) for group in groups]
    lengths = [np.hypot(*np.ptp(group, axis=0)) for group in groups]
    result = np.full(len(border), -1)
    for number, index in enumerate(np.argsort(lengths)[::-1]):
        group = groups[index]
        free = result < 0
        if not free[border == names[index]].any():
            continue
        mean = group.mean(axis=0)
        normal = normals((group - mean)[None])[0]
        on = free & np.all([abs((end - mean) @ normal) < tolerance for end in ends], axis=0)
        if _is_smooth(group - mean, normal, tolerance):  # bent more than a line may be, but one border
            on |= free & (border == names[index])
        result[on] = number
    return np.where(result < 0, result.max() + 1 + border, result)


def _is_smooth(centred: np.ndarray, normal: np.ndarray, tolerance: float) -> bool:
    """Whether points follow a cubic along a line about as well as a line may be followed."""
    along, across = centred @ (normal[1], -normal[0]), centred @ normal
    powers = np.vander(along / max(np.ptp(along), 1e-9), 4)
    rest = across - powers @ np.linalg.lstsq(powers, across, rcond=None)[0]
    return float(np.sqrt(np.mean(rest**2))) < tolerance / 2


def _few(points: np.ndarray) -> np.ndarray:
    """Enough of a line's points, spread over it, to tell how it runs and how rough it is."""
    if len(points) <= _ENOUGH:
        return points
    return points[np.linspace(0, len(points) - 1, _ENOUGH).round().astype(int)]


def _extent(line: np.ndarray) -> float:
    """px from the first point to the last."""
    return float(np.hypot(*(line[-1] - line[0])))


def _steps(line: np.ndarray) -> float:
    """Rows or columns from end to end, whichever are more: a border has a point in each."""
    return float(np.max(abs(line[-1] - line[0])))


def _rms(line: np.ndarray) -> float:
    """px about the best line."""
    centred = line - line.mean(axis=0)
    return float(np.sqrt(np.mean((centred @ normals(centred[None])[0]) ** 2)))
