"""The closed vocabulary of array types and axis names used in every signature.

Axes: ``line`` lines of the data set, ``point`` points of a line, ``frame`` images, ``terms``
distortion coefficients (N of eq. 2), ``rows`` rows of a line's (possibly compressed) design,
``basis`` functions of the focal length, ``parameter`` unknowns of a fit.
"""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax
import numpy as np
from jax.core import Tracer, eval_context
from jaxtyping import ArrayLike, Bool, Float, Int, Num, PyTree

AnyArray = jax.Array | np.ndarray
"""A JAX array, or a NumPy array where JAX cannot hold the values as given (float64, x64 off)."""

Scalar = Float[AnyArray, ""]
Point = Float[AnyArray, "2"]
Centres = Float[AnyArray, "2"] | Float[AnyArray, "frame 2"]
Points = Num[AnyArray, "*batch 2"] | list | tuple
FocalLike = Num[ArrayLike, "..."] | list | tuple
Coefficients = Float[AnyArray, "terms"]
Elements = Float[AnyArray, "terms ..."]
"""Coefficients of many distortions, element by element: ``k[0]`` is k1 of all of them."""
Mask = Bool[AnyArray, "line point"]
FrameIndex = Int[AnyArray, "line"]
LineNumber = Int[AnyArray, "line"]
LineWeight = Float[AnyArray, "line"]
Focal = Float[AnyArray, "frame"]
Focus = Float[AnyArray, "frame"]


def traced(tree: PyTree) -> bool:
    """Whether values in the tree are not known yet, being inside ``jit``, ``vmap`` or ``grad``."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


_Given = ParamSpec("_Given")
_Result = TypeVar("_Result")


def of_known_values(function: Callable[_Given, _Result]) -> Callable[_Given, _Result]:
    """A function that decides by the values of its arguments, which ``jit`` and ``grad`` do not know.

    Inside of them it works where its arguments are known nevertheless (closed over): computed at once, as
    outside, while other operations on known arrays are traced there.

    Raises:
        ValueError: values are not known.
    """

    @functools.wraps(function)
    def at_once(*args: _Given.args, **kwargs: _Given.kwargs) -> _Result:
        if traced((args, kwargs)):
            raise ValueError(
                f"Arguments of {function.__name__} must have known values, because its control flow "
                "depends on them, but some are traced: call it outside of jit, vmap and grad."
            )
        with eval_context():  # ensure_compile_time_eval fails inside of an eager `shard_map`
            return function(*args, **kwargs)

    return at_once
