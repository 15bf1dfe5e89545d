"""HEIC photographs, as phones take them, by pillow-heif: the extra ``heic``.

The decoder turns them upright. They are turned back by the orientation in their EXIF data, which cameras
write beside the one that the decoder follows.
"""

import io
from collections.abc import Mapping
from types import ModuleType
from typing import Any

import numpy as np

from .exif import parse_exif
from .metadata import Metadata
from .tiff import as_stored, orientation_of

HEIC_SUFFIXES = (".heic", ".heif")


def heic_size(content: bytes) -> tuple[int, int]:
    """Width and height. No pixel is decoded.

    Raises:
        ValueError: pillow-heif is not installed, or cannot read it.
    """
    return _opened(content).size


def heic_metadata(content: bytes) -> Metadata:
    """EXIF data, XMP and colour profile. No pixel is decoded.

    Raises:
        ValueError: as `heic_size`.
    """
    return metadata_in(_opened(content).info)


def metadata_in(info: Mapping[Any, Any]) -> Metadata:
    """What Pillow, and libraries that follow it, tell of a picture."""
    exif, xmp, icc = (info.get(name) for name in ("exif", "xmp", "icc_profile"))
    exif, xmp, icc = (block if isinstance(block, bytes) else b"" for block in (exif, xmp, icc))
    return Metadata(exif=exif.removeprefix(b"Exif\0\0"), xmp=xmp, icc=icc)


def decode_heic(content: bytes) -> tuple[np.ndarray, Metadata]:
    """The pixels as stored, as OpenCV has them, all their bits kept; and the metadata.

    Raises:
        ValueError: as `heic_size`, or it is damaged.
    """
    picture, metadata = _opened(content), heic_metadata(content)
    try:
        image = np.array(picture)  # a copy: the memory goes with the picture
    except Exception as error:  # of whatever kind libheif's are
        raise ValueError("the file is damaged or cut off") from error
    parsed = parse_exif(io.BytesIO(metadata.exif))
    return as_stored(image, 1 if parsed is None else orientation_of(parsed)), metadata


def _opened(content: bytes):
    library = _library()
    try:
        return library.open_heif(io.BytesIO(content), convert_hdr_to_8bit=False, bgr_mode=True)
    except Exception as error:  # as above
        raise ValueError("it is damaged, or of an unknown format") from error


def _library() -> ModuleType:
    try:
        import pillow_heif
    except ModuleNotFoundError as error:
        raise ValueError('HEIC files need the extra "heic": pip install "zoomjax[heic]"') from error
    return pillow_heif
