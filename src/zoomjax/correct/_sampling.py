"""An image at given positions: bilinear and bicubic, with derivatives written for their transposes.

The image is zero outside. Everything is written so that XLA, on a CPU, makes one loop of each gather and
what is done with it.
"""

import functools

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

_UNROLLED = 4
"""Channels up to which each gets code of its own."""


def _linear_weights(fraction):
    return [1 - fraction, fraction], [-jnp.ones_like(fraction), jnp.ones_like(fraction)]


def _cubic_weights(fraction):
    """Catmull-Rom's kernel at the four neighbours, and its derivative."""
    f = fraction
    weights = [
        ((-0.5 * f + 1) * f - 0.5) * f,
        (1.5 * f - 2.5) * f * f + 1,
        ((-1.5 * f + 2) * f + 0.5) * f,
        (0.5 * f - 0.5) * f * f,
    ]
    slopes = [
        (-1.5 * f + 2) * f - 0.5,
        (4.5 * f - 5) * f,
        (-4.5 * f + 4) * f + 0.5,
        (1.5 * f - 1) * f,
    ]
    return weights, slopes


KERNELS = {"linear": (_linear_weights, 0, 2), "cubic": (_cubic_weights, 1, 4)}
"""Weights and slopes, pixels before the position's own, and pixels in all."""


def _axis(position, length, interpolation):
    """Indices of the pixels to mix along one axis, their weights, and the weights' derivatives."""
    kernel, before, _ = KERNELS[interpolation]
    position = jnp.clip(position, -8, length + 8)
    first = jnp.floor(position)
    weights, slopes = kernel(position - first)
    indices = [first.astype(jnp.int32) + (tap - before) for tap in range(len(weights))]
    inside = [(index >= 0) & (index < length) for index in indices]
    return (
        [jnp.clip(index, 0, length - 1) for index in indices],
        [jnp.where(use, weight, 0) for use, weight in zip(inside, weights, strict=True)],
        [jnp.where(use, slope, 0) for use, slope in zip(inside, slopes, strict=True)],
    )


def mixes_border(x, y, size, interpolation):
    """Where pixels that a position gives a weight other than zero are not in the image."""
    kernel, before, _ = KERNELS[interpolation]
    mixes = False
    for position, length in zip((x, y), size, strict=True):
        position = jnp.clip(position, -8, length + 8)
        first = jnp.floor(position)
        for tap, weight in enumerate(kernel(position - first)[0]):
            index = first + (tap - before)
            mixes = mixes | ((weight != 0) & ((index < 0) | (index >= length)))
    return mixes


def _mix(image, columns, rows, wx, wy):
    """The weighted sum of pixels; `image` is (height, width) or (height, width, channels)."""
    spread = (lambda w: w[..., None]) if image.ndim == 3 else (lambda w: w)
    total = 0
    for row, weight in zip(rows, wy, strict=True):
        along = sum(
            spread(w) * image.at[row, column].get(mode="promise_in_bounds").astype(w.dtype)
            for column, w in zip(columns, wx, strict=True)
        )
        total = total + spread(weight) * along
    return total


@functools.partial(jax.custom_jvp, nondiff_argnums=(3,))
def sample(image, x, y, interpolation):
    """The image, zero outside, at positions (x, y)."""
    columns, wx, _ = _axis(x, image.shape[1], interpolation)
    rows, wy, _ = _axis(y, image.shape[0], interpolation)
    return _mix(image, columns, rows, wx, wy)


def _sample_jvp(interpolation, primals, tangents):
    """The tangent: the mix of the image's tangent, and the slopes of the kernel times those of x and y.

    Written for its transpose: the whole gradient takes two thirds, and that of the lens alone a third, of
    the time it takes with `_mix` for all three terms.
    """
    image, x, y = primals
    image_dot, *moves = tangents
    total = jnp.zeros((*x.shape, image.shape[2]), image.dtype)
    if not isinstance(image_dot, SymbolicZero):
        total = total + _mix_windows(image_dot, x, y, interpolation)
    if not all(isinstance(move, SymbolicZero) for move in moves):
        x_dot, y_dot = (
            jnp.zeros_like(x) if isinstance(move, SymbolicZero) else move.astype(x.dtype) for move in moves
        )
        total = total + _moved(image, x, y, x_dot, y_dot, interpolation).astype(image.dtype)
    return sample(image, x, y, interpolation), total


sample.defjvp(_sample_jvp, symbolic_zeros=True)


def _mix_windows(image, x, y, interpolation):
    """The samples, from windows of neighbours in a row, gathered whole.

    The same values as `sample`'s, slower; but the transpose adds whole windows, in half the time that it
    takes to add the pixels one by one.
    """
    height, width, channels = image.shape
    kernel, before, taps = KERNELS[interpolation]
    padded = jnp.pad(image, ((taps, taps), (taps, taps), (0, 0))).reshape(-1)
    first_x, first_y = jnp.floor(x), jnp.floor(y)
    wx, wy = kernel(x - first_x)[0], kernel(y - first_y)[0]
    column, row = (
        jnp.clip(first - before, -taps, length).astype(jnp.int32) + taps
        for first, length in ((first_x, width), (first_y, height))
    )
    window = jax.lax.GatherDimensionNumbers(offset_dims=(2,), collapsed_slice_dims=(), start_index_map=(0,))
    total = 0
    for tap, weight in enumerate(wy):
        start = ((row + tap) * (width + 2 * taps) + column) * channels
        pixels = jax.lax.gather(
            padded, start[..., None], window, (taps * channels,), mode="promise_in_bounds"
        ).reshape(*x.shape, taps, channels)
        weights = (jnp.stack(wx, axis=-1) * weight[..., None]).astype(image.dtype)
        total = total + jnp.sum(weights[..., None] * pixels, axis=2)
    return total


def _moved(image, x, y, x_dot, y_dot, interpolation):
    """What the samples change by when the positions move by (x_dot, y_dot).

    Per channel the real part of the conjugate move times the complex slope (d/dx, d/dy): so both slopes
    use each gathered pixel once, which is what lets XLA make one loop of it all, here and transposed.
    """
    columns, wx, sx = _axis(x, image.shape[1], interpolation)
    rows, wy, sy = _axis(y, image.shape[0], interpolation)
    move = computed_p.bind(jax.lax.complex(x_dot, y_dot), x[0, 0])
    several = image.shape[2] > _UNROLLED

    def spread(plane):
        return plane[..., None] if several else plane

    changes = []
    for channel in [slice(None)] if several else range(image.shape[2]):
        slope = 0
        for row, wr, sr in zip(rows, wy, sy, strict=True):
            for column, wc, sc in zip(columns, wx, sx, strict=True):
                pixel = image.at[row, column, channel].get(mode="promise_in_bounds").astype(move.dtype)
                slope = slope + spread(jax.lax.complex(sc * wr, wc * sr)) * pixel
        changes.append(jnp.real(spread(jnp.conj(move)) * slope))
    return changes[0] if several else jnp.stack(changes, axis=-1)


def _computed(values, finite):
    return jax.lax.cond(jnp.all(finite != jnp.inf), lambda z: z, lambda z: z + z, values)


computed_p = Primitive("computed")
"""Values as they are, computed before they are used: by a branch on a finite number, which XLA cannot know.

optimization_barrier does not last until XLA forms its loops on a CPU. A primitive, as a `jax.lax.cond` that
`vmap` has batched cannot be transposed.
"""

computed_p.def_impl(jax.jit(_computed))
computed_p.def_abstract_eval(lambda values, _: values)
mlir.register_lowering(computed_p, mlir.lower_fun(_computed, multiple_results=False))


def _computed_jvp(primals, tangents):
    values, finite = primals
    return computed_p.bind(values, finite), computed_p.bind(ad.instantiate_zeros(tangents[0]), finite)


ad.primitive_jvps[computed_p] = _computed_jvp
ad.primitive_transposes[computed_p] = lambda cotangent, _, finite: (
    None if type(cotangent) is ad.Zero else computed_p.bind(cotangent, finite),
    None,
)


batching.primitive_batchers[computed_p] = lambda arrays, axes: (computed_p.bind(*arrays), axes[0])
