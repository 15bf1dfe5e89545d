"""Correction of images in JAX, differentiable with respect to the image and the lens.

Each output pixel shows the distorted position of a corrected point, and mixes the 2 x 2 (bilinear) or 4 x 4
(bicubic) pixels around it. Positions are those of `Distortion.distort`, from Newton's method on all pixels
together, started close. Their derivative is the implicit function theorem's, because the last step is
differentiated at the solution.

Everything is written so that XLA, on a CPU, makes one loop of each gather and what is done with it.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, DTypeLike, Float, Num

from .._core.products import EXACT
from ..models.distortion import Distortion
from ..models.family import AbstractRadial
from ..models.sizes import check_channels_last, check_image_size, checked_distortion
from .framing import Framing, check_framing

_TOLERANCE = 1e-3
"""px: the last Newton step where the iteration has arrived; the error left is of the order of
its square."""

_DEGREE = 10
"""Of the polynomial that starts Newton's method: for photographic lenses one step from it is enough."""

_UNROLLED = 4
"""Channels up to which each gets code of its own."""

_OFF = -16384.0
"""A position, px, that is off any image."""


def warp_image(
    image: Num[Array, "height width *channels"],
    distortion: Distortion,
    *,
    framing: Framing | None = None,
    interpolation: str = "linear",
    border_value: float | int = 0,
) -> Num[Array, "out_height out_width *channels"]:
    """Correct an image, differentiably with respect to the image and the distortion.

    ``jax.vmap`` it over images, distortions or both.

    Args:
        image: grey, or with channels last. Integers are computed in float32, rounded and clipped.
        distortion: the distortion of this image, in its pixels. May be traced.
        framing: the part to show (`frame_output`); by default the geometry of the input.
        interpolation: "linear", or "cubic" (Catmull-Rom's kernel, a = -0.5; OpenCV's has a = -0.75).
        border_value: value outside of the image, and where the distortion has no inverse, which is beyond
            the fold of a lens (see `Distortion.has_inverse`).

    Returns:
        An image of the same dtype and channels.

    Raises:
        ValueError: the image has no pixels, or its channels first; `interpolation` is unknown; the
            distortion is not a `Distortion`, or is for images of another size (not checked under ``jit`` or
            ``vmap``); or the framing was made for images of another size.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> d = Distortion(jnp.array([0.1]), jnp.array([2.5, 1.5]), jnp.array(3.6))
        >>> image = jnp.linspace(0, 1, 24).reshape(4, 6)
        >>> jax.grad(lambda d: warp_image(image, d).sum())(d).coefficients.shape
        (1,)
    """
    if image.ndim < 2 or 0 in image.shape:
        raise ValueError(
            f"Argument image must have shape (height, width, ...) with pixels, but it is {image.shape}."
        )
    if image.dtype == bool:
        raise ValueError("Argument image must hold numbers, but its dtype is bool: image.astype(float).")
    if interpolation not in _KERNELS:
        raise ValueError(
            f'Argument interpolation must be "linear" or "cubic", but it is {interpolation!r}.'
        )
    check_channels_last(image.shape)
    height, width = image.shape[:2]
    checked_distortion(distortion)
    if framing is not None:
        check_framing(framing, (width, height), "framing")
    if framing is None or framing.image_size is not None:
        check_image_size(distortion, (width, height))
    return _warped(image, distortion, framing, interpolation, border_value)


@eqx.filter_jit
def _warped(image, distortion, framing, interpolation, border_value):
    height, width = image.shape[:2]
    values = image if jnp.issubdtype(image.dtype, jnp.floating) else image.astype(jnp.float32)
    if framing is None:
        framing = Framing(jnp.ones(()), jnp.zeros(2), (width, height))
    x, y = sample_positions(distortion, framing, jnp.promote_types(values.dtype, jnp.float32))
    flat = values.reshape(height, width, -1)
    result = border_value + _sample(flat - border_value, x, y, interpolation).astype(values.dtype)
    result = result.reshape(*x.shape, *image.shape[2:])
    return result if values is image else _rounded(result, image.dtype)


def sample_positions(
    distortion: Distortion, framing: Framing, dtype: DTypeLike
) -> tuple[Float[Array, "height width"], Float[Array, "height width"]]:
    """`Distortion.distort` of the points that a framing shows, px; far off the image without inverse.

    Newton's method on the ratio q of the radii, ``q L(τ q²) = 1`` for squared corrected radii τ: started
    from a polynomial, iterated together until it has arrived on a sample of radii, and a last time for the
    derivative.
    """
    family = distortion.family
    if not isinstance(family, AbstractRadial):
        return _exact_positions(distortion, framing, dtype)
    k, centre, scale, origin, zoom = (
        jnp.asarray(leaf, dtype)
        for leaf in (
            distortion.coefficients,
            distortion.centre,
            distortion.scale,
            framing.origin,
            framing.scale,
        )
    )
    width, height = framing.size
    x = ((origin[0] + jnp.arange(width, dtype=dtype) / zoom) - centre[0]) / scale
    y = ((origin[1] + jnp.arange(height, dtype=dtype) / zoom) - centre[1]) / scale
    squared = x[None, :] ** 2 + y[:, None] ** 2
    fixed = jax.lax.stop_gradient((k, squared, scale))
    ratio, seen = _arrived_ratio(family, *fixed)
    squared = jnp.where(seen, squared, 0)
    value, slope = _equation(family, ratio, squared, k)
    ratio = ratio - value / jax.lax.stop_gradient(slope)
    return (
        jnp.where(seen, centre[0] + scale * x[None, :] * ratio, _OFF),
        jnp.where(seen, centre[1] + scale * y[:, None] * ratio, _OFF),
    )


def _exact_positions(distortion, framing, dtype):
    """The same by a separate inverse for each pixel, for distortion models that are not radial."""
    width, height = framing.size
    pixels = jnp.stack(jnp.meshgrid(jnp.arange(width), jnp.arange(height)), axis=-1).astype(dtype)
    positions = distortion.distort(
        jnp.broadcast_to(jnp.asarray(framing.origin, dtype), pixels.shape)
        + pixels / jnp.asarray(framing.scale, dtype)
    )
    positions = jnp.where(jnp.isnan(positions), _OFF, positions)
    return positions[..., 0], positions[..., 1]


def _equation(family, q, squared, k):
    """``q L(τ q²) - 1`` and its derivative with respect to q, kept off zero."""
    value, slope = family.equation(q, squared * q * q, 1, k)
    return value, jnp.maximum(slope, jnp.finfo(slope.dtype).eps)


def _arrived_ratio(family, k, squared, scale):
    """The ratio q, at most one Newton step from its solution, and which τ have one."""
    limit = family.limit(k)
    farthest = jnp.sqrt(jnp.max(squared))
    reach = family.reach(k, limit)
    end = jnp.minimum(farthest, reach)
    top = end * family.ratio(end * end, k, limit)[0]
    # Exact pairs of radii, and the least-squares polynomial through them, in Chebyshev's basis.
    r = top * jnp.sin(jnp.linspace(0, jnp.pi / 2, 65, dtype=k.dtype)[1:])
    rho = r * family.factor(r * r, k)
    v = 2 * (rho / rho[-1]) ** 2 - 1
    angle = jnp.arccos(jnp.clip(v, -1, 1))
    design = jnp.cos(jnp.outer(angle, jnp.arange(_DEGREE + 1, dtype=k.dtype)))
    q, triangle = jnp.linalg.qr(design * rho[:, None])
    powers = jax.scipy.linalg.solve_triangular(triangle, jnp.matmul(q.T, r, precision=EXACT))
    bound = rho[-1] ** 2

    def start(squared):
        return _chebyshev(powers, jnp.clip(2 * squared / bound - 1, -1, 1))

    def step(q, squared):
        value, slope = _equation(family, q, squared, k)
        return q - value / slope

    def unfinished(state):
        _, probe, count = state
        move = jnp.max(jnp.abs(step(probe, rho * rho) - probe) * rho) * scale
        return (move > _TOLERANCE) & (count < 40)

    def improve(state):
        ratio, probe, count = state
        return step(ratio, squared), step(probe, rho * rho), count + 1

    state = (start(squared), start(rho * rho), 0)
    seen = squared <= reach * reach
    ratio = jnp.where(seen, jax.lax.while_loop(unfinished, improve, state)[0], 1)
    # What has arrived on the sample may not have between: where the next step is long, the safe method. As
    # a loop, so that also under vmap it costs nothing where no pixel needs it.
    move = jnp.abs(step(ratio, squared) - ratio) * jnp.sqrt(squared) * scale
    late = seen & ~(move <= _TOLERANCE)

    def replaced(state):
        exact, found = family.ratio(jnp.where(late, squared, 0), k, limit)
        return jnp.where(late, jnp.where(found, exact, jnp.nan), state[0]), False

    ratio, _ = jax.lax.while_loop(lambda state: state[1], replaced, (ratio, jnp.any(late)))
    seen = seen & jnp.isfinite(ratio)
    return jnp.where(seen, ratio, 1), seen


def _chebyshev(coefficients, v):
    """Clenshaw's sum."""
    first = second = jnp.zeros_like(v)
    for coefficient in coefficients[:0:-1]:
        first, second = coefficient + 2 * v * first - second, first
    return coefficients[0] + v * first - second


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


_KERNELS = {"linear": (_linear_weights, 0, 2), "cubic": (_cubic_weights, 1, 4)}
"""Weights and slopes, pixels before the position's own, and pixels in all."""


def _axis(position, length, interpolation):
    """Indices of the pixels to mix along one axis, their weights, and the weights' derivatives."""
    kernel, before, _ = _KERNELS[interpolation]
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


def _mix(image, columns, rows, wx, wy):
    """The weighted sum of pixels; `image` is (height, width) or (height, width, channels)."""
    spread = (lambda w: w[..., None]) if image.ndim == 3 else (lambda w: w)
    total = 0
    for row, weight in zip(rows, wy, strict=True):
        along = sum(
            spread(w) * image.at[row, column].get(mode="promise_in_bounds")
            for column, w in zip(columns, wx, strict=True)
        )
        total = total + spread(weight) * along
    return total


@functools.partial(jax.custom_jvp, nondiff_argnums=(3,))
def _sample(image, x, y, interpolation):
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
    return _sample(image, x, y, interpolation), total


_sample.defjvp(_sample_jvp, symbolic_zeros=True)


def _mix_windows(image, x, y, interpolation):
    """The samples, from windows of neighbours in a row, gathered whole.

    The same values as `_sample`'s, slower; but the transpose adds whole windows, in half the time that it
    takes to add the pixels one by one.
    """
    height, width, channels = image.shape
    kernel, before, taps = _KERNELS[interpolation]
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
    # Computed before it is used: optimization_barrier does not last until XLA forms its loops on a CPU.
    move = jax.lax.cond(x[0, 0] != jnp.inf, lambda z: z, jnp.zeros_like, jax.lax.complex(x_dot, y_dot))
    several = image.shape[2] > _UNROLLED

    def spread(plane):
        return plane[..., None] if several else plane

    changes = []
    for channel in [slice(None)] if several else range(image.shape[2]):
        slope = 0
        for row, wr, sr in zip(rows, wy, sy, strict=True):
            for column, wc, sc in zip(columns, wx, sx, strict=True):
                pixel = image.at[row, column, channel].get(mode="promise_in_bounds").astype(x.dtype)
                slope = slope + spread(jax.lax.complex(sc * wr, wc * sr)) * pixel
        changes.append(jnp.real(spread(jnp.conj(move)) * slope))
    return changes[0] if several else jnp.stack(changes, axis=-1)


def _rounded(values, dtype):
    """Floating values as integers of a dtype."""
    limits = jnp.iinfo(dtype)
    return jnp.clip(jnp.round(values), limits.min, limits.max).astype(dtype)
