"""The focal length in EXIF data, read from and written to the bytes of their TIFF structure."""

import struct

_FOCAL_LENGTH, _EXIF_FOLDER = 0x920A, 0x8769
_LONG, _RATIONAL = 4, 5
_FINENESS = 10_000  # parts of a mm
_UNKNOWN = 2**32 - 1  # as numerator


def exif_focal(block: bytes) -> float | None:
    """The focal length, mm, in EXIF data or at the start of a TIFF file; None if they hold none."""
    try:
        return _focal(block.removeprefix(b"Exif\0\0"))
    except struct.error:  # cut off, or offsets that lead nowhere
        return None


def exif_with_focal(focal: float) -> bytes:
    """EXIF data that hold a focal length, mm, and nothing else."""
    folder, fraction = 26, 44  # where the EXIF folder and the fraction begin
    return (
        b"II"
        + struct.pack("<HI", 42, 8)
        + struct.pack("<HHHIII", 1, _EXIF_FOLDER, _LONG, 1, folder, 0)
        + struct.pack("<HHHIII", 1, _FOCAL_LENGTH, _RATIONAL, 1, fraction, 0)
        + struct.pack("<II", round(focal * _FINENESS), _FINENESS)
    )


def _focal(block: bytes) -> float | None:
    """First folder, EXIF folder, one fraction."""
    order = {b"II": "<", b"MM": ">"}.get(block[:2])
    if order is None:
        return None

    def entries(offset: int) -> dict[tuple[int, int], int]:
        (count,) = struct.unpack_from(f"{order}H", block, offset)
        each = (struct.unpack_from(f"{order}HHII", block, offset + 2 + 12 * i) for i in range(count))
        return {(tag, kind): value for tag, kind, _, value in each}

    (first,) = struct.unpack_from(f"{order}I", block, 4)
    folder = entries(first).get((_EXIF_FOLDER, _LONG))
    fraction = entries(folder).get((_FOCAL_LENGTH, _RATIONAL)) if folder else None
    if fraction is None:
        return None
    above, below = struct.unpack_from(f"{order}II", block, fraction)
    return above / below if above and below and above != _UNKNOWN else None
