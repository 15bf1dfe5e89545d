"""Framing: the part of the corrected plane that an output image shows, and its scale.

Correction bends the border of an image, so the result is not a rectangle. A framing is an affine map from
pixels p of the output to corrected points, ``x = origin + p / scale``: with ``keep="same"`` it is the
identity, ``"all"`` shrinks until every pixel of the input is shown, ``"valid"`` enlarges until no pixel
of the output lies outside of the input, ``"grow"`` adds a border on all sides (overscan) until every pixel
of the input is shown at scale 1. One framing for all focal lengths of a zoom, instead of one per
frame, keeps the framing of a corrected video constant while zooming.
"""

from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core.checks import checked_size
from .._core.fields import check_finite, check_positive, check_shapes, host_numbers
from .._core.types import Point, Points, Scalar, of_known_values
from ..models.distortion import Distortion
from ..models.lens import ZoomLens
from ..models.sizes import check_aspect, check_image_size, checked_distortion, lens_for_size
from ._inverse_polynomial import fold_radius

LARGEST = 32766
"""px a side: `cv2.remap` counts in 16 bits."""

_INSET = 0.02
"""px: how far inside the border "valid" stays, so that errors of positions do not mix the border in."""

_SPARE = 1e-4
"""By how much more "valid" enlarges: next to a fold, little in the corrected image is much in the other."""


def _size(size: Any, name: str) -> tuple[int, int]:
    """A size; those of `jax.export`, which are known when the program runs, as they are."""
    unknown = isinstance(size, tuple) and any(hasattr(side, "__jax_array__") for side in size)
    return size if unknown else checked_size(size, name)


class Framing(eqx.Module):
    """The window on the corrected plane that an output image shows.

    Attributes:
        scale: output pixels per corrected pixel; above 1 enlarges.
        origin: the corrected point, px, shown at the centre of the output's top-left pixel.
        size: (width, height) of the output, px.
        image_size: (width, height) px of the distorted images that it was made for; None for a user-defined
            framing, which is used without checks.

    Example:
        >>> import numpy as np
        >>> Framing(np.array(2.0), np.zeros(2), (4, 4)).corrected(np.ones(2)).tolist()
        [0.5, 0.5]
    """

    scale: Scalar = eqx.field(converter=host_numbers("scale"))
    origin: Point = eqx.field(converter=host_numbers("origin"))
    size: tuple[int, int] = eqx.field(static=True, converter=lambda size: _size(size, "size"))
    image_size: tuple[int, int] | None = eqx.field(
        static=True,
        default=None,
        converter=lambda size: None if size is None else _size(size, "image_size"),
    )

    def __check_init__(self):
        """Check that it is a window: what has no scale, or a negative one, shows nothing, or mirrors."""
        check_shapes({"scale": (self.scale, ()), "origin": (self.origin, (2,))})
        check_positive("scale", self.scale)
        check_finite("origin", self.origin)

    def corrected(self, pixels: Points) -> Float[Array, "*batch 2"]:
        """The corrected points, px, that output pixels show."""
        pixels = jnp.asarray(pixels)
        return jnp.broadcast_to(self.origin, pixels.shape) + pixels / self.scale


@of_known_values
def frame_output(
    distortions: Distortion | Iterable[Distortion] | ZoomLens,
    image_size: tuple[int, int],
    *,
    keep: str = "same",
    size: tuple[int, int] | None = None,
) -> Framing:
    """Choose one framing for the corrected images of one distortion, of several, or of a whole zoom range.

    Args:
        distortions: the distortions of the images, or a `ZoomLens` for 65 focal lengths spread evenly in
            1/f over the fitted range.
        image_size: (width, height) px of the distorted images. A `ZoomLens` for another size is scaled.
        keep: "same" for the geometry of the input, "all" to show every pixel of every input, "valid" to
            show nothing beyond any input's border, "grow" for the geometry of the input on a canvas that is
            enlarged, by as many pixels on opposite sides, until it shows every pixel of every input. Where
            a lens folds (see `Distortion.monotone_radius`), only the part within the fold is used.
        size: (width, height) px of the output; by default `image_size`. Not with "grow".

    Raises:
        ValueError: a size or `keep` is not valid, there is no distortion, one is for images of another size
            or aspect ratio, or ("valid") the images have no common part.

    Warns:
        UserWarning: the lens is for images of another size, so it was scaled.

    Example:
        >>> d = Distortion(np.array([0.1]), np.array([319.5, 239.5]), np.array(400.0))
        >>> float(frame_output(d, (640, 480), keep="all").scale)  # the corners move out by a tenth
        0.9093...
    """
    image_size = checked_size(image_size)
    size = image_size if size is None else checked_size(size, "size")
    check_keep(keep)
    if keep == "grow" and size != image_size:
        raise ValueError('Argument size must be left out with keep="grow", which determines it.')
    middle, reach = (np.array(image_size) - 1) / 2, (np.array(size) - 1) / 2
    if isinstance(distortions, ZoomLens):
        distortions = lens_for_size(distortions, image_size)
    each = _each(distortions)
    for distortion in each:
        check_image_size(distortion, image_size)
    if keep == "same":
        return _framing(1.0, middle, size, image_size)
    inset = _INSET if keep == "valid" else 0.0
    outlines = [_outline(d, image_size, inset) for d in each]
    low, high = np.min(outlines, axis=(0, 1)), np.max(outlines, axis=(0, 1))
    if keep == "grow":
        return _framing(
            1.0, middle, _grown(np.maximum(middle - low, high - middle), image_size), image_size
        )
    if keep == "all":
        middle = (low + high) / 2
        least = np.where(reach > 0, 1e-6, 0.5)  # one pixel shows what is within half a pixel
        scale = float(np.min(np.maximum(reach, 0.5) / np.maximum((high - low) / 2, least)))
    else:
        # An outline encloses what can be seen, so that a rectangle about a seen point holds no unseen one
        # exactly if the outline stays outside of it.
        distance = min(_clearance(abs(outline - middle) / np.maximum(reach, 0.5)) for outline in outlines)
        distance *= 1 - _SPARE
        source = np.stack([np.asarray(d.distort(middle)) for d in each])
        if not (distance > 1e-3 and ((source >= 0) & (source <= np.array(image_size) - 1)).all()):
            raise ValueError(
                'Argument keep="valid" must leave something to show, but the images have no common part '
                'about their middle. Use keep="same".'
            )
        scale = float(1 / distance)
    return _framing(scale, middle, size, image_size)


def _grown(reach: np.ndarray, image_size: tuple[int, int]) -> tuple[int, int]:
    """The image's size and whole pixels on each side, until it reaches so far from the middle, px."""
    more = np.ceil(np.maximum(reach - (np.array(image_size) - 1) / 2 - 1e-6, 0))
    width, height = (int(side + 2 * border) for side, border in zip(image_size, more, strict=True))
    if max(width, height) > LARGEST:
        raise ValueError(
            f'Argument keep="grow" needs a canvas of {width} x {height} px, more than {LARGEST} px a side. '
            'Use keep="all".'
        )
    return width, height


def check_keep(keep: str) -> None:
    """Refuse names that are not known.

    Raises:
        ValueError: it is none of those that `frame_output` takes.
    """
    if keep not in ("same", "all", "valid", "grow"):
        raise ValueError(f'Argument keep must be "same", "all", "valid" or "grow", but it is {keep!r}.')


def check_framing(framing: Framing, image_size: tuple[int, int], name: str) -> None:
    """Refuse a framing that was made for images of another size.

    Raises:
        ValueError: it was, and would show another part; the message names the argument.
    """
    if framing.image_size not in (None, image_size):
        old, new = (f"{width} x {height}" for width, height in (framing.image_size, image_size))
        raise ValueError(
            f"Argument {name} must be a framing for images of {new} px, as this one is, but it was made "
            f"for {old}. Make one by frame_output for this size."
        )


def framing_for_size(framing: Framing, image_size: tuple[int, int]) -> Framing:
    """The same framing for images of the same view with more or fewer pixels.

    A user-defined framing without an image size is returned unchanged.

    Raises:
        ValueError: the images have another aspect ratio.
    """
    if framing.image_size in (None, image_size):
        return framing
    check_aspect(image_size, framing.image_size)
    ratio = np.array(image_size) / np.array(framing.image_size)
    half = 0.5 - 0.5 / float(framing.scale)  # both pixels (0, 0) have their corners at -1/2
    origin = (np.asarray(framing.origin, float) + half) * ratio - half
    width, height = (max(1, round(side)) for side in np.array(framing.size) * ratio)
    return Framing(framing.scale, origin, (width, height), image_size)


def _framing(
    scale: float, middle: np.ndarray, size: tuple[int, int], image_size: tuple[int, int]
) -> Framing:
    """The framing that shows the corrected point `middle` in the middle of the output."""
    origin = middle - (np.array(size) - 1) / 2 / scale
    return Framing(np.asarray(scale, np.float64), origin.astype(np.float64), size, image_size)


def _each(distortions: Distortion | Iterable[Distortion] | ZoomLens) -> list[Distortion]:
    if isinstance(distortions, Distortion):
        return [checked_distortion(distortions, "distortions")]
    if isinstance(distortions, ZoomLens):
        low, high = (float(f) for f in distortions.focal_range)
        focal = np.clip(1 / np.linspace(1 / low, 1 / high, 65), low, high)
        return [distortions(f) for f in focal]
    if not isinstance(distortions, Iterable):
        checked_distortion(distortions, "distortions")
    distortions = [checked_distortion(each, "distortions") for each in distortions]
    if not distortions:
        raise ValueError("Argument distortions must hold at least one distortion, but it is empty.")
    return distortions


def _outline(distortion: Distortion, image_size: tuple[int, int], inset: float) -> np.ndarray:
    """Where the image's border, or the fold before it, is in the corrected image: a loop, (n, 2) px."""
    right, bottom = (max(side - 1 - inset, inset) for side in image_size)
    x = np.linspace(inset, right, 2 * image_size[0])
    y = np.linspace(inset, bottom, 2 * image_size[1])
    border = np.concatenate(
        [
            np.stack([x, 0 * x + inset], 1),
            np.stack([0 * y + right, y], 1),
            np.stack([x[::-1], 0 * x + bottom], 1),
            np.stack([0 * y + inset, y[::-1]], 1),
        ]
    )
    centre = np.asarray(distortion.centre, float)
    away = border - centre
    fold = fold_radius(distortion)
    away *= np.minimum(1, fold / np.maximum(np.hypot(*away.T), 1e-12))[:, None]
    scale = float(distortion.scale)
    squared = np.sum((away / scale) ** 2, axis=1)
    k = np.asarray(distortion.coefficients, float)
    x, y = (away / scale).T
    return centre + scale * np.stack(distortion.distortion_model.correct((x, y), squared, k), axis=1)


def _clearance(apart: np.ndarray) -> float:
    """How near a loop comes to the middle, in the norm whose unit ball is the output's rectangle."""
    across = apart[:, 0] - apart[:, 1]
    after = np.roll(across, -1)
    crosses = across * after < 0  # a corner of the rectangle points between these two: where it touches
    part = np.where(crosses, across / np.where(crosses, across - after, 1), 0)[:, None]
    return float(np.max(apart + part * (np.roll(apart, -1, axis=0) - apart), axis=1).min())
