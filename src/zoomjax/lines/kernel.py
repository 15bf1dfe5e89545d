"""The reduction of lines on an NVIDIA GPU, by a kernel that keeps columns in registers.

XLA writes the columns of all points to memory, and reads them again for each column that is done. Here a
warp holds the columns of some hundred points, orthogonalises them as `reduction` does, and writes their
triangle: points are read once. The triangles of a line are rows then, that are reduced in the same way
until one is left.
"""

import re
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas
from jaxtyping import Array, Bool, Float

from .reduction import inverse_norm, tangent_of

triton: Any
try:
    from jax.experimental.pallas import triton
except ImportError:  # JAX 0.12 says that a later one will not have it
    triton = None

_RUN = 256
"""Points that a warp holds: 8 a thread. Twice as many columns of them would not fit into its registers."""

_MOST_TERMS = 3
_LEAST_CAPABILITY = 8.0
"""Compute capability of the first GPUs that Triton, by which Pallas compiles for them, supports."""


def has_kernel(terms: int) -> bool:
    """Whether there is a kernel for so many terms on JAX's default device."""
    capability = getattr(jax.devices()[0], "compute_capability", "")
    known = re.fullmatch(r"\d+\.\d+", str(capability)) and float(capability) >= _LEAST_CAPABILITY
    # Before JAX 0.7 these were called differently. Without Triton there are none.
    return (
        bool(known)
        and terms <= _MOST_TERMS
        and hasattr(triton, "CompilerParams")
        and hasattr(triton, "load")
    )


@partial(jax.custom_jvp, nondiff_argnums=(3, 4))
def triangles(
    points: Float[Array, "line point 2"],
    mask: Bool[Array, "line point"],
    centre: Float[Array, "2"],
    scale: float,
    terms: int,
) -> Float[Array, "line rows rows"]:
    """R of the columns ``[1, z, r^2 z, ..., r^(2N) z]`` of each line, ``z = (point - centre) / scale``.

    On a CPU the kernel is interpreted, for tests.
    """
    numbers = jnp.append(centre, 1 / scale).astype(points.dtype)
    coordinates = [pallas.BlockSpec((None, _RUN, None), partial(_block, last=c)) for c in range(2)]
    specs = [*coordinates, pallas.BlockSpec((None, _RUN), _block), pallas.BlockSpec((3,), lambda *_: (0,))]
    operands = (points, points, mask.astype(jnp.int8), numbers)
    found = _launch(partial(_reduce_points, terms=terms), operands, specs, mask.shape, _RUN, 2 * terms + 3)
    while found.shape[1] > 1:
        found = _merged(found)
    return found[:, 0]


@triangles.defjvp
def _triangles_jvp(scale, terms, primals, tangents):
    (points, mask, centre), (points_dot, _, centre_dot) = primals, tangents

    def tangent(r, points, there, points_dot):
        def columns(points, centre):
            z = jnp.where(there[:, None], points - centre[None], 0) / scale
            return jnp.stack(_radial(z[:, 0], z[:, 1], there.astype(z.dtype), terms))

        return tangent_of(r, *jax.jvp(columns, (points, centre), (points_dot, centre_dot)))

    r = triangles(points, mask, centre, scale, terms)
    return r, jax.vmap(tangent)(r, points, mask, points_dot)


def _merged(found):
    """Fewer triangles of each line, of as many rows of these as a warp holds."""
    lines, runs, size, _ = found.shape
    rows = found.reshape(lines, runs * size, size)
    run = min(_RUN, pallas.next_power_of_2(runs * size))
    specs = [pallas.BlockSpec((None, run, None), partial(_block, last=c)) for c in range(size)]
    return _launch(_reduce_rows, [rows] * size, specs, rows.shape[:2], run, size)


def _launch(kernel, operands, specs, shape, run, size):
    """A triangle for each run of the points or rows of each line."""
    lines, number = shape
    runs = -(-number // run)
    return pallas.pallas_call(
        partial(kernel, number=number, run=run),
        out_shape=jax.ShapeDtypeStruct((lines, runs, size, size), operands[0].dtype),
        grid=(lines, runs),
        in_specs=specs,
        out_specs=pallas.BlockSpec((None, None, size, size), lambda line, run: (line, run, 0, 0)),
        interpret=jax.default_backend() == "cpu",
        compiler_params=triton.CompilerParams(num_warps=1, num_stages=1),
    )(*operands)


def _block(line, run, *, last=None):
    return (line, run) if last is None else (line, run, last)


def _reduce_points(x, y, mask, numbers, out, *, number, run, terms):
    """The triangle of a run of points."""
    there = (triton.load(mask, mask=_inside(number, run), other=0) != 0) & _inside(number, run)

    def normalised(coordinates, axis):
        offset = triton.load(coordinates, mask=there, other=0) - numbers[axis]
        return jnp.where(there, offset * numbers[2], 0)

    one = jnp.where(there, jnp.ones((), x.dtype), jnp.zeros((), x.dtype))
    _orthogonalise(_radial(normalised(x, 0), normalised(y, 1), one, terms), out)


def _reduce_rows(*columns_and_out, number, run):
    """The triangle of a run of rows, which are triangles of other runs."""
    *columns, out = columns_and_out
    _orthogonalise([triton.load(column, mask=_inside(number, run), other=0) for column in columns], out)


def _inside(number, run):
    """Which of a run there are: the last one of a line is not full."""
    return pallas.program_id(1) * run + jax.lax.broadcasted_iota(jnp.int32, (run,), 0) < number


def _radial(x, y, valid, terms):
    """The columns, each an array of its own."""
    squared = x * x + y * y
    columns = [valid, x, y]
    for _ in range(terms):
        columns += [columns[-2] * squared, columns[-1] * squared]
    return columns


def _orthogonalise(columns, out):
    """Modified Gram-Schmidt, as in `reduction`, on numbers and not on small arrays, which kernels lack."""
    size, zero = len(columns), jnp.zeros((), columns[0].dtype)
    removed = [zero] * size
    for done in range(size):
        first, *rest = columns
        products = [jnp.sum(first * column) for column in columns]
        inverse = inverse_norm(products[0], removed[0])
        row = [product * inverse for product in products]
        for place, value in enumerate([zero] * done + row):
            out[done, place] = value
        removed = [old + value * value for old, value in zip(removed[1:], row[1:], strict=True)]
        columns = [column - value * inverse * first for column, value in zip(rest, row[1:], strict=True)]
