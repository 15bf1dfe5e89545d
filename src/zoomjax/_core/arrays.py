"""One formula for NumPy and JAX: the namespace to take operations from, and ranks made equal.

And what is done with arrays in several rooms.
"""

import contextlib
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .types import traced


def namespace(*values: Any) -> Any:
    """``jax.numpy`` if one of the arguments is a JAX array, traced or not; else ``numpy``."""
    return jnp if any(isinstance(value, jax.Array) for value in values) else np


def as_array(value: Any) -> Any:
    """Numbers as an array of floating dtype; what is one, or stands for one, as it is."""
    if isinstance(value, (list, tuple, float, int, np.generic)):
        value = np.asarray(value)
    if isinstance(value, (np.ndarray, jax.Array)) and not jnp.issubdtype(value.dtype, jnp.inexact):
        value = value.astype(float)
    return value


def mixes_booleans(values: Any) -> bool:
    """Whether lists hold booleans among numbers, of which NumPy makes numbers."""
    if not isinstance(values, list | tuple):
        return False
    return len({isinstance(leaf, bool | np.bool_) for leaf in jax.tree.leaves(values)}) > 1


def aligned(*parts: tuple[Any, int]) -> list[Any]:
    """Arrays with as many leading axes of length 1 as make them broadcast without a change of rank.

    Args:
        parts: each an array, and how many of its last axes are its own and do not take part.
    """
    rank = max(array.ndim - own for array, own in parts)
    return [
        namespace(array).reshape(array, (*[1] * (rank + own - array.ndim), *array.shape))
        for array, own in parts
    ]


def native(array: np.ndarray) -> np.ndarray:
    """The same values in this machine's order of bytes, which OpenCV takes for granted."""
    return array.astype(array.dtype.newbyteorder("="), copy=False)


def numeric(array: np.ndarray) -> np.ndarray:
    """As `native`; long doubles, which JAX does not have, as doubles."""
    return array.astype(float) if array.dtype.char == "g" else native(array)


def held_as_given(array: np.ndarray) -> Any:
    """A JAX array, unless that would change the values' dtype."""
    array = native(array)
    if jax.dtypes.canonicalize_dtype(array.dtype) == array.dtype:
        return jax.device_put(array)  # without a program, as jnp.asarray would compile for each shape
    return array


def as_jax(values: Any) -> jax.Array:
    """A JAX array of these numbers, by no program: `jnp.asarray` compiles one for each shape of NumPy's."""
    return values if isinstance(values, jax.Array) else jax.device_put(values)


def widest(on: bool = True) -> contextlib.AbstractContextManager:
    """JAX's widest type, or not, in this thread: as `jax_enable_x64`, for a while."""
    switch: Any = jax  # before 0.8 it is in jax.experimental
    return switch.enable_x64(on) if hasattr(switch, "enable_x64") else switch.experimental.enable_x64(on)


def in_float64(function: Callable[..., Any], *given: Any) -> Any:
    """What a function gives of arrays that are known, computed in float64, in the widest of their dtypes.

    For what float32 has no room for, as products of derivatives that are nearly alike. Of arrays that are
    traced, or in other processes, too, it is computed in their own dtype.
    """
    own = [leaf.dtype for leaf in jax.tree.leaves(given) if _is_real(leaf)]
    # Without x64 JAX computes with arrays of NumPy in float32, whatever theirs is.
    dtype = jax.dtypes.canonicalize_dtype(np.result_type(*own) if own else float)
    if dtype == np.float64 or traced(given) or not all(map(_is_addressable, jax.tree.leaves(given))):
        return function(*given)
    with widest():
        result = function(*(_cast(one, np.dtype(float)) for one in given))
        result = jax.tree.map(np.asarray, result)
    return jax.tree.map(jnp.asarray, _cast(result, dtype))


def _is_addressable(leaf: Any) -> bool:
    return not isinstance(leaf, jax.Array) or leaf.is_fully_addressable


def _is_real(leaf: Any) -> bool:
    return hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jnp.floating)


def _cast(tree: Any, dtype: np.dtype) -> Any:
    return jax.tree.map(lambda leaf: np.asarray(leaf, dtype) if _is_real(leaf) else leaf, tree)


def finite(values: Any) -> Any:
    """Whether each of the values is finite, as an array even of one."""
    xp = namespace(values)
    return xp.asarray(xp.isfinite(values))


def together(x: Any, y: Any) -> Any:
    """Points (x, y) from their coordinates.

    Formulas take points apart by ``z[..., 0]`` and put them together by this, and do not multiply ``z`` by
    ``factor[..., None]``: XLA can then make one loop of it all, and of its gradient by the points.
    """
    return namespace(x, y).stack([x, y], axis=-1)


def interleaved(x: Any, y: Any) -> Any:
    """As `together`, in half the time on a CPU: one loop over all numbers, which picks x or y by its index.

    For results that are not differentiated through: its transpose would be sums over pairs.
    """
    if namespace(x, y) is np:
        return together(x, y)
    return jnp.where(jnp.arange(2) == 0, x[..., None], y[..., None])


def apart(values: Any) -> tuple[Any, ...]:
    """The elements along the first axis; derivatives by them are not padded, as by ``values[0]``."""
    return tuple(jnp.unstack(values) if isinstance(values, jax.Array) else values)


def once(values: Any) -> Any:
    """Arrays as they are, computed once: XLA would compute them anew wherever they are used.

    For what is expensive and used for both coordinates of a point.
    """
    return jax.lax.optimization_barrier(values) if namespace(*jax.tree.leaves(values)) is jnp else values


_BLOCK = 2**16
"""Elements: few enough for a processor's cache, and enough for all of its cores."""


def in_blocks(function: Callable[..., Any], values: Any, *others: Any) -> Any:
    """``function(values, *others)`` element by element, one block of the elements after another on a CPU.

    Memory is then needed for the loops of one block, and each block's loops end when its own elements are
    done. Not where there are several devices: arrays that are sharded would be gathered.

    Args:
        function: of arrays that broadcast; its result has the shape and dtype of the first.
        values: the elements.
        others: arrays whose last axes broadcast with those of the elements; they may have more before.
    """
    shape = values.shape
    number = math.prod(shape) if all(isinstance(length, int) for length in shape) else 0
    if number <= _BLOCK or jax.device_count() > 1:
        return function(values, *others)

    def flat(array):
        own = array.shape[: max(array.ndim - len(shape), 0)]
        alike = all(length == 1 for length in array.shape[len(own) :])
        wanted = (1,) * len(shape) if alike else shape
        return jnp.broadcast_to(array, (*own, *wanted)).reshape(*own, -1)

    def blocks():
        cut = jax.lax.dynamic_slice_in_dim
        operands = [flat(array) for array in (values, *others)]

        def one(index, done):
            start = jnp.minimum(index * _BLOCK, number - _BLOCK)
            parts = (
                cut(array, start, _BLOCK, axis=-1) if array.shape[-1] > 1 else array for array in operands
            )
            return jax.lax.dynamic_update_slice_in_dim(done, function(*parts), start, axis=-1)

        return jax.lax.fori_loop(0, -(-number // _BLOCK), one, 0 * operands[0]).reshape(shape)

    return jax.lax.platform_dependent(cpu=blocks, default=lambda: function(values, *others))


def places(count: np.ndarray) -> np.ndarray:
    """0, 1, 2, ... for the members of each group, one group after the other; `count` is of the groups."""
    return np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
