"""Lenses of the database as zoom lenses: continuous, differentiable, and proved invertible.

The zoom models are those of files that lensfun reads (`zoomjax.interop.radial_table`).
"""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._core.checks import checked_size
from ..models.lens import ZoomLens
from .database import LensTable, one_named, version
from .radial_table import LARGER, MODELS, SPARE, RadialTable, TableFit, pitch_by_crop, zoom_of_table


def library_lens(
    lens: str | LensTable,
    *,
    image_size: tuple[int, int],
    crop: float | int | None = None,
    model: str = "auto",
) -> ZoomLens:
    """Make a lens of the lensfun database a `ZoomLens`.

    Its `about` has what it is of, and ``table_error_px``: how far it puts a point of the distorted image
    from where lensfun does, at most, over the whole image and all focal lengths, px. A magnification of
    each focal length is left out of that: it leaves lines straight, and lensfun's versions differ in it.

    The corrected image has the scale of the original in its centre.

    Args:
        lens: its name, or words of it that no other lens has (`find_lenses`); or one of its tables.
        image_size: (width, height) px of the images. They show the whole sensor, or the part of it that
            `crop` is for.
        crop: crop factor of the images, 43.27 mm over the diagonal of the sensor. By default that of the
            sensor on which the lens was calibrated.
        model: "smooth" for a `SmoothZoom`, "table" for a `TableZoom`, or "auto" for a zoom the first of
            these within a pixel of the table, and for a single focal length a `TableZoom` of it.

    Raises:
        ImportError: lensfunpy is not installed.
        ValueError: no lens has this name, or several have; its tables are for smaller sensors only; or
            the model asked for is not invertible; or no camera has images of this size and crop factor.

    Example:
        >>> lens = library_lens("nikkor 18-200mm f/3.5-5.6g if-ed ii", image_size=(4288, 2848))
        >>> lens(35.0).undistort([0.0, 0.0]).round().tolist()
        [95.0, 63.0]
    """
    size = checked_size(image_size)
    if model not in MODELS:
        raise ValueError(f"Argument model must be one of {', '.join(MODELS)}, but it is {model!r}.")
    if crop is not None and not (isinstance(crop, int | float) and 0 < crop < math.inf):
        raise ValueError(f"Argument crop must be a positive number, the crop factor, but it is {crop!r}.")
    table = table_for(one_named(lens), crop) if isinstance(lens, str) else table_for([lens], crop)
    crop = table.crop_factor if crop is None else float(crop)
    centre = _centre(table, size)
    unit = math.hypot(table.aspect_ratio, 1) * table.crop_factor / crop
    # Of the three kinds, poly5 alone has the magnification 1 in the centre in all versions of lensfun.
    told = RadialTable(table.focal, _range(table), table.polynomial, unit, scaled=table.kind != "POLY5")
    found = zoom_of_table(told, centre=centre, image_size=size, model=model)
    if found is not None:
        return _lens(table, found, centre, size, crop)
    raise ValueError(
        f'The lens "{table.name}" folds its images over as a {model} model: choose another model.'
        if model != "auto"
        else f'The table of the lens "{table.name}" folds its images over: it cannot be used.'
    )


def table_for(found: list[LensTable], crop: float | int | None) -> LensTable:
    """The table of a lens from the sensor that is nearest, and not smaller.

    Raises:
        ValueError: all are from smaller sensors.
    """
    if crop is None:
        return min(found, key=lambda table: table.crop_factor)
    covering = [table for table in found if table.crop_factor <= crop * LARGER]
    if not covering:
        least = min(table.crop_factor for table in found)
        raise ValueError(
            f'The lens "{found[0].name}" was calibrated on a sensor of crop factor {least:g}, and images '
            f"of crop factor {crop:g} show more than that: the database has no data there."
        )
    return max(covering, key=lambda table: table.crop_factor)


def _range(table: LensTable) -> tuple[float, float]:
    """The focal lengths that a lens is for."""
    low, high = table.focal_range
    return low / SPARE, high * SPARE


def _lens(
    table: LensTable, found: TableFit, centre: Float[np.ndarray, "2"], size: tuple[int, int], crop: float
) -> ZoomLens:
    return ZoomLens(
        zoom=found.zoom,
        centre=jnp.asarray(centre),
        focal_range=jnp.asarray(_range(table)),
        image_size=size,
        pixel_pitch=pitch_by_crop(crop, size),
        about={
            "lens": table.name,
            "maker": table.maker,
            "crop_factor": crop,
            "table_error_px": float(f"{found.error:.3g}"),
            "source": f"lensfun database, CC BY-SA 3.0, of lensfunpy {version()}",
        },
    )


def _centre(table: LensTable, size: tuple[int, int]) -> Float[np.ndarray, "2"]:
    """The centre of distortion, px; lensfun has it in halves of the shorter side from the middle."""
    off = np.array([table.source.center_x, table.source.center_y], float)
    return (np.array(size) - 1) / 2 + off * (min(size) - 1) / 2
