"""Focal length from named lines of a football pitch of 105 m by 68 m, the size for international matches.

The names are those of the SoccerNet annotations. "Left" and "right" are the halves as the main camera sees
them, "top" is far from it and "bottom" near; "Big rect." is the penalty area, "Small rect." the goal area,
and "main" its side parallel to the goal line.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from .._core.checks import checked_size
from .._core.fields import refuse_masked
from .._core.types import AnyArray
from ._markings import find_markings
from .estimate import FocalEstimate, check_principal
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
        ValueError: none of the names is known, positions are not finite (n, 2) arrays, or `principal` is
            not one point.

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


def name_pitch_lines(
    lines: Sequence[ArrayLike], *, principal: Float[AnyArray, "2"], image_size: tuple[int, int]
) -> dict[str, np.ndarray]:
    """Find out which markings of a football pitch straight lines in one picture are.

    A search over the cameras that could see four of the lines as four of the markings. The camera stands
    upright, 2 to 80 m over the ground; lines need not be seen whole. From the far side of the pitch all
    looks as from the near one, so that names are those of the pitch turned by half a turn.

    Args:
        lines: corrected positions along each line, px, (n, 2), in any order; lines of other things are
            accepted while they are few.
        principal: the principal point, px; the centre of distortion is the usual choice.
        image_size: (width, height) px.

    Returns:
        For each name in `PITCH_LINES` that was found the positions on it, as `focal_from_pitch` takes them.
        It is empty if the lines are not clear: if they are fewer than four, or where cameras with
        other focal lengths explain them as well.

    Raises:
        ValueError: positions are not finite (n, 2) arrays, or `principal` is not one point.

    Example:
        >>> import numpy as np
        >>> from zoomjax.focal.pitch import PITCH_LINES
        >>> names, lines = [name for name in PITCH_LINES if "left" in name or name == "Side line top"], []
        >>> for name in names:
        ...     x, y = np.linspace(*PITCH_LINES[name], 9).T
        ...     seen = 2000 * np.stack([x + 40, 0.28 * y + 6], axis=-1) / (80 - 0.96 * y)[:, None] + 500
        ...     lines.append(seen[(seen.min(axis=1) > 0) & (seen.max(axis=1) < 999)])
        >>> named = name_pitch_lines(lines, principal=np.array([500.0, 500.0]), image_size=(1000, 1000))
        >>> sorted(named) == sorted(name for name, seen in zip(names, lines) if len(seen) > 1)
        True
    """
    refuse_masked("principal", principal)
    principal, size = np.asarray(principal, float), np.array(checked_size(image_size))
    check_principal(principal)
    unit = float(np.hypot(*size)) / 2
    points = [_positions(f"line {number}", line) for number, line in enumerate(lines)]
    points = [line for line in points if len(line) > 1 and np.ptp(line, axis=0).any()]
    if len(points) < 4:
        return {}
    segments = np.stack([_ends((line - principal) / unit) for line in points])
    found = find_markings(segments, np.array(list(PITCH_LINES.values())), size / 2 / unit)
    if found is None or not found.clear:
        return {}
    names = list(PITCH_LINES)
    return {
        names[index]: np.concatenate(
            [line for line, own in zip(points, found.marking, strict=True) if own == index]
        )
        for index in sorted(set(found.marking.tolist()) - {-1})
    }


def _ends(line: np.ndarray) -> np.ndarray:
    """The ends of the straight line nearest to points."""
    middle = line.mean(axis=0)
    direction = np.linalg.svd(line - middle, full_matrices=False)[2][0]
    along = (line - middle) @ direction
    return middle + np.array([[along.min()], [along.max()]]) * direction


def _positions(name: str, points: ArrayLike) -> np.ndarray:
    refuse_masked(name, points)
    try:
        positions: np.ndarray = np.asarray(points, float)
    except ValueError:  # rows of different lengths, or words
        positions = np.full(2, np.nan)
    positions = positions.reshape(-1, 2) if positions.size == 0 else positions
    if positions.ndim != 2 or positions.shape[1] != 2 or not np.isfinite(positions).all():
        raise ValueError(f"Positions on {name!r} must be a finite array (n, 2), but they are {points!r}.")
    return positions
