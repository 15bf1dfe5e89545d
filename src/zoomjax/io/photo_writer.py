"""Photos encoded with their metadata, and what of these a format does not hold."""

import dataclasses
import re
import struct
from collections.abc import Sequence

import cv2
import numpy as np

from .avif import encode_avif
from .jpeg import with_segments
from .metadata import NAMES, Metadata, missing
from .png import with_chunks
from .tiff import encode_tiff, is_big
from .webp import encode_transparent_webp

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
        if image.dtype.kind == "i" and suffix.lower() not in (".tif", ".tiff"):
            raise ValueError(f"it has signed numbers, which a {suffix} file does not hold: choose .tif")
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
    if kind in (".tif", ".tiff", ".avif") and any(_without_header(metadata.exif) for _, metadata in pages):
        content, lost = encoded_photo(_with_readable_exif(pages), suffix)
        return content, [f"{NAMES['exif']}, which are damaged", *lost]
    if kind in (".tif", ".tiff"):
        lost = ["the camera's data in EXIF"] if is_big(pages) else []
        if any(_MAKER_NOTES.search(metadata.exif) for _, metadata in pages):
            lost.append(MAKER_NOTES)
        held = ("exif", "xmp", "icc", "iptc", "dpi")
        for _, metadata in pages:
            lost += [*missing(metadata, *held), *_chunks_lost(kind, metadata)]
        return encode_tiff(pages), list(dict.fromkeys(lost))
    [(image, metadata)] = pages
    lost = []
    if image.ndim > 2 and metadata.icc[16:20] == b"GRAY":  # which readers refuse
        metadata, lost = dataclasses.replace(metadata, icc=b""), [NAMES["icc"]]
    content, others = _encoded(kind, image, metadata)
    return content, [*lost, *others, *_chunks_lost(kind, metadata)]


def _without_header(exif: bytes) -> bool:
    """Whether EXIF data are none that a file can hold in another form than as they are."""
    return bool(exif) and (exif[:4] not in (b"II*\0", b"MM\0*") or len(exif) < 8)


def _with_readable_exif(pages: Pages) -> Pages:
    return [
        (image, dataclasses.replace(metadata, exif=b"") if _without_header(metadata.exif) else metadata)
        for image, metadata in pages
    ]


def _encoded(kind: str, image: np.ndarray, metadata: Metadata) -> tuple[bytes, list[str]]:
    """The content of a file of one page, and names of the fields of its metadata that it does not hold."""
    if kind == ".avif":
        return encode_avif(image, metadata), missing(metadata, "exif", "xmp", "icc")
    if kind == ".webp":
        return _webp(image, metadata), missing(metadata, "exif", "xmp", "icc")
    content = _by_opencv(kind, image, _JPEG if kind in (".jpg", ".jpeg") else [])
    if kind == ".png":
        return with_chunks(content, metadata), missing(
            metadata, "exif", "xmp", "icc", "comment", "dpi", "shape"
        )
    if kind == ".bmp":
        return _with_density(content, metadata), missing(metadata, "dpi")
    return with_segments(content, metadata)


def _chunks_lost(kind: str, metadata: Metadata) -> list[str]:
    """What files of the source's format alone hold, where this is another one."""
    there = {name for name, _ in metadata.chunks}
    lost: list[str] = []
    if kind not in (".jpg", ".jpeg") and any(len(name) == 1 for name in there):
        lost.append("the rest of the XMP")
    if kind == ".png":
        return lost
    if b"cICP" in there or (there & {b"gAMA", b"cHRM"} and b"sRGB" not in there and not metadata.icc):
        lost.append("the colour space")
    return [*lost, *(["texts"] if there & {b"tEXt", b"zTXt", b"iTXt"} else [])]


def _webp(image: np.ndarray, metadata: Metadata) -> bytes:
    if image.shape[2] == 4:
        return encode_transparent_webp(image, metadata)
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
