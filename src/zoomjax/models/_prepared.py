"""What zoom models have in common when they are made ready for focal lengths."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core.arrays import as_jax
from .._core.checks import checked_integer
from .._core.types import Focal, traced
from .zoom import UNFITTED, check_distinct


def checked_number(number):
    return None if number is None else checked_integer("number", number, 1)


def check_knots(what: str, focal: Focal, number: int | None) -> None:
    if not traced(focal):
        check_distinct(what, focal, number or 1)


def zero_parameters(rows: int, terms: int, dtype: np.dtype) -> Float[Array, "rows terms"]:
    return as_jax(np.zeros((rows, terms), dtype))


def shortest(focal: Focal) -> Float[Array, ""]:
    """The shortest focal length: where they are known by NumPy, which compiles nothing."""
    return jnp.min(focal) if traced(focal) else as_jax(np.asarray(focal).min())


def prepared(value):
    if value is None:
        raise ValueError(UNFITTED)
    return value
