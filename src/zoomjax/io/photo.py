"""Reading of photos with their metadata.

Pixels are used as stored, before rotation by the orientation tag, because the lens model refers to these.
"""

import contextlib
import dataclasses
import io
import os
import stat
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from .avif import avif_metadata, decode_avif
from .decoders import by_opencv
from .exif import exif_focal, find_exif
from .headers import announced_format, announced_size, jpeg_segments
from .heic import HEIC_SUFFIXES, decode_heic, heic_metadata, heic_pictures
from .jpeg import is_cmyk, jpeg_metadata
from .metadata import Metadata
from .photo_writer import FORMATS, MAKER_NOTES
from .png import png_metadata, transparent_grey
from .raw import NOT_READ, RAW_SUFFIXES, decode_raw, raw_metadata, raw_size
from .tiff import CMYK, read_tiff, tiff_metadata, tiff_pages, tiff_size
from .webp import webp_metadata

SUFFIXES = (*FORMATS, *HEIC_SUFFIXES, *RAW_SUFFIXES)
"""Of files that count as photographs."""


@dataclasses.dataclass(frozen=True)
class Photo:
    """A photo file.

    Attributes:
        pages: pixels as stored, as OpenCV has them, and metadata; several in a TIFF file only.
        others: what else the file holds that is not among these, such as "further pictures".
        colours: what the file's colours are called where the pixels have others, as of CMYK; else empty.
    """

    pages: tuple[tuple[np.ndarray, Metadata], ...]
    others: tuple[str, ...] = ()
    colours: str = ""


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
    whole: dict[str, Callable[[bytes], Metadata]] = {"HEIC": heic_metadata, "AVIF": avif_metadata}
    with _named(path), open_photo(path) as file:
        if path.suffix.lower() in RAW_SUFFIXES:
            return raw_metadata(file.read(_MOST_BYTES)).exif or None
        kind = announced_format(file.read(16))
        file.seek(0)
        if kind in whole:
            return whole[kind](file.read(_MOST_BYTES)).exif or None
        return find_exif(file, kind)


def read_size(source: str | os.PathLike[str]) -> tuple[int, int]:
    """Read a photo's width and height, px, from its header. It raises as `read_focal`."""
    path = Path(source)
    with _named(path), open_photo(path) as file:
        content = file.read(_MOST_BYTES)
        if path.suffix.lower() in RAW_SUFFIXES:  # whose header begins with a small picture
            return raw_size(content)
        _, width, height = announced_size(content)
    return width, height


def metadata_focal(metadata: Metadata) -> float | None:
    """The focal length, mm, in the metadata from `read_photo`."""
    return exif_focal(metadata.exif) if metadata.exif else None


def read_metadata(source: str | os.PathLike[str]) -> Metadata:
    """Read a photo's metadata, of its first page. No pixel is decoded; raises as `read_focal`."""
    path = Path(source)
    with _named(path), open_photo(path) as file:
        content = file.read(_MOST_BYTES)
        if path.suffix.lower() in RAW_SUFFIXES:
            return raw_metadata(content)
        kind = announced_format(content)
        return _METADATA[kind](content) if kind in _METADATA else Metadata()


def count_pages(source: str | os.PathLike[str]) -> int:
    """How many pages as large as the first a TIFF file has; 1 for others. It raises as `read_focal`."""
    path = Path(source)
    with _named(path), open_photo(path) as file:
        content = file.read(_MOST_BYTES)
        return tiff_pages(content) if announced_format(content) == "TIFF" else 1


def read_photo(source: str | os.PathLike[str]) -> tuple[np.ndarray, Metadata]:
    """Read the pixels as stored, and metadata; of a TIFF file, those of its first page.

    The header is checked before anything is decoded, and only regular files are opened.

    Raises:
        FileNotFoundError: there is no such photograph.
        OSError: it cannot be read.
        ValueError: it cannot be decoded, or has more than 500 million pixels or 4 GB.
    """
    return _read(Path(source), most_pages=1).pages[0]


def read_pages(source: str | os.PathLike[str]) -> Photo:
    """Read all pages of a photo file, and what else is known of it; raises as `read_photo`."""
    return _read(Path(source), most_pages=_MOST_PAGES)


def _read(path: Path, *, most_pages: int) -> Photo:
    with _named(path):
        with open_photo(path) as file:
            content = file.read(_MOST_BYTES)
        if not content:
            raise ValueError("the file is empty")
        if path.suffix.lower() in RAW_SUFFIXES:
            _check_pixels(*raw_size(content))
            page = decode_raw(content)
            return Photo((page,), () if page[1].exif else (NOT_READ,))
        kind, width, height = announced_size(content)
        _check_pixels(width, height)
        return _DECODERS.get(kind, _plain)(content, most_pages)


@contextlib.contextmanager
def _named(path: Path) -> Iterator[None]:
    """Errors of a photo name it."""
    try:
        yield
    except (ValueError, MemoryError) as error:
        reason = error if isinstance(error, ValueError) else "there is not enough memory for it"
        raise ValueError(f"Cannot read a photograph from {path}: {reason}.") from error


def _check_pixels(width: int, height: int) -> None:
    if width * height > _MOST_PIXELS:
        raise ValueError(f"its header announces {width}x{height} px, more than {_MOST_PIXELS:,} in all")


_MOST_BYTES = 4_000_000_000
_MOST_PIXELS = 500_000_000
"""Cameras that shift their sensor give 400 million; three bytes each, and five times that to find lines."""

_MOST_PAGES = 10_000
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


def _jpeg(content: bytes, most_pages: int) -> Photo:
    if all(mark != _END for mark, _ in jpeg_segments(content)):
        raise ValueError("the file is damaged or cut off")  # OpenCV fills up what is missing with grey
    metadata, others = jpeg_metadata(content)
    return Photo(((_decoded(content), metadata),), tuple(others), CMYK if is_cmyk(content) else "")


def _png(content: bytes, most_pages: int) -> Photo:
    metadata, others = png_metadata(content)
    image = _decoded(content)
    if image.ndim == 2 and (transparent := transparent_grey(content)) is not None:  # which OpenCV drops
        most = np.iinfo(image.dtype).max
        alpha = np.where(image == transparent, 0, most).astype(image.dtype)
        image = np.dstack([image, image, image, alpha])
    return Photo(((image, metadata),), tuple(others))


def _webp(content: bytes, most_pages: int) -> Photo:
    metadata, others = webp_metadata(content)
    return Photo(((_decoded(content), metadata),), tuple(others))


def _tiff(content: bytes, most_pages: int) -> Photo:
    if most_pages > 1 and (number := tiff_size(content)) > _MOST_PIXELS:
        raise ValueError(f"its pages have {number:,} pixels, more than {_MOST_PIXELS:,}")
    pages = read_tiff(content, most_pages=most_pages)
    notes = [MAKER_NOTES] if any(page.notes for page in pages) else []
    others = tuple(dict.fromkeys([*notes, *(other for page in pages for other in page.others)]))
    colours = next(filter(None, (page.colours for page in pages)), "")
    return Photo(tuple((page.image, page.metadata) for page in pages), others, colours)


def _heic(content: bytes, most_pages: int) -> Photo:
    return Photo((decode_heic(content),), ("further pictures",) if heic_pictures(content) > 1 else ())


def _avif(content: bytes, most_pages: int) -> Photo:
    image, metadata, others = decode_avif(content)
    return Photo(((image, metadata),), tuple(others))


def _bmp_metadata(content: bytes) -> Metadata:
    if len(content) < 46 or struct.unpack_from("<I", content, 14)[0] < 40:
        return Metadata()
    across, down = (round(value * 0.0254, 2) for value in struct.unpack_from("<ii", content, 38))
    return Metadata(dpi=(across, down) if across > 0 and down > 0 else None)


def _plain(content: bytes, most_pages: int) -> Photo:
    image = _decoded(content)
    lost = ("transparency",) if _has_fourth(content, image) else ()
    return Photo(((image, _bmp_metadata(content)),), lost)


def _has_fourth(content: bytes, image: np.ndarray) -> bool:
    """Whether a BMP file has a fourth channel that was not decoded, and that is not one number.

    Some programs keep transparency there, where the format has nothing.
    """
    if len(content) < 34 or image.shape[2:] != (3,) or struct.unpack_from("<H", content, 28)[0] != 32:
        return False
    start, (height, width) = struct.unpack_from("<I", content, 10)[0], image.shape[:2]
    fourth = np.frombuffer(content[start : start + 4 * width * height], np.uint8)[3::4]
    return bool(fourth.size and np.ptp(fourth))


_DECODERS: dict[str, Callable[[bytes, int], Photo]] = {
    "JPEG": _jpeg,
    "PNG": _png,
    "WebP": _webp,
    "TIFF": _tiff,
    "HEIC": _heic,
    "AVIF": _avif,
}
_METADATA: dict[str, Callable[[bytes], Metadata]] = {
    "JPEG": lambda content: jpeg_metadata(content)[0],
    "PNG": lambda content: png_metadata(content)[0],
    "WebP": lambda content: webp_metadata(content)[0],
    "TIFF": lambda content: tiff_metadata(content)[0],
    "HEIC": heic_metadata,
    "AVIF": avif_metadata,
    "BMP": _bmp_metadata,
}


def _decoded(content: bytes) -> np.ndarray:
    image = by_opencv(cv2.imdecode, content)
    if image is None:
        raise ValueError("it is damaged, or of an unknown format")
    return image
