"""Points that are whole steps of 1/1024 px, as detectors give them: a tenth of the space, no digit lost.

Neighbours on a line are some px apart, so that differences are small, and their bytes, put in planes of
equal weight, are mostly zeros or alike: what deflate is good at.
"""

from typing import Any

import numpy as np

STEP = 1 / 1024
"""px. Its rounding is far below the noise of any detector."""

_MOST = 2**30
"""Steps: a million px, on either side."""


def packed(points: np.ndarray) -> dict[str, Any] | None:
    """Points (n, 2) as arrays for a compressed file; None if they are not whole steps."""
    steps = np.asarray(points, np.float64) / STEP
    if not (np.abs(steps) < _MOST).all() or (steps != np.rint(steps)).any():
        return None
    moved = np.diff(steps.astype(np.int32), axis=0, prepend=np.zeros((1, 2), np.int32))
    planes = np.ascontiguousarray(moved.T).astype("<i4").view(np.uint8).reshape(2, len(points), 4)
    return {"steps": np.ascontiguousarray(planes.transpose(0, 2, 1)), "step": np.array(STEP, points.dtype)}


def unpacked(steps: np.ndarray, step: np.ndarray) -> np.ndarray:
    """The points that `packed` took, in their dtype.

    Raises:
        ValueError: the arrays are of other shapes or dtypes.
    """
    if steps.ndim != 3 or steps.shape[:2] != (2, 4) or steps.dtype != np.uint8:
        raise ValueError("its points are no table of numbers")
    if step.shape != () or step.dtype not in (np.float32, np.float64) or step != STEP:
        raise ValueError("its points are steps of a length that is not known")
    moved = np.ascontiguousarray(steps.transpose(0, 2, 1)).view("<i4")[..., 0]
    return (np.cumsum(moved, axis=1, dtype=np.int64).T * STEP).astype(step.dtype)
