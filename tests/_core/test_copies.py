"""Copies of files that are elsewhere: whole or not there, told by their URLs, made anew by workers."""

import os
from pathlib import Path

import pytest

from zoomjax._core import copies
from zoomjax._core.copies import Origin, by_url, have_copy, is_url, make_copy, origin_of, shown_url

fsspec = pytest.importorskip("fsspec")


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("s3://bucket/shots/*.jpg", True),
        ("zip://*.jpg::file:///shots.zip", True),
        ("simplecache::s3://bucket/a.jpg", True),
        ("photos/a.jpg", False),
        ("C:/photos/a.jpg", False),
        ("C://photos/a.jpg", False),
        ("/odd://name", False),
        ("a::b.jpg", False),
        ("", False),
    ],
)
def test_what_is_a_url(text, found):
    assert is_url(text) == found


def test_no_user_and_no_password_is_shown():
    assert shown_url("sftp://me:secret@host/a.jpg") == "sftp://host/a.jpg"
    assert shown_url("zip://a.jpg::ftp://me:secret@host/b@c.zip") == "zip://a.jpg::ftp://host/b@c.zip"
    assert shown_url("photos/me@home.jpg") == "photos/me@home.jpg"


@pytest.fixture
def origin(tmp_path):
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "a.jpg").write_bytes(b"whole")
    return Origin(fsspec.filesystem("file"), str(tmp_path / "there" / "a.jpg"))


def test_a_copy_knows_where_it_is_from(origin, tmp_path, monkeypatch):
    path = tmp_path / "new" / "folder" / "a.jpg"
    make_copy(origin, path)
    assert path.read_bytes() == b"whole"
    monkeypatch.chdir(path.parent)
    assert origin_of("a.jpg") == origin
    assert origin_of(Path(origin.place)) is None
    copies.forget(path)
    assert origin_of(path) is None


def test_a_copy_that_fails_is_not_there(origin, tmp_path):
    with pytest.raises(FileNotFoundError):
        make_copy(origin._replace(place=origin.place + "x"), tmp_path / "a.jpg")
    assert not list(tmp_path.glob("*.jpg"))
    assert origin_of(tmp_path / "a.jpg") is None


def test_a_worker_has_one_copy_at_a_time(origin, tmp_path):
    first, second = (tmp_path / "copies" / name / "a.jpg" for name in "xy")
    have_copy(str(first), origin)
    have_copy(str(first), origin._replace(place="nothing"))  # it is there
    assert first.read_bytes() == b"whole"
    have_copy(str(second), origin)
    assert not first.parent.exists()
    assert second.exists()
    copies.drop_copy()
    assert not (tmp_path / "copies").exists()
    assert os.path.exists(origin.place)


def test_a_file_that_is_there_is_not_removed(origin, tmp_path):
    own = tmp_path / "own.jpg"
    own.write_bytes(b"mine")
    have_copy(str(own), origin)
    copies.drop_copy()
    assert own.read_bytes() == b"mine"


def test_messages_name_urls(monkeypatch, tmp_path):
    monkeypatch.setattr(copies, "_NAMES", {})
    copies.name_by_url(tmp_path / "0", "ftp://me:secret@host/shots")
    assert by_url(f"Cannot read {tmp_path / '0'}/a.jpg.") == "Cannot read ftp://host/shots/a.jpg."
    assert by_url("Cannot read a.jpg.") == "Cannot read a.jpg."
    copies.name_by_url(tmp_path / "01", "s3://bucket")  # which begins as the other
    assert by_url(f"{tmp_path / '01'}/b.jpg") == "s3://bucket/b.jpg"
