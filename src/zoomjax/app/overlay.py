"""Detected lines drawn over their image, for checking."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import UInt8

from ..detect.sources import shrunk

_LONGEST = 2000
"""px of the longer side of the picture."""

_COLOURS = ((255, 200, 0), (0, 220, 255), (120, 255, 80), (255, 120, 220))  # blue, green, red
_REJECTED = (40, 40, 255)


def draw_lines(
    image: UInt8[np.ndarray, "height width *channels"],
    lines: Sequence[np.ndarray],
    rejected: Sequence[bool],
) -> UInt8[np.ndarray, "tall wide 3"]:
    """Draw lines over the dimmed image: neighbours in different colours, rejected lines dashed in red.

    Args:
        image: grey, or colour in the order blue, green, red.
        lines: points of each line, (n, 2) px, in order along the line.
        rejected: whether each line was rejected.

    Returns:
        At most 2000 px a side.
    """
    picture, scale = shrunk(image, _LONGEST)
    if picture.ndim == 2:
        picture = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)
    picture = (picture * 0.55).astype(np.uint8)
    width = max(1, round(max(picture.shape[:2]) / 900))
    across = sorted(range(len(lines)), key=lambda i: (_is_steep(lines[i]), *_place(lines[i])))
    for number, index in enumerate(across):
        line = (lines[index] + 0.5) * scale - 0.5
        if rejected[index]:
            for dash in np.array_split(line, max(2, len(line) // 8))[::2]:
                _draw(picture, dash, _REJECTED, 2 * width)
        else:
            _draw(picture, line, _COLOURS[number % len(_COLOURS)], width)
    return picture


def _draw(picture: np.ndarray, line: np.ndarray, colour: tuple[int, int, int], width: int) -> None:
    bits = 4
    cv2.polylines(
        picture, [np.rint(line * 2**bits).astype(np.int32)], False, colour, width, cv2.LINE_AA, bits
    )


def _is_steep(line: np.ndarray) -> bool:
    x, y = np.ptp(line, axis=0)
    return bool(y > x)


def _place(line: np.ndarray) -> tuple[float, ...]:
    """Sort key of a line among those of about its direction."""
    x, y = line.mean(axis=0)
    return (float(x),) if _is_steep(line) else (float(y),)
