"""Detected lines drawn over their image, for checking: coloured by how far from straight they are."""

import functools
from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from jaxtyping import UInt8

from ..detect.sources import shrunk

_LONGEST = 2000
"""px of the longer side of the picture."""

_SCALE = np.array([(255, 200, 0), (80, 230, 120), (0, 220, 255), (0, 120, 255)], float)
"""Colours of lines from the straightest to the least straight: blue, green, yellow, orange."""

_REJECTED = (40, 40, 255)

_APART = 16.0
"""px between points of the picture that are drawn: lines bend little, and each piece takes its time."""

_WHITE, _BLACK = (255, 255, 255), (0, 0, 0)


def for_picture(image: UInt8[np.ndarray, "..."], longest: int) -> tuple[UInt8[np.ndarray, "..."], float]:
    """As `shrunk`, faster where both sides can be divided by a whole number first.

    Means of whole pixels are quick; what is left to do, by less than half, needs none.
    """
    tall, wide = image.shape[:2]
    whole = next((by for by in range(max(tall, wide) // longest, 1, -1) if not (tall % by or wide % by)), 1)
    if whole == 1:
        return shrunk(image, longest)
    image = cv2.resize(image, (wide // whole, tall // whole), interpolation=cv2.INTER_AREA)
    scale = longest / max(image.shape[:2])
    return cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR), scale / whole


def draw_lines(
    image: UInt8[np.ndarray, "height width *channels"],
    lines: Sequence[np.ndarray],
    rejected: Sequence[bool],
    *,
    rms: Sequence[float] | np.ndarray = (),
    limit: float = 1.0,
    labels: Mapping[int, str] | None = None,
    legend: bool = False,
    dim: float = 0.55,
) -> UInt8[np.ndarray, "tall wide 3"]:
    """Draw lines over the dimmed image, coloured by their RMS distance, rejected lines dashed in red.

    Args:
        image: grey, or colour in the order blue, green, red.
        lines: points of each line, (n, 2) px, in order along the line.
        rejected: whether each line was rejected.
        rms: of each line, px; by default all have the first colour.
        limit: the RMS, px, from which on a line has the last colour.
        labels: text near the middle of lines, by their places in `lines`; three after another are apart.
        legend: whether to explain the colours below the picture.
        dim: brightness of the image.

    Returns:
        At most 2000 px a side, and the legend.
    """
    picture, scale = for_picture(image, _LONGEST)
    if picture.ndim == 2:
        picture = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)
    picture = cv2.LUT(np.ascontiguousarray(picture[..., :3]), (np.arange(256) * dim).astype(np.uint8))
    width = max(1, round(max(picture.shape[:2]) / 1200))
    shown = [(line + 0.5) * scale - 0.5 for line in lines]
    for index, line in enumerate(shown):
        if rejected[index]:
            for dash in _dashes(line):
                _draw(picture, dash, _REJECTED, width + 1)
        else:
            _draw(picture, line, colour(rms[index] / limit if len(rms) and limit > 0 else 0.0), width)
    for order, (index, text) in enumerate((labels or {}).items()):
        _write(picture, text, shown[index], (3 + order % 3) / 8)
    return np.vstack([picture, _legend(picture.shape[1], limit)]) if legend else picture


def colour(share: float) -> tuple[int, int, int]:
    """Blue, green, red of a line whose RMS is a share of the limit."""
    at = float(np.clip(np.nan_to_num(share), 0, 1)) * (len(_SCALE) - 1)
    channels = [np.interp(at, np.arange(len(_SCALE)), channel) for channel in _SCALE.T]
    return (round(channels[0]), round(channels[1]), round(channels[2]))


def _draw(picture: np.ndarray, line: np.ndarray, colour: tuple[int, int, int], width: int) -> None:
    bits = 4
    points = np.rint(np.clip(_thinned(line), -1e4, 1e4) * 2**bits).astype(np.int32)
    cv2.polylines(picture, [points], False, colour, width, cv2.LINE_AA, bits)


def _thinned(line: np.ndarray) -> np.ndarray:
    """Its ends, and of the points between them some that are apart."""
    if len(line) < 3:
        return line
    steps = np.hypot(*np.diff(line, axis=0).T)
    kept = np.diff(np.cumsum(steps) // _APART, prepend=0.0) > 0
    return line[np.concatenate([[True], kept[:-1], [True]])]


def _dashes(line: np.ndarray) -> Sequence[np.ndarray]:
    """Pieces of a line, all as long as the gaps between them, from end to end."""
    if len(line) < 2:
        return [line]
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))
    number = max(1, round(along[-1] / (2 * _APART)))
    ends = np.linspace(0, along[-1], 2 * number)
    return list(np.stack([np.interp(ends, along, side) for side in line.T], axis=1).reshape(number, 2, 2))


def _write(picture: np.ndarray, text: str, line: np.ndarray, share: float) -> None:
    """Text in a dark outline at a share of a line's length, within the picture."""
    if len(line) == 0:
        return
    size = float(np.clip(max(picture.shape[:2]) / 1600, 0.42, 1.2))
    (wide, tall), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
    x, y = line[int(share * len(line))]
    at = (
        int(np.clip(x - wide / 2, 2, max(picture.shape[1] - wide - 2, 2))),
        int(np.clip(y + tall / 2, tall + 2, max(picture.shape[0] - 2, tall + 2))),
    )
    for ink, thickness in ((_BLACK, 3), (_WHITE, 1)):
        cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, ink, thickness, cv2.LINE_AA)


@functools.lru_cache(maxsize=4)
def _legend(wide: int, limit: float) -> np.ndarray:
    """A strip that explains the colours; photos of one size share it."""
    size = float(np.clip(wide / 1600, 0.4, 1.0))
    tall = round(44 * size)
    strip = np.full((tall, wide, 3), 32, np.uint8)
    bar = wide // 5
    for x in range(bar):
        strip[tall // 4 : -tall // 4, tall // 3 + x] = colour(x / max(bar - 1, 1))
    at = tall // 3 + bar + 10
    for words, ink in (
        (f"0 to {limit:.2g} px RMS from straight; numbers: rows of lines.npz; ", _WHITE),
        ("red dashes: rejected", _REJECTED),
    ):
        place = (at, round(tall * 0.68))
        cv2.putText(strip, words, place, cv2.FONT_HERSHEY_SIMPLEX, size * 0.8, ink, 1, cv2.LINE_AA)
        at += cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, size * 0.8, 1)[0][0]
    return strip
