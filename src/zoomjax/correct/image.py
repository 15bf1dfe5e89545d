"""Correction of images with OpenCV: a map of source positions, made cheaply, and `cv2.remap`.

Per image: the polynomial for the inverse radial function (`_inverse_polynomial.fit_inverse`), or the exact
inverse where that is not accurate to 0.01 px; one pass over the output's pixels for the map; one
`cv2.remap`.
Maps are float32: fixed-point ones take longer to make than they save, and round to 1/32 px.
"""

import math
import warnings
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Shaped

from .._core.arrays import native
from ..models.distortion import Distortion
from ..models.lens import ZoomLens
from ..models.sizes import (
    check_channels_last,
    check_image_size,
    check_one_image,
    checked_distortion,
    lens_for_size,
)
from ._inverse_polynomial import fit_inverse, fold_radius
from .framing import LARGEST, Framing, check_framing, frame_output
from .maps import OUTSIDE, Plane, source_positions

_INTERPOLATION = {
    "nearest": cv2.INTER_NEAREST,
    "linear": cv2.INTER_LINEAR,
    "cubic": cv2.INTER_CUBIC,
    "lanczos": cv2.INTER_LANCZOS4,
}
_WIDE = ("cubic", "lanczos")
"""Interpolations that reach over more than the pixels next to a position."""

_BORDER = {
    "constant": cv2.BORDER_CONSTANT,
    "replicate": cv2.BORDER_REPLICATE,
    "reflect": cv2.BORDER_REFLECT_101,
}
_MARGIN = 8.0
"""px beyond the image's corner that an interpolation (Lanczos: 4) may still reach back from."""

_WORKING = {"bool": "uint8", "int8": "int16", "int32": "float64", "uint32": "float64", "float16": "float32"}
"""What `cv2.remap` does not know is computed in a type that holds all of its values."""

_KNOWN = ("uint8", "uint16", "int16", "float32", "float64")


def undistort_image(
    image: Shaped[np.ndarray, "height width *channels"],
    distortion: Distortion | ZoomLens,
    *,
    focal: float | int | None = None,
    keep: str | Framing = "same",
    size: tuple[int, int] | None = None,
    interpolation: str = "linear",
    border: str = "constant",
    border_value: float | int | Sequence[float | int] = 0,
) -> np.ndarray:
    """Correct an image: the image that a lens without distortion would have taken.

    Args:
        image: grey, or with any number of channels; boolean, integer of up to 32 bits, or floating.
            It may be a strided view.
        distortion: the distortion of this image, in its pixels; or a lens, which is scaled to images of
            another size with the same aspect ratio.
        focal: the focal length, if a lens is given.
        keep: the part to show, "same", "all", "valid" or "grow"; or a `Framing` from `frame_output`, which
            also gives the scale and can be used for many images of one size.
        size: (width, height) px of the result; by default the image's. Not with a `Framing`.
        interpolation: "nearest", "linear", "cubic" or "lanczos"; the last two have some seven digits,
            whatever the dtype.
        border: fill outside of the image: "constant", "replicate" or "reflect".
        border_value: for "constant": one number, or one per channel. With any `border` it also fills pixels
            without a counterpart because the lens folds.

    Returns:
        The dtype and channels of the image. Positions are those of `Distortion.distort` to 0.01 px.

    Raises:
        ValueError: an argument is not one of the above, channels are first, a side is longer than 32766 px,
            or the framing, or by its centre and scale the distortion, is for images of another size. With a
            user-defined `Framing` the distortion is not checked.

    Warns:
        UserWarning: the lens folds within the image, and the part beyond the fold cannot be corrected; or
            the lens is for images of another size, so it was scaled.

    Example:
        >>> import numpy as np
        >>> d = Distortion(np.array([0.1]), np.array([3.0, 1.0]), np.array(4.0))
        >>> undistort_image(np.eye(4, 6, dtype=np.uint8) * 200, d).shape
        (4, 6)
    """
    image = checked_image(image)
    check_sampling(interpolation, border)
    height, width = image.shape[:2]
    distortion = _distortion(distortion, focal, (width, height))
    if isinstance(keep, Framing):
        check_framing(keep, (width, height), "keep")
    if not isinstance(keep, Framing) or keep.image_size is not None:
        check_image_size(distortion, (width, height))
    if not isinstance(keep, Framing):
        keep = frame_output(distortion, (width, height), keep=keep, size=size)
    elif size is not None:
        raise ValueError(
            "Argument size must be left out with a Framing, but it is given: the framing has one."
        )
    if max(keep.size) > LARGEST:
        raise ValueError(f"Argument size must be at most {LARGEST} px a side, but it is {keep.size}.")
    folded = warn_of_fold(distortion, (width, height))
    x, y = position_map(distortion, keep, (width, height), extend=border != "constant")
    fill = border_values(border_value, math.prod(image.shape[2:]), image.dtype)
    corrected = remap(image, x, y, interpolation, border, fill)
    if folded and border != "constant":
        corrected[x == OUTSIDE] = fill if image.ndim > 2 else fill[0]
    return corrected


def _all_within(x: np.ndarray, y: np.ndarray, size: tuple[int, int]) -> bool:
    """Whether every pixel of the output is within the middles of an image's outermost pixels."""
    return all(p.min() >= 0 and p.max() <= side - 1 for p, side in zip((x, y), size, strict=True))


def _distortion(
    distortion: Distortion | ZoomLens, focal: float | int | None, size: tuple[int, int]
) -> Distortion:
    """That of the image, also from a lens and a focal length."""
    if isinstance(distortion, ZoomLens):
        if focal is None:
            raise ValueError(
                "Argument focal must be given with a ZoomLens, but it is not: undistort_image(image, lens, "
                "focal=...), or undistort_image(image, lens(focal))."
            )
        return lens_for_size(distortion, size)(focal)
    if focal is not None:
        raise ValueError("Argument focal must be left out unless the distortion is a ZoomLens.")
    return checked_distortion(distortion)


def position_map(
    distortion: Distortion,
    framing: Framing,
    image_size: tuple[int, int],
    *,
    plane: Plane | None = None,
    extend: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """For each output pixel the x and y, px, of its source, as float32 arrays (height, width).

    Within 0.01 px of `Distortion.distort`; far off the image where there is no source.

    Args:
        distortion: of the image.
        framing: of the output.
        image_size: (width, height) px of the distorted image.
        plane: the sampling of both images; by default every pixel.
        extend: whether positions off the image matter, for borders that continue it.
    """
    centre = np.asarray(distortion.centre, float)
    radius = _farthest(centre, np.asarray(framing.origin, float), framing.size, float(framing.scale))
    seen = math.inf if extend else _farthest(centre, np.zeros(2), image_size, 1.0) + _MARGIN
    inverse = fit_inverse(distortion, radius + _MARGIN, seen=seen)
    x, y = source_positions(distortion, framing, inverse, plane)
    return np.asarray(x), np.asarray(y)


def remap(
    image: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    interpolation: str,
    border: str,
    fill: np.ndarray,
    out: np.ndarray | None = None,
) -> np.ndarray:
    """`cv2.remap` for any dtype and number of channels.

    Where nothing beyond the image is shown, wide kernels do not mix a constant border in either. `out` may
    be given for the dtypes that OpenCV knows, with up to 4 channels.
    """
    if interpolation in _WIDE and border == "constant" and _all_within(x, y, image.shape[1::-1]):
        border = "replicate"
    working = np.dtype(_WORKING.get(image.dtype.name, image.dtype))
    if working != image.dtype:
        scaled = image.astype(working) * (255 if image.dtype == bool else 1)
        result = remap(scaled, x, y, interpolation, border, fill * (255 if image.dtype == bool else 1))
        return _cast(result, image.dtype)
    flags = {"interpolation": _INTERPOLATION[interpolation], "borderMode": _BORDER[border]}
    flat = image.reshape(*image.shape[:2], -1) if image.ndim > 2 else image
    channels = 1 if flat.ndim == 2 else flat.shape[2]
    if channels not in (1, 3, 4):
        groups = np.split(np.arange(channels), _cuts(channels))
        parts = [
            remap(np.ascontiguousarray(flat[..., some]), x, y, interpolation, border, fill[some])
            for some in groups
        ]
        result = np.concatenate(parts, axis=2)
    elif channels == 3 and image.dtype == np.uint8 and interpolation == "linear" and out is None:
        result = _remap_colour_bytes(flat, x, y, (*fill.tolist(), 0), flags)
    else:
        result = cv2.remap(flat, x, y, borderValue=fill.tolist(), dst=out, **flags)
    return result.reshape(*result.shape[:2], *image.shape[2:])


def _cuts(channels: int) -> list[int]:
    """Where to cut channels into groups of 4, 3 or 1: for 2, OpenCV 5 has slow and coarser code only."""
    whole, rest = divmod(channels, 4)
    ends = [4 * i for i in range(1, whole + 1)] + ([4 * whole + 1] if rest == 2 else [])
    return [end for end in ends if end < channels]


def _remap_colour_bytes(image, x, y, fill, flags) -> np.ndarray:
    """Linear `cv2.remap` of three channels of bytes by way of four, for which OpenCV 5 has faster code.

    In strips of 1 MiB that stay in the cache, both conversions included, it is faster than three channels.
    The other interpolations are slower so.
    """
    four = cv2.cvtColor(image, cv2.COLOR_BGR2BGRA)
    height, width = x.shape
    result = np.empty((height, width, 3), np.uint8)
    rows = max(1, min(height, 2**18 // width))
    strip = np.empty((rows, width, 4), np.uint8)
    for top in range(0, height, rows):
        part = slice(top, min(top + rows, height))
        corrected = strip[: part.stop - top]
        cv2.remap(four, x[part], y[part], borderValue=fill, dst=corrected, **flags)
        cv2.cvtColor(corrected, cv2.COLOR_BGRA2BGR, dst=result[part])
    return result


def border_values(value: float | int | Sequence[float | int], channels: int, dtype: np.dtype) -> np.ndarray:
    """One border value a channel, in float64.

    Raises:
        ValueError: there are neither one nor as many as channels, or the dtype cannot hold them.
    """
    given = np.atleast_1d(np.asarray(value, np.float64))
    if given.ndim != 1 or given.size not in (1, channels):
        raise ValueError(
            f"Argument border_value must be one number, or one for each of the {channels} channels, "
            f"but it is {value!r}."
        )
    if dtype.kind in "iu" and not ((given >= np.iinfo(dtype).min) & (given <= np.iinfo(dtype).max)).all():
        raise ValueError(f"Argument border_value must be a value of {dtype}, but it is {value!r}.")
    return np.broadcast_to(given, channels).copy()


def warn_of_fold(distortion: Distortion, image_size: tuple[int, int], stacklevel: int = 3) -> bool:
    """Whether the lens folds within an image of that size, having warned if so."""
    limit = fold_radius(distortion)
    corner = _farthest(np.asarray(distortion.centre, float), np.zeros(2), image_size, 1.0)
    if limit >= corner:
        return False
    warnings.warn(
        f"The lens is not invertible on this image: its distortion folds {limit:.0f} px from the "
        f"centre, and the farthest corner is {corner:.0f} px from it. The part beyond the fold is left "
        "out, and pixels without a counterpart get the border value. Fit the lens to lines that reach the "
        "corners, or with fewer terms.",
        stacklevel=stacklevel,
    )
    return True


def _farthest(centre: np.ndarray, origin: np.ndarray, size: tuple[int, int], scale: float) -> float:
    """Distance, px, from the centre to the farthest pixel of a window."""
    last = origin + (np.array(size) - 1) / scale
    return float(np.hypot(*np.maximum(abs(origin - centre), abs(last - centre))))


def check_sampling(interpolation: str, border: str) -> None:
    """Refuse names that are not known.

    Raises:
        ValueError: an argument is none of those that `undistort_image` takes.
    """
    for name, value, known in (
        ("interpolation", interpolation, _INTERPOLATION),
        ("border", border, _BORDER),
    ):
        if value not in known:
            raise ValueError(f"Argument {name} must be one of {', '.join(known)}, but it is {value!r}.")


def checked_image(image) -> np.ndarray:
    """The image, in this machine's order of bytes, if it is one that OpenCV can warp.

    Raises:
        ValueError: it is none; the message says what to do.
    """
    if not isinstance(image, np.ndarray) or image.ndim < 2 or 0 in image.shape:
        shape = getattr(image, "shape", type(image).__name__)
        raise ValueError(
            "Argument image must be a NumPy array (height, width[, channels]) with pixels, but it is "
            f"{shape}. cv2.imread gives None where it cannot read a file."
        )
    if isinstance(image, np.ma.MaskedArray):
        raise ValueError("Argument image is a masked array, and masks are not kept: give its data alone.")
    check_channels_last(image.shape)
    check_one_image(image.shape, "one call for each")
    if image.dtype.name not in (*_KNOWN, *_WORKING):
        raise ValueError(
            "Argument image must be boolean, integer of up to 32 bits or floating, but its dtype is "
            f"{image.dtype}. Convert it with image.astype(...)."
        )
    if max(image.shape[:2]) > LARGEST:
        raise ValueError(
            f"Argument image must be at most {LARGEST} px a side, but its shape is {image.shape}."
        )
    return native(image)


def _cast(values: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Rounded and clipped to a dtype."""
    if dtype.kind == "b":
        return values >= 128
    if dtype.kind == "f":
        clipped = np.clip(values, np.finfo(dtype).min, np.finfo(dtype).max)
        return np.where(np.isfinite(values), clipped, values).astype(dtype)
    limits = np.iinfo(dtype)
    return np.clip(np.rint(values), limits.min, limits.max).astype(dtype)
