"""Which lens of the database a photo was taken with: from what its EXIF data tell of camera and lens.

Bodies and lenses are found by lensfun's own search, which knows how makers spell them. A lens counts if
its name has all words that the EXIF data have, if the body takes it, and if it has the focal length. What
EXIF data call a lens may be a mere description, its focal lengths and apertures; then all lenses of the
body count that have these. Compact cameras have one lens, which EXIF data need not name.
"""

import dataclasses
import re
from collections.abc import Iterable, Sequence
from typing import Any

from ..io.equipment import Equipment
from .database import LensTable, database, listed, one_named, table_of, tables
from .library import table_for

_SLACK = 1.05
"""How far beyond the focal lengths of a lens those in EXIF data may be: cameras round them."""

_SMALLER_PART = 1.2
"""Ratio of crop factors from which an image shows a part of the sensor only."""

_DESCRIPTION = re.compile(
    r"\s*(?P<low>\d+(\.\d+)?)\s*(mm)?\s*(-\s*(?P<high>\d+(\.\d+)?)\s*mm)?\s*(f/?\s*(?P<stop>[\d.]+(-[\d.]+)?))?\s*",
    re.IGNORECASE,
)


@dataclasses.dataclass(frozen=True)
class LensMatch:
    """A lens of the database that a photo was taken with.

    Attributes:
        table: its table, for a sensor no smaller than the photo's.
        crop: crop factor of the photo.
    """

    table: LensTable
    crop: float


def match_lens(equipment: Equipment, image_size: tuple[int, int], *, lens: str | None = None) -> LensMatch:
    """Find the lens that a photo was taken with, for `library_lens`.

    Args:
        equipment: what the photo's EXIF data say, from `zoomjax.io.read_equipment`.
        image_size: (width, height) px of the photo.
        lens: name of the lens, as for `library_lens`, if that is known; then only the crop factor is looked
            for.

    Raises:
        ImportError: lensfunpy is not installed.
        ValueError: no lens fits, or several do, which the message names; or the crop factor is not known,
            as after digital zoom, or of a photo that was cropped.

    Example:
        >>> from zoomjax.io import Equipment
        >>> photo = Equipment(maker="SONY", camera="ILCE-7M3", lens="FE 24-70mm F2.8 GM", focal=35.0)
        >>> found = match_lens(photo, (6000, 4000))
        >>> found.table.name, found.crop
        ('FE 24-70mm f/2.8 GM', 1.0)
    """
    if equipment.enlarged:
        raise ValueError(
            f"The photo was taken with a digital zoom of {equipment.digital_zoom:.3g}: which part of the "
            "sensor it shows is not known. Make the lens with the crop factor of what it shows, by "
            "library_lens or zoomjax lens, and give that."
        )
    if equipment.written is not None and equipment.cropped(image_size):
        width, height = equipment.written
        raise ValueError(
            f"The photo has {image_size[0]} x {image_size[1]} px, and by its EXIF data the camera wrote "
            f"{width} x {height}: it was cropped, and which part of the sensor it shows is not known. Give "
            "the photo as the camera stored it."
        )
    body = _body(equipment, image_size)
    crop = _crop(body, equipment, image_size)
    found = _fitting(body, equipment) if lens is None else one_named(lens)
    if crop is None:
        raise ValueError(
            "The crop factor of the photo is not known: its EXIF data have neither a camera of the lensfun "
            "database nor the 35 mm equivalent focal length nor the resolution of the focal plane."
        )
    return LensMatch(table_for(found, crop), crop)


def crop_factor(equipment: Equipment, image_size: tuple[int, int]) -> float | None:
    """The crop factor of a photo: by its EXIF data, else of its body in the database; None if not known.

    Without lensfunpy it is that of the EXIF data. After digital zoom it is not known, nor is that of a
    photo that was cropped.
    """
    if equipment.enlarged or equipment.cropped(image_size):
        return None
    if (told := equipment.crop_factor(image_size)) is not None:
        return told
    try:
        return _crop(_body(equipment, image_size), equipment, image_size)
    except ImportError:
        return None


def _fitting(body: Any, equipment: Equipment) -> list[LensTable]:
    """The tables of the one lens that fits.

    Raises:
        ValueError: none fits, or several do.
    """
    if not equipment.camera and not equipment.lens:
        raise ValueError("The lens of the photo is not known: its EXIF data name neither camera nor lens.")
    found = _with_focal(_candidates(body, equipment), equipment.focal)
    different = list(dict.fromkeys(table.name for table in found))
    if len(different) > 1:
        standard = [name for name in different if name.endswith("(Standard)")]  # and not its converters
        different = standard if len(standard) == 1 else different
    shown = f'of "{equipment.lens}"' if equipment.lens else f'of the camera "{equipment.camera}"'
    if len(different) > 1:
        raise ValueError(
            f"{len(different)} lenses of the lensfun database fit the EXIF data {shown}: choose argument "
            f"lens, {listed(different)}."
        )
    if not different:
        near = list(dict.fromkeys(t.name for t in _with_focal(_similar(body, equipment), equipment.focal)))
        hint = (
            f"choose argument lens, perhaps {listed(near)}" if near else "choose argument lens by its name"
        )
        raise ValueError(f"No lens of the lensfun database fits the EXIF data {shown}: {hint}.")
    return [table for table in tables() if table.name == different[0]]


def _candidates(body: Any, equipment: Equipment) -> list[LensTable]:
    """The lenses that the EXIF data may mean, all equally well."""
    if body is not None and body.mount[:1].islower():  # lensfun's sign of a lens that is fixed
        return _tables(database().find_lenses(body))
    if not equipment.lens:
        return []
    described = _DESCRIPTION.fullmatch(equipment.lens)
    if described is None:
        found = _searched(body, equipment)
        same = [lens for lens in found if _bare(lens.model).endswith(_bare(equipment.lens))]
        best = max((lens.score for lens in found), default=0)
        return _tables(same if len(same) == 1 else [lens for lens in found if lens.score == best])
    own = _tables(database().find_lenses(body)) if body is not None else tables()
    low = float(described["low"])
    high = float(described["high"] or low)
    stop = described["stop"] or ""
    return [
        table
        for table in own
        if abs(table.focal_range[0] / low - 1) < 0.03
        and abs(table.focal_range[1] / high - 1) < 0.03
        and (not stop or re.search(rf"[fF/]{re.escape(stop)}(?![\d.-])", table.name))
    ]


def _similar(body: Any, equipment: Equipment) -> list[LensTable]:
    """Lenses with a similar name, for a hint."""
    if body is None or not equipment.lens:
        return []
    return _tables(database().find_lenses(body, None, equipment.lens, loose_search=True)[:_HINTS])


_HINTS = 4


def _searched(body: Any, equipment: Equipment) -> Sequence[Any]:
    """Lensfun's own lenses with all words of the name, for this body if that is known."""
    if body is not None:
        return database().find_lenses(body, None, equipment.lens)
    wanted = _bare(equipment.lens)
    return [lens for lens in database().lenses if _bare(lens.model).endswith(wanted)]


def _tables(lenses: Iterable[Any]) -> list[LensTable]:
    return [table for lens in lenses if (table := table_of(lens)) is not None]


def _with_focal(found: Sequence[LensTable], focal: float | None) -> list[LensTable]:
    """Those that have the focal length."""
    if focal is None:
        return list(found)
    return [t for t in found if t.focal_range[0] / _SLACK <= focal <= t.focal_range[1] * _SLACK]


def _bare(name: str) -> str:
    """A name's letters and digits."""
    return "".join(filter(str.isalnum, name.casefold()))


def _body(equipment: Equipment, image_size: tuple[int, int]) -> Any:
    """Lensfun's camera of this name; the variant for the photo's aspect ratio, if it has such."""
    if not equipment.camera:
        return None
    found = database().find_cameras(equipment.maker or None, equipment.camera)
    shape = max(image_size) / min(image_size)

    def away(camera: Any) -> float:
        ratio = re.fullmatch(r"(\d+):(\d+)", camera.variant or "")
        return 0.05 if ratio is None else abs(int(ratio[1]) / int(ratio[2]) - shape)

    return min(found, key=away, default=None)


def _crop(body: Any, equipment: Equipment, image_size: tuple[int, int]) -> float | None:
    """The body's, unless EXIF data tell that the image shows a part of its sensor only."""
    told = equipment.crop_factor(image_size)
    if body is None:
        return told
    own = round(float(body.crop_factor), 3)
    return told if told is not None and told > _SMALLER_PART * own else own
