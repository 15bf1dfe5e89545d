"""Files whose fields contradict each other: refused, or said, and none taken without a word."""

import json
import re
from typing import Any

import numpy as np
import pytest

import zoomjax as zj
from benchmarks.mutations import LCP
from zoomjax.models import TableZoom

from ._lenses import LENSES, PITCH
from .test_base import CHAIN, DATABASE, FRAMES, PROFILE, SAMPLE, YAML

ENTRIES = PROFILE.replace(
    "@",
    '"interpolations": {"24": {"focal_length": 24.2, "input_horizontal_stretch": 1}, "50": '
    '{"camera_matrix": [[500, 0, 179.5], [0, 500, 119.5], [0, 0, 1]], "focal_length": 50, '
    '"distortion_model": "opencv_standard"}},',
)
TWO = FRAMES.replace("@", "").replace("[{}]", '[{"k1": -0.1, "camera_model": "OPENCV"}]')
ANGLE = TWO.replace('"camera_model": "OPENCV"', '"camera_model": "OPENCV", "camera_angle_x": 0.691')
INFO = (
    "image_width: 360\nimage_height: 240\ndistortion_model: plumb_bob\n"
    "camera_matrix: {rows: 3, cols: 3, data: [500,0,180,0,500,120,0,0,1]}\n"
    "distortion_coefficients: {rows: 1, cols: 5, data: [-0.1,0.01,0,0,0]}\n"
)
MODEL = (
    "{'lensmodel': 'LENSMODEL_OPENCV4', 'intrinsics': [500, 500, 180, 120, -0.1, 0, 0, 0], "
    "'extrinsics': [0, 0, 0, 0, 0, 0], 'imagersize': [360, 240]}"
)
XML = (
    "<?xml version='1.0'?><opencv_storage><image_width>360</image_width><image_height>240</image_height>"
    "<camera_matrix type_id='opencv-matrix'><rows>3</rows><cols>3</cols><dt>d</dt><data>500. 0. 180. 0. "
    "500. 120. 0. 0. 1.</data></camera_matrix><distortion_coefficients type_id='opencv-matrix'>"
    "<rows>1</rows><cols>5</cols><dt>d</dt><data>-0.1 0.01 0. 0. 0.</data></distortion_coefficients>"
    "</opencv_storage>"
)
JSON = (
    '{"image_width": 360, "image_height": 240, "camera_matrix": {"type_id": "opencv-matrix", "rows": 3, '
    '"cols": 3, "dt": "d", "data": [500, 0, 180, 0, 500, 120, 0, 0, 1]}, "distortion_coefficients": '
    '{"type_id": "opencv-matrix", "rows": 1, "cols": 5, "dt": "d", "data": [-0.1, 0.01, 0, 0, 0]}}'
)
PROJECT = '# hugin project file\np f0 w360 h240 v50\ni w360 h240 f0 r0 p0 v50 a0 b0.01 c0 d0 e0 n"a.jpg"\n'
CASES = {
    "gyroflow, focal": (
        "a.json",
        ENTRIES,
        '"focal_length": 24.2',
        '"focal_length": 35',
    ),
    "gyroflow, model": (
        "a.json",
        ENTRIES,
        '"opencv_standard"}}',
        '"opencv_fisheye"}}',
    ),
    "gyroflow, stretch": ("a.json", ENTRIES, 'stretch": 1', 'stretch": 1.33'),
    "nerfstudio, model": ("a.json", TWO, '"camera_model": "OPENCV"', '"camera_model": "OPENCV_FISHEYE"'),
    "nerfstudio, fisheye": ("a.json", TWO, '"camera_model": "OPENCV"', '"is_fisheye": true'),
    "nerfstudio, angle": ("a.json", ANGLE, '"camera_angle_x": 0.691', '"camera_angle_x": 0.9'),
    "opencv, matrix": ("a.yaml", YAML.replace("@", ""), "500.,0.,180.", "500.,0."),
    "ros, coefficients": ("a.yaml", INFO, "[-0.1,0.01,0,0,0]", "[-0.1,0.01,0,0]"),
    "ros, model": (
        "a.yaml",
        INFO,
        "cols: 5, data: [-0.1,0.01,0,0,0]",
        "cols: 6, data: [-0.1,0.01,0,0,0,1]",
    ),
    "hugin, no number": ("a.pto", PROJECT, "b0.01", "bnan"),
    "hugin, infinite": ("a.pto", PROJECT, "b0.01", "binf"),
    "nerfstudio, twice": ("a.json", TWO, '"fl_y": 500', '"fl_y": 500, "k1": -0.2'),
    "nerfstudio, size": ("a.json", TWO, '"w": 360', '"w": 360.7'),
    "gyroflow, twice": ("a.json", ENTRIES, '"asymmetrical": true', '"focal_length": 35'),
    "gyroflow, size": ("a.json", ENTRIES, '"w": 360', '"w": 360.7'),
    "opentrackio, twice": (
        "a.jsonl",
        SAMPLE,
        '"projectionOffset"',
        '"pinholeFocalLength": 24, "projectionOffset"',
    ),
    "opentrackio, size": ("a.jsonl", SAMPLE, '"width": 360', '"width": 360.7'),
    "opencv, twice": ("a.yaml", YAML.replace("@", ""), "   dt: d", "   rows: 3"),
    "opencv, twice in XML": (
        "a.xml",
        XML,
        "<image_width>",
        "<image_height>240</image_height><image_width>",
    ),
    "opencv, matrix in XML": ("a.xml", XML, "500. 0. 180.", "500. 0."),
    "opencv, twice in JSON": ("a.json", JSON, '"dt": "d", "data": [-0.1', '"rows": 1, "data": [-0.1'),
    "opencv, matrix in JSON": ("a.json", JSON, "500, 0, 180", "500, 0"),
    "opencv, size": ("a.yaml", YAML.replace("@", ""), "image_height: 240", "image_height: 0"),
    "ros, twice": ("a.yaml", INFO, "image_height: 240", "image_height: 240\ndistortion_model: plumb_bob"),
    "kalibr, twice": (
        "a.yaml",
        CHAIN.replace("@", ""),
        "resolution: [360, 240]",
        "resolution: [360, 240]\ncam0: {}",
    ),
    "kalibr, size": ("a.yaml", CHAIN.replace("@", ""), "[360, 240]", "[360, 240.5]"),
    "mrcal, twice": ("a.cameramodel", MODEL, "'extrinsics'", "'intrinsics'"),
    "mrcal, size": ("a.cameramodel", MODEL, "360, 240", "360.7, 240"),
    "hugin, twice": ("a.pto", PROJECT, "r0", "v30"),
    "lcp, size": ("a.lcp", LCP, '"1" stCamera:ImageWidth="600"', '"1" stCamera:ImageWidth="600.5"'),
}
TOLD = {
    **dict.fromkeys(["hugin, no number", "hugin, infinite"], "its distortion is no map"),
    "nerfstudio, twice": "it has 'k1' twice",
    "gyroflow, twice": "it has 'focal_length' twice",
    "opentrackio, twice": "it has 'pinholeFocalLength' twice",
    **dict.fromkeys(["opencv, twice", "opencv, twice in JSON"], "it has 'rows' twice"),
    "opencv, twice in XML": "it has 'image_height' twice",
    "ros, twice": "it has 'distortion_model' twice",
    "kalibr, twice": "it has 'cam0' twice",
    "mrcal, twice": "it has 'intrinsics' twice",
    "hugin, twice": "it has 'v' twice",
    **dict.fromkeys(
        ("nerfstudio, size", "gyroflow, size", "opentrackio, size", "mrcal, size"),
        r"360\.7 px wide or high",
    ),
    "opencv, size": "its images are 0 px wide or high",
    "kalibr, size": r"240\.5 px wide or high",
    "lcp, size": r"600\.5 px wide or high",
    "gyroflow, focal": "entry of 24 mm says that its focal length is 35",
    "gyroflow, model": "its distortion model 'opencv_fisheye'",
    "gyroflow, stretch": "its input_horizontal_stretch is 1.33",
    "nerfstudio, model": "its camera model 'OPENCV_FISHEYE'",
    "nerfstudio, fisheye": "its is_fisheye is True",
    "nerfstudio, angle": "its camera_angle_x is that of f = 372.6.. px, and its fl_x is 500",
    **dict.fromkeys(
        ["opencv, matrix", "opencv, matrix in XML", "opencv, matrix in JSON"],
        "a matrix of 3 x 3 has 8 numbers",
    ),
    "ros, coefficients": "a matrix of 1 x 5 has 4 numbers",
    "ros, model": "more coefficients than the five of its model, plumb_bob",
}


@pytest.mark.parametrize("case", CASES)
def test_what_contradicts_itself_is_refused(case, tmp_path):
    name, text, old, new = CASES[case]
    assert text.count(old) == 1
    (tmp_path / name).write_text(text)
    zj.interop.read(tmp_path / name)
    (tmp_path / name).write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=TOLD[case]):
        zj.interop.read(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "text", "old", "new", "note"),
    [
        (
            "a.json",
            TWO,
            '"frames": [{"k1": -0.1',
            '"frames": [{"k1": -0.2',
            "values of k1 than",
        ),
        ("a.json", PROFILE.replace("@", ""), '"w": 360, "h": 240', '"w": 720, "h": 480', "of another size"),
        ("a.yaml", YAML.replace("@", ""), "height: 240", "height: 640", "of images of another size"),
        ("a.yaml", INFO + "binning_x: 0\n", "binning_x: 0", "binning_x: 2", "cropped or binned"),
        ("a.yaml", INFO + "roi: {width: 0}\n", "roi: {width: 0}", "roi: {width: 180}", "cropped or binned"),
        (
            "a.jsonl",
            SAMPLE,
            '"distortion": [{',
            '"distortion": [{"radial": [2e-4, 0], "tangential": [0, 0]}, {',
            "several distortions of the model Brown-Conrady D-U, which differ",
        ),
        (
            "a.xml",
            DATABASE.replace("@", ""),
            "<calibration>",
            '<calibration><distortion model="poly5" focal="24" k1="-0.1" k2="0"/>',
            "not alike, as at 24 mm: the first is read",
        ),
    ],
)
def test_what_contradicts_itself_is_said(name, text, old, new, note, tmp_path):
    told: dict[str, Any] = {"image_size": (360, 240)} if name == "a.xml" else {}
    assert text.count(old) == 1
    (tmp_path / name).write_text(text)
    assert not any(note in each for each in zj.interop.read(tmp_path / name, **told).report.notes)
    (tmp_path / name).write_text(text.replace(old, new))
    assert any(note in each for each in zj.interop.read(tmp_path / name, **told).report.notes)


def unreal(path, change):
    zj.interop.write(LENSES["landscape"](), path, focal=[24, 35, 50], pixel_pitch=PITCH, overwrite=True)
    table = json.loads(path.read_text())
    change(table, {entry["parameterName"]: entry for entry in table["cameraParameterTables"]})
    path.write_text(json.dumps(table))
    return zj.interop.read(path)


def test_a_sensor_of_another_shape_than_the_image_is_said(tmp_path):
    def higher(table, _):
        table["sensorDimensions"]["height"] *= 1.2

    back = unreal(tmp_path / "a.ulens", higher)
    assert back.lens.pixel_pitch is None
    assert any("has another shape than images of" in note for note in back.report.notes)
    assert unreal(tmp_path / "a.ulens", lambda *_: None).lens.pixel_pitch == pytest.approx(PITCH)


@pytest.mark.parametrize("name", ["FocalLengthTable", "ImageCenterTable", "DistortionTable"])
def test_several_entries_of_one_zoom_are_refused(name, tmp_path):
    """As of a lens that breathes, and whose distortion does not change with the focus."""

    def again(_, tables):
        first, rest = tables[name]["data"].split(";", 1)
        words = first.split(",")
        tables[name]["data"] = ", ".join([words[0], words[1], "0.7", *words[3:]]) + ";" + first + ";" + rest

    with pytest.raises(ValueError, match=f"its {name} has several entries at the zoom 24"):
        unreal(tmp_path / "a.ulens", again)


def test_a_profile_without_focal_lengths_in_px_goes_by_the_crop_factor(tmp_path):
    """Coefficients are for radii in focal lengths, of 1.5 times as many px at a crop factor of 1.5."""
    bare = re.sub(r'\s*stCamera:FocalLength[XY]="[^"]*"', "", LCP)
    assert bare != LCP
    found = {}
    for factor in (1.0, 1.5):
        (tmp_path / "a.lcp").write_text(with_factor(bare, factor))
        found[factor] = zj.interop.read(tmp_path / "a.lcp", zoom=TableZoom()).lens
    pitch = {factor: lens.pixel_pitch for factor, lens in found.items()}
    assert pitch[1.0] == pytest.approx(1.5 * pitch[1.5])
    k = [np.asarray(lens(float(lens.focal_range[0])).coefficients)[0] for lens in found.values()]
    assert k[0] / k[1] == pytest.approx(1.5**2, rel=0.1)


def with_factor(text, factor):
    told = f'stCamera:SensorFormatFactor="{factor}" '
    return text.replace("stCamera:FocalLength=", f"{told}stCamera:FocalLength=")


def test_a_profile_of_cameras_with_other_sensors_is_refused(tmp_path):
    entry = LCP[LCP.index("<rdf:li") : LCP.index("</rdf:Seq>")]
    other = entry.replace('stCamera:FocalLength="18"', 'stCamera:FocalLength="72"')
    assert other != entry
    both = with_factor(entry, 1.0) + with_factor(other, 1.5)
    (tmp_path / "a.lcp").write_text(LCP.replace(entry, both))
    with pytest.raises(ValueError, match=r"cameras of other sensors, SensorFormatFactor 1, 1\.5"):
        zj.interop.read(tmp_path / "a.lcp")


@pytest.mark.parametrize("name", ["opencv", "nerfstudio", "nuke", "gyroflow"])
def test_focal_lengths_that_are_not_those_of_a_file_are_refused(name, tmp_path):
    """As those of another order: each entry got the focal length of another one, without a word."""
    lens = LENSES["landscape"]()
    focal = [24.0, 35.0, 50.0] if name != "opencv" else [24.0]
    zj.interop.write(lens, tmp_path / "a", format=name, focal=focal, pixel_pitch=PITCH)
    more: dict[str, Any] = {"format": name, "image_size": lens.image_size if name == "nuke" else None}
    for rounded in ([24.0, 35.0, 50.0], [24.4, 35.2, 49.0]):
        zj.interop.read(tmp_path / "a", focal=rounded[: len(focal)], **more)
    with pytest.raises(ValueError, match=r"its focal length is 24 mm, and argument focal has 50 mm there"):
        zj.interop.read(tmp_path / "a", focal=[50.0, 35.0, 24.0][: len(focal)], **more)


def test_focal_lengths_in_px_that_are_not_those_of_a_node_are_refused(tmp_path):
    lens = LENSES["landscape"]()
    zj.interop.write(lens, tmp_path / "a.nk", focal=[24.0, 50.0], pixel_pitch=PITCH)
    more: dict[str, Any] = {"focal_unit": "px", "image_size": lens.image_size}
    zj.interop.read(tmp_path / "a.nk", focal=[24 / PITCH, 50 / PITCH], **more)
    with pytest.raises(
        ValueError, match=r"its focal length is 653\.9\d+ px, and argument focal has 24 px there"
    ):
        zj.interop.read(tmp_path / "a.nk", focal=[24.0, 50.0], **more)


def test_a_sensor_that_is_not_that_of_the_focal_lengths_is_said(tmp_path):
    lens, focal = LENSES["landscape"](), np.array([24.0, 35.0, 50.0])
    zj.interop.write(lens, tmp_path / "a.ulens", focal=focal, pixel_pitch=PITCH)
    number = len(zj.interop.read(tmp_path / "a.ulens").report.focal)
    assert number == len(focal)
    for factor, said in ((1.01, 0), (1.5, 1)):
        notes = zj.interop.read(tmp_path / "a.ulens", focal=factor * focal).report.notes
        assert (
            sum("its sensor is 35.23 mm wide, and the file says 23.49 mm" in note for note in notes) == said
        )


@pytest.mark.parametrize("name", ["discorpy", "kalibr"])
def test_focal_lengths_in_another_order_than_files_that_are_named_by_them_are_refused(name, tmp_path):
    """Files are read in the order of their names, and not in that in which they were written."""
    lens, focal = LENSES["landscape"](), [50.0, 24.0, 35.0]
    zj.interop.write(lens, tmp_path / "a", format=name, focal=focal, pixel_pitch=PITCH)
    size = lens.image_size if name == "discorpy" else None
    zj.interop.read(tmp_path / "a", format=name, focal=sorted(focal), image_size=size)
    with pytest.raises(
        ValueError, match=r"order of the files, which their names say, 24, 35, 50, but it is"
    ):
        zj.interop.read(tmp_path / "a", format=name, focal=focal, image_size=size)
