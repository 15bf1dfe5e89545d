"""Format and size of an image file from its header, before anything is decoded.

A decoder allocates memory for the number of pixels in the header, whatever the file holds. So the header is
read first, by a few lines that need almost no memory.
"""

import re
import struct
from collections.abc import Iterator

from .avif import avif_size
from .heic import heic_size


def announced_format(content: bytes) -> str:
    """Format ("JPEG", "PNG", "WebP", "TIFF", "BMP", "AVIF" or "HEIC") of a file that begins like this.

    Raises:
        ValueError: the content has another format.
    """
    if not content:
        raise ValueError("the file is empty")
    for begins, name, _ in _FORMATS:
        if begins.match(content):
            return name
    raise ValueError(unknown(content))


def unknown(content: bytes) -> str:
    """What a file is that is no photo in a known format, as far as its beginning tells."""
    name = next((name for begins, name in _OTHERS if begins.match(content)), None)
    if name is None:
        return "it is damaged, or of an unknown format"
    return f"it is {name}: convert it to TIFF or PNG first" if "video" not in name else f"it is {name}"


def announced_size(content: bytes) -> tuple[str, int, int]:
    """Format, as `announced_format` has it, width and height that a file's header announces.

    Raises:
        ValueError: the content has another format, or ends before its size.
    """
    for begins, name, size in _FORMATS:
        if begins.match(content):
            try:
                return name, *size(content)
            except (struct.error, OverflowError, StopIteration):  # it ends early, or leads out of the file
                raise ValueError("it is damaged, or of an unknown format") from None
    raise ValueError(unknown(content))


def jpeg_segments(content: bytes) -> Iterator[tuple[int, int]]:
    """The second byte of each marker of a JPEG, and where what follows it begins.

    Markers without content of their own are left out. Compressed pixels are passed over.
    """
    at = 2
    while (mark := _MARK.search(content, at)) is not None:
        yield mark[0][1], mark.end()
        at = mark.end() + int.from_bytes(content[mark.end() : mark.end() + 2], "big")


_MARK = re.compile(rb"\xff[^\x00\x01\xd0-\xd8\xff]", re.DOTALL)
"""What begins a segment, or ends the picture: not what pixels contain, nor what has no length."""

_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers of the segment with the size: one for each way of compressing."""


def _jpeg(content: bytes) -> tuple[int, int]:
    start = next(start for mark, start in jpeg_segments(content) if mark in _FRAMES)
    height, width = struct.unpack_from(">HH", content, start + 3)
    return width, height


def _png(content: bytes) -> tuple[int, int]:
    width, height = struct.unpack_from(">II", content, 16)
    return width, height


def _bmp(content: bytes) -> tuple[int, int]:
    old = struct.unpack_from("<I", content, 14) == (12,)
    width, height = struct.unpack_from("<HH" if old else "<ii", content, 18)
    return abs(width), abs(height)  # a negative height means rows from the top


def _webp(content: bytes) -> tuple[int, int]:
    kind = content[12:16]
    if kind == b"VP8X":
        low, middle, high = struct.unpack_from("<HHH", content, 24)
        return 1 + low + ((middle & 0xFF) << 16), 1 + (middle >> 8) + (high << 8)
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", content, 21)
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    width, height = struct.unpack_from("<HH", content, 26)
    return width & 0x3FFF, height & 0x3FFF


def _tiff(content: bytes) -> tuple[int, int]:
    """From the first page's folder: entries of a tag, a type, a number of values and the first of them."""
    order = "<" if content[:2] == b"II" else ">"
    big = struct.unpack_from(f"{order}H", content, 2) == (43,)
    (folder,) = struct.unpack_from(f"{order}{'Q' if big else 'I'}", content, 8 if big else 4)
    (count,) = struct.unpack_from(f"{order}{'Q' if big else 'H'}", content, folder)
    first, step, value = (folder + 8, 20, 12) if big else (folder + 2, 12, 8)
    size = {}
    for index in range(min(count, 65535)):
        entry = first + step * index
        tag, kind = struct.unpack_from(f"{order}HH", content, entry)
        if tag in (_WIDTH, _HEIGHT):
            (size[tag],) = struct.unpack_from(order + _INTEGERS.get(kind, "I"), content, entry + value)
    if len(size) < 2:
        raise struct.error("no size")
    return size[_WIDTH], size[_HEIGHT]


_WIDTH, _HEIGHT = 256, 257
_INTEGERS = {1: "B", 3: "H", 4: "I", 16: "Q"}

_FORMATS = (
    (re.compile(rb"\xff\xd8\xff"), "JPEG", _jpeg),
    (re.compile(rb"\x89PNG\r\n\x1a\n....IHDR", re.DOTALL), "PNG", _png),
    (re.compile(rb"RIFF....WEBPVP8[ LX]", re.DOTALL), "WebP", _webp),
    (re.compile(rb"II[*+]\0|MM\0[*+]"), "TIFF", _tiff),
    (re.compile(rb"BM"), "BMP", _bmp),
    (re.compile(rb"....ftypavif", re.DOTALL), "AVIF", avif_size),
    (re.compile(rb"....ftyp(hei[cmsx]|hev[cx]|mif1)", re.DOTALL), "HEIC", heic_size),
)

_OTHERS = (
    (re.compile(rb"GIF8[79]a"), "a GIF image"),
    (re.compile(rb"\0\0\0\x0cjP  |\xff\x4f\xff\x51"), "a JPEG 2000 image"),
    (re.compile(rb"\xff\x0a|\0\0\0\x0cJXL "), "a JPEG XL image"),
    (re.compile(rb"....ftypavis", re.DOTALL), "a sequence of AVIF images"),
    (re.compile(rb"....ftypcrx ", re.DOTALL), "a RAW photo without the suffix of one"),
    (re.compile(rb"8BPS"), "a Photoshop file"),
    (re.compile(rb"v/1\x01"), "an OpenEXR image"),
    (re.compile(rb"SDPX|XPDS"), "a DPX image"),
    (re.compile(rb"#\?RADIANCE"), "a Radiance image"),
    (re.compile(rb"P[1-7]\s"), "a PNM image"),
    (re.compile(rb"\x00\x00\x01\x00"), "an icon"),
    (re.compile(rb"%PDF"), "a PDF document"),
    (re.compile(rb"(\xef\xbb\xbf)?\s*<(\?xml|svg)"), "an SVG drawing or another XML document"),
    (re.compile(rb"....ftyp|\x1aE\xdf\xa3|RIFF....AVI ", re.DOTALL), "a video"),
)
"""What is often taken for a photo, and how messages call it."""
