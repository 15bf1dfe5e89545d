"""Tracks in ``.npz`` files: what is saved comes back, and what else a file may hold is refused."""

import dataclasses
import warnings
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import zoomjax as zj
from zoomjax.tracks import Tracks, load_tracks

SIZE = (64, 48)


def make(dtype=np.float64, frames=9, weight=None):
    points = np.random.default_rng(3).uniform(0, 40, (9, 2)).astype(dtype)
    track, frame = [7, 7, 7, 3, 3, -5, -5, -5, -5], [0, 1, 4, 2, 3, 4, 5, 6, 7]
    return Tracks.from_arrays(track, frame, points, image_size=SIZE, frames=frames, weight=weight)


def assert_same(got, tracks):
    for one, two in zip(got.views(), tracks.views(), strict=True):
        np.testing.assert_array_equal(one, two)
        assert one.dtype == two.dtype
    assert (got.image_size, got.frames) == (tracks.image_size, tracks.frames)
    np.testing.assert_array_equal(got.number, tracks.number)
    np.testing.assert_array_equal(got.mask, tracks.mask)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_what_is_saved_is_loaded(dtype, tmp_path):
    tracks = make(dtype)
    tracks.save(tmp_path / "tracks.npz")
    assert_same(load_tracks(tmp_path / "tracks.npz"), tracks)


def test_tracks_of_one_number_are_not_saved(tmp_path):
    """The file could not be read."""
    tracks = make()
    alike = dataclasses.replace(tracks, number=np.zeros_like(tracks.number))
    with pytest.raises(ValueError, match="tracks have the number 0"):
        alike.save(tmp_path / "tracks.npz")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_weights_come_back_from_a_file_that_older_readers_refuse(dtype, tmp_path):
    """They would take all weights as equal."""
    path, weight = tmp_path / "tracks.npz", np.linspace(0, 1, 9).astype(dtype)
    versions = []
    for tracks in (make(), make(weight=weight)):
        tracks.save(path)
        loaded = load_tracks(path)
        assert_same(loaded, tracks)
        with np.load(path) as file:
            versions.append(int(file["version"]))
    assert versions == [1, 2]
    np.testing.assert_array_equal(loaded.view_weights(), tracks.view_weights())
    assert loaded.view_weights().dtype == dtype


@pytest.mark.filterwarnings("ignore:.*lie outside of the image", "ignore:.*they are copies of others")
@given(st.lists(st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=5), min_size=1, max_size=6))
def test_any_tracks_come_back(tmp_path_factory, ragged):
    path = tmp_path_factory.getbasetemp() / "any.npz"
    track = np.repeat(np.arange(len(ragged)) * 11 - 20, [len(row) for row in ragged])
    frame = np.concatenate([np.arange(len(row)) * 3 for row in ragged])
    points = np.stack([np.concatenate(ragged), frame], axis=1)
    tracks = Tracks.from_arrays(track, frame, points, image_size=SIZE, frames=20)
    tracks.save(path)
    assert_same(load_tracks(path), tracks)


@pytest.fixture
def saved(tmp_path):
    make().save(tmp_path / "tracks.npz")
    return tmp_path / "tracks.npz"


def rewrite(path, **changes):
    with np.load(path) as file:
        fields = {name: file[name] for name in file.files} | changes
    np.savez(path, **{name: value for name, value in fields.items() if value is not None})


def replace_by_zip(path):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("hello.txt", "hello")


def bomb(path):
    """Very many tracks of two views, and one of as many as all of them."""
    tracks = 30_000
    counts = np.append(np.full(tracks, 2), 2 * tracks)
    rows = counts.sum()
    rewrite(path, counts=counts, points=np.zeros((rows, 2)), frame=np.zeros(rows, int))


SPOILED = {
    "truncated": (lambda path: path.write_bytes(path.read_bytes()[:-200]), "Cannot read"),
    "empty": (lambda path: path.write_bytes(b""), "not an .npz archive"),
    "text": (lambda path: path.write_text("track,frame,x,y\n"), "not an .npz archive"),
    "other archive": (replace_by_zip, "Cannot read"),
    "lines": (lambda path: rewrite(path, format="zoomjax.lines"), "holds no tracks; Tracks.save"),
    "pickled": (lambda path: rewrite(path, points=np.array([[1, 2], None], object)), "allow_pickle"),
    "newer version": (lambda path: rewrite(path, version=99), "version is 99 .*; update zoomjax"),
    "no points": (lambda path: rewrite(path, points=None), "it has no 'points'"),
    "counts that disagree": (lambda path: rewrite(path, counts=np.array([5, 6, 7])), "disagree"),
    "negative counts": (lambda path: rewrite(path, counts=np.array([-5, 4, 10])), "disagree"),
    "numbers that disagree": (lambda path: rewrite(path, number=np.array([1, 2])), "disagree"),
    "numbers given twice": (lambda path: rewrite(path, number=np.array([1, 2, 1])), "disagree"),
    "NaN": (lambda path: rewrite(path, points=np.full((9, 2), np.nan)), "finite"),
    "frame out of range": (lambda path: rewrite(path, frame=np.arange(9) + 5), "from 0 to 8"),
    "image size": (lambda path: rewrite(path, image_size=np.array([6])), "image_size"),
    "frames": (lambda path: rewrite(path, frames=np.array([6, 7])), "Cannot read"),
    "padding": (bomb, "GB of memory"),
    "too few weights": (lambda path: rewrite(path, weight=np.ones(8)), "each of the 9 views"),
    "weights below 0": (lambda path: rewrite(path, weight=-np.ones(9)), "at least 0"),
}


@pytest.mark.parametrize(("spoil", "message"), SPOILED.values(), ids=SPOILED)
def test_a_file_that_holds_no_tracks_is_refused_in_one_sentence(spoil, message, saved):
    spoil(saved)
    with pytest.raises(ValueError, match=message) as caught:
        load_tracks(saved)
    assert str(caught.value).startswith(f"Cannot read tracks from {saved}: ")
    assert "\n" not in str(caught.value)


def test_damage_anywhere_is_an_error_that_names_the_file_or_does_none(saved):
    """One byte changed, at places spread over the whole file."""
    whole, told = saved.read_bytes(), []
    for position in range(0, len(whole), 7):
        saved.write_bytes(whole[:position] + bytes([whole[position] ^ 0x55]) + whole[position + 1 :])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                assert np.isfinite(load_tracks(saved).points).all()
            except ValueError as error:
                told.append(str(error))
    assert len(told) > 50
    assert all(str(saved) in message for message in told)


def test_a_file_is_written_whole_or_not_at_all(saved):
    with pytest.raises(FileNotFoundError):
        load_tracks(saved.with_name("none.npz"))
    before = saved.read_bytes()
    with pytest.raises(IsADirectoryError):
        make().save(saved.parent)
    assert saved.read_bytes() == before
    assert [path.name for path in saved.parent.iterdir()] == ["tracks.npz"]


@pytest.mark.usefixtures("unchecked")
def test_other_kinds_of_things_are_told(saved):
    with pytest.raises(TypeError, match="they are loaded already"):
        load_tracks(make())
    with pytest.raises(ValueError, match="holds no lines"):
        zj.load_lines(saved)


@pytest.mark.usefixtures("unchecked")
def test_what_is_no_track_is_refused():
    frame = [0, 1]
    for points in ([[1, 2j], [2, 2]], [["a", "b"], ["c", "d"]], np.array([[1, 2], [2, 2]], object)):
        with pytest.raises(ValueError, match="points must hold real numbers"):
            Tracks.from_arrays([0, 0], frame, points, image_size=SIZE)
    with pytest.warns(UserWarning, match="1 of 2 points lie outside of the image"):
        Tracks.from_arrays([0, 0], frame, [[1, 2], [1e6, 2]], image_size=SIZE)
    with pytest.raises(ValueError, match=r"frame must increase along a track, but frame\[1\] does not"):
        Tracks(
            np.zeros((2, 2, 2)), np.array([[0, 1], [1, 1]]), np.ones((2, 2), bool), SIZE, 3, np.arange(2)
        )
