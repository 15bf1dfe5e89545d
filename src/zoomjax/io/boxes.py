"""Boxes, of which MP4 and MOV files consist, and Canon's newer RAW files: a length, a name, a content."""

import struct
from collections.abc import Generator
from io import BufferedIOBase


def boxes(file: BufferedIOBase, end: int) -> Generator[tuple[bytes, int], None, None]:
    """Name and end of each box up to a place; the file is where its content begins.

    Raises:
        struct.error: the file ends within the head of a box.
    """
    while (start := file.tell()) + 8 <= end:
        length, name = struct.unpack(">I4s", file.read(8))
        if length == 1:
            (length,) = struct.unpack(">Q", file.read(8))
        stop = end if length == 0 else start + length
        if stop < file.tell() or stop > end:
            return
        yield name, stop
        file.seek(stop)
