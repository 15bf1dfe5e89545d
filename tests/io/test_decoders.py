"""Photos with damaged data, which decoders fill up with something else and only print."""

import io

import cv2
import numpy as np
import pytest
from PIL import Image

from zoomjax.io.photo import read_pages, read_photo


@pytest.fixture(scope="module")
def image():
    noise = np.random.default_rng(0).integers(0, 256, (120, 160, 3), np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 4)


def jpeg(image, **options):
    file = io.BytesIO()
    Image.fromarray(image).save(file, "JPEG", quality=90, **options)
    return file.getvalue()


def without(content, first, last):
    """The file with zeros in a part of it."""
    start, end = (round(part * len(content)) for part in (first, last))
    return content[:start] + bytes(end - start) + content[end:]


@pytest.mark.parametrize("options", [{}, {"progressive": True}, {"restart_marker_blocks": 20}])
def test_a_jpeg_file_with_damaged_data_is_refused(tmp_path, image, options, capfd):
    """Half of its picture was grey or elsewhere, and lines were found in that."""
    path = tmp_path / "a.jpg"
    path.write_bytes(without(jpeg(image, **options), 0.3, 0.35))
    for read in (read_photo, read_pages):
        with pytest.raises(ValueError, match=r"a\.jpg: its data are damaged \("):
            read(path)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(("number", "damaged"), [(2, False), (40, True)])
def test_a_few_bytes_too_many_are_no_damage(tmp_path, image, number, damaged, capfd):
    content, path = jpeg(image), tmp_path / "a.jpg"
    path.write_bytes(content[:-2] + bytes(number) + content[-2:])
    if damaged:
        with pytest.raises(ValueError, match=r"damaged \(\d+ extraneous bytes before"):
            read_photo(path)
    else:
        np.testing.assert_array_equal(
            read_photo(path)[0], cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
        )
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("compression", ["tiff_lzw", "jpeg"])
def test_a_tiff_file_with_damaged_data_is_refused(tmp_path, image, compression, capfd):
    path = tmp_path / "a.tif"
    Image.fromarray(image).save(path, compression=compression)
    path.write_bytes(without(path.read_bytes(), 0.5, 0.6))
    with pytest.raises(ValueError, match=r"a\.tif: its data are damaged \("):
        read_photo(path)
    assert capfd.readouterr().err == ""


def test_tags_that_nobody_knows_are_no_damage(tmp_path, image, capfd):
    """OpenCV printed a line for each of those of maps."""
    tags, path = {34264: (1.0, 0.0), 34735: (1, 1, 0, 0)}, tmp_path / "a.tif"
    info = Image.fromarray(image).getexif()
    info.update(tags)
    Image.fromarray(image).save(path, tiffinfo=info)
    np.testing.assert_array_equal(read_photo(path)[0][..., ::-1], image)
    assert capfd.readouterr().err == ""
