"""Correction of images with OpenCV: a map of source positions, made cheaply, and `cv2.remap`.

Per image: the polynomial for the inverse radial function (`_inverse_polynomial.fit_inverse`), or the exact
inverse where that is not accurate to 0.01 px; then a map and `cv2.remap`, in large images for one band of
rows after the other, in the same memory.
Maps are float32: fixed-point ones take longer to make than they save, and round to 1/32 px.
"""

import math
import warnings
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Shaped

from .._core.arrays import native
from .._core.fields import refuse_masked_image
from ..models.distortion import Distortion
from ..models.lens import ZoomLens
from ..models.sizes import (
    check_channels_last,
    check_image_size,
    check_one_image,
    checked_distortion,
    lens_for_size,
)
from ._inverse_polynomial import RadialInverse, fit_inverse, fold_radius
from .framing import LARGEST, Framing, check_framing, frame_output
from .maps import OUTSIDE, Plane, source_positions
from .sampler import KNOWN, WIDE, WORKING, border_values, check_sampling, sampler

_MARGIN = 8.0
"""px beyond the image's corner that an interpolation (Lanczos: 4) may still reach back from."""

_BAND = 2**20
"""Pixels of a band of rows. Its positions are written where those of the band before were."""

_WHOLE = 2**22
"""Pixels up to which a single map takes less time than bands do to wait for one another."""


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
        The dtype and channels of the image. Positions are those of `Distortion.distort` to 0.01 px; with
        "linear", OpenCV rounds them to 1/32 px for float64 and integers of 32 bits. Give float32 where
        that counts.

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
    fill = border_values(border_value, math.prod(image.shape[2:]), image.dtype)
    sample = sampler(image, interpolation, border, fill)
    inverse = _inverse(distortion, keep, (width, height), extend=border != "constant")
    whole = interpolation in WIDE and border == "constant"  # the border depends on all positions
    whole |= math.prod(keep.size) <= _WHOLE
    corrected = np.empty((*keep.size[::-1], *image.shape[2:]), image.dtype)
    bands = _bands(keep, keep.size[1] if whole else max(_BAND // keep.size[0], 1))
    positions = None
    for rows, band in bands:
        positions = source_positions(distortion, band, inverse, into=positions)
        x, y = map(np.asarray, positions)
        sample(x, y, corrected[rows])
        if folded and border != "constant":
            corrected[rows][x == OUTSIDE] = fill if image.ndim > 2 else fill[0]
        del x, y  # their memory is used again
    return corrected


def _bands(framing: Framing, rows: int) -> Iterator[tuple[slice, Framing]]:
    """Parts of an output: so many of its rows each, and their framing.

    The last begins earlier if it would have fewer: one number of rows, one program.
    """
    width, height = framing.size
    rows = min(rows, height)
    for first in range(0, height, rows):
        first = min(first, height - rows)
        origin = framing.origin + np.array([0, first]) / framing.scale
        yield slice(first, first + rows), Framing(framing.scale, origin, (width, rows))


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
    inverse = _inverse(distortion, framing, image_size, extend)
    x, y = source_positions(distortion, framing, inverse, plane)
    return np.asarray(x), np.asarray(y)


def _inverse(
    distortion: Distortion, framing: Framing, image_size: tuple[int, int], extend: bool
) -> RadialInverse | None:
    """The polynomial for all of an output; None where none is accurate."""
    centre = np.asarray(distortion.centre, float)
    radius = _farthest(centre, np.asarray(framing.origin, float), framing.size, float(framing.scale))
    seen = math.inf if extend else _farthest(centre, np.zeros(2), image_size, 1.0) + _MARGIN
    return fit_inverse(distortion, radius + _MARGIN, seen=seen)


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
    refuse_masked_image("image", image)
    check_channels_last(image.shape)
    check_one_image(image.shape, "one call for each")
    if image.dtype.name not in (*KNOWN, *WORKING):
        raise ValueError(
            "Argument image must be boolean, integer of up to 32 bits or floating, but its dtype is "
            f"{image.dtype}. Convert it with image.astype(...)."
        )
    if max(image.shape[:2]) > LARGEST:
        raise ValueError(
            f"Argument image must be at most {LARGEST} px a side, but its shape is {image.shape}."
        )
    return native(image)
