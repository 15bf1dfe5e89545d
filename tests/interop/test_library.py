"""Lenses of the library against lensfun's own code: their error is what they say; and invertible."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.interop import find_lenses, library_lens
from zoomjax.models import TableZoom, certify

from ._lensfun import largest_difference

SIZE = (4288, 2848)
NIKKOR = "Nikon AF-S DX VR Zoom-Nikkor 18-200mm f/3.5-5.6G IF-ED"
LENSES = (
    NIKKOR,
    "Tokina 11-16mm f/2.8 AT-X 116 AF Pro DX",  # its table folds within the image
    "HD PENTAX DA* 16-50mm f/2.8 ED PLM AW",  # strong, and far from even powers
    "Canon EF 24-70mm f/2.8L II USM",
    "Canon PowerShot S100 & compatibles",  # a 4:3 sensor
    "FE 24-70mm f/2.8 GM",
)


def focal_lengths(table):
    """Those of the table, and between."""
    some = np.array(table.focal)[:: max(len(table.focal) // 2, 1)]
    return [*some, *np.sqrt(some[1:] * some[:-1])]


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("smaller", [1.0, 1.5])
def test_the_error_of_a_lens_is_as_large_as_it_says(name, smaller):
    table = next(table for table in find_lenses(name) if table.name == name)
    crop = table.crop_factor * smaller
    lens = library_lens(table, image_size=SIZE, crop=crop)
    worst = max(largest_difference(lens, table, focal, crop) for focal in focal_lengths(table))
    assert worst <= 1.1 * lens.about["table_error_px"] + 0.03
    assert certify(lens).certified


@pytest.mark.parametrize(("model", "kind"), [("smooth", zj.SmoothZoom), ("table", TableZoom)])
def test_the_model_can_be_chosen(model, kind):
    lens = library_lens(NIKKOR, image_size=SIZE, model=model)
    assert isinstance(lens.zoom, kind)


def test_the_smooth_model_is_the_choice_within_a_pixel_and_a_table_is_nearer():
    for table in find_lenses("nikkor", zooms=True)[::6]:
        lens = library_lens(table, image_size=SIZE)
        near = lens.about["table_error_px"]
        assert (
            isinstance(lens.zoom, zj.SmoothZoom)
            == (library_lens(table, image_size=SIZE, model="smooth").about["table_error_px"] <= 1)
            or near <= 1
        )
        assert library_lens(table, image_size=SIZE, model="table").about["table_error_px"] < 1.5


def test_a_lens_of_one_focal_length_is_a_table_of_one():
    lens = library_lens("Nikon AF-S Nikkor 85mm f/1.8G", image_size=SIZE)
    assert lens.zoom.parameters.shape == (1, 7)
    assert lens.focal_range[0] < 85 < lens.focal_range[1]


def test_what_a_lens_says_of_itself_is_kept_in_its_file(tmp_path):
    lens = library_lens(NIKKOR, image_size=SIZE)
    lens.save(tmp_path / "lens.json")
    again = zj.load_lens(tmp_path / "lens.json")
    assert again.about == lens.about
    assert set(again.about) == {"lens", "maker", "crop_factor", "table_error_px", "source"}
    assert again.pixel_pitch == pytest.approx(28.84 / np.hypot(*SIZE), rel=1e-3)
    points = np.array([[3.0, 4.0], [4000.0, 100.0]])
    np.testing.assert_array_equal(again(31.0).undistort(points), lens(31.0).undistort(points))


def test_it_goes_through_transformations():
    lens = library_lens(NIKKOR, image_size=SIZE)

    @eqx.filter_jit
    def corner(focal):
        return lens.undistort(jnp.zeros(2), focal)[0]

    slope = float(jax.grad(corner)(30.0))
    step = float(corner(30.001) - corner(29.999)) / 0.002
    assert slope == pytest.approx(step, rel=1e-4)
    assert slope != 0


def test_a_smaller_sensor_sees_the_middle_of_the_same_lens():
    whole = library_lens("Canon EF 24-70mm f/2.8L II USM", image_size=(6000, 4000), crop=1.0, model="table")
    part = library_lens("Canon EF 24-70mm f/2.8L II USM", image_size=(3000, 2000), crop=2.0, model="table")
    points = np.array([[0.0, 0.0], [2500.0, 300.0]])
    shift = np.array([1500.0, 1000.0])
    inner, outer = part(35.0).undistort(points), whole(35.0).undistort(points + shift) - shift
    # But for the magnification, and the errors that both say.
    middle = (np.array([3000, 2000]) - 1) / 2
    radii = [np.linalg.norm(found - middle, axis=1) for found in (inner, outer)]
    assert abs(np.ptp(radii[0] / radii[1])) * 1800 < 2


def test_a_larger_sensor_than_that_calibrated_is_refused():
    with pytest.raises(
        ValueError, match=r"calibrated on a sensor of crop factor 1\.5, and images of crop factor 1 "
    ):
        library_lens(NIKKOR, image_size=SIZE, crop=1.0)


def test_of_several_tables_the_nearest_sensor_counts():
    name = "Nikon AF Nikkor 20mm f/2.8D"
    assert {table.crop_factor for table in find_lenses(name)} == {1.0, 1.528}
    assert library_lens(name, image_size=SIZE, crop=1.3).about["crop_factor"] == 1.3
    one, other = (library_lens(name, image_size=SIZE, crop=crop) for crop in (1.5, 1.53))
    assert one.about["table_error_px"] != other.about["table_error_px"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"model": "spline"}, "model must be one of auto, smooth, table"),
        ({"crop": 0}, "crop must be a positive number"),
        ({"crop": 1e4}, r"No images of \d+ x \d+ px have a crop factor of 10000: it means pixels of"),
        ({"image_size": (0, 5)}, "image_size must be two positive integers"),
    ],
)
def test_bad_arguments_are_a_sentence(change, message):
    with pytest.raises(ValueError, match=message):
        library_lens(NIKKOR, **({"image_size": SIZE} | change))


def turns_back(table):
    """Whether the table folds before the corner of the image at some focal length."""
    corrected = np.linspace(0, 3, 3001)
    for focal in table.focal:
        distorted = corrected * np.polynomial.polynomial.polyval(corrected, table.polynomial(focal))
        rises = np.diff(distorted, append=-1) > 0
        if distorted[np.argmin(rises)] < np.hypot(table.aspect_ratio, 1):
            return True
    return False


@pytest.mark.slow
def test_every_zoom_of_the_database_is_invertible_and_near_its_table():
    for table in find_lenses(zooms=True)[::9]:
        lens = library_lens(table, image_size=SIZE)
        assert certify(dataclasses.replace(lens, about={})).certified
        assert lens.about["table_error_px"] < (3 if not turns_back(table) else 15)
