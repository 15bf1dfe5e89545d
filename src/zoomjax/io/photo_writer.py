"""Photos encoded with their metadata, and what of these a format does not hold."""

import re
import struct
from collections.abc import Sequence

import cv2
import numpy as np

from .avif import encode_avif
from .jpeg import with_segments
from .metadata import Metadata, missing
from .png import with_chunks
from .tiff import encode_tiff, is_big

FORMATS = {  # suffix: bits a sample, and numbers of channels, that the format holds
    **dict.fromkeys([".jpg", ".jpeg"], ((8,), (1, 3))),
    ".png": ((8, 16), (1, 3, 4)),
    ".webp": ((8,), (3, 4)),
    **dict.fromkeys([".tif", ".tiff"], ((8, 16, 32, 64), (1, 3, 4))),
    ".bmp": ((8,), (1, 3, 4)),
    ".avif": ((8,), (3, 4)),
}
"""Files that can be written."""

_JPEG = [
    *(cv2.IMWRITE_JPEG_QUALITY, 97),
    *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
]
_WEBP = [cv2.IMWRITE_WEBP_QUALITY, 101]  # above 100: without loss

_MAKER_NOTES = re.compile(rb"\x7c\x92[\x01\x07]\0|\x92\x7c\0[\x01\x07]")
"""Their tag and type in EXIF data, in both orders of bytes."""

MAKER_NOTES = "the camera maker's notes"
"""How messages call what does not survive being moved, and is left out of TIFF files."""

Pages = Sequence[tuple[np.ndarray, Metadata]]


def check_written(pages: Pages, suffix: str) -> None:
    """Refuse what a format cannot store without loss of channels, bits or pages: before any work.

    Raises:
        ValueError: it cannot; the message says which can.
    """
    bits, channels = FORMATS[suffix.lower()]
    for image, _ in pages:
        own = 1 if image.ndim == 2 else image.shape[2]
        if 8 * image.dtype.itemsize not in bits or own not in channels:
            raise ValueError(
                f"it has {own} channels of {8 * image.dtype.itemsize} bits, which a {suffix} file does not "
                "hold: choose .png or .tif"
            )
    if len(pages) > 1 and suffix.lower() not in (".tif", ".tiff"):
        raise ValueError(f"it has {len(pages)} pages, which a {suffix} file does not hold: choose .tif")


def encoded_photo(pages: Pages, suffix: str) -> tuple[bytes, list[str]]:
    """The content of a file in the format of a suffix, and names of the metadata that it does not hold.

    Raises:
        ValueError: as `check_written`, or the encoder fails.
    """
    check_written(pages, suffix)
    kind = suffix.lower()
    if kind in (".tif", ".tiff"):
        lost = ["the camera's data in EXIF"] if is_big(pages) else []
        if any(_MAKER_NOTES.search(metadata.exif) for _, metadata in pages):
            lost.append(MAKER_NOTES)
        return encode_tiff(pages), [*lost, *_lost(pages, "exif", "xmp", "icc", "iptc", "dpi")]
    [(image, metadata)] = pages
    if kind == ".avif":
        return encode_avif(image, metadata), _lost(pages, "exif", "xmp", "icc")
    if kind == ".webp":
        return _webp(image, metadata), _lost(pages, "exif", "xmp", "icc")
    content = _by_opencv(kind, image, _JPEG if kind in (".jpg", ".jpeg") else [])
    if kind == ".png":
        return with_chunks(content, metadata), _lost(pages, "exif", "xmp", "icc", "comment", "dpi", "shape")
    if kind == ".bmp":
        return _with_density(content, metadata), _lost(pages, "dpi")
    return with_segments(content, metadata)


def _lost(pages: Pages, *held: str) -> list[str]:
    return list(dict.fromkeys(name for _, metadata in pages for name in missing(metadata, *held)))


def _webp(image: np.ndarray, metadata: Metadata) -> bytes:
    known = (
        (cv2.IMAGE_METADATA_EXIF, metadata.exif),
        (cv2.IMAGE_METADATA_XMP, metadata.xmp),
        (cv2.IMAGE_METADATA_ICCP, metadata.icc),
    )
    blocks = [(kind, np.frombuffer(block, np.uint8)) for kind, block in known if block]
    if not blocks:
        return _by_opencv(".webp", image, _WEBP)
    kinds, data = zip(*blocks, strict=True)
    try:
        done, content = cv2.imencodeWithMetadata(".webp", image, list(kinds), list(data), _WEBP)
    except cv2.error as error:
        raise ValueError(f"it cannot be written as .webp: {error.err}") from error
    if not done:
        raise ValueError("it cannot be written as .webp")
    return content.tobytes()


def _by_opencv(suffix: str, image: np.ndarray, options: list[int]) -> bytes:
    try:
        done, content = cv2.imencode(suffix, image, options)
    except cv2.error as error:
        raise ValueError(f"it cannot be written as {suffix}: {error.err}") from error
    if not done:
        raise ValueError(f"it cannot be written as {suffix}: {image.dtype}, shape {image.shape}")
    return content.tobytes()


def _with_density(content: bytes, metadata: Metadata) -> bytes:
    """A BMP file with its resolution, in pixels per metre."""
    if metadata.dpi is None:
        return content
    metres = struct.pack("<ii", *(min(round(value / 0.0254), 2**31 - 1) for value in metadata.dpi))
    return content[:38] + metres + content[46:]
