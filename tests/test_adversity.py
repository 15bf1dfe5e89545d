"""The command line where things go wrong: disks, caches, homes, folders, signals.

Whatever it is: one sentence, the right exit status, and nothing of the user's touched.
"""

import os
import shutil
import signal
import subprocess

import pytest

import zoomjax as zj
from zoomjax import scenes

from ._clips import lens, write_clip
from ._commands import COMMAND

posix = pytest.mark.skipif(os.name != "posix", reason="needs POSIX")


def zoomjax(*arguments, cwd, first="pass", **environment):
    """Run it after a statement, in an environment with these variables; None: without."""
    env = {key: value for key, value in (os.environ | environment).items() if value is not None}
    return subprocess.run(
        [*COMMAND[:2], f"{first}\n{COMMAND[2]}", *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=cwd,
        env=env,
        timeout=300,
    )


def contents(folder):
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


FORCED = ("--degree", "2", "--centre", "image")


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """Lines, and their results in ``out``."""
    folder = tmp_path_factory.mktemp("calibrated")
    lens, focal = scenes.nikkor_18_200(), scenes.focal_sweep(5)
    scenes.board_lines(lens, focal, spacing=60, noise=0.3).save(folder / "lines.npz")
    done = zoomjax("calibrate", "lines.npz", "-o", "out", *FORCED, cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def folder(calibrated, tmp_path):
    shutil.copytree(calibrated, tmp_path / "copy")
    return tmp_path / "copy"


def is_a_sentence(done, status=2):
    told = done.stderr.strip().splitlines()
    assert done.returncode == status, done.stderr
    assert "Traceback" not in done.stderr
    assert told[-1].startswith("Error: ")
    assert "[Errno" not in done.stderr
    return told[-1]


@pytest.mark.slow
def test_what_was_edited_is_replaced_only_when_that_is_asked_for(folder):
    (folder / "out" / "lens.json").write_text("edited")
    before = contents(folder)
    refused = zoomjax("calibrate", "lines.npz", "-o", "out", cwd=folder)
    told = is_a_sentence(refused)
    assert "lens.json would be replaced" in told
    assert told.endswith("give --overwrite.")
    assert "Reading the lines" not in refused.stderr
    assert contents(folder) == before
    done = zoomjax("calibrate", "lines.npz", "-o", "out", "--overwrite", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "edited" not in (folder / "out" / "lens.json").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("command", ["demo", "reproduce"])
def test_commands_refuse_what_is_not_theirs_before_the_work(command, tmp_path):
    (tmp_path / "photos").mkdir()
    for name in ("photos/board-020.56mm.jpg", "reproduce.md", "figure-05.png"):
        (tmp_path / name).write_text("mine")
    before = contents(tmp_path)
    assert "would be replaced" in is_a_sentence(zoomjax(command, "-o", tmp_path, cwd=tmp_path))
    assert contents(tmp_path) == before


@posix
@pytest.mark.exhaustive
def test_a_cache_that_a_killed_run_left_half_written_is_mended_unnoticed(folder, tmp_path):
    """JAX writes its entries in place, complains of half ones in each run, and never replaces them.

    They are in their own place: with XLA_FLAGS, their names depend on the folder.
    """
    cache = tmp_path / "cache"
    job = ("calibrate", "lines.npz", "-o", "out", *FORCED)
    assert zoomjax(*job, cwd=folder, ZOOMJAX_CACHE=str(cache)).returncode == 0
    entries = sorted((cache / "compiled").glob("*-cache"))
    assert len(entries) > 5
    for number, entry in enumerate(entries):
        entry.write_bytes(entry.read_bytes()[: 100 * (number % 3)])
    for atime in sorted((cache / "compiled").glob("*-atime"))[::2]:
        atime.unlink()
    (cache / "compiled" / "odd-cache").mkdir()  # and no "odd-atime"
    for _ in range(2):
        done = zoomjax(*job, cwd=folder, ZOOMJAX_CACHE=str(cache))
        assert done.returncode == 0, done.stderr
        assert "Warning" not in done.stderr
    mended = [entry for entry in entries if entry.is_file() and entry.stat().st_size > 500]
    assert len(mended) > 5


@posix
@pytest.mark.slow
@pytest.mark.parametrize(
    "home",
    [
        {"HOME": None},
        *(
            pytest.param(variables, marks=pytest.mark.exhaustive)
            for variables in ({"HOME": "/nowhere"}, {"HOME": ""}, {"ZOOMJAX_CACHE": "lines.npz"})
        ),
    ],
    ids=str,
)
def test_no_home_and_no_cache_do_no_harm(home, folder):
    without = {"ZOOMJAX_CACHE": None, "XDG_CACHE_HOME": "/dev/null/cache"} if "HOME" in home else {}
    before = set(contents(folder))
    done = zoomjax("calibrate", "lines.npz", "-o", "out", cwd=folder, **(without | home))
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr
    assert set(contents(folder)) == before


@posix
@pytest.mark.slow
def test_a_file_that_may_not_grow_is_told(folder):
    before = contents(folder)
    limit = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))"
    done = zoomjax("calibrate", "lines.npz", "-o", "out", cwd=folder, first=limit)
    assert is_a_sentence(done) == "Error: File too large: out"
    assert contents(folder) == before


@pytest.fixture
def mounted(tmp_path):
    """A function that mounts a small file system in memory."""
    made = []

    def mount(where, options):
        where.mkdir(exist_ok=True)
        command = ["mount", "-t", "tmpfs", "-o", options, "zoomjax-test", str(where)]
        if not shutil.which("mount") or subprocess.run(command, capture_output=True).returncode:
            pytest.skip("needs to mount")
        made.append(where)
        return where

    yield mount
    for where in reversed(made):
        subprocess.run(["umount", str(where)], check=True)


@posix
@pytest.mark.slow
def test_a_full_disk_is_told(folder, mounted):
    disk = mounted(folder / "disk", "size=300k")
    (disk / "mine").write_bytes(bytes(200_000))
    before = contents(folder)
    told = is_a_sentence(zoomjax("calibrate", "lines.npz", "-o", "disk/out", cwd=folder))
    assert told == "Error: No space left on device: disk/out"
    assert contents(folder) == before
    assert not (disk / "out").exists()


@posix
@pytest.mark.parametrize("suffix", [".mkv", ".mp4"])
def test_a_video_on_a_full_disk_is_told(suffix, tmp_path, mounted):
    """And not as one that the container does not take."""
    source = write_clip(tmp_path / "in.mkv", encoder="ffv1", sound=False)
    disk = mounted(tmp_path / "disk", "size=64k")
    (disk / "mine").write_bytes(bytes(60_000))
    with pytest.raises(OSError, match="No space left on device"):
        zj.undistort_video(source, disk / f"out{suffix}", lens=lens(), focal=20.0)
    assert [path.name for path in disk.iterdir()] == ["mine"]


@pytest.mark.slow
@posix
def test_a_read_only_folder_is_told_before_the_work(folder, mounted):
    mounted(folder / "disk", "ro")
    for output in ("disk", "disk/out"):
        done = zoomjax("calibrate", "lines.npz", "-o", output, cwd=folder)
        assert f"Cannot write in the folder {output}: Read-only file system." in is_a_sentence(done)
        assert "Reading the lines" not in done.stderr


@posix
@pytest.mark.slow
def test_two_processes_in_one_folder_leave_the_results_of_one(folder):
    lens, focal = scenes.nikkor_18_200(), scenes.focal_sweep(5)
    scenes.board_lines(lens, focal, spacing=60, noise=0.6).save(folder / "noisy.npz")
    begun = [
        subprocess.Popen(
            [*COMMAND, "calibrate", name, "-o", "new"], cwd=folder, stderr=subprocess.PIPE, text=True
        )
        for name in ("lines.npz", "noisy.npz")
    ]
    for process in begun:
        assert process.wait(300) == 0, process.stderr.read()
        process.stderr.close()
    new = contents(folder / "new")
    if new["lens.json"] == (folder / "out" / "lens.json").read_bytes():
        assert new["summary.json"] == (folder / "out" / "summary.json").read_bytes()
    assert set(new) == set(contents(folder / "out"))
    done = zoomjax("calibrate", "lines.npz", "-o", "new", cwd=folder)
    assert done.returncode == 0, done.stderr


@posix
@pytest.mark.slow
def test_signals_at_random_moments_lose_nothing():
    from benchmarks.reliability_interrupt import run

    for row in run(4, seed=3, names=("lines", "undistort", "export")).values():
        assert row["tried"] == 4
        assert not row["seen"]
        assert not any(row[what] for what in ("wrong", "lost", "crashed", "hung"))


@posix
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_that_a_library_swallows_ends_the_run_before_the_next_step(number, folder):
    """Deterministic: it arrives in a destructor, which Python lets raise nothing."""
    first = f"""
import signal; signal.signal(signal.SIGINT, signal.default_int_handler)
import zoomjax.lines.npz
load = zoomjax.lines.npz.load_lines
class Swallow:
    def __del__(self):
        signal.raise_signal({int(number)})
def swallowing(path):
    Swallow()
    print("went on", flush=True)
    return load(path)
zoomjax.lines.npz.load_lines = swallowing
"""
    before = contents(folder)
    done = zoomjax("calibrate", "lines.npz", "-o", "out", cwd=folder, first=first)
    assert "went on" in done.stdout
    assert "ignored" not in done.stderr
    assert done.returncode == 128 + number
    told = {signal.SIGINT: "Interrupted.", signal.SIGTERM: "Ended by a signal."}[number]
    assert done.stderr.rstrip().endswith(told)
    assert "Fitting" not in done.stderr
    assert contents(folder) == before


@posix
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_jax_is_imported_aborts_nothing(number, folder):
    """Raised as an exception there, it goes through C++ that has no use for it."""
    first = f"""
import signal; signal.signal(signal.SIGINT, signal.default_int_handler)
import enum
make = enum.EnumType.__call__
def signalled(*arguments, **settings):
    import sys
    if "jaxlib._jax" in sys.modules or "jaxlib" in sys.modules:
        signal.raise_signal({int(number)})
    return make(*arguments, **settings)
enum.EnumType.__call__ = signalled
"""
    done = zoomjax("calibrate", "lines.npz", "-o", "new", cwd=folder, first=first)
    assert done.returncode == 128 + number, done.stderr
    assert done.stderr in ("Interrupted.\n", "Ended by a signal.\n")
    assert not (folder / "new").exists()


@posix
def test_ended_by_a_signal_it_says_so(folder):
    process = subprocess.Popen(
        [*COMMAND, "calibrate", "lines.npz", "-o", "new"], cwd=folder, stderr=subprocess.PIPE, text=True
    )
    while not (folder / "new").exists():
        assert process.poll() is None
    process.send_signal(signal.SIGTERM)
    _, stderr = process.communicate(timeout=120)
    assert process.returncode == 128 + signal.SIGTERM
    assert stderr.rstrip().endswith("Ended by a signal.")
    assert not (folder / "new").exists()
