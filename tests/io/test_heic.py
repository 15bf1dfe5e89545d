"""HEIC photographs: pixels as the camera stored them, metadata, and sentences about what is wrong."""

import contextlib
import io
import struct
import sys

import numpy as np
import pytest
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

import zoomjax as zj
from zoomjax.detect.sources import find_photos
from zoomjax.io.avif import decode_avif
from zoomjax.io.exif import exif_with_orientation
from zoomjax.io.headers import announced_size
from zoomjax.io.heic import _properties, heic_metadata
from zoomjax.io.photo import read_focal, read_pages, read_photo, read_size

pillow_heif = pytest.importorskip("pillow_heif")

SIZE = (192, 128)


def gradient(depth=8):
    """Smooth, and different at each corner: compression changes little, turning much."""
    x, y = np.meshgrid(np.linspace(0, 1, SIZE[0]), np.linspace(0, 1, SIZE[1]))
    return (np.stack([x, y, 0.5 * (x + y)], axis=-1) * (2**depth - 1)).astype(f"u{depth // 8}")


def write(path, image, orientation=1, focal=35.0, profile=None):
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    if focal:
        exif[ExifTags.IFD.Exif] = {ExifTags.Base.FocalLength: IFDRational(round(focal * 10), 10)}
    mode = "BGR;16" if image.dtype == np.uint16 else "BGR"
    file = pillow_heif.from_bytes(mode, image.shape[1::-1], image.tobytes())
    more = {"icc_profile": profile} if profile else {}
    file.save(path, quality=-1, exif=exif.tobytes(), **more)
    return path


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pixels_are_those_that_were_stored(tmp_path, orientation):
    path = write(tmp_path / "a.heic", gradient(), orientation)
    image, metadata = read_photo(path)
    assert image.dtype == np.uint8
    assert np.abs(image.astype(int) - gradient()).max() <= 4
    assert read_focal(path) == 35.0
    assert metadata.exif
    assert not metadata.xmp + metadata.icc


@pytest.mark.parametrize("told", [1, 3, 6, 7])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_pixels_do_not_depend_on_what_the_exif_data_say(tmp_path, orientation, told):
    path = write(tmp_path / "a.heic", gradient(), orientation)
    content = path.read_bytes()
    at = content.index(b"MM\0*") if b"MM\0*" in content else content.index(b"II*\0")
    block = content[at:]  # as an editor changes it, and nothing else
    path.write_bytes(content[:at] + exif_with_orientation(block, told))
    image, metadata = read_photo(path)
    assert np.abs(image.astype(int) - gradient()).max() <= 4
    assert heic_metadata(path.read_bytes()) == metadata
    exif = Image.Exif()
    exif.load(metadata.exif)
    assert exif[ExifTags.Base.Orientation] == orientation  # which other formats' viewers follow
    assert read_focal(path) == 35.0


def test_a_file_without_exif_data_gets_the_orientation(tmp_path):
    path = tmp_path / "a.heic"
    file = pillow_heif.from_bytes("BGR", SIZE, gradient().tobytes())
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    file.save(path, quality=-1, exif=exif.tobytes())
    content = path.read_bytes().replace(b"Exif\0\0MM\0*", b"Exif\0\0XXXX")  # damaged
    assert content != path.read_bytes()
    path.write_bytes(content)
    image, metadata = read_photo(path)
    assert np.abs(image.astype(int) - gradient()).max() <= 4
    exif = Image.Exif()
    exif.load(metadata.exif)
    assert dict(exif) == {ExifTags.Base.Orientation: 6}


def with_part(content, wide, high, right, down):
    """A file whose colour profile, of 28 bytes, becomes the property that a part alone is to be shown."""
    at = content.index(b"prof") - 8
    part = struct.pack(">I4s2I2I2i2i", 40, b"clap", wide, 1, high, 1, right, 1, down, 1)
    assert int.from_bytes(content[at : at + 4]) == len(part)
    return content[:at] + part + content[at + 40 :]


@pytest.mark.parametrize("part", [(96, 64, 0, 0), (180, 128, 6, 0), (192, 120, 0, 4)])
def test_a_part_of_the_pixels_alone_is_refused(tmp_path, part):
    """The decoder gives no others."""
    path = write(tmp_path / "a.heic", gradient(), profile=bytes(28))
    path.write_bytes(with_part(path.read_bytes(), *part))
    with pytest.raises(ValueError, match="shows a part of the pixels it holds"):
        read_photo(path)


@pytest.mark.parametrize("shape", [(127, 191), (67, 65), (128, 192)])
def test_what_encoders_fill_up_is_no_part(tmp_path, shape):
    image = gradient()[: shape[0], : shape[1]]
    assert read_photo(write(tmp_path / "a.heic", image, orientation=6))[0].shape[:2] == image.shape[:2]


def test_the_mark_of_a_part_is_said_to_be_lost_where_all_pixels_are_taken():
    image = io.BytesIO()
    Image.fromarray(gradient()).save(image, "AVIF", icc_profile=bytes(28))
    content = image.getvalue()
    assert decode_avif(content)[2] == []
    at = content.index(b"ipma") + 15  # where the properties of the picture are listed
    index = [name for name, _ in _properties(content)].index(b"colr") + 1
    listed = bytes(0x80 | one if one & 0x7F == index else one for one in content[at : at + 5])
    marked = with_part(content[:at] + listed + content[at + 5 :], 96, 64, 20, 10)
    pixels, _, others = decode_avif(marked)
    assert pixels.shape[1::-1] == SIZE
    assert others == ["that a part of the pixels alone is to be shown"]


def test_more_than_eight_bits_are_kept(tmp_path):
    image, _ = read_photo(write(tmp_path / "a.heif", gradient(16)))
    assert image.dtype == np.uint16
    assert np.abs(image.astype(int) - gradient(16)).max() < 65535 / 100  # lossy
    assert len(np.unique(image)) > 500


def test_the_size_is_known_before_pixels_are_decoded(tmp_path):
    content = write(tmp_path / "a.heic", gradient()).read_bytes()
    assert announced_size(content) == ("HEIC", *SIZE)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_the_size_is_that_of_the_pixels_as_stored(tmp_path, orientation):
    """And not as they are shown: lenses are matched with it, and centres are checked."""
    path = write(tmp_path / "a.heic", gradient(), orientation)
    assert read_size(path) == SIZE == read_photo(path)[0].shape[1::-1]


def test_further_pictures_are_named(tmp_path):
    file = pillow_heif.from_bytes("BGR", SIZE, gradient().tobytes())
    file.save(tmp_path / "one.heic", quality=-1)
    file.add_frombytes("BGR", SIZE, (255 - gradient()).tobytes())
    file.save(tmp_path / "two.heic", quality=-1, save_all=True)
    assert read_pages(tmp_path / "one.heic").others == ()
    assert read_pages(tmp_path / "two.heic").others == ("further pictures",)


def test_corrected_with_its_metadata(tmp_path):
    profile = bytes(range(256))
    source = write(tmp_path / "a.heic", gradient(), orientation=6, profile=profile)
    lens = zj.scenes.nikkor_18_200(SIZE)
    zj.undistort_photo(source, tmp_path / "b.tif", lens=lens)  # 35 mm, from the EXIF data
    stored, metadata = read_photo(tmp_path / "b.tif")
    np.testing.assert_array_equal(stored, zj.undistort_image(read_photo(source)[0], lens(35.0)))
    assert read_focal(tmp_path / "b.tif") == 35.0
    assert metadata.icc == profile
    with pytest.raises(ValueError, match=r"must end in one of \.jpg"):
        zj.undistort_photo(source, tmp_path / "b.heic", lens=lens)


def test_folders_of_photographs_include_them(tmp_path):
    write(tmp_path / "a.HEIC", gradient())
    [source] = find_photos([tmp_path])
    assert source.read()[1] == 35.0


def test_without_a_focal_length_there_is_none(tmp_path):
    assert read_focal(write(tmp_path / "a.heic", gradient(), focal=None)) is None


def test_without_the_extra_a_sentence_names_it(tmp_path, monkeypatch):
    path = write(tmp_path / "a.heic", gradient())
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    for read in (read_photo, read_focal):
        with pytest.raises(ValueError, match=r'need the extra "heic": pip install "zoomjax\[heic\]"'):
            read(path)


def test_damaged_files_are_refused(tmp_path, rng):
    content = write(tmp_path / "a.heic", gradient()).read_bytes()
    for _ in range(60):
        damaged = bytearray(content[: rng.integers(20, len(content))])
        for place in rng.integers(12, len(damaged), 5):
            damaged[place] = rng.integers(256)
        (path := tmp_path / "damaged.heic").write_bytes(damaged)
        for read in (read_photo, read_focal):
            with contextlib.suppress(ValueError):  # which names the file: anything else is a crash
                read(path)
