"""From images on disk to a lens: rendered photographs of the paper's board, and a clip that zooms."""

import base64
import dataclasses
import json
import re
import shutil
import unicodedata
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

import zoomjax as zj
from zoomjax import scenes
from zoomjax.app import demo, image_calibration
from zoomjax.app.board_focals import Board
from zoomjax.app.console import show_images
from zoomjax.app.drawings import drawing
from zoomjax.app.image_calibration import _with_findings, calibrate_images
from zoomjax.app.image_job import ImageJob
from zoomjax.app.model_choice import WantedModel
from zoomjax.app.report import report
from zoomjax.app.undistort_files import Job, undistort_files
from zoomjax.io.exif import exif_with_focal
from zoomjax.io.video_reader import decode_video
from zoomjax.trust.assessment import Finding

from .. import _clips as clips
from .._browser import opened
from ..io.test_equipment import block, ends

SIZE = (1072, 712)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Five good photographs, and one of everything that can be wrong with one."""
    folder = tmp_path_factory.mktemp("photos")
    good = demo.write_photos(folder, number=5, image_size=SIZE)
    image = cv2.imread(str(good[0]), cv2.IMREAD_GRAYSCALE)
    noise = np.random.default_rng(0).integers(-2, 3, image.shape)  # or it is a copy
    cv2.imwrite(str(folder / "no-exif.png"), np.clip(image + noise, 0, 255).astype(np.uint8))
    cv2.imwrite(str(folder / "small.png"), cv2.resize(image, None, fx=0.5, fy=0.5))
    cv2.imwrite(str(folder / "turned.png"), np.rot90(image))
    cv2.imwrite(str(folder / "blank.png"), np.full_like(image, 90))
    (folder / "empty.jpg").write_bytes(b"")
    (folder / "cut.jpg").write_bytes(good[1].read_bytes()[:20000])
    shutil.copy(good[1], folder / "the same.jpg")
    bare = cv2.imread(str(good[2]), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(folder / "a-copy-without-exif.png"), bare)
    return folder


@pytest.fixture(scope="module")
def done(folder):
    steps = []
    calibrated = calibrate_images(ImageJob((folder,)), progress=lambda *step: steps.append(step))
    assert steps == [(number, 13) for number in range(1, 14)]
    return calibrated


@pytest.mark.slow
def test_the_lens_is_that_of_the_photographs(done):
    lens, truth = done.calibration.fit.lens, scenes.nikkor_18_200(SIZE)
    assert demo.worst_error(lens, truth, done.focals.focal.values()) < 0.1
    assert (lens.image_size, lens.focal_unit) == (SIZE, "mm")
    np.testing.assert_allclose(lens.focal_range, [20.56, 127.36])


@pytest.mark.slow
def test_bad_images_are_reported_and_do_not_matter(done):
    assert [d.name[:5] for d in done.used] == ["board"] * 5
    expected = {
        "no-exif.png": "EXIF data have no focal length",
        "small.png": "its size is 536x356 px, but most images have 1072x712: use images as stored by the "
        "camera",
        "turned.png": "its size is 712x1072 px, but most images have 1072x712: it was rotated, so rotate "
        "it back",
        "blank.png": "no lines were found",
        "empty.jpg": "the file is empty",
        "cut.jpg": "the file is damaged or cut off",
        "the same.jpg": "it shows the same lines as board-",
        "a-copy-without-exif.png": "it shows the same lines as board-",
    }
    assert set(done.unused) == set(expected)
    for name, reason in expected.items():
        assert reason in done.unused[name]
    [told, *_] = done.warnings()
    assert told.startswith("8 of 13 images are not used.")
    assert all(name in told for name in expected)
    [sizes] = [found for found in done.calibration.assessment.findings if found.about == "other sizes"]
    assert sizes.found.startswith("2 of 7 photos are of another size")


def test_results_are_written_with_the_lines_over_each_image(done, tmp_path):
    done.write(tmp_path)
    written = sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file())
    numbers = [1 + sorted([*done.unused, *(d.name for d in done.used)]).index(d.name) for d in done.used]
    overlays = [f"{n:04d}-{d.name}" for n, d in zip(numbers, done.used, strict=True)]
    assert overlays == done.overlays()
    files = ["lens.json", "lines.npz", "summary.json", "model.png", *(f"lines/{name}" for name in overlays)]
    assert written == sorted([*files, ".zoomjax.json"])
    for name in overlays:
        height, width, _ = cv2.imread(str(tmp_path / "lines" / name)).shape
        assert width == SIZE[0]
        assert SIZE[1] < height < SIZE[1] + 60  # with a legend below
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["focal_source"] == "EXIF data"
    assert [image["name"] for image in summary["images"]] == [d.name for d in done.used]
    assert sum(image["lines"] for image in summary["images"]) == summary["lines"]
    assert summary["unused"] == done.unused
    assert summary["rms_frames"] <= summary["rms_zoom"] < 0.1 < summary["rms_none"]


def pictures(done, folder):
    """Small pictures of three photos."""
    with drawing(done, folder / "lines", most=3) as drawn:
        return list(drawn.pictures())


@pytest.mark.slow
def test_the_report_shows_photos_before_and_after(done, tmp_path):
    shown = pictures(done, tmp_path)
    focal = [float(done.calibration.lines.focal[one.frame]) for one in shown]
    assert focal == sorted(focal)
    assert len(focal) == 3
    for one in shown:
        before, after = (cv2.imdecode(np.frombuffer(of, np.uint8), 1) for of in (one.before, one.after))
        assert before.shape == after.shape == (372, 560, 3)
        assert np.abs(before.astype(int) - after).mean() > 1
        own = np.flatnonzero(np.asarray(done.calibration.lines.frame) == one.frame)
        worst = own[np.argsort(-done.calibration.line_rms[own])[:3]]
        assert list(one.crops) == worst.tolist()
    page = report(done.calibration, done, pictures=shown)
    assert page.count("data:image/jpeg;base64,") == sum(2 + len(one.crops) for one in shown)
    assert f"line {next(iter(shown[0].crops))}: " in page
    assert "3 of 5 photos are shown" in page
    assert len(page) < 3_000_000


SLID = """<!DOCTYPE html><meta charset="utf-8"><title>probe</title>
<iframe id="page" src="report.html" style="width:1200px;height:800px;border:0"></iframe>
<pre id="found"></pre>
<script>
onload = async () => {
  const page = document.getElementById("page").contentDocument;
  const input = page.getElementById("zoom-at"), found = [];
  for (let step = 0; step <= Number(input.max); step += 4) {
    input.value = step;
    input.dispatchEvent(new Event("input"));
    const images = ["zoom-before", "zoom-after"].map((name) => page.getElementById(name));
    const loaded = (image) => image.complete || new Promise((done) => { image.onload = done; });
    await Promise.all(images.map(loaded));
    found.push([step, page.getElementById("zoom-photo").textContent, ...images.map((image) => image.src),
      images.every((image) => image.naturalWidth > 0 && image.getBoundingClientRect().width > 100)]);
  }
  document.getElementById("found").textContent = JSON.stringify(found);
};
</script>"""


@pytest.mark.slow
def test_under_the_slider_is_the_nearest_photo_before_and_after(done, tmp_path):
    """In a browser, at every fourth place of the slider: by 1/f, with its own pictures, and to be seen."""
    shown = pictures(done, tmp_path)
    text = report(done.calibration, done, pictures=shown)
    (tmp_path / "report.html").write_text(text, encoding="utf-8")
    (tmp_path / "probe.html").write_text(SLID, encoding="utf-8")
    document, console = opened(tmp_path / "probe.html", tmp_path / "profile")
    assert not console
    found = json.loads(re.search(r'<pre id="found">(.*?)</pre>', document)[1])
    assert len(found) == 11
    places = json.loads(re.search(r'id="lens-data">(.*?)</script>', text)[1])["focal"]
    focal = np.array([float(done.calibration.lines.focal[one.frame]) for one in shown])
    seen = set()
    for step, told, before, after, visible in found:
        nearest = int(np.argmin(abs(1 / focal - 1 / places[step])))
        one = shown[nearest]
        assert told == f"The nearest photo: {done.used[one.frame].name}, f = {focal[nearest]:.5g} mm"
        for source, picture in ((before, one.before), (after, one.after)):
            assert base64.b64decode(source.removeprefix("data:image/jpeg;base64,")) == picture
        assert visible
        seen.add(nearest)
    assert seen == {0, 1, 2}


def test_of_many_photos_some_are_drawn(done, monkeypatch, capsys):
    monkeypatch.setattr("zoomjax.app.image_calibration.MOST_OVERLAYS", 3)
    drawn = [bool(name) for name in done.overlays()]
    assert sum(drawn) == 3
    assert drawn[int(np.argmax(done.calibration.fit.frame_rms))]
    every = dataclasses.replace(done, job=dataclasses.replace(done.job, overlays="all"))
    assert all(every.overlays())
    none = dataclasses.replace(done, job=dataclasses.replace(done.job, overlays="none"))
    assert not any(none.overlays())
    for of, told in ((done, "over 3 of 5 images"), (every, "over each image"), (none, "")):
        show_images(of, Path("out"))
        shown = " ".join(capsys.readouterr().out.split())
        assert told in shown
        assert ("Check the detected lines" in shown) == ("lines/" in shown) == bool(told)
    page = report(done.calibration, done)
    assert page.count('href="lines/') == 3


def test_the_verdict_is_good(done):
    assert done.calibration.assessment.verdict == "good"


@pytest.mark.parametrize(
    ("source", "unit", "verdict"), [("board", "mm", "doubtful"), ("plane", "px", "good")]
)
def test_focal_lengths_in_mm_that_are_all_off_by_one_factor_are_doubtful(done, source, unit, verdict):
    """As of a board whose spacing is wrong: `undistort` would take those of the EXIF data."""
    focals = dataclasses.replace(
        done.focals, unit=unit, focal={name: 1.5 * f for name, f in done.focals.focal.items()}
    )
    board = Board((20.0, 20.0), 1000.0, 0.01)
    off = dataclasses.replace(
        done, focals=focals, job=dataclasses.replace(done.job, focal=source, board=board)
    )
    assessment = _with_findings(off).calibration.assessment
    assert assessment.verdict == verdict
    assert ("by their EXIF data" in "".join(f.found for f in assessment.findings)) == (verdict != "good")


def test_photos_that_seem_turned_count_in_the_verdict(done, monkeypatch):
    turned = Finding("turned photos", "doubtful", "some were turned.", "Turn them back.", cause=True)
    asked = []
    monkeypatch.setattr(
        image_calibration, "findings_of_turned", lambda *args: [asked.append(args), turned][1:]
    )
    assert _with_findings(done).calibration.assessment.verdict == "doubtful"
    [(lines, lens, names)] = asked
    assert len(names) == len(lines.focal) == len(done.used)
    assert lens is done.calibration.fit.lens


@pytest.mark.slow
def test_lines_that_are_not_straight_are_rejected(folder, tmp_path):
    """A stripe bent by 2.5 px in one of the photographs: too little for the detector."""
    for path in sorted(folder.glob("board*")):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    target = tmp_path / sorted(folder.glob("board*"))[-1].name
    image, metadata = cv2.imread(str(target)), cv2.imreadWithMetadata(str(target), flags=1)
    t = np.linspace(0, 1, 200)
    for side, level in ((0, 255), (14, 0)):
        arc = np.stack([330 + side + 2.5 * (2 * t - 1) ** 2, 20 + 670 * t], axis=-1)
        cv2.polylines(image, [np.rint(arc * 16).astype(np.int32)], False, (level,) * 3, 14, cv2.LINE_AA, 4)
    _, content = cv2.imencodeWithMetadata(".jpg", image, list(metadata[1]), list(metadata[2]))
    target.write_bytes(content.tobytes())
    spoiled = calibrate_images(ImageJob((tmp_path,)))
    rejected = spoiled.rejected()
    assert [int(r.sum()) for r in rejected[:-1]] == [0] * 4
    assert 1 <= rejected[-1].sum() <= 6  # both sides, each perhaps in pieces
    truth = scenes.nikkor_18_200(SIZE)
    assert demo.worst_error(spoiled.calibration.fit.lens, truth, [20.56, 50.0, 127.36]) < 0.1


@pytest.mark.slow
def test_an_image_none_of_whose_lines_agrees_is_not_used(folder, tmp_path):
    """One line, drawn by hand."""
    for path in sorted(folder.glob("board*")):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    t = np.linspace(0, 1, 200)
    arc = np.stack([500 + 12 * (2 * t - 1) ** 2, 20 + 670 * t], axis=-1)
    image = np.full((SIZE[1], SIZE[0]), 60, np.uint8)
    cv2.fillPoly(
        image,
        [np.rint(np.vstack([arc, [[1100, 690], [1100, 20]]]) * 16).astype(np.int32)],
        200,
        cv2.LINE_AA,
        4,
    )
    exif = np.frombuffer(exif_with_focal(60.0), np.uint8)
    _, content = cv2.imencodeWithMetadata(".png", image, [cv2.IMAGE_METADATA_EXIF], [exif])
    (tmp_path / "bent.png").write_bytes(content.tobytes())
    done = calibrate_images(ImageJob((tmp_path,)))
    assert list(done.unused) == ["bent.png"]
    assert "none of its lines is straight" in done.unused["bent.png"]
    assert len(done.used) == 5


@pytest.mark.slow
def test_a_lens_that_the_photos_tell_has_its_prior(folder, tmp_path):
    """Of two photos from inside of its range; the report says so."""
    for path in sorted(folder.glob("board-*"))[1:3]:
        focal = float(path.name[6:12])
        of_lens = block(
            FocalLength=IFDRational(round(100 * focal), 100),
            FocalLengthIn35mmFilm=round(1.5 * focal),
            **ends((18, 1), (200, 1), (35, 10), (56, 10)),
        )
        Image.open(path).save(tmp_path / path.name, exif=of_lens, quality=95)
    done = calibrate_images(ImageJob((tmp_path,), model=WantedModel("smooth"), overlays="none"))
    zoom = done.calibration.fit.lens.zoom
    np.testing.assert_allclose(zoom.mean, zj.SmoothZoom.for_lens(18.0, 200.0, crop=1.5).mean, atol=5e-4)
    assert zoom.focal_ref == 18.0
    told = done.about()["prior"]
    assert "that of a lens of 18 to 200 mm at crop factor 1.5" in told
    assert told in report(done.calibration, done)


def test_photos_that_tell_no_lens_have_the_prior_of_all(done):
    assert done.lens is None
    assert done.about()["prior"] is None


@pytest.mark.slow
def test_one_photo_needs_no_focal_length(folder, tmp_path):
    path = tmp_path / "no-exif.png"
    shutil.copy(folder / "no-exif.png", path)
    done = calibrate_images(ImageJob((path,), overlays="none"))
    lens, truth = done.calibration.fit.lens, scenes.nikkor_18_200(SIZE)(20.56)
    corner = np.array([10.0, 10.0])
    np.testing.assert_allclose(lens(1.0).undistort(corner), truth.undistort(corner), atol=0.3)
    assert lens.about["focal"] == "not known"
    with pytest.raises(ValueError, match="pixel_pitch"):
        zj.Camera(lens)
    page = report(done.calibration, done)
    assert "focal length not known" in page
    assert "against 1/f" not in page  # plots of one point
    assert [name for name, _ in done.calibration.rows()] == ["no correction", "corrected"]
    for zooms in ("frame by frame", "over the zoom", "zoom polynomial", "focal range"):
        assert zooms not in page
    for text in (page, done.calibration.advice(), str(done.calibration.summary()["next_photo"])):
        assert not re.search(r"\b1 mm\b(?! stands)", text)
    done.calibration.fit.lens.save(tmp_path / "lens.json")
    expected = zj.undistort_image(cv2.imread(str(path)), lens(1.0))
    image = cv2.imread(str(path))
    cv2.imwrite(str(tmp_path / "later.tif"), image)  # and it knows no more
    write_exif(tmp_path / "zoomed.png", image, 70.0)  # another than 1 mm, but nobody knows that either
    clips.write_frames(tmp_path / "clip.mkv", [image] * 3, encoder="ffv1")
    files = tuple(tmp_path / name for name in ("later.tif", "zoomed.png"))
    undistort_files(Job(tmp_path / "lens.json", files, tmp_path / "out"))
    for file in files:
        np.testing.assert_array_equal(cv2.imread(str(tmp_path / "out" / file.name)), expected)
    undistort_files(Job(tmp_path / "lens.json", (tmp_path / "clip.mkv",), tmp_path / "out.mkv"))
    with decode_video(tmp_path / "out.mkv") as (number, frames):
        shown = [image() for *_, image in frames]
    assert number == len(shown) == 3
    assert np.abs(shown[1].astype(int) - expected).mean() < 3


def write_exif(path, image, focal):
    exif = np.frombuffer(exif_with_focal(focal), np.uint8)
    _, content = cv2.imencodeWithMetadata(".png", image, [cv2.IMAGE_METADATA_EXIF], [exif])
    path.write_bytes(content.tobytes())


@pytest.mark.slow
def test_several_photos_need_focal_lengths(folder, tmp_path):
    image = cv2.imread(str(folder / "no-exif.png"), cv2.IMREAD_GRAYSCALE)
    for shift, name in enumerate("ab"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.roll(image, 5 * shift, axis=0))
    with pytest.raises(ValueError, match=r"No focal length found .*one focal length for all"):
        calibrate_images(ImageJob((tmp_path,)))


@pytest.mark.slow
def test_several_photos_of_one_zoom_need_none(folder, tmp_path):
    image = cv2.imread(str(folder / "no-exif.png"), cv2.IMREAD_GRAYSCALE)
    for name in "ab":
        cv2.imwrite(str(tmp_path / f"{name}.png"), image if name == "a" else image[:, ::-1])
    done = calibrate_images(ImageJob((tmp_path,), focal="same", overlays="none"))
    lens, truth = done.calibration.fit.lens, scenes.nikkor_18_200(SIZE)(20.56)
    corner = np.array([10.0, 10.0])
    np.testing.assert_allclose(lens(1.0).undistort(corner), truth.undistort(corner), atol=0.3)
    assert lens.about["focal"] == "not known"
    assert not re.search(r"\b1 mm\b(?! stands)", report(done.calibration, done))


@pytest.mark.slow
def test_a_zooming_video_is_calibrated(tmp_path):
    clips.write_clip(tmp_path / "zoom.mp4", sound=False)
    track = [f"{n},{clips.focal(n)}" for n in range(clips.FRAMES)]
    (tmp_path / "track.csv").write_text("\n".join(["frame,focal", *track]))
    job = ImageJob(
        (tmp_path / "zoom.mp4",), focal=str(tmp_path / "track.csv"), model=WantedModel(degree=1), frames=8
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        done = calibrate_images(job)
    assert done.focals.origin == "the track of the video"
    assert len(done.used) == 8
    lens, truth = done.calibration.fit.lens, clips.lens()
    assert demo.worst_error(lens, truth, [20.0, 35.0, 80.0]) < 1.5  # 320 px wide, few lines
    done.write(tmp_path)
    assert len(list((tmp_path / "lines").glob("*-zoom-*.jpg"))) == 8


def test_a_second_run_leaves_nothing_of_the_first_and_everything_else(done, tmp_path):
    done.write(tmp_path)
    stale, *others = sorted((tmp_path / "lines").iterdir())
    (tmp_path / "lines" / "old.jpg").write_bytes(b"not of zoomjax")
    done.calibration.write(tmp_path)  # of other lines
    assert [p.name for p in (tmp_path / "lines").iterdir()] == ["old.jpg"]
    done.write(tmp_path)
    names = ["old.jpg", *(p.name for p in (stale, *others))]
    assert sorted(p.name for p in (tmp_path / "lines").iterdir()) == sorted(names)


HOSTILE = [
    "<script>alert(1)<‚script>.jpg",
    "[red]x[‚red].jpg",
    "\x1b[31m\x9b2J.jpg",
    "=cmd().jpg",
    "two\nlines\u202e.jpg",
]


@pytest.fixture
def hostile(done, folder, tmp_path):
    """The photographs once more under names that mean something to somebody, two folders up."""
    photos = [tmp_path / name for name in HOSTILE]
    for detection, photo in zip(done.used, photos, strict=True):
        photo.write_bytes((folder / detection.name).read_bytes())
    inputs = tuple(f"{tmp_path}/a/b/../../{photo.name}" for photo in photos)
    (tmp_path / "a" / "b").mkdir(parents=True)
    pairs = zip(done.used, inputs, strict=True)
    used = tuple(dataclasses.replace(d, name=name, file=name) for d, name in pairs)
    names = {source.path: source.name for source in ImageJob(inputs).sources()[0]}
    used = tuple(dataclasses.replace(d, name=names[Path(d.file)]) for d in used)
    focals = dataclasses.replace(
        done.focals, focal={d.name: f for d, f in zip(used, done.focals.focal.values(), strict=True)}
    )
    unused = {f"bad {name}": f"it is bad: {name}" for name in HOSTILE}
    images = tuple(d.name for d in used)
    return dataclasses.replace(
        done, job=ImageJob(inputs), used=used, focals=focals, images=images, unused=unused
    )


def test_results_in_the_photographs_own_folder_touch_none_of_them(hostile, tmp_path):
    before = {photo: photo.read_bytes() for photo in tmp_path.glob("*.jpg")}
    assert len(before) == 5
    (tmp_path / "lines").mkdir()
    (tmp_path / "lines" / "0001-mine.jpg").write_bytes(b"mine")
    for _ in range(2):
        hostile.write(tmp_path)
    assert {photo: photo.read_bytes() for photo in tmp_path.glob("*.jpg")} == before
    made = ["0001-script_alert_1_script", "0002-red_x_red", "0003-31m_2J", "0004-cmd", "0005-two_lines"]
    assert sorted(p.stem for p in (tmp_path / "lines").iterdir()) == sorted(["0001-mine", *made])
    assert not list((tmp_path / "a").rglob("*.jpg"))
    (tmp_path / "lines" / f"{made[2]}.jpg").write_bytes(b"edited")
    with pytest.raises(FileExistsError, match=r"0003-31m_2J\.jpg would be replaced"):
        hostile.write(tmp_path)


@pytest.mark.slow
def test_hostile_names_give_no_orders(hostile, tmp_path, capsys):
    show_images(hostile, tmp_path / "[red]out\x1b[0m")
    shown = "".join(capsys.readouterr())
    assert not {c for c in shown if unicodedata.category(c) in ("Cc", "Cf")} - {"\n"}
    flat = "".join(shown.split())
    for name in (
        "[red]x[‚red].jpg",
        r"\x1b[31m\x9b2J.jpg",
        r"two\nlines\u202e.jpg",
        r"[red]out\x1b[0m/lines",
    ):
        assert name in flat
    page = report(hostile.calibration, hostile)
    assert "<script>alert" not in page
    assert "&lt;script&gt;alert(1)&lt;" in page
    assert "\x1b" not in page
    assert r"two\nlines\u202e.jpg" in page
    assert "[red]x[‚red].jpg" in page
    page.encode()


WRONG = {
    "unknown detector": (
        {"detector": "circles"},
        ValueError,
        "Argument detector must be one of edges, grid, pitch",
    ),
    "photos and a video": ({"inputs": ("a.jpg", "b.mp4")}, ValueError, "photos, or one video"),
    "two videos": ({"inputs": ("a.mp4", "b.mp4")}, ValueError, "one video"),
    "no such photo": ({"inputs": ("nothing.jpg",)}, FileNotFoundError, "nothing.jpg"),
    "no such table": ({"focal": "nothing.csv"}, FileNotFoundError, "nothing.csv"),
    "video without focal": ({"inputs": ("a.mp4",)}, ValueError, "A video needs --focal"),
    "a number that is none": ({"focal": "-3"}, ValueError, "positive number"),
    "video with exif": ({"inputs": ("a.mp4",), "focal": "exif"}, ValueError, "A video needs --focal"),
    "no such video": ({"inputs": ("a.mp4",), "focal": "3"}, FileNotFoundError, "no video a.mp4"),
}


@pytest.mark.parametrize("case", WRONG)
def test_mistakes_are_told_before_any_work(case, folder):
    settings, error, message = WRONG[case]
    with pytest.raises(error, match=message):
        calibrate_images(ImageJob(**{"inputs": (folder,)} | settings))


def test_when_no_image_can_be_used_the_reason_is_told(tmp_path):
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(tmp_path / name), np.full((100, 100), 90, np.uint8))
    with pytest.raises(ValueError, match="None of the 2 images can be used: no lines were found"):
        calibrate_images(ImageJob((tmp_path,)))
    (tmp_path / "c.png").write_bytes(b"")
    with pytest.raises(ValueError, match=r"a\.png: no lines.*c\.png: .*empty"):
        calibrate_images(ImageJob((tmp_path,)))


@pytest.mark.usefixtures("unchecked")
def test_whether_photos_are_tied_is_no_word():
    with pytest.raises(TypeError, match="tied must be True or False, but it is 'no'"):
        ImageJob(("a.jpg",), tied="no")  # pyright: ignore[reportArgumentType]
