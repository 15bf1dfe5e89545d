"""Metadata of PNG files: the chunks around the pixels, read and written as they are."""

import contextlib
import struct
import zlib
from collections.abc import Iterator

from .metadata import Metadata

_XMP = b"XML:com.adobe.xmp\0"
_COMMENT = b"Comment\0"
_INCH = 0.0254  # m
_MOST_BYTES = 100_000_000
_COPIED = (b"gAMA", b"cHRM", b"sRGB", b"cICP", b"mDCV", b"cLLI", b"tEXt", b"zTXt", b"iTXt")
"""Chunks that hold for the result as well, whatever is in them."""


def png_metadata(content: bytes) -> tuple[Metadata, list[str]]:
    """The metadata of a PNG file, and what else it holds that is lost when it is written again."""
    fields: dict[str, bytes] = {}
    chunks, others, dpi, shape = [], [], None, None
    for name, block in _chunks(content):
        if name == b"eXIf":
            fields.setdefault("exif", block)
        elif name == b"iTXt" and block.startswith(_XMP):
            fields.setdefault("xmp", _text(block[len(_XMP) :]))
        elif name == b"tEXt" and block.startswith(_COMMENT) and "comment" not in fields:
            fields["comment"] = block[len(_COMMENT) :]
        elif name == b"iCCP":
            fields.setdefault("icc", _inflated(block.partition(b"\0")[2][1:]))
        elif name == b"pHYs" and len(block) == 9:
            across, down, metres = struct.unpack(">IIB", block)
            if across and down and metres:
                dpi = (across * _INCH, down * _INCH)
            elif across and down and across != down:
                shape = (across, down)
        elif name == b"acTL":
            others.append("further pictures")
        elif name in _COPIED:
            chunks.append((name, block))
    return Metadata(**fields, dpi=dpi, shape=shape, chunks=tuple(chunks)), others


def transparent_grey(content: bytes) -> int | None:
    """The value of a grey file's transparent pixels, as of 8 or 16 bits; None if there is none such."""
    depth, colour = content[24], content[25]
    for name, block in _chunks(content):
        if name == b"tRNS" and colour == 0 and len(block) == 2:
            value = int.from_bytes(block, "big") & ((1 << depth) - 1)
            return value if depth >= 8 else value * 255 // ((1 << depth) - 1)
        if name == b"IDAT":
            break
    return None


def with_chunks(content: bytes, metadata: Metadata) -> bytes:
    """An encoded PNG file with metadata; the caller sees to it that they fit in."""
    chunks = []
    if metadata.icc:
        chunks.append((b"iCCP", b"ICC profile\0\0" + zlib.compress(metadata.icc)))
    chunks += [
        (name, block)
        for name, block in metadata.chunks
        if name in _COPIED and not (metadata.icc and name == b"sRGB")
    ]
    if metadata.dpi:
        metres = [min(round(value / _INCH), 2**31 - 1) for value in metadata.dpi]
        chunks.append((b"pHYs", struct.pack(">IIB", *metres, 1)))
    elif metadata.shape:
        chunks.append((b"pHYs", struct.pack(">IIB", *metadata.shape, 0)))
    if metadata.exif:
        chunks.append((b"eXIf", metadata.exif))
    if metadata.xmp:
        chunks.append((b"iTXt", _XMP + b"\0\0\0\0" + metadata.xmp))
    if metadata.comment:
        chunks.append((b"tEXt", _COMMENT + metadata.comment.replace(b"\0", b" ")))
    head = 8 + 4 + 4 + 13 + 4  # the signature and the chunk that comes first
    return content[:head] + b"".join(_written(*chunk) for chunk in chunks) + content[head:]


def _written(name: bytes, block: bytes) -> bytes:
    return struct.pack(">I", len(block)) + name + block + struct.pack(">I", zlib.crc32(name + block))


def _chunks(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    at = 8
    while len(head := content[at : at + 8]) == 8:
        size, name = struct.unpack(">I4s", head)
        yield name, content[at + 8 : at + 8 + size]
        at += size + 12


def _text(block: bytes) -> bytes:
    """The text of an international chunk, after its keyword: perhaps compressed, in some language."""
    compressed = block[:1] == b"\1"
    text = block[2:].partition(b"\0")[2].partition(b"\0")[2]
    return _inflated(text) if compressed else text


def _inflated(block: bytes) -> bytes:
    """What was compressed; nothing if it is damaged, or swells beyond reason."""
    with contextlib.suppress(zlib.error):
        unpacker = zlib.decompressobj()
        content = unpacker.decompress(block, _MOST_BYTES)
        return content if unpacker.eof else b""
    return b""
