"""The way back: distortion applied to corrected images, as visual effects are put into the original.

For every pixel of the distorted image, its place in the corrected one: the distortion's own formula, with
no inverse. It is evaluated in float64, row by row, and takes some times as long as `cv2.remap`.
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Shaped

from ..models.distortion import Distortion
from ..models.lens import ZoomLens
from ..models.sizes import check_image_size, checked_distortion, lens_for_size
from ._inverse_polynomial import fold_radius
from .framing import Framing, check_keep, frame_output
from .image import checked_image, warn_of_fold
from .maps import OUTSIDE, Plane
from .sampler import border_values, check_sampling, remap

_ROWS = 64  # at a time: what is computed of them stays in the cache


def redistort_image(
    image: Shaped[np.ndarray, "height width *channels"],
    distortion: Distortion | ZoomLens,
    *,
    focal: float | int | None = None,
    keep: str | Framing = "same",
    interpolation: str = "linear",
    border: str = "constant",
    border_value: float | int | Sequence[float | int] = 0,
) -> np.ndarray:
    """Apply distortion to a corrected image: what `undistort_image` with the same arguments has removed.

    Args:
        image: the corrected image, as for `undistort_image`.
        distortion: the distortion of the image to make; or a lens.
        focal: the focal length, if a lens is given.
        keep: how the corrected image was framed, "same", "all" or "valid"; or its `Framing`. With a lens
            also "grow"; the image that is made then has the lens's size.
        interpolation: "nearest", "linear", "cubic" or "lanczos".
        border: fill outside of the corrected image: "constant", "replicate" or "reflect".
        border_value: for "constant": one number, or one per channel. With any `border` it also fills pixels
            beyond a fold of the lens.

    Returns:
        The dtype and channels of the image, in the size of the distorted image.

    Raises:
        ValueError: an argument is not one of the above, or the image does not have the framing's size.

    Warns:
        UserWarning: the lens folds within the image, and the part beyond the fold cannot be made.

    Example:
        >>> d = Distortion(np.array([0.1]), np.array([3.0, 1.0]), np.array(4.0))
        >>> redistort_image(np.eye(4, 6, dtype=np.uint8) * 200, d).shape
        (4, 6)
    """
    image = checked_image(image)
    check_sampling(interpolation, border)
    height, width = image.shape[:2]
    distortion, framing, made = _geometry(distortion, focal, keep, (width, height))
    folded = warn_of_fold(distortion, made)
    x, y = redistortion_map(distortion, framing, made)
    fill = border_values(border_value, math.prod(image.shape[2:]), image.dtype)
    result = remap(image, x, y, interpolation, border, fill)
    if folded and border != "constant":
        result[x == OUTSIDE] = fill if image.ndim > 2 else fill[0]
    return result


def framing_of_corrected(lens: ZoomLens, focal: float | int, keep: str, size: tuple[int, int]) -> Framing:
    """The framing of a corrected image of a size, as `redistort_image` takes it."""
    return _geometry(lens, focal, keep, size)[1]


def _geometry(
    distortion: Distortion | ZoomLens,
    focal: float | int | None,
    keep: str | Framing,
    size: tuple[int, int],
) -> tuple[Distortion, Framing, tuple[int, int]]:
    """The distortion, the framing of the given image, and the size of the image to make."""
    if isinstance(keep, Framing):
        made = keep.image_size or size
    else:
        check_keep(keep)
        grows = keep == "grow"
        if grows and not isinstance(distortion, ZoomLens):
            raise ValueError('Argument keep="grow" needs a lens, which knows the size, or a Framing.')
        made = distortion.image_size if grows and isinstance(distortion, ZoomLens) else size
    if isinstance(distortion, ZoomLens):
        if focal is None:
            raise ValueError("Argument focal must be given with a ZoomLens, but it is not.")
        distortion = lens_for_size(distortion, made)(focal)
    elif focal is not None:
        raise ValueError("Argument focal must be left out unless the distortion is a ZoomLens.")
    distortion = checked_distortion(distortion)
    check_image_size(distortion, made)
    framing = keep if isinstance(keep, Framing) else frame_output(distortion, made, keep=keep)
    check_framed(framing, size)
    return distortion, framing, made


def check_framed(framing: Framing, size: tuple[int, int]) -> None:
    """Refuse a corrected image that does not have its framing's size.

    Raises:
        ValueError: it has another.
    """
    if framing.size == size:
        return
    (width, height), of = framing.size, framing.image_size
    grown = "" if of in (None, framing.size) else f', made with "grow" of an image of {of[0]} x {of[1]} px'
    raise ValueError(
        f"The corrected image has {size[0]} x {size[1]} px, but its framing {width} x {height} px{grown}. "
        "Give the keep, and the focal lengths, with which it was corrected."
    )


def redistortion_map(
    distortion: Distortion,
    framing: Framing,
    image_size: tuple[int, int],
    *,
    plane: Plane | None = None,
    extend: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """For each pixel of the distorted image the x and y, px, in the corrected one, as float32 arrays.

    Far off the image beyond a fold. Arguments are those of `image.position_map`, of the same two images.
    """
    plane = Plane(image_size) if plane is None else plane
    step, offset = np.array(plane.step), np.array(plane.offset)
    x, y = (np.empty(plane.size[::-1], np.float32) for _ in range(2))
    centre, scale = np.asarray(distortion.centre, float), float(distortion.scale)
    origin, zoom = np.asarray(framing.origin, float), float(framing.scale)
    k, fold = np.asarray(distortion.coefficients, float), fold_radius(distortion) / scale
    across = (np.arange(plane.size[0]) * step[0] + offset[0] - centre[0]) / scale
    for top in range(0, plane.size[1], _ROWS):
        rows = slice(top, min(top + _ROWS, plane.size[1]))
        down = (np.arange(rows.start, rows.stop) * step[1] + offset[1] - centre[1])[:, None] / scale
        squared = across**2 + down**2
        corrected = distortion.distortion_model.correct((across + 0 * down, down + 0 * across), squared, k)
        seen = squared <= fold**2
        for axis, (out, values) in enumerate(zip((x, y), corrected, strict=True)):
            pixels = (centre[axis] + scale * np.asarray(values) - origin[axis]) * zoom
            out[rows] = np.where(seen, (pixels - offset[axis]) / step[axis], OUTSIDE)
    return x, y
