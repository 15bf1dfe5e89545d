"""Reading of photos with their metadata.

Pixels are used as stored, before rotation by the orientation tag, because the lens model refers to these.
"""

import contextlib
import io
import os
import stat
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from .exif import exif_focal, find_exif
from .headers import announced_format, announced_size, jpeg_segments
from .heic import HEIC_SUFFIXES, decode_heic, heic_metadata
from .tiff import Metadata, as_stored, tiff_metadata

FORMATS = {  # suffix: bits a sample, and numbers of channels, that the format holds
    **dict.fromkeys([".jpg", ".jpeg"], ((8,), (1, 3))),
    ".png": ((8, 16), (1, 3, 4)),
    ".webp": ((8,), (3, 4)),
    **dict.fromkeys([".tif", ".tiff"], ((8, 16, 32, 64), (1, 3, 4))),
    ".bmp": ((8,), (1, 3, 4)),
}
SUFFIXES = (*FORMATS, *HEIC_SUFFIXES)
"""Of files that count as photographs."""


def read_focal(source: str | os.PathLike[str]) -> float | None:
    """Read the focal length, mm, from a photo's EXIF data; None if they have none. No pixel is decoded.

    Raises:
        FileNotFoundError: there is no such photograph.
        OSError: it cannot be read.
        ValueError: it is not a photo or not a regular file, or has more than 4 GB.
    """
    block = read_exif(source)
    return None if block is None else exif_focal(block)


def read_exif(source: str | os.PathLike[str]) -> bytes | None:
    """Read a photo's EXIF data; None if it has none. No pixel is decoded. It raises as `read_focal`."""
    path = Path(source)
    try:
        with open_photo(path) as file:
            kind = announced_format(file.read(16))
            file.seek(0)
            if kind == "HEIC":
                return next(_exif_blocks(heic_metadata(file.read(_MOST_BYTES))), None)
            return find_exif(file, kind)
    except ValueError as error:
        raise ValueError(f"Cannot read a photograph from {path}: {error}.") from error


def read_size(source: str | os.PathLike[str]) -> tuple[int, int]:
    """Read a photo's width and height, px, from its header. It raises as `read_focal`."""
    path = Path(source)
    try:
        with open_photo(path) as file:
            _, width, height = announced_size(file.read(_MOST_BYTES))
    except ValueError as error:
        raise ValueError(f"Cannot read a photograph from {path}: {error}.") from error
    return width, height


def metadata_focal(metadata: Metadata) -> float | None:
    """The focal length, mm, in the metadata from `read_photo`."""
    return next((exif_focal(block) for block in _exif_blocks(metadata)), None)


def _exif_blocks(metadata: Metadata) -> Iterator[bytes]:
    return (data.tobytes() for kind, data in metadata if kind == cv2.IMAGE_METADATA_EXIF)


def read_photo(source: str | os.PathLike[str]) -> tuple[np.ndarray, Metadata]:
    """Read the pixels as stored, and metadata (EXIF, XMP, colour profile) as pairs of kind and bytes.

    The header is checked before anything is decoded, and only regular files are opened.

    Raises:
        FileNotFoundError: there is no such photograph.
        OSError: it cannot be read.
        ValueError: it cannot be decoded, or has more than 500 million pixels or 4 GB.
    """
    path = Path(source)
    try:
        with open_photo(path) as file:
            content = file.read(_MOST_BYTES)
        if not content:
            raise ValueError("the file is empty")
        kind, width, height = announced_size(content)
        if width * height > _MOST_PIXELS:
            raise ValueError(f"its header announces {width}x{height} px, more than {_MOST_PIXELS:,} in all")
        if kind == "JPEG" and all(mark != _END for mark, _ in jpeg_segments(content)):
            raise ValueError("the file is damaged or cut off")  # OpenCV fills up what is missing with grey
        if kind == "HEIC":
            return decode_heic(content)
        image, metadata = _decoded(np.frombuffer(content, np.uint8), metadata=kind in _WITH_METADATA)
        if kind == "TIFF":
            metadata, orientation = tiff_metadata(io.BytesIO(content))
            image = as_stored(image, orientation)  # OpenCV turns TIFF files, whatever it is asked
        return image, metadata
    except (ValueError, MemoryError) as error:
        reason = error if isinstance(error, ValueError) else "there is not enough memory for it"
        raise ValueError(f"Cannot read a photograph from {path}: {reason}.") from error


_WITH_METADATA = ("JPEG", "PNG", "WebP")
"""Formats whose metadata OpenCV knows."""

_MOST_BYTES = 4_000_000_000
_MOST_PIXELS = 500_000_000
"""Cameras that shift their sensor give 400 million; three bytes each, and five times that to find lines."""

_END = 0xD9
"""The marker at the end of a JPEG's picture; phones append films and other pictures."""


@contextlib.contextmanager
def open_photo(path: Path) -> Iterator[io.BufferedReader]:
    """The file for reading: one that has an end, and not a pipe, which would be waited for.

    Raises:
        FileNotFoundError: there is no such photograph.
        OSError: it cannot be read.
        ValueError: it is not a regular file, or too large.
    """
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    try:
        descriptor = os.open(path, flags)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"There is no photograph {path}.") from error
    with open(descriptor, "rb") as file:
        about = os.fstat(descriptor)
        if not stat.S_ISREG(about.st_mode):
            raise ValueError("it is not a regular file")
        if about.st_size > _MOST_BYTES:
            raise ValueError(f"it has {about.st_size / 1e9:.1f} GB, more than {_MOST_BYTES / 1e9:.0f}")
        yield file


def _decoded(content: np.ndarray, *, metadata: bool) -> tuple[np.ndarray, Metadata]:
    kinds, blocks = [], []
    try:
        if metadata:
            image, kinds, blocks = cv2.imdecodeWithMetadata(content, flags=cv2.IMREAD_UNCHANGED)
        else:
            image = cv2.imdecode(content, cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        if error.code == cv2.Error.StsNoMem:
            raise MemoryError from error
        raise ValueError(f"OpenCV cannot decode it ({error.err})") from error
    if image is None:
        raise ValueError("it is damaged, or of an unknown format")
    return image, [
        (int(kind), np.asarray(data, np.uint8)) for kind, data in zip(kinds, blocks, strict=True)
    ]
