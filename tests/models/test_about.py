"""Facts in a lens: kept in files and through transformations, checked on entry."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.models import About, Camera

FACTS = {"camera": "NIKON D300", "crop_factor": 1.5}


def lens(**more):
    zoom = zj.PolynomialZoom(1, jnp.array([[0.02, 0.01], [0.1, -0.03]]), jnp.array(20.0))
    return zj.ZoomLens(zoom, jnp.array([319.5, 239.5]), jnp.array([20.0, 80.0]), (640, 480), **more)


def test_facts_and_pitch_come_back_from_a_file(tmp_path):
    lens(pixel_pitch=0.0055, about=FACTS).save(tmp_path / "lens.json")
    again = zj.load_lens(tmp_path / "lens.json")
    assert again.pixel_pitch == 0.0055
    assert again.about == FACTS
    assert json.loads((tmp_path / "lens.json").read_text())["version"] == 1


def test_a_file_without_them_is_what_it_was(tmp_path):
    lens().save(tmp_path / "lens.json")
    assert {"pixel_pitch", "about"}.isdisjoint(json.loads((tmp_path / "lens.json").read_text()))
    again = zj.load_lens(tmp_path / "lens.json")
    assert (again.pixel_pitch, dict(again.about)) == (None, {})


@pytest.mark.parametrize(
    "change", [{"pixel_pitch": -1}, {"pixel_pitch": "x"}, {"about": [1]}, {"about": {"camera": [1]}}]
)
def test_a_file_with_wrong_ones_is_refused(change, tmp_path):
    path = tmp_path / "lens.json"
    lens().save(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(ValueError, match=f"Cannot read a lens from .*: Argument {next(iter(change))} must"):
        zj.load_lens(path)


def test_entries_that_are_not_known_are_told(tmp_path):
    """They were gone without a word when the lens was saved again."""
    path = tmp_path / "lens.json"
    lens().save(path)
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content | {"camera": {"sensor": 36}, "zoom": content["zoom"] | {"note": 1}}))
    with pytest.warns(
        UserWarning, match=r"lens\.json has entries .* not know: camera, zoom\.note\. They do"
    ):
        assert zj.load_lens(path).about == {}


@pytest.mark.parametrize("name", ["crop_factor", "digital_zoom", "width_of_focal_px"])
@pytest.mark.parametrize("value", ["1.5", "", 0, -1.5])
def test_what_is_computed_with_must_be_a_positive_number(name, value, tmp_path):
    path = tmp_path / "lens.json"
    lens().save(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"about": {name: value}}))
    with pytest.raises(
        ValueError, match=f"lens.json: Argument about must hold a positive number as {name}"
    ):
        zj.load_lens(path)


@pytest.mark.parametrize("pitch", [0, -1.0, np.nan, np.inf, True, "0.01", [1, 2]])
def test_a_wrong_pitch_is_refused(pitch):
    with pytest.raises(ValueError, match="pixel_pitch must be the width of a pixel"):
        lens(pixel_pitch=pitch)


@pytest.mark.parametrize("pitch", [5.5, 5.5e-6])
def test_a_pitch_in_another_unit_is_refused(pitch, tmp_path):
    with pytest.raises(ValueError, match=r"must be the width of a pixel .*\(3\.9 µm are 0\.0039\)"):
        lens(pixel_pitch=pitch)
    with pytest.raises(ValueError, match="pixel_pitch must be the width of a pixel"):
        Camera(lens(), pixel_pitch=pitch)
    lens(pixel_pitch=0.0055).save(tmp_path / "lens.json")
    text = (tmp_path / "lens.json").read_text().replace("0.0055", str(pitch))
    (tmp_path / "lens.json").write_text(text)
    with pytest.raises(ValueError, match=r"Cannot read a lens from .*: Argument pixel_pitch must"):
        zj.load_lens(tmp_path / "lens.json")


@pytest.mark.parametrize("word", ["relatve", "Relative", "unknown", 50.0])
def test_a_misspelt_word_for_focal_lengths_is_refused(word, tmp_path):
    with pytest.raises(ValueError, match="'not known' or 'relative' as focal"):
        lens(about={"focal": word})
    path = tmp_path / "lens.json"
    lens(about={"focal": "relative"}).save(path)
    path.write_text(path.read_text().replace('"relative"', json.dumps(word)))
    with pytest.raises(ValueError, match=r"lens.json: .* as focal"):
        zj.load_lens(path)


@pytest.mark.parametrize("about", ["NIKON", {1: "a"}, {"crop": np.nan}, {"crop": None}, {"tele": True}])
def test_wrong_facts_are_refused(about):
    with pytest.raises(ValueError, match="about must be a dictionary of words and finite numbers"):
        lens(about=about)


@pytest.mark.parametrize("width", ["640", "wide", 0.0, -640.0])
def test_a_width_of_focal_lengths_that_is_none_is_refused(width, tmp_path):
    """By it focal lengths in px are multiplied, in cameras and exports."""
    with pytest.raises(ValueError, match="about must hold a positive number as width_of_focal_px"):
        lens(about={"width_of_focal_px": width})
    lens(about={"width_of_focal_px": 640.0}).save(tmp_path / "lens.json")
    text = (tmp_path / "lens.json").read_text()
    (tmp_path / "lens.json").write_text(text.replace('_px": 640.0', f'_px": {json.dumps(width)}'))
    with pytest.raises(ValueError, match=r"Cannot read a lens from .*: Argument about must hold"):
        zj.load_lens(tmp_path / "lens.json")


def test_facts_do_not_change_with_the_dictionary_they_came_from():
    given = dict(FACTS)
    one = lens(about=given)
    given["camera"] = "another"
    assert one.about == FACTS
    assert hash(one.about) == hash(About(dict(reversed(FACTS.items()))))


def test_a_lens_with_facts_goes_through_jit_and_its_result_keeps_its_own():
    doubled = jax.jit(lambda lens: jax.tree.map(lambda leaf: 2 * leaf, lens))
    assert doubled(lens(about=FACTS)).about == FACTS
    assert doubled(lens(about={"camera": "another"})).about == {"camera": "another"}


def test_lenses_without_facts_stack():
    both = [dataclasses.replace(lens(about={"camera": name}), about={}) for name in "ab"]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *both)
    assert jax.vmap(lambda lens: lens(40.0).coefficients)(stacked).shape == (2, 2)


@pytest.mark.filterwarnings("ignore:The lens is for images of")
def test_half_the_pixels_are_twice_as_wide():
    assert zj.models.lens_for_size(lens(pixel_pitch=0.0055), (320, 240)).pixel_pitch == 0.011


def test_a_camera_takes_the_pitch_of_its_lens():
    points = np.array([[0.1, 0.2, 1.0]])
    own, given = Camera(lens(pixel_pitch=0.0055)), Camera(lens(), pixel_pitch=0.0055)
    np.testing.assert_array_equal(own.project(points, 40.0)[0], given.project(points, 40.0)[0])
    with pytest.raises(ValueError, match="must be given for a lens whose focal lengths are in mm"):
        Camera(lens())
