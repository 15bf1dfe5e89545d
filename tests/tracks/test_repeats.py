"""Frames that repeat the one before them: found by their points, in clips as converters make them."""

import numpy as np
import pytest

from zoomjax.scenes import motion_clip, motion_tracks, pan_and_zoom
from zoomjax.tracks import Tracks, track_frames, track_video
from zoomjax.tracks.repeats import copies, counted_once, originals, without_rests

from .._clips import write_frames
from .test_video import FRAMES, SIZE, encoded, lens, make, plain, texture

__all__ = ["encoded", "plain", "texture"]

AT_30 = [2 if n % 5 == 4 else 1 for n in range(FRAMES)]
AT_60 = [3, 2] * (FRAMES // 2)


def shown_first(times):
    """Of frames shown so many times each, the first that shows the same."""
    return np.repeat(np.cumsum(times) - times, times)


def repeated(tracks, times):
    """Tracks of a clip of which each frame is shown so many times."""
    track, frame, points = tracks.views()
    often = np.asarray(times)[frame]
    again = np.arange(often.sum()) - np.repeat(np.cumsum(often) - often, often)
    return Tracks.from_arrays(
        np.repeat(track, often),
        np.repeat((np.cumsum(times) - times)[frame], often) + again,
        np.repeat(points, often, axis=0),
        image_size=tracks.image_size,
        frames=int(np.sum(times)),
    )


@pytest.mark.parametrize("times", [AT_30, AT_60], ids=["25 to 30", "24 to 60"])
@pytest.mark.parametrize("crf", ["15", "30"])
def test_copies_are_found_in_encoded_clips(plain, tmp_path, times, crf):
    path = tmp_path / "clip.mp4"
    frames = [plain[1][n] for n in np.repeat(np.arange(FRAMES), times)]
    tracks = track_video(write_frames(path, frames, options={"crf": crf, "g": "12"}))
    found, truth = originals(tracks), shown_first(times)
    assert np.mean(found == truth) > 0.95
    assert (found >= truth).all()  # none is taken for a copy that is not
    moments = without_rests(found, tracks)  # but for those at the ends of the clip
    np.testing.assert_array_equal(moments[3:-3], found[3:-3])


def test_a_frame_that_was_dropped_leaves_a_copy(plain):
    shown = [n - (n == 9) for n in range(FRAMES)]
    tracks = track_frames([plain[1][n] for n in shown])
    first = originals(tracks)
    assert np.flatnonzero(first != np.arange(FRAMES)).tolist() == [9]
    assert first[9] == 8


def test_clips_without_copies_have_none(encoded, texture):
    slow = make(texture, pan=0.7)
    for tracks in (track_video(encoded), track_frames(slow.frames())):
        np.testing.assert_array_equal(originals(tracks), np.arange(FRAMES))


@pytest.fixture(scope="module")
def resting(texture):
    """A camera that turns, slows down, rests for ten frames, and turns on."""
    focal, rotation = pan_and_zoom(lens(), 48, pan=12)
    speed = np.repeat([1.0, 0.6, 0.3, 0.1, 0, 0.1, 0.3, 0.6, 1], [6, 1, 1, 1, 10, 1, 1, 1, 6])
    at = np.concatenate([[0], np.cumsum(speed)])
    frame = np.clip(at.astype(int), 0, 46)
    share = (at - frame)[:, None, None]
    turned = (1 - share) * rotation[frame] + share * rotation[frame + 1]
    left, _, right = np.linalg.svd(turned)
    f = np.interp(at, np.arange(48), focal)
    return list(motion_clip(lens(), f, left @ right, texture=texture, noise=1.5).frames())


def test_frames_of_a_camera_that_rests_are_no_copies_where_their_noise_differs(resting):
    tracks = track_frames(resting)
    np.testing.assert_array_equal(originals(tracks), np.arange(tracks.frames))


def test_frames_of_a_camera_that_rests_are_moments_even_if_encoding_makes_them_alike(resting, tmp_path):
    tracks = track_video(write_frames(tmp_path / "rest.mp4", resting))
    first = originals(tracks)
    assert np.sum(first != np.arange(tracks.frames)) >= 5
    np.testing.assert_array_equal(without_rests(first, tracks), np.arange(tracks.frames))


def test_a_camera_that_turns_back_makes_no_copies():
    focal, rotation = pan_and_zoom(lens(), 150, pan=30)
    tracks = motion_tracks(lens(), focal, rotation, views=60, life=12, noise=0.05).tracks
    np.testing.assert_array_equal(originals(tracks), np.arange(150))


def test_a_slow_camera_without_noise_makes_no_endless_copies():
    focal, rotation = pan_and_zoom(lens(), 60, pan=0.05, tilt=0)
    tracks = motion_tracks(lens(), np.full(60, focal[0]), rotation, views=60, life=30).tracks
    assert np.bincount(originals(tracks)).max() < 12


def test_the_copies_of_each_view_are_counted():
    scene = motion_tracks(lens(), *pan_and_zoom(lens(), 20, pan=10), views=30, life=8, noise=0.2)
    times = [2 if n % 5 == 4 else 1 for n in range(20)]
    tracks = repeated(scene.tracks, times)
    first = originals(tracks)
    np.testing.assert_array_equal(first, shown_first(times))
    number = copies(first, tracks)
    assert np.sum(1 / number) == pytest.approx(np.sum(np.asarray(scene.tracks.mask)))
    assert set(number.tolist()) == {1.0, 2.0}


def test_copies_count_once(plain):
    tracks = track_frames([plain[1][n] for n in np.repeat(np.arange(12), AT_30[:12])])
    weight = tracks.view_weights()
    assert weight is not None
    track, frame, _ = tracks.views()
    first = shown_first(AT_30[:12])[frame]
    _, place = np.unique(np.stack([track, first]), axis=1, return_inverse=True)
    np.testing.assert_allclose(np.bincount(place.ravel(), weights=weight), weight.max(), rtol=1e-6)
    assert np.sum(weight**2) / np.sum(weight) == pytest.approx(1)


def test_tracks_without_copies_have_no_weights(plain):
    assert track_frames(plain[1][:6]).weight is None


def test_weights_of_their_own_are_shared_among_copies():
    scene = motion_tracks(lens(), *pan_and_zoom(lens(), 20, pan=10), views=30, life=8, noise=0.2)
    track, frame, points = repeated(scene.tracks, AT_30[:20]).views()
    tracks = Tracks.from_arrays(track, frame, points, image_size=SIZE, weight=np.full(len(track), 3.0))
    weight = counted_once(tracks).view_weights()
    assert weight is not None
    assert np.sum(weight**2) / np.sum(weight) == pytest.approx(3)
    assert set(np.round(weight / weight.min(), 6).tolist()) == {1.0, 2.0}


def test_views_that_are_no_copies_keep_their_weight_beside_a_long_rest():
    """Else the noise, which is that of weight 1, would be too large by the length of the rest."""
    scene = motion_tracks(lens(), *pan_and_zoom(lens(), 20, pan=10), views=30, life=8, noise=0.2)
    held = repeated(scene.tracks, [60, *[1] * 19])
    weight = counted_once(held).view_weights()
    assert weight is not None
    frame = held.views()[1]
    np.testing.assert_allclose(weight[frame >= 60], 1, rtol=0.1)
    np.testing.assert_allclose(weight[frame < 60], 1 / 60, rtol=0.1)


def test_the_names_and_the_order_of_tracks_do_not_matter():
    scene = motion_tracks(lens(), *pan_and_zoom(lens(), 20, pan=10), views=30, life=8, noise=0.2)
    tracks = repeated(scene.tracks, AT_30[:20])
    order = np.random.default_rng(0).permutation(len(tracks.mask))
    fields = (np.asarray(of)[order] for of in (tracks.points, tracks.frame, tracks.mask))
    other = Tracks(*fields, tracks.image_size, tracks.frames, np.zeros(len(order), int))
    np.testing.assert_array_equal(originals(other), originals(tracks))
    np.testing.assert_array_equal(originals(other), shown_first(AT_30[:20]))


def test_points_of_few_tracks_tell_nothing():
    points = np.array([[10.0, 10.0], [10.0, 10.0], [15.0, 15.0], [15.0, 15.0]])
    tracks = Tracks.from_arrays([0, 0, 1, 1], [0, 1, 0, 1], points, image_size=(64, 64))
    np.testing.assert_array_equal(originals(tracks), [0, 1])
