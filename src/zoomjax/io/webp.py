"""Metadata of WebP files: their chunks."""

import struct
from collections.abc import Iterator

from .metadata import Metadata


def webp_metadata(content: bytes) -> tuple[Metadata, list[str]]:
    """The metadata of a WebP file, and what else it holds that is lost when it is written again."""
    chunks: dict[bytes, bytes] = {}
    for name, block in _chunks(content):
        chunks.setdefault(name, block)
    exif = chunks.get(b"EXIF", b"").removeprefix(b"Exif\0\0")
    metadata = Metadata(exif=exif, xmp=chunks.get(b"XMP ", b""), icc=chunks.get(b"ICCP", b""))
    return metadata, ["further pictures"] if b"ANIM" in chunks else []


def _chunks(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    at = 12
    while len(head := content[at : at + 8]) == 8:
        name, size = struct.unpack("<4sI", head)
        yield name, content[at + 8 : at + 8 + size]
        at += 8 + size + size % 2
