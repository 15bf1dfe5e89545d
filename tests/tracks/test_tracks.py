"""Tracks as padded tensors, from one entry a view."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zoomjax.tracks import Tracks


@given(st.data())
def test_views_come_back_in_any_order(data):
    length = data.draw(st.lists(st.integers(2, 5), min_size=1, max_size=6))
    track = np.repeat(np.arange(len(length)) * 7, length)
    frame = np.concatenate([np.arange(n) * 2 for n in length])
    points = np.stack([track + 0.5, frame + 0.25], axis=1)
    order = data.draw(st.permutations(range(len(track))))
    tracks = Tracks.from_arrays(track[order], frame[order], points[order], image_size=(64, 48))
    assert np.asarray(tracks.number).tolist() == sorted(set(track.tolist()))
    row, view = np.nonzero(np.asarray(tracks.mask))
    np.testing.assert_array_equal(np.asarray(tracks.frame)[row, view], frame)
    np.testing.assert_array_equal(np.asarray(tracks.points)[row, view], points)
    assert tracks.frames == frame.max() + 1


def test_copies_of_tracks_under_other_names_are_dropped():
    """They count as independent: focal lengths of a fit of each track twice are told √2 too narrowly."""
    track, frame = [5, 5, 2, 2, 9, 9, 9, 7, 7], [0, 1, 1, 0, 0, 1, 2, 1, 2]
    points = [[1.5, 2], [2, 2], [2, 2], [1.5, 2], [1.5, 2], [2, 2], [3, 2], [1.5, 2], [2, 2]]
    with pytest.warns(UserWarning, match=r"Dropped 1 of 4 tracks: .* as 5 is, and would count twice"):
        tracks = Tracks.from_arrays(track, frame, points, image_size=(8, 6))
    assert tracks.number.tolist() == [2, 7, 9]
    assert tracks.views()[2].tolist() == [[1.5, 2], [2, 2], [1.5, 2], [2, 2], *points[4:7]]


def test_tracks_of_one_view_are_dropped():
    with pytest.warns(UserWarning, match="Dropped 1 of 2 tracks"):
        tracks = Tracks.from_arrays([3, 3, 4], [0, 1, 0], np.zeros((3, 2)), image_size=(8, 6))
    assert np.asarray(tracks.number).tolist() == [3]


@pytest.mark.parametrize(
    ("track", "frame", "points", "frames", "message"),
    [
        ([0, 0], [0, 0], np.zeros((2, 2)), None, "two views in frame 0"),
        ([0, 1], [0, 0], np.zeros((2, 2)), None, "No track has two views"),
        ([0, 0], [0, 1], [[0, 0], [np.nan, 1]], None, r"points\[1\]"),
        ([0, 0], [0, 5], np.zeros((2, 2)), 3, "from 0 to 2"),
        ([0, 0], [-1, 5], np.zeros((2, 2)), None, "from 0"),
        ([0.0, 0.0], [0, 1], np.zeros((2, 2)), None, "one integer a view"),
        ([0, 0], [0, 1], np.zeros((2, 3)), None, "one entry a view"),
        ([], [], np.zeros((0, 2)), None, "one integer a view"),
    ],
)
def test_mistakes_are_told(track, frame, points, frames, message):
    with pytest.raises(ValueError, match=message):
        Tracks.from_arrays(track, frame, points, image_size=(8, 6), frames=frames)


def test_sizes_and_masks_are_checked():
    good = Tracks.from_arrays([0, 0], [0, 1], np.zeros((2, 2)), image_size=(8, 6))
    with pytest.raises(ValueError, match="mask"):
        Tracks(good.points, good.frame, good.mask[:, :1], (8, 6), 2, good.number)
    with pytest.raises(ValueError, match="from 0 to 0"):
        Tracks(good.points, good.frame, good.mask, (8, 6), 1, good.number)


@pytest.mark.parametrize("frame", [[0, 1, 0], [2, 0, 1], [1, 1, 1]])
def test_frames_increase_across_views_that_are_not_there(frame):
    """A view that is masked out does not part a track in two: a point is in one place in a frame."""
    given = {"points": np.zeros((1, 3, 2)), "image_size": (8, 6), "frames": 3, "number": np.zeros(1, int)}
    with pytest.raises(ValueError, match=r"frame must increase along a track, but frame\[0\] does not"):
        Tracks(frame=np.array([frame]), mask=np.array([[True, False, True]]), **given)
    Tracks(frame=np.array([[0, 0, 1]]), mask=np.array([[True, False, True]]), **given)


def weighted(weight, **options):
    track, frame = [7, 3, 7, 3, 3], [1, 0, 0, 4, 2]
    points = np.arange(10.0).reshape(5, 2) / 2
    return Tracks.from_arrays(track, frame, points, image_size=(8, 6), weight=weight, **options)


def test_weights_go_with_their_views():
    tracks = weighted([0.5, 1, 2, 0, 3])
    assert tracks.mask.tolist() == [[True, True, True], [True, True, False]]
    assert np.asarray(tracks.weight)[np.asarray(tracks.mask)].tolist() == [1, 3, 0, 2, 0.5]
    assert tracks.view_weights().tolist() == [1, 3, 0, 2, 0.5]
    again = Tracks.from_arrays(*tracks.views(), image_size=(8, 6), weight=tracks.view_weights())
    np.testing.assert_array_equal(again.weight, tracks.weight)
    assert weighted(None).weight is None
    assert weighted(None).view_weights() is None


def test_weights_of_tracks_that_are_dropped_go_with_them():
    with pytest.warns(UserWarning, match="Dropped 1 of 2 tracks"):
        tracks = Tracks.from_arrays(
            [3, 4, 3], [0, 0, 1], np.zeros((3, 2)), image_size=(8, 6), weight=[1, 5, 2]
        )
    assert tracks.view_weights().tolist() == [1, 2]
    with (
        pytest.warns(UserWarning, match="Dropped 1 of 2 tracks"),
        pytest.raises(ValueError, match="No track of two views has a weight above 0"),
    ):
        Tracks.from_arrays([3, 4, 3], [0, 0, 1], np.zeros((3, 2)), image_size=(8, 6), weight=[0, 5, 0])


@pytest.mark.parametrize(("weight", "stays"), [([1, 1, 1, 1], 3), ([0, 1, 0, 0.5], 4), ([2, 1, 0, 0.5], 3)])
def test_of_copies_the_heaviest_stays(weight, stays):
    given = [3, 4, 3, 4], [0, 0, 1, 1], [[1, 2], [1, 2], [3, 2], [3, 2]]
    with pytest.warns(UserWarning, match=f"copies of others, with the same views, as {7 - stays} is"):
        tracks = Tracks.from_arrays(*given, image_size=(8, 6), weight=weight)
    assert tracks.number.tolist() == [stays]
    assert tracks.view_weights().tolist() == [
        of for of, track in zip(weight, given[0], strict=True) if track == stays
    ]


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("weight", "message"),
    [
        ([1, 1, 1, 1], r"one real number for each of the 5 views, but its shape is \(4,\)"),
        (1.0, r"one real number for each of the 5 views, but its shape is \(\)"),
        (["a"] * 5, "one real number for each of the 5 views, but it is"),
        ([1, 1, -0.5, 1, 1], r"at least 0 .* it has -0.5: give views that must not count weight 0"),
        ([1, 1, np.nan, 1, 1], "it has nan: give views that must not count weight 0"),
        ([1, 1, np.inf, 1, 1], "it has inf"),
        ([0] * 5, "0 for all: leave it out for equal weights"),
    ],
)
def test_what_is_no_weight_is_told(weight, message):
    with pytest.raises(ValueError, match=message):
        weighted(weight)


def test_weights_of_padding_do_not_matter():
    good = weighted([0.5, 1, 2, 0, 3])
    fields = [np.asarray(of) for of in (good.points, good.frame, good.mask)]
    weight = np.where(good.mask, good.weight, np.nan)
    Tracks(*fields, (8, 6), 5, good.number, weight)
    weight[0, 0] = -1
    with pytest.raises(ValueError, match="weight must be finite and at least 0"):
        Tracks(*fields, (8, 6), 5, good.number, weight)
    with pytest.raises(ValueError, match="weight must have shape"):
        Tracks(*fields, (8, 6), 5, good.number, weight[:, :1])
