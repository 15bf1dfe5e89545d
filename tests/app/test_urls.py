"""The command line on URLs: what it makes of paths, with URLs in what it says."""

import json
import subprocess

import cv2
import pytest

from zoomjax import scenes
from zoomjax.app.runs import what_is_run

from .._clips import lens, picture
from .._commands import COMMAND
from .._exif import exif
from ..correct import test_photo

pytest.importorskip("fsspec")


def zoomjax(*arguments):
    return subprocess.run([*COMMAND, *map(str, arguments)], capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A lens, and photos in folders, of which one is damaged."""
    made = tmp_path_factory.mktemp("files")
    lens().save(made / "lens.json")
    for name in ("in/a.jpg", "in/day/b.jpg"):
        (made / name).parent.mkdir(parents=True, exist_ok=True)
        test_photo.write(made / name, cv2.cvtColor(picture(0), cv2.COLOR_GRAY2BGR), exif((40, 1)))
    (made / "in/bad.jpg").write_bytes(b"not a photo")
    return made


@pytest.mark.slow
def test_photos_are_corrected_as_by_their_paths(folder, tmp_path):
    url = f"file://{folder.as_posix()}"
    by_path = zoomjax("undistort", folder / "lens.json", folder / "in", "-o", tmp_path / "path", "--json")
    by_url = zoomjax("undistort", f"{url}/lens.json", f"{url}/in", "-o", tmp_path / "url", "--json")
    assert by_path.returncode == by_url.returncode == 1
    told = json.loads(by_url.stdout)
    assert [of["source"] for of in told["files"]] == [f"{url}/in/a.jpg", f"{url}/in/day/b.jpg"]
    assert list(told["skipped"]) == [f"{url}/in/bad.jpg"]
    assert f"from {url}/in/bad.jpg: it is damaged" in told["skipped"][f"{url}/in/bad.jpg"]
    for name in ("a.jpg", "day/b.jpg"):
        one, other = (cv2.imread(str(tmp_path / where / name)) for where in ("path", "url"))
        assert (one == other).all()
    again = zoomjax("undistort", f"{url}/lens.json", f"{url}/in", "-o", tmp_path / "url", "--resume")
    assert again.stdout.startswith("0 of 3 photos corrected now, 2 earlier")


@pytest.mark.slow
def test_an_error_names_the_url(folder, tmp_path):
    url = f"file://{folder.as_posix()}/in"
    done = zoomjax("undistort", folder / "lens.json", f"{url}/bad.jpg", "-o", tmp_path / "out.jpg")
    assert (done.returncode, done.stderr.count("Error")) == (2, 1)
    assert f"Cannot read a photograph from {url}/bad.jpg" in done.stderr
    done = zoomjax("calibrate", f"{url}/none.jpg", "-o", tmp_path / "out")
    assert done.stderr == f"Error: There is nothing to read at {url}/none.jpg.\n"
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_lines_are_fitted_as_by_their_path(tmp_path):
    lines = scenes.board_lines(scenes.nikkor_18_200(), scenes.focal_sweep(4), spacing=300, noise=0.3)
    lines.save(tmp_path / "lines.npz")
    for name, given in (("a", tmp_path / "lines.npz"), ("b", f"file://{tmp_path.as_posix()}/lines.npz")):
        done = zoomjax("calibrate", given, "-o", tmp_path / name, "--degree", 1, "--centre", "image")
        assert done.returncode == 0, done.stderr
    one, other = (json.loads((tmp_path / name / "lens.json").read_text()) for name in "ab")
    assert one["zoom"] == other["zoom"]


def test_the_report_has_no_password(monkeypatch):
    monkeypatch.setattr("sys.argv", ["zoomjax", "calibrate", "sftp://me:secret@host/shots"])
    rows = dict(what_is_run("title").rows)
    assert rows["Command"] == "zoomjax calibrate sftp://host/shots"
