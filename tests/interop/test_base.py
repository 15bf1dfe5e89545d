"""What a file may say beyond the numbers that are read: it changes nothing, is refused, or is said."""

import dataclasses
import json

import numpy as np
import pytest

import zoomjax as zj
from zoomjax.models import PolynomialZoom, TableZoom

from ._lenses import LENSES, PITCH

DEGREE_4 = (
    "LD_3DE4_Radial_Standard_Degree_4 {\n direction undistort\n tde4_filmback_width_cm 3.6\n"
    " tde4_filmback_height_cm 2.4\n Distortion_Degree_2 0.1\n @\n}\n"
)
OWN = "LensDistortion2 {\n distortionNumerator0 0.1\n distortionOrder {2 0}\n @\n}\n"
BARREL = "#PFBarrel 2011 v2\n360\n240\n1\n360\n240\nHigh Order\n@\n1\n1\n0.1\n0\n0.5\n0.5\n"
SAMPLE = (
    '{"protocol": {"name": "OpenTrackIO"}, "static": {"camera": {"activeSensorPhysicalDimensions": '
    '{"width": 36, "height": 24}, "activeSensorResolution": {"width": 360, "height": 240}, '
    '"anamorphicSqueeze": {"num": 1, "denom": 1}}}, "lens": {"pinholeFocalLength": 35, '
    '"distortion": [{"radial": [1e-4, 0], "tangential": [0, 0]}], "projectionOffset": {"x": 0, "y": 0}}}\n'
)
PROFILE = (
    '{"calib_dimension": {"w": 360, "h": 240}, "asymmetrical": true, "distortion_model": '
    '"opencv_standard", "focal_length": 24, @ "fisheye_params": {"camera_matrix": [[240, 0, 179.5], '
    '[0, 240, 119.5], [0, 0, 1]], "distortion_coeffs": [-0.1, 0.02, 0, 0]}}'
)
FRAMES = (
    '{@ "fl_x": 500, "fl_y": 500, "cx": 180, "cy": 120, "w": 360, "h": 240, "k1": -0.1, "frames": [{}]}'
)
YAML = (
    "%YAML:1.0\n---\nimage_width: 360\nimage_height: 240\n@\ncamera_matrix: !!opencv-matrix\n   rows: 3\n"
    "   cols: 3\n   dt: d\n   data: [500.,0.,180.,0.,500.,120.,0.,0.,1.]\n"
    "distortion_coefficients: [-0.1, 0.01, 0, 0]\n"
)
CHAIN = (
    "cam0:\n  camera_model: pinhole\n  intrinsics: [500, 500, 180, 120]\n  distortion_model: radtan\n"
    "  distortion_coeffs: [-0.1, 0, 0, 0]\n  resolution: [360, 240]\n@\n"
)
DATABASE = (
    '<lensdatabase version="1"><lens><maker>M</maker><model>Z</model>@<cropfactor>1</cropfactor>'
    '<calibration><distortion model="poly5" focal="24" k1="-0.05" k2="0.004"/></calibration></lens>'
    "</lensdatabase>"
)
FISHEYE_SET = '<calibration cropfactor="2"><distortion model="poly5" focal="24" k1="-0.2"/></calibration>'

# Name of the file, text, what stands for nothing, what means another distortion, and what is said of that.
CASES = [
    ("a.nk", DEGREE_4, "U_Degree_4 0", "U_Degree_4 0.05", "its U_Degree_4 is"),
    ("a.nk", DEGREE_4, "V_Degree_4 0", "V_Degree_4 {{curve x1 0 x2 0.05}}", "its V_Degree_4 is"),
    ("a.nk", DEGREE_4, "B_Cylindric_Bending 0", "B_Cylindric_Bending 0.1", "its B_Cylindric_Bending is"),
    ("a.nk", DEGREE_4, "tde4_pixel_aspect 1", "tde4_pixel_aspect 2", "its tde4_pixel_aspect is"),
    ("a.nk", DEGREE_4, "field_of_view_xb_unit 1", "field_of_view_xb_unit 0.9", "its field_of_view_xb"),
    ("a.nk", OWN, "anamorphicSqueeze 1", "anamorphicSqueeze 2", "its anamorphicSqueeze is"),
    ("a.nk", OWN, "anamorphicScale {1 1}", "anamorphicScale {1 1.3}", "its anamorphicScale is"),
    ("a.nk", OWN, "distortionNumeratorX00 0", "distortionNumeratorX00 0.1", "its distortionNumeratorX00"),
    (
        "a.nk",
        OWN,
        'projection "Rectilinear"',
        'projection "Fisheye/Fisheye Equisolid"',
        "its projection is",
    ),
    ("a.pfb", BARREL, "1", "2", "its squeeze is 2.0, and only 1 is read"),
    ("a.json", PROFILE, '"input_vertical_stretch": 1.0,', '"input_vertical_stretch": 1.33,', "its input_v"),
    ("a.json", PROFILE, '"digital_lens": null,', '"digital_lens": "gopro_superview",', "its digital_lens"),
    ("a.json", FRAMES, '"is_fisheye": false,', '"is_fisheye": true,', "its is_fisheye is"),
    ("a.yaml", YAML, "fisheye_model: 0", "fisheye_model: 1", "its fisheye_model is"),
    ("a.xml", DATABASE, "<type>rectilinear</type>", "<type>fisheye</type>", "its type is fisheye"),
    ("a.xml", DATABASE, "", FISHEYE_SET, "calibrations of several cameras"),
]


def read(path):
    told = {"image_size": (360, 240)} if path.suffix in (".nk", ".xml") else {}
    told |= {"focal": 24} if path.suffix in (".nk", ".pfb") else {}
    return zj.interop.read(path, **told)


def same(one, other):
    points = np.array([[0.0, 0.0], [300.0, 20.0], [180.0, 239.0]])
    moved = (np.asarray(each.lens(each.report.focal[0]).undistort(points)) for each in (one, other))
    return np.array_equal(*moved)


@pytest.mark.parametrize(("name", "text", "nothing", "other", "message"), CASES)
def test_what_means_another_distortion_is_refused(name, text, nothing, other, message, tmp_path):
    (tmp_path / name).write_text(text.replace("@", "" if text != BARREL else "1"))
    plain = read(tmp_path / name)
    (tmp_path / name).write_text(text.replace("@", nothing))
    assert same(read(tmp_path / name), plain)
    (tmp_path / name).write_text(text.replace("@", other))
    with pytest.raises(ValueError, match=message):
        read(tmp_path / name)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[1e-4, 0]", "[1e-4, 0, 0, 0, 0, 0, 1e-9]", "more than 6 coefficients"),
        ('"tangential": [0, 0]', '"tangential": [0, 0, 1e-6]', "more than 2 coefficients"),
        ('{"num": 1', '{"num": 2', "its anamorphicSqueeze is 2.0, and only 1 is read"),
        ('"height": 24}', '"height": 48}', "its pixels are not square, but 0.1 by 0.2 mm"),
    ],
)
def test_a_sample_of_opentrackio_with_another_distortion_is_refused(old, new, message, tmp_path):
    (tmp_path / "a.jsonl").write_text(SAMPLE)
    assert read(tmp_path / "a.jsonl").report.notes == ()
    assert old in SAMPLE
    (tmp_path / "a.jsonl").write_text(SAMPLE.replace(old, new))
    with pytest.raises(ValueError, match=message):
        read(tmp_path / "a.jsonl")


def test_units_of_unreal_are_looked_at(tmp_path):
    zj.interop.write(LENSES["landscape"](), path := tmp_path / "a.ulens", focal=24, pixel_pitch=PITCH)
    table = json.loads(path.read_text())
    table["metadata"]["cxCyUnits"] = "Pixels"
    path.write_text(json.dumps(table))
    with pytest.raises(ValueError, match="its cxCyUnits is Pixels, and only Normalized is read"):
        zj.interop.read(path)


def test_maps_of_pixels_that_are_not_square_are_refused(tmp_path):
    OpenEXR = pytest.importorskip("OpenEXR")
    lens = LENSES["landscape"]()
    report = zj.interop.write(lens, tmp_path / "maps", format="stmap", focal=24)
    with OpenEXR.File(str(report.files[0])) as file:
        header, pixels = dict(file.header()), file.channels()["RGB"].pixels
    header["pixelAspectRatio"] = 2.0
    with OpenEXR.File(header, {"RGB": pixels}) as file:
        file.write(str(tmp_path / "undistort.exr"))
    with pytest.raises(ValueError, match=r"its pixelAspectRatio is 2.0, and only 1 is read"):
        zj.interop.read(tmp_path / "undistort.exr")


@pytest.mark.parametrize(
    ("name", "text", "note"),
    [
        ("a.nk", DEGREE_4 + OWN, "The first of the file's 2 nodes is read, and no other."),
        ("a.yaml", CHAIN + CHAIN.replace("cam0", "cam1"), "cam0 is read, and cam1 is not."),
        ("a.jsonl", SAMPLE.replace('{"x": 0', '{"x": 1'), "Its projectionOffset is left out: the rays"),
    ],
)
def test_what_is_left_out_is_said(name, text, note, tmp_path):
    (tmp_path / name).write_text(text.replace("@", ""))
    assert any(told.startswith(note) for told in read(tmp_path / name).report.notes)


def test_entries_of_one_focal_length_that_are_not_alike_are_said(tmp_path):
    """As of a track that changes its focus alone. Those of one that stands still are alike."""
    still = SAMPLE * 2 + SAMPLE.replace(": 35,", ": 50,")
    (tmp_path / "a.jsonl").write_text(still)
    assert read(tmp_path / "a.jsonl").report.notes == ()
    (tmp_path / "b.jsonl").write_text(still + SAMPLE.replace("1e-4", "2e-4"))
    back = read(tmp_path / "b.jsonl")
    far = 0.1e-4 * 10 * np.hypot(179.5, 119.5) ** 3 * 0.1**2
    assert back.report.at_nodes == pytest.approx(far, rel=0.02)
    assert any("not alike, as at 35 mm" in note for note in back.report.notes)


def test_labels_that_contradict_focal_lengths_in_px_are_said(tmp_path):
    """24 mm written on a lens of 23.9 mm: half of a per cent, 9 px of a corner at 45 degrees in 4k."""
    lens, focal = LENSES["landscape"](), [24.0, 50.0]
    for labels, pitch, note in (
        (focal, PITCH, None),
        ([24.15, 50.0], PITCH * 1.003125, "differ by up to 0.62 %: that of the lens is"),
        ([25.0, 50.0], None, "differ by up to 4.1 %: their size is left open"),
    ):
        path = tmp_path / f"{labels[0]}.txt"
        zj.interop.write(lens, path, format="colmap", focal=focal, pixel_pitch=PITCH)
        back = zj.interop.read(path, focal=labels, zoom=TableZoom())
        assert back.lens.pixel_pitch == (None if pitch is None else pytest.approx(pitch, rel=1e-9))
        assert any(note in told for told in back.report.notes) if note else back.report.notes == ()


def test_maps_of_focal_lengths_in_two_units_are_no_lens(tmp_path):
    """As of two lenses whose maps went into one folder."""
    zj.interop.write(LENSES["landscape"](), tmp_path / "maps", format="stmap", focal=[24, 35])
    lens = dataclasses.replace(LENSES["px"](), image_size=(640, 480))
    zj.interop.write(lens, tmp_path / "maps", format="stmap", focal=[1300.0])
    with pytest.raises(ValueError, match="some of its focal lengths are in mm and some in px"):
        zj.interop.read(tmp_path / "maps")


def test_frames_before_the_first_sample_are_refused_where_there_are_none(tmp_path):
    track = zj.io.FocalTrack(np.array([-2.0, 3.0]), np.array([24.0, 50.0]), by_time=False)
    with pytest.raises(ValueError, match="samples from 0, and the track begins at frame -2"):
        zj.interop.write(
            LENSES["landscape"](),
            tmp_path / "a.jsonl",
            format="opentrackio",
            track=track,
            pixel_pitch=PITCH,
        )
    assert not (tmp_path / "a.jsonl").exists()


@pytest.mark.parametrize("name", ["lensfun", "opencv", "opentrackio", "stmap", "pftrack"])
def test_a_focal_length_that_nobody_knows_is_not_written(name, tmp_path, recwarn):
    """A number stands for it in the lens: 1 mm would be that of the tool's rays, or of its table."""
    zoom = PolynomialZoom(0, np.array([[0.05, -0.01]]), np.array(1.0))
    size = (640, 480)
    lens = zj.ZoomLens(zoom, np.array([320.0, 240.0]), np.ones(2), size, about={"focal": "not known"})
    for focal in (None, [24, 35]):
        with pytest.raises(ValueError, match="Argument focal must be given, the one focal length"):
            zj.interop.write(lens, tmp_path / "out", format=name, focal=focal, pixel_pitch=PITCH)
    report = zj.interop.write(lens, tmp_path / "out", format=name, focal=35, pixel_pitch=PITCH)
    assert report.focal == (35.0,)
    told = {"image_size": size} if name == "lensfun" else {"focal": 35} if name == "pftrack" else {}
    back = zj.interop.read(tmp_path / "out", format=name, **told)
    assert back.report.focal == (35.0,)
    points = np.array([[0.0, 0.0], [600.0, 300.0]])
    moved = np.asarray(back.lens(35.0).undistort(points)) - np.asarray(lens(1.0).undistort(points))
    assert np.abs(moved).max() < (5 if name == "lensfun" else 0.1)  # which scales as it likes
    assert not recwarn.list
