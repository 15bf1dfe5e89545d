"""Products of float32 matrices with all their digits: GPUs otherwise multiply with 10 bits."""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

EXACT = jax.lax.Precision.HIGHEST


def exact_products(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """The function, in which products of matrices have all their digits unless they say otherwise.

    It holds while the function is called: of one that is compiled, for what it traces then.
    """

    @functools.wraps(function)
    def exact(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        with jax.default_matmul_precision("highest"):
            return function(*args, **kwargs)

    return exact
