"""What files announce: the same size as the decoder finds, whatever the encoder; else a sentence."""

import io
import struct

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from zoomjax.io.headers import announced_size

from .._bad_files import bmp, png, tiff, webp

SIZES = [(301, 37), (1, 1), (2, 700), (65, 255)]

OPENCV = {
    "JPEG": (".jpg", []),
    "JPEG, progressive": (".jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
    "PNG": (".png", []),
    "WebP": (".webp", []),
    "WebP, lossless": (".webp", [cv2.IMWRITE_WEBP_QUALITY, 101]),
    "TIFF": (".tif", []),
    "BMP": (".bmp", []),
}
PILLOW = {
    "TIFF, big": {"format": "TIFF", "big_tiff": True},
    "TIFF, deflated": {"format": "TIFF", "compression": "tiff_deflate"},
    "WebP, extended": {"format": "WEBP", "exif": b"Exif\0\0II*\0\x08\0\0\0\0\0\0\0\0\0"},
    "JPEG, thumbnail": {
        "format": "JPEG",
        "exif": b"Exif\0\0" + b"\xff\xd8\xff\xc0\x00\x11\x08\x12\x34" * 9,
    },
}


def encoded(name, image):
    if name in OPENCV:
        suffix, options = OPENCV[name]
        return cv2.imencode(suffix, image, options)[1].tobytes()
    file = io.BytesIO()
    Image.fromarray(image).save(file, **PILLOW[name])
    return file.getvalue()


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", [*OPENCV, *PILLOW])
def test_the_size_is_the_one_that_is_decoded(name, size, rng):
    content = encoded(name, rng.integers(0, 256, (size[1], size[0], 3)).astype(np.uint8))
    height, width = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED).shape[:2]
    assert (width, height) == size
    assert announced_size(content) == (name.split(",")[0], *size)


def test_big_endian_tiff_has_short_values_at_the_front(rng):
    entries = struct.pack(">HHIHHHHIHH", 256, 3, 1, 301, 0, 257, 3, 1, 37, 0)
    assert announced_size(b"MM\0*" + struct.pack(">IH", 8, 2) + entries) == ("TIFF", 301, 37)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (png(100_000, 2**31), ("PNG", 100_000, 2**31)),
        (bmp(70_000, -80_000), ("BMP", 70_000, 80_000)),
        (webp(2**24, 70_000), ("WebP", 2**24, 70_000)),
        (tiff(2**32 - 1, 5), ("TIFF", 2**32 - 1, 5)),
        (b"BM" + bytes(12) + struct.pack("<IHH", 12, 300, 200), ("BMP", 300, 200)),
    ],
)
def test_large_sizes_are_read_as_they_are(content, expected):
    assert announced_size(content) == expected


BEGINNINGS = [encoded(name, np.zeros((5, 7, 3), np.uint8)) for name in [*OPENCV, *PILLOW]]


@given(
    begins=st.sampled_from(BEGINNINGS),
    keep=st.integers(0, 80),
    rest=st.binary(max_size=64) | st.just(b"\xff" * 64),
)
def test_any_bytes_are_a_size_or_a_sentence(begins, keep, rest):
    try:
        name, width, height = announced_size(begins[:keep] + rest)
    except ValueError:
        return
    assert name in ("JPEG", "PNG", "WebP", "TIFF", "BMP")
    assert width >= 0
    assert height >= 0
