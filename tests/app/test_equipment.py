"""The camera and lens of a calibration's photos in the lens."""

import dataclasses
import sys

import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from zoomjax import scenes
from zoomjax.app.equipment import (
    KnownLens,
    known_lens,
    taken_at_others,
    taken_otherwise,
    with_earlier,
    with_equipment,
)
from zoomjax.app.model_choice import WantedModel
from zoomjax.interop import library_lens
from zoomjax.io.equipment import FILM
from zoomjax.models.about import UNKNOWN

from ..io.test_equipment import CROP, FOCAL, PITCH, SIZE, block, ends, plane

SENSOR = plane(25.4 / PITCH, 2)


def photo(path, maker="NIKON CORPORATION", camera="NIKON D300", lens="18-200", sensor=SENSOR):
    content = block(of={"Make": maker, "Model": camera}, LensModel=lens, **FOCAL, **sensor)
    Image.fromarray(np.zeros((8, 12, 3), np.uint8)).save(path, exif=content)
    return path


@pytest.fixture
def lens():
    return scenes.nikkor_18_200(SIZE)


def test_what_all_photos_agree_on_is_in_the_lens(lens, tmp_path):
    (tmp_path / "none.jpg").write_bytes(b"")
    found = with_equipment(
        lens, [photo(tmp_path / "a.jpg"), photo(tmp_path / "b.jpg"), tmp_path / "none.jpg"]
    )
    assert found.about == {"camera": "NIKON D300", "lens": "18-200", "crop_factor": round(CROP, 3)}
    assert found.pixel_pitch == pytest.approx(PITCH, rel=1e-5)


def test_what_photos_do_not_agree_on_is_left_out(lens, tmp_path):
    other = photo(tmp_path / "b.jpg", maker="Canon", camera="EOS 5D", sensor=plane(12.7 / PITCH, 2))
    found = with_equipment(lens, [photo(tmp_path / "a.jpg"), other])
    assert found.about == {"lens": "18-200"}
    assert found.pixel_pitch is None


def test_photos_of_another_lens_than_the_one_they_are_corrected_by_are_told(lens, tmp_path):
    photos = [photo(tmp_path / "a.jpg"), photo(tmp_path / "b.jpg", lens="24-105"), bare(tmp_path / "c.jpg")]
    assert taken_otherwise(lens, photos[::2]) == []  # nothing is known of the lens
    known = dataclasses.replace(lens, about={"lens": "18-200"})
    (told,) = taken_otherwise(known, photos)
    assert "that of 18-200, and by their EXIF data 1 of 3 photos" in told
    assert "(24-105)" in told
    assert taken_otherwise(known, photos[:1]) == []


def test_photos_of_several_zooms_by_a_lens_of_one_that_is_not_known_are_told(lens, tmp_path):
    of_one = dataclasses.replace(lens, about={"focal": UNKNOWN})
    for name, focal in (("a.jpg", 20.0), ("b.jpg", 80.0)):
        content = block(of={"Model": "D300"}, FocalLength=focal)
        Image.fromarray(np.zeros((8, 12, 3), np.uint8)).save(tmp_path / name, exif=content)
    photos = [tmp_path / "a.jpg", tmp_path / "b.jpg"]
    (told,) = taken_otherwise(of_one, photos)
    assert "20 to 80 mm" in told
    assert taken_otherwise(of_one, photos[:1]) == []
    assert taken_otherwise(lens, photos) == []


def test_photos_of_other_focal_lengths_than_those_used_are_told(lens, tmp_path):
    def at(focal, **tags):
        path = tmp_path / f"{focal}-{len(tags)}.jpg"
        content = block(of={"Model": "D300"}, FocalLength=focal, **tags)
        Image.fromarray(np.zeros((8, 12, 3), np.uint8)).save(path, exif=content)
        return path

    photos, in_px = [at(24.0), at(35.0), at(70.0)], dataclasses.replace(lens, focal_unit="px")
    own = dict(zip(photos, (24.5, 33.0, 70.0), strict=True)).__getitem__
    for of in (lens, in_px):
        (told,) = taken_at_others(of, photos, lambda photo: 50.0)
        assert "24.0-0.jpg is of 24 mm and 70.0-0.jpg is of 70 mm, and the focal length used is 50" in told
        assert ("leave it out: then the EXIF data count" in told) == (of is lens)  # they are in mm
        assert ("give a table with that of each photo: the lens counts in px" in told) == (of is in_px)
        assert taken_at_others(of, photos, own) == []
        assert taken_at_others(of, [bare(tmp_path / "none.jpg")], lambda photo: 50.0) == []
    # One factor for all: in px, focused near, of equal view on film, or wrong.
    assert taken_at_others(in_px, photos, lambda photo: 160 * own(photo)) == []
    assert taken_at_others(lens, photos, lambda photo: 0.85 * own(photo)) == []
    assert taken_at_others(lens, [at(24.0, FocalLengthIn35mmFilm=36)], lambda photo: 36.0) == []
    (told,) = taken_at_others(lens, photos[1:2], lambda photo: 50.0)
    assert told.startswith("By their EXIF data 35.0-0.jpg is of 35 mm, and the focal length used is 50 mm.")
    of_one = dataclasses.replace(lens, about={"focal": UNKNOWN})
    assert taken_at_others(of_one, photos[1:2], lambda photo: 1.0) == []


def test_photos_that_show_another_part_of_the_sensor_are_told(lens, tmp_path):
    known = dataclasses.replace(lens, about={"crop_factor": 1.5})
    photos = [of_a_zoom(tmp_path / "a.jpg"), of_a_zoom(tmp_path / "b.jpg", FocalLengthIn35mmFilm=35)]
    (told,) = taken_otherwise(known, photos)
    assert "of crop factor 1.5, and by their EXIF data 1 of 2 photos are of 1:" in told
    assert taken_otherwise(known, photos[:1]) == taken_otherwise(lens, photos) == []
    width, height = SIZE
    whole, part = (
        of_a_zoom(tmp_path / f"{shown}.jpg", ExifImageWidth=shown, ExifImageHeight=height)
        for shown in (width, width * 4 // 3)
    )
    (told,) = taken_otherwise(known, [whole, part])
    assert f"1 of 2 photos were cropped, as the camera wrote another shape ({width * 4 // 3} x" in told
    assert taken_otherwise(lens, [whole, part]) == []  # its own may have been
    assert (with_equipment(lens, [part]).about, with_equipment(lens, [part]).pixel_pitch) == ({}, None)
    zoomed = of_a_zoom(tmp_path / "c.jpg", DigitalZoomRatio=IFDRational(2, 1))
    for of in (known, lens):
        (told,) = taken_otherwise(of, [photos[0], zoomed])
        assert "for a digital zoom of 1, and by their EXIF data 1 of 2 photos were taken with 2:" in told
    found = with_equipment(lens, [zoomed, zoomed])
    assert (found.about, found.pixel_pitch) == ({"digital_zoom": 2.0}, None)
    assert taken_otherwise(found, [zoomed]) == []
    assert len(taken_otherwise(found, photos[:1])) == 1
    assert with_equipment(lens, [photos[0], zoomed]).about == {}


def test_photos_of_another_camera_than_that_of_a_lens_without_a_name_are_told(lens, tmp_path):
    """As of a phone."""
    known = dataclasses.replace(lens, about={"camera": "Apple iPhone"})
    photos = [photo(tmp_path / "a.jpg", lens=""), bare(tmp_path / "b.jpg")]
    (told,) = taken_otherwise(known, photos)
    assert "the camera Apple iPhone, and by their EXIF data 2 of 2 photos" in told
    assert taken_otherwise(dataclasses.replace(known, about={"camera": "NIKON D300"}), photos) == []
    assert (
        taken_otherwise(dataclasses.replace(known, about={"camera": "a", "lens": "18-200"}), photos) == []
    )


def test_photos_of_several_lenses_are_told_where_a_lens_has_no_name(lens, tmp_path):
    """It is of one of them at most."""
    photos = [photo(tmp_path / f"{number}.jpg", lens=name) for number, name in enumerate("aab")]
    (told,) = taken_otherwise(lens, photos)
    assert told.startswith("By their EXIF data the photos were taken with 2 lenses, a (2), b (1), and are")
    assert taken_otherwise(lens, photos[:2]) == []
    (told,) = taken_otherwise(dataclasses.replace(lens, about={"lens": "a"}), photos)
    assert told.startswith("The lens is that of a, and")
    one, two = (photo(tmp_path / f"{body}.jpg", "", body, lens="") for body in ("D300", "X100"))
    (told,) = taken_otherwise(lens, [one, two])
    assert "taken with 2 cameras, D300 (1), X100 (1), and are corrected as of one" in told
    (told,) = taken_otherwise(dataclasses.replace(lens, about={"camera": "D300"}), [one, two])
    assert told.startswith("The lens is that of the camera D300")


def test_names_of_the_database_are_not_those_of_exif_data(tmp_path):
    known = library_lens("FE 24-70mm f/2.8 GM", image_size=(300, 200))
    own = photo(tmp_path / "a.jpg", "SONY", "ILCE-7M3", lens="FE 24-70mm F2.8 GM", sensor={})
    assert taken_otherwise(known, [own]) == []


def bare(path):
    """A photo whose EXIF data name the body, and nothing of its sensor."""
    block_of_it = block(of={"Make": "NIKON CORPORATION", "Model": "NIKON D300"})
    Image.fromarray(np.zeros((8, 12, 3), np.uint8)).save(path, exif=block_of_it)
    return path


def test_the_database_tells_the_sensor_of_a_body_whose_photos_do_not(lens, tmp_path):
    found = with_equipment(lens, [bare(tmp_path / "a.jpg")])
    assert found.about["crop_factor"] == 1.523
    assert found.pixel_pitch == pytest.approx(FILM / 1.523 / np.hypot(*SIZE))


def test_without_the_database_the_sensor_is_not_known(lens, tmp_path, monkeypatch):
    from zoomjax.interop import database

    database.database.cache_clear()
    monkeypatch.setitem(sys.modules, "lensfunpy", None)
    assert with_equipment(lens, [bare(tmp_path / "a.jpg")]).pixel_pitch is None


def test_the_maker_is_named_once(lens, tmp_path):
    found = with_equipment(lens, [photo(tmp_path / "a.jpg", maker="SONY", camera="ILCE-7M3")])
    assert found.about["camera"] == "SONY ILCE-7M3"


ZOOM = ends((18, 1), (200, 1), (35, 10), (56, 10))


def of_a_zoom(path, zoom=ZOOM, **sensor):
    content = block(**FOCAL, **zoom, **(sensor or {"FocalLengthIn35mmFilm": 53}))
    Image.fromarray(np.zeros((8, 12, 3), np.uint8)).save(path, exif=content)
    return path


def test_a_lens_that_all_photos_tell_is_known(tmp_path):
    photos = [of_a_zoom(tmp_path / "a.jpg"), of_a_zoom(tmp_path / "b.jpg", FocalLengthIn35mmFilm=52)]
    found = known_lens(photos, [18.0, 35.0], SIZE)
    assert found == KnownLens(18.0, 200.0, 52.5 / 35)
    assert found.prior().focal_ref == 18.0
    assert "a lens of 18 to 200 mm at crop factor 1.5" in found.sentence()


@pytest.mark.parametrize(
    "other",
    [
        {"zoom": {}},
        {"zoom": ends((16, 1), (85, 1), (35, 10), (56, 10))},
        {"FocalLengthIn35mmFilm": 0},
        {"FocalLengthIn35mmFilm": 70},
    ],
)
def test_a_lens_that_one_photo_does_not_tell_or_contradicts_is_not_known(other, tmp_path):
    photos = [of_a_zoom(tmp_path / "a.jpg"), of_a_zoom(tmp_path / "b.jpg", **other)]
    assert known_lens(photos, [18.0, 35.0], SIZE) is None


@pytest.mark.parametrize("focal", [[9.0, 35.0], [35.0, 280.0]])
def test_focal_lengths_beyond_the_lens_are_those_of_another(focal, tmp_path):
    assert known_lens([of_a_zoom(tmp_path / "a.jpg")], focal, SIZE) is None


def test_the_models_that_are_compared_know_the_lens():
    known = WantedModel("smooth", lens=KnownLens(18.0, 200.0, 1.5))
    assert known.base([18.0, 35.0]).zoom.focal_ref == 18.0
    assert WantedModel("smooth").base([18.0, 35.0]).zoom.mean is None


FACTS = {"camera": "NIKON D300", "lens": "18-200", "crop_factor": 1.5}


def results(folder, lens, summary=True):
    """The files of a calibration that count here; the path of its lines."""
    folder.mkdir()
    lens.save(folder / "lens.json")
    if summary:
        (folder / "summary.json").write_text("{}")
    return folder / "lines.npz"


def test_lines_that_are_fitted_again_keep_what_the_earlier_lens_knew(lens, tmp_path):
    known = dataclasses.replace(lens, about=FACTS, pixel_pitch=PITCH)
    files = [results(tmp_path / "a", known), results(tmp_path / "b", known)]
    found = with_earlier(lens, files)
    assert (found.about, found.pixel_pitch) == (FACTS, PITCH)
    narrow = dataclasses.replace(lens, focal_range=np.array([24.0, 70.0]))  # some frames left out
    assert with_earlier(narrow, files[:1]).pixel_pitch == PITCH
    other = dataclasses.replace(known, about={**FACTS, "lens": "24-70"}, pixel_pitch=2 * PITCH)
    found = with_earlier(lens, [files[0], results(tmp_path / "c", other)])
    assert (dict(found.about), found.pixel_pitch) == ({"camera": "NIKON D300", "crop_factor": 1.5}, None)


def test_a_lens_beside_lines_that_is_not_theirs_says_nothing(lens, tmp_path):
    known = dataclasses.replace(lens, about=FACTS, pixel_pitch=PITCH)
    wide = dataclasses.replace(known, focal_range=np.array([24.0, 70.0]))
    in_px = dataclasses.replace(known, focal_unit="px")
    small = dataclasses.replace(known, image_size=(300, 200), centre=np.array([150.0, 100.0]))
    (tmp_path / "none").mkdir()
    for files in (
        [results(tmp_path / "imported", known, summary=False)],
        [results(tmp_path / "range", wide)],
        [results(tmp_path / "unit", in_px)],
        [results(tmp_path / "size", small)],
        [tmp_path / "none" / "lines.npz"],
        [results(tmp_path / "other", known).with_name("own.npz")],
        [results(tmp_path / "one", known), tmp_path / "none" / "lines.npz"],
    ):
        assert with_earlier(lens, files) is lens, files


def test_relative_focal_lengths_stay_so_and_are_not_mixed_with_others(lens, tmp_path):
    relative = dataclasses.replace(lens, about={"focal": "relative"})
    files = [results(tmp_path / "a", relative), results(tmp_path / "b", lens)]
    assert with_earlier(lens, files[:1]).about == {"focal": "relative"}
    with pytest.raises(ValueError, match=r"lines\.npz is of a clip whose focal lengths are relative"):
        with_earlier(lens, files)


def test_a_focal_length_that_is_not_known_stays_so(lens, tmp_path):
    one = dataclasses.replace(lens, focal_range=np.ones(2))
    unknown = dataclasses.replace(one, about={"focal": "not known"})
    files = [results(tmp_path / "a", unknown), results(tmp_path / "b", lens)]
    assert with_earlier(one, files[:1]).about == {"focal": "not known"}
    with pytest.raises(ValueError, match=r"lines\.npz is of photos whose focal length is not known"):
        with_earlier(dataclasses.replace(lens, focal_range=np.array([1.0, 200.0])), files)
