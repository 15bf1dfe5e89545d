"""Detection of the white markings of a pitch: the straight lines in broadcast football.

First the grass is found (`_grass`), then the middles of white ridges on it (`_ridge_points`). These are
linked into smooth pieces (`_segments`), and the pieces of one marking are joined across players
(`_joining`). Circles on a pitch are ellipses in the image, and their flattest parts are almost straight. So
curves that bend more than lens distortion can explain are rejected.
"""

import numpy as np
from jaxtyping import UInt8

from ._frame_model import normals
from ._grass import Grass, find_grass
from ._joining import border_lines, joined
from ._ridge_points import WIDEST, ridge_points
from ._segments import fragments
from .base import AbstractDetector
from .edges import as_grey

_LEAST_RADIUS = 5.0
"""Of the arc that a lens may bend a line to, in halves of the image's diagonal: k1 = 0.1 makes it 10 for a
line halfway between the middle of the image and a corner. Where a whole penalty area is in sight, the
flattest part of its arc has 1 to 2."""

_CROOKED = 1.5
"""px, RMS about the best parabola, that a line of joined pieces may have."""

_BESIDE = 3
"""px beyond the side of the widest marking, where the grass beside a line is looked at."""

_LEAST_COVER = 0.4
"""Share of a line that must be visible."""


class PitchDetector(AbstractDetector):
    """Detects the straight white markings on the grass of a pitch, in colour images of broadcast football.

    Points are in the middle of the markings, which may be up to 2 % of the image's shorter side
    wide. Circles and arcs, players, goals, boards and captions are left out; a marking interrupted by a
    player is one line. Thresholds adapt to the grass of each image.

    Attributes:
        least_length: share of the image's diagonal that a line must extend over, 0 to 1.

    Example:
        >>> import cv2
        >>> import numpy as np
        >>> image = np.full((360, 640, 3), (50, 140, 70), np.uint8)
        >>> image = cv2.line(image, (40, 60), (600, 290), (230, 240, 235), 3, cv2.LINE_AA)
        >>> image = cv2.ellipse(image, (250, 230), (120, 60), 0, 0, 360, (230, 240, 235), 3, cv2.LINE_AA)
        >>> lines = PitchDetector()(image)
        >>> len(lines), lines[0].shape[1]
        (1, 2)
    """

    least_length: float = 0.06

    def __check_init__(self):
        """Check that it is a share."""
        if not 0 <= self.least_length <= 1:
            raise ValueError(f"Argument least_length must be 0 to 1, but it is {self.least_length}.")

    def __call__(self, image: UInt8[np.ndarray, "height width *channels"]) -> list[np.ndarray]:
        """Detect markings with sub-pixel points in their middle, the longest line first.

        Args:
            image: (height, width, 3), uint8 BGR, at least 32 px a side.

        Returns:
            For each line an (n, 2) array of ``(x, y)``, px, in order along the line; none without grass.

        Raises:
            ValueError: the image is not such an array, or not in colour.
        """
        _check(image)
        grass = find_grass(image)
        if grass is None:
            return []
        half_diagonal = np.hypot(*image.shape[:2]) / 2
        radius = _LEAST_RADIUS * half_diagonal
        pieces = fragments(ridge_points(image, grass))
        lines = border_lines(pieces, joined(pieces, radius))
        lengths = [np.hypot(*(line[-1] - line[0])) for line in lines]
        longest_first = [lines[index] for index in np.argsort(lengths)[::-1]]
        long = longest_first[: np.sum(lengths >= 2 * half_diagonal * self.least_length)]
        return [line for line in long if _is_line(line, radius) and _bounds_field(line, image, grass)]


def _check(image) -> None:
    """Check that this is an image in colour."""
    as_grey(image)
    if image.ndim != 3:
        raise ValueError(
            "Argument image must be a colour image (height, width, 3), blue, green, red, as grass is found "
            f"by its colour, but its shape is {image.shape}."
        )


def _is_line(points: np.ndarray, radius: float) -> bool:
    """Whether points follow an arc of at least that radius, px, without too large gaps."""
    centred = points - points.mean(axis=0)
    normal = normals(centred[None])[0]
    along, across = centred @ (normal[1], -normal[0]), centred @ normal
    powers = np.vander(along / np.ptp(along), 3)
    bend = np.linalg.lstsq(powers, across, rcond=None)[0]
    rms = np.sqrt(np.mean((across - powers @ bend) ** 2))
    steps = np.max(abs(points[-1] - points[0]))  # a marking has a point in each row or column
    flat = abs(bend[0]) * 2 * radius <= np.ptp(along) ** 2
    return bool(flat and rms <= _CROOKED and len(points) >= _LEAST_COVER * steps)


def _bounds_field(points: np.ndarray, image: np.ndarray, grass: Grass) -> bool:
    """Whether the field of play is beside most points: what is behind a goal is no marking."""
    away = WIDEST * min(image.shape[:2]) / 2 + _BESIDE
    along = (points[-1] - points[0]) / np.hypot(*(points[-1] - points[0]))
    aside = away * np.array([-along[1], along[0]])
    greatest = np.subtract(image.shape[1::-1], 1)
    sides = [np.clip(np.rint(points + offset).astype(int), 0, greatest) for offset in (aside, -aside)]
    field = [grass.is_field(image[side[:, 1], side[:, 0]]) for side in sides]
    return bool(np.mean(field[0] | field[1]) > 0.5)
