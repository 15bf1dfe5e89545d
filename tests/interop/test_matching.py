"""From what EXIF data say of camera and lens to one lens of the database, or a question."""

import pytest

from zoomjax.interop import match_lens
from zoomjax.interop.matching import crop_factor
from zoomjax.io import Equipment

SIZE = (6000, 4000)


@pytest.mark.parametrize(
    ("maker", "camera", "lens", "focal", "name", "crop"),
    [
        (
            "Canon",
            "Canon EOS 600D",
            "EF-S18-55mm f/3.5-5.6 IS II",
            35,
            "Canon EF-S 18-55mm f/3.5-5.6 IS II",
            1.613,
        ),
        (
            "Canon",
            "Canon EOS 5D Mark III",
            "EF24-70mm f/2.8L II USM",
            35,
            "Canon EF 24-70mm f/2.8L II USM",
            1.0,
        ),
        ("SONY", "ILCE-7M3", "FE 24-70mm F2.8 GM", 35, "FE 24-70mm f/2.8 GM", 1.0),  # and there is a GM II
        ("FUJIFILM", "X-T20", "XF18-55mmF2.8-4 R LM OIS", 18, "XF18-55mmF2.8-4 R LM OIS", 1.529),
        ("Canon", "Canon PowerShot S100", "", 10, "Canon PowerShot S100 & compatibles", 4.62),
        ("Canon", "Canon PowerShot S100", "5.2-26.0 mm", 10, "Canon PowerShot S100 & compatibles", 4.62),
        ("Panasonic", "DMC-LX3", "", 5.1, "DMC-LX3 & compatibles (Standard)", 5.1),  # its 3:2 mode
    ],
)
def test_the_lens_of_a_photo_is_found(maker, camera, lens, focal, name, crop):
    found = match_lens(Equipment(maker, camera, lens, float(focal)), SIZE)
    assert (found.table.name, found.crop) == (name, crop)


D300 = ("NIKON CORPORATION", "NIKON D300")


@pytest.mark.parametrize(
    ("photo", "message"),
    [
        (
            (*D300, "18.0-200.0 mm f/3.5-5.6", 35),
            r"2 lenses .* choose argument lens, \"Nikon .*IF-ED\" or \"Nikon .*II\"",
        ),
        ((*D300, "AF-S DX Zoom-Nikkor 18-55mm f/3.5-5.6G ED II", 35), 'No lens .* perhaps "Nikon AF-S DX'),
        ((*D300, "AF-S DX VR Zoom-Nikkor 18-200mm f/3.5-5.6G IF-ED", 400), "No lens .* fits"),
        (
            (*D300, "", 35),
            'fits the EXIF data of the camera "NIKON D300": choose argument lens by its name',
        ),
        (("", "", "", 35), "EXIF data name neither camera nor lens"),
        (("", "", "FE 24-70mm F2.8 GM", 35), "crop factor of the photo is not known"),
    ],
)
def test_where_none_or_several_fit_it_asks(photo, message):
    with pytest.raises(ValueError, match=message):
        match_lens(Equipment(*photo[:3], float(photo[3])), SIZE)


def test_a_name_settles_it_and_the_body_gives_the_crop_factor():
    found = match_lens(
        Equipment(*D300, "18.0-200.0 mm f/3.5-5.6", 35.0), SIZE, lens="18-200mm f/3.5-5.6g if-ed ii"
    )
    assert (found.table.name[-2:], found.crop) == ("II", 1.523)


def test_a_part_of_the_sensor_has_the_crop_factor_of_its_own():
    part = Equipment("SONY", "ILCE-7M3", "FE 24-70mm F2.8 GM", 35.0, crop=1.53)
    assert match_lens(part, SIZE).crop == 1.53
    rounded = Equipment("SONY", "ILCE-7M3", "FE 24-70mm F2.8 GM", 35.0, crop=1.03)
    assert match_lens(rounded, SIZE).crop == 1.0


def test_a_lens_for_a_smaller_sensor_is_refused_on_a_larger():
    with pytest.raises(ValueError, match=r"was calibrated on a sensor of crop factor 1\.5"):
        match_lens(Equipment("NIKON CORPORATION", "NIKON D3"), SIZE, lens="18-200mm f/3.5-5.6g if-ed ii")


def test_a_photo_with_digital_zoom_has_no_crop_factor():
    """Its body's would be that of all of the sensor."""
    photo = Equipment("SONY", "ILCE-7M3", "FE 24-70mm F2.8 GM", 35.0, crop=2.0, digital_zoom=2.0)
    assert crop_factor(photo, SIZE) is None
    for lens in (None, "FE 24-70mm f/2.8 GM"):
        with pytest.raises(ValueError, match="digital zoom of 2: which part of the sensor it shows is not"):
            match_lens(photo, SIZE, lens=lens)


def test_a_photo_that_was_cropped_has_no_crop_factor_either():
    """That of its body, or of equal view on film, is of what the camera wrote."""
    photo = Equipment("SONY", "ILCE-7M3", "FE 24-70mm F2.8 GM", 35.0, crop=1.0, written=(6000, 4000))
    assert match_lens(photo, (3000, 2000)).crop == crop_factor(photo, (2000, 3000)) == 1.0
    for lens in (None, "FE 24-70mm f/2.8 GM"):
        with pytest.raises(
            ValueError, match=r"has 3000 x 3000 px, and .* wrote 6000 x 4000: it was cropped"
        ):
            match_lens(photo, (3000, 3000), lens=lens)
    assert crop_factor(photo, (3000, 3000)) is None
