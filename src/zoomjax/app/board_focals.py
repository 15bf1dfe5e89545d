"""The focal length of a board that is parallel to the sensor, at a known distance (eq. 14)."""

import dataclasses
import math
from collections.abc import Collection, Sequence

import jax.numpy as jnp
import numpy as np

from ..detect.batch import Detection
from ..focal.board import focal_from_board
from ..focal.estimate import FocalEstimate
from ..models.distortion import Distortion
from .plane_focals import nodes

NOT_THE_BOARD = (
    "no evenly spaced lines of a board were found in it, or they are not spaced alike in both directions "
    "(then give both: --spacing ACROSSxDOWN)"
)
"""Why an image may have no focal length."""

_EVEN = 0.1
"""Largest RMS distance of lines of a board from even spacing, in steps."""

_DISAGREE = 3e-3
"""Relative difference allowed between a board's two directions, if more than three deviations."""


@dataclasses.dataclass(frozen=True)
class Board:
    """A board parallel to the sensor.

    Attributes:
        spacing: mm between neighbouring lines on it, across and down: from one edge of a stripe to the next
            one, or from corner to corner, or from dot to dot.
        distance: mm from the camera's projection plane to it.
        pixel_pitch: mm, side of a pixel on the sensor.
    """

    spacing: tuple[float, float]
    distance: float
    pixel_pitch: float


_SHORTEST = 0.1
"""Focal length over the sensor's diagonal: half of the least that lenses have."""

_LARGEST = 5.0
"""Size of a board's image on the sensor over its own, beyond macro lenses."""


def check_board(board: Board, focal: Collection[float], image_size: tuple[int, int]) -> None:
    """Refuse focal lengths that no lens has: a length of the board is in another unit.

    Raises:
        ValueError: the angle of view is beyond that of any lens, or the board is far larger on the sensor
            than it is.
    """
    if not focal:
        return
    shortest, longest = min(focal), max(focal)
    share = shortest / board.pixel_pitch / math.hypot(*image_size)
    if share < _SHORTEST or longest > _LARGEST / (1 + _LARGEST) * board.distance:
        raise ValueError(
            f"By the board f is {shortest:.3g} to {longest:.3g} mm, which cannot be. Check --spacing, "
            f"--distance and --pixel-pitch: they are {board.spacing[0]:g} mm, {board.distance:g} mm and "
            f"{board.pixel_pitch:g} mm."
        )


def focal_of_board(board: Board, detection: Detection, correction: Distortion) -> FocalEstimate | None:
    """The focal length of one image, mm; None if it shows no board, or its directions disagree."""
    spacing = np.array(board.spacing)
    known = nodes(detection, correction)
    if known is not None:
        points, places = known
        parts = [(points, spacing * places)]
    else:
        corrected = [np.asarray(correction.undistort(line)) for line in detection.lines]
        parts = [(points, spacing * places) for points, places in _parallels(corrected)]
    found = [
        focal_from_board(points, places, distance=board.distance, pixel_pitch=board.pixel_pitch)
        for points, places in parts
    ]
    return _combined(found)


def _combined(found: Sequence[FocalEstimate]) -> FocalEstimate | None:
    """The weighted mean of estimates; None if there are none, or if they disagree."""
    if not found:
        return None
    focal, std, rms = (
        np.array([float(getattr(f, name)) for f in found]) for name in ("focal", "std", "rms")
    )
    weight = 1 / np.maximum(std, 1e-12) ** 2
    mean = weight @ focal / weight.sum()
    if np.any(abs(focal - mean) > np.maximum(3 * std, _DISAGREE * mean)):
        return None
    return FocalEstimate(jnp.asarray(mean), jnp.asarray(weight.sum() ** -0.5), jnp.asarray(rms.max()))


def _parallels(lines: Sequence[np.ndarray]) -> list[tuple[np.ndarray, np.ndarray]]:
    """For each direction of a board, the positions of its lines, px, and their numbers on the board.

    Both are (n, 2), on the x axis for vertical and on the y axis for horizontal lines, as
    `focal_from_board` takes them. A direction whose lines are not evenly spaced is left out.
    """
    middle = np.array([line.mean(axis=0) for line in lines])
    along = np.array([line[-1] - line[0] for line in lines])
    twice = 2 * np.arctan2(along[:, 1], along[:, 0])
    # Multiplying the angle by 4 in all makes both directions of a board one.
    main = np.angle(np.sum(np.hypot(*along.T) * np.exp(2j * twice))) / 4
    result = []
    for direction in (main, main + np.pi / 2):
        chosen = np.cos(twice - 2 * direction) > 0.9
        normal = np.array([-np.sin(direction), np.cos(direction)])
        counted = _counted(np.sort(middle[chosen] @ normal))
        if counted is not None:
            axis = np.eye(2)[int(np.argmax(abs(normal)))]
            result.append(tuple(values[:, None] * axis for values in counted))
    return result


def _counted(position: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Positions of evenly spaced lines, in order, and their numbers; None if they are not evenly spaced.

    Some lines may be missing, and some may be in two pieces.
    """
    if len(position) < 3:
        return None
    usual = float(np.median(np.diff(position)))
    position = position[np.append(True, np.diff(position) > 0.2 * usual)]
    if len(position) < 3 or usual < 1:
        return None
    step, index = float(np.median(np.diff(position))), np.zeros(len(position))
    for number in range(1, len(position)):  # the estimate of the step improves with each line
        index[number] = index[number - 1] + np.rint((position[number] - position[number - 1]) / step)
        if number > 3:
            step = float(np.polyfit(index[: number + 1], position[: number + 1], 1)[0])
    rest = position - np.polyval(np.polyfit(index, position, 1), index)
    return (position, index) if np.sqrt(np.mean(rest**2)) < _EVEN * step else None
