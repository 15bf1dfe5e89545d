"""TIFF files: pixels as they are stored, and metadata that other programs find again."""

import io
import struct

import cv2
import numpy as np
import pytest
import tifffile
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from zoomjax.io.exif import exif_focal
from zoomjax.io.metadata import Metadata
from zoomjax.io.photo import read_focal, read_photo
from zoomjax.io.tiff import as_stored, encode_tiff, read_tiff, tiff_metadata

DEPTHS = [(np.uint8, 1), (np.uint8, 3), (np.uint8, 4), (np.uint16, 3), (np.uint16, 4), (np.float32, 3)]


def block(orientation=6):
    exif = Image.Exif()
    exif[ExifTags.Base.Make] = "Makers & Söhne".encode()
    exif[ExifTags.Base.Orientation] = orientation
    exif[ExifTags.Base.XResolution] = exif[ExifTags.Base.YResolution] = IFDRational(300, 1)
    exif[ExifTags.Base.ResolutionUnit] = 2
    exif[ExifTags.IFD.Exif] = {0x920A: IFDRational(355, 10), 0x9003: "2020:01:02 03:04:05"}
    exif[ExifTags.IFD.GPSInfo] = {1: "N", 2: (IFDRational(47), IFDRational(30), IFDRational(1, 2))}
    return exif.tobytes().removeprefix(b"Exif\0\0")


METADATA = Metadata(exif=block(), xmp=b"<x:xmpmeta/>", icc=bytes(range(256)))


def decoded(content):
    """By OpenCV, which turns TIFF files by their orientation."""
    return cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)


def picture(rng, dtype, channels):
    image = rng.integers(0, 256, (30, 50, channels)).astype(dtype)
    return np.squeeze(image * 200 if dtype == np.uint16 else image)


@pytest.mark.parametrize(("dtype", "channels"), DEPTHS)
def test_pixels_come_back_as_they_were(rng, tmp_path, dtype, channels):
    image = picture(rng, dtype, channels)
    (path := tmp_path / "a.tif").write_bytes(encode_tiff([(image, METADATA)]))
    back, _ = read_photo(path)
    assert back.dtype == dtype
    np.testing.assert_array_equal(back, image)
    stored = tifffile.imread(path) if dtype == np.float32 else None
    if stored is not None:
        np.testing.assert_array_equal(stored[..., ::-1], image)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_the_orientation_does_not_turn_pixels(rng, tmp_path, orientation):
    image = picture(rng, np.uint16, 3)
    metadata = Metadata(exif=block(orientation))
    (path := tmp_path / "a.tif").write_bytes(encode_tiff([(image, metadata)]))
    np.testing.assert_array_equal(read_photo(path)[0], image)
    turned = decoded(path.read_bytes())
    assert (turned.shape == image.shape and (turned == image).all()) == (orientation == 1)
    np.testing.assert_array_equal(as_stored(turned, orientation), image)


def test_metadata_come_back(rng, tmp_path):
    (path := tmp_path / "a.tif").write_bytes(encode_tiff([(picture(rng, np.uint16, 3), METADATA)]))
    found = read_photo(path)[1]
    assert exif_focal(found.exif) == read_focal(path) == 35.5
    assert (found.xmp, found.icc) == (METADATA.xmp, METADATA.icc)
    again = encode_tiff([(picture(rng, np.uint8, 3), found)])
    with tifffile.TiffFile(io.BytesIO(again)) as file:
        tags = file.pages.first.tags
        assert tags["ExifTag"].value["DateTimeOriginal"] == "2020:01:02 03:04:05"
        assert tags["ExifTag"].value["FocalLength"] == (71, 2)
        assert tags["GPSTag"].value["GPSLatitude"] == (47, 1, 30, 1, 1, 2)
        assert tags["Orientation"].value == 6
        assert tags["XResolution"].value == (300, 1)
        assert tags["ResolutionUnit"].value == 2
        assert "Software" not in tags
    by_pillow = Image.open(io.BytesIO(again))
    assert by_pillow.getexif()[ExifTags.Base.Make].encode("latin-1") == "Makers & Söhne".encode()


def test_what_describes_the_storage_of_pixels_does_not_go_over(rng):
    file, given = io.BytesIO(), Image.Exif()
    given[ExifTags.Base.Orientation] = 6
    Image.fromarray(picture(rng, np.uint8, 3)).save(file, "TIFF", exif=given, compression="tiff_lzw")
    metadata, orientation = tiff_metadata(file.getvalue())
    assert orientation == 6
    exif = Image.Exif()
    exif.load(metadata.exif)
    assert not {256, 257, 258, 259, 273, 278, 279} & set(exif)


@pytest.mark.parametrize("content", [b"", b"II*\0", b"II*\0" + struct.pack("<IH", 8, 9) + b"\xff" * 50])
def test_damaged_files_have_no_metadata(content):
    assert tiff_metadata(content) == (Metadata(), 1)


def test_damaged_exif_data_are_left_out(rng):
    image = picture(rng, np.uint8, 3)
    for damaged in (b"", b"nothing", block()[:30]):
        content = encode_tiff([(image, Metadata(exif=damaged))])
        np.testing.assert_array_equal(decoded(content), image)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_grey_with_transparency_becomes_colours_with_it(rng, tmp_path, dtype):
    image = picture(rng, dtype, 2)
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, image, photometric="minisblack", extrasamples=["unassalpha"])
    back, _ = read_photo(path)
    np.testing.assert_array_equal(back, image[..., [0, 0, 0, 1]])


@pytest.mark.parametrize("compression", ["tiff_lzw", "packbits"])
def test_colours_are_not_multiplied_by_transparency(rng, tmp_path, compression):
    """OpenCV does so, with 8 bits, and decodes what is compressed by LZW."""
    image = picture(rng, np.uint8, 4)
    Image.fromarray(image).save(tmp_path / "a.tif", compression=compression)
    np.testing.assert_array_equal(read_photo(tmp_path / "a.tif")[0], image[..., [2, 1, 0, 3]])


@pytest.mark.parametrize("dtype", [bool, np.uint8, np.uint16, np.uint32])
def test_grey_in_which_white_is_0_does_not_become_a_negative(rng, tmp_path, dtype):
    if dtype is np.uint32 and int(cv2.__version__.partition(".")[0]) < 5:
        pytest.skip("OpenCV cannot read 32-bit whole numbers before version 5")
    most = 1 if dtype is bool else np.iinfo(dtype).max
    image = rng.integers(0, most, (30, 48), endpoint=True).astype(dtype)
    tifffile.imwrite(tmp_path / "a.tif", image, photometric="miniswhite")
    back, _ = read_photo(tmp_path / "a.tif")
    np.testing.assert_array_equal(back, 255 * (1 - image.astype(np.uint8)) if most == 1 else most - image)


@pytest.mark.parametrize("dtype", [np.float32, np.int16])
def test_white_that_is_0_of_numbers_without_a_black_is_refused(tmp_path, dtype):
    tifffile.imwrite(tmp_path / "a.tif", np.ones((30, 50), dtype), photometric="miniswhite")
    with pytest.raises(ValueError, match=f"white is 0, and what black is in {np.dtype(dtype)}"):
        read_photo(tmp_path / "a.tif")


def test_half_precision_becomes_single(rng, tmp_path):
    image = rng.uniform(0, 1, (30, 50, 3)).astype(np.float16)
    tifffile.imwrite(tmp_path / "a.tif", image, photometric="rgb", compression="zlib")
    back, _ = read_photo(tmp_path / "a.tif")
    assert back.dtype == np.float32
    np.testing.assert_array_equal(back[..., ::-1], image)


OTHERS = [
    (np.ones((30, 50, 5), np.uint8), "it has 5 channels, and photos have up to 4"),
    (np.ones((5, 30, 50), np.uint8), "it has 5 channels, and photos have up to 4"),
    (np.ones((30, 50), np.complex64), "its numbers .complex64, compressed by NONE. cannot be decoded"),
]


@pytest.mark.parametrize(("image", "told"), OTHERS)
def test_what_cannot_be_decoded_is_not_called_damaged(tmp_path, image, told):
    planes = "separate" if image.shape[0] == 5 else "contig"
    tifffile.imwrite(tmp_path / "a.tif", image, photometric="minisblack", planarconfig=planes)
    with pytest.raises(ValueError, match=told):
        read_photo(tmp_path / "a.tif")


def test_compressed_grey_with_transparency_that_opencv_would_drop_is_refused(rng, tmp_path):
    path = tmp_path / "a.tif"
    Image.fromarray(picture(rng, np.uint8, 2)).save(path, compression="tiff_lzw")
    with pytest.raises(ValueError, match="grey with transparency"):
        read_photo(path)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"extrasamples": ["assocalpha"]}, "multiplied by transparency"),
        ({"extrasamples": ["unspecified"]}, "no transparency"),
        ({"extrasamples": ["unassalpha"]}, ""),
        (
            {"extrasamples": ["unassalpha"], "extratags": [(33550, 12, 3, (1.0, 1.0, 0.0), True)]},
            "place on a map",
        ),
    ],
)
def test_what_the_result_does_not_hold_is_named(rng, options, told):
    content = io.BytesIO()
    tifffile.imwrite(content, picture(rng, np.uint8, 4), photometric="rgb", **options)
    [page] = read_tiff(content.getvalue())
    assert len(page.others) == bool(told)
    assert told in " ".join(page.others)
