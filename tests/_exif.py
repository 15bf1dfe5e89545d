"""EXIF data made by hand, byte by byte, for tests of what reads them."""

import struct


def exif(focal=(3500, 100), orientation=6, order="<"):
    """EXIF data with an orientation and, unless None, a focal length."""
    mark = b"II" if order == "<" else b"MM"
    header = mark + struct.pack(f"{order}HI", 42, 8)
    # A SHORT lies at the start of its four bytes.
    turned = struct.pack(f"{order}HHIHH", 0x0112, 3, 1, orientation, 0)
    count = 1 if focal is None else 2
    first = struct.pack(f"{order}H", count) + turned
    folder = 8 + 2 + 12 * count + 4
    if focal is None:
        return header + first + struct.pack(f"{order}I", 0)
    first += struct.pack(f"{order}HHII", 0x8769, 4, 1, folder) + struct.pack(f"{order}I", 0)
    second = struct.pack(f"{order}HHHII", 1, 0x920A, 5, 1, folder + 18) + struct.pack(f"{order}I", 0)
    return header + first + second + struct.pack(f"{order}II", *focal)
