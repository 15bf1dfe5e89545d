"""Files that are no photographs, and say that they are: made by code, each in a moment."""

import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np


def png(width: int, height: int, content: bytes = b"") -> bytes:
    """A grey PNG of one bit that announces a size, and has this for its compressed pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", content) + chunk(b"IEND", b"")


def whole_png(width: int, height: int) -> bytes:
    """All of a black PNG: 30,000 x 30,000 px fit into 110 kB."""
    packer, rows = zlib.compressobj(), b"\0" * (1 + (width + 7) // 8)
    content = b"".join(packer.compress(rows) for _ in range(height)) + packer.flush()
    return png(width, height, content)


def bmp(width: int, height: int) -> bytes:
    """The header of one."""
    return b"BM" + struct.pack("<IHHIIiiHHIIiiII", 54, 0, 0, 54, 40, width, height, 1, 24, 0, 0, 0, 0, 0, 0)


def tiff(width: int, height: int) -> bytes:
    """The header of one, with no pixels."""
    entries = [(256, 4, width), (257, 4, height), (258, 4, 8), (259, 4, 1), (262, 4, 1), (273, 4, 8)]
    entries += [(277, 4, 1), (278, 4, height), (279, 4, width * height % 2**32)]
    folder = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in entries)
    return b"II*\0" + struct.pack("<IH", 8, len(entries)) + folder + bytes(4)


def webp(width: int, height: int) -> bytes:
    """The header of an extended one, with no pixels."""
    size = (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
    return b"RIFF" + struct.pack("<I", 22) + b"WEBPVP8X" + struct.pack("<I", 10) + bytes(4) + size


def jpeg(width: int, height: int, image: bytes) -> bytes:
    """A JPEG whose header announces another size."""
    at = image.index(b"\xff\xc0") + 5
    return image[:at] + struct.pack(">HH", height, width) + image[at + 4 :]


def write_bad_files(folder: Path, *, good: int) -> list[Path]:
    """Bad files of every kind, among so many good photographs; all paths, in order."""
    image = np.zeros((48, 64, 3), np.uint8)
    image[20] = 255
    whole = {suffix: cv2.imencode(suffix, image)[1].tobytes() for suffix in FORMATS}
    bad = {
        "empty.jpg": b"",
        "text.png": b"Straight lines are drawn with a ruler.\n" * 40,
        "gif.jpg": b"GIF89a" + bytes(400),
        "null.jpg": bytes(4000),
        "bomb.png": png(100_000, 100_000, zlib.compress(bytes(100))),
        "real-bomb.png": whole_png(30_000, 30_000),
        "negative.png": png(2**31 + 5, 10),
        "nothing.png": png(0, 0),
        "bomb.bmp": bmp(90_000, -90_000),
        "least.bmp": bmp(-(2**31), -(2**31)),
        "bomb.tif": tiff(100_000, 100_000),
        "lie.tif": tiff(20_000, 20_000),
        "bomb.webp": webp(2**24, 2**20),
        "lie.jpg": jpeg(20_000, 20_000, whole[".jpg"])[:-2],
        "bomb.jpg": jpeg(65_500, 65_500, whole[".jpg"]),
        "start.jpg": b"\xff\xd8\xff",
        "loop.tif": b"II*\0" + struct.pack("<IH", 8, 0) + struct.pack("<I", 8),
        "far.tif": b"II+\0\x08\0\0\0" + b"\xff" * 16,
    }
    for suffix, content in whole.items():
        bad[f"cut{suffix}"] = content[: len(content) // 2]
        bad[f"garbage{suffix}"] = content[:16] + bytes(range(256)) * 4
    for name, content in bad.items():
        (folder / name).write_bytes(content)
    os.mkfifo(folder / "pipe.jpg")
    os.symlink("/dev/zero", folder / "zero.jpg")
    os.symlink(folder / "link.jpg", folder / "link.jpg")
    (folder / "folder.jpg").mkdir()
    with open(folder / "hole.png", "wb") as file:
        file.truncate(5_000_000_000)
    paths = [*sorted(folder.iterdir()), folder / "removed.jpg"]
    for number in range(good):
        path = folder / f"good-{number}.png"
        cv2.imwrite(str(path), image)
        paths.insert(number * len(paths) // max(good - 1, 1), path)
    return paths


FORMATS = (".jpg", ".png", ".webp", ".tif", ".bmp")
