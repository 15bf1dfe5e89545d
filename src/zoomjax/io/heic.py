"""HEIC photographs, as phones take them, by pillow-heif: the extra ``heic``.

The decoder turns them upright, as properties of the file say, whatever orientation their EXIF data have.
So pictures are turned back by those properties, and the EXIF data get the orientation that these mean: in
files of other formats it is what viewers follow.
"""

import dataclasses
import io
import struct
from collections.abc import Iterator, Mapping
from types import ModuleType
from typing import Any

import numpy as np

from .exif import exif_with_orientation, parse_exif
from .metadata import Metadata
from .tiff import as_stored, orientation_of

HEIC_SUFFIXES = (".heic", ".heif")


def heic_size(content: bytes) -> tuple[int, int]:
    """Width and height of the pixels as stored, as `decode_heic` gives them. None is decoded.

    Raises:
        ValueError: pillow-heif is not installed, or cannot read it.
    """
    width, height = _opened(content).size
    return (height, width) if _orientation(heic_metadata(content)) in _ON_THE_SIDE else (width, height)


def heic_pictures(content: bytes) -> int:
    """How many pictures a file holds, of which the main one is decoded.

    Raises:
        ValueError: as `heic_size`.
    """
    return len(_opened(content))


def heic_metadata(content: bytes) -> Metadata:
    """EXIF data, XMP and colour profile. No pixel is decoded.

    Raises:
        ValueError: as `heic_size`.
    """
    return _told_truly(metadata_in(_opened(content).info), orientation_in(content))


def metadata_in(info: Mapping[Any, Any]) -> Metadata:
    """What Pillow, and libraries that follow it, tell of a picture."""
    exif, xmp, icc = (info.get(name) for name in ("exif", "xmp", "icc_profile"))
    exif, xmp, icc = (block if isinstance(block, bytes) else b"" for block in (exif, xmp, icc))
    return Metadata(exif=exif.removeprefix(b"Exif\0\0"), xmp=xmp, icc=icc)


def decode_heic(content: bytes) -> tuple[np.ndarray, Metadata]:
    """The pixels as stored, as OpenCV has them, all their bits kept; and the metadata.

    Raises:
        ValueError: as `heic_size`, or it is damaged, or shows a part of its pixels alone.
    """
    picture, metadata = _opened(content), heic_metadata(content)
    if shows_a_part(content, picture.size):  # which alone the decoder gives
        raise ValueError(
            "it shows a part of the pixels it holds (clap), in which the lens's centre is elsewhere: give "
            "it as the camera wrote it, or save all of it in another format"
        )
    try:
        image = np.array(picture)  # a copy: the memory goes with the picture
    except Exception as error:  # of whatever kind libheif's are
        raise ValueError("the file is damaged or cut off") from error
    return as_stored(image, _orientation(metadata)), metadata


def orientation_in(content: bytes) -> int | None:
    """The orientation, 1 to 8, of which the properties of a file tell; None if they tell of several.

    They are all in one box (ISO/IEC 23008-12, 6.5.10 and 6.5.12). Turns come before reflections (MIAF).
    """
    turns, mirrors = set[int](), set[int]()
    for name, block in _properties(content):
        if name == b"irot":
            turns.add(block[0] & 3)
        elif name == b"imir":
            mirrors.add(block[0] & 1)
    if len(turns) > 1 or len(mirrors) > 1:
        return None
    return _ORIENTATIONS[next(iter(turns), 0)][next(iter(mirrors), -1) + 1]


def shows_a_part(content: bytes, size: tuple[int, int] | None = None) -> bool:
    """Whether a file says to show a part of its pixels, beyond what encoders fill up, or less than 2 %.

    That is a property of the file, too (6.5.9), with the width and height of the part and its offset from
    the middle. Of several pictures, the one of this `size`, perhaps turned, counts; None: any.
    """
    properties = list(_properties(content))
    whole = [
        struct.unpack_from(">4x2I", block) for name, block in properties if (name, len(block)) == _SIZE
    ]
    for name, block in properties:
        if (name, len(block)) != _PART:
            continue
        numbers = struct.unpack(">2I2I2i2i", block)
        wide, high, right, down = (numbers[n] / (numbers[n + 1] or 1) for n in (0, 2, 4, 6))
        of = min((full for full in whole if full[0] >= wide and full[1] >= high), default=None)
        if of is None or (size is not None and sorted(size) != sorted((round(wide), round(high)))):
            continue
        for full, part, offset in ((of[0], wide, right), (of[1], high, down)):
            before, after = (full - part) / 2 + offset, (full - part) / 2 - offset
            if before > _SMALL * full or after > max(_SMALL * full, _FILLED):
                return True
    return False


_ON_THE_SIDE = range(5, 9)
"""Orientations of pictures that are shown with width and height exchanged."""

_SIZE, _PART = (b"ispe", 12), (b"clap", 32)
"""Properties of a picture: its size; the part to be shown."""

_SMALL, _FILLED = 0.02, 64


def _properties(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    """The properties of a file's pictures, which are all in one box: names and contents."""
    at = content.find(b"ipco")
    end = at - 4 + int.from_bytes(content[at - 4 : at]) if at >= 4 else 0
    at += 4
    while at + 8 < end <= len(content):
        size = max(int.from_bytes(content[at : at + 4]), 8)
        yield content[at + 4 : at + 8], content[at + 8 : at + max(size, 9)]
        at += size


_ORIENTATIONS = ((1, 4, 2), (8, 5, 7), (3, 2, 4), (6, 7, 5))
"""By quarter turns against the clock, and reflections after them: none, up and down, left and right."""


def _told_truly(metadata: Metadata, orientation: int | None) -> Metadata:
    """Metadata with the orientation by which the decoder has turned the picture."""
    if orientation is None or orientation == _orientation(metadata):
        return metadata
    return dataclasses.replace(metadata, exif=exif_with_orientation(metadata.exif, orientation))


def _orientation(metadata: Metadata) -> int:
    parsed = parse_exif(io.BytesIO(metadata.exif))
    return 1 if parsed is None else orientation_of(parsed)


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
