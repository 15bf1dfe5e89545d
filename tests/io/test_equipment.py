"""Camera, lens and pixel pitch from EXIF data that Pillow writes."""

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from zoomjax.io import Equipment, read_equipment
from zoomjax.io.equipment import FILM, exif_equipment

SIZE = (4288, 2848)
WIDTH = 23.6  # of the sensor, mm
PITCH = WIDTH / SIZE[0]
CROP = FILM / (PITCH * np.hypot(*SIZE))


def block(*, of=(), **tags):
    """EXIF data with tags of the camera, in `of`, and of the photo, by Pillow's names."""
    exif = Image.Exif()
    for name, value in dict(of).items():
        exif[ExifTags.Base[name]] = value
    exif[ExifTags.IFD.Exif] = {ExifTags.Base[name]: value for name, value in tags.items()}
    return exif.tobytes()


def plane(per_unit, unit, size=SIZE):
    return {
        "FocalPlaneXResolution": IFDRational(round(per_unit * 1000), 1000),
        "FocalPlaneResolutionUnit": unit,
        "ExifImageWidth": size[0],
        "ExifImageHeight": size[1],
    }


FOCAL = {"FocalLength": IFDRational(350, 10)}


def test_names_and_focal_length_are_read_from_a_photo(tmp_path):
    content = block(
        of={"Make": "NIKON CORPORATION\0\0", "Model": "NIKON  D300"}, LensModel="18.0-200.0 mm", **FOCAL
    )
    path = tmp_path / "a.jpg"
    Image.fromarray(np.zeros((8, 12, 3), np.uint8)).save(path, exif=content)
    found = read_equipment(path)
    assert (found.maker, found.camera, found.lens) == ("NIKON CORPORATION", "NIKON D300", "18.0-200.0 mm")
    assert found.focal == 35.0
    assert found.pixel_pitch(SIZE) is None
    cv2.imwrite(str(path), np.zeros((8, 12), np.uint8))
    assert read_equipment(path) == Equipment()


@pytest.mark.parametrize(("unit", "mm"), [(2, 25.4), (3, 10.0), (4, 1.0)])
def test_the_pitch_is_that_of_the_focal_plane(unit, mm):
    found = exif_equipment(block(**plane(mm / PITCH, unit)))
    assert found.pixel_pitch(SIZE) == pytest.approx(PITCH, rel=1e-5)
    assert found.crop_factor(SIZE) == pytest.approx(CROP, rel=1e-5)


def test_a_smaller_copy_has_wider_pixels_and_an_upright_one_the_same():
    found = exif_equipment(block(**plane(25.4 / PITCH, 2)))
    assert found.pixel_pitch((SIZE[0] // 2, SIZE[1] // 2)) == pytest.approx(2 * PITCH, rel=1e-5)
    assert found.pixel_pitch(SIZE[::-1]) == pytest.approx(PITCH, rel=1e-5)


def test_the_pitch_of_a_part_of_the_image_is_not_known():
    half = (SIZE[0], SIZE[1] // 2)
    film = {"FocalLengthIn35mmFilm": round(35 * CROP), **FOCAL}
    for more in ({}, film):
        found = exif_equipment(block(**plane(25.4 / PITCH, 2), **more))
        assert found.cropped(half)
        assert found.pixel_pitch(half) is None
        for whole in (SIZE, SIZE[::-1], (53, 35), (53, 36), (4256, 2848)):
            assert not found.cropped(whole)
            assert found.pixel_pitch(whole) is not None
    assert not exif_equipment(block(**film)).cropped(half)  # nothing says so


def test_of_a_raw_photo_the_shape_of_a_picture_beside_it_says_nothing(tmp_path):
    content = block(**plane(25.4 / PITCH, 2, size=(SIZE[0], SIZE[1] // 2)), **FOCAL)
    for name, cropped in (("a.tif", True), ("a.dng", False)):
        Image.fromarray(np.zeros((8, 12, 3), np.uint8)).save(tmp_path / name, "TIFF", exif=content)
        assert read_equipment(tmp_path / name).cropped(SIZE) == cropped


def test_equal_view_on_film_gives_the_pitch_to_its_rounding():
    found = exif_equipment(block(FocalLengthIn35mmFilm=round(35 * CROP), **FOCAL))
    assert found.pixel_pitch(SIZE) == pytest.approx(PITCH, rel=0.01)


@pytest.mark.parametrize(("ratio", "zoom"), [((0, 1), 1), ((0, 0), 1), ((1, 1), 1), ((2, 1), 2)])
def test_what_digital_zoom_shows_of_the_sensor_is_not_known(ratio, zoom):
    found = exif_equipment(
        block(
            FocalLengthIn35mmFilm=53,
            DigitalZoomRatio=IFDRational(*ratio),
            **FOCAL,
            **plane(25.4 / PITCH, 2),
        )
    )
    assert (found.digital_zoom, found.enlarged) == (zoom, zoom > 1)
    assert (found.pixel_pitch(SIZE) is None) == (zoom > 1)


def test_a_focal_plane_that_film_contradicts_is_a_mistake_of_the_camera():
    film = {"FocalLengthIn35mmFilm": 53, **FOCAL}
    wrong = exif_equipment(block(**film, **plane(10 / PITCH, 2)))  # cm, and called inches
    assert wrong.pixel_pitch(SIZE) == pytest.approx(PITCH, rel=0.02)
    right = exif_equipment(block(**film, **plane(25.4 / PITCH, 2)))
    assert right.pixel_pitch(SIZE) == pytest.approx(PITCH, rel=1e-5)


def ends(*values):
    return {"LensSpecification": tuple(IFDRational(*value) for value in values)}


def test_the_lens_tells_its_range():
    found = exif_equipment(block(**ends((180, 10), (2000, 10), (35, 10), (56, 10))))
    assert found.zoom_range == (18.0, 200.0)
    assert exif_equipment(block(**ends((18, 1), (200, 1), (0, 0), (0, 0)))).zoom_range == (18.0, 200.0)


@pytest.mark.parametrize(
    "tags",
    [
        {},
        ends((18, 1), (0, 0), (35, 10), (56, 10)),
        ends((0, 0), (200, 1), (35, 10), (56, 10)),
        ends((0, 1), (200, 1), (35, 10), (56, 10)),
        ends((18, 0), (200, 1), (35, 10), (56, 10)),
        ends((200, 1), (18, 1), (35, 10), (56, 10)),
        ends((50, 1), (50, 1), (18, 10), (18, 10)),  # no zoom
        ends((18, 1), (200, 1)),
        {"LensSpecification": "18-200"},
    ],
)
def test_a_range_that_is_none_is_not_known(tags):
    assert exif_equipment(block(**tags)).zoom_range is None


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"no EXIF",
        block(FocalLengthIn35mmFilm=0, FocalLength=IFDRational(0, 0)),
        block(FocalPlaneXResolution=IFDRational(1, 0), FocalPlaneResolutionUnit=9),
        block(of={"Make": "----", "Model": "\0\0"}, LensModel="---"),
    ],
)
def test_nothing_is_known_from_what_tells_nothing(content):
    found = exif_equipment(content)
    assert not any((found.maker, found.camera, found.lens, found.focal, found.pixel_pitch(SIZE)))
