"""Correction of images in JAX, differentiable with respect to the image and the lens.

Each output pixel shows the distorted position of a corrected point, and mixes the 2 x 2 (bilinear) or 4 x 4
(bicubic) pixels around it. Positions are those of `Distortion.distort`, from Newton's method on all pixels
together, started close. Their derivatives, of any order, are the implicit function theorem's.

Everything is written so that XLA, on a CPU, makes one loop of each gather and what is done with it
(`_sampling`).
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Float, Num, ScalarLike

from .._core.fields import refuse_masked_image
from .._core.products import EXACT
from .._core.types import traced
from ..models.distortion import Distortion
from ..models.distortion_model import AbstractRadial
from ..models.sizes import check_channels_last, check_image_size, check_one_image, checked_distortion
from ._sampling import KERNELS, computed_p, mixes_border, sample
from .framing import Framing, check_framing

_TOLERANCE = 1e-3
"""px: the last Newton step where the iteration has arrived; the error left is of the order of
its square."""

_DEGREE = 10
"""Of the polynomial that starts Newton's method: for photographic lenses one step from it is enough."""

_OFF = -16384.0
"""A position, px, that is off any image."""


def warp_image(
    image: Num[Array, "height width *channels"],
    distortion: Distortion,
    *,
    framing: Framing | None = None,
    interpolation: str = "linear",
    border_value: ScalarLike = 0,
) -> Num[Array, "out_height out_width *channels"]:
    """Correct an image, differentiably with respect to the image and the distortion.

    ``jax.vmap`` it over images, distortions or both.

    Args:
        image: grey, or with channels last. Integers are computed in float32, rounded and clipped.
        distortion: the distortion of this image, in its pixels. May be traced.
        framing: the part to show (`frame_output`); by default the geometry of the input.
        interpolation: "linear", or "cubic" (Catmull-Rom's kernel, a = -0.5; OpenCV's has a = -0.75).
        border_value: value outside of the image, and where the distortion has no inverse, which is beyond
            the fold of a lens (see `Distortion.has_inverse`). Pixels at the border mix it in: with NaN
            they are NaN, and no others.

    Returns:
        An image of the same dtype and channels.

    Raises:
        ValueError: the image is no array, has no pixels or its channels first, or is several;
            `interpolation` is unknown; the border
            value is not one number, or none of the image's dtype; the distortion is not a `Distortion`, or
            is for images of another size (checked under ``jit`` where it is the ``lens(focal)`` of a lens);
            or the framing was made for images of another size.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> d = Distortion(jnp.array([0.1]), jnp.array([2.5, 1.5]), jnp.array(3.6))
        >>> image = jnp.linspace(0, 1, 24).reshape(4, 6)
        >>> jax.grad(lambda d: warp_image(image, d).sum())(d).coefficients.shape
        (1,)
    """
    refuse_masked_image("image", image)
    if not isinstance(image, np.ndarray | jax.Array):
        raise ValueError(
            f"Argument image must be an array, but it is a {type(image).__name__}: jnp.asarray(image)."
        )
    if isinstance(image, np.ndarray) and image.dtype.kind in "fiu" and image.dtype.char != "g":
        given = np.asarray(image, image.dtype.newbyteorder("="))  # JAX takes no other order of bytes
        image = jnp.asarray(given)
        _check_kept(given, image.dtype)
    if image.ndim < 2 or 0 in image.shape:
        raise ValueError(
            f"Argument image must have shape (height, width, ...) with pixels, but it is {image.shape}."
        )
    real = jnp.issubdtype(image.dtype, jnp.integer) or jnp.issubdtype(image.dtype, jnp.floating)
    if not real or image.dtype.kind == "m" or image.dtype.char == "g":
        raise ValueError(
            f"Argument image must hold real numbers, but its dtype is {image.dtype}: image.astype(float)."
        )
    if interpolation not in KERNELS:
        raise ValueError(
            f'Argument interpolation must be "linear" or "cubic", but it is {interpolation!r}.'
        )
    check_channels_last(image.shape)
    check_one_image(image.shape, "jax.vmap over the first axis, and channels last")
    _check_border(border_value, image.dtype)
    height, width = image.shape[:2]
    checked_distortion(distortion)
    if framing is not None:
        check_framing(framing, (width, height), "framing")
        if framing.size[0] * framing.size[1] > _MOST_PIXELS:  # XLA ends the process where numbers overflow
            raise ValueError(
                f"Argument framing must show an image that fits into memory, but it is {framing.size} px."
            )
    if framing is None or framing.image_size is not None:
        check_image_size(distortion, (width, height))
    return _warped(image, distortion, framing, interpolation, border_value)


def _check_kept(image, dtype):
    """Raise ValueError where JAX, without float64, cuts integers of 64 bits to others."""
    if image.dtype.itemsize == dtype.itemsize or image.dtype.kind == "f" or not image.size:
        return
    limits = np.iinfo(dtype)
    if image.min() < limits.min or image.max() > limits.max:
        raise ValueError(
            f"Argument image holds integers beyond those of {dtype}, which JAX makes of them without "
            "float64: image.astype(float)."
        )


def _check_border(value, dtype):
    """Raise ValueError where it is not one number, or known and none of an image's integers."""
    kind = getattr(value, "dtype", type(value))
    if np.ndim(value) != 0 or not any(jnp.issubdtype(kind, real) for real in (jnp.floating, jnp.integer)):
        raise ValueError(f"Argument border_value must be one number, but it is {value!r}.")
    if jnp.issubdtype(dtype, jnp.integer) and not traced(value):
        limits = jnp.iinfo(dtype)
        if not limits.min <= float(value) <= limits.max:
            raise ValueError(f"Argument border_value must be a value of {dtype}, but it is {value!r}.")


_MOST_PIXELS = 2**36

_LARGE = 1000
"""Border values beyond which pixels that do not mix the border in are sampled without it."""


@eqx.filter_jit
def _warped(image, distortion, framing, interpolation, border_value):
    height, width = image.shape[:2]
    values = image if jnp.issubdtype(image.dtype, jnp.floating) else image.astype(jnp.float32)
    if framing is None:
        framing = Framing(jnp.ones(()), jnp.zeros(2), (width, height))
    x, y = sample_positions(distortion, framing, np.promote_types(values.dtype, np.float32))
    flat = values.reshape(height, width, -1)
    border = jnp.asarray(border_value, values.dtype)
    if not traced(border_value) and np.isfinite(border_value):
        result = border + sample(flat - border, x, y, interpolation).astype(values.dtype)
        if abs(float(border_value)) > _LARGE:  # whose differences have lost the picture's digits
            inner = sample(flat, x, y, interpolation).astype(values.dtype)
            mixed = jnp.asarray(mixes_border(x, y, (width, height), interpolation))
            result = jnp.where(mixed[..., None], result, inner)
    else:  # NaN and inf would be differences, and so in every pixel
        finite = jnp.where(jnp.isfinite(border), border, 0)
        result = finite + sample(flat - finite, x, y, interpolation).astype(values.dtype)
        mixed = mixes_border(x, y, (width, height), interpolation) & ~jnp.isfinite(border)
        result = jnp.where(mixed[..., None], border, result)
    # Or XLA, on a CPU, would make one slow loop of the samples and whatever sum a loss is of them.
    result = computed_p.bind(result, x[0, 0]).reshape(*x.shape, *image.shape[2:])
    return result if values is image else _rounded(result, image.dtype)


def sample_positions(
    distortion: Distortion, framing: Framing, dtype: DTypeLike
) -> tuple[Float[Array, "height width"], Float[Array, "height width"]]:
    """`Distortion.distort` of the points that a framing shows, px; far off the image without inverse.

    Newton's method on the ratio q of the radii, ``q L(τ q²) = 1`` for squared corrected radii τ: started
    from a polynomial, iterated together until it has arrived on a sample of radii, and a last time.
    """
    distortion_model = distortion.distortion_model
    if not isinstance(distortion_model, AbstractRadial):
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
    ratio, seen = _arrived_ratio(distortion_model, *fixed)
    # Where nothing is seen for a NaN in k, as beyond a lens's focal range, it is no part of derivatives.
    ratio = _ratio(distortion_model, ratio, jnp.where(seen, squared, 0), jnp.where(jnp.isfinite(k), k, 0))
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


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _ratio(distortion_model, near, squared, k):
    """The ratio q, by one Newton step from near to it."""
    value, slope = _equation(distortion_model, near, squared, k)
    return near - value / slope


@_ratio.defjvp
def _ratio_jvp(distortion_model, primals, tangents):
    """By the implicit function theorem at the solution, itself differentiated for the next order."""
    q, (_, squared, k) = _ratio(distortion_model, *primals), primals
    value_dot = jax.jvp(lambda *at: _equation(distortion_model, q, *at)[0], (squared, k), tangents[1:])[1]
    return q, -value_dot / _equation(distortion_model, q, squared, k)[1]


def _equation(distortion_model, q, squared, k):
    """``q L(τ q²) - 1`` and its derivative with respect to q, kept off zero."""
    value, slope = distortion_model.equation(q, squared * q * q, 1, k)
    return value, jnp.maximum(slope, jnp.finfo(slope.dtype).eps)


def _arrived_ratio(distortion_model, k, squared, scale):
    """The ratio q, at most one Newton step from its solution, and which τ have one."""
    limit = distortion_model.monotone_radius(k)
    farthest = jnp.sqrt(jnp.max(squared))
    reach = distortion_model.reach(k, limit)
    end = jnp.minimum(farthest, reach)
    top = end * distortion_model.ratio(end * end, k, limit)[0]
    # Exact pairs of radii, and the least-squares polynomial through them, in Chebyshev's basis.
    r = top * jnp.sin(jnp.linspace(0, jnp.pi / 2, 65, dtype=k.dtype)[1:])
    rho = r * distortion_model.factor(r * r, k)
    v = 2 * (rho / rho[-1]) ** 2 - 1
    angle = jnp.arccos(jnp.clip(v, -1, 1))
    design = jnp.cos(jnp.outer(angle, jnp.arange(_DEGREE + 1, dtype=k.dtype)))
    q, triangle = jnp.linalg.qr(design * rho[:, None])
    powers = jax.scipy.linalg.solve_triangular(triangle, jnp.matmul(q.T, r, precision=EXACT))
    bound = rho[-1] ** 2

    def start(squared):
        return _chebyshev(powers, jnp.clip(2 * squared / bound - 1, -1, 1))

    def step(q, squared):
        value, slope = _equation(distortion_model, q, squared, k)
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
        exact, found = distortion_model.ratio(jnp.where(late, squared, 0), k, limit)
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


def _rounded(values, dtype):
    """Floating values as integers of a dtype."""
    limits = jnp.iinfo(dtype)
    most = values.dtype.type(limits.max)  # of 32 bits it may be rounded up, beyond the largest
    most = np.nextafter(most, 0, dtype=most.dtype) if most > limits.max else most
    return jnp.clip(jnp.round(values), limits.min, most).astype(dtype)
