"""Tracks found in clips whose truth is known: how exact they are, and what they leave out."""

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.scenes import leaves, motion_clip, pan_and_zoom
from zoomjax.tracks import track_frames, track_video
from zoomjax.tracks.video import _enough

from .._clips import write_frames, write_still

SIZE, FRAMES = (448, 256), 24


def lens(size=SIZE, zoom_ratio=1.5):
    """Barrel at the short end, by 6 px in the corners."""
    zoom = zj.PolynomialZoom(1, jnp.array([[-0.02, 0.002], [-0.05, 0.01]]), jnp.array(0.7 * size[0]))
    focal = 0.7 * size[0] * jnp.array([1.0, zoom_ratio])
    return zj.ZoomLens(zoom, (jnp.array(size) - 1) / 2 + 3, focal, size, "px")


@pytest.fixture(scope="module")
def texture():
    return leaves((1024, 512))


def make(texture, frames=FRAMES, *, first=0, pan=12, **options):
    focal, rotation = pan_and_zoom(lens(), 2 * frames, pan=pan)
    part = slice(first, first + frames)
    return motion_clip(lens(), focal[part], rotation[part], texture=texture, noise=1.5, **options)


@pytest.fixture(scope="module")
def plain(texture):
    clip = make(texture)
    return clip, list(clip.frames())


@pytest.fixture(scope="module")
def encoded(plain, tmp_path_factory):
    return write_frames(tmp_path_factory.mktemp("clips") / "plain.mp4", plain[1])


def errors(tracks, clip, shown=None):
    """Each view's age, and its error, px, against where the point is that the first view shows.

    `shown`: which of the clip's frames each frame is.
    """
    number, frame, points = tracks.views()
    points = points.astype(float)
    shown = np.arange(tracks.frames) if shown is None else np.asarray(shown)
    first = np.searchsorted(number, number)
    rays, truth = np.zeros((len(number), 3)), np.zeros_like(points)
    for m in np.unique(frame[first]):
        there = frame[first] == m
        rays[there] = clip.rays(int(shown[m]), points[first[there]])
    for m in np.unique(frame):
        truth[frame == m] = clip.points(int(shown[m]), rays[frame == m])
    return frame - frame[first], points - truth


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def per_frame(tracks):
    return np.bincount(tracks.views()[1], minlength=tracks.frames)


def test_points_follow_the_scene_without_drift(plain, encoded):
    seen = []
    tracks = track_video(encoded, progress=lambda done, total: seen.append((done, total)))
    assert (tracks.frames, tracks.image_size) == (FRAMES, SIZE)
    assert seen == [(done, FRAMES) for done in range(1, FRAMES + 1)]
    assert per_frame(tracks).min() > 60
    assert per_frame(tracks).max() <= 200
    age, error = errors(tracks, plain[0])
    assert rms(error[age > 0]) < 0.12
    assert np.abs(error).max() < 1.5
    old, young = error[age > 12], error[(age > 0) & (age < 4)]
    assert len(old) > 500
    assert rms(old) < 1.6 * rms(young)
    assert np.abs(old.mean(axis=0)).max() < 0.03


def test_tracks_spread_over_the_image(plain):
    _, frame, points = track_frames(plain[1][:3]).views()
    cells = {tuple(cell) for cell in (points[frame == 2] // 64).astype(int)}
    assert len(cells) == 7 * 4


def test_few_tracks_spread_too(plain):
    _, frame, points = track_frames(plain[1][:3], most=12).views()
    assert len({tuple(cell) for cell in (points[frame == 2] // 128).astype(int)}) >= 6


def test_most_and_life_are_kept(plain):
    tracks = track_frames(plain[1], most=30, life=6)
    assert per_frame(tracks).max() <= 30
    assert np.asarray(tracks.mask).sum(axis=1).max() <= 7


def test_grey_frames_give_tracks_too(plain):
    tracks = track_frames((frame[..., 1] for frame in plain[1][:6]), most=50)
    age, error = errors(tracks, plain[0])
    assert rms(error[age > 0]) < 0.1


def test_captions_and_logos_are_left_out(texture):
    clip = make(texture, 14, caption=True)
    tracks = track_frames(clip.frames())
    assert clip.is_caption(tracks.views()[2].astype(float)).mean() < 0.005
    assert per_frame(tracks).min() > 60
    age, error = errors(tracks, clip)
    assert np.mean(np.abs(error[age > 0]).max(axis=1) < 0.5) > 0.98


def test_a_still_moment_throws_nothing_away(texture):
    focal, rotation = pan_and_zoom(lens(), 40, pan=12)
    shown = np.repeat(np.arange(16), [1] * 8 + [9] + [1] * 7)
    clip = motion_clip(lens(), focal[shown], rotation[shown], texture=texture, noise=1.5, caption=True)
    tracks = track_frames(clip.frames())
    assert per_frame(tracks).min() > 60
    assert clip.is_caption(tracks.views()[2].astype(float)).mean() < 0.01


def test_a_fast_pan_is_followed(texture):
    """By a seventh of the image's width a frame, from the first one on."""
    focal, rotation = pan_and_zoom(lens(), 24, pan=100)
    clip = motion_clip(lens(), focal[:5], rotation[:5], texture=texture, noise=1.5)
    tracks = track_frames(clip.frames())
    number, frame, points = tracks.views()
    steps = np.diff(points, axis=0)[(np.diff(number) == 0) & (np.diff(frame) == 1)]
    assert np.median(np.abs(steps[:, 0])) > SIZE[0] / 7
    assert per_frame(tracks).min() > 20
    age, error = errors(tracks, clip)
    assert np.mean(np.abs(error[age > 0]).max(axis=1) < 0.5) > 0.95


def test_a_clip_that_never_moves_has_tracks(texture):
    clip = make(texture, 6)
    still = motion_clip(lens(), clip.focal[:1].repeat(6), clip.rotation[:1].repeat(6, 0), texture=texture)
    tracks = track_frames(still.frames())
    assert per_frame(tracks).min() > 60
    _, error = errors(tracks, still)
    assert rms(error) < 0.02


def test_nothing_links_across_a_cut(plain, texture, tmp_path):
    other = list(make(leaves((1024, 512), seed=5), 10, first=9).frames())
    path = write_frames(tmp_path / "cut.mp4", [*plain[1][:10], *other])
    number, frame, _ = track_video(path).views()
    before, after = (set(number[which]) for which in (frame < 10, frame >= 10))
    assert before
    assert after
    assert not before & after


def test_repeated_frames_break_nothing(plain, tmp_path):
    shown = np.repeat(np.arange(FRAMES), [2 if n % 5 == 4 else 1 for n in range(FRAMES)])
    path = write_frames(tmp_path / "repeated.mp4", [plain[1][n] for n in shown])
    tracks = track_video(path)
    assert tracks.frames == len(shown)
    age, error = errors(tracks, plain[0], shown)
    assert rms(error[age > 0]) < 0.12
    once = track_frames(plain[1])
    assert np.mean(per_frame(tracks)) > 0.8 * np.mean(per_frame(once))
    assert np.mean(np.asarray(tracks.mask).sum(1)) > 0.8 * np.mean(np.asarray(once.mask).sum(1))


def test_a_clip_that_is_joined_to_its_copy_is_told(plain, tmp_path):
    """It counted as twice as many frames, which made standard deviations smaller."""
    frames = plain[1][:8]
    told = r"8 of 16 frames show to the last bit what earlier ones do.* leave them out"
    with pytest.warns(UserWarning, match=f"In argument frames {told}"):
        track_frames([*frames, *frames])
    path = write_frames(tmp_path / "in.mkv", [*frames, *frames], encoder="ffv1")
    with pytest.warns(UserWarning, match=rf"in\.mkv {told}"):
        track_video(path)
    track_frames([*frames, *[np.zeros_like(frames[0])] * 3, frames[0]])  # one alone may come again
    track_frames([image for image in frames for _ in range(2)])  # as conversions of the rate repeat them


def test_fades_and_black_frames_may_have_no_tracks(plain):
    fade = np.concatenate([np.linspace(1, 0, 6), np.zeros(3), np.linspace(0, 1, 6)])
    frames = [(share * frame).astype(np.uint8) for share, frame in zip(fade, plain[1], strict=False)]
    tracks = track_frames(frames)
    assert tracks.frames == 15
    assert (per_frame(tracks)[6:8] == 0).all()
    assert per_frame(tracks)[1] > 60
    track, frame, _ = tracks.views()
    assert len(set(track[frame == 0]) & set(track[frame == 3])) > 40  # where it has faded by half
    assert per_frame(tracks)[-1] > 60
    age, error = errors(tracks, plain[0])
    assert np.mean(np.abs(error[age > 0]).max(axis=1) < 0.5) > 0.95


def test_frames_with_next_to_no_points_have_none(plain):
    """Three corners tell no focal length and no rotation."""
    frames = [np.full_like(frame, 128) for frame in plain[1][:9]]
    for n, (frame, seen) in enumerate(zip(frames, plain[1], strict=False)):
        if n < 6:
            frame[:] = seen
        else:
            for x, y in ((60, 60), (200, 90), (330, 150)):
                cv2.rectangle(frame, (x + n, y), (x + n + 30, y + 30), (250, 250, 250), -1)
            frame[120:] = 128
    tracks = track_frames(frames)
    counts = per_frame(tracks)
    assert counts[5] > 60
    assert ((counts == 0) | (counts >= 4)).all()


def test_interlaced_clips_are_warned_of(plain, tmp_path):
    options = {"flags": "+ildct", "x264-params": "tff=1"}
    path = write_frames(tmp_path / "interlaced.mp4", plain[1][:4], options=options)
    with pytest.warns(UserWarning, match="interlaced.* Deinterlace it first"):
        track_video(path)


def test_what_cannot_be_tracked_is_told_in_one_sentence(plain, tmp_path):
    one = write_still(tmp_path / "still.mkv", 1)
    with pytest.raises(ValueError, match=r"^Cannot track points in .*still.mkv: It has fewer than two"):
        track_video(one)
    black = write_frames(tmp_path / "black.mp4", [np.zeros_like(plain[1][0])] * 3)
    with pytest.raises(ValueError, match=r"black.mp4: Nothing in it can be followed"):
        track_video(black)
    text = tmp_path / "text.mp4"
    text.write_text("no video")
    with pytest.raises(ValueError, match=r"^Cannot read a video from .*text.mp4") as caught:
        track_video(text)
    assert "\n" not in str(caught.value)
    with pytest.raises(FileNotFoundError):
        track_video(tmp_path / "none.mp4")
    with pytest.raises(ValueError, match="Argument most"):
        track_frames(plain[1], most=3)
    with pytest.raises(ValueError, match="follow each other"):
        track_frames([plain[1][0], plain[1][1][:-2]])
    with pytest.raises(ValueError, match="fewer than two frames"):
        track_frames([])


def test_tiny_frames_have_no_room_for_tracks():
    with pytest.raises(ValueError, match="Nothing in it can be followed"):
        track_frames([leaves((24, 24))] * 3)


def test_two_frames_are_enough(plain):
    tracks = track_frames(plain[1][:2])
    assert per_frame(tracks).min() > 60


@pytest.mark.slow
def test_a_zooming_broadcast_with_moving_things_and_captions(tmp_path):
    """Zoomed by 1:2, a third of it moving, through H.264 at the encoder's own quality."""
    true = lens((960, 540), 2.0)
    clip = motion_clip(true, *pan_and_zoom(true, 60, pan=20), noise=2, moving=0.3, caption=True)
    tracks = track_video(write_frames(tmp_path / "broadcast.mp4", clip.frames()))
    assert per_frame(tracks)[1:].min() > 150
    assert np.asarray(tracks.mask).sum(axis=1).mean() > 6
    _, frame, points = tracks.views()
    assert clip.is_caption(points.astype(float)).mean() < 0.005
    moving = np.zeros(len(frame), bool)
    for m in range(60):
        moving[frame == m] = clip.is_moving(m, points[frame == m].astype(float))
    assert moving.mean() < 0.35
    age, error = errors(tracks, clip)
    scene = error[(age > 0) & ~moving]
    assert 1.48 * np.median(np.abs(scene)) < 0.08
    assert np.mean(np.abs(scene).max(axis=1) < 0.5) > 0.94  # at the borders of moving things


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("frame", "what"),
    [
        (np.zeros((64, 64)), r"\(64, 64\), float64"),
        (np.zeros((64, 64), np.uint16), "uint16"),
        (np.zeros((3, 64, 64), np.uint8), r"\(3, 64, 64\)"),
        ([[1, 2], [3, 4]], "list"),
        ("clip.mp4", "str"),
    ],
)
def test_what_is_no_image_is_refused(frame, what):
    with pytest.raises(ValueError, match=rf"frames must hold images .* of uint8, .* but one is .*{what}"):
        track_frames([frame, frame])


def test_frames_have_four_views_or_none_and_tracks_two():
    track = np.array([0, 0, 0, 1, 1, 2, 2, 3, 3, 4, 4])
    frame = np.array([0, 1, 2, 0, 1, 0, 1, 0, 1, 2, 3])
    kept = _enough(track, frame, np.zeros((len(track), 2)))
    np.testing.assert_array_equal(kept[0], [0, 0, 1, 1, 2, 2, 3, 3])
    np.testing.assert_array_equal(kept[1], [0, 1] * 4)
    fewer = frame[track > 0], track[track > 0]
    assert len(_enough(fewer[1], fewer[0], np.zeros((len(fewer[0]), 2)))[0]) == 0
    assert len(_enough(track[:0], frame[:0], np.zeros((0, 2)))[0]) == 0
