"""Weights of lines as they are given, and the frames that count by them.

In NumPy where it can be: of what JAX does once, most is compiling.
"""

from typing import Any

import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Bool, Float

from ..lines.base import AbstractLines
from ..lines.lines import Lines
from ..lines.triangles import AbstractTriangles
from .problem import data_of


def own_weights(lines: AbstractLines) -> Float[np.ndarray, "line"]:
    """The weight of each line; 0 for those of too few points to count."""
    own = np.ones(lines.frame.shape) if lines.weight is None else np.asarray(lines.weight, float)
    return np.where(counts_of(lines) > 2, own, 0)


def counts_of(lines: AbstractLines) -> Float[np.ndarray, "line"]:
    """Numbers of points."""
    inside = data_of(lines)
    if isinstance(inside, Lines):
        return np.asarray(inside.mask).sum(axis=1).astype(float)
    if not isinstance(inside, AbstractTriangles):
        return np.asarray(inside.counts)
    return np.round(np.asarray(inside.triangle)[:, 0, 0].astype(float) ** 2)


def frames_that_count(lines: AbstractLines) -> Bool[np.ndarray, "frame"] | None:
    """The frames of which a line counts: of three points or more, and of a weight above 0.

    None where all do, or none, or nobody can tell here and now.
    """
    if not all(map(_here, jax.tree.leaves(lines))):
        return None
    counted = np.zeros(len(lines.focal), bool)
    counted[np.asarray(lines.frame)[own_weights(lines) > 0]] = True
    return None if counted.all() or not counted.any() else counted


def _here(array: Any) -> bool:
    """Whether values are known in this process: not being traced, and not on another machine."""
    return not isinstance(array, jax.Array) or (
        not isinstance(array, Tracer) and array.is_fully_addressable
    )
