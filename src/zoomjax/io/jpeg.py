"""Metadata of JPEG files: the segments before the picture, read and written as they are."""

import re
import struct
from collections.abc import Iterable, Iterator

from .headers import jpeg_segments
from .metadata import Metadata

_EXIF, _XMP, _ICC = b"Exif\0\0", b"http://ns.adobe.com/xap/1.0/\0", b"ICC_PROFILE\0"
_PHOTOSHOP, _MORE_XMP = b"Photoshop 3.0\0", b"http://ns.adobe.com/xmp/extension/\0"
_JFIF, _PICTURES = b"JFIF\0", b"MPF\0"
_APP0, _APP1, _APP2, _APP13, _APP14, _COMMENT, _SCAN, _EOI = 0xE0, 0xE1, 0xE2, 0xED, 0xEE, 0xFE, 0xDA, 0xD9

MOST = 65533
"""Bytes of a segment's content."""

_FILM = b"ftyp"
_ANNOUNCED = re.compile(rb"""((?:MotionPhoto|MicroVideo)=["'])1(?=["'])""")
"""How XMP says that a film follows the picture, as phones append it."""

_PART = MOST - len(_ICC) - 2  # of a colour profile
_INCHES = {1: 1.0, 2: 2.54}


def jpeg_metadata(content: bytes) -> tuple[Metadata, list[str]]:
    """The metadata of a JPEG file, and what else it holds that is lost when it is written again."""
    found: dict[str, bytes] = {}
    profile: dict[int, bytes] = {}
    chunks, others, dpi, shape = [], [], None, None
    for mark, block in _segments(content):
        if mark == _APP1 and block.startswith(_EXIF):
            found.setdefault("exif", block[len(_EXIF) :])
        elif mark == _APP1 and block.startswith(_XMP):
            found.setdefault("xmp", block[len(_XMP) :])
        elif mark == _APP1 and block.startswith(_MORE_XMP):
            chunks.append((bytes([_APP1]), block))
        elif mark == _APP2 and block.startswith(_ICC) and len(block) > len(_ICC) + 2:
            profile[block[len(_ICC)]] = block[len(_ICC) + 2 :]
        elif mark == _APP13 and block.startswith(_PHOTOSHOP):
            found["iptc"] = found.get("iptc", b"") + block[len(_PHOTOSHOP) :]
        elif mark == _COMMENT:
            found.setdefault("comment", block)
        elif mark == _APP0 and block.startswith(_JFIF):
            dpi, shape = _density(block)
        elif mark == _APP2 and block.startswith(_PICTURES):
            others.append("further pictures")
        elif mark in range(0xE0, 0xF0) and mark not in (_APP0, _APP14):
            others.append(f"the segment APP{mark - 0xE0}")
    found["icc"] = b"".join(profile[number] for number in sorted(profile))
    if _FILM in content[_end(content) :]:
        others.append("the film of a motion photo")
        found["xmp"] = _ANNOUNCED.sub(rb"\g<1>0", found.get("xmp", b""))
    return Metadata(**found, dpi=dpi, shape=shape, chunks=tuple(chunks)), list(dict.fromkeys(others))


def _end(content: bytes) -> int:
    """Where the picture ends."""
    return next((start for mark, start in jpeg_segments(content) if mark == _EOI), len(content))


def is_cmyk(content: bytes) -> bool:
    """Whether a JPEG file holds four colours."""
    frames = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
    heads = (content[start : start + 8] for mark, start in jpeg_segments(content) if mark in frames)
    return next((head[7] == 4 for head in heads if len(head) == 8), False)


def with_segments(content: bytes, metadata: Metadata) -> tuple[bytes, list[str]]:
    """An encoded JPEG file with metadata; and names of those that are too long for it."""
    segments, lost = [], []
    for name, mark, begins, block in (
        ("EXIF data", _APP1, _EXIF, metadata.exif),
        ("XMP", _APP1, _XMP, metadata.xmp),
        ("the comment", _COMMENT, b"", metadata.comment),
    ):
        if len(begins) + len(block) > MOST:
            lost.append(name)
        elif block:
            segments.append((mark, begins + block))
    segments += [(chunk[0], block) for chunk, block in metadata.chunks if len(chunk) == 1]
    parts = [metadata.icc[at : at + _PART] for at in range(0, len(metadata.icc), _PART)]
    if len(parts) > 255:
        lost.append("the colour profile")
    else:
        segments += [
            (_APP2, _ICC + bytes([number, len(parts)]) + part) for number, part in enumerate(parts, 1)
        ]
    step = MOST - len(_PHOTOSHOP)
    resources = [metadata.iptc[at : at + step] for at in range(0, len(metadata.iptc), step)]
    segments += [(_APP13, _PHOTOSHOP + part) for part in resources]
    start = 2
    if content[2:4] == b"\xff\xe0":
        start += 2 + int.from_bytes(content[4:6], "big")
    return content[:2] + _header(metadata) + b"".join(_written(segments)) + content[start:], lost


def _segments(content: bytes) -> Iterator[tuple[int, bytes]]:
    """Markers and contents of the segments before the picture."""
    for mark, start in jpeg_segments(content):
        if mark == _SCAN:
            return
        yield mark, content[start + 2 : start + int.from_bytes(content[start : start + 2], "big")]


def _density(block: bytes) -> tuple[tuple[float, float] | None, tuple[int, int] | None]:
    """Pixels per inch in a JFIF header, or else the shape of pixels, as `Metadata` has them."""
    if len(block) < 12:
        return None, None
    unit, across, down = struct.unpack_from(">BHH", block, 7)
    if not across or not down:
        return None, None
    if unit in _INCHES:
        return (across * _INCHES[unit], down * _INCHES[unit]), None
    return None, (across, down) if across != down else None


def _header(metadata: Metadata) -> bytes:
    across, down = (round(value) for value in metadata.dpi or metadata.shape or (1, 1))
    unit = int(metadata.dpi is not None)
    if not (0 < across < 65536 and 0 < down < 65536):
        unit, across, down = 0, 1, 1
    block = _JFIF + struct.pack(">HBHHBB", 0x0102, unit, across, down, 0, 0)
    return b"".join(_written([(_APP0, block)]))


def _written(segments: Iterable[tuple[int, bytes]]) -> Iterator[bytes]:
    for mark, block in segments:
        yield bytes([0xFF, mark]) + struct.pack(">H", len(block) + 2) + block
