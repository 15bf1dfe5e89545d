"""Metadata of TIFF files, which OpenCV neither reads nor writes: read by Pillow, written by tifffile.

OpenCV decodes TIFF files still, as it does all others: tifffile needs a package of codecs for most of them.
"""

import io
import struct
from typing import Any

import cv2
import numpy as np
import tifffile
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from .exif import File, parse_exif

Metadata = list[tuple[int, np.ndarray]]
"""EXIF data, XMP and colour profiles, as OpenCV gives and takes them: pairs of kind and bytes."""

_BASE, _FOLDERS = ExifTags.Base, (ExifTags.IFD.Exif, ExifTags.IFD.GPSInfo)

_TEXTS = (
    *(_BASE.ImageDescription, _BASE.Make, _BASE.Model, _BASE.Software, _BASE.DateTime, _BASE.Artist),
    *(_BASE.HostComputer, _BASE.Copyright),
)
_RESOLUTION = (_BASE.XResolution, _BASE.YResolution, _BASE.ResolutionUnit)
_DESCRIBING = (*_TEXTS, *_RESOLUTION, _BASE.Orientation, *_FOLDERS)
"""Tags that tell of the photograph, and not of how its pixels are stored."""

_OTHERS = ((cv2.IMAGE_METADATA_XMP, 700, 1), (cv2.IMAGE_METADATA_ICCP, 34675, 7))
"""Kinds of metadata that are the content of one tag, and the tag's type."""

_MOST_BYTES = 100_000_000  # of metadata


def tiff_metadata(file: File) -> tuple[Metadata, int]:
    """The metadata of a TIFF file, and its orientation, 1 to 8, which decoders may have undone."""
    exif = parse_exif(file)
    if exif is None:
        return [], 1
    others = [(kind, exif.get(tag)) for kind, tag, _ in _OTHERS]
    for tag in set(exif) - set(_DESCRIBING):
        del exif[tag]
    for tag in set(_TEXTS) & set(exif):
        exif[tag] = _bytes(exif[tag])  # else Pillow writes ASCII alone
    orientation = orientation_of(exif)
    blocks = [(kind, block) for kind, block in others if isinstance(block, bytes)]
    if len(exif):
        blocks.insert(0, (cv2.IMAGE_METADATA_EXIF, exif.tobytes().removeprefix(b"Exif\0\0")))
    metadata = [
        (kind, np.frombuffer(block, np.uint8)) for kind, block in blocks if len(block) < _MOST_BYTES
    ]
    return metadata, orientation


def orientation_of(exif: Image.Exif) -> int:
    """1 to 8; 1, upright, if it is not known."""
    orientation: Any = exif.get(_BASE.Orientation)
    return orientation if orientation in range(1, 9) else 1


def _bytes(text: Any) -> bytes:
    """The bytes of a text as Pillow reads it, of whatever encoding."""
    return str(text).encode("latin-1", "replace")


def as_stored(image: np.ndarray, orientation: int) -> np.ndarray:
    """An image that a decoder has turned by its orientation, 1 to 8, as it was before."""
    if orientation > 4:
        image = image.swapaxes(0, 1)
    down, across = orientation in (3, 4, 6, 7), orientation in (2, 3, 7, 8)
    return np.ascontiguousarray(image[:: -1 if down else 1, :: -1 if across else 1])


def encode_tiff(image: np.ndarray, metadata: Metadata) -> bytes:
    """A TIFF file, without loss, of an image as OpenCV has them and of metadata."""
    blocks = {kind: data.tobytes() for kind, data in metadata}
    exif = parse_exif(io.BytesIO(blocks.get(cv2.IMAGE_METADATA_EXIF, b"").removeprefix(b"Exif\0\0")))
    exif = Image.Exif() if exif is None else exif
    tags: list[Any] = [(tag, 2, 0, _bytes(exif[tag]), True) for tag in _TEXTS if tag in exif]
    tags += [(tag, kind, len(blocks[of]), blocks[of], True) for of, tag, kind in _OTHERS if of in blocks]
    if exif.get(_BASE.Orientation) in range(1, 9):
        tags.append((_BASE.Orientation, 3, 1, exif[_BASE.Orientation], True))
    folders = {int(tag): folder for tag in _FOLDERS if (folder := exif.get_ifd(tag))}
    tags += [(tag + 1, 4, 1, 0, True) for tag in folders]
    integers = image.dtype.kind == "u"
    channels = 1 if image.ndim == 2 else image.shape[2]
    content = io.BytesIO()
    tifffile.imwrite(
        content,
        image if channels == 1 else image[..., [2, 1, 0, 3][:channels]],
        byteorder="<",
        photometric="minisblack" if channels == 1 else "rgb",
        extrasamples=["unassalpha"] if channels == 4 else None,
        compression="zlib" if integers else None,
        compressionargs={"level": 1} if integers else None,
        predictor=integers,
        rowsperstrip=64,
        metadata=None,
        software=False,
        extratags=tags,
        **_resolution(exif),
    )
    _put_folders(content, folders)
    return content.getvalue()


def _resolution(exif: Image.Exif) -> dict[str, Any]:
    across, down, unit = (exif.get(tag) for tag in _RESOLUTION)
    if across is None or down is None or not (0 < across < 1e6 and 0 < down < 1e6):
        return {}
    return {"resolution": (float(across), float(down)), "resolutionunit": unit if unit in (1, 2, 3) else 2}


def _put_folders(content: io.BytesIO, folders: dict[int, dict[int, Any]]) -> None:
    """Append folders of EXIF data, which tifffile does not write.

    It does not even write tags that lead to them: so they get these tags' numbers here, one less.
    """
    content.seek(0)
    with tifffile.TiffFile(content) as file:
        tags = {tag: file.pages.first.tags[tag + 1] for tag in folders}
        places = {tag: (entry.offset, entry.valueoffset) for tag, entry in tags.items()}
    for tag, (entry, value) in places.items():
        folder = ImageFileDirectory_v2(b"II*\0\0\0\0\0", group=tag)
        for key, of in folders[tag].items():
            folder[key] = of
        at = content.seek(0, io.SEEK_END)
        content.write(folder.tobytes(at))
        for place, field in ((entry, struct.pack("<H", tag)), (value, struct.pack("<I", at))):
            content.seek(place)
            content.write(field)
