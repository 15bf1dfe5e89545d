"""Focal lengths in EXIF data of both byte orders, and data that are cut off or something else."""

import pytest

from zoomjax.io.exif import exif_focal, exif_with_focal

from .._exif import exif


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("prefix", [b"", b"Exif\0\0"])
def test_focal_length_of_both_byte_orders(order, prefix):
    assert exif_focal(prefix + exif(order=order)) == 35.0


@pytest.mark.parametrize(
    "block",
    [
        *(exif(focal) for focal in (None, (0, 1), (35, 0), (0, 0), (2**32 - 1, 1), (2**32 - 1, 2**32 - 1))),
        *(b"", b"no EXIF", exif()[:40]),
    ],
)
def test_none_where_there_is_none(block):
    assert exif_focal(block) is None


@pytest.mark.parametrize("focal", [20.56, 35.0, 600.0, 4.25])
def test_a_written_focal_length_is_read_back(focal):
    assert exif_focal(exif_with_focal(focal)) == pytest.approx(focal, abs=1e-4)
