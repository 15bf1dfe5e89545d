"""Arguments of `write` and `read`: what is refused, by name, before a file is looked at or made."""

import dataclasses
import json

import numpy as np
import pytest

import zoomjax as zj
from zoomjax.interop.base import InterpolatedFormat, NodeFormat
from zoomjax.models import SmoothZoom, TableZoom

from ._lenses import LENSES, PITCH

FORMATS = {fmt.name: fmt for fmt in zj.interop.formats()}
WRITE = {"tolerance": 0.2, "convention": "centres"}
READ = {"focal": 24, "crop": 1.5, "name": "One", "direction": "undistort", "convention": "centres"}
"""Options with values that are right where they are used."""

CAMERA = "1 SIMPLE_RADIAL 640 480 500 320 240 -0.1\n"


@pytest.mark.parametrize("name", [name for name, fmt in FORMATS.items() if fmt.writes])
@pytest.mark.parametrize("option", WRITE)
def test_an_option_is_used_or_refused_by_writers(name, option, tmp_path):
    fmt, told = FORMATS[name], {"focal": [24, 50], "pixel_pitch": PITCH, option: WRITE[option]}
    path = tmp_path / f"a{fmt.suffixes[0] * (fmt.zoom != 'one')}"
    if option in fmt.options:
        zj.interop.write(LENSES["landscape"](), path, format=name, **told)
        return
    with pytest.raises(ValueError, match=f"Argument {option} has no effect on the format {name}: leave"):
        zj.interop.write(LENSES["landscape"](), path, format=name, **told)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("option", READ)
def test_an_option_is_used_or_refused_by_readers(name, option, tmp_path):
    path = tmp_path / f"a{FORMATS[name].suffixes[0]}"
    path.write_text("")
    used = option in FORMATS[name].options
    message = (
        "Cannot read a" if used else f"Argument {option} has no effect on the format {name}: leave it out"
    )
    with pytest.raises(ValueError, match=message):
        zj.interop.read(path, format=name, **{option: READ[option]})


def test_facts_about_the_camera_are_no_options(tmp_path):
    lens = LENSES["landscape"]()
    zj.interop.write(lens, tmp_path / "a.pfb", focal=24, pixel_pitch=PITCH)
    zj.interop.read(tmp_path / "a.pfb", focal=24, image_size=lens.image_size)


def test_a_pitch_that_contradicts_the_lens_s_is_told(tmp_path):
    """It was written without a word."""
    lens = dataclasses.replace(LENSES["landscape"](), pixel_pitch=PITCH)
    for same in (None, PITCH, PITCH * 1.005):
        zj.interop.write(lens, tmp_path / "a.xml", format="lensfun", pixel_pitch=same, overwrite=True)
    with pytest.warns(UserWarning, match=r"lens is 0\.0367 mm, and 0\.055 mm is given: leave argument"):
        zj.interop.write(lens, tmp_path / "b.xml", format="lensfun", pixel_pitch=0.055)
    assert zj.interop.read(
        tmp_path / "b.xml", image_size=lens.image_size
    ).lens.pixel_pitch == pytest.approx(0.055, rel=1e-3)


@pytest.mark.parametrize("name", ["pftrack", "discorpy", "nuke"])
def test_focal_lengths_of_files_without_them_may_be_in_px(name, tmp_path):
    """They were read as if they were in mm, whatever they were."""
    lens, fmt = LENSES["px"](), FORMATS[name]
    focal = np.array([18, 35, 90, 200]) / PITCH
    path = tmp_path / f"a{fmt.suffixes[0] * (fmt.zoom != 'one')}"
    zj.interop.write(lens, path, format=name, focal=focal, pixel_pitch=PITCH)
    told = {"focal": focal} | ({} if name == "pftrack" else {"image_size": lens.image_size})
    back = zj.interop.read(path, **told, focal_unit="px").lens
    assert back.focal_unit == "px"
    assert np.asarray(back.focal_range) == pytest.approx(focal[[0, -1]])
    points = np.array([[10.0, 20.0], [600.0, 400.0]])
    for f in focal:
        np.testing.assert_allclose(back(f).undistort(points), lens(f).undistort(points), atol=0.05)
    if name != "nuke":  # whose node says its focal lengths, in mm
        assert zj.interop.read(path, **told).lens.focal_unit == "mm"


def test_a_unit_of_focal_lengths_that_are_not_given_is_refused(tmp_path):
    lens = LENSES["px"]()
    path = tmp_path / "a"
    zj.interop.write(lens, path, format="opencv", focal=1000, pixel_pitch=PITCH)
    with pytest.raises(ValueError, match="focal_unit is that of argument focal, which is not given"):
        zj.interop.read(path, format="opencv", focal_unit="px")
    with pytest.raises(ValueError, match="holds its focal lengths in px: leave out arguments focal"):
        zj.interop.read(path, format="opencv", focal=900, focal_unit="px")
    with pytest.raises(ValueError, match="focal_unit must be one of mm, px, but it is 'inch'"):
        zj.interop.read(path, format="opencv", focal=900, focal_unit="inch")


WRONG = {
    "Argument zoom must be a zoom model .* but it is the class TableZoom": {"zoom": TableZoom},
    "Argument terms must be an integer of at least 1, but it is -1": {"terms": -1},
    "Argument terms must be an integer of at least 1, but it is 0": {"terms": 0},
    "Argument terms must be at most 4, but it is 5": {"terms": 5},
    "Argument distortion_model must be a distortion model such as": {"distortion_model": "division"},
    "Argument image_size": {"image_size": (0, 3)},
    "Argument focal must hold positive numbers, but it is 'wide'": {"focal": "wide"},
    r"Argument focal must hold positive numbers, but it is \[24, -1\]": {"focal": [24, -1]},
    "^The prior of this SmoothZoom is for 2 terms": {"zoom": SmoothZoom(), "terms": 3},
}


@pytest.mark.parametrize("message", WRONG)
def test_a_wrong_argument_is_no_damaged_file(message, tmp_path, unchecked):
    (tmp_path / "cameras.txt").write_text(CAMERA)
    with pytest.raises((ValueError, TypeError), match=message) as error:
        zj.interop.read(tmp_path / "cameras.txt", **WRONG[message])
    assert "Cannot read" not in str(error.value)


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ({"convention": "nuke"}, "Argument convention must be one of centres, gyroflow, alicevision, but"),
        ({"direction": "back"}, "Argument direction must be one of undistort, redistort, but it is 'back'"),
    ],
)
def test_a_wrong_choice_is_no_damaged_map(told, message, tmp_path):
    (tmp_path / "undistort.exr").write_bytes(b"v/1\x01")
    with pytest.raises(ValueError, match=f"^{message}"):
        zj.interop.read(tmp_path / "undistort.exr", **told)


def sizes_of_files(folder):
    """A file of each format that says its image size, of images of 640 x 480."""
    lens = LENSES["landscape"]()
    for name, fmt in FORMATS.items():
        if fmt.writes and name not in ("nuke", "lensfun", "discorpy"):
            path = folder / (name if fmt.zoom == "one" else f"{name}{fmt.suffixes[0]}")
            focal = [24, 50]
            zj.interop.write(lens, path, format=name, focal=focal, pixel_pitch=PITCH)
            yield name, path, {"focal": focal} if name == "pftrack" else {}


def test_an_image_size_that_contradicts_the_file_is_refused(tmp_path):
    for name, path, told in sizes_of_files(tmp_path):
        with pytest.raises(
            ValueError, match="images are 640x480 px: leave out argument image_size, which is"
        ):
            zj.interop.read(path, format=name, image_size=(1280, 960), **told)
        assert zj.interop.read(path, image_size=(640, 480), **told).lens.image_size == (640, 480)


def focal_in(path):
    """The focal lengths in a file, or a folder, as they follow each other there."""
    lines = path.read_text().splitlines()
    if path.suffix == ".jsonl":
        return [json.loads(line)["lens"]["pinholeFocalLength"] for line in lines]
    if path.suffix == ".txt":
        return [round(float(line.split()[4]) * PITCH, 6) for line in lines if line[0] != "#"]
    if path.suffix == ".json":
        return [frame["focal"] for frame in json.loads(path.read_text())["frames"]]
    [line] = [line for line in lines if "focal_length" in line]
    return [10 * float(word) for word in line.replace("}", "").split()[3::2]]


@pytest.mark.parametrize("name", ["opentrackio", "colmap", "nerfstudio", "nuke"])
def test_entries_are_in_the_order_of_the_focal_lengths_given(name, tmp_path):
    path = tmp_path / f"a{FORMATS[name].suffixes[0]}"
    focal = [70, 35, 24, 35]
    report = zj.interop.write(LENSES["landscape"](), path, format=name, focal=focal, pixel_pitch=PITCH)
    assert report.focal == tuple(focal)
    assert focal_in(path) == pytest.approx(focal)


@pytest.mark.parametrize("name", [n for n, fmt in FORMATS.items() if fmt.writes and fmt.zoom != "list"])
def test_a_focal_length_twice_is_refused_where_it_can_be_there_once(name, tmp_path):
    with pytest.raises(ValueError, match=f"once for the format {name}, but 35 is there 2 times"):
        zj.interop.write(
            LENSES["landscape"](), tmp_path / "a", format=name, focal=[70, 35, 24, 35], pixel_pitch=PITCH
        )


def test_tables_are_sorted_by_the_focal_length(tmp_path):
    lens, told = LENSES["landscape"](), {"focal": [70, 35, 24], "pixel_pitch": PITCH}
    assert zj.interop.write(lens, tmp_path / "a.xml", format="lensfun", **told).focal == (24, 35, 70)


@pytest.mark.parametrize(
    ("name", "path", "focal"), [("stmap", "st.exr", 24), ("opencv", "cameras.yaml", [24, 35])]
)
def test_a_folder_has_no_name_of_a_file(name, path, focal, tmp_path):
    with pytest.raises(ValueError, match="is to be their folder: give a name without"):
        zj.interop.write(
            LENSES["landscape"](), tmp_path / path, format=name, focal=focal, pixel_pitch=PITCH
        )
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "path", "end"),
    [
        ("opencv", "x.exr", ".yaml"),
        ("mrcal", "x.json", ".cameramodel"),
        ("gyroflow", "x.yaml", ".json"),
        ("ros", "x.XML", ".yaml"),
    ],
)
def test_a_file_has_no_name_of_another_format(name, path, end, tmp_path):
    """YAML under the name x.json was no lens for `read`, which goes by the name first."""
    lens = LENSES["landscape"]()
    with pytest.raises(ValueError, match=f"The format {name} is no .* file, .* a name that ends in {end}"):
        zj.interop.write(lens, tmp_path / path, format=name, focal=24, pixel_pitch=PITCH)
    assert not list(tmp_path.iterdir())


def test_a_format_is_whole_or_cannot_be_made():
    class Half(NodeFormat):
        def read(self, job):
            return None

    class Third(InterpolatedFormat):
        def text(self, nodes, job):
            return ""

    for half, missing in ((Half, "forms"), (Third, "foreign")):
        with pytest.raises(TypeError, match=missing):
            half()


def test_a_mark_before_the_text_is_no_part_of_it(tmp_path):
    """Which some programs write: the mark of the order of bytes, in UTF-8."""
    plain, marked = tmp_path / "plain", tmp_path / "marked"
    for folder in (plain, marked):
        folder.mkdir()
    for _name, path, told in sizes_of_files(plain):
        source = sorted(path.iterdir())[0] if path.is_dir() else path
        if source.suffix == ".exr":
            continue
        (marked / source.name).write_text(source.read_text(), encoding="utf-8-sig")
        assert (marked / source.name).read_bytes()[:3] == b"\xef\xbb\xbf"
        wanted, got = (zj.interop.read(file, **told) for file in (source, marked / source.name))
        assert got.report.format == wanted.report.format
        assert np.asarray(got.lens.focal_range).tolist() == np.asarray(wanted.lens.focal_range).tolist()


def test_cameras_of_two_sizes_are_told_apart(tmp_path):
    (tmp_path / "cameras.txt").write_text(CAMERA + CAMERA.replace("640 480", "320 240"))
    message = r"images of one size, and it has 2 of them \(320x240, 640x480\): put the entries of each size"
    with pytest.raises(ValueError, match=message):
        zj.interop.read(tmp_path / "cameras.txt")


@pytest.mark.parametrize("model", ["PINHOLE", "SIMPLE_PINHOLE"])
def test_a_pinhole_of_nerfstudio_has_no_distortion(model, tmp_path):
    table = {"camera_model": model, "fl_x": 500, "fl_y": 500, "cx": 320, "cy": 240, "w": 640, "h": 480}
    (tmp_path / "a.json").write_text(json.dumps(table | {"frames": []}))
    back = zj.interop.read(tmp_path / "a.json")
    assert np.asarray(back.lens(500.0).coefficients) == pytest.approx(0, abs=1e-12)
    (tmp_path / "b.json").write_text(json.dumps(table | {"frames": [], "camera_model": "OPENCV_FISHEYE"}))
    with pytest.raises(ValueError, match="its camera model 'OPENCV_FISHEYE' is not one of OPENCV"):
        zj.interop.read(tmp_path / "b.json")


def test_samples_of_opentrackio_may_be_an_array(tmp_path):
    zj.interop.write(LENSES["landscape"](), tmp_path / "a.jsonl", focal=[24, 50], pixel_pitch=PITCH)
    samples = [json.loads(line) for line in (tmp_path / "a.jsonl").read_text().splitlines()]
    (tmp_path / "a.json").write_text(json.dumps(samples, indent=1))
    (tmp_path / "empty.json").write_text("[]")
    assert zj.interop.read(tmp_path / "a.json").report.focal == (24, 50)
    with pytest.raises(ValueError, match="it is empty"):
        zj.interop.read(tmp_path / "empty.json", format="opentrackio")
