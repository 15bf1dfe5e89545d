"""``zoomjax undistort``, as a user runs it: photos and videos, and mistakes in one sentence."""

import dataclasses
import json
import re
import shutil
import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest
from PIL import Image

import zoomjax as zj
from zoomjax.app.undistort_files import Job, undistort_files

from .._clips import FRAMES, bend, lens, luma, picture, write_clip, write_still
from .._commands import COMMAND, INTERRUPTIBLE, one_after_another
from .._exif import exif
from ..correct import test_photo

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
        test_photo.write(folder / name, cv2.cvtColor(picture(0), cv2.COLOR_GRAY2BGR), exif((focal, 1)))
    (folder / "focal.csv").write_text("image,focal\na.jpg,30\nb.jpg,30\nc.jpg,30\n")
    (folder / "table.csv").write_text("image,focal\nb.jpg,30\n")
    (folder / "empty.mp4").write_bytes(b"")
    (folder / "copy.mp4").write_bytes((folder / "zoom.mp4").read_bytes())
    (folder / "notes.txt").write_text("Straight lines.")
    Image.fromarray(picture(0)).save(folder / "picture.gif")
    return folder


def test_video(folder):
    done = run(folder, "zoom.mp4", "--focal", "track.csv", "--keep", "valid", "-o", "out.mp4")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert done.stdout.startswith(f"{FRAMES} frames corrected, scale 1.0")
    assert max(bend(frame) for frame in luma(folder / "out.mp4")[0][::6]) <= 0.2


@pytest.mark.slow
def test_a_folder_of_results_stands_for_its_lens(folder, tmp_path):
    (tmp_path / "mylens").mkdir()
    lens().save(tmp_path / "mylens/lens.json")
    photo, options = folder / "a.jpg", ["--to", "opencv", "--focal", "35", "--pixel-pitch", "0.005"]
    for words in (
        ["undistort", "mylens", photo, "-o", "a.jpg"],
        ["export", "mylens", *options, "-o", "a.yaml"],
    ):
        done = subprocess.run([*COMMAND, *map(str, words)], cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert (tmp_path / words[-1]).exists()
    words = ["undistort", str(tmp_path), str(photo), "-o", "b.jpg"]
    done = subprocess.run([*COMMAND, *words], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2
    assert "has no lens.json: give that of zoomjax calibrate" in done.stderr


@pytest.mark.slow
def test_a_dry_run_says_what_would_be_written(folder):
    photos = ("a.jpg", "b.jpg", "picture.gif")
    done = run(folder, *photos, "--focal", "table.csv", "-o", "planned", "--dry-run")
    assert done.returncode == 1
    assert done.stdout.splitlines() == [
        "1 file would be written. Nothing was written.",
        "  b.jpg -> planned/b.jpg, f = 30 mm",
    ]
    assert "Skipped a.jpg: " in done.stderr
    assert "Skipped picture.gif: it is a GIF" in done.stderr
    done = run(folder, "zoom.mp4", "--focal", "track.csv", "-o", "planned.mp4", "--dry-run")
    assert done.returncode == 0, done.stderr
    assert "  zoom.mp4 -> planned.mp4" in done.stdout
    assert not [*folder.glob("planned*")]


@pytest.mark.filterwarnings("ignore:The lens is for images of")
@pytest.mark.parametrize("redistort", [False, True])
@pytest.mark.parametrize("keep", ["same", "grow"])
def test_a_dry_run_says_of_photos_what_the_run_says(folder, tmp_path, keep, redistort):
    """Of one that is done already, and of one that is turned, the run and its rehearsal say the same."""
    job = Job(folder / "lens.json", (folder / "a.jpg",), tmp_path / "in", focal="30", keep=keep)
    undistort_files(job)
    [done] = (tmp_path / "in").iterdir()
    done = done.rename(done.with_name("done.jpg"))
    stored = cv2.imread(str(done), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    cv2.imwrite(str(tmp_path / "in/turned.jpg"), np.ascontiguousarray(np.rot90(stored)))
    shutil.copy(folder / "b.jpg", tmp_path / "in")
    if redistort:
        undistort_files(
            dataclasses.replace(job, inputs=(done,), output=tmp_path / "in/e.jpg", redistort=True)
        )
    job = dataclasses.replace(
        job, inputs=(tmp_path / "in",), output=tmp_path / "out", redistort=redistort, resume=True
    )
    planned = undistort_files(dataclasses.replace(job, dry_run=True))
    made = undistort_files(job)
    assert planned.skipped == made.skipped
    assert planned.files == made.files
    assert len(made.skipped) == (3 if redistort and keep == "grow" else 2)


def test_a_dry_run_tells_a_name_in_one_line(folder, tmp_path):
    shutil.copy(folder / "b.jpg", tmp_path / "two\nlines.jpg")
    job = Job(folder / "lens.json", (tmp_path,), tmp_path / "out", focal="30", dry_run=True)
    [_, told] = undistort_files(job).sentence.splitlines()
    assert told.endswith(r"out/two\nlines.jpg, f = 30 mm")


def test_results_of_an_earlier_run_in_place_of_those_of_skipped_files_are_said(folder, tmp_path):
    photos = tuple(folder / name for name in ("a.jpg", "b.jpg"))
    job = Job(folder / "lens.json", photos, tmp_path / "out", focal="30")
    assert not undistort_files(job).skipped
    before = (tmp_path / "out/a.jpg").read_bytes()
    again = dataclasses.replace(job, focal=str(folder / "table.csv"), overwrite=True)
    told = [undistort_files(dataclasses.replace(again, dry_run=dry)).skipped for dry in (True, False)]
    for skipped in told:
        [(source, why)] = skipped.items()
        assert source == str(photos[0])
        assert why.endswith(f". What is in {tmp_path / 'out/a.jpg'} is of an earlier run.")
    assert (tmp_path / "out/a.jpg").read_bytes() == before
    [why] = undistort_files(dataclasses.replace(again, output=tmp_path / "other")).skipped.values()
    assert "earlier run" not in why

    clips = tuple(tmp_path / name for name in ("a.mp4", "b.mp4"))
    write_clip(clips[0])
    clips[1].write_bytes(b"")
    (tmp_path / "videos").mkdir()
    (tmp_path / "videos/b.mp4").write_bytes(b"of another day")
    job = dataclasses.replace(job, inputs=clips, output=tmp_path / "videos", overwrite=True)
    [why] = undistort_files(job).skipped.values()
    assert why.endswith(f"What is in {tmp_path / 'videos/b.mp4'} is of an earlier run.")


@pytest.mark.slow
def test_results_as_json_and_in_silence(folder):
    done = run(folder, "a.jpg", "b.jpg", "picture.gif", "-o", "json", "--json")
    assert done.returncode == 1
    told = json.loads(done.stdout)
    assert told["files"] == [{"source": f"{n}.jpg", "target": f"json/{n}.jpg"} for n in "ab"]
    assert [*told["skipped"]] == ["picture.gif"]
    again = run(folder, "a.jpg", "b.jpg", "picture.gif", "-o", "json", "--resume", "--quiet")
    assert (again.returncode, again.stdout) == (1, "")
    assert again.stderr.startswith("Skipped picture.gif: it is a GIF")


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


def test_photos_corrected_before_are_counted(folder, tmp_path):
    xmp = b'<x:xmpmeta><a crs:LensProfileEnable="1" crs:AlreadyApplied="True"/></x:xmpmeta>'
    for number, told in enumerate((xmp, xmp, b"")):
        Image.fromarray(picture(0)).convert("RGB").save(tmp_path / f"{number}.jpg", xmp=told)
    job = Job(folder / "lens.json", (tmp_path,), tmp_path / "out", focal="40")
    told = "Of 3 photos 2 say that Adobe's lens correction has corrected their distortion before."
    assert any(note.startswith(told) for note in undistort_files(job).notes)
    (tmp_path / "0.jpg").unlink()
    (tmp_path / "1.jpg").unlink()
    assert undistort_files(dataclasses.replace(job, output=tmp_path / "other")).notes == ()


def test_focal_lengths_that_exif_data_contradict_are_told(folder, tmp_path):
    """Also where the table has none for a photo, which is skipped."""
    job = Job(folder / "lens.json", (folder / "a.jpg", folder / "c.jpg"), tmp_path / "one", focal="30")
    (told,) = undistort_files(job).notes
    assert "a.jpg is of 20 mm and c.jpg is of 80 mm, and the focal length used is 30 mm" in told
    photos = (folder / "a.jpg", folder / "b.jpg")
    job = dataclasses.replace(job, inputs=photos, output=tmp_path / "two", focal=str(folder / "table.csv"))
    done = undistort_files(job)
    assert [*done.skipped] == [str(folder / "a.jpg")]
    assert "b.jpg is of 40 mm, and the focal length used is 30 mm" in done.notes[0]


@pytest.mark.slow
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
    "short track": (["zoom.mp4", "--focal", "short.csv"], "or hold its ends (--hold)"),
    "an empty word": (["a.jpg", "--focal", ""], "--focal must be a positive number"),
    "a folder for a photo": (
        ["a.jpg", "--focal", "."],
        "cannot read focal lengths where there is a folder",
    ),
    "a source of a calibration": (
        ["a.jpg", "--focal", "same"],
        "but it is 'same', by which a calibration finds focal lengths. Leave it out",
    ),
    "negative": (["zoom.mp4", "--focal", "-3"], "--focal must be a positive"),
    "two videos": (["zoom.mp4", "copy.mp4", "--focal", "30"], "of 2 videos must be a folder"),
    "both kinds": (["zoom.mp4", "a.jpg"], "not both"),
    "table too short": (["a.jpg", "--focal", "table.csv"], "no focal length for a.jpg"),
    "table of something else": (["a.jpg", "--focal", "track.csv"], 'must name the columns "image,focal"'),
    "no such table": (["a.jpg", "--focal", "none.csv"], "none.csv"),
    "no such photo": (["none.jpg", "--focal", "30"], "There is no photograph none.jpg"),
    "interpolation": (["a.jpg", "--interpolation", "best"], "--interpolation must be one of nearest"),
    "border": (["zoom.mp4", "--focal", "30", "--border", "wrap"], "must be one of constant"),
    "keep": (["zoom.mp4", "--focal", "30", "--keep", "most"], "must be"),
    "keep of photos": (["none.jpg", "a.jpg", "--keep", "most"], "must be"),
    "hold of photos": (["none.jpg", "a.jpg", "--hold"], "--hold is for"),
    "decimal comma": (["none.jpg", "a.jpg", "--focal", "20,5"], "with a decimal point"),
    "over an input": (["a.jpg", "b.jpg", "-o", "."], "is the input"),
    "a GIF": (["picture.gif", "--focal", "30"], "it is a GIF image: convert it to TIFF or PNG first"),
    "no photo": (["notes.txt", "--focal", "30"], "it is not a photo: names of photos end in"),
    "nothing": (["none*.jpg"], "No photo or video fits the pattern none*.jpg"),
}


@pytest.fixture(scope="module")
def told_of_mistakes(folder):
    """Status and output for each, of one process, and what was written meanwhile."""
    commands = []
    for arguments, _ in WRONG.values():
        target = "wrong.mp4" if "mp4" in arguments[0] else "wrong"
        commands.append([*ARGUMENTS, *(["-o", target] if "-o" not in arguments else []), *arguments])
    before = content(folder)
    told = one_after_another(folder, commands)
    assert content(folder) == before
    return dict(zip(WRONG, told, strict=True))


@pytest.mark.parametrize("case", WRONG)
def test_a_mistake_is_one_sentence_and_status_2(case, told_of_mistakes):
    status, told = told_of_mistakes[case]
    assert status == 2, told
    assert WRONG[case][1] in told
    assert len(told.strip().splitlines()) == 1


def test_no_lens(tmp_path):
    done = run(tmp_path, "zoom.mp4", "--focal", "30", "-o", "out.mp4")
    assert done.returncode == 2
    assert "lens.json" in done.stderr


def content(folder):
    """Every file in a folder, and what is in it."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("name", ["a.jpg", "zoom.mp4"])
def test_an_input_is_never_written_to(folder, tmp_path, name, overwrite):
    """Whatever it is called: itself, through .. or links, and as another one's output."""
    suffix = name[-4:]
    (tmp_path / "own").mkdir()
    for each in (name, "lens.json", "focal.csv"):
        (tmp_path / "own" / each).write_bytes((folder / each).read_bytes())
    (tmp_path / "here").symlink_to("own")
    (tmp_path / "own" / f"soft{suffix}").symlink_to(name)
    (tmp_path / "own" / f"hard{suffix}").hardlink_to(tmp_path / "own" / name)
    outputs = [name, f"../own/{name}", f"../here/{name}", f"soft{suffix}", f"hard{suffix}", ".", "../here"]
    before = content(tmp_path)
    for output in outputs:
        with pytest.raises(ValueError, match=r"The output .* is the input"):
            undistort_files(
                Job(
                    tmp_path / "own" / "lens.json",
                    (tmp_path / "own" / name,),
                    tmp_path / "own" / output,
                    "30",
                    overwrite=overwrite,
                )
            )
    assert content(tmp_path) == before
    assert (tmp_path / "own" / f"soft{suffix}").is_symlink()


def test_an_input_is_not_another_one_s_output(folder, tmp_path):
    for name, own in (("x/a.jpg", "a.jpg"), ("y/b.jpg", "b.jpg"), ("y/a.jpg", "c.jpg")):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes((folder / own).read_bytes())
    before = content(tmp_path)
    job = Job(folder / "lens.json", (tmp_path / "x/a.jpg", tmp_path / "y/b.jpg"), tmp_path / "y", "30")
    with pytest.raises(ValueError, match=r"is the input"):
        undistort_files(dataclasses.replace(job, overwrite=True))
    assert content(tmp_path) == before


@pytest.mark.parametrize("name", ["a.jpg", "zoom.mp4"])
def test_what_is_there_is_replaced_only_if_that_is_said(folder, tmp_path, name):
    target, mine = tmp_path / name, tmp_path / "mine.txt"
    mine.write_text("mine")
    for make in (lambda: target.write_text("mine"), lambda: target.symlink_to(mine)):
        make()
        job = Job(folder / "lens.json", (folder / name,), target, "30")
        with pytest.raises(FileExistsError, match="already exists"):
            undistort_files(job)
        assert target.read_text() == "mine"
        undistort_files(dataclasses.replace(job, overwrite=True))
        assert target.stat().st_size > 1000
        assert not target.is_symlink()
        assert mine.read_text() == "mine"
        target.unlink()
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.slow
def test_one_file_that_is_there_is_found_before_any_work(folder, tmp_path):
    (tmp_path / "b.jpg").write_text("mine")
    done = run(folder, "a.jpg", "b.jpg", "c.jpg", "-o", tmp_path)
    assert done.returncode == 2
    assert "b.jpg already exists" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["b.jpg"]
    done = run(folder, "a.jpg", "b.jpg", "c.jpg", "-o", tmp_path, "--overwrite")
    assert (done.returncode, done.stderr) == (0, "")
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.parametrize("names", [("a.jpg", "A.JPG"), ("\u00e9.jpg", "e\u0301.jpg")])
def test_names_that_some_systems_take_for_one_are_refused(folder, tmp_path, names):
    inputs = []
    for name in names:
        inputs.append(tmp_path / name)
        inputs[-1].write_bytes((folder / "a.jpg").read_bytes())
    if len(list(tmp_path.iterdir())) < 2:
        pytest.skip("This file system does the same.")
    with pytest.raises(ValueError, match="have the same name"):
        undistort_files(Job(folder / "lens.json", tuple(inputs), tmp_path / "out", "30"))
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.parametrize("keep", ["same", "valid"])
def test_bad_photos_are_named_and_skipped(folder, tmp_path, keep):
    good = (folder / "a.jpg").read_bytes()
    square = cv2.imencode(".jpg", np.zeros((64, 64), np.uint8))[1].tobytes()
    bare = cv2.imencode(".jpg", picture(0))[1].tobytes()
    for name, written in (
        ("cut.jpg", good[:900]),
        ("empty.png", b""),
        ("square.jpg", square),
        ("bare.jpg", bare),
    ):
        (tmp_path / name).write_bytes(written)
    (tmp_path / "good.jpg").write_bytes(good)
    names = ["cut.jpg", "good.jpg", "none.jpg", "empty.png", "square.jpg", "bare.jpg"]
    done = run(folder, *(tmp_path / name for name in names), "-o", tmp_path / "out", "--keep", keep)
    assert done.returncode == 1, done.stderr
    assert done.stdout == f"1 of 6 photos corrected: {tmp_path / 'out'}\n"
    for name, reason in (
        ("cut.jpg", "damaged or cut off"),
        ("none.jpg", "There is no photograph"),
        ("empty.png", "the file is empty"),
        ("square.jpg", "no"),
        ("bare.jpg", "focal length of .* is not known"),
    ):
        assert re.search(rf"^Skipped .*{name}: .*{reason}", done.stderr, re.MULTILINE)
    assert len(done.stderr.splitlines()) == 5
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["good.jpg"]
    done = run(folder, tmp_path / "cut.jpg", tmp_path / "bare.jpg", "-o", tmp_path / "no", "--keep", keep)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 2
    assert not (tmp_path / "no").exists()


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


@pytest.mark.slow
def test_memory_stays_flat(folder):
    """The peak of 24 and of 240 frames: the same, and not 240 frames of 92 kB more."""
    probe = (
        "import resource, sys; from zoomjax.app.cli import main\n"
        "try:\n    main()\nfinally:\n    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    )
    peaks = []
    for frames in (24, 240):
        name = write_still(folder / f"{frames}.mkv", frames).name
        done = subprocess.run(
            [sys.executable, "-c", probe, *ARGUMENTS, name, "--focal", "30", "-o", f"flat-{frames}.mp4"],
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
