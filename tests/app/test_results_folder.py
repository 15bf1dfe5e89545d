"""Folders of results: whatever happens, nothing that is not ours is touched, and ours is whole."""

import contextlib
import errno
import hashlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from zoomjax.app.results_folder import LIST, results_folder

OLD = {"lens.json": "old lens", "lines/0001-a.jpg": "old a", "lines/0002-b.jpg": "old b"}
NEW = {"lens.json": "new lens", "report.html": "new page", "lines/0001-a.jpg": "new a"}


def contents(folder):
    """Every file, folder and link in it, but the list, and what they hold."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.name != LIST:
            name = path.relative_to(folder).as_posix()
            is_link, is_folder = path.is_symlink(), path.is_dir()
            found[name] = os.readlink(path) if is_link else "/" if is_folder else path.read_text()
    return found


def files(folder):
    return {name: text for name, text in contents(folder).items() if text != "/"}


def fill(part, results):
    for name, text in results.items():
        (part / name).parent.mkdir(exist_ok=True)
        (part / name).write_text(text)


def write(folder, results, **settings):
    with results_folder(folder, results, clears=["lines/*"], **settings) as part:
        fill(part, results)


def test_results_appear_together_and_a_second_run_replaces_its_own(tmp_path):
    folder = tmp_path / "new" / "deep"
    with results_folder(folder, OLD) as part:
        fill(part, OLD)
        assert [path.name[:9] for path in folder.iterdir()] == [".zoomjax-"]
    assert files(folder) == OLD
    write(folder, NEW)
    assert files(folder) == NEW  # the second overlay was ours, and is gone
    assert sorted(path.name for path in folder.iterdir()) == [LIST, "lens.json", "lines", "report.html"]


FOREIGN = {
    "a file": lambda folder: (folder / "report.html").write_text("mine"),
    "an empty file": lambda folder: (folder / "report.html").write_text(""),
    "a link to a file": lambda folder: (folder / "report.html").symlink_to("../outside/kept"),
    "a link to nothing": lambda folder: (folder / "report.html").symlink_to("nowhere"),
    "a link to one of ours": lambda folder: (folder / "report.html").symlink_to("lens.json"),
    "a hard link": lambda folder: os.link(folder / "../outside/kept", folder / "report.html"),
    "a device": lambda folder: os.mkfifo(folder / "report.html"),
    "ours, edited": lambda folder: (folder / "lens.json").write_text("mine now"),
    "ours, edited to the same size": lambda folder: (folder / "lens.json").write_text("OLD lens"),
    "an overlay, edited": lambda folder: (folder / "lines/0001-a.jpg").write_text("mine now"),
    "a list that is none": lambda folder: (folder / LIST).write_text("notes"),
    "a list of another kind": lambda folder: (folder / LIST).write_text('{"files": {}}'),
    "a later version's list": lambda folder: (folder / LIST).write_text('{"zoomjax results": 2}'),
    "a deep list": lambda folder: (folder / LIST).write_text("[" * 100_000),
    "a list of odd things": lambda folder: (folder / LIST).write_text(
        '{"zoomjax results": 1, "files": {"lens.json": 3}}'
    ),
}


@pytest.fixture
def outside(tmp_path):
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "kept").write_text("kept")
    yield tmp_path / "outside"
    assert files(tmp_path / "outside") == {"kept": "kept"}


def tree(folder):
    """What is in a folder, pipes included."""
    return {
        path: (path.lstat().st_ino, path.lstat().st_size, path.lstat().st_mtime_ns)
        for path in folder.rglob("*")
    }


@pytest.mark.parametrize("kind", FOREIGN)
def test_what_zoomjax_did_not_write_is_refused_before_the_work(kind, tmp_path, outside):
    folder = tmp_path / "out"
    write(folder, OLD)
    FOREIGN[kind](folder)
    before = tree(folder)
    asks = pytest.raises(FileExistsError, match=r"would be replaced.*folder, or give argument overwrite")
    with asks, results_folder(folder, NEW):
        pytest.fail("the work began")
    assert tree(folder) == before
    with asks, results_folder(folder) as part:  # it came during the work
        fill(part, NEW)
    assert tree(folder) == before
    write(folder, NEW, overwrite=True)
    assert {name: text for name, text in files(folder).items() if name in NEW} == NEW
    assert not any((folder / name).is_symlink() for name in NEW)


@pytest.mark.parametrize("to", ["../outside", "nowhere", "."])
def test_a_link_in_place_of_a_folder_is_not_followed(to, tmp_path, outside):
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "lines").symlink_to(to)
    with pytest.raises(FileExistsError, match="lines would be replaced"):
        write(folder, NEW)
    assert contents(folder) == {"lines": to}
    write(folder, NEW, overwrite=True)
    assert files(folder) == NEW


def test_a_link_made_after_the_results_is_not_followed_to_remove_them(tmp_path, outside):
    folder = tmp_path / "out"
    write(folder, OLD)
    (folder / "lines").rename(tmp_path / "moved")
    (folder / "lines").symlink_to("../moved")
    write(folder, {"lens.json": "new lens"})
    assert files(tmp_path / "moved") == {"0001-a.jpg": "old a", "0002-b.jpg": "old b"}


def test_a_folder_in_place_of_a_file_is_never_replaced(tmp_path):
    (tmp_path / "lens.json").mkdir()
    (tmp_path / "lens.json" / "kept").write_text("kept")
    for overwrite in (False, True):
        with pytest.raises(FileExistsError, match="is a folder, but a file must be written"):
            write(tmp_path, NEW, overwrite=overwrite)
    assert files(tmp_path) == {"lens.json/kept": "kept"}


def test_what_else_is_in_the_folder_stays(tmp_path):
    theirs = {"board.jpg": "photo", "lines/notes.txt": "notes", "lines/0002-c.jpg": "their own"}
    fill(tmp_path, theirs)
    write(tmp_path, OLD)
    assert files(tmp_path) == OLD | theirs
    (tmp_path / "lines/0002-b.jpg").write_text("edited")
    write(tmp_path, NEW)
    assert files(tmp_path) == NEW | theirs | {"lines/0002-b.jpg": "edited"}


def test_what_another_command_wrote_stays_and_is_remembered(tmp_path):
    write(tmp_path, {"photos/1.jpg": "photo"})
    write(tmp_path, NEW)
    write(tmp_path, {"photos/1.jpg": "another"})
    assert files(tmp_path) == {"photos/1.jpg": "another"} | {
        name: text for name, text in NEW.items() if not name.startswith("lines/")
    }


@pytest.mark.parametrize(
    "name", ["../outside/kept", "{}/outside/kept", "a/../../outside/kept", "..", "", "\0"]
)
def test_a_list_cannot_name_what_is_outside(name, tmp_path, outside):
    folder = tmp_path / "out"
    write(folder, OLD)
    listed = json.loads((folder / LIST).read_text())
    prints = [[4, hashlib.sha256(b"kept").hexdigest()]]
    listed["files"][name.format(tmp_path)] = prints
    (folder / LIST).write_text(json.dumps(listed))
    with results_folder(folder, NEW, clears=["*", "lines/*"]) as part:
        fill(part, NEW)
    assert files(folder) == NEW


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "full"), KeyboardInterrupt(), SystemExit(143)])
@pytest.mark.parametrize("before", [None, {}, OLD], ids=["no folder", "empty", "with results"])
def test_after_a_failure_all_is_as_before(before, error, tmp_path):
    folder = tmp_path / "new" / "out"
    if before is not None:
        write(folder, before)
    was = tree(tmp_path)

    def fail(part):
        fill(part, NEW)
        raise error

    with pytest.raises(type(error)), results_folder(folder, NEW) as part:
        fail(part)
    assert set(tree(tmp_path)) == set(was)
    assert before is None or files(folder) == before


@pytest.mark.parametrize("failing", range(11))
@pytest.mark.parametrize("links", [True, False], ids=["", "no hard links"])
def test_a_failure_while_the_results_appear_is_undone(failing, links, tmp_path, monkeypatch):
    """Each renaming in turn; then none."""
    write(tmp_path, OLD)
    before = (tmp_path / LIST).read_text()
    left = failing + 1
    replace, rename = os.replace, os.rename

    def counted(do, is_one):
        def maybe(*paths):
            nonlocal left
            if is_one(paths):
                left -= 1
                if left == 0:
                    raise OSError(errno.ENOSPC, "full")
            return do(*paths)

        return maybe

    def forward(paths):
        return "old" not in Path(paths[0]).parts

    def no_link(*_, **__):
        raise OSError(errno.EPERM, "no links")

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", counted(replace, forward))
        patch.setattr(os, "rename", counted(rename, forward))
        if not links:
            patch.setattr(os, "link", no_link)
        if failing < (6 if links else 10):
            with pytest.raises(OSError, match="full"):
                write(tmp_path, NEW)
        else:
            write(tmp_path, NEW)
    assert files(tmp_path) == (OLD if left <= 0 else NEW)
    if left <= 0:
        assert (tmp_path / LIST).read_text() == before
    write(tmp_path, NEW)  # which knows all that is there
    assert files(tmp_path) == NEW


@pytest.fixture
def interruptible():
    """As in a terminal: what runs in the background of a shell inherits that Ctrl-C is ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_an_interrupt_while_the_results_appear_waits(tmp_path, monkeypatch):
    write(tmp_path, OLD)
    replace = os.replace

    def interrupted(*paths):
        signal.raise_signal(signal.SIGINT)
        replace(*paths)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", interrupted)
        with pytest.raises(KeyboardInterrupt):
            write(tmp_path, NEW)
    assert files(tmp_path) == NEW
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


KILLED = """
import os, signal, sys
from pathlib import Path
sys.path.insert(0, {tests!r})
from test_results_folder import NEW, write
replace, left = os.replace, {moment}
def dying(*paths):
    global left
    left -= 1
    if left < 0:
        os.kill(os.getpid(), signal.SIGKILL)
    replace(*paths)
os.replace = dying
write(Path({folder!r}), NEW)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs SIGKILL")
@pytest.mark.parametrize("moment", range(6))
def test_after_a_kill_every_file_is_whole_and_the_next_run_knows_them(moment, tmp_path):
    write(tmp_path, OLD)
    code = KILLED.format(tests=str(Path(__file__).parent), moment=moment, folder=str(tmp_path))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == (-signal.SIGKILL if moment < 5 else 0), done.stderr
    for name, text in files(tmp_path).items():
        if not name.startswith(".zoomjax-"):
            assert text in (OLD.get(name), NEW.get(name))
    for left in tmp_path.glob(".zoomjax-*/"):
        os.utime(left, (1e9, 1e9))  # long ago
    write(tmp_path, NEW)
    assert files(tmp_path) == NEW
    assert not list(tmp_path.glob(".zoomjax-*/"))


def test_what_is_left_is_removed_only_when_no_process_uses_it(tmp_path):
    theirs = [
        tmp_path / ".zoomjax-mine",
        tmp_path / ".zoomjax-abcdefgh.jpg",
        tmp_path / ".zoomjax-ABCDEFGH",
    ]
    for path in theirs:
        path.mkdir()
    with results_folder(tmp_path, []) as other:
        used, fresh, left = other.parent, tmp_path / ".zoomjax-0fresh_0", tmp_path / ".zoomjax-0left__0"
        for path in (fresh, left):
            path.mkdir()
        (left / "file").write_text("half")
        (link := tmp_path / ".zoomjax-0link__0").symlink_to(tmp_path)
        for path in (used, left):
            os.utime(path, (1e9, 1e9))
        write(tmp_path, NEW)
        assert [path.exists() for path in (used, fresh, left)] == [True, True, False]
        assert link.is_symlink()
        assert all(path.exists() for path in theirs)


def test_processes_that_write_one_folder_leave_the_results_of_one(tmp_path):
    sets = [
        {name: f"{text} {i}" for name, text in (NEW | {f"lines/{i}.jpg": ""}).items()} for i in range(8)
    ]
    failed = []

    def run(results):
        try:
            for _ in range(5):
                write(tmp_path / "out", results)
        except BaseException as error:
            failed.append(error)

    threads = [threading.Thread(target=run, args=(results,)) for results in sets]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert not failed
    assert files(tmp_path / "out") in sets


def test_a_folder_that_another_run_removes_again_is_made_again(tmp_path):
    stop = threading.Event()

    def others():
        while not stop.is_set():
            with contextlib.suppress(ZeroDivisionError), results_folder(tmp_path / "a" / "b"):
                _ = 1 / 0

    thread = threading.Thread(target=others)
    thread.start()
    until = time.monotonic() + 1
    try:
        while time.monotonic() < until:
            with results_folder(tmp_path / "a" / "b"):
                pass
    finally:
        stop.set()
        thread.join()


def test_a_folder_that_cannot_be_written_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(OSError, match="Cannot write in the folder"), results_folder(folder):
            pytest.fail("the work began")
    (tmp_path / "link").symlink_to("nowhere")
    with pytest.raises(OSError, match="Cannot write in the folder"), results_folder(tmp_path / "link"):
        pytest.fail("the work began")


@pytest.mark.parametrize("value", ["no", None, 0])
@pytest.mark.usefixtures("unchecked")
def test_whether_to_overwrite_is_no_word(tmp_path, value):
    (tmp_path / "lens.json").write_text("the user's")
    with (
        pytest.raises(TypeError, match=f"overwrite must be True or False, but it is {value!r}"),
        results_folder(tmp_path, ["lens.json"], overwrite=value),
    ):
        pytest.fail("the work began")
    assert (tmp_path / "lens.json").read_text() == "the user's"
