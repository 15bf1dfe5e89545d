"""What a photo was taken with, from its EXIF data: camera, lens, and the width of a pixel.

The width of a pixel has two sources. The resolution of the focal plane, in pixels of the image that the
camera wrote, is the more exact. The focal length of equal view on film of 36 x 24 mm is rounded to whole
mm. Where both are there and differ by more than a fifth, the first is taken for a mistake of the camera.
A photo with digital zoom shows a part of the sensor, and makers do not agree on whether the two tell of
that; one that was cropped shows a part, too, and neither tells which. Then the width of a pixel is not
known.
"""

import dataclasses
import io
import math
import os
from pathlib import Path
from typing import Any

from PIL import ExifTags

from .exif import parse_exif
from .photo import read_exif
from .raw import RAW_SUFFIXES

FILM = math.hypot(36, 24)
"""Diagonal of the film that crop factors refer to, mm."""

_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
"""The unit of the resolution of the focal plane, mm."""

_DISAGREE = 1.2
_LEAST, _MOST = 0.2, 30.0
"""Crop factors that there are: from plates to the smallest phones."""
_ENLARGED = 1.02
"""Digital zoom from which it is more than rounding."""
_RESHAPED = 0.01
"""Difference of height over width from which an image has another shape."""


@dataclasses.dataclass(frozen=True)
class Equipment:
    """Camera and lens of a photo, as far as its EXIF data say.

    Attributes:
        maker, camera: of the body; empty if not known.
        lens: the lens; empty if not known.
        focal: focal length, mm.
        plane_pitch: mm from pixel to pixel in the image as the camera wrote it.
        written: width and height px of that image; None if they are not known, as of RAW photos.
        crop: crop factor, from the focal length of equal view on film.
        zoom_range: the ends of the lens's own range, mm; None if they are not known, or one.
        digital_zoom: by how much a part of the image was enlarged; 1 if it was not, or nothing is said.
    """

    maker: str = ""
    camera: str = ""
    lens: str = ""
    focal: float | None = None
    plane_pitch: float | None = None
    written: tuple[int, int] | None = None
    crop: float | None = None
    zoom_range: tuple[float, float] | None = None
    digital_zoom: float = 1.0

    @property
    def enlarged(self) -> bool:
        """Whether there was digital zoom: the image shows less than its lens and sensor would."""
        return self.digital_zoom > _ENLARGED

    def cropped(self, image_size: tuple[int, int]) -> bool:
        """Whether an image of this size has another shape than the camera wrote: it is a part of that."""
        if self.written is None:
            return False
        here, written = sorted(image_size), sorted(self.written)
        most = _RESHAPED + 1 / here[1]  # small copies are rounded to whole pixels
        return abs(here[0] / here[1] - written[0] / written[1]) > most

    def crop_factor(self, image_size: tuple[int, int]) -> float | None:
        """Crop factor of an image of this size: the diagonal of film over that of the sensor shown.

        None if it is not known, as after digital zoom, or of a photo that was cropped.
        """
        if self.enlarged or self.cropped(image_size):
            return None
        direct = self._direct(image_size)
        if direct is not None and self.crop is not None:
            return direct if 1 / _DISAGREE < direct / self.crop < _DISAGREE else self.crop
        return direct or self.crop

    def pixel_pitch(self, image_size: tuple[int, int]) -> float | None:
        """Width of a pixel on the sensor, mm, of an image of this size; None if it is not known."""
        crop = self.crop_factor(image_size)
        return None if crop is None else FILM / (crop * math.hypot(*image_size))

    def _direct(self, image_size: tuple[int, int]) -> float | None:
        """The crop factor by the resolution of the focal plane."""
        if self.plane_pitch is None:
            return None
        crop = FILM / (self.plane_pitch * math.hypot(*(self.written or image_size)))
        return crop if _LEAST < crop < _MOST else None


def read_equipment(source: str | os.PathLike[str]) -> Equipment:
    """Camera and lens in a photo's EXIF data; nothing is known where they have none. No pixel is decoded.

    Raises:
        FileNotFoundError: there is no such photo.
        OSError: it cannot be read.
        ValueError: it is not a photo or not a regular file, or has more than 4 GB.
    """
    block = read_exif(source)
    found = Equipment() if block is None else exif_equipment(block)
    if Path(source).suffix.lower() in RAW_SUFFIXES:  # which may tell the shape of a JPEG beside the whole
        return dataclasses.replace(found, written=None)
    return found


def exif_equipment(block: bytes) -> Equipment:
    """Camera and lens in EXIF data, or at the start of a TIFF file."""
    exif = parse_exif(io.BytesIO(block.removeprefix(b"Exif\0\0")))
    if exif is None:
        return Equipment()
    tags, base = exif.get_ifd(ExifTags.IFD.Exif), ExifTags.Base
    focal, film = _positive(tags.get(base.FocalLength)), _positive(tags.get(base.FocalLengthIn35mmFilm))
    unit = _MM.get(tags.get(base.FocalPlaneResolutionUnit, 2))
    resolution = _positive(tags.get(base.FocalPlaneXResolution))
    width, height = (_positive(tags.get(tag)) for tag in (base.ExifImageWidth, base.ExifImageHeight))
    crop = film / focal if film and focal else None
    return Equipment(
        maker=_text(exif.get(base.Make)),
        camera=_text(exif.get(base.Model)),
        lens=_text(tags.get(base.LensModel)),
        focal=focal,
        plane_pitch=unit / resolution if unit and resolution else None,
        written=(int(width), int(height)) if width and height else None,
        crop=crop if crop and _LEAST < crop < _MOST else None,
        zoom_range=_zoom_range(tags.get(base.LensSpecification)),
        digital_zoom=max(_positive(tags.get(base.DigitalZoomRatio)) or 1.0, 1.0),
    )


def _zoom_range(specification: Any) -> tuple[float, float] | None:
    """Shortest and longest focal length of a lens, mm, which stand before its widest apertures."""
    if not isinstance(specification, tuple) or len(specification) != 4:
        return None
    shortest, longest = map(_positive, specification[:2])
    return (shortest, longest) if shortest and longest and shortest < longest else None


def _positive(value: Any) -> float | None:
    """A positive number; None for what is none, such as 0/0 and the words of damaged data."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if 0 < number < 4e9 else None


def _text(value: Any) -> str:
    """A name without what fills up its field; empty for what is none, as dashes."""
    text = " ".join(value.split("\0")[0].split()) if isinstance(value, str) else ""
    return text if any(letter.isalnum() for letter in text) else ""
