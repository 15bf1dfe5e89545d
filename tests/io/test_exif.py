"""Focal lengths in EXIF data of both byte orders, in files, and data that are cut off or something else."""

import io
import struct
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image

from zoomjax.io.exif import exif_focal, exif_with_focal, find_exif
from zoomjax.io.photo import read_focal, read_photo

from .._exif import exif


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("prefix", [b"", b"Exif\0\0"])
def test_focal_length_of_both_byte_orders(order, prefix):
    assert exif_focal(prefix + exif(order=order)) == 35.0


@pytest.mark.usefixtures("unchecked")
def test_what_is_no_block_and_no_focal_length_is_refused():
    with pytest.raises(TypeError, match="Argument block must be bytes"):
        exif_focal("photo.jpg")  # type: ignore[arg-type]
    for focal in (0, -35.0, np.nan, np.inf, "35"):
        with pytest.raises(ValueError, match="Argument focal must be a finite number above 0"):
            exif_with_focal(focal)


@pytest.mark.parametrize(
    "block",
    [
        *(exif(focal) for focal in (None, (0, 1), (35, 0), (0, 0), (2**32 - 1, 1), (2**32 - 1, 2**32 - 1))),
        *(b"", b"no EXIF", exif()[:40]),
    ],
)
def test_none_where_there_is_none(block):
    assert exif_focal(block) is None


@pytest.mark.parametrize(("kind", "code"), [(11, "f"), (12, "d"), (3, "H"), (4, "I")])
@pytest.mark.parametrize("order", ["<", ">"])
def test_a_focal_length_of_another_type_is_read(kind, code, order):
    """The standard's type is RATIONAL; some programs write FLOAT, DOUBLE, SHORT or LONG."""
    block = bytearray(exif(order=order))
    place = len(block) - 8  # of the fraction, and its entry before
    value = struct.pack(f"{order}{code}", 35)
    where = value.ljust(4, b"\0") if len(value) <= 4 else struct.pack(f"{order}I", place)
    block[place - 4 - 12 : place - 4] = struct.pack(f"{order}HHI", 0x920A, kind, 1) + where
    block[place:] = value.ljust(8, b"\0")
    assert exif_focal(bytes(block)) == 35.0


@pytest.mark.parametrize("focal", [20.56, 35.0, 600.0, 4.25])
def test_a_written_focal_length_is_read_back(focal):
    assert exif_focal(exif_with_focal(focal)) == pytest.approx(focal, abs=1e-4)


def png_chunk(name, data):
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def encoded(kind, block):
    """A photograph with EXIF data; PNG files may have them before or behind the pixels."""
    image = np.random.default_rng(0).integers(0, 256, (48, 64, 3)).astype(np.uint8)
    if kind == "PNG, behind":
        content = cv2.imencode(".png", image)[1].tobytes()
        return content[:-12] + png_chunk(b"eXIf", block) + content[-12:]
    file = io.BytesIO()
    Image.fromarray(image).save(file, kind, exif=b"Exif\0\0" + block)
    return file.getvalue()


KINDS = ("JPEG", "PNG", "PNG, behind", "WEBP", "TIFF")


@pytest.mark.parametrize("kind", KINDS)
def test_the_focal_length_of_a_file_is_read_without_its_pixels(kind, tmp_path):
    content = encoded(kind, exif_with_focal(35.5))
    (path := tmp_path / "photo").write_bytes(content)
    assert read_focal(path) == 35.5
    if kind in ("JPEG", "PNG"):  # whose EXIF data are at the beginning
        path.write_bytes(content[: len(content) // 3])
        with pytest.raises(ValueError, match="Cannot read a photograph"):
            read_photo(path)
        assert read_focal(path) == 35.5


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_have_no_focal_length_and_raise_nothing(kind, rng):
    content = encoded(kind, exif_with_focal(35.5))
    for _ in range(200):
        damaged = bytearray(content[: rng.integers(1, len(content))])
        for place in rng.integers(0, min(len(damaged), 200), 4):
            damaged[place] = rng.integers(256)
        block = find_exif(io.BytesIO(bytes(damaged)), "WebP" if kind == "WEBP" else kind.split(",")[0])
        assert block is None or (exif_focal(block) or 1.0) > 0


@pytest.mark.parametrize(
    ("content", "reason"), [(b"", "the file is empty"), (b"no photograph" * 9, "of an unknown format")]
)
def test_what_is_no_photograph_is_refused(content, reason, tmp_path):
    (path := tmp_path / "photo.jpg").write_bytes(content)
    with pytest.raises(ValueError, match=f"Cannot read a photograph from .*: .*{reason}"):
        read_focal(path)
