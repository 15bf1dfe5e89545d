"""Lenses from other tools' files: what zoomjax wrote, what others did, and what is damaged."""

import cv2
import numpy as np
import pytest

import zoomjax as zj
from benchmarks.mutations import LCP
from zoomjax.models import BrownConrady, Division, RadialPolynomial, TableZoom

from ._lenses import LENSES, PITCH
from .test_write import shown

BOTH = {fmt.name: fmt for fmt in zj.interop.formats() if fmt.writes and fmt.reads}
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
    assert np.asarray(back.lens.focal_range) == pytest.approx(np.array([18, 200]) * factor)
    assert np.asarray(back.lens.centre) == pytest.approx(np.asarray(lens.centre), abs=1e-3)
    assert len(back.report.focal) == len(report.focal)
    points = shown(lens)
    for focal in (18.0, 21.0, 50.0, 200.0):
        wanted, got = (np.asarray(d.undistort(points)) for d in (lens(focal), back.lens(focal * factor)))
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
    ("name", "kind", "family"),
    [
        ("opentrackio", "decentred", BrownConrady),
        ("opentrackio", "division", Division),
        ("colmap", "division", Division),
        ("opencv", "decentred", BrownConrady),
    ],
)
def test_other_distortion_models_come_back(name, kind, family, tmp_path):
    lens = LENSES[kind]()
    path = tmp_path / ("cv" if name == "opencv" else f"a{BOTH[name].suffixes[0]}")
    zj.interop.write(lens, path, format=name, focal=FOCAL, pixel_pitch=PITCH)
    back = zj.interop.read(path)
    assert isinstance(back.lens.family, family)
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
    if convention == "gyroflow":
        moved = np.asarray(zj.interop.read(path).lens.centre - back.lens.centre)
        assert np.abs(moved).max() > 0.1  # which shows that the convention matters


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


def test_plumb_bob_and_one_entry_without_a_zoom(tmp_path):
    (tmp_path / "c.yaml").write_text(
        "image_width: 600\nimage_height: 400\ncamera_name: c\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
        "  data: [500, 0, 299.5, 0, 500, 199.5, 0, 0, 1]\ndistortion_model: plumb_bob\n"
        "distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [-0.1, 0.01, 0, 0, 0]\n"
    )
    back = zj.interop.read(tmp_path / "c.yaml")
    assert back.report.format == "ros"
    assert isinstance(back.lens.family, RadialPolynomial)
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
            zj.interop.read(bad, format=name, **given(name, lens) | {"focal": 18})
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
    (tmp_path / "x.exr").write_bytes(map_of.read_bytes())
    with pytest.raises(ValueError, match="its name does not tell its direction: give argument direction"):
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
