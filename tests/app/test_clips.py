"""A clip and nothing else: the command line finds its focal lengths and its lens."""

import csv
import json
import shlex
import subprocess
import warnings
from pathlib import Path

import av
import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes
from zoomjax.app.arguments import results_of
from zoomjax.app.clips import ClipJob, correction_command, wants_motion
from zoomjax.app.heard import heard
from zoomjax.app.known_focals import known_focals
from zoomjax.app.model_choice import WantedModel
from zoomjax.app.motion_calibration import FILES, MotionCalibration
from zoomjax.app.panorama import write_panorama
from zoomjax.fit.motion import fit_motion
from zoomjax.io.focal_track import read_focal_track
from zoomjax.io.video_reader import decode_video
from zoomjax.scenes import motion_clip, motion_tracks, pan_and_zoom

from .._clips import write_frames
from .._commands import COMMAND, one_after_another, still_earlier, write_earlier

SIZE, FRAMES = (640, 360), 36


def lens():
    """Barrel at the short end, by 30 px in the corners; the centre 3 px off."""
    zoom = zj.PolynomialZoom(2, jnp.array([[0.02, 0.0], [-0.05, 0.01], [-0.1, 0.03]]), jnp.array(500.0))
    return zj.ZoomLens(zoom, jnp.array([322.0, 178.0]), jnp.array([500.0, 1200.0]), SIZE, "px")


def path():
    return pan_and_zoom(lens(), FRAMES, pan=20, tilt=5)


def zoomjax(*arguments, cwd):
    return subprocess.run(
        [*COMMAND, *map(str, arguments)], capture_output=True, text=True, cwd=cwd, timeout=600
    )


def write_clip(file, images):
    with av.open(str(file), "w") as out:
        video = out.add_stream("libx264", rate=25)
        video.width, video.height, video.pix_fmt = *SIZE, "yuv420p"
        for image in images:
            frame = av.VideoFrame.from_ndarray(image, "bgr24")
            out.mux(video.encode(frame.reformat(format="yuv420p")))
        out.mux(video.encode(None))


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clip")
    write_clip(folder / "clip.mp4", motion_clip(lens(), *path(), noise=2).frames())
    return folder / "clip.mp4"


@pytest.fixture(scope="module")
def calibrated(clip):
    write_earlier(clip.parent / "out")
    done = zoomjax("calibrate", clip.name, "-o", "out", cwd=clip.parent)
    assert done.returncode == 0, done.stderr
    return clip.parent / "out", done


def track(folder):
    with (folder / "track.csv").open() as file:
        return {k: np.array(v, float) for k, v in zip_rows(csv.DictReader(file)).items()}


def zip_rows(rows):
    rows = list(rows)
    return {name: [row[name] for row in rows] for name in rows[0]}


@pytest.mark.slow
def test_a_clip_alone_gives_its_focal_lengths_and_its_lens(calibrated):
    folder, done = calibrated
    assert {file.name for file in folder.iterdir()} >= set(FILES)
    assert done.stdout.startswith("Good:")
    found, focal = track(folder), path()[0]
    assert abs(found["focal"] / focal - 1).max() < 0.005
    assert (abs(found["focal"] - focal) < 5 * found["sigma"]).mean() > 0.8
    np.testing.assert_allclose(found["frame"], np.arange(FRAMES))
    np.testing.assert_allclose(found["seconds"], np.arange(FRAMES) / 25, atol=1e-3)
    made, true = zj.load_lens(folder / "lens.json"), lens()
    points = np.random.default_rng(0).uniform(0, SIZE, (50, 2))
    for f in (510.0, 800.0, 1190.0):
        missed = np.asarray(made(f).undistort(points)) - np.asarray(true(f).undistort(points))
        assert np.hypot(*(missed - missed.mean(axis=0)).T).max() < 0.4
    assert np.asarray(made(510.0).centre) == pytest.approx(np.array([322, 178]), abs=1)


@pytest.mark.slow
def test_nothing_about_an_earlier_lens_stays(calibrated):
    assert still_earlier(calibrated[0]) == {"lines.npz"}


@pytest.mark.slow
def test_its_summary_says_what_it_found(calibrated):
    summary = json.loads((calibrated[0] / "summary.json").read_text())
    assert summary["verdict"] == "good"
    assert summary["warnings"] == []
    assert summary["frames"] == FRAMES
    assert summary["views_that_follow"] > 0.95
    assert summary["turned"][0] == pytest.approx(20, abs=1)
    assert summary["corner_displacement"][0]["px"] < -10


@pytest.mark.slow
def test_its_summary_has_the_entries_of_that_of_photos(calibrated, tmp_path):
    summary = summary_of(calibrated[0])
    scenes.board_lines(scenes.nikkor_18_200(), scenes.focal_sweep(5), spacing=60).save(tmp_path / "l.npz")
    done = zoomjax("calibrate", "l.npz", "--degree", 2, "--centre", "image", "-o", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    others = summary_of(tmp_path / "out")
    of_lines_alone = {
        *("evidence", "rms_algebraic", "rms_frames", "rms_held_out", "rms_frames_held_out"),
        *("rejected_lines", "rejected", "points", "frames_without_a_model", "next_photo", "earlier"),
        "rms_zoom_equal_weights",
    }
    assert others.keys() - summary.keys() == of_lines_alone
    for name in others.keys() & summary.keys() - {"line_noise"}:
        kinds = {type(of[name]) for of in (others, summary)}
        assert len(kinds) == 1, name
    assert others["centre"].keys() == summary["centre"].keys()
    assert others["certificate"].keys() == summary["certificate"].keys()
    assert summary["rms_none"] > 20 * summary["rms_zoom"] > 0
    assert summary["focal_known"]
    frames = summary["per_frame"]
    assert [row["frame"] for row in frames] == list(range(FRAMES))
    np.testing.assert_allclose([row["focal"] for row in frames], track(calibrated[0])["focal"], atol=1e-3)
    assert np.ptp([row["pan"] for row in frames]) == pytest.approx(summary["turned"][0])
    assert sum(row["views"] for row in frames) == summary["views"]


@pytest.mark.slow
def test_the_track_corrects_the_clip(clip, calibrated):
    arguments = ["undistort", "out/lens.json", clip.name, "--focal", "out/track.csv"]
    done = zoomjax(*arguments, "-o", "corrected.mp4", cwd=clip.parent)
    assert done.returncode == 0, done.stderr
    with av.open(str(clip.parent / "corrected.mp4")) as video:
        assert sum(1 for _ in video.decode(video=0)) == FRAMES


@pytest.mark.slow
def test_the_panorama_is_as_sharp_as_the_frames(calibrated):
    """The mean of frames that were put beside one another wrongly would be smooth."""
    panorama = cv2.imread(str(calibrated[0] / "panorama.jpg"), cv2.IMREAD_GRAYSCALE)
    assert panorama is not None
    height, width = panorama.shape
    middle = panorama[height // 3 : -height // 3, width // 3 : -width // 3].astype(float)
    assert np.abs(np.diff(middle, axis=1)).mean() > 4


@pytest.mark.slow
def test_frames_whose_f_is_not_known_are_told_and_left_out_of_the_panorama(clip, tmp_path):
    tracks = motion_tracks(lens(), *path(), views=60, life=12, noise=0.3, seed=1).tracks
    fit = fit_motion(tracks)
    gone = [12, 13, 14]
    unknown = eqx.tree_at(
        lambda fit: (fit.focal, fit.focal_std),
        fit,
        tuple(of.at[jnp.array(gone)].set(jnp.nan) for of in (fit.focal, fit.focal_std)),
    )
    times = np.column_stack([np.arange(FRAMES), np.arange(FRAMES) / 25])
    MotionCalibration(clip, tracks, unknown, times).write_track(tmp_path / "track.csv")
    with (tmp_path / "track.csv").open() as file:
        rows = list(csv.DictReader(file))
    sigma, focal = (np.array([float(row[name]) for row in rows]) for name in ("sigma", "focal"))
    others = np.isin(np.arange(FRAMES), gone, invert=True)
    np.testing.assert_allclose(sigma[others], np.asarray(fit.focal_std)[others], atol=1e-3)
    assert sigma[13] > sigma[12] > 2 * sigma[11]
    assert (abs(focal - np.asarray(fit.focal))[gone] < 2 * sigma[gone]).all()
    write_panorama(clip, unknown, tmp_path / "panorama.jpg")
    assert (tmp_path / "panorama.jpg").stat().st_size > 10_000


@pytest.mark.slow
def test_options_have_their_effect(clip, calibrated):
    folder, _ = calibrated
    options = ["--focal", "motion", "--centre", "image", "--degree", "1", "--quiet"]
    done = zoomjax("calibrate", clip.name, *options, "-o", "other", cwd=clip.parent)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) < 4
    first, other = (zj.load_lens(place / "lens.json") for place in (folder, clip.parent / "other"))
    assert other.shift is None
    assert first.shift is not None
    assert np.shape(other.zoom.parameters)[0] == 2
    assert "No focal lengths" not in done.stderr


@pytest.mark.slow
def test_a_clip_takes_another_distortion_model(clip, calibrated):
    options = ["--distortion-model", "division", "--terms", "1", "--degree", "1", "--quiet"]
    done = zoomjax("calibrate", clip.name, *options, "-o", "division", cwd=clip.parent)
    assert done.returncode == 0, done.stderr
    first, other = (zj.load_lens(clip.parent / place / "lens.json") for place in ("out", "division"))
    assert other.distortion_model == zj.models.Division()
    assert summary_of(clip.parent / "division")["distortion_model"] == "Division"
    points = np.array([[0, 0], [639, 0], [100, 300]])
    moved = [np.asarray(of(600.0).undistort(points)) - points for of in (first, other)]
    np.testing.assert_allclose(*moved, atol=1.5)
    assert np.hypot(*moved[1].T).max() > 5


TRIED = "No focal lengths are given (--focal): they and the lens are found from how clip.mp4 moves.\n"


@pytest.mark.slow
def test_that_motion_is_tried_is_said_at_the_start(calibrated):
    assert calibrated[1].stderr.startswith(TRIED)


@pytest.mark.slow
def test_what_is_wrong_with_the_file_is_in_all_results(clip):
    """Of fields, and at another rate than it was filmed at: every fifth frame is there twice."""
    with av.open(str(clip)) as given:
        frames = [frame.to_ndarray(format="bgr24") for frame in given.decode(video=0)]
    frames = [frames[n] for n in np.repeat(np.arange(FRAMES), [1, 1, 1, 1, 2] * 7 + [1])]
    options = {"flags": "+ildct", "x264-params": "tff=1"}
    write_frames(clip.with_name("fields.mp4"), frames, options=options)
    done = zoomjax("calibrate", "fields.mp4", "--json", "-o", "third", cwd=clip.parent)
    summary = json.loads(done.stdout)
    assert (summary["frames"], summary["repeated_frames"]) == (FRAMES + 7, 7)
    assert summary["verdict"] == "good"
    [finding] = summary["findings"]
    assert finding["found"].startswith("7 of 43 frames repeat the one before")
    found = track(clip.parent / "third")
    shown = path()[0][np.repeat(np.arange(FRAMES), [1, 1, 1, 1, 2] * 7 + [1])]
    assert abs(found["focal"] / shown - 1).max() < 0.005
    [warning] = summary["warnings"]
    assert warning.startswith("The video is interlaced")
    assert done.stderr.count(f"Warning: {warning}") == 1
    assert TRIED.partition(" (")[0] not in done.stderr
    page = (clip.parent / "third" / "report.html").read_text(encoding="utf-8")
    assert page.count("<aside><strong>Warning: </strong>The video is interlaced") == 1
    assert page.count("7 of 43 frames repeat the one before") == 1


def test_warnings_are_kept_and_shown_once():
    with warnings.catch_warnings(record=True) as shown, heard() as kept:
        warnings.simplefilter("always")
        for _ in range(2):
            warnings.warn("Argument focal is odd.", stacklevel=1)
        warnings.warn("Soon gone.", DeprecationWarning, stacklevel=1)
    assert kept == ["--focal is odd."]
    assert [str(one.message) for one in shown if one.category is UserWarning] == ["Argument focal is odd."]


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    """A clip that zooms and does not turn, calibrated with its lines alone, and with an f as well."""
    folder = tmp_path_factory.mktemp("still")
    focal, rotation = path()
    still = focal, np.broadcast_to(rotation[0], rotation.shape)
    frames = motion_clip(lens(), *still, noise=2).frames()
    write_clip(folder / "clip.mp4", [draw_bars(image, i, still) for i, image in enumerate(frames)])
    told = ["--known-focal", f"{focal[9] * 0.008:.4f}@9", "--pixel-pitch", 0.008, "--focal-sigma", "0.5%"]
    done = {}
    for name, options in {"alone": [], "told": told}.items():
        lines = ["--lines", "--frames", 9, "--overlays", "none"]
        done[name] = zoomjax("calibrate", "clip.mp4", *options, *lines, "-o", name, cwd=folder)
        assert done[name].returncode == 0, done[name].stderr
    return folder, done


def summary_of(folder):
    return json.loads((folder / "summary.json").read_text())


@pytest.mark.slow
def test_one_known_focal_length_gives_the_scale_that_a_still_camera_leaves_open(still):
    folder, done = still
    before, after = summary_of(folder / "alone"), summary_of(folder / "told")
    assert before["verdict"] == "not determined"
    advice = "--known-focal 24@0 --pixel-pitch 0.0055 if it is 24 mm in frame 0"
    assert advice in " ".join(done["alone"].stdout.split())
    assert before["focal_scale_std"] > 0.1
    about = {of["about"] for of in after["findings"]}
    assert about - {"repeated frames"} == {"lens"}  # the two frames at the end of the zoom are the same
    assert after["verdict"] == "doubtful"  # for lines are few at the corners
    assert after["focal_scale_std"] < 0.015
    [known] = after["known_focal"]
    assert known["frame"] == 9
    assert known["focal"] == pytest.approx(path()[0][9], rel=1e-4)
    assert known["sigma"] == pytest.approx(path()[0][9] / 200, rel=1e-4)
    found, focal = track(folder / "told"), path()[0]
    assert (abs(found["focal"] - focal) < 4 * found["sigma"]).all()
    assert abs(found["focal"] / focal - 1).max() < 0.005


def draw_board(image, focal, rotation):
    """A checkerboard of 9 x 6 squares that stands in the scene, turned by 35 degrees about the vertical."""
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    distortion = lens()(float(focal))
    straight = np.asarray(distortion.undistort(np.stack([x, y], -1).reshape(-1, 2).astype(float)))
    ahead = np.column_stack([(straight - np.asarray(distortion.centre)) / focal, np.ones(len(straight))])
    rays = ahead @ rotation
    across = np.array([np.cos(np.radians(35)), 0, np.sin(np.radians(35))])
    normal = np.array([-across[2], 0, across[0]])
    board = rays * (normal[2] / (rays @ normal))[:, None] - [0, 0, 1]
    u, v = board @ across / 0.037, board[:, 1] / 0.037
    dark = (np.floor(u) + np.floor(v)) % 2 == 1
    inside = (abs(u + 0.5) < 4.5) & (abs(v) < 3)
    near = (abs(u + 0.5) < 5) & (abs(v) < 3.5)
    grey = np.where(inside & dark, 20, 230)[:, None]
    drawn = np.where(near[:, None], grey, image.reshape(-1, 3)).reshape(image.shape)
    return cv2.GaussianBlur(drawn.astype(np.uint8), (0, 0), 0.7)


@pytest.mark.slow
def test_a_board_in_the_frames_gives_the_scale_that_a_still_camera_leaves_open(tmp_path):
    focal, rotation = path()[0], np.broadcast_to(np.eye(3), (FRAMES, 3, 3))
    frames = motion_clip(lens(), focal, rotation, noise=2).frames()
    write_clip(
        tmp_path / "clip.mp4", [draw_board(im, f, np.eye(3)) for im, f in zip(frames, focal, strict=True)]
    )
    lines = [
        "--lines",
        "--detector",
        "grid",
        "--frames",
        12,
        "--overlays",
        "none",
        "--known-focal",
        "plane",
    ]
    plan = zoomjax("calibrate", "clip.mp4", *lines, "--dry-run", "-o", "out", cwd=tmp_path)
    assert "whose plane tells f" in " ".join(plan.stdout.split())
    done = zoomjax("calibrate", "clip.mp4", *lines, "-o", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    summary = summary_of(tmp_path / "out")
    assert summary["focal_scale"] == "absolute"
    assert len(summary["known_focal"]) > 6
    assert summary["focal_scale_std"] < 0.03
    found = track(tmp_path / "out")
    assert abs(found["focal"] / focal - 1).max() < 0.03
    assert (abs(found["focal"] - focal) < 4 * found["sigma"]).all()


NO_SENSE = [
    (["--known-focal", "plane"], "--known-focal plane needs --lines --detector grid"),
    (
        ["--known-focal", "pitch", "--lines", "--detector", "grid"],
        "--known-focal pitch needs --lines --detector pitch",
    ),
    (
        ["--known-focal", "plane", "--known-focal", "9@0", "--lines", "--detector", "grid"],
        "--known-focal plane stands by itself",
    ),
    (
        ["--known-focal", "plane", "--lines", "--detector", "grid", "--pixel-pitch", "0.01"],
        "have no effect with --known-focal plane",
    ),
    (["--known-focal", "24@0"], "give --pixel-pitch"),
    (["--known-focal", "700@36", "--focal-unit", "px"], "frame 36, which the clip does not have"),
    (["--focal-sigma", "1%"], "--focal-sigma has no effect with --focal motion"),
    (["--focal", "30", "--known-focal", "24@0"], "--known-focal has no effect without --focal motion"),
]


@pytest.fixture(scope="module")
def told_of_no_sense(clip):
    commands = (["calibrate", clip.name, *options, "-o", "no"] for options, _ in NO_SENSE)
    return one_after_another(clip.parent, commands)


@pytest.mark.parametrize("number", range(len(NO_SENSE)))
def test_a_known_focal_length_that_makes_no_sense_is_refused(number, told_of_no_sense, clip):
    status, told = told_of_no_sense[number]
    assert status == 2
    assert NO_SENSE[number][1] in told
    assert not (clip.parent / "no").exists()


@pytest.mark.slow
def test_relative_focal_lengths_are_told_wherever_they_are(still):
    folder, done = still
    out = folder / "alone"
    assert summary_of(out)["focal_scale"] == "relative"
    assert (out / "track.csv").read_text().startswith("# Relative focal lengths: ")
    assert zj.load_lens(out / "lens.json").about["focal"] == "relative"
    assert "Focal lengths are relative" in done["alone"].stdout
    assert ", relative ·" in (out / "report.html").read_text(encoding="utf-8")
    assert summary_of(folder / "told")["focal_scale"] == "absolute"
    assert (folder / "told" / "track.csv").read_text().startswith("frame,seconds,")
    assert "focal" not in zj.load_lens(folder / "told" / "lens.json").about
    assert "relative" not in done["told"].stdout


@pytest.mark.slow
def test_relative_focal_lengths_straighten_their_own_clip(still):
    folder, _ = still
    arguments = ["undistort", "alone/lens.json", "clip.mp4", "--focal"]
    done = zoomjax(*arguments, "alone/track.csv", "-o", "corrected.mp4", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    found, true = read_focal_track(folder / "alone" / "track.csv"), lens()
    made = zj.load_lens(folder / "alone" / "lens.json")
    straight = np.stack([np.linspace(0, 640, 60), np.linspace(20, 70, 60)], axis=-1)
    for frame in (0, 9, 20, FRAMES - 1):
        bent = np.asarray(true(float(path()[0][frame])).distort(straight))
        own = np.asarray(made(found.at(frame, 0.0)).undistort(bent))
        assert off_straight(own) < max(0.15 * off_straight(bent), 0.1)
    done = zoomjax(*arguments, "900", "-o", "other.mp4", cwd=folder)
    assert "Warning: The focal lengths of this lens are relative" in done.stderr
    done = zoomjax(
        "undistort", "told/lens.json", "clip.mp4", "--focal", "alone/track.csv", "-o", "x.mp4", cwd=folder
    )
    assert "Warning: The focal lengths of alone/track.csv are relative" in done.stderr
    export = ["export", "alone/lens.json", "--to", "opencv", "--focal", "900", "-o", "a.yaml"]
    assert "focal lengths of this lens are relative" in zoomjax(*export, cwd=folder).stderr


def off_straight(points):
    """RMS distance of points from a straight line, px."""
    return np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[-1] / np.sqrt(len(points))


def draw_bars(image, index, where=None):
    """Dark bars that stand in the scene, straight in the world."""
    focal, rotation = (leaf[index] for leaf in where or path())
    distortion = lens()(float(focal))
    rng = np.random.default_rng(7)
    for ends in np.concatenate([rng.uniform(-0.6, 0.6, (30, 2, 2)), np.ones((30, 2, 1))], axis=2):
        a, b = ends @ rotation.T
        ahead = a + np.linspace(0, 1, 400)[:, None] * (b - a)
        straight = np.asarray(distortion.centre) + focal * ahead[:, :2] / ahead[:, 2:]
        bent = np.asarray(distortion.distort(straight))
        bent = bent[np.isfinite(bent).all(axis=1) & (abs(bent) < 2000).all(axis=1)]
        at = np.rint(16 * bent).astype(np.int32)
        cv2.polylines(image, [at], False, rng.uniform(0, 40, 3).tolist(), 5, cv2.LINE_AA, 4)
    return image


@pytest.mark.slow
def test_lines_of_the_frames_join_if_wanted(tmp_path):
    frames = [draw_bars(im, i) for i, im in enumerate(motion_clip(lens(), *path(), noise=2).frames())]
    write_clip(tmp_path / "clip.mp4", frames)
    for options in (["-o", "out"], ["--lines", "--frames", 9, "-o", "lined"]):
        done = zoomjax("calibrate", "clip.mp4", *options, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    without, summary = (
        json.loads((tmp_path / folder / "summary.json").read_text()) for folder in ("out", "lined")
    )
    assert without["lines"] == 0
    assert summary["lines"] > 30
    assert summary["line_noise"] < 0.3
    assert summary["verdict"] == "good"
    assert f"{summary['lines']} straight lines in 9 of them" in done.stdout
    assert summary["detector"] == "edges"
    assert without["detector"] is None
    assert summary["focal_scale_std"] < without["focal_scale_std"]
    assert abs(track(tmp_path / "lined")["focal"] / path()[0] - 1).max() < 0.005
    lines_and_pictures_are_those_of_photos(tmp_path / "lined", summary)
    done = zoomjax("calibrate", "lined", "--degree", 2, "--centre", "image", "-o", "again", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    again = summary_of(tmp_path / "again")
    assert again["lines"] == summary["lines"]
    assert again["per_frame"][0]["focal_sigma"] == pytest.approx(summary["images"][0]["focal_sigma"])


def lines_and_pictures_are_those_of_photos(folder, summary):
    lines = zj.lines.load_lines(folder / "lines.npz")
    assert len(lines.frame) == summary["lines"]
    found, frames = track(folder), [0, 4, 9, 13, 18, 22, 26, 31, 35]
    np.testing.assert_allclose(lines.focal, found["focal"][frames], rtol=1e-5)
    names = [f"clip-{number:06d}.jpg" for number in frames]
    assert [row["name"] for row in summary["images"]] == names
    assert [row["focal"] for row in summary["images"]] == pytest.approx(np.asarray(lines.focal))
    assert sum(row["lines"] for row in summary["images"]) == summary["lines"]
    pictures = sorted(path.name for path in (folder / "lines").iterdir())
    assert pictures == [f"{place:04d}-{name}" for place, name in enumerate(names, start=1)]
    picture = cv2.imread(str(folder / "lines" / pictures[0]))
    assert picture is not None
    assert picture.shape[0] > SIZE[1]  # there is a legend below
    assert 0 <= summary["rejected_lines"] == len(summary["rejected"]) < summary["lines"] / 10


def test_lines_are_an_option_of_motion_alone(clip):
    done = zoomjax("calibrate", clip.name, "--focal", "30", "--lines", "-o", "no", cwd=clip.parent)
    assert done.returncode != 0
    assert "--lines has no effect without --focal motion" in done.stderr


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (
            "--robust --focal-unit mm --overlays all",
            "--robust and --focal-unit and --overlays have no effect",
        ),
        ("--detector grid --no-cache", "--detector and --no-cache have no effect without --lines"),
        ("--focal motion --spacing 3", "--spacing has no effect with --focal motion"),
        ("--jobs 1 --frames 9", "--frames and --jobs have no effect without --lines"),
    ],
)
def test_an_option_without_effect_is_refused(clip, options, sentence):
    done = zoomjax("calibrate", clip.name, *options.split(), "-o", "no", cwd=clip.parent)
    assert done.returncode == 2
    assert sentence in done.stderr


@pytest.mark.slow
def test_a_clip_that_does_not_move_is_refused(clip, tmp_path):
    with decode_video(clip) as (_, frames):
        first = next(iter(frames))[2]()
    write_clip(tmp_path / "still.mp4", [first] * 8)
    done = zoomjax("calibrate", "still.mp4", "-o", "out", cwd=tmp_path)
    assert done.returncode == 2
    assert "still.mp4 shows 1 frame and copies: f is found from how it moves" in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_dry_run_writes_nothing(clip):
    done = zoomjax("calibrate", clip.name, "-o", "dry", "--dry-run", cwd=clip.parent)
    assert "Nothing was written" in done.stdout
    told = zoomjax("calibrate", clip.name, "-o", "dry", "--dry-run", "--json", cwd=clip.parent)
    assert json.loads(told.stdout) == {"plan": done.stdout.splitlines()[:1], "output": "dry"}
    assert not (clip.parent / "dry").exists()


@pytest.mark.parametrize(
    ("inputs", "options", "message"),
    [
        (["a.jpg"], {}, "one video"),
        (["a.mp4", "b.mp4"], {}, "one video"),
        (["a.mp4"], {"centre": (3.0, 4.0)}, "--centre is fit or image"),
        (["a.mp4"], {"model": WantedModel(distortion_model="auto")}, "--distortion-model names one"),
        (
            ["a.mp4"],
            {"model": WantedModel(distortion_model="brown-conrady"), "lines": True},
            "With --lines, --distortion-model is radial or division",
        ),
    ],
)
def test_mistakes_are_told(tmp_path, inputs, options, message):
    settings = {"model": WantedModel(), "centre": "fit"} | options
    with pytest.raises(ValueError, match=message):
        ClipJob(inputs, tmp_path, **settings)


def test_motion_is_tried_where_nothing_else_is_given():
    assert wants_motion(["a.mp4"], None, None)
    assert wants_motion(["a.mp4"], "motion", None)
    assert not wants_motion(["a.mp4"], "track.csv", None)
    assert not wants_motion(["a.mp4"], None, "30")
    assert not wants_motion(["a.jpg"], None, None)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Dropped", "ignore:.*known focal lengths contradict")
@pytest.mark.parametrize(
    ("kind", "verdict", "finding"),
    [
        ("still", "not determined", "hardly turns"),
        ("still, an f", "not determined", "moves a corner of the image by up to"),
        ("one zoom", "good", "hardly changes"),
        ("moving", "not determined", "moves by itself"),
        ("cut", "good", "1 cut"),
        ("cut, then at rest", "doubtful", "cuts part them from the others: the scale"),
        ("pupil", "doubtful", "its entrance pupil is off the axis"),
        ("little turning", "doubtful", "have a common factor that is known to"),
        ("dark", "good", "3 frames show nothing that can be followed: frames 20 to 22."),
        ("darker", "doubtful", "12 of 36 frames show nothing"),
        ("middle", "not determined", "moves a corner of the image by up to"),
        ("wrong f", "doubtful", "px is given"),
        ("x for y", "doubtful", "of the points lie outside of the image of 640 x 360 px"),
    ],
)
def test_what_the_clip_cannot_tell_is_said(tmp_path, kind, verdict, finding):
    from zoomjax.tracks import Tracks

    focal, rotation = path()
    if kind.startswith("still"):
        rotation = np.broadcast_to(rotation[0], rotation.shape)
    if kind == "cut, then at rest":
        rotation = np.concatenate(
            [rotation[: FRAMES // 2], [rotation[FRAMES // 2]] * (FRAMES - FRAMES // 2)]
        )
    if kind == "one zoom":
        focal = np.full(FRAMES, 600.0)
    if kind == "little turning":
        focal, rotation = pan_and_zoom(lens(), FRAMES, pan=4, tilt=0)
    more = {"moving": {"moving": 0.8}, "pupil": {"pupil": 0.5}, "little turning": {"noise": 0.5}}.get(
        kind, {}
    )
    options = {"views": 80, "life": 15, "noise": 0.1} | more
    tracks = motion_tracks(lens(), focal, rotation, **options).tracks
    if kind == "x for y":
        track, frame, points = tracks.views()
        with pytest.warns(UserWarning, match="points lie outside"):
            tracks = Tracks.from_arrays(track, frame, points[:, ::-1], image_size=SIZE, frames=FRAMES)
    if kind in ("dark", "darker", "middle"):
        track, frame, points = tracks.views()
        seen = {
            "dark": (frame < 20) | (frame > 22),
            "darker": frame % 3 != 1,
            "middle": np.hypot(*(points - np.array(SIZE) / 2).T) < 130,
        }[kind]
        tracks = Tracks.from_arrays(track[seen], frame[seen], points[seen], image_size=SIZE, frames=FRAMES)
    if kind.startswith("cut"):
        track, frame, points = tracks.views()
        tracks = Tracks.from_arrays(
            2 * track + (frame >= FRAMES // 2), frame, points, image_size=SIZE, frames=FRAMES
        )
    told = {"wrong f": [f"{focal[5]}@5", f"{1.1 * focal[30]}@30"], "still, an f": [f"{focal[5]}@5"]}
    known = known_focals(told[kind], unit="px") if kind in told else None
    if known is None:
        fit = fit_motion(tracks, throw=False)
    else:
        of_frames = known.of_frames(np.arange(float(FRAMES)))
        fit = fit_motion(tracks, focal=of_frames[0], focal_std=of_frames[1], throw=False)
    times = np.column_stack([np.arange(FRAMES), np.arange(FRAMES) / 25])
    done = MotionCalibration(tmp_path / "clip.mp4", tracks, fit, times, known=known)
    assert any(finding in sentence for sentence in map(str, done.findings)), done.findings
    assert done.verdict == verdict


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Dropped")
@pytest.mark.parametrize("seed", [3, 4])
def test_things_that_move_and_pass_for_noise_are_told(tmp_path, seed):
    """Four of five points are on things that move slowly: most of them follow by that little."""
    long_lens = zj.ZoomLens(
        zj.PolynomialZoom(2, jnp.array([[0.02, 0.0], [-0.05, 0.01], [-0.15, 0.05]]), jnp.array(800.0)),
        jnp.array([645.0, 356.0]),
        jnp.array([800.0, 2400.0]),
        (1280, 720),
        "px",
    )
    where = pan_and_zoom(long_lens, 24, pan=25, tilt=6, seed=seed)
    scene = motion_tracks(long_lens, *where, views=60, life=12, noise=0.3, moving=0.8, seed=seed)
    fit = fit_motion(scene.tracks, throw=False)
    done = MotionCalibration(tmp_path / "clip.mp4", scene.tracks, fit, np.zeros((24, 2)))
    assert done.following() > 0.6
    assert any("may be on things that move" in str(finding) for finding in done.findings)
    assert done.verdict != "good"


def test_the_command_that_corrects_a_clip_can_be_pasted():
    lens, clip, track = Path("my lens/lens.json"), "it's a clip.mp4", Path("my lens/track.csv")
    told = shlex.split(correction_command(lens, clip, track=track))
    assert told[:4] == ["zoomjax", "undistort", str(lens), clip]
    assert told[4:] == ["--focal", str(track), "-o", "corrected.mp4"]


def test_results_of_a_clip_without_lines_are_refused_as_such(tmp_path):
    for name in ("lens.json", "summary.json", "tracks.npz", "track.csv", "panorama.jpg", "motion.png"):
        (tmp_path / name).touch()
    with pytest.raises(ValueError, match=r"results of a clip without lines, .* with --lines"):
        results_of(str(tmp_path))
    photo = tmp_path / "a.jpg"
    photo.touch()
    assert results_of(str(tmp_path)) is None
    assert results_of(str(tmp_path / "*.jpg")) is None
    assert results_of(str(photo)) is None
    (tmp_path / "lines.npz").touch()
    assert results_of(str(tmp_path)) == tmp_path / "lines.npz"
