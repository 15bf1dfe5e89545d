"""Tags of BigTIFF files, whose offsets have 64 bits, as those of a TIFF file of the usual kind.

Pillow reads them in part, and not at all in big-endian order. So what describes the image is written anew
in the usual form: of one page, with its folders of EXIF data, GPS and interoperability. Where the pixels
are is left out.
"""

import struct

_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4}
"""Bytes of a value of each type that the usual TIFF has, too."""

_LONG = {16: (4, "Q", "I"), 17: (9, "q", "i"), 18: (4, "Q", "I")}
"""Types of 64 bits: the type of 32 bits, and both for `struct`."""

_FOLDERS = {0x8769, 0x8825, 0xA005}  # EXIF data, GPS, interoperability
_PLACES = {
    *(273, 279, 288, 289, 324, 325),  # strips, free space and tiles
    *(330, 513, 514, 519, 520, 521),  # further pictures, and JPEG's tables
}
_DEEPEST = 2
_MOST_TAGS = 4096


def is_bigtiff(head: bytes) -> bool:
    """Whether a file of which this is the beginning is one."""
    return head[:4] in (b"II+\0", b"MM\0+")


def usual_tags(content: bytes, offset: int | None = None) -> bytes:
    """A TIFF file of the usual kind, without pixels, with the tags of a page: by default the first.

    Raises:
        struct.error: it is damaged or cut off.
    """
    order = "<" if content[:2] == b"II" else ">"
    first: int = struct.unpack_from(f"{order}Q", content, 8)[0] if offset is None else offset
    reader = _Reader(content, order)
    return content[:2] + struct.pack(f"{order}HI", 42, 8) + reader.folder(first, 8, 0)


class _Reader:
    """Reads folders, of whose values all together are no longer than the file."""

    def __init__(self, content: bytes, order: str):
        self._content, self._order, self._left = content, order, len(content)

    def folder(self, offset: int, start: int, depth: int) -> bytes:
        """The tags at an offset, in the usual form, for a folder that is to start at another."""
        found: dict[int, tuple[int, int, bytes | int]] = {}
        [number] = self._numbers("Q", offset)
        for at in range(offset + 8, offset + 8 + 20 * min(number, _MOST_TAGS), 20):
            tag, kind, count = self._numbers("HHQ", at)
            if tag in found or tag in _PLACES or (tag in _FOLDERS and depth == _DEEPEST):
                continue
            if tag in _FOLDERS:
                found[tag] = (4, 1, self._numbers("Q", at + 12)[0])
            elif (value := self._value(at, kind, count)) is not None:
                found[tag] = (_LONG[kind][0] if kind in _LONG else kind, count, value)
        rows, beyond, place = b"", b"", start + 2 + 12 * len(found) + 4
        for tag, (kind, count, value) in found.items():
            inner = isinstance(value, int)
            held = self.folder(value, place + len(beyond), depth + 1) if isinstance(value, int) else value
            if inner or len(held) > 4:
                at = struct.pack(f"{self._order}I", place + len(beyond))
                beyond, held = beyond + held + bytes(len(held) % 2), at
            rows += struct.pack(f"{self._order}HHI", tag, kind, count) + held.ljust(4, b"\0")
        return struct.pack(f"{self._order}H", len(found)) + rows + bytes(4) + beyond

    def _numbers(self, layout: str, at: int) -> tuple[int, ...]:
        return struct.unpack_from(self._order + layout, self._content, at)

    def _value(self, at: int, kind: int, count: int) -> bytes | None:
        """The value of a tag in the usual form; None where it has none."""
        size = (8 if kind in _LONG else _SIZES.get(kind, 0)) * count
        if not 0 < size <= self._left:
            return None
        self._left -= size
        place = at + 12 if size <= 8 else self._numbers("Q", at + 12)[0]
        value = self._content[place : place + size]
        if len(value) < size or kind not in _LONG:
            return value if len(value) == size else None
        _, long, short = _LONG[kind]
        try:
            numbers = struct.unpack(f"{self._order}{count}{long}", value)
            return struct.pack(f"{self._order}{count}{short}", *numbers)
        except struct.error:  # more than 32 bits
            return None
