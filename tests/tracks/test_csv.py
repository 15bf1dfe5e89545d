"""Tracks as CSV: what is read back, and what is refused with which words."""

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zoomjax.tracks import Tracks, load_tracks, read_tracks_csv, write_tracks_csv

SIZE = (64, 48)


@pytest.mark.filterwarnings("ignore:.*lie outside of the image")
@given(data=st.data(), dtype=st.sampled_from([np.float32, np.float64]))
def test_what_is_written_is_read_back_to_the_last_digit(data, dtype, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "tracks.csv"
    length = data.draw(st.lists(st.integers(2, 5), min_size=1, max_size=5))
    width = 32 if dtype == np.float32 else 64
    numbers = st.floats(-1e6, 1e6, width=width)
    points = data.draw(st.lists(numbers, min_size=2 * sum(length), max_size=2 * sum(length)))
    tracks = Tracks.from_arrays(
        np.repeat(np.arange(len(length)) * 5 - 3, length),
        np.concatenate([np.arange(n) * 2 for n in length]),
        np.array(points, dtype).reshape(-1, 2),
        image_size=SIZE,
        frames=12,
    )
    write_tracks_csv(tracks, path)
    read = read_tracks_csv(path, image_size=SIZE, frames=12)
    for one, two in zip(read.views(), tracks.views(), strict=True):
        np.testing.assert_array_equal(one.astype(two.dtype), two)
    assert read.frames == 12


def write(path, text):
    path.write_text(text)
    return path


def test_columns_and_rows_in_any_order(tmp_path):
    text = "y;x;note;track;frame\n1;2,5;a;9;3\n3;4;b;-1;0\n5;6;a;9;1\n7;8;c;-1;1\n"
    tracks = read_tracks_csv(write(tmp_path / "t.csv", text), image_size=SIZE)
    assert tracks.frames == 4
    track, frame, points = tracks.views()
    assert track.tolist() == [-1, -1, 9, 9]
    assert frame.tolist() == [0, 1, 1, 3]
    assert points.tolist() == [[4, 3], [8, 7], [6, 5], [2.5, 1]]


def test_weights_are_one_more_column(tmp_path, rng):
    text = "weight,x,y,track,frame\n1,2,3,9,3\n0,4,5,9,1\n0.25,6,7,-1,0\n1e-3,8,9,-1,1\n"
    tracks = read_tracks_csv(write(tmp_path / "t.csv", text), image_size=SIZE)
    assert tracks.view_weights().tolist() == [0.25, 1e-3, 0, 1]
    track, frame, points = tracks.views()
    weight = rng.uniform(0, 2, 4).astype(np.float32)
    tracks = Tracks.from_arrays(track, frame, points, image_size=SIZE, weight=weight)
    write_tracks_csv(tracks, tmp_path / "t.csv")
    assert (tmp_path / "t.csv").read_text().startswith("track,frame,x,y,weight\n")
    read = read_tracks_csv(tmp_path / "t.csv", image_size=SIZE)
    np.testing.assert_array_equal(read.view_weights().astype(np.float32), weight)
    np.testing.assert_array_equal(read.views()[2], points)


HEAD = "track,frame,x,y\n"
WEIGHED = "track,frame,x,y,weight\n"
REFUSED = {
    "empty": ("", 'must name the columns "track,frame,x,y"'),
    "column missing": ("track,frame,x\n0,0,1\n", 'must name the columns "track,frame,x,y"'),
    "no rows": (HEAD, "there are no rows"),
    "words": (f"{HEAD}0,0,1,one\n", "y in row 2 is 'one', which is no number"),
    "nan": (f"{HEAD}0,0,nan,1\n", "x in row 2 is 'nan', which is no number"),
    "half a track": (f"{HEAD}0.5,0,1,1\n", "track in row 2 must be an integer"),
    "half a frame": (f"{HEAD}0,0,1,1\n0,1.5,1,1\n", "frame in row 3 must be an integer"),
    "negative frame": (f"{HEAD}0,-1,1,1\n0,1,1,1\n", "from 0, but it has -1"),
    "enormous track": (f"{HEAD}9e12,0,1,1\n", "integers of 32 bits"),
    "two views": (f"{HEAD}4,0,1,1\n4,0,2,2\n", "Track 4 has two views in frame 0"),
    "weight below 0": (f"{WEIGHED}0,0,1,1,1\n0,1,2,2,-3\n", "at least 0 .* it has -3"),
    "no weight": (f"{WEIGHED}0,0,1,1,1\n0,1,2,2,\n", "weight in row 3 is empty"),
    "weights of 0": (f"{WEIGHED}0,0,1,1,0\n0,1,2,2,0\n", "0 for all"),
    "one view": (f"{HEAD}0,0,1,1\n1,0,2,2\n", "No track has two views"),
}


@pytest.mark.parametrize(("text", "message"), REFUSED.values(), ids=REFUSED)
def test_what_holds_no_tracks_is_refused_in_one_sentence(text, message, tmp_path):
    path = write(tmp_path / "t.csv", text)
    with pytest.raises(ValueError, match=message) as caught:
        read_tracks_csv(path, image_size=SIZE)
    assert str(caught.value).startswith(f"Cannot read tracks from {path}: ")
    assert "\n" not in str(caught.value)


def test_frames_beyond_the_clip_and_no_file(tmp_path):
    path = write(tmp_path / "t.csv", f"{HEAD}0,0,1,1\n0,7,1,1\n")
    with pytest.raises(ValueError, match="from 0 to 4"):
        read_tracks_csv(path, image_size=SIZE, frames=5)
    with pytest.raises(FileNotFoundError):
        read_tracks_csv(tmp_path / "none.csv", image_size=SIZE)


def test_tracks_of_one_view_are_dropped(tmp_path):
    path = write(tmp_path / "t.csv", f"{HEAD}0,0,1,1\n0,1,1,1\n8,1,1,1\n")
    with pytest.warns(UserWarning, match="Dropped 1 of 2 tracks"):
        assert read_tracks_csv(path, image_size=SIZE).number.tolist() == [0]


def test_digits_are_kept_where_jax_has_none(tmp_path, rng):
    """A file that is read and written would lose what float32 does not hold."""
    places = rng.uniform(0, 600, (10, 2))
    rows = [
        f"{track},{frame},{x!r},{y!r}"
        for (track, frame), (x, y) in zip(
            [(track, frame) for track in (0, 1) for frame in range(5)], places.tolist(), strict=True
        )
    ]
    (tmp_path / "a.csv").write_text("\n".join(["track,frame,x,y", *rows]))
    with jax.enable_x64(False):
        tracks = read_tracks_csv(tmp_path / "a.csv", image_size=(640, 640))
        write_tracks_csv(tracks, tmp_path / "b.csv")
        tracks.save(tmp_path / "c.npz")
        loaded = load_tracks(tmp_path / "c.npz")
    assert (tmp_path / "b.csv").read_text().split() == (tmp_path / "a.csv").read_text().split()
    for each in (tracks, loaded):
        assert each.points.dtype == np.float64
        np.testing.assert_array_equal(each.views()[2], places)
