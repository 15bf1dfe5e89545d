"""The command line, run as a user runs it: in a process of its own, on files."""

import contextlib
import importlib.metadata
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes
from zoomjax.app import console
from zoomjax.app._flags import with_flags
from zoomjax.app.arguments import centre_of, read_lines
from zoomjax.app.console import show_choice, stages
from zoomjax.app.demo import write_photos
from zoomjax.app.image_job import ImageJob
from zoomjax.app.model_choice import WantedModel
from zoomjax.app.runs import calibrate_lines
from zoomjax.lines.csv import write_lines_csv
from zoomjax.models import BrownConrady, Model, PolynomialZoom, SmoothZoom, SplineZoom
from zoomjax.trust.comparison import ComparedModel
from zoomjax.trust.selection import Selection

from .._clips import lens
from .._commands import COMMAND, INTERRUPTIBLE, one_after_another, still_earlier, write_earlier


def zoomjax(*arguments, cwd=None):
    return subprocess.run(
        [*COMMAND, *map(str, arguments)], capture_output=True, text=True, cwd=cwd, timeout=300
    )


@pytest.fixture(scope="module")
def few_lines():
    """The paper's board at five focal lengths, 40 px between points."""
    return scenes.board_lines(scenes.nikkor_18_200(), scenes.focal_sweep(5), spacing=40, noise=0.3)


FORCED = ("--degree", 2, "--centre", "image")  # nothing is chosen: faster, and what the library does


@pytest.fixture(scope="module")
def calibrated(few_lines, tmp_path_factory):
    folder = tmp_path_factory.mktemp("calibrated")
    few_lines.save(folder / "lines.npz")
    done = zoomjax("calibrate", folder / "lines.npz", "-o", folder / "out", *FORCED)
    assert done.returncode == 0, done.stderr
    return folder / "out", done


@pytest.mark.slow
def test_nothing_about_an_earlier_lens_stays_beside_a_new_one(calibrated, tmp_path):
    """A report, or a panorama, of another lens would be taken for that of this one."""
    folder, _ = calibrated
    for name in ("again", "out"):
        write_earlier(tmp_path / name)
    done = zoomjax("calibrate", folder / "lines.npz", "-o", tmp_path / "again", *FORCED)
    assert done.returncode == 0, done.stderr
    assert still_earlier(tmp_path / "again") == {"tracks.npz", "track.csv"}
    options = ("--to", "lensfun", "--pixel-pitch", 0.005)
    assert zoomjax("export", folder / "lens.json", *options, "-o", tmp_path / "a.xml").returncode == 0
    size = "x".join(str(side) for side in zj.load_lens(folder / "lens.json").image_size)
    done = zoomjax("import", tmp_path / "a.xml", "--image-size", size, "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert still_earlier(tmp_path / "out") == {"lines.npz", "tracks.npz", "track.csv"}


def test_help_does_not_wait_for_jax():
    probe = "import sys; sys.argv = ['zoomjax', '--help']\nfrom zoomjax.app.cli import main\n"
    probe += "try:\n    main()\nexcept SystemExit:\n    pass\nassert 'jax' not in sys.modules"
    start = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "calibrate" in done.stdout
    assert time.perf_counter() - start < 30  # the figure itself is measured, not tested


@pytest.mark.slow
def test_calibrate_writes_all_results(calibrated, few_lines):
    out, done = calibrated
    expected = [".zoomjax.json", "lens.json", "lines.npz", "model.png", "report.html", "summary.json"]
    assert sorted(p.name for p in out.iterdir()) == expected
    summary = json.loads((out / "summary.json").read_text())
    assert summary["frames"] == 5
    assert summary["lines"] == len(few_lines.frame)
    assert summary["points"] == int(few_lines.mask.sum())
    assert summary["focal_range"] == pytest.approx([20.56, 127.36])
    assert summary["result"] == "successful"
    assert summary["rms_frames"] <= summary["rms_zoom"] < 0.35 < summary["rms_none"]
    assert f"{summary['rms_zoom']:.4f}" in done.stdout


STAGE = re.compile(r"  \S.* +\d+\.\d\d s|  … \S.*, for \d+ s so far")


@pytest.mark.exhaustive
def test_on_a_fresh_machine_a_terminal_shows_nothing_but_stages(few_lines, tmp_path):
    """All of stderr: with nothing kept, and with what was compiled damaged."""
    few_lines.save(tmp_path / "lines.npz")
    (tmp_path / "home").mkdir()
    kept = tmp_path / "home" / ".cache" / "zoomjax" / "compiled"
    own = {"HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "MPLCONFIGDIR", "ZOOMJAX_CACHE"}
    bare = {name: value for name, value in os.environ.items() if name not in own}
    bare["HOME"] = str(tmp_path / "home")
    for _ in range(2):
        done = subprocess.run(
            [*COMMAND, "calibrate", "lines.npz", "-o", "out"],
            capture_output=True, text=True, cwd=tmp_path, timeout=600, env=bare,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert [line for line in done.stderr.splitlines() if not STAGE.fullmatch(line)] == []
        # Those cut off were made again, but for small ones that tracing needed the first time only.
        programs = [file for file in kept.glob("*-cache") if file.stat().st_size > 100]
        assert len(programs) > 3
        for file in programs:
            file.write_bytes(b"cut off")


def test_every_package_that_a_command_needs_is_declared():
    """JAX keeps nothing compiled, and complains at each program, where filelock is missing."""
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    assert any(line.startswith("filelock") for line in project["optional-dependencies"]["app"])


def test_calibrate_gives_the_lens_that_the_library_gives(calibrated, few_lines):
    out, _ = calibrated
    lens = zj.load_lens(out / "lens.json")
    fit = zj.fit_zoom(zj.fit.in_image(zj.compress(few_lines)))
    np.testing.assert_allclose(lens.zoom.parameters, fit.lens.zoom.parameters, atol=1e-9)
    np.testing.assert_array_equal(zj.load_lines(out / "lines.npz").points, few_lines.points)


@pytest.mark.slow
def test_calibrate_is_told_centre_and_model(calibrated, tmp_path):
    source, given = (
        calibrated[0] / "lines.npz",
        ("--centre", "2150,1420", "--model", "spline", "--terms", 1),
    )
    done = zoomjax("calibrate", source, "-o", tmp_path, *given)
    assert done.returncode == 0, done.stderr
    assert "The centre of distortion is taken as given: (2150.0, 1420.0) px." in done.stdout
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["model"] == "SplineZoom"
    assert "selection" not in summary
    assert summary["centre"]["how"] == "given"
    lens = zj.load_lens(tmp_path / "lens.json")
    np.testing.assert_allclose(lens.centre, [2150, 1420])
    assert lens(50.0).coefficients.shape == (1,)
    default = json.loads((calibrated[0] / "summary.json").read_text())
    assert default["centre"]["how"] == "image"
    assert (default["centre"]["x"], default["centre"]["y"]) == (2143.5, 1423.5)


def test_centres_are_read():
    assert [centre_of(text) for text in ("fit", "image", "959.5,-1e1")] == ["fit", "image", (959.5, -10.0)]
    for text in ("", "1", "1,2,3", "nan,1", "a,b"):
        with pytest.raises(ValueError, match="must be fit, moving, image, or X,Y"):
            centre_of(text)


@pytest.mark.slow
def test_calibrate_allows_for_uncertain_focal_lengths(calibrated, tmp_path):
    exact = json.loads((calibrated[0] / "summary.json").read_text())
    done = zoomjax("calibrate", calibrated[0] / "lines.npz", "-o", tmp_path, *FORCED, "--focal-sigma", "1%")
    assert done.returncode == 0, done.stderr
    assert "include those of the focal lengths, 1.00%," in done.stdout
    told = json.loads((tmp_path / "summary.json").read_text())
    assert [row["focal_sigma"] / row["focal"] for row in told["per_frame"]] == pytest.approx([0.01] * 5)
    assert told["corner_displacement"][0]["std"] > 2 * exact["corner_displacement"][0]["std"]
    np.testing.assert_allclose(told["parameters"], exact["parameters"])
    refused = zoomjax(
        "calibrate", calibrated[0] / "lines.npz", "-o", tmp_path / "no", "--focal-sigma", "a bit"
    )
    assert refused.returncode == 2
    assert "--focal-sigma must be a number such as 0.3, or 1%" in refused.stderr


@pytest.mark.slow
def test_lines_are_fitted_again_where_they_are(calibrated, tmp_path):
    """A folder of results stands for its lines, which stay as they are; overlays of the fit before go."""
    folder = tmp_path / "mylens"
    shutil.copytree(calibrated[0], folder)
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    done = zoomjax(
        "calibrate", folder, "-o", folder, "--exclude", "0,7", "--degree", 1, "--centre", "image"
    )
    assert done.returncode == 0, done.stderr
    after = {file.name: file.read_bytes() for file in folder.iterdir()}
    assert set(after) == set(before)
    assert after["lines.npz"] == before["lines.npz"]
    assert after["lens.json"] != before["lens.json"]
    old, new = (json.loads(content["summary.json"]) for content in (before, after))
    assert new["rms_none"] != old["rms_none"]  # without two lines
    assert f" lines, {len(new['rejected'])} left out, in " in done.stdout
    assert len(new["parameters"]) < len(old["parameters"])
    again = zoomjax("calibrate", "lines.npz", "-o", ".", "--dry-run", cwd=folder)
    assert again.returncode == 0, again.stderr
    other = zoomjax("calibrate", folder, "-o", tmp_path / "new", *FORCED)
    assert other.returncode == 0, other.stderr
    assert "count again: 0, 7." in " ".join(other.stdout.split())
    assert json.loads((tmp_path / "new" / "summary.json").read_text())["parameters"] == old["parameters"]


def test_files_of_lines_are_read_one_after_the_other(few_lines, tmp_path):
    ragged, frame = few_lines.to_ragged(), np.asarray(few_lines.frame)
    for name, frames in (("a", [0, 1]), ("b", [2, 3, 4])):
        some = np.flatnonzero(np.isin(frame, frames))
        zj.Lines.from_ragged(
            [ragged[n] for n in some],
            frame[some] - frames[0],
            few_lines.focal[np.array(frames)],
            image_size=few_lines.image_size,
        ).save(tmp_path / f"{name}.npz")
    both = read_lines([tmp_path / "a.npz", tmp_path / "b.npz"], None, None, None)
    np.testing.assert_array_equal(both.focal, few_lines.focal)
    np.testing.assert_array_equal(both.frame, few_lines.frame)
    np.testing.assert_array_equal(np.concatenate(both.to_ragged()), np.concatenate(ragged))
    line = np.stack([np.arange(9.0), np.full(9, 3.0)], axis=-1)
    zj.Lines.from_ragged([line], [0], [24.0], image_size=(640, 480)).save(tmp_path / "c.npz")
    with pytest.raises(
        ValueError, match=r"The files of lines must hold .* size of .*a\.npz is .*c\.npz is"
    ):
        read_lines([tmp_path / "a.npz", tmp_path / "b.npz", tmp_path / "c.npz"], None, None, None)


@pytest.mark.parametrize("place", ["the lines", "a table of focal lengths", "the track of a video"])
def test_a_column_of_standard_deviations_that_would_not_count_is_refused(place, tmp_path):
    rows = [f"0,{line},{x},{40 * line},24,0.5" for line in (1, 2) for x in range(5)]
    beside, lines, focal = tmp_path / "f.csv", tmp_path / "lines.csv", tmp_path / "f.csv"
    beside.write_text("Frame;FOCAL; Sigma\n0;24;0,5\n")
    if place == "the lines":
        lines.write_text("\n".join(["frame,line,x,y,focal,sigma", *rows]))
        focal = None
    else:
        lines.write_text("\n".join(["frame,line,x,y", *(row.rsplit(",", 2)[0] for row in rows)]))

    def read(sigma):
        given = None if focal is None else str(focal)
        if place == "the track of a video":
            return ImageJob((str(tmp_path / "a.mp4"),), focal=given, focal_sigma=sigma)
        return read_lines([lines], given, "640x480", None, sigma)

    with pytest.raises(ValueError, match=r"The column sigma of .*\.csv would not count") as refused:
        read(None)
    assert with_flags(str(refused.value)).endswith(
        "such as 2.1%, as most of it says, or 0 for focal lengths that are exact."
    )
    assert read("0") is not None


def test_a_track_in_the_unit_of_the_lens_beside_it_is_in_no_other(tmp_path):
    """The track of a clip that was calibrated by itself is in px, and was taken for mm."""
    lens().save(tmp_path / "lens.json")  # in mm
    track = tmp_path / "track.csv"
    track.write_text("frame,focal\n0,500\n9,900\n")

    def job(unit, focal=track):
        return ImageJob((str(tmp_path / "a.mp4"),), focal=str(focal), focal_unit=unit)

    assert job("mm").focal == str(track)
    with pytest.raises(ValueError, match=r"track\.csv are in mm, .*: give argument focal_unit mm"):
        job("px")
    other = track.rename(tmp_path / "own.csv")
    assert job("px", other).focal == str(other)


@pytest.mark.slow
def test_calibrate_reads_csv(calibrated, few_lines, tmp_path):
    write_lines_csv(few_lines, tmp_path / "lines.csv")
    size = ("--image-size", "4288x2848")
    done = zoomjax("calibrate", tmp_path / "lines.csv", *size, "-o", tmp_path, *FORCED)
    assert done.returncode == 0, done.stderr
    of_csv = json.loads((tmp_path / "summary.json").read_text())
    of_npz = json.loads((calibrated[0] / "summary.json").read_text())
    assert of_csv["rms_zoom"] == pytest.approx(of_npz["rms_zoom"], rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("given", "unit", "known", "focal"),
    [("35", None, True, 35.0), ("1200", "px", True, 1200.0), ("same", None, False, 1.0)],
)
def test_csv_lines_of_one_zoom_need_one_focal_length_or_none(
    given, unit, known, focal, few_lines, tmp_path
):
    (tmp_path / "lines.csv").write_text(
        "frame,line,x,y\n"
        + "".join(
            f"{frame},{number},{x!r},{y!r}\n"
            for number, line in enumerate(few_lines.to_ragged())
            if (frame := int(few_lines.frame[number])) < 2
            for x, y in line[::4].tolist()
        )
    )
    out = tmp_path / "out"
    out.mkdir()
    file = tmp_path / "lines.csv"
    lines = read_lines([file], given, "4288x2848", unit)
    assert np.asarray(lines.focal).tolist() == [focal, focal]
    assert lines.focal_unit == (unit or "mm")
    calibrate_lines(
        lines,
        out,
        lambda _: None,
        model=WantedModel("polynomial", degree=0),
        centre="image",
        focal_sigma=None,
        robust=False,
        files=[file],
        names=["lines.npz"],
        focal_known=given != "same",
    )
    summary = json.loads((out / "summary.json").read_text())
    assert summary["focal_known"] is known
    assert summary["focal_range"] == [focal, focal]
    about = zj.load_lens(out / "lens.json").about
    assert (about.get("focal") == "not known") is not known


@pytest.mark.slow
def test_the_command_takes_one_zoom_of_csv_lines(few_lines, tmp_path):
    rows = "".join(
        f"0,{n},{x!r},{y!r}\n"
        for n, line in enumerate(few_lines.to_ragged()[:40])
        for x, y in line.tolist()
    )
    (tmp_path / "lines.csv").write_text(f"frame,line,x,y\n{rows}")
    size = ("--image-size", "4288x2848")
    done = zoomjax("calibrate", "lines.csv", *size, "--focal", "same", "-o", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["focal_known"] is False
    assert "focal length not known" in done.stdout


@pytest.mark.exhaustive
def test_demo_photographs_the_board_and_finds_the_papers_lens(tmp_path):
    """And calibrating its photographs again takes what was found in them from the cache."""
    done = zoomjax("demo", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    out = tmp_path / "zoomjax-demo"
    summary = json.loads((out / "summary.json").read_text())
    assert (summary["frames"], summary["image_size"]) == (12, [2144, 1424])
    assert summary["rms_zoom"] / summary["rms_frames"] - 1 < 0.015
    assert (out / "model.png").stat().st_size > 10_000
    assert (out / "before-after.jpg").stat().st_size > 10_000
    photos = sorted((out / "photos").iterdir())
    assert [p.name for p in photos] == [p.name[5:] for p in sorted((out / "lines").iterdir())]
    lens, truth = zj.load_lens(out / "lens.json"), scenes.nikkor_18_200((2144, 1424))
    for f in (20.56, 35.0, 127.36):
        error = lens(f).undistort(np.zeros(2)) - truth(f).undistort(np.zeros(2))
        assert np.abs(error).max() < 0.1
    assert "Largest error of the calibrated lens" in done.stdout


@pytest.mark.slow
def test_calibrate_takes_photographs(tmp_path, monkeypatch):
    """Two processes, one bad file, the default source of focal lengths; then once more, from the cache."""
    monkeypatch.setenv("ZOOMJAX_CACHE", str(tmp_path / "cache"))
    write_photos(tmp_path / "shots", number=4, image_size=(1072, 712))
    (tmp_path / "shots" / "broken.jpg").write_bytes(b"")
    done = zoomjax("calibrate", "shots", "-o", "out", "--jobs", "2", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Focal lengths: EXIF data." in done.stdout
    assert "1 of 5 images are not used" in done.stderr
    assert "broken.jpg" in done.stderr
    first = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert first["focal_range"] == pytest.approx([20.56, 127.36])
    assert len(list((tmp_path / "out" / "lines").iterdir())) == first["frames"] == 4
    pictures = re.findall(r'href="(lines/[^"]+)"', (tmp_path / "out" / "report.html").read_text())
    assert len(pictures) == 4
    assert all((tmp_path / "out" / picture).is_file() for picture in pictures)
    cached = {p: p.stat().st_mtime_ns for p in (tmp_path / "cache" / "detections").iterdir()}
    assert len(cached) == 4
    again = zoomjax("calibrate", "shots/*.jpg", "-o", "again", cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "cache" / "detections").iterdir()} == cached
    assert json.loads((tmp_path / "again" / "summary.json").read_text())["rms_zoom"] == first["rms_zoom"]


@pytest.mark.slow
def test_the_verdict_is_the_first_line_and_decides_strict_runs(calibrated, tmp_path):
    out, done = calibrated
    summary = json.loads((out / "summary.json").read_text())
    assert next(iter(summary)) == "verdict"
    assert summary["verdict"] == "good"
    assert done.stdout.split("\n")[0].startswith("Good: ")
    t = np.linspace(-200, 200, 50)
    radial = [np.stack([319.5 + t * c, 239.5 + t * s], -1) for c, s in ((1, 0), (0, 1), (0.6, 0.8))]
    lines = zj.Lines.from_ragged(radial * 3, np.repeat([0, 1, 2], 3), [20, 40, 80], image_size=(640, 480))
    lines.save(tmp_path / "lines.npz")
    strict = zoomjax("calibrate", "lines.npz", "-o", "out", "--strict", "--quiet", cwd=tmp_path)
    assert strict.returncode == 3
    assert strict.stdout.startswith("Not determined: ")
    assert not STAGE.search(strict.stderr)
    assert (tmp_path / "out" / "lens.json").exists()


@pytest.mark.slow
def test_results_as_json_are_the_summary(calibrated, tmp_path):
    source = calibrated[0] / "lines.npz"
    options = ("--json", "--strict", "--exclude", "0,2", *FORCED)
    done = zoomjax("calibrate", source, "-o", tmp_path / "o", *options)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary == json.loads((tmp_path / "o" / "summary.json").read_text())
    assert [row["line"] for row in summary["rejected"]] in ([0, 2], [2, 0])


@pytest.mark.slow
def test_a_dry_run_writes_nothing(calibrated, tmp_path):
    write_photos(tmp_path / "shots", number=3, image_size=(268, 178))
    done = zoomjax("calibrate", "shots", "-o", "out", "--dry-run", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "3 photos, by the detector edges:" in done.stdout
    assert "20.56 mm" in done.stdout
    assert not (tmp_path / "out").exists()
    told = zoomjax("calibrate", "shots", "-o", "out", "--dry-run", "--json", cwd=tmp_path)
    plan = json.loads(told.stdout)
    assert plan["plan"] == [line.strip() for line in done.stdout.splitlines()[:-1]]
    assert plan["output"] == "out"
    done = zoomjax("calibrate", calibrated[0] / "lines.npz", "-o", tmp_path / "o", "--dry-run")
    assert "lines in 5 frames, f = 20.56 to 127.36 mm" in done.stdout
    assert not (tmp_path / "o").exists()
    assert done.stderr == ""
    for inputs in ("shots", calibrated[0] / "lines.npz"):
        done = zoomjax("calibrate", inputs, "--centre", "5000,90", "-o", "o", "--dry-run", cwd=tmp_path)
        assert done.returncode == 0
        assert done.stderr.count("The centre of distortion, (5000, 90) px, is outside of the image of") == 1
    photos = sorted((tmp_path / "shots").iterdir())
    (tmp_path / "f.csv").write_text(f"image,focal\n{photos[0].name},50\n{photos[2].name},70.5\n")
    done = zoomjax("calibrate", "shots", "--focal", "f.csv", "-o", "out", "--dry-run", cwd=tmp_path)
    told = [line.split(": ")[1] for line in done.stdout.splitlines()[1:4]]
    assert told == ["50 mm", "not used, as f.csv has no row for it", "70.5 mm"]


def test_help_has_examples_and_fits_a_terminal():
    for command in ("calibrate", "undistort", "demo", "reproduce"):
        done = subprocess.run(
            [*COMMAND, command, "--help"],
            capture_output=True,
            text=True,
            env=os.environ | {"COLUMNS": "80"},
        )
        assert f"zoomjax {command} " in done.stdout[done.stdout.index("Example") :]
        assert max(map(len, done.stdout.splitlines())) <= 80


ALL_HELP = """
import json, typer
from typer.testing import CliRunner
from zoomjax.app import cli
names = typer.main.get_command(cli.app).commands
print(json.dumps({name: CliRunner().invoke(cli.app, [name, "--help"]).output for name in names}))
"""


def test_help_tells_choices_and_no_python_types():
    """All commands in one process, without the checks of types that tests add."""
    env = os.environ | {"COLUMNS": "120"}
    done = subprocess.run([sys.executable, "-c", ALL_HELP], capture_output=True, text=True, env=env)
    assert done.returncode == 0, done.stderr
    texts = json.loads(done.stdout)
    assert len(texts) > 7
    for name, text in texts.items():
        assert "--help" in text, name
        assert not re.search(r"<(list\[|str|bool|int|float|path|text|file|dir)", text, re.IGNORECASE), name
        assert ("<edges|grid|pitch>" in text) == (name == "calibrate")


def test_the_table_of_models_fits_a_terminal(capsys, monkeypatch):
    """Also with the longest names, which are wrapped."""
    monkeypatch.setenv("COLUMNS", "80")
    names = [Model(PolynomialZoom(2), 2), Model(SmoothZoom(6), 2), Model(SplineZoom(4), 3, BrownConrady())]
    figures = [
        ComparedModel(of, 8.3, 1.5924, 1.7458, 0.287, 1.73213 * n, 0.287) for n, of in enumerate(names)
    ]
    out = ComparedModel(names[2], problem="The fit failed. More.")
    shown = {"chosen": names[1], "best": names[0], "compared": (*figures, out), "hold_out": "focal"}
    selection = object.__new__(Selection)  # without the fit, which is not shown
    for name, value in (shown | {"folds": 10}).items():
        object.__setattr__(selection, name, value)
    show_choice(selection)
    told = capsys.readouterr().out
    assert max(map(len, told.splitlines())) <= 80
    assert re.search(r"^> SmoothZoom, degree 6, 2 terms +8\.3 +1\.7458 ± 0\.2870 +\+1\.7321", told, re.M)
    assert re.search(r"^  degree 2, 2 terms .* best *$", told, re.M)
    assert "not compared" in told
    assert "by no more than one standard error of the difference" in " ".join(told.split())
    object.__setattr__(selection, "rule", "least")
    show_choice(selection)
    assert "by no more than 0.05 %, which is nothing, that of fewest" in " ".join(
        capsys.readouterr().out.split()
    )
    object.__setattr__(selection, "best", names[1])
    show_choice(selection)
    assert "fewest" not in capsys.readouterr().out


def test_a_stage_that_takes_long_says_so_and_its_name_counts_once(capsys, monkeypatch):
    monkeypatch.setattr(console, "_TICK", 0.05)
    with stages() as stage:
        stage("Fitting the lens")
        time.sleep(0.4)
        stage("Making the report")
    told = capsys.readouterr().err.splitlines()
    assert "… Fitting the lens, for 0 s so far" in told[0]
    assert sum(line.strip().startswith("Fitting the lens") for line in told) == 1
    assert sum(line.strip().startswith("Making the report") for line in told) == 1


@pytest.mark.slow
def test_all_frames_are_told_if_that_is_asked_for(calibrated, tmp_path):
    source = calibrated[0] / "lines.npz"
    done = zoomjax("calibrate", source, "-o", tmp_path / "o", "--verbose", *FORCED)
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "o" / "summary.json").read_text())["per_frame"]
    for row in rows:
        figures = [f"{row[key]:.3f}" for key in ("rms_none", "rms_zoom", "rms_held_out", "rms_frames")]
        wanted = [str(row["frame"]), f"{row['focal']:.5g}", *figures, str(row["lines"]), "0"]
        assert wanted in [line.split() for line in done.stdout.splitlines()]
    assert "Versions: zoomjax" in done.stdout
    assert all(len(line) <= 80 for line in done.stdout.splitlines() if str(tmp_path) not in line)


WRONG = {
    "much and little": (["lines.npz", "--verbose", "--quiet"], "--verbose has no effect with --quiet"),
    "no such file": (["missing.npz"], "missing.npz"),
    "not a lines file": (["foreign.npz"], "foreign.npz"),
    "truncated": (["truncated.npz"], "truncated.npz"),
    "unknown kind": (["notes.txt"], "notes.txt is not a photo"),
    "a folder without photos": (["."], "no photographs in the folder"),
    "options of images for lines": (
        ["lines.npz", "--spacing", "3"],
        "no effect for lines.npz",
    ),
    "an option of lines for images": (["a.jpg", "--image-size", "640x480"], "images have their own"),
    "half a board": (["a.jpg", "--spacing", "20"], "Missing or wrong: --distance, --pixel-pitch"),
    "a spacing that is none": (
        ["a.jpg", "--spacing", "20x", "--distance", "9", "--pixel-pitch", "1"],
        "Missing or wrong: --spacing",
    ),
    "not a source of focal lengths": (["a.jpg", "--focal", "zoom"], "is not a source of focal lengths"),
    "a unit that is none": (["a.jpg", "--focal-unit", "km"], "'mm', 'px'"),
    "no such detector": (["a.jpg", "--detector", "circles"], "Error: Invalid value for '--detector'"),
    "no such option": (["a.jpg", "--detect", "edges"], "Error: No such option: --detect"),
    "a line that is none": (["lines.npz", "--exclude", "1,x"], "--exclude must be numbers of lines"),
    "a line that is not there": (["lines.npz", "--exclude", "9999"], "There is no line 9999"),
    "a line of several files": (
        ["lines.npz", "more.npz", "--exclude", "3"],
        "--exclude is for one file of",
    ),
    "lines of images": (["a.jpg", "--exclude", "3"], "--exclude is for a file of lines"),
    "two files": (["lines.npz", "./lines.npz"], "lines.npz is given twice"),
    "a copy of a file": (["lines.npz", "copy.npz"], "copy.npz holds a frame of lines.npz again, 0 here"),
    "files with a frame in common": (
        ["lines.npz", "more.npz"],
        "more.npz holds a frame of lines.npz again, 1 here and 0 there: its lines would count twice",
    ),
    "options for another kind": (["lines.npz", "--image-size", "640x480"], "for CSV files"),
    "too few focal lengths": (["lines.npz", "--degree", "5"], "6 or more distinct focal lengths"),
    "a degree of another model": (["lines.npz", "--model", "spline", "--degree", "1"], "for polynomials"),
    "lines beside photos": (
        ["photos", "lines.npz", "--detector", "edges"],
        "--detector has no effect for lines.npz, which contains lines: leave it out",
    ),
    "an empty model": (["lines.npz", "--model", ""], "--model must be one of auto, polynomial"),
    "no such model": (["lines.npz", "--model", "best"], "--model must be one of auto, polynomial"),
    "a centre that is none": (["lines.npz", "--centre", "middle"], "fit, moving, image, or X,Y"),
    "no such distortion model": (
        ["lines.npz", "--distortion-model", "fisheye"],
        "'radial', 'division', 'brown-conrady'",
    ),
    "a centre of decentering": (
        ["lines.npz", "--distortion-model", "brown-conrady", "--centre", "fit"],
        '--centre cannot be "fit" with --distortion-model brown-conrady',
    ),
    "a prior of another distortion model": (
        ["lines.npz", "--distortion-model", "brown-conrady", "--model", "smooth"],
        "--model smooth has no prior for this distortion model: leave out --distortion-model",
    ),
    "focal lengths that are not measured": (
        ["a.jpg", "--shared-focal", "folder"],
        "--shared-focal is for focal lengths that are measured from a flat grid",
    ),
    "a board at infinity": (
        ["a.jpg", "--spacing", "20", "--distance", "inf", "--pixel-pitch", "0.005"],
        "Missing or wrong: --distance",
    ),
    "pixels in µm": (
        ["a.jpg", "--spacing", "20", "--distance", "900", "--pixel-pitch", "3.9"],
        "--pixel-pitch must be the width of a pixel on the sensor in mm",
    ),
    "digits of another kind": (["a.jpg", "--focal", "35", "--focal-sigma", "1_0"], "such as 0.3, or 1%"),
    "no digits": (["lines.npz", "--focal-sigma", ""], "such as 0.3, or 1%"),
    "too many coefficients": (["a.jpg", "--terms", "9"], "--terms must be at most 4"),
    "more coefficients than the prior": (
        ["a.jpg", "--model", "smooth", "--terms", "3"],
        "leave out --terms",
    ),
    "a focal length of csv that is none": (
        ["bare.csv", "--image-size", "640x480", "--focal", "-35"],
        "a positive number, or same if it is not known",
    ),
    "a source of photos for csv": (
        ["bare.csv", "--image-size", "640x480", "--focal", "exif"],
        "must be a CSV file with the columns frame,focal, or one focal length of",
    ),
    "one focal length beside those of csv": (
        ["lines.csv", "--image-size", "640x480", "--focal", "same"],
        "focal lengths are also given separately",
    ),
    "a unit of what is not known": (
        ["bare.csv", "--image-size", "640x480", "--focal", "same", "--focal-unit", "px"],
        "leave out --focal-unit",
    ),
    "how uncertain what is not known is": (
        ["a.jpg", "--focal", "same", "--focal-sigma", "1%"],
        "--focal-sigma has no effect with --focal same",
    ),
    "a size of nothing": (["lines.csv", "--image-size", "0x480"], "--image-size must be like"),
    "a size in other digits": (["lines.csv", "--image-size", "²x3"], "--image-size must be like"),
    "csv without image size": (["lines.csv"], "--image-size"),
    "csv with a bad image size": (["lines.csv", "--image-size", "big"], "1920x1080"),
    "csv without focal lengths": (["bare.csv", "--image-size", "640x480"], "frame,focal"),
}


def _with_a_frame_before(lines):
    """Another frame, and then the first frame of the lines."""
    own = [line for line, frame in zip(lines.to_ragged(), lines.frame, strict=True) if frame == 0]
    frame = np.repeat([0, 1], len(own))
    points = [*(line + 0.25 for line in own), *own]
    return zj.Lines.from_ragged(points, frame, [35, 50], image_size=lines.image_size)


@pytest.fixture(scope="module")
def wrong_files(few_lines, tmp_path_factory):
    folder = tmp_path_factory.mktemp("wrong")
    few_lines.save(folder / "lines.npz")
    few_lines.save(folder / "copy.npz")
    _with_a_frame_before(few_lines).save(folder / "more.npz")
    (folder / "truncated.npz").write_bytes((folder / "lines.npz").read_bytes()[:5000])
    np.savez(folder / "foreign.npz", corners=np.zeros(3))
    (folder / "notes.txt").write_text("straight lines")
    write_lines_csv(few_lines, folder / "lines.csv")
    (folder / "bare.csv").write_text("frame,line,x,y\n0,0,1,1\n0,0,2,2\n0,0,3,4\n")
    return folder


@pytest.fixture(scope="module")
def told_of_mistakes(wrong_files):
    """Status and output for each, of one process."""
    commands = (
        ["calibrate", *arguments, "-o", f"out{number}"]
        for number, (arguments, _) in enumerate(WRONG.values())
    )
    return dict(zip(WRONG, one_after_another(wrong_files, commands), strict=True))


@pytest.mark.parametrize("case", WRONG)
def test_a_mistake_is_one_sentence_and_status_2(case, told_of_mistakes, wrong_files):
    status, told = told_of_mistakes[case]
    assert status == 2
    assert WRONG[case][1] in told
    assert "Traceback" not in told
    assert not list(wrong_files.glob("out*"))


def test_empty_names_are_not_the_working_folder(tmp_path):
    """Of a variable of the shell that is not set: all photos there would be used, or results put there."""
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((40, 60), np.uint8))
    scenes.nikkor_18_200((60, 40)).save(tmp_path / "lens.json")
    commands = [
        *(
            ["undistort", "lens.json", given, "--focal", 30, "-o", out]
            for given, out in (("", "b"), ("a.png", ""))
        ),
        *(["calibrate", *given, "-o", out] for given, out in ((["", "a.png"], "b"), (["a.png"], ""))),
        *(["export", given, "--to", "lensfun", "-o", out] for given, out in (("", "b"), ("lens.json", ""))),
        ["import", "", "-o", "b"],
        ["demo", "--output="],
    ]
    for status, told in one_after_another(tmp_path, commands):
        assert status == 2
        assert "is empty, as a variable of the shell that is not set" in told
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png", "lens.json"]


def test_a_url_is_no_name_of_a_file_here(tmp_path):
    """Results went to the folder s3: here, and it was called what had been given."""
    scenes.nikkor_18_200((60, 40)).save(tmp_path / "lens.json")
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((40, 60), np.uint8))
    commands = [
        ["undistort", "lens.json", "a.png", "--focal", 30, "-o", "s3://key:secret@bucket/out"],
        ["undistort", "lens.json", "a.png", "--focal", "s3://b/f.csv", "-o", "b"],
        ["calibrate", "a.png", "--focal", "file:///f.csv", "-o", "b"],
        ["export", "s3://b/lens.json", "--to", "lensfun", "-o", "b.xml"],
        ["import", "https://host/a.xml", "-o", "b"],
    ]
    names = ["--output is 's3://bucket/out'", "--focal", "--focal", "An argument", "An argument"]
    for name, (status, told) in zip(names, one_after_another(tmp_path, commands), strict=True):
        assert status == 2
        assert name in told
        assert "but files are meant here, not URLs: copy" in " ".join(told.split())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png", "lens.json"]


def test_a_home_folder_that_the_shell_did_not_fill_in_is_no_folder_here(tmp_path):
    """Results went to the folder ~ here, and were said to be in ~/out."""
    scenes.nikkor_18_200((60, 40)).save(tmp_path / "lens.json")
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((40, 60), np.uint8))
    commands = [
        ["undistort", "lens.json", "a.png", "--focal", 30, "--output=~/out"],
        ["undistort", "lens.json", "~/*.png", "--focal", 30, "-o", "b"],
        ["undistort", "lens.json", "a.png", "--focal=~/f.csv", "-o", "b"],
        ["calibrate", "a.png", "--focal", 30, "--output=~"],
        ["export", "~/lens.json", "--to", "lensfun", "-o", "b.xml"],
    ]
    names = ["--output is '~/out'", "An argument is", "--focal is", "--output is '~'", "An argument is"]
    for name, (status, told) in zip(names, one_after_another(tmp_path, commands), strict=True):
        assert status == 2
        assert name in told
        assert "write the folder in full, or ./~ for one of this name" in " ".join(told.split())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png", "lens.json"]
    done = zoomjax("undistort", "lens.json", "a.png", "--focal", 30, "-o", "./~/b.png", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "~" / "b.png").exists()


def test_a_mistake_is_told_on_stderr(wrong_files):
    arguments, hint = next(iter(WRONG.values()))
    done = zoomjax("calibrate", *arguments, "-o", "out", cwd=wrong_files)
    assert done.returncode == 2
    assert hint in done.stderr
    assert done.stdout == ""


_BOARD = ("--spacing", "30", "--distance", "1185", "--pixel-pitch", "0.0055")


WITHOUT_EFFECT = [
    (["lines.npz", "--lines", "--no-cache"], "--lines and --no-cache have no effect for lines.npz"),
    (["lines.npz", "--detector", "grid"], "--detector has no effect for lines.npz"),
    (["lines.npz", "--overlays", "all", "--frames", "3"], "--frames and --overlays have no effect"),
    (["a.png", "--frames", "3"], "--frames has no effect for photos"),
    (["lines.npz", "--shared-focal", "exif"], "--shared-focal has no effect for lines.npz"),
    (["a.png", "--focal-unit", "px"], "--focal-unit has no effect without --focal"),
    (
        ["a.png", "--focal", "exif", "--focal-unit", "px"],
        "--focal-unit has no effect with --focal exif",
    ),
    (["a.png", "--focal", "plane", "--focal-unit", "mm"], "--focal-unit has no effect with --focal pl"),
    (
        ["a.png", "--focal", "35", *_BOARD],
        "--spacing and --distance and --pixel-pitch have no effect",
    ),
    (["a.png", "--focal", "exif", *_BOARD], "have no effect with --focal exif"),
    (["lines.npz", "--model", "auto", "--degree", "2"], "--model auto has no effect with --degree"),
]


@pytest.fixture(scope="module")
def told_of_options(wrong_files):
    (wrong_files / "a.png").write_bytes(b"")
    commands = (["calibrate", *options, "-o", "none"] for options, _ in WITHOUT_EFFECT)
    yield one_after_another(wrong_files, commands)
    (wrong_files / "a.png").unlink()


@pytest.mark.parametrize("number", range(len(WITHOUT_EFFECT)))
def test_an_option_without_effect_is_refused(number, told_of_options):
    status, told = told_of_options[number]
    assert status == 2
    assert WITHOUT_EFFECT[number][1] in told


def test_calibrate_does_not_replace_its_input(wrong_files):
    before = (wrong_files / "lines.npz").read_bytes()
    (wrong_files / "lines.csv").write_text("frame,line,x,y,focal\n")
    done = zoomjax("calibrate", "lines.npz", "lines.csv", "-o", ".", "--overwrite", cwd=wrong_files)
    assert done.returncode == 2
    assert "is the input" in done.stderr
    assert (wrong_files / "lines.npz").read_bytes() == before


def test_calibrate_does_not_replace_photographs(tmp_path):
    write_photos(tmp_path / "lines", number=3, image_size=(536, 356))
    before = {p: p.read_bytes() for p in (tmp_path / "lines").iterdir()}
    done = zoomjax("calibrate", "lines", "-o", ".", cwd=tmp_path)
    assert done.returncode == 2
    assert "would replace the photo" in done.stderr
    assert {p: p.read_bytes() for p in (tmp_path / "lines").iterdir()} == before


def test_an_interrupted_run_leaves_nothing(wrong_files):
    """Interrupted as by Ctrl-C, at the first sign of life."""
    command = [*INTERRUPTIBLE, "demo", "-o", "new"]
    process = subprocess.Popen(command, cwd=wrong_files, stderr=subprocess.PIPE)
    while not (wrong_files / "new").exists():
        time.sleep(0.05)
        assert process.poll() is None
    stderr = b""
    for _ in range(30):  # libraries now and then swallow an interrupt: users press again
        process.send_signal(signal.SIGINT)
        with contextlib.suppress(subprocess.TimeoutExpired):
            _, stderr = process.communicate(timeout=2)
            break
    assert process.returncode == 130
    assert stderr.decode().rstrip().endswith("Interrupted.")
    assert not (wrong_files / "new").exists()


def test_version():
    assert zoomjax("--version").stdout == f"zoomjax {importlib.metadata.version('zoomjax')}\n"


@pytest.mark.slow
def test_what_is_wrong_with_a_model_is_told_on_stderr(tmp_path):
    t = np.linspace(-200, 200, 50)
    radial = [np.stack([319.5 + t * c, 239.5 + t * s], -1) for c, s in ((1, 0), (0, 1), (0.6, 0.8))]
    lines = zj.Lines.from_ragged(radial * 3, np.repeat([0, 1, 2], 3), [20, 40, 80], image_size=(640, 480))
    lines.save(tmp_path / "lines.npz")
    done = zoomjax(
        "calibrate", "lines.npz", "-o", "out", "--degree", "2", "--centre", "image", cwd=tmp_path
    )
    assert done.returncode == 0
    assert "Warning: The points do not determine" in " ".join(done.stderr.split())


def test_a_warning_of_files_that_are_looked_for_again_is_told_once(tmp_path):
    """Also where no line can be found in them."""
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((80, 120), 128, np.uint8))
    (tmp_path / "film.gif").write_bytes(b"GIF89a")
    done = zoomjax("calibrate", tmp_path, tmp_path / "grey.png", "--focal", 30, "-o", tmp_path / "out")
    assert done.returncode
    told = " ".join(done.stderr.split())
    assert told.count("one file is left out: film.gif.") == 1, told
    assert told.count("is given twice: it is used once.") == 1


def test_an_output_folder_that_cannot_be_written_is_told_before_the_work(wrong_files):
    done = zoomjax("calibrate", "lines.npz", "-o", Path("lines.npz") / "out", cwd=wrong_files)
    assert done.returncode == 2
    assert f"lines.npz{os.sep}out" in done.stderr
    assert "Fitting" not in done.stderr
