"""Files with offsets of 64 bits tell what others do: Pillow reads them in part, or not at all."""

import io
import struct

import numpy as np
import pytest
import tifffile
from PIL import ExifTags

import zoomjax as zj
from zoomjax.io.bigtiff import is_bigtiff, usual_tags
from zoomjax.io.equipment import read_equipment
from zoomjax.io.exif import parse_exif
from zoomjax.io.photo import read_focal, read_metadata, read_photo
from zoomjax.models import PolynomialZoom, ZoomLens

XMP = b"<rdf:RDF></rdf:RDF>"

STANDS_FOR_EXIF = 34664  # tifffile writes no folder of EXIF data


def written(path, order, orientation=6, pages=1):
    """A BigTIFF file of a photo: 35 mm, turned, with a profile and XMP."""
    tags = [
        (ExifTags.Base.Orientation, 3, 1, orientation, True),
        (ExifTags.Base.Make, 2, 6, b"Maker\0", True),
        (700, 1, len(XMP), XMP, True),
        (34675, 7, 9, b"a profile", True),
        (STANDS_FOR_EXIF, 16, 1, 1, True),
    ]
    with tifffile.TiffWriter(path, bigtiff=True, byteorder=order) as file:
        for _ in range(pages):
            file.write(np.zeros((40, 60, 3), np.uint8), photometric="rgb", metadata=None, extratags=tags)
    content = bytearray(path.read_bytes())
    content += bytes(-len(content) % 8)
    folder = struct.pack(f"{order}QHHQIIQ", 1, ExifTags.Base.FocalLength, 5, 1, 350, 10, 0)
    old, new = (struct.pack(f"{order}HHQ", tag, 16, 1) for tag in (STANDS_FOR_EXIF, ExifTags.IFD.Exif))
    assert content.count(old) == pages
    for _ in range(pages):
        at = content.index(old)
        content[at : at + 20] = new + struct.pack(f"{order}Q", len(content))
    path.write_bytes(content + folder)
    return path


@pytest.mark.parametrize("order", "<>")
def test_the_metadata_are_read(tmp_path, order):
    photo = written(tmp_path / "big.tif", order)
    assert is_bigtiff(photo.read_bytes()[:4])
    assert read_focal(photo) == 35
    assert read_equipment(photo).maker == "Maker"
    found = read_metadata(photo)
    assert (found.xmp, found.icc) == (XMP, b"a profile")
    assert parse_exif(io.BytesIO(found.exif))[ExifTags.Base.Make] == "Maker"


@pytest.mark.parametrize("order", "<>")
def test_a_corrected_photo_keeps_them(tmp_path, order):
    photo = written(tmp_path / "big.tif", order, pages=2)
    zoom = PolynomialZoom(0, np.zeros((1, 2)), np.array(20.0))
    lens = ZoomLens(zoom, np.array([29.5, 19.5]), np.array([20.0, 80.0]), (60, 40))
    zj.undistort_photo(photo, tmp_path / "out.tif", lens=lens, focal=read_focal(photo))
    assert read_focal(tmp_path / "out.tif") == 35
    _, found = read_photo(tmp_path / "out.tif")
    assert found.icc == b"a profile"
    exif = parse_exif(io.BytesIO((tmp_path / "out.tif").read_bytes()))
    assert exif[ExifTags.Base.Orientation] == 6
    assert exif[ExifTags.Base.Make] == "Maker"
    with tifffile.TiffFile(tmp_path / "out.tif") as file:
        assert [page.tags[274].value for page in file.pages] == [6, 6]


@pytest.mark.parametrize("order", "<>")
def test_damage_raises_nothing_and_takes_no_memory(tmp_path, rng, order):
    content = written(tmp_path / "big.tif", order).read_bytes()
    for _ in range(300):
        damaged = bytearray(content[: rng.integers(16, len(content) + 1)])
        for at in rng.integers(0, len(damaged), 8):
            damaged[at] = rng.integers(256)
        parse_exif(io.BytesIO(damaged))
    # Each of many tags leads back to the folder itself.
    tags = b"".join(struct.pack(f"{order}HHQQ", 0x8769, 16, 1, 16) for _ in range(4000))
    head = b"II+\0\x08\0\0\0" if order == "<" else b"MM\0+\0\x08\0\0"
    bomb = head + struct.pack(f"{order}QQ", 16, 4000) + tags
    assert len(usual_tags(bomb)) < 1000
