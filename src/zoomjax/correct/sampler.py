"""`cv2.remap` for images of any dtype and number of channels."""

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from .._core.checks import real_numbers

INTERPOLATION = {
    "nearest": cv2.INTER_NEAREST,
    "linear": cv2.INTER_LINEAR,
    "cubic": cv2.INTER_CUBIC,
    "lanczos": cv2.INTER_LANCZOS4,
}
WIDE = ("cubic", "lanczos")
"""Interpolations that reach over more than the pixels next to a position."""

BORDER = {
    "constant": cv2.BORDER_CONSTANT,
    "replicate": cv2.BORDER_REPLICATE,
    "reflect": cv2.BORDER_REFLECT_101,
}

WORKING = {
    "bool": "uint8",
    **dict.fromkeys(["int8", "int16", "float16"], "float32"),
    **dict.fromkeys(["int32", "uint32"], "float64"),
}
"""What `cv2.remap` does not know is computed in a type that holds all of its values; and so are integers of
16 bits with a sign, for which it rounds positions to 1/32 px, as for float64."""

KNOWN = ("uint8", "uint16", "float32", "float64")

_STRIP = 2**18
"""Pixels that are converted together: they stay in the cache."""

Sampler = Callable[..., np.ndarray]
"""Samples an image at positions x and y, px, two float32 arrays of one shape; its third argument, if it is
given, is the array that takes the result."""


def remap(
    image: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    interpolation: str,
    border: str,
    fill: np.ndarray,
    out: np.ndarray | None = None,
) -> np.ndarray:
    """An image sampled at positions: see `sampler`."""
    return sampler(image, interpolation, border, fill)(x, y, out)


def sampler(image: np.ndarray, interpolation: str, border: str, fill: np.ndarray) -> Sampler:
    """What samples an image, which is converted once to what OpenCV knows.

    Where no position is beyond the image, wide kernels do not mix a constant border in either.
    """
    if image.dtype.name in WORKING:
        return _by_another_dtype(image, interpolation, border, fill)
    flat = image.reshape(*image.shape[:2], -1) if image.ndim > 2 else image
    channels = 1 if flat.ndim == 2 else flat.shape[2]
    flags = {"interpolation": INTERPOLATION[interpolation], "borderMode": BORDER[border]}
    if channels not in (1, 3, 4):
        sample = _by_groups(flat, interpolation, border, fill)
    elif channels == 3 and image.dtype == np.uint8 and interpolation == "linear":
        sample = _of_colour_bytes(flat, (*fill.tolist(), 0), flags)
    else:
        values, wide = fill.tolist(), interpolation in WIDE and border == "constant"

        def sample(x, y, out=None):
            own = flags
            if wide and _all_within(x, y, image.shape[1::-1]):
                own = flags | {"borderMode": BORDER["replicate"]}
            return cv2.remap(flat, x, y, borderValue=values, dst=out, **own)

    def shaped(x, y, out=None):
        shape = (*x.shape, *image.shape[2:])
        if out is None:
            return sample(x, y).reshape(shape)
        given = out.reshape(*x.shape, channels) if flat.ndim > 2 else out
        sample(x, y, given)
        return out

    return shaped


def _all_within(x: np.ndarray, y: np.ndarray, size: tuple[int, int]) -> bool:
    """Whether every position is within the middles of an image's outermost pixels."""
    return all(p.min() >= 0 and p.max() <= side - 1 for p, side in zip((x, y), size, strict=True))


def _by_another_dtype(image, interpolation, border, fill) -> Sampler:
    """The sampler of an image whose dtype OpenCV does not know."""
    most = 255 if image.dtype == bool else 1
    working = image.astype(WORKING[image.dtype.name]) * most
    sample = sampler(working, interpolation, border, fill * most)

    def cast(x, y, out=None):
        result = _cast(sample(x, y), image.dtype)
        if out is None:
            return result
        out[...] = result
        return out

    return cast


def _cast(values: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Rounded and clipped to a dtype."""
    if dtype.kind == "b":
        return values >= 128
    if dtype.kind == "f":
        clipped = np.clip(values, np.finfo(dtype).min, np.finfo(dtype).max)
        return np.where(np.isfinite(values), clipped, values).astype(dtype)
    limits = np.iinfo(dtype)
    return np.clip(np.rint(values), limits.min, limits.max).astype(dtype)


def _by_groups(image, interpolation, border, fill) -> Sampler:
    """The sampler of an image with more channels than OpenCV takes, or with two."""
    groups = np.split(np.arange(image.shape[2]), _cuts(image.shape[2]))
    samples = [
        sampler(np.ascontiguousarray(image[..., some]), interpolation, border, fill[some])
        for some in groups
    ]

    def sample(x, y, out=None):
        return np.concatenate([one(x, y) for one in samples], axis=2, out=out)

    return sample


def _cuts(channels: int) -> list[int]:
    """Where to cut channels into groups of 4, 3 or 1: for 2, OpenCV 5 has slow and coarser code only."""
    whole, rest = divmod(channels, 4)
    ends = [4 * i for i in range(1, whole + 1)] + ([4 * whole + 1] if rest == 2 else [])
    return [end for end in ends if end < channels]


def _of_colour_bytes(image, fill, flags) -> Sampler:
    """Linear `cv2.remap` of three channels of bytes by way of four, for which OpenCV 5 has faster code.

    In strips that stay in the cache it is faster than three channels, both conversions included. The other
    interpolations are slower so.
    """
    four = cv2.cvtColor(image, cv2.COLOR_BGR2BGRA)

    def sample(x, y, out=None):
        height, width = x.shape
        result = np.empty((height, width, 3), np.uint8) if out is None else out
        rows = max(1, min(height, _STRIP // width))
        strip = np.empty((rows, width, 4), np.uint8)
        for top in range(0, height, rows):
            part = slice(top, min(top + rows, height))
            corrected = strip[: part.stop - top]
            cv2.remap(four, x[part], y[part], borderValue=fill, dst=corrected, **flags)
            cv2.cvtColor(corrected, cv2.COLOR_BGRA2BGR, dst=result[part])
        return result

    return sample


def border_values(value: float | int | Sequence[float | int], channels: int, dtype: np.dtype) -> np.ndarray:
    """One border value a channel, in float64.

    Raises:
        ValueError: there are neither one nor as many as channels, or the dtype cannot hold them.
    """
    if dtype.kind == "b" and isinstance(value, bool | np.bool_):
        value = int(value)
    numbers = real_numbers(value)
    given = np.empty(0) if numbers is None else np.atleast_1d(numbers).astype(np.float64)
    if given.ndim != 1 or given.size not in (1, channels):
        raise ValueError(
            f"Argument border_value must be one number, or one for each of the {channels} channels, "
            f"but it is {value!r}."
        )
    if dtype.kind in "iu" and not ((given >= np.iinfo(dtype).min) & (given <= np.iinfo(dtype).max)).all():
        raise ValueError(f"Argument border_value must be a value of {dtype}, but it is {value!r}.")
    return np.broadcast_to(given, channels).copy()


def check_sampling(interpolation: str, border: str) -> None:
    """Refuse names that are not known.

    Raises:
        ValueError: an argument is none of those that `undistort_image` takes.
    """
    for name, value, known in (
        ("interpolation", interpolation, INTERPOLATION),
        ("border", border, BORDER),
    ):
        if value not in known:
            raise ValueError(f"Argument {name} must be one of {', '.join(known)}, but it is {value!r}.")
