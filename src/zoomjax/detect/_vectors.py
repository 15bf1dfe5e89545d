"""Vectors of the plane, (..., 2), by the hundred thousand: NumPy's sums over so short an axis are slow."""

import numpy as np


def dot(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(...), scalar products."""
    return first[..., 0] * second[..., 0] + first[..., 1] * second[..., 1]


def cross(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(...), how much of the second is to the left of the first, times both lengths."""
    return first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]


def norm(vectors: np.ndarray) -> np.ndarray:
    """(...), lengths; of what is no larger than an image, which `np.hypot` need not keep from overflow."""
    return np.sqrt(dot(vectors, vectors))
