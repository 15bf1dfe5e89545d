"""The part of its pictures that a video says to show: ``clap`` of MP4 and MOV, ``PixelCrop`` of Matroska.

FFmpeg's libraries do not apply it, and PyAV does not tell of it: it is read from the file's own headers.
"""

import struct
from collections.abc import Generator
from io import BufferedIOBase
from pathlib import Path

from .boxes import boxes

_PATH = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd")
_ENTRY = 8 + 78
"""Bytes before the boxes of a picture's description: its own head, and what has a fixed length."""
_MOST = 1 << 16
"""Bytes of a description that are read."""

_SEGMENT, _TRACKS, _TRACK, _VIDEO = 0x18538067, 0x1654AE6B, 0xAE, 0xE0
_WIDTH, _HEIGHT = 0xB0, 0xBA
_CROPS = {0x54CC: 0, 0x54DD: 0, 0x54BB: 1, 0x54AA: 1}
"""Matroska's numbers of the pixels left out at the left, right, top and bottom, and the axis of each."""


def shown_size(path: Path, size: tuple[int, int]) -> tuple[int, int] | None:
    """Width and height px that a file with pictures of this size says to show; None if it says nothing."""
    try:
        with open(path, "rb") as file:
            head = file.read(12)
            file.seek(0)
            if head.startswith(b"\x1aE\xdf\xa3"):
                found = _of_matroska(file, size)
            else:
                found = (
                    _of_mov(file) if head[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free") else None
                )
    except (OSError, ValueError, struct.error, ZeroDivisionError, RecursionError):
        return None
    return (
        found if found and found != size and 0 < found[0] <= size[0] and 0 < found[1] <= size[1] else None
    )


def _length(file: BufferedIOBase) -> int:
    here = file.tell()
    length = file.seek(0, 2)
    file.seek(here)
    return length


def _of_mov(file: BufferedIOBase) -> tuple[int, int] | None:
    def inside(end: int, path: tuple[bytes, ...]) -> tuple[int, int] | None:
        for name, stop in boxes(file, end):
            if name != path[0]:
                continue
            found = _of_description(file, stop) if len(path) == 1 else inside(stop, path[1:])
            if found is not None:
                return found
        return None

    return inside(_length(file), _PATH)


def _of_description(file: BufferedIOBase, stop: int) -> tuple[int, int] | None:
    """Of the first description of pictures or sound."""
    content = file.read(min(stop - file.tell(), _MOST))[8:]
    place = _ENTRY
    while place + 8 <= len(content):
        length, name = struct.unpack_from(">I4s", content, place)
        if name == b"clap":
            width, by_width, height, by_height = struct.unpack_from(">4I", content, place + 8)
            return round(width / by_width), round(height / by_height)
        if length < 8:
            return None
        place += length
    return None


def _number(file: BufferedIOBase, *, keep: bool) -> int:
    """A number of Matroska's, of a length that it says itself, whose mark the names of elements keep."""
    first = file.read(1)
    if not first or not first[0]:
        raise ValueError("no number")
    length = 9 - first[0].bit_length()
    value = first[0] if keep else first[0] & ((1 << (8 - length)) - 1)
    rest = file.read(length - 1)
    if not keep and value == (1 << (8 - length)) - 1 and rest == b"\xff" * (length - 1):
        return -1  # of no known length
    return int.from_bytes(bytes([value]) + rest, "big")


def _elements(file: BufferedIOBase, end: int) -> Generator[tuple[int, int], None, None]:
    """Name and end of each element up to a place; the file is where its content begins."""
    while file.tell() < end:
        name, length = _number(file, keep=True), _number(file, keep=False)
        stop = end if length < 0 else min(file.tell() + length, end)
        yield name, stop
        file.seek(stop)


def _of_matroska(file: BufferedIOBase, size: tuple[int, int]) -> tuple[int, int] | None:
    for segment, end in _elements(file, _length(file)):
        if segment != _SEGMENT:
            continue
        for tracks, end_of_tracks in _elements(file, end):
            if tracks != _TRACKS:
                continue
            for track, end_of_track in _elements(file, end_of_tracks):
                for video, stop in _elements(file, end_of_track) if track == _TRACK else ():
                    if video == _VIDEO and (found := _of_video(file, stop, size)) is not None:
                        return found
            return None
    return None


def _of_video(file: BufferedIOBase, end: int, size: tuple[int, int]) -> tuple[int, int] | None:
    """What is left of pictures of this size; None for those of another, as of a cover."""
    own, left = [0, 0], [0, 0]
    for name, stop in _elements(file, end):
        if name in (_WIDTH, _HEIGHT):
            own[name == _HEIGHT] = int.from_bytes(file.read(stop - file.tell()), "big")
        elif name in _CROPS:
            left[_CROPS[name]] += int.from_bytes(file.read(stop - file.tell()), "big")
    return (size[0] - left[0], size[1] - left[1]) if tuple(own) == size else None
