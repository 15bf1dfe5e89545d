"""Focal length from named lines of a football pitch of 105 m by 68 m, the size for international matches.

The names are those of the SoccerNet annotations. "Left" and "right" are the halves as the main camera sees
them, "top" is far from it and "bottom" near; "Big rect." is the penalty area, "Small rect." the goal area,
and "main" its side parallel to the goal line.
"""

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from .._core.types import AnyArray
from .estimate import FocalEstimate
from .plane import focal_from_lines

_LENGTH, _WIDTH = 105.0, 68.0
"""Of the pitch, m: what FIFA's tournaments use. Law 1 allows 100 to 110 by 64 to 75; the rest is fixed."""

_GOAL = 7.32
_AREAS = {"Big": 16.5, "Small": 5.5}
"""How far the two areas reach into the pitch, and to both sides of the goal, m."""


def _pitch_lines() -> dict[str, tuple[tuple[float, float], tuple[float, float]]]:
    x, y = _LENGTH / 2, _WIDTH / 2
    lines = {
        "Side line top": ((-x, -y), (x, -y)),
        "Side line bottom": ((-x, y), (x, y)),
        "Side line left": ((-x, -y), (-x, y)),
        "Side line right": ((x, -y), (x, y)),
        "Middle line": ((0.0, -y), (0.0, y)),
    }
    for area, reach in _AREAS.items():
        for half, side in (("left", -1), ("right", 1)):
            goal, main, half_width = side * x, side * (x - reach), _GOAL / 2 + reach
            lines[f"{area} rect. {half} main"] = ((main, -half_width), (main, half_width))
            lines[f"{area} rect. {half} top"] = ((goal, -half_width), (main, -half_width))
            lines[f"{area} rect. {half} bottom"] = ((goal, half_width), (main, half_width))
    return lines


PITCH_LINES: Mapping[str, tuple[tuple[float, float], tuple[float, float]]] = MappingProxyType(
    _pitch_lines()
)
"""The straight lines on the ground and their end points (x, y), m, from the middle of the pitch: x to the
right and y towards the camera. Markings are up to 0.12 m wide; areas are measured to their outer edges."""


def focal_from_pitch(
    annotations: Mapping[str, ArrayLike], *, principal: Float[AnyArray, "2"]
) -> FocalEstimate:
    """Estimate the focal length from one picture of a football pitch with named lines.

    Args:
        annotations: for each name corrected positions in the image, px, (n, 2), anywhere on that line.
            Names that are not in `PITCH_LINES` are ignored: curves, posts, crossbars.
        principal: the principal point, px; the centre of distortion is the usual choice.

    Returns:
        The focal length in px, as from `focal_from_lines`: NaN from too few lines. The standard deviation
        includes neither errors of the size of the pitch nor of the principal point.

    Raises:
        ValueError: none of the names is known, or positions are not finite (n, 2) arrays.

    Example:
        >>> import numpy as np
        >>> from zoomjax.focal.pitch import PITCH_LINES
        >>> annotations = {}
        >>> for name in ("Side line top", "Side line left", "Big rect. left main", "Big rect. left top"):
        ...     x, y = np.linspace(*PITCH_LINES[name], 4).T
        ...     depth = 80 - 0.96 * y
        ...     annotations[name] = 3000 * np.stack([x + 30, 0.28 * y], axis=-1) / depth[:, None]
        >>> print(f"{focal_from_pitch(annotations, principal=np.zeros(2)).focal:.1f}")
        3000.0
    """
    used = {name: _positions(name, annotations[name]) for name in PITCH_LINES if name in annotations}
    if not used:
        raise ValueError(
            "Argument annotations must have names of straight lines of the pitch, but they are "
            f"{', '.join(map(repr, annotations)) or 'none'}. Known are {', '.join(map(repr, PITCH_LINES))}."
        )
    # All lines and a power of 2 of points each: for pictures alike, one compilation.
    most = max(4, *(len(points) for points in used.values()))
    points = np.zeros((len(PITCH_LINES), 1 << (most - 1).bit_length(), 2))
    mask = np.zeros(points.shape[:2], bool)
    for row, name in enumerate(PITCH_LINES):
        number = len(used.get(name, ()))
        points[row, :number] = used.get(name, 0)
        mask[row, :number] = True
    return focal_from_lines(points, np.array(list(PITCH_LINES.values())), principal=principal, mask=mask)


def _positions(name: str, points: ArrayLike) -> np.ndarray:
    try:
        positions: np.ndarray = np.asarray(points, float)
    except ValueError:  # rows of different lengths, or words
        positions = np.full(2, np.nan)
    positions = positions.reshape(-1, 2) if positions.size == 0 else positions
    if positions.ndim != 2 or positions.shape[1] != 2 or not np.isfinite(positions).all():
        raise ValueError(f"Positions on {name!r} must be a finite array (n, 2), but they are {points!r}.")
    return positions
