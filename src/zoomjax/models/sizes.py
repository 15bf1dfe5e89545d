"""Image sizes: checks that a lens or distortion fits an image, and lenses for images of another size.

A `ZoomLens` stores the size of its images. A `Distortion` stores only its centre and scale. For a lens
these are near the middle of the image, and half its diagonal, which reveals an image of another size.
"""

import dataclasses
import math
from typing import Any

import jax.numpy as jnp
import numpy as np

from .._core.arguments import kinds_checked
from .._core.checks import checked_size, warn_caller
from .._core.programs import light_program
from .._core.types import traced
from ._known_sizes import known_size
from .about import WIDTH_OF_FOCALS
from .distortion import Distortion
from .lens import ZoomLens

_FEW = 16
"""Channels, or images, that are more likely than an image of so few rows or columns."""

_SAME_SCALE = 0.01
"""By which a scale may differ from half the image's diagonal and count as that."""


@kinds_checked
def lens_for_size(lens: ZoomLens, image_size: tuple[int, int]) -> ZoomLens:
    """The same lens for images of the same view with more or fewer pixels.

    The normalised coefficients are unchanged; the centre becomes ``(c + 1/2) w'/w - 1/2``, and the pixel
    pitch is that of the other pixels. Focal lengths are unchanged, also those in px: they refer to images
    of the lens's original size, and `Camera` and exports convert them.

    Args:
        lens: the lens.
        image_size: (width, height) px of the images.

    Raises:
        ValueError: the images have another aspect ratio, so they cannot show the same view.

    Warns:
        UserWarning: the size differs, so the lens was scaled.

    Example:
        >>> from zoomjax.scenes.board import nikkor_18_200
        >>> lens_for_size(nikkor_18_200(), (4288, 2848)).image_size
        (4288, 2848)
    """
    size = checked_size(image_size)
    if size == lens.image_size:
        return lens
    check_aspect(size, lens.image_size)
    (width, height), (old_width, old_height) = size, lens.image_size
    about, stays = dict(lens.about), ""
    if lens.focal_unit == "px":
        own = about.setdefault(WIDTH_OF_FOCALS, float(old_width))
        stays = f" Its focal lengths stay those in px of images {own:g} px wide."
    warn_caller(
        f"The lens is for images of {old_width} x {old_height} px, and this one has {width} x {height}: "
        f"its distortion is scaled to them.{stays}"
    )
    centre = jnp.asarray(lens.centre)
    ratio = jnp.asarray([width / old_width, height / old_height], centre.dtype)
    pitch = None if lens.pixel_pitch is None else lens.pixel_pitch * lens.scale / (math.hypot(*size) / 2)
    return dataclasses.replace(
        lens, centre=(centre + 0.5) * ratio - 0.5, image_size=size, pixel_pitch=pitch, about=about
    )


def check_aspect(image_size: tuple[int, int], lens_size: tuple[int, int]) -> None:
    """Refuse images that cannot show the same view as those of a lens.

    Raises:
        ValueError: the aspect ratios differ by more than rounding.
    """
    (width, height), (old_width, old_height) = image_size, lens_size
    if abs(width * old_height - height * old_width) > max(old_width, old_height, width, height):
        raise ValueError(
            f"The lens is for images of {old_width} x {old_height} px, and this one has {width} x "
            f"{height}, another aspect ratio: it was cropped, turned, or taken in another mode. Give "
            "images as they were when the lens was calibrated."
        )


def checked_distortion(distortion: Any, name: str = "distortion") -> Distortion:
    """One `Distortion`.

    Raises:
        ValueError: it is something else, such as a lens, which becomes one by a focal length.
    """
    if isinstance(distortion, Distortion) and np.ndim(distortion.coefficients) == 1:
        return distortion
    if isinstance(distortion, Distortion):
        kind = "several at once: give one"
    elif isinstance(distortion, ZoomLens):
        kind = "a ZoomLens: give lens(focal)"
    else:
        kind = f"a {type(distortion).__name__}: give lens(focal), of the lens of a fit fit.lens(focal)"
    raise ValueError(f"Argument {name} must be a Distortion, but it is {kind}.")


def check_image_size(distortion: Distortion, image_size: tuple[int, int]) -> None:
    """Refuse a distortion that is clearly for images of another size.

    This is so if another image size explains centre and scale and this one does not: the centre is the
    middle of that size, and the scale half its diagonal; or that size is the same view scaled or turned,
    and its middle is much nearer to the centre than the middle of this image. Where centre and scale are
    traced, those that the lens's image size makes likely stand in for them, of what ``lens(focal)``
    returned; else nothing is checked.

    Raises:
        ValueError: the distortion is for another size; the message gives the sizes.
    """
    known = all(isinstance(side, int | np.integer) for side in image_size)  # or symbolic, for `jax.export`
    if not known:
        return
    if not traced((distortion.centre, distortion.scale)):
        centre, scale = np.asarray(distortion.centre, float), float(distortion.scale)
    elif (size := known_size(distortion)) is not None:
        centre, scale = (np.array(size) - 1) / 2, math.hypot(*size) / 2
    else:
        return
    width, height = image_size
    half = math.hypot(width, height) / 2
    ratio = scale / half

    here = _off_middle(centre, width, height)
    if abs(ratio - 1) > _SAME_SCALE:
        other = tuple(2 * centre + 1)  # in the middle of which the centre is
        explained = min(other) > 0 and abs(math.hypot(*other) / 2 - scale) < _SAME_SCALE * scale
        if not explained:
            other = (ratio * width, ratio * height)
            explained = 2 * _off_middle(centre, *other) < here
    else:
        other = (height, width)
        explained = 4 * _off_middle(centre, *other) < here
    if explained:
        middle = f"({(width - 1) / 2:.5g}, {(height - 1) / 2:.5g})"
        raise ValueError(
            f"The distortion is for images of another size: its centre is ({centre[0]:.5g}, "
            f"{centre[1]:.5g}) and its scale {scale:.5g} px, but this image of {width} x {height} px has "
            f"its middle at {middle} and half a diagonal of {half:.5g} px. "
            f"Give images of the lens's size, or use lens_for_size(lens, ({width}, {height}))(focal). If "
            "the image is a crop for which this distortion is right, give a Framing: "
            f"Framing(np.array(1.0), np.zeros(2), ({width}, {height}))."
        )


def _off_middle(centre: np.ndarray, width: float | int, height: float | int) -> float:
    """How far the centre is from the middle of an image, in halves of its diagonal."""
    return (
        2
        * math.hypot(centre[0] - (width - 1) / 2, centre[1] - (height - 1) / 2)
        / math.hypot(width, height)
    )


def check_one_image(shape: tuple[int, ...], instead: str) -> None:
    """Refuse several images in one array, which would be taken for one with very many channels.

    Args:
        shape: of the array.
        instead: what to do with them.

    Raises:
        ValueError: the shape is (images, rows, columns, 1, 3 or 4), or with channels before rows.
    """
    if len(shape) != 4 or not all(isinstance(side, int) for side in shape):
        return
    first, second, third, last = shape
    if (last in (1, 3, 4) and third > max(first, _FEW)) or (second in (1, 3, 4) and third > _FEW < last):
        raise ValueError(
            f"Argument image must be one image, (height, width, channels), but its shape is {shape}, as "
            f"that of several: {instead}."
        )


def check_channels_last(shape: tuple[int, ...]) -> None:
    """Refuse images with channels first, which would be taken for images of 3 rows.

    Raises:
        ValueError: the shape is (1, 3 or 4, rows, columns).
    """
    if len(shape) == 3 and shape[0] in (1, 3, 4) and shape[-1] > 4:
        raise ValueError(
            "Argument image must have its channels last, (height, width, channels), but its shape is "
            f"{shape}. Move the axis: jnp.moveaxis(image, 0, -1)."
        )


@light_program
def at_focal(lens: Any, focal: Any) -> Any:
    """``lens(focal)`` compiled, for videos.

    It extrapolates beyond the fitted range without a warning: for callers that have checked the range, or
    that measure how uncertain the lens is there.
    """
    return lens._distortion(focal, None)
