"""Numbers spread over points together, so that their derivatives are summed together.

A few numbers act on many points, and their gradient is a sum over the points for each of them. Where each
is broadcast by itself, XLA sums each by itself, and first writes what it sums to memory. `spread`
broadcasts them in one operation, whose transpose is one pass over the points for all sums.
"""

import itertools
import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

Shape = tuple[Any, ...]  # of integers, or of symbols for `jax.export`

_BLOCK = 1024
"""Numbers summed one by one; the sums of blocks are then summed, so that float32 keeps its digits."""


def spread(arrays: Sequence[Any], shape: Shape) -> list[Any]:
    """The arrays, each of as many axes as `shape`, broadcast to it; NumPy's by NumPy."""
    if any(isinstance(array, jax.Array) for array in arrays):
        return spread_p.bind(*map(jnp.asarray, arrays), shape=shape)
    return [np.broadcast_to(array, shape) for array in arrays]


def _spread(*arrays, shape):
    return [jnp.broadcast_to(array, shape) for array in arrays]


def _summed(*arrays, shapes):
    """Each array summed over the axes along which its shape is 1; those of equal shapes in one pass."""
    sums: list[Any] = [None] * len(arrays)
    by_shape = sorted(range(len(arrays)), key=lambda index: str(shapes[index]))
    for _, group in itertools.groupby(by_shape, key=lambda index: str(shapes[index])):
        indices = list(group)
        found = _sums([arrays[index] for index in indices], shapes[indices[0]])
        for index, total in zip(indices, found, strict=True):
            sums[index] = total
    return sums


def _sums(arrays, shape):
    full = arrays[0].shape
    axes = [axis for axis, (one, size) in enumerate(zip(shape, full, strict=True)) if one != size]
    if not axes:
        return arrays
    kept = [axis for axis in range(len(full)) if axis not in axes]
    lead = [full[axis] for axis in kept]
    number = math.prod(full[axis] for axis in axes)
    rows = [jnp.transpose(array, (*kept, *axes)).reshape(*lead, number) for array in arrays]
    if _in_blocks(number):
        missing = -number % _BLOCK
        blocks = (*lead, (number + missing) // _BLOCK, _BLOCK)
        rows = _sums_of_rows(
            [jnp.pad(row, [(0, 0)] * len(lead) + [(0, missing)]).reshape(blocks) for row in rows]
        )
    return [total.reshape(shape) for total in _sums_of_rows(rows)]


def _in_blocks(number):
    """Not of several devices: points may lie on all of them, and blocks would cross the borders."""
    return isinstance(number, int) and number > _BLOCK and jax.device_count() == 1


def _sums_of_rows(arrays):
    zeros = [np.zeros((), array.dtype) for array in arrays]
    added = jax.lax.reduce(
        arrays, zeros, lambda a, b: [x + y for x, y in zip(a, b, strict=True)], [arrays[0].ndim - 1]
    )
    return list(added)


def _transposed_spread(cotangents, *arrays, shape):
    del shape
    wanted = [
        index
        for index, (cotangent, array) in enumerate(zip(cotangents, arrays, strict=True))
        if ad.is_undefined_primal(array) and type(cotangent) is not ad.Zero
    ]
    if not wanted:
        return [None] * len(arrays)
    shapes = tuple(arrays[index].aval.shape for index in wanted)
    sums = summed_p.bind(*(cotangents[index] for index in wanted), shapes=shapes)
    found = dict(zip(wanted, sums, strict=True))
    return [found.get(index) for index in range(len(arrays))]


def _transposed_summed(cotangents, *arrays, shapes):
    del shapes
    shape = arrays[0].aval.shape
    return spread_p.bind(*map(ad.instantiate_zeros, cotangents), shape=shape)


def _linear(primitive):
    """Its own derivative."""

    def rule(primals, tangents, **parameters):
        tangents = primitive.bind(*map(ad.instantiate_zeros, tangents), **parameters)
        return primitive.bind(*primals, **parameters), tangents

    return rule


def _length(arrays, axes):
    """Of the axis along which some of the arrays are batched."""
    return next(array.shape[axis] for array, axis in zip(arrays, axes, strict=True) if axis is not None)


def _batched_spread(arrays, axes, *, shape):
    number = _length(arrays, axes)
    first = [
        array[None] if axis is None else jnp.moveaxis(array, axis, 0)
        for array, axis in zip(arrays, axes, strict=True)
    ]
    return spread_p.bind(*first, shape=(number, *shape)), [0] * len(arrays)


def _batched_summed(arrays, axes, *, shapes):
    number = _length(arrays, axes)
    first = [
        jnp.broadcast_to(array, (number, *array.shape)) if axis is None else jnp.moveaxis(array, axis, 0)
        for array, axis in zip(arrays, axes, strict=True)
    ]
    shapes = tuple((number, *shape) for shape in shapes)
    return summed_p.bind(*first, shapes=shapes), [0] * len(arrays)


def _primitive(name, function, transposed, batched):
    primitive = Primitive(name)
    primitive.multiple_results = True
    primitive.def_impl(lambda *arrays, **given: jax.jit(partial(function, **given))(*arrays))
    mlir.register_lowering(primitive, mlir.lower_fun(function, multiple_results=True))
    ad.primitive_jvps[primitive] = _linear(primitive)
    ad.primitive_transposes[primitive] = transposed
    batching.primitive_batchers[primitive] = batched
    return primitive


spread_p = _primitive("spread", _spread, _transposed_spread, _batched_spread)
summed_p = _primitive("summed", _summed, _transposed_summed, _batched_summed)


@spread_p.def_abstract_eval
def _(*arrays, shape):
    return [array.update(shape=shape) for array in arrays]


@summed_p.def_abstract_eval
def _(*arrays, shapes):
    return [array.update(shape=shape) for array, shape in zip(arrays, shapes, strict=True)]
