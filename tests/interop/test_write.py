"""Lenses in other tools' formats, read by those tools: at the focal lengths written, and between."""

import dataclasses
import itertools
import json

import cv2
import jsonschema
import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest
from discorpy.losa.loadersaver import load_metadata_txt
from discorpy.post.postprocessing import unwarp_image_backward
from scipy.optimize import minimize_scalar

import zoomjax as zj

from ._lenses import LENSES, PITCH, polynomial
from ._readers import CORRECTS, READERS

MARGIN = 0.01
"""px beyond the error that the writer reported: of readers, and of points that it did not look at."""

WRITTEN = {fmt.name: fmt for fmt in zj.interop.formats() if fmt.writes}
TABLES = [name for name in READERS if WRITTEN[name].zoom == "interpolated"]
OTHERS = [name for name in READERS if WRITTEN[name].zoom != "interpolated"]


def shown(lens):
    """A grid of points over the image."""
    w, h = lens.image_size
    return np.stack(np.meshgrid(np.linspace(0, w - 1, 7), np.linspace(0, h - 1, 6)), -1).reshape(-1, 2)


def error(name, path, lens, focal, index=0, pitch=PITCH, distorted=None):
    """The greatest distance of what the tool does to what the lens does, px."""
    distorted = shown(lens) if distorted is None else distorted
    corrected = np.asarray(lens(focal).undistort(distorted))
    start, end = (distorted, corrected) if name in CORRECTS else (corrected, distorted)
    mm, px = (focal, focal / pitch) if lens.focal_unit == "mm" else (focal * pitch, focal)
    centre = np.asarray(lens.centre_at(focal))

    def at(scale):
        points = centre + scale * (start - centre)
        found = READERS[name](path, focal, points, index=index, size=lens.image_size, mm=mm, px=px)
        return np.hypot(*(found - end).T).max()

    if name == "lensfun" and "ptlens" in path.read_text():  # which leaves the scale free
        return min(at(minimize_scalar(at, bounds=(0.97, 1.03), method="bounded").x), at(1.0))
    return at(1.0)


@pytest.fixture(params=LENSES)
def lens(request):
    return LENSES[request.param]()


@pytest.mark.parametrize("name", OTHERS)
def test_at_its_focal_lengths_a_file_does_as_the_lens(name, lens, tmp_path):
    focal = np.geomspace(*np.asarray(lens.focal_range), 3)
    fmt = WRITTEN[name]
    path = tmp_path / ("files" if fmt.zoom == "one" else f"lens{fmt.suffixes[0]}")
    report = zj.interop.write(lens, path, format=name, focal=focal, pixel_pitch=PITCH)
    assert report.focal == pytest.approx(focal)
    files = sorted(path.iterdir(), key=lambda file: float(file.stem)) if path.is_dir() else [path] * 3
    worst = max(error(name, file, lens, f, i) for i, (file, f) in enumerate(zip(files, focal, strict=True)))
    assert worst <= report.worst + MARGIN
    exact = (
        isinstance(lens.distortion_model, zj.models.RadialPolynomial)
        and lens(focal[0]).coefficients.shape[-1] < 3
    )
    if fmt.exact and exact:
        assert max(worst, report.worst) < 1e-8
    rational = name in ("opencv", "ros", "mrcal", "colmap", "opentrackio")
    radial = isinstance(lens.distortion_model, zj.models.AbstractRadial)
    if rational and radial:
        assert report.worst < MARGIN


@pytest.mark.slow
@pytest.mark.parametrize("name", TABLES)
@pytest.mark.parametrize("kind", LENSES)
def test_between_its_focal_lengths_a_file_does_as_reported(name, kind, tmp_path):
    lens = LENSES[kind]()
    path = tmp_path / f"lens{WRITTEN[name].suffixes[0]}"
    report = zj.interop.write(lens, path, format=name, pixel_pitch=PITCH)
    nodes = np.array(report.focal)
    between = [a + (b - a) * 0.37 for a, b in itertools.pairwise(nodes)]
    # Unreal's first and last interval are eased: not by this reader, and they are short.
    tried = np.concatenate([nodes[[0, len(nodes) // 2, -1]], between[:: max(len(between) // 5, 1)]])
    assert max(error(name, path, lens, f) for f in tried) <= report.worst + MARGIN
    assert report.worst <= 0.1 or any("cannot follow" in note for note in report.notes)


@pytest.mark.parametrize("name", ["discorpy", "hugin", "opentrackio", "nuke", "opencv"])
def test_the_error_that_is_said_is_the_greatest_of_all_points(name, tmp_path):
    """Refitted are seven coefficients, which leave narrow rings."""
    lens = zj.interop.library_lens(
        "Nikon AF-S DX VR Zoom-Nikkor 18-200mm f/3.5-5.6G IF-ED II", image_size=(4288, 2848)
    )
    [low, _] = np.asarray(lens.focal_range).tolist()
    path = tmp_path / f"lens{WRITTEN[name].suffixes[0]}"
    report = zj.interop.write(lens, path, format=name, focal=low)
    grid = np.stack(np.meshgrid(np.linspace(0, 4287, 61), np.linspace(0, 2847, 41)), -1).reshape(-1, 2)
    worst = error(name, path, lens, low, pitch=lens.pixel_pitch, distorted=grid)
    assert 0.9 * report.worst <= worst <= report.worst + MARGIN


def test_more_focal_lengths_are_written_for_a_lower_tolerance(tmp_path):
    lens = LENSES["landscape"]()
    reports = [
        zj.interop.write(lens, tmp_path / f"{t}.json", format="gyroflow", pixel_pitch=PITCH, tolerance=t)
        for t in (0.5, 0.1)
    ]
    assert len(reports[0].focal) < len(reports[1].focal)
    assert reports[0].worst <= 0.5
    assert reports[1].worst <= 0.1


def test_what_a_format_cannot_do_is_said(tmp_path):
    lens = polynomial([[0.1, -0.03]], (4288, 2848), (2143.5, 1423.5))
    report = zj.interop.write(lens, tmp_path / "k.yaml", format="kalibr", focal=50, pixel_pitch=PITCH)
    assert 0.5 < report.worst < 2
    assert any("cannot follow this lens within 0.1 px" in note for note in report.notes)


def said(lens, folder, **how):
    report = zj.interop.write(lens, folder / "a", overwrite=True, pixel_pitch=PITCH, **how)
    return report, str(report)


FLOOR = "cannot follow this lens within"
BETWEEN = "Between the focal lengths the error exceeds the tolerance of 0.1 px"


def test_it_is_said_whether_the_formula_or_the_focal_lengths_are_what_is_wrong(tmp_path):
    mild = LENSES["landscape"]()
    report, text = said(mild, tmp_path, format="gyroflow", focal=[18, 200])
    assert f"{BETWEEN}: give more of them, or none to have them chosen." in text
    assert FLOOR not in text
    strong = polynomial([[0.25, -0.05], [0.01, 0.0]], (4288, 2848), (2143.5, 1423.5))
    report, text = said(strong, tmp_path, format="lensfun")  # a smooth one
    assert report.at_nodes > 0.1
    assert FLOOR in text
    assert BETWEEN not in text
    assert report.between <= report.at_nodes + 0.1
    report, text = said(strong, tmp_path, format="unreal", focal=[18, 200])
    assert FLOOR in text
    assert BETWEEN in text


def test_opentrackio_is_named_for_unreal_where_it_takes_the_lens(tmp_path):
    better = "Unreal's reader of OpenTrackIO takes the lens without a refit."
    assert better in said(LENSES["landscape"](), tmp_path, format="unreal", focal=[18, 200])[1]
    seven = zj.interop.library_lens("Canon EF 24-70mm f/2.8L II USM", image_size=(600, 400), model="table")
    assert seven(35.0).coefficients.shape[-1] > 3
    seven = dataclasses.replace(seven, pixel_pitch=None)
    assert better not in said(seven, tmp_path, format="unreal", focal=[24, 70])[1]


@pytest.mark.parametrize("name", TABLES)
@pytest.mark.parametrize("gap", [1e-6, 4e-9, 1e-13])
def test_focal_lengths_that_digits_do_not_tell_apart_are_written_apart(name, gap, tmp_path):
    """The errors were those of reading it again, as that zip() got lists of unlike lengths."""
    k = np.array([[0.01], [0.01], [0.011], [0.011]])
    zoom = zj.models.TableZoom(inverse=False, parameters=k, knots=np.array([20.0, 35.0, 35.0 + gap, 80.0]))
    lens = zj.ZoomLens(zoom, np.array([319.5, 239.5]), np.array([20.0, 80.0]), (640, 480))
    report = zj.interop.write(lens, tmp_path / "a", format=name, pixel_pitch=PITCH, tolerance=0.5)
    assert report.worst <= 0.5
    for focal in (20.0, 34.99, 35.01, 80.0):
        assert error(name, tmp_path / "a", lens, focal) < 0.5 + MARGIN
    narrow = dataclasses.replace(lens, focal_range=np.array([35.0, 35.0 + min(gap, 1e-8)]))
    report = zj.interop.write(narrow, tmp_path / "b", format=name, pixel_pitch=PITCH, tolerance=0.5)
    assert report.focal == (35.0,)


def test_samples_of_opentrackio_are_of_its_schema(lens, tmp_path):
    from pathlib import Path

    schema = json.loads((Path(__file__).parent / "opentrackio-schema.json").read_text())
    focal = np.geomspace(*np.asarray(lens.focal_range), 3)
    zj.interop.write(lens, tmp_path / "t.jsonl", format="opentrackio", focal=focal, pixel_pitch=PITCH)
    lines = (tmp_path / "t.jsonl").read_text().splitlines()
    assert len(lines) == 3
    for line in lines:
        jsonschema.validate(json.loads(line), schema)


@pytest.mark.parametrize(
    "name", ["landscape", "portrait", "wide, three terms", "px", "decentred", "moving centre"]
)
def test_maps_say_where_to_sample(name, tmp_path):
    lens = LENSES[name]()
    w, h = lens.image_size
    ends = np.asarray(lens.focal_range).tolist()
    report = zj.interop.write(lens, tmp_path / "maps", format="stmap", focal=ends)
    assert report.worst < 1e-3
    for focal in ends:
        distortion = lens(focal)
        for kind, exact in (("undistort", distortion.distort), ("redistort", distortion.undistort)):
            with OpenEXR.File(
                str(tmp_path / "maps" / f"{kind}.{focal:.10g}.exr"), separate_channels=True
            ) as file:
                header = dict(file.header())
                red, green, blue = (np.array(file.channels()[c].pixels) for c in "RGB")
            assert red.dtype == np.float32
            assert (blue == 1).all()  # Blender takes it for the opacity
            assert np.asarray(header["displayWindow"]).tolist() == [[0, 0], [w - 1, h - 1]]
            left, top = np.asarray(header["dataWindow"])[0]
            y, x = (v.ravel() for v in np.mgrid[0 : red.shape[0] : 37, 0 : red.shape[1] : 41])
            found = np.stack([red[y, x] * w - 0.5, (1 - green[y, x].astype(float)) * h - 0.5], -1)
            wanted = np.asarray(exact(np.stack([x + left, y + top], -1).astype(float)))
            assert np.abs(found - wanted).max() < 1e-3


@pytest.mark.parametrize("name", ["landscape", "portrait", "decentred"])
def test_openimageio_warps_by_maps(name, tmp_path):
    """An image of its own coordinates, warped by OpenImageIO, shows where it was sampled."""
    lens = LENSES[name]()
    w, h = lens.image_size
    zj.interop.write(lens, tmp_path / "maps", format="stmap", focal=18)
    ramp = np.zeros((h, w, 3), np.float32)
    ramp[..., 1], ramp[..., 0] = np.mgrid[0:h, 0:w]
    source = oiio.ImageBuf(ramp)
    for kind, exact in (("undistort", lens(18.0).distort), ("redistort", lens(18.0).undistort)):
        at = oiio.ImageBuf(str(tmp_path / "maps" / f"{kind}.18.exr"))
        # The filter "triangle", 2 px wide, is bilinear; the last two: S grows to the right, T upwards.
        warped = oiio.ImageBufAlgo.st_warp(source, at, "triangle", 2.0, 0, 1, False, True)
        assert not warped.has_error
        found = warped.get_pixels(oiio.FLOAT)[10:-10:7, 10:-10:7, :2]
        y, x = np.mgrid[warped.ybegin : warped.yend, warped.xbegin : warped.xend][:, 10:-10:7, 10:-10:7]
        wanted = np.asarray(exact(np.stack([x, y], -1).astype(float)))
        inside = ((wanted > 2) & (wanted < np.array([w, h]) - 3)).all(-1)
        assert inside.mean() > 0.5
        assert np.abs(found - wanted)[inside].max() < 0.01


@pytest.mark.parametrize("name", ["landscape", "portrait"])
def test_discorpy_corrects_images(name, tmp_path):
    lens = LENSES[name]()
    w, h = lens.image_size
    report = zj.interop.write(lens, tmp_path / "lens.txt", format="discorpy", focal=24)
    x, y, factors = load_metadata_txt(str(tmp_path / "lens.txt"))
    rows, columns = np.mgrid[0:h, 0:w].astype(float)
    found = np.stack([unwarp_image_backward(ramp, x, y, factors) for ramp in (columns, rows)], -1)
    wanted = np.asarray(lens(24.0).distort(np.stack([columns, rows], -1)))
    inside = ((wanted > 1) & (wanted < np.array([w, h]) - 2)).all(-1)
    assert np.abs(found - wanted)[inside].max() < report.worst + MARGIN
    assert report.worst < 0.1


def test_maps_cover_the_corrected_image(tmp_path):
    """What the camera saw at its corners is in the map, beyond the display window."""
    lens = LENSES["landscape"]()
    report = zj.interop.write(lens, tmp_path / "maps", format="stmap", focal=18)
    corners = np.array([[0, 0], [639, 0], [639, 479], [0, 479.0]])
    corrected = np.asarray(lens(18.0).undistort(corners))
    with OpenEXR.File(str(tmp_path / "maps" / "undistort.18.exr")) as file:
        low, high = np.asarray(file.header()["dataWindow"])
    assert (low <= corrected.min(0)).all()
    assert (high >= corrected.max(0)).all()
    assert (low < 0).all()
    width, height = high - low + 1
    assert report.notes == (
        f"Corrected images are {width}x{height} px: the photo's frame begins {-low[0]} px from the left "
        f"and {-low[1]} px from the top.",
    )


def test_maps_without_overscan_say_nothing_of_it(tmp_path):
    lens = polynomial([[-0.01]], (640, 480), (319.5, 239.5))
    assert not zj.interop.write(lens, tmp_path / "maps", format="stmap", focal=18).notes


@pytest.mark.parametrize("suffix", [".yaml", ".yml", ".xml", ".json", ""])
def test_opencvs_files_are_of_the_language_of_their_suffix(suffix, tmp_path):
    """And YAML where there is none. The first line of YAML is that which old versions of OpenCV need."""
    lens = LENSES["landscape"]()
    path = tmp_path / f"camera{suffix}"
    zj.interop.write(lens, path, format="opencv", focal=24, pixel_pitch=PITCH)
    start = {".xml": "<?xml", ".json": "{"}.get(suffix, "%YAML:1.0\n---\n")
    text = path.read_text()
    assert text.startswith(start)
    whole = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    first = tmp_path / "first.yaml"
    zj.interop.write(lens, first, format="opencv", focal=24, pixel_pitch=PITCH, overwrite=True)
    like = cv2.FileStorage(str(first), cv2.FILE_STORAGE_READ)
    for name in ("camera_matrix", "distortion_coefficients"):
        assert np.array_equal(whole.getNode(name).mat(), like.getNode(name).mat())


def test_a_track_is_an_entry_for_each_frame(tmp_path):
    lens = LENSES["landscape"]()
    track = zj.io.FocalTrack(np.array([1001.0, 1004.0]), np.array([24.0, 48.0]), by_time=False)
    report = zj.interop.write(lens, tmp_path / "a.nk", format="nuke", track=track, pixel_pitch=PITCH)
    assert report.focal == pytest.approx([24, 28.8, 36, 48])
    assert "{{curve x1001 " in (tmp_path / "a.nk").read_text()
    zj.interop.write(lens, tmp_path / "a.jsonl", track=track, pixel_pitch=PITCH)
    lines = (tmp_path / "a.jsonl").read_text().splitlines()
    numbers = [json.loads(line)["timing"]["sequenceNumber"] for line in lines]
    assert numbers == [1001, 1002, 1003, 1004]
    zj.interop.write(lens, tmp_path / "cv", format="opencv", track=track, pixel_pitch=PITCH)
    assert sorted(file.name for file in (tmp_path / "cv").iterdir())[0] == "001001.yaml"


IN_FRAMES, IN_SECONDS = (
    zj.io.FocalTrack(np.arange(2.0), np.array([20.0, 30]), by_time=by_time) for by_time in (False, True)
)
NO_FRAME = zj.io.FocalTrack(np.array([0.5, 0.75]), np.array([20.0, 30]), by_time=False)
MISTAKES = {
    "Argument pixel_pitch, mm from one pixel to the next": {"format": "opencv", "focal": 24},
    "Argument format must be one of": {"format": "nonsense"},
    "Argument format must be given": {},
    "The format lcp can be read only": {"format": "lcp"},
    "Argument focal must be given, one focal length or several": {"format": "opencv", "pixel_pitch": PITCH},
    "Argument focal must hold positive": {"format": "opencv", "focal": -1, "pixel_pitch": PITCH},
    "Argument focal must hold positive numbers, but it is True": {"format": "opencv", "focal": True},
    "Argument focal must hold positive numbers, but it is .'24'": {"format": "opencv", "focal": ["24"]},
    "Argument pixel_pitch must be a positive": {"format": "opencv", "focal": 24, "pixel_pitch": True},
    "Argument pixel_pitch must be the width": {"format": "opencv", "focal": 24, "pixel_pitch": 5.5},
    "it means pixels of 5.5e-06 mm and a sensor": {"format": "lensfun", "pixel_pitch": 5.5e-6},
    "Argument track must reach over a whole frame, but it": {"format": "nuke", "track": NO_FRAME},
    "Argument tolerance must be a positive": {"format": "lensfun", "tolerance": 0, "pixel_pitch": PITCH},
    "Argument convention must be one of": {"format": "stmap", "focal": 24, "convention": "x"},
    "Argument track must be left out: the format": {"format": "lensfun", "track": IN_FRAMES},
    "Argument track must be in frames": {"format": "nuke", "track": IN_SECONDS},
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("message", MISTAKES)
def test_a_mistake_is_one_sentence_and_nothing_is_written(message, tmp_path):
    with pytest.raises(ValueError, match=message):
        zj.interop.write(LENSES["landscape"](), tmp_path / "out.abc", **MISTAKES[message])
    assert not list(tmp_path.iterdir())


def test_files_are_replaced_only_if_told(tmp_path):
    lens = LENSES["landscape"]()
    (tmp_path / "a.pfb").write_text("mine")
    with pytest.raises(FileExistsError, match="give argument overwrite"):
        zj.interop.write(lens, tmp_path / "a.pfb", focal=24)
    zj.interop.write(lens, tmp_path / "a.pfb", focal=24, overwrite=True)
    assert (tmp_path / "a.pfb").read_text().startswith("#PFBarrel")


@pytest.mark.parametrize("name", ["opencv", "stmap"])
def test_files_of_a_longer_track_that_stay_are_named(name, tmp_path):
    """They are of another lens: a program that reads the sequence would go on with it."""
    lens = polynomial([[-0.01]], (64, 48), (31.5, 23.5))

    def written(frames, **options):
        track = zj.io.FocalTrack(np.arange(frames), np.full(frames, 18.0), by_time=False)
        path = tmp_path / "maps"
        return zj.interop.write(lens, path, format=name, track=track, pixel_pitch=PITCH, **options)

    assert "other files" not in str(written(5).notes)
    before = {file.name: file.read_bytes() for file in (tmp_path / "maps").iterdir()}
    report = written(3, overwrite=True)
    left = sorted(before.keys() - {file.name for file in report.files})
    assert f"holds other files of this kind, {left[0]} and {len(left) - 1} more" in report.notes[-1]
    assert {file.name for file in (tmp_path / "maps").iterdir()} == before.keys()
    assert "other files" not in str(written(5, overwrite=True).notes)


def test_a_lens_that_folds_is_refused(tmp_path):
    lens = polynomial([[-0.6, 0.0]], (640, 480), (319.5, 239.5))
    for name in ("opencv", "stmap"):
        with pytest.raises(ValueError, match="folds over within the image"):
            zj.interop.write(lens, tmp_path / name, format=name, focal=24, pixel_pitch=PITCH)
    assert not list(tmp_path.iterdir())
