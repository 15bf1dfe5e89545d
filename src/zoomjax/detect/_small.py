"""Lines of one image as a few bytes, to be sent: whole steps, as files of lines hold them."""

import io
from typing import Any

import numpy as np

from .._core.steps import packed, unpacked


def small(lines: tuple[np.ndarray, ...]) -> bytes:
    """The points of all lines, exactly."""
    points = np.concatenate(lines) if lines else np.zeros((0, 2))
    steps = packed(points)
    held: dict[str, Any] = {"points": points} if steps is None else steps
    content = io.BytesIO()
    counts = np.array([len(line) for line in lines], np.int32)
    np.savez_compressed(content, counts=counts, **held)
    return content.getvalue()


def of_small(content: bytes) -> tuple[np.ndarray, ...]:
    """The lines that `small` took."""
    with np.load(io.BytesIO(content), allow_pickle=False) as stored:
        points = unpacked(stored["steps"], stored["step"]) if "steps" in stored else stored["points"]
        counts = stored["counts"]
    return tuple(np.split(points, np.cumsum(counts)[:-1])) if counts.size else ()
