"""RAW photos as cameras write them, developed by rawpy (LibRaw): the extra ``raw``.

Developed plainly and the same for all: the camera's white balance, no automatic brightness, sRGB, 16 bits,
the pixels as stored on the sensor. LibRaw does not correct distortion, nor does it turn the picture.
"""

import contextlib
import io
import struct
from collections.abc import Generator
from typing import Any

import numpy as np
from PIL import ExifTags, Image

from .boxes import boxes
from .exif import exif_in_srgb, parse_exif
from .jpeg import jpeg_metadata
from .metadata import Metadata
from .tiff import tiff_metadata

RAW_SUFFIXES = (
    *(".dng", ".nef", ".nrw", ".cr2", ".cr3", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw"),
    *(".3fr", ".iiq", ".erf", ".mos", ".mrw", ".rwl"),
)


def raw_size(content: bytes) -> tuple[int, int]:
    """Width and height of the developed picture. No pixel is decoded.

    Raises:
        ValueError: rawpy is not installed, or cannot read it.
    """
    with _opened(content) as raw:
        width, height, aspect = raw.sizes.width, raw.sizes.height, raw.sizes.pixel_aspect
        if aspect < 1:  # LibRaw makes pixels square
            return int(width), int(height / aspect + 0.5)
        return int(width * aspect + 0.5), int(height)


def raw_metadata(content: bytes) -> Metadata:
    """EXIF data and XMP, of formats that are TIFF files inside, or hold some or a JPEG file; else empty.

    The colour profile is left out: the picture is developed to sRGB.
    """
    if content.startswith(_FUJI):
        start, length = struct.unpack_from(">2I", content.ljust(_FUJI_HEAD, b"\0"), _FUJI_HEAD - 8)
        metadata, _ = jpeg_metadata(content[start : start + length])
    elif content[4:12] == _CANON:
        metadata = _of_canon(content)
    elif content.startswith(_MINOLTA):
        metadata = _of_minolta(content)
    elif content[:4] in _LIKE_TIFF:
        metadata, _ = tiff_metadata(_LIKE_TIFF[content[:4]] + content[4:])
    elif content[:2] in (b"II", b"MM"):
        metadata, _ = tiff_metadata(content)
    else:
        return Metadata()
    return Metadata(exif=exif_in_srgb(metadata.exif), xmp=metadata.xmp, iptc=metadata.iptc)


NOT_READ = "EXIF data and XMP, which are not read of such files"
"""How messages call what a RAW file may hold where nothing was found."""

_LIKE_TIFF = {
    **dict.fromkeys((b"IIRO", b"IIRS", b"IIU\0"), b"II*\0"),
    b"MMOR": b"MM\0*",
}
"""What files of Olympus and Panasonic begin with, and what it is in TIFF files."""

_FUJI, _FUJI_HEAD = b"FUJIFILMCCD-RAW", 92
"""What files of Fujifilm begin with; at the end of it stands where a JPEG file is, and its length."""


_CANON = b"ftypcrx "
"""What Canon's newer files have after the length of their first box."""

_PARTS = bytes.fromhex("85c0b687820f11e08111f4ce462b6a48")
_PACKET = bytes.fromhex("be7acfcb97a942e89c71999491e3afac")
"""What boxes without a name of their own begin with that hold EXIF data in parts, and the XMP packet."""

_FOLDERS = {b"CMT2": ExifTags.IFD.Exif, b"CMT4": ExifTags.IFD.GPSInfo}


def _of_canon(content: bytes) -> Metadata:
    """Of a file of boxes: each folder of the EXIF data is a TIFF file by itself, in a box of its own."""
    file, xmp, parts = io.BytesIO(content), b"", dict[bytes, Image.Exif | None]()
    with contextlib.suppress(struct.error):  # cut off
        for name, end in boxes(file, len(content)):
            if name == b"uuid" and file.read(16) == _PACKET:
                xmp = file.read(end - file.tell())
            for inner, stop in boxes(file, end) if name == b"moov" else ():
                if inner == b"uuid" and file.read(16) == _PARTS:
                    for part, last in boxes(file, stop):
                        parts[part] = parse_exif(io.BytesIO(file.read(last - file.tell())))
    exif = parts.get(b"CMT1") or Image.Exif()
    for part, folder in _FOLDERS.items():
        if own := parts.get(part):
            exif[folder] = dict(own)
    try:
        block = exif.tobytes().removeprefix(b"Exif\0\0") if exif else b""
    except Exception:  # Pillow raises errors of many kinds for values of damaged data
        block = b""
    return Metadata(exif=block, xmp=xmp)


_MINOLTA = b"\0MRM"


def _of_minolta(content: bytes) -> Metadata:
    """Of a file of blocks, a name and a length, of which one is a TIFF file."""
    place = 8
    while len(head := content[place : place + 8]) == 8:
        name, length = struct.unpack(">4sI", head)
        if name == b"\0TTW":
            return tiff_metadata(content[place + 8 : place + 8 + length])[0]
        place += 8 + length
    return Metadata()


def decode_raw(content: bytes) -> tuple[np.ndarray, Metadata]:
    """The developed picture, 16 bits of blue, green and red, not turned; raises as `raw_size`."""
    with _opened(content) as raw:
        try:
            image = raw.postprocess(use_camera_wb=True, no_auto_bright=True, output_bps=16, user_flip=0)
        except Exception as error:  # of LibRaw's own kinds
            raise ValueError("the file is damaged or cut off") from error
    return np.ascontiguousarray(image[..., ::-1]), raw_metadata(content)


@contextlib.contextmanager
def _opened(content: bytes) -> Generator[Any, None, None]:
    try:
        import rawpy
    except ModuleNotFoundError as error:
        raise ValueError('RAW files need the extra "raw": pip install "zoomjax[raw]"') from error
    try:
        raw = rawpy.imread(io.BytesIO(content))
    except Exception as error:  # as above
        raise ValueError("it is damaged, or LibRaw does not know this camera") from error
    with raw:
        yield raw
