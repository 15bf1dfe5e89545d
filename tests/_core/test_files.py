"""Writing whole files, and only where nothing is lost."""

import os
import signal
import tempfile

import pytest

from zoomjax._core.files import (
    refuse_existing,
    refuse_inputs,
    refuse_links,
    remove_left,
    settled,
    whole_file,
    whole_folder,
)
from zoomjax.app.results_folder import results_folder


def test_what_is_there_is_not_replaced_unless_that_is_given(tmp_path):
    targets = [tmp_path / name for name in ("a.jpg", "b.jpg", "c.jpg")]
    refuse_existing(targets, overwrite=False)
    targets[1].write_text("mine")
    with pytest.raises(FileExistsError, match=r"b\.jpg already exists and .* give argument overwrite\.$"):
        refuse_existing(targets, overwrite=False)
    targets[2].symlink_to(tmp_path / "nowhere")
    with pytest.raises(FileExistsError, match=r"b\.jpg and 1 more file already exist"):
        refuse_existing(iter([*targets, targets[1]]), overwrite=False)
    refuse_existing(targets, overwrite=True)


@pytest.mark.parametrize("name", ["a.json", "a" * 250 + ".json", "ü" * 125 + ".json", "new\nline"])
def test_a_file_appears_whole_or_stays_as_it_was(name, tmp_path):
    def fail(part):
        part.write_text("half")
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError), whole_file(tmp_path / name) as part:
        fail(part)
    assert not list(tmp_path.iterdir())
    with whole_file(tmp_path / name) as part:
        assert part.parent == tmp_path
        part.write_text("first")
    with pytest.raises(ZeroDivisionError), whole_file(tmp_path / name) as part:
        fail(part)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["first"]


@pytest.mark.parametrize("to", ["kept", "nowhere"])
def test_a_link_is_replaced_and_not_followed(to, tmp_path):
    (tmp_path / "kept").write_text("kept")
    (tmp_path / "link").symlink_to(to)
    with whole_file(tmp_path / "link") as part:
        part.write_text("new")
    assert not (tmp_path / "link").is_symlink()
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"kept": "kept", "link": "new"}


def test_what_is_no_ordinary_file_is_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("pipe")
    (tmp_path / "null").symlink_to("/dev/null")
    for name in ("pipe", "link", "null"):
        before = (tmp_path / name).lstat()  # reading a link, to follow it, changes its time of access
        with pytest.raises(FileExistsError, match="in place of a device"), whole_file(tmp_path / name):
            pytest.fail("the work began")
        after = (tmp_path / name).lstat()
        assert all(getattr(after, of) == getattr(before, of) for of in ("st_ino", "st_mode", "st_mtime_ns"))


def test_parts_that_no_process_uses_are_removed(tmp_path):
    left, theirs = tmp_path / ".zoomjax-0left__0.part", tmp_path / ".mine.12345678.part"
    folder, link = tmp_path / ".zoomjax-0folder0.part", tmp_path / ".zoomjax-0link__0.part"
    left.write_text("half")
    theirs.write_text("half")
    folder.mkdir()
    link.symlink_to(theirs)
    os.mkfifo(tmp_path / ".zoomjax-0pipe__0.part")
    with whole_file(tmp_path / "video.mp4") as used:
        used.write_text("half")
        for path in (left, theirs, used, folder):
            os.utime(path, (1e9, 1e9))
        remove_left(tmp_path)
        assert not left.exists()
        assert used.exists()
    names = {theirs.name, folder.name, link.name, ".zoomjax-0pipe__0.part", "video.mp4"}
    assert {path.name for path in tmp_path.iterdir()} == names
    remove_left(tmp_path / "nowhere")


def test_a_folder_that_is_not_there_hides_nothing(tmp_path, monkeypatch):
    """``new/../a`` is not found while ``new`` is missing, and is ``a`` once somebody makes it."""
    (tmp_path / "a").write_text("mine")
    (tmp_path / "there").mkdir()
    hidden = tmp_path / "new" / ".." / "a"
    assert not hidden.exists()
    assert settled(hidden).samefile(tmp_path / "a")
    assert settled(tmp_path / "new" / "..").samefile(tmp_path)
    assert settled(tmp_path / "new" / "deep" / ".." / ".." / "b").parent.samefile(tmp_path)
    for plain in ("a", "new/b", "there/../a"):
        assert settled(tmp_path / plain) == tmp_path / plain
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileExistsError, match="already exists"):
        refuse_existing([hidden], overwrite=False)
    with pytest.raises(ValueError, match="is the input"):
        refuse_inputs([hidden], [tmp_path / "a"])
    with pytest.raises(ValueError, match="is not in the folder"):
        refuse_links(tmp_path / "out", [tmp_path / "out" / "b", tmp_path / "out" / ".." / "a"])


def test_a_folder_in_place_of_a_file_is_told_before_any_is_replaced(tmp_path):
    (tmp_path / "out" / "b").mkdir(parents=True)
    (tmp_path / "out" / "a").write_text("mine")

    def fill(part):
        for name in ("a", "b"):
            (part / name).write_text("new")

    with pytest.raises(IsADirectoryError, match="folder"), whole_folder(tmp_path / "out") as part:
        fill(part)
    assert (tmp_path / "out" / "a").read_text() == "mine"


@pytest.mark.skipif(os.name == "nt", reason="a signal there ends the process")
@pytest.mark.parametrize("maker", [whole_file, whole_folder, results_folder])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_as_something_is_made_leaves_nothing(maker, number, tmp_path, monkeypatch):
    """It comes when the temporary file is there, and nobody else knows its name yet."""
    name = "mkstemp" if maker is whole_file else "mkdtemp"
    make = getattr(tempfile, name)

    def disturbed(**options):
        made = make(**options)
        os.kill(os.getpid(), number)
        return made

    def end(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(tempfile, name, disturbed)
    before = signal.signal(number, end)
    try:
        with pytest.raises(KeyboardInterrupt), maker(tmp_path / "new"):
            pytest.fail("the signal comes before")
    finally:
        signal.signal(number, before)
    assert not list(tmp_path.iterdir())
