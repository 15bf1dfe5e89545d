"""``zoomjax undistort``, as a user runs it: photos and videos, and mistakes in one sentence."""

import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest

import zoomjax as zj
from _commands import COMMAND, INTERRUPTIBLE
from _exif import exif

from . import test_photos
from .clips import FRAMES, bend, lens, luma, picture, write_clip, write_still

ARGUMENTS = ["undistort", "lens.json"]


def run(folder, *arguments):
    return subprocess.run(
        [*COMMAND, *ARGUMENTS, *map(str, arguments)],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=300,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A lens, a clip with its track, three photos with EXIF data, and a table for them."""
    folder = tmp_path_factory.mktemp("files")
    lens().save(folder / "lens.json")
    write_clip(folder / "zoom.mp4")
    (folder / "track.csv").write_text(f"frame,focal\n0,20\n{FRAMES - 1},80\n")
    (folder / "short.csv").write_text("frame,focal\n0,20\n9,80\n")
    for name, focal in (("a.jpg", 20), ("b.jpg", 40), ("c.jpg", 80)):
        test_photos.write(folder / name, cv2.cvtColor(picture(0), cv2.COLOR_GRAY2BGR), exif((focal, 1)))
    (folder / "focal.csv").write_text("image,focal\na.jpg,30\nb.jpg,30\nc.jpg,30\n")
    (folder / "table.csv").write_text("image,focal\nb.jpg,30\n")
    (folder / "empty.mp4").write_bytes(b"")
    return folder


def test_video(folder):
    done = run(folder, "zoom.mp4", "--focal", "track.csv", "--keep", "valid", "-o", "out.mp4")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert done.stdout.startswith(f"{FRAMES} frames corrected, scale 1.0")
    assert max(bend(frame) for frame in luma(folder / "out.mp4")[0][::6]) <= 0.2


def test_photos_at_their_own_focal_lengths(folder):
    done = run(folder, "a.jpg", "b.jpg", "c.jpg", "-o", "own")
    assert done.returncode == 0, done.stderr
    assert done.stdout == "3 photos corrected: own\n"
    for name, focal in (("a.jpg", 20.0), ("b.jpg", 40.0), ("c.jpg", 80.0)):
        before, after = (
            cv2.imread(str(folder / where / name), cv2.IMREAD_UNCHANGED) for where in (".", "own")
        )
        difference = cv2.absdiff(after, zj.undistort_image(before, lens()(focal)))
        assert difference.mean() < 1


def test_photos_with_a_table_or_one_focal_length(folder):
    for focal, out in (("focal.csv", "table"), ("30", "number")):
        done = run(folder, "a.jpg", "b.jpg", "--focal", focal, "-o", out)
        assert done.returncode == 0, done.stderr
    for name in ("a.jpg", "b.jpg"):
        assert (folder / "table" / name).read_bytes() == (folder / "number" / name).read_bytes()


WRONG = {
    "no such file": (["none.mp4", "--focal", "30"], "There is no video none.mp4"),
    "empty video": (["empty.mp4", "--focal", "30"], "the file is empty"),
    "no focal length": (["zoom.mp4"], "A video needs --focal"),
    "no such track": (["zoom.mp4", "--focal", "none.csv"], "none.csv"),
    "short track": (["zoom.mp4", "--focal", "short.csv"], "Give a track as long as the video"),
    "negative": (["zoom.mp4", "--focal", "-3"], "positive"),
    "two videos": (["zoom.mp4", "zoom.mp4", "--focal", "30"], "one video at a time"),
    "both kinds": (["zoom.mp4", "a.jpg"], "not both"),
    "table too short": (["a.jpg", "b.jpg", "--focal", "table.csv"], "no number for a.jpg"),
    "table of something else": (["a.jpg", "--focal", "track.csv"], 'must be "image,focal"'),
    "interpolation": (["a.jpg", "--interpolation", "best"], "must be one of nearest"),
    "border": (["zoom.mp4", "--focal", "30", "--border", "wrap"], "must be one of constant"),
    "keep": (["zoom.mp4", "--focal", "30", "--keep", "most"], "must be"),
    "same name": (["a.jpg", "./a.jpg"], "same name"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_mistake_is_one_sentence_and_status_2(folder, case):
    arguments, hint = WRONG[case]
    target = "wrong.mp4" if "mp4" in arguments[0] else "wrong"
    done = run(folder, *arguments, "-o", target)
    assert done.returncode == 2, done.stdout
    assert hint in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not (folder / "wrong.mp4").exists()
    assert not list(folder.glob("wrong/*")) + list(folder.glob(".*.part"))


def test_no_lens(tmp_path):
    done = run(tmp_path, "zoom.mp4", "--focal", "30", "-o", "out.mp4")
    assert done.returncode == 2
    assert "lens.json" in done.stderr


def test_output_over_the_input_is_refused(folder):
    content = (folder / "zoom.mp4").read_bytes()
    done = run(folder, "zoom.mp4", "--focal", "30", "-o", "zoom.mp4")
    assert done.returncode == 2
    assert "is the input" in done.stderr
    assert (folder / "zoom.mp4").read_bytes() == content


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_leaves_no_file(tmp_path, number):
    lens().save(tmp_path / "lens.json")
    write_still(tmp_path / "long.mkv", 20000)  # minutes of work
    command = [*INTERRUPTIBLE, *ARGUMENTS, "long.mkv", "--focal", "30", "-o", "out.mp4"]
    process = subprocess.Popen(command, cwd=tmp_path)
    deadline = time.monotonic() + 60
    while not any(p.stat().st_size > 0 for p in tmp_path.glob(".*.part")) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert list(tmp_path.glob(".*.part"))
    process.send_signal(number)
    assert process.wait(60) != 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["lens.json", "long.mkv"]


def test_memory_stays_flat(folder):
    """The peak of 24 and of 240 frames: the same, and not 240 frames of 92 kB more."""
    probe = (
        "import resource, sys; from zoomjax.cli import main\n"
        "try:\n    main()\nfinally:\n    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    )
    peaks = []
    for frames in (24, 240):
        name = write_still(folder / f"{frames}.mkv", frames).name
        done = subprocess.run(
            [sys.executable, "-c", probe, *ARGUMENTS, name, "--focal", "30", "-o", "flat.mp4"],
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert f"{frames} frames corrected" in done.stdout, done.stderr
        peaks.append(int(done.stdout.split()[-1]))
    assert peaks[1] - peaks[0] < 15_000  # kB; the frames themselves are 22 MB


def test_table_with_a_byte_order_mark(folder):
    (folder / "excel.csv").write_bytes("﻿image,focal\r\na.jpg,30\r\n".encode())
    done = run(folder, "a.jpg", "--focal", "excel.csv", "-o", "excel.jpg")
    assert done.returncode == 0, done.stderr
    assert np.ptp(cv2.imread(str(folder / "excel.jpg"))) > 100
