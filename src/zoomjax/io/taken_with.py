"""The names of camera and lens in a photo's EXIF data."""

import io
from pathlib import Path
from typing import Any, NamedTuple

from PIL import ExifTags

from .exif import find_exif, parse_exif
from .headers import announced_format
from .photo import open_photo


class TakenWith(NamedTuple):
    """Names from EXIF data; empty where they are not known."""

    camera: str = ""
    lens: str = ""


def read_taken_with(photo: Path) -> TakenWith:
    """Read the names of camera and lens. No pixel is decoded; a photo that cannot be read has none."""
    try:
        with open_photo(photo) as file:
            kind = announced_format(file.read(16))
            file.seek(0)
            block = find_exif(file, kind)
    except (OSError, ValueError):
        return TakenWith()
    exif = None if block is None else parse_exif(io.BytesIO(block.removeprefix(b"Exif\0\0")))
    if exif is None:
        return TakenWith()
    lens = exif.get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.LensModel)
    return TakenWith(_name(exif.get(ExifTags.Base.Model)), _name(lens))


def _name(value: Any) -> str:
    """A name without what fills up its field; empty for what is none."""
    text = " ".join(value.split("\0")[0].split()) if isinstance(value, str) else ""
    return text if any(letter.isalnum() for letter in text) else ""
