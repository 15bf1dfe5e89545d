"""Lenses from other tools' files: what zoomjax wrote, what others did, and what is damaged."""

import json
import re

import cv2
import numpy as np
import OpenEXR
import pytest

import zoomjax as zj
from benchmarks.mutations import LCP
from zoomjax.models import BrownConrady, Division, RadialPolynomial, TableZoom

from ._lenses import LENSES, PITCH
from ._readers import project
from .test_write import shown

BOTH = {fmt.name: fmt for fmt in zj.interop.formats() if fmt.writes}
FOCAL = [18, 24, 35, 50, 85, 200]
SILENT = ("nuke", "pftrack", "discorpy")
"""Formats that hold no focal lengths."""


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A path of every format, and the report."""
    lens, folder, found = LENSES["landscape"](), tmp_path_factory.mktemp("written"), {}
    for name, fmt in BOTH.items():
        path = folder / (name if fmt.zoom == "one" else f"{name}{fmt.suffixes[0]}")
        focal = None if fmt.zoom == "interpolated" else FOCAL
        found[name] = path, zj.interop.write(lens, path, format=name, focal=focal, pixel_pitch=PITCH)
    return lens, found


def given(name, lens):
    """What a file does not say."""
    size = {"image_size": lens.image_size} if name in ("lensfun", "nuke", "discorpy") else {}
    return size | ({"focal": FOCAL} if name in SILENT else {})


@pytest.mark.slow
@pytest.mark.parametrize("name", BOTH)
def test_a_lens_comes_back(name, written):
    lens, found = written
    path, report = found[name]
    back = zj.interop.read(path, **given(name, lens))
    assert back.lens.image_size == lens.image_size
    factor = 1 if back.lens.focal_unit == "mm" else 1 / PITCH
    close = 1e-3 if name == "hugin" else 1e-6  # its focal lengths are those of the rays of a fit
    assert np.asarray(back.lens.focal_range) == pytest.approx(np.array([18, 200]) * factor, rel=close)
    assert np.asarray(back.lens.centre) == pytest.approx(np.asarray(lens.centre), abs=1e-3)
    assert len(back.report.focal) == len(report.focal)
    points = shown(lens)
    for focal in (18.0, 21.0, 50.0, 200.0):
        own = np.clip(focal * factor, *np.asarray(back.lens.focal_range))  # the ends are fitted, too
        wanted, got = (np.asarray(d.undistort(points)) for d in (lens(focal), back.lens(own)))
        # The report of the writer is of distorted points, which are up to 1.2 times as dense.
        assert np.hypot(*(got - wanted).T).max() <= 1.3 * (report.worst + back.report.worst) + 0.02
    assert back.report.worst < 0.2


def test_files_of_a_folder_are_in_the_order_of_the_numbers_in_their_names(tmp_path):
    """Else focal lengths given for them would go to others: 105 is before 18 for a dictionary."""
    lens, focal = LENSES["landscape"](), [18, 24.5, 105, 200]
    zj.interop.write(lens, tmp_path / "k", format="discorpy", focal=focal)
    back = zj.interop.read(tmp_path / "k", focal=focal, image_size=lens.image_size, zoom=TableZoom())
    assert [path.name for path in back.report.files] == ["18.txt", "24.5.txt", "105.txt", "200.txt"]
    points = shown(lens)
    for f in focal:
        moved = np.asarray(back.lens(float(f)).undistort(points)) - np.asarray(
            lens(float(f)).undistort(points)
        )
        assert np.abs(moved).max() < 0.1


@pytest.mark.parametrize("name", ["opencv", "ros"])
def test_frames_before_the_first_are_before_it(name, tmp_path):
    """A track may begin before frame 0, and a name's dash is no sign where a word is before it."""
    lens, focal = LENSES["landscape"](), np.array([24.0, 35.0, 50.0, 70.0])
    track = zj.io.FocalTrack(np.arange(-2.0, 2.0), focal, by_time=False)
    zj.interop.write(lens, tmp_path / "a", format=name, track=track, pixel_pitch=0.01)
    back = zj.interop.read(tmp_path / "a", focal=focal)
    names = [path.stem for path in back.report.files]
    assert names == ["-00002", "-00001", "000000", "000001"]
    points = shown(lens)
    for f in focal:
        moved = np.asarray(back.lens(f).undistort(points)) - np.asarray(lens(f).undistort(points))
        assert np.abs(moved).max() < 0.5
    for number, path in enumerate(back.report.files):
        path.rename(path.with_name(f"lens-{9 + number}.yaml"))
    assert [path.stem for path in zj.interop.read(tmp_path / "a", focal=focal).report.files] == [
        *("lens-9", "lens-10", "lens-11", "lens-12")
    ]


@pytest.mark.parametrize("suffix", [".yaml", ".xml", ".json"])
def test_opencvs_files_are_read_in_all_three_languages(suffix, tmp_path):
    """XML is that of its own sample of calibration, and capitals of the sample's first versions."""
    size, matrix = (640, 480), np.array([[657.0, 0, 319.5], [0, 657, 239.5], [0, 0, 1]])
    k = np.array([[-0.4], [0.5], [0], [0], [-0.57]])
    for number, names in enumerate(
        (
            ("image_width", "image_height", "camera_matrix", "distortion_coefficients"),
            ("image_Width", "image_Height", "Camera_Matrix", "Distortion_Coefficients"),
        )
    ):
        path = tmp_path / f"{number}{suffix}"
        file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        file.write("calibration_Time", "Sun 29 Nov")
        for name, value in zip(names, [*size, matrix, k], strict=True):
            file.write(name, value)
        file.release()
        back = zj.interop.read(path, zoom=TableZoom())
        assert (back.report.format, back.lens.image_size, back.lens.focal_unit) == ("opencv", size, "px")
        points = shown(back.lens)
        corrected = np.asarray(back.lens(657.0).undistort(points))
        assert project(matrix, k, corrected) == pytest.approx(points, abs=back.report.worst + 1e-6)


@pytest.mark.parametrize("name", ["nuke", "opentrackio", "pftrack"])
def test_our_own_formula_comes_back_exactly(name, written):
    lens, found = written
    back = zj.interop.read(found[name][0], zoom=TableZoom(), **given(name, lens)).lens
    assert back(35.0).coefficients == pytest.approx(np.asarray(lens(35.0).coefficients), abs=1e-9)


NUKE = """LD_3DE4_Radial_Standard_Degree_4 {
 tde4_filmback_width_cm 3.6
 tde4_filmback_height_cm 2.4
 Distortion_Degree_2 %s
 Quartic_Distortion_Degree_4 %s
}
"""


@pytest.mark.parametrize(
    "curve",
    [
        "{{curve x1 0.01 x2 0.02 x3 0.04}}",
        "{{curve i x1 0.01 0.02 0.04}}",
        "{{curve l x1 0.01 x2 0.02 s0 0.04}}",
    ],
)
def test_curves_of_nuke_are_read_with_keys_left_out(curve, tmp_path):
    (tmp_path / "a.nk").write_text(NUKE % (curve, "0.001"))
    told = {"image_size": (360, 240), "focal": (24, 35, 50), "zoom": TableZoom()}
    lens = zj.interop.read(tmp_path / "a.nk", **told).lens
    first = [float(lens(f).coefficients[0]) for f in (24.0, 35.0, 50.0)]
    assert first == pytest.approx([first[0] * n for n in (1, 2, 4)])
    assert first[0] != 0


def test_focal_lengths_of_nuke_are_those_of_the_node(tmp_path):
    """In cm, as a curve; a constant is that of all frames only where there is one."""
    text = NUKE % ("{{curve x1 0.01 x2 0.02}}", "0.001")
    (tmp_path / "a.nk").write_text(
        text.replace(" {\n", " {\n tde4_focal_length_cm {{curve x1 2.4 x2 3.5}}\n")
    )
    back = zj.interop.read(tmp_path / "a.nk", image_size=(360, 240), zoom=TableZoom())
    assert back.report.focal == (24, 35)
    assert [float(back.lens(f).coefficients[0]) for f in (24.0, 35.0)] == pytest.approx([0.01, 0.02])
    (tmp_path / "b.nk").write_text(text.replace(" {\n", " {\n tde4_focal_length_cm 2.4\n"))
    with pytest.raises(ValueError, match="give argument focal, 2 of them"):
        zj.interop.read(tmp_path / "b.nk", image_size=(360, 240))
    notes = zj.interop.read(tmp_path / "b.nk", image_size=(360, 240), focal=[24.0, 35.0]).report.notes
    assert any("not those of its keys: those of argument focal count" in note for note in notes)


def test_nukes_own_node_is_read(tmp_path):
    """As AliceVision writes it: fewer numerators, knobs of other kinds, and a centre with curves."""
    (tmp_path / "a.nk").write_text(
        "LensDistortion2 {\n\n distortionModelPreset Custom\n"
        " distortionNumerator0 {{curve x1 0.05 x2 0.04 }}\n\n distortionNumerator1 -0.01\n"
        " centre {{curve x1 0.02 x2 0.03 } {curve x1 -0.01 x2 0.01 }}\n output Undistort\n"
        " distortionScalingType Format\n distortionOrder {2 0}\n normalisationType Diagonal\n}\n"
        "Blur {\n distortionNumerator0 9\n}\n"
    )
    told = {"image_size": (301, 401), "focal": (24, 35), "zoom": TableZoom()}
    back = zj.interop.read(tmp_path / "a.nk", **told)
    for focal, k1 in ((24.0, 0.05), (35.0, 0.04)):
        assert back.lens(focal).coefficients == pytest.approx([k1, -0.01], abs=1e-9)
    half = np.hypot(301, 401) / 2  # (0.02, -0.01) and (0.03, 0.01), y up
    for focal, (x, y) in ((24.0, (0.02, -0.01)), (35.0, (0.03, 0.01))):
        centre = np.asarray(back.lens.centre_at(focal))
        assert centre == pytest.approx([150 + x * half, 200 - y * half], abs=1e-9)
    assert any("centre moves along the zoom" in note for note in back.report.notes)


@pytest.mark.parametrize(
    ("knob", "message"),
    [
        ("normalisationType Width", "its normalisationType is Width, and only Diagonal is read"),
        ("projection Fisheye", "its projection is Fisheye, and only Rectilinear is read"),
        ("distortionOrder {40 0}", "up to 12 coefficients"),
    ],
)
def test_a_node_of_nuke_in_another_geometry_is_refused(knob, message, tmp_path):
    (tmp_path / "a.nk").write_text(f"LensDistortion2 {{\n distortionNumerator0 0.1\n {knob}\n}}\n")
    with pytest.raises(ValueError, match=message):
        zj.interop.read(tmp_path / "a.nk", image_size=(360, 240), focal=24)


@pytest.mark.parametrize("kind", ["division", "wide, three terms", "decentred", "px", "moving centre"])
def test_a_node_that_was_written_for_nuke_is_read_again(kind, tmp_path):
    lens = LENSES[kind]()
    focal = np.geomspace(*np.asarray(lens.focal_range), 3)
    zj.interop.write(lens, tmp_path / "a.nk", format="nuke", focal=focal, pixel_pitch=PITCH)
    own = "LensDistortion2" in (tmp_path / "a.nk").read_text()
    told = {"image_size": lens.image_size, "zoom": TableZoom()} | ({"focal": focal} if own else {})
    back = zj.interop.read(tmp_path / "a.nk", **told)
    assert type(back.lens.distortion_model) is type(lens.distortion_model)
    factor = PITCH if lens.focal_unit == "px" and not own else 1.0
    assert back.report.focal == pytest.approx(focal * factor)
    for f in focal:
        moved = back.lens(f * factor).undistort(shown(lens)) - lens(f).undistort(shown(lens))
        assert np.abs(moved).max() <= back.report.worst + 1e-9
    assert back.report.worst < 1e-8


@pytest.mark.parametrize(
    ("first", "second", "message"),
    [
        ("{{curve x1 0.01 x2 0.02}}", "{{curve x1 0 x5 0}}", "keys at different frames"),
        ("{{curve}}", "0", "has no keys"),
    ],
)
def test_curves_that_do_not_say_it_all_are_refused(first, second, message, tmp_path):
    (tmp_path / "a.nk").write_text(NUKE % (first, second))
    with pytest.raises(ValueError, match=message):
        zj.interop.read(tmp_path / "a.nk", image_size=(360, 240), focal=(24, 35))


@pytest.mark.parametrize(
    ("name", "kind", "distortion_model"),
    [
        ("opentrackio", "decentred", BrownConrady),
        ("opentrackio", "division", Division),
        ("colmap", "division", Division),
        ("opencv", "decentred", BrownConrady),
    ],
)
def test_other_distortion_models_come_back(name, kind, distortion_model, tmp_path):
    lens = LENSES[kind]()
    path = tmp_path / ("cv" if name == "opencv" else f"a{BOTH[name].suffixes[0]}")
    zj.interop.write(lens, path, format=name, focal=FOCAL, pixel_pitch=PITCH)
    back = zj.interop.read(path)
    assert isinstance(back.lens.distortion_model, distortion_model)
    factor = 1 if back.lens.focal_unit == "mm" else 1 / PITCH
    points = shown(lens)
    difference = lens(35.0).undistort(points) - back.lens(35.0 * factor).undistort(points)
    assert np.abs(difference).max() < (0.05 if name == "opencv" else 1e-9)


@pytest.mark.parametrize("convention", ["centres", "gyroflow", "alicevision"])
@pytest.mark.parametrize("direction", ["undistort", "redistort"])
def test_maps_are_read_in_both_directions_and_three_conventions(convention, direction, tmp_path):
    lens = LENSES["portrait"]()
    zj.interop.write(lens, tmp_path / "m", format="stmap", focal=24, convention=convention)
    path = tmp_path / "m" / f"{direction}.24.exr"
    back = zj.interop.read(path, convention=convention)
    assert back.report.worst < 0.02
    assert np.asarray(back.lens.centre) == pytest.approx(np.asarray(lens.centre), abs=0.01)
    two, more = np.split(np.asarray(back.lens(24.0).coefficients), [2])
    assert two == pytest.approx(np.asarray(lens(24.0).coefficients), abs=1e-4)
    assert more == pytest.approx(0, abs=1e-4)
    told = zj.interop.read(path)
    assert np.asarray(told.lens.centre) == pytest.approx(np.asarray(back.lens.centre))
    forget(path)
    if convention == "gyroflow":
        moved = np.asarray(zj.interop.read(path).lens.centre - back.lens.centre)
        assert np.abs(moved).max() > 0.1  # which shows that the convention matters


def forget(path):
    """Make a map of our own one of another program's, which tells its focal length alone."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        kept = {key: value for key, value in file.header().items() if key not in TOLD}
        pixels = {name: channel.pixels.copy() for name, channel in file.channels().items()}
    with OpenEXR.File(kept, pixels) as file:
        file.write(str(path))


TOLD = ("zoomjaxDirection", "zoomjaxConvention", "channels")


@pytest.mark.parametrize("direction", ["undistort", "redistort"])
def test_black_in_a_map_shows_nothing(direction, tmp_path):
    """Else it would be the image's lower left corner, which lies within it."""
    lens = LENSES["portrait"]()
    zj.interop.write(lens, tmp_path / "m", format="stmap", focal=24)
    path = tmp_path / "m" / f"{direction}.24.exr"
    whole = zj.interop.read(path)
    with OpenEXR.File(str(path)) as file:
        header, pixels = dict(file.header()), file.channels()["RGB"].pixels.copy()
    pixels[:, : pixels.shape[1] // 4] = 0
    with OpenEXR.File(header, {"RGB": pixels}) as file:
        file.write(str(path))
    black = zj.interop.read(path)
    assert black.report.worst < whole.report.worst + 1e-3
    assert np.asarray(black.lens(24.0).coefficients) == pytest.approx(
        np.asarray(whole.lens(24.0).coefficients), abs=1e-4
    )


@pytest.mark.parametrize("what", ["encoded", "constant"])
def test_a_picture_that_is_no_map_is_refused(what, tmp_path):
    """With an error of half of the image it was a lens: of a map saved in sRGB, or a grey picture."""
    lens = LENSES["portrait"]()
    zj.interop.write(lens, tmp_path / "m", format="stmap", focal=24)
    path = tmp_path / "m" / "undistort.24.exr"
    with OpenEXR.File(str(path)) as file:
        header, pixels = dict(file.header()), file.channels()["RGB"].pixels.copy()
    pixels = np.clip(pixels, 0, 1) ** np.float32(1 / 2.2) if what == "encoded" else 0 * pixels + 0.5
    with OpenEXR.File(header, {"RGB": pixels.astype(np.float32)}) as file:
        file.write(str(path))
    with pytest.raises(ValueError, match=r"px off: red and green must be positions from 0 to 1|folds over"):
        zj.interop.read(path)


@pytest.mark.parametrize("foreign", [False, True])
def test_an_argument_that_contradicts_a_map_is_refused(foreign, tmp_path):
    lens = LENSES["portrait"]()
    zj.interop.write(lens, tmp_path / "m", format="stmap", focal=24)
    path = tmp_path / "m" / "redistort.24.exr"
    if foreign:
        forget(path)
    with pytest.raises(ValueError, match="its direction is redistort: leave out argument direction"):
        zj.interop.read(path, direction="undistort")
    with pytest.raises(ValueError, match="its focal is 24: leave out argument focal, which is 55"):
        zj.interop.read(path, focal=55)
    assert zj.interop.read(path, focal=24, direction="redistort").report.focal == (24,)
    if not foreign:
        with pytest.raises(ValueError, match="its convention is centres: leave out argument convention"):
            zj.interop.read(path, convention="gyroflow")
        path = path.rename(tmp_path / "undistort.exr")
        assert zj.interop.read(path).lens(24.0).coefficients[0] == pytest.approx(
            float(lens(24.0).coefficients[0]), abs=1e-4
        )


def test_maps_of_two_directions_are_of_the_same_focal_lengths(tmp_path):
    zj.interop.write(LENSES["portrait"](), tmp_path / "m", format="stmap", focal=[24, 35])
    (tmp_path / "m/redistort.24.exr").unlink()
    (tmp_path / "m/undistort.35.exr").unlink()
    with pytest.raises(ValueError, match="not of the same focal lengths: give argument direction"):
        zj.interop.read(tmp_path / "m")
    assert zj.interop.read(tmp_path / "m", direction="undistort").report.focal == (24,)


@pytest.mark.parametrize("focal", [[24], [18, 50, 200]])
@pytest.mark.parametrize("direction", ["undistort", "redistort"])
def test_maps_of_a_decentred_lens_come_back_decentred(direction, focal, tmp_path):
    """Else they would come back as radial about another centre, a pixel off."""
    lens = LENSES["decentred"]()
    zj.interop.write(lens, tmp_path / "m", format="stmap", focal=focal)
    back = zj.interop.read(tmp_path / "m", direction=direction, focal=None)
    assert isinstance(back.lens.distortion_model, BrownConrady)
    assert np.asarray(back.lens.centre) == pytest.approx(np.asarray(lens.centre), abs=0.05)
    assert back.report.worst < 1e-3
    for f in focal:
        moved = back.lens(float(f)).undistort(shown(lens)) - lens(float(f)).undistort(shown(lens))
        assert np.abs(moved).max() < 1e-3
    radial = zj.interop.read(
        tmp_path / "m", direction=direction, distortion_model=RadialPolynomial(), zoom=TableZoom()
    )
    assert isinstance(radial.lens.distortion_model, RadialPolynomial)
    assert radial.report.worst > 0.05


HUGIN = """# hugin project file
p f0 w3000 h1500 v360  n"TIFF_m c:LZW"
i w600 h400 f0 v60 Ra0 Eev11.9 Eb1 r0 p0 y0 TrX0 a0.01 b-0.03 c0.005 d-5.5 e3.25 g0 t0 Vm5 n"a 1.jpg"
i w600 h400 f0 v40 Ra=0 y12.5 a=0 b-0.01 c=0 d=0 e=0 g=0 t=0 S0,600,0,400 n"b.jpg"
v Ra0
"""


def test_a_project_of_hugin_may_link_one_image_to_another(tmp_path):
    (tmp_path / "a.pto").write_text(HUGIN)
    back = zj.interop.read(tmp_path / "a.pto", zoom=TableZoom())
    assert np.asarray(back.lens.centre) == pytest.approx([299.5 - 5.5, 199.5 + 3.25])
    views, terms = (60, 40), ((0.01, -0.03, 0.005), (0.01, -0.01, 0.005))
    for focal, view, (a, b, c) in zip(back.report.focal, views, terms, strict=True):
        tools = 300 / np.tan(np.radians(view / 2))
        assert focal == pytest.approx(tools * (1 - a - b - c), rel=1e-3)
        corrected = np.asarray(back.lens(focal).undistort(shown(back.lens))) - np.asarray(back.lens.centre)
        of_rays = corrected * tools / focal
        r = np.hypot(*of_rays.T)[:, None] / 200
        distorted = of_rays * (a * r**3 + b * r**2 + c * r + 1 - a - b - c)
        found = distorted + np.asarray(back.lens.centre) - shown(back.lens)
        assert np.abs(found).max() < back.report.worst + 0.05


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("f0 v40", "f3 v40", "its projection is number 3, and only 0, rectilinear, is read"),
        ("g=0", "g1.5", "it has shear"),
        ("v40", "v180", "its field of view must be between 0 and 180 degrees, but it is 180"),
        (' n"b.jpg"', "", "an image line has no name, n, as where the file was cut off"),
        ('n"b.jpg"\n', 'n"b.j', "an image line has no name, n, as where the file was cut off"),
        ("w600 h400 f0 v40", "w400 h600 f0 v40", "images of one size, and it has 2"),
        ("b-0.01", "b1.5", "the factor at the centre is not positive"),
    ],
)
def test_a_project_of_hugin_that_is_no_lens_is_refused(old, new, message, tmp_path):
    assert old in HUGIN
    (tmp_path / "a.pto").write_text(HUGIN.replace(old, new))
    with pytest.raises(ValueError, match=message):
        zj.interop.read(tmp_path / "a.pto")


@pytest.mark.parametrize("name", ["colmap", "pftrack", "discorpy"])
def test_a_last_number_that_may_be_cut_off_is_told(name, tmp_path):
    lens = LENSES["landscape"]()
    given = {"image_size": lens.image_size} if name == "discorpy" else {}
    pitch = {"pixel_pitch": PITCH} if name == "colmap" else {}
    given |= {"focal": 24.0} if name != "colmap" else {}
    [path] = zj.interop.write(lens, tmp_path / "a", format=name, focal=24.0, **pitch).files
    assert "has no end" not in str(zj.interop.read(path, format=name, **given).report)
    path.write_text(path.read_text()[:-1])
    report = zj.interop.read(path, format=name, **given).report
    assert f"The last line of {path} has no end" in str(report)
    if name == "colmap":
        path.write_text(path.read_text().rsplit(" ", 2)[0])
        with pytest.raises(
            ValueError, match="FULL_OPENCV has 12 parameters, but a line has 10: it may be cut"
        ):
            zj.interop.read(path, format=name)


@pytest.mark.parametrize(("distortion_model", "most"), [(Division(), 0.2), (BrownConrady(), 0.1)])
def test_a_distortion_model_that_is_asked_for_is_taken(distortion_model, most, written):
    _, found = written
    back = zj.interop.read(found["opentrackio"][0], distortion_model=distortion_model, zoom=TableZoom())
    assert type(back.lens.distortion_model) is type(distortion_model)
    assert back.report.worst < most


LENSFUN = """<lensdatabase version="1">
 <lens><maker>Some</maker><model>One 24-70mm</model><mount>X</mount><cropfactor>1.5</cropfactor>
  <calibration>
   <distortion model="ptlens" focal="24" a="0.01" b="-0.03" c="0.005"/>
   <distortion model="ptlens" focal="35" a="0.004" b="-0.012" c="0.004"/>
   <distortion model="ptlens" focal="70" a="0" b="0.006" c="0"/>
  </calibration></lens>
 <lens><maker>Some</maker><model>Two 10-20mm</model><mount>X</mount><cropfactor>1.6</cropfactor>
  <aspect-ratio>4:3</aspect-ratio><center x="0.01" y="-0.02"/>
  <calibration>
   <distortion model="poly3" focal="10" k1="-0.03"/>
   <distortion model="poly3" focal="20" k1="-0.01"/>
  </calibration></lens>
</lensdatabase>"""


def test_a_larger_sensor_than_that_of_a_lensfun_file_is_refused(tmp_path):
    """As of the library: beyond the corners of the calibration its polynomials are extrapolated."""
    (tmp_path / "a.xml").write_text(LENSFUN)
    told = r"on a sensor of crop factor 1\.6, and images of crop factor 0\.8 show more than that"
    with pytest.raises(ValueError, match=told):
        zj.interop.read(tmp_path / "a.xml", image_size=(600, 400), name="two", crop=0.8)
    found = zj.interop.read(tmp_path / "a.xml", image_size=(600, 400), name="two", crop=1.59)
    assert found.lens.about["crop_factor"] == 1.59


def test_a_crop_factor_of_no_camera_is_refused(tmp_path):
    """The lens had next to no distortion, that of the very middle, without a word of it."""
    (tmp_path / "a.xml").write_text(LENSFUN)
    told = "Cannot read a lensfun lens .*: No images of 6000 x 4000 px have a crop factor of 1000: it means"
    with pytest.raises(ValueError, match=told):
        zj.interop.read(tmp_path / "a.xml", image_size=(6000, 4000), name="two", crop=1000)


@pytest.mark.parametrize(
    ("name", "focal", "crop"), [("One", 24.0, None), ("two", 10.0, None), ("One", 35.0, 2.0)]
)
def test_lensfun_and_the_lens_agree_up_to_scale(name, focal, crop, tmp_path):
    import lensfunpy

    (tmp_path / "a.xml").write_text(LENSFUN)
    size = (600, 400)
    back = zj.interop.read(tmp_path / "a.xml", image_size=size, name=name, crop=crop, zoom=TableZoom())
    database = lensfunpy.Database(xml=LENSFUN, load_common=False, load_bundled=False)
    [lens] = [lens for lens in database.lenses if name.lower() in lens.model.lower()]
    modifier = lensfunpy.Modifier(lens, crop or lens.crop_factor, *size)
    modifier.initialize(focal, 4, 10, scale=1.0, flags=lensfunpy.ModifyFlags.DISTORTION)
    corrected = shown(back.lens)
    distorted = np.array(
        [np.reshape(modifier.apply_geometry_distortion(float(x), float(y), 1, 1), 2) for x, y in corrected]
    )
    inside = ((distorted >= 0) & (distorted <= np.array(size) - 1)).all(-1)
    corrected, distorted = corrected[inside], distorted[inside]
    centre = np.asarray(back.lens.centre)
    ours = np.asarray(back.lens(focal).undistort(distorted)) - centre
    theirs = corrected - centre
    scale = np.sum(ours * theirs) / np.sum(theirs * theirs)
    assert np.hypot(*(ours - scale * theirs).T).max() <= back.report.worst + 0.02
    assert back.report.worst < 0.5


def test_an_adobe_profile_is_opencvs_formula_at_the_farthest_focus(tmp_path):
    (tmp_path / "a.lcp").write_text(LCP)
    back = zj.interop.read(tmp_path / "a.lcp")
    assert back.lens.image_size == (600, 400)
    matrix = np.array([[480, 0, 0.51 * 600 - 0.5], [0, 480, 0.49 * 400 - 0.5], [0, 0, 1]])
    corrected = np.stack(np.meshgrid(np.linspace(0, 599, 7), np.linspace(0, 399, 6)), -1).reshape(-1, 2)
    rays = np.column_stack([(corrected - matrix[:2, 2]) / 480, np.ones(len(corrected))])[:, None]
    seen = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, np.array([-0.1, 0.02, 0, 0]))[0][:, 0]
    found = np.asarray(back.lens(18.0).undistort(seen))
    assert np.hypot(*(found - corrected).T).max() <= back.report.worst + 0.01
    assert back.report.worst < 0.3


FX, FY, K = 500.0, 504.5, (-0.25, 0.06, 1e-3, -5e-4)
"""A camera with pixels that are 0.9 % from square, and k1, k2, p1, p2."""

NOT_QUITE_SQUARE = {
    "colmap.txt": f"1 OPENCV 640 480 {FX} {FY} 330.5 235.5 {' '.join(map(str, K))}\n",
    "kalibr.yaml": f"cam0:\n  camera_model: pinhole\n  intrinsics: [{FX}, {FY}, 330, 235]\n"
    f"  distortion_model: radtan\n  distortion_coeffs: {list(K)}\n  resolution: [640, 480]\n",
    "nerfstudio.json": json.dumps(
        {"fl_x": FX, "fl_y": FY, "cx": 330.5, "cy": 235.5, "w": 640, "h": 480, "frames": []}
        | dict(zip(("k1", "k2", "p1", "p2"), K, strict=True))
    ),
}


@pytest.mark.parametrize("name", [*NOT_QUITE_SQUARE, "division.txt"])
def test_the_error_of_pixels_that_are_not_square_is_reported(name, tmp_path):
    """Ours are square: what the lens cannot do as the tool with its own fx and fy is in the report."""
    division = f"1 DIVISION 640 480 {FX} {FY} 330.5 235.5 -0.3\n"
    (tmp_path / name).write_text(NOT_QUITE_SQUARE.get(name, division))
    back = zj.interop.read(tmp_path / name)
    f, c = np.array([FX, FY]), np.array([330.0, 235.0])
    if name == "division.txt":
        distorted = shown(back.lens)
        rays = (distorted - c) / f
        corrected = rays / (1 - 0.3 * np.sum(rays**2, -1, keepdims=True)) * f + c
    else:
        corrected = np.stack(np.meshgrid(np.linspace(-60, 700, 25), np.linspace(-60, 540, 25)), -1)
        corrected = corrected.reshape(-1, 2)
        distorted = project([[FX, 0, c[0]], [0, FY, c[1]], [0, 0, 1]], K, corrected)
        inside = ((distorted >= 0) & (distorted <= [639, 479])).all(-1)
        corrected, distorted = corrected[inside], distorted[inside]
    lens = back.lens(float(f.mean()))
    if name == "division.txt":
        worst = np.hypot(*(np.asarray(lens.undistort(distorted)) - corrected).T).max()
    else:  # its own image is the distorted one
        worst = np.hypot(*(np.asarray(lens.distort(corrected)) - distorted).T).max()
    assert 0.1 < worst <= back.report.worst + 0.01
    assert any("0.89 % from square" in note for note in back.report.notes)


def test_pixels_that_are_not_square_and_a_skew_are_refused(tmp_path):
    (tmp_path / "a.txt").write_text("1 PINHOLE 640 480 500 510 320 240\n")
    with pytest.raises(ValueError, match="its pixels are not square: fx is 500 and fy is 510"):
        zj.interop.read(tmp_path / "a.txt")
    matrix = "camera_matrix: {data: [500, 3, 320, 0, 500, 240, 0, 0, 1]}\n"
    rest = "image_width: 640\nimage_height: 480\ndistortion_model: plumb_bob\n"
    (tmp_path / "a.yaml").write_text(rest + matrix + "distortion_coefficients: {data: [0, 0, 0, 0]}\n")
    with pytest.raises(ValueError, match="its camera matrix is skewed, by 3"):
        zj.interop.read(tmp_path / "a.yaml")


def test_plumb_bob_and_one_entry_without_a_zoom(tmp_path):
    (tmp_path / "c.yaml").write_text(
        "image_width: 600\nimage_height: 400\ncamera_name: c\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
        "  data: [500, 0, 299.5, 0, 500, 199.5, 0, 0, 1]\ndistortion_model: plumb_bob\n"
        "distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [-0.1, 0.01, 0, 0, 0]\n"
    )
    back = zj.interop.read(tmp_path / "c.yaml")
    assert back.report.format == "ros"
    assert isinstance(back.lens.distortion_model, RadialPolynomial)
    assert np.asarray(back.lens.focal_range).tolist() == [500, 500]
    assert np.asarray(zj.interop.read(tmp_path / "c.yaml", focal=35).lens.focal_range).tolist() == [35, 35]


def damaged(text):
    """A text, damaged in several ways."""
    yield "empty", b""
    yield "cut", text[: len(text) // 2]
    yield "bytes", bytes(range(256)) * 20
    yield "head", text[:300] + b"\xff\xfe\x00" * 200
    yield "nan", text.replace(b"0.0", b"NaN").replace(b"0.", b"nan.")
    yield "words", text.replace(b"1", b"one")


@pytest.mark.parametrize("name", list(BOTH))
def test_a_damaged_file_is_one_sentence(name, written, tmp_path):
    lens, found = written
    path, _ = found[name]
    source = sorted(path.iterdir())[0] if path.is_dir() else path
    told = []
    for kind, content in damaged(source.read_bytes()):
        bad = tmp_path / f"{kind}-undistort{source.suffix}"
        bad.write_bytes(content)
        try:
            focal = {"focal": 18} if "focal" in BOTH[name].options else {}
            zj.interop.read(bad, format=name, **given(name, lens) | focal)
        except ValueError as error:
            told.append(str(error))
    assert len(told) >= 4
    assert all(text.startswith(f"Cannot read a {name} lens from {tmp_path}") for text in told)
    assert all(text.endswith(".") and "\n" not in text for text in told)


def test_what_a_file_does_not_say_is_asked_for(written, tmp_path):
    _, found = written
    with pytest.raises(ValueError, match="it holds no image size: give argument image_size"):
        zj.interop.read(found["lensfun"][0])
    with pytest.raises(ValueError, match="it holds no focal lengths: give argument focal, 6 of them"):
        zj.interop.read(found["pftrack"][0])
    (tmp_path / "a.xml").write_text(LENSFUN)
    with pytest.raises(ValueError, match="argument name must choose one of 2 lenses, such as 'Some One"):
        zj.interop.read(tmp_path / "a.xml", image_size=(600, 400))
    with pytest.raises(ValueError, match="none of its 2 lenses"):
        zj.interop.read(tmp_path / "a.xml", image_size=(600, 400), name="Three")
    map_of = sorted(found["stmap"][0].iterdir())[0]
    (tmp_path / "x.exr").write_bytes(map_of.read_bytes().replace(b"zoomjaxDirection", b"unknownDirection"))
    with pytest.raises(ValueError, match="its name does not say its direction: give argument direction"):
        zj.interop.read(tmp_path / "x.exr")
    with pytest.raises(FileNotFoundError):
        zj.interop.read(tmp_path / "none.yaml")
    (tmp_path / "notes.txt").write_text("shopping")
    with pytest.raises(ValueError, match="is of no format that is known"):
        zj.interop.read(tmp_path / "notes.txt")


def test_yaml_and_python_in_a_file_are_not_run(tmp_path):
    (tmp_path / "a.yaml").write_text(
        "distortion_model: !!python/object/apply:os.system ['true']\ncamera_matrix: 1\n"
    )
    with pytest.raises(ValueError, match="it is no YAML"):
        zj.interop.read(tmp_path / "a.yaml")
    (tmp_path / "a.cameramodel").write_text("{'lensmodel': __import__('os').getcwd()}")
    with pytest.raises(ValueError, match="Cannot read a mrcal lens"):
        zj.interop.read(tmp_path / "a.cameramodel")


def test_a_coefficient_that_is_no_finite_number_is_refused_at_once(tmp_path, recwarn):
    """1e400 is infinite: fits went on with it, and warned twenty times."""
    path = tmp_path / "a.xml"
    zj.interop.write(LENSES["landscape"](), path, format="lensfun", focal=[18, 35, 70], pixel_pitch=PITCH)
    path.write_text(re.sub(r'k2="[^"]*"', 'k2="1e400"', path.read_text(), count=1))
    with pytest.raises(ValueError, match="coefficients or centre at 18 are not finite numbers"):
        zj.interop.read(path, image_size=LENSES["landscape"]().image_size)
    assert not recwarn.list


def cameras(path, *rows):
    """Cameras of a focal length and k1 each, for COLMAP."""
    lines = [f"{i} RADIAL 640 480 {f} 320 240 {k} 0\n" for i, (f, k) in enumerate(rows, start=1)]
    path.write_text("".join(lines))
    return path


def test_a_smooth_zoom_that_folds_over_gives_way_to_a_table(tmp_path):
    rows = (500, 0.3), (700, -0.2), (1000, 40.0)
    found = zj.interop.read(cameras(tmp_path / "c.txt", *rows))
    assert isinstance(found.lens.zoom, TableZoom)
    assert np.isfinite(found.report.worst)


@pytest.mark.parametrize("rows", [[(500, 50.0)], [(500, -0.3), (700, 40.0), (1000, -0.3)]])
def test_a_lens_that_folds_over_is_refused(rows, tmp_path):
    with pytest.raises(
        ValueError, match=r"the lens that is nearest to it folds over within the image with a "
    ):
        zj.interop.read(cameras(tmp_path / "c.txt", *rows))


def test_the_centre_may_be_a_corner(tmp_path):
    (tmp_path / "c.txt").write_text("1 RADIAL 640 480 900 0.5 0.5 -0.1 0\n")
    found = zj.interop.read(tmp_path / "c.txt")
    assert np.asarray(found.lens.centre).tolist() == [0, 0]
    assert np.isfinite(found.report.worst)
