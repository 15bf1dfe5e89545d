"""Tracks found again where the camera comes back: how exact these views are, and what is refused."""

import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.scenes import leaves, motion_clip, pan_and_zoom
from zoomjax.tracks import Tracks, find_again, track_video

from .._clips import write_frames

SIZE, FRAMES = (448, 256), 24


@pytest.fixture(scope="module")
def clip():
    """Pans away and comes back, zoomed by 1:1.2."""
    zoom = zj.PolynomialZoom(1, jnp.array([[-0.02, 0.002], [-0.05, 0.01]]), jnp.array(310.0))
    lens = zj.ZoomLens(zoom, (jnp.array(SIZE) - 1) / 2 + 3, jnp.array([310.0, 372.0]), SIZE, "px")
    path = pan_and_zoom(lens, FRAMES, pan=40)
    return motion_clip(lens, *path, texture=leaves((1024, 512)), noise=1.5)


@pytest.fixture(scope="module")
def video(clip, tmp_path_factory):
    return write_frames(tmp_path_factory.mktemp("again") / "clip.mp4", clip.frames())


@pytest.fixture(scope="module")
def tracks(video):
    return track_video(video, life=8)


def carried(clip, off=0.0):
    """Where the truth says that frames show points, `off` px to the right."""

    def carry(frame, points, other):
        rays = np.zeros((len(points), 3))
        for m in np.unique(frame):
            rays[frame == m] = clip.rays(int(m), points[frame == m])
        return clip.points(other, rays) + np.array([off, 0])

    return carry


@pytest.mark.slow
def test_points_are_found_again_where_the_camera_comes_back(clip, video, tracks):
    more = find_again(video, tracks, carry=carried(clip, 1.0), every=2)
    number, frame, points = more.views()
    first = np.searchsorted(number, number)
    gained = len(number) - len(tracks.views()[0])
    assert gained > 0.05 * len(number)
    long = frame - frame[first] > 9
    assert long.sum() >= gained
    assert not frame[long].max() > FRAMES
    late = np.flatnonzero(long)
    truth = np.array(
        [carried(clip)(frame[first[[i]]], points[first[[i]]].astype(float), int(frame[i]))[0] for i in late]
    )
    missed = np.linalg.norm(points[late] - truth, axis=1)
    assert np.sqrt(np.mean(np.minimum(missed, 1) ** 2)) < 0.25
    assert np.mean(missed < 0.5) > 0.95


def test_every_says_in_which_frames(clip, video, tracks):
    number, frame, _ = tracks.views()
    known = set(zip(number.tolist(), frame.tolist(), strict=True))
    number, frame, _ = find_again(video, tracks, carry=carried(clip), every=5).views()
    new = {pair for pair in zip(number.tolist(), frame.tolist(), strict=True) if pair not in known}
    assert new
    assert all(moment % 5 == 0 for _, moment in new)


@pytest.mark.slow
def test_points_are_looked_for_in_no_copies(clip, tmp_path):
    """Every frame is there twice: the second says nothing that the first does not."""
    path = write_frames(tmp_path / "twice.mp4", np.repeat(list(clip.frames()), 2, axis=0))
    tracks = track_video(path, life=16)
    truth = carried(clip)
    more = find_again(
        path, tracks, carry=lambda frame, points, other: truth(frame // 2, points, other // 2)
    )
    known, found = (
        set(zip(number.tolist(), frame.tolist(), strict=True))
        for number, frame, _ in (tracks.views(), more.views())
    )
    assert found > known
    assert {moment % 2 for _, moment in found - known} == {0}


def test_new_views_have_the_largest_weight_of_their_track(clip, video, tracks):
    number, frame, _ = tracks.views()
    weight = 1 + number % 3 + 0.1 * (frame % 2)
    given = Tracks.from_arrays(*tracks.views(), image_size=tracks.image_size, frames=FRAMES, weight=weight)
    more = find_again(video, given, carry=carried(clip), every=5)
    known = dict(zip(zip(number.tolist(), frame.tolist(), strict=True), weight, strict=True))
    of_track = np.zeros(number.max() + 1)
    np.maximum.at(of_track, number, weight)
    pairs = [(int(track), int(moment)) for track, moment, _ in zip(*more.views(), strict=True)]
    expected = [known.get((track, moment), of_track[track]) for track, moment in pairs]
    assert len(pairs) > len(known)
    np.testing.assert_allclose(more.view_weights(), expected)


def test_what_is_not_there_is_not_found(clip, video, tracks):
    count = len(tracks.views()[0])
    wrong = find_again(video, tracks, carry=carried(clip, 40.0))
    assert len(wrong.views()[0]) < 1.02 * count
    nowhere = find_again(video, tracks, carry=lambda frame, points, other: np.full_like(points, np.nan))
    assert len(nowhere.views()[0]) == count


def test_every_is_a_number_of_frames(clip, video, tracks):
    with pytest.raises(ValueError, match="every"):
        find_again(video, tracks, carry=carried(clip), every=0)
