"""Rendered clips with a cut: shots of one scene are joined, and others are not."""

import dataclasses
import json
from functools import partial

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import zoomjax as zj
from zoomjax.app.motion_calibration import calibrate_motion
from zoomjax.app.panorama import write_panorama
from zoomjax.fit import RESULTS, linked_well, shot_turns
from zoomjax.scenes import leaves, motion_clip
from zoomjax.tracks import KeyFrames, Tracks, track_video

from .._clips import write_frames

SIZE, CUT, FRAMES = (640, 360), 20, 40


def lens(distortion=1.0):
    k = distortion * jnp.array([[0.02, 0.0], [-0.05, 0.01], [-0.1, 0.03]])
    zoom = zj.PolynomialZoom(2, k, jnp.array(500.0))
    return zj.ZoomLens(zoom, jnp.array([322.0, 178.0]), jnp.array([500.0, 1200.0]), SIZE, "px")


def shot(pan, tilt, focal):
    """Focal lengths and rotations of half of the clip, between these ends."""
    number = FRAMES // 2
    angles = np.column_stack([np.linspace(*tilt, number), np.linspace(*pan, number)])
    return np.geomspace(*focal, number), Rotation.from_euler("xy", -angles, degrees=True).as_matrix()


def shots():
    return shot((-15, 10), (0, 3), (520, 800)), shot((30, 2), (5, 2), (640, 1100))


def rendered(path, seeds, *, caption=False, shutter=0.0, lenses=None):
    """A clip of both shots, before panoramas of these seeds."""
    frames = []
    for part, seed, of in zip(shots(), seeds, lenses or (lens(), lens()), strict=True):
        texture = leaves(seed=seed)
        made = motion_clip(
            of, *part, texture=texture, noise=2, caption=caption, shutter=shutter, density=1200.0
        )
        frames += list(made.frames())
    return write_frames(path, frames)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("cuts")


@pytest.fixture(scope="module")
def done(folder):
    clip = rendered(folder / "clip.mp4", (0, 0), caption=True, shutter=0.4)
    stages = []
    found = calibrate_motion(clip, track_video(clip), stage=stages.append)
    assert "Joining shots of the same scene" in stages
    assert "Fitting the path that is closed" in stages
    return found


@pytest.mark.slow
def test_shots_of_one_scene_are_joined(done):
    focal, rotation = (np.concatenate(part) for part in zip(*shots(), strict=True))
    fit = done.fit
    np.testing.assert_array_equal(fit.shot, np.arange(FRAMES) >= CUT)
    np.testing.assert_array_equal(fit.scene, 0)
    assert abs(np.asarray(fit.focal) / focal - 1).max() < 0.003
    true = rotation @ rotation[0].T
    off = Rotation.from_matrix(np.asarray(fit.rotation) @ np.swapaxes(true, 1, 2)).magnitude()
    assert np.degrees(off).max() < 0.06
    assert fit.readout == pytest.approx(0.4, abs=0.05)  # no row has its time from beyond the cut
    assert done.verdict == "good"
    assert "1 cut. All shots show one scene" in " ".join(map(str, done.findings))
    assert (done.summary()["shots"], done.summary()["scenes"]) == (2, 1)


def test_tracks_go_across_the_cut_and_hold_the_shots(done):
    number, frame, _ = done.tracks.views()
    _, first, track = np.unique(number, return_index=True, return_inverse=True)
    across = np.unique(track[(frame[first][track] < CUT) & (frame >= CUT)])
    assert len(across) > 30
    log_std = np.asarray(done.fit.focal_std) / np.asarray(done.fit.focal)
    assert np.ptp([log_std[:CUT].mean(), log_std[CUT:].mean()]) < 0.1 * log_std.mean()


@pytest.mark.slow
def test_the_panorama_shows_both_shots_and_is_sharp(done, folder):
    write_panorama(done.clip, done.fit, folder / "panorama.jpg")
    panorama = cv2.imread(str(folder / "panorama.jpg"), cv2.IMREAD_GRAYSCALE)
    assert panorama is not None
    height, width = panorama.shape
    seen = np.flatnonzero(panorama[height // 2] > 0)
    pan = np.ptp(np.asarray(done.fit.pan_and_tilt)[:, 0])
    assert pan == pytest.approx(45, abs=1)
    assert np.ptp(seen) > 0.95 * width
    middle = panorama[height // 3 : -height // 3, width // 3 : -width // 3].astype(float)
    assert np.abs(np.diff(middle, axis=1)).mean() > 4


@pytest.mark.slow
@pytest.mark.parametrize("caption", [False, True])
def test_shots_of_different_scenes_are_not_joined(done, folder, caption):
    clip = rendered(folder / f"other-{caption}.mp4", (0, 5), caption=caption)
    apart = eqx.tree_at(lambda fit: fit.scene, done.fit, done.fit.shot)
    assert len(shot_turns(apart, done.tracks, look=partial(KeyFrames, done.clip))) == 1
    assert shot_turns(apart, done.tracks, look=partial(KeyFrames, clip)) == []


@pytest.mark.slow
@pytest.mark.parametrize("distortion", [1.0, -0.5])
def test_a_shot_by_another_lens_is_told(folder, distortion):
    clip = rendered(folder / f"lens-{distortion}.mp4", (0, 5), lenses=(lens(), lens(distortion)))
    done = calibrate_motion(clip, track_video(clip))
    said = [of for of in done.findings if of.about == "different lenses"]
    if distortion == 1:
        assert (said, done.verdict) == ([], "good")
        return
    assert done.verdict != "good"
    assert len(said) == 1
    assert "frames 20 to 39" in said[0].found or "frames 0 to 19" in said[0].found
    assert "Calibrate the shots of each camera and lens by themselves" in said[0].advice
    assert said[0].found in json.dumps(done.summary())


class Nothing:
    """What frames show in which nothing is found; keeps their numbers."""

    def __init__(self, frames):
        self.frames = list(frames)

    def matches(self, one, other):
        assert {one, other} <= set(self.frames)
        return np.zeros((0, 2)), np.zeros((0, 2))

    def alike(self, *_):
        raise AssertionError("nothing matches")


def test_of_many_shots_the_longest_are_compared(done):
    shot = np.repeat(np.arange(45), np.where(np.arange(45) % 3 == 0, 1, 4))
    fit, number = done.fit, len(shot)
    values = fit.focal[0], fit.focal_std[0], fit.rotation[0]
    values = [jnp.broadcast_to(of, (number, *jnp.shape(of))) for of in values]
    values[0] = values[0] * jnp.linspace(1, 2, number)
    of = lambda fit: (fit.focal, fit.focal_std, fit.rotation, fit.shot, fit.scene)  # noqa: E731
    fit = eqx.tree_at(of, fit, (*values, jnp.asarray(shot), jnp.asarray(shot)))
    looks = []
    tracks = dataclasses.replace(done.tracks, frames=number)
    assert shot_turns(fit, tracks, look=lambda frames: looks.append(Nothing(frames)) or looks[0]) == []
    compared = shot[looks[0].frames]
    assert np.unique(compared).tolist() == [n for n in range(45) if n % 3]
    assert np.bincount(compared).max() == 2


def test_without_a_scale_nothing_is_compared(done):
    of = lambda fit: fit.fit.result  # noqa: E731
    fit = eqx.tree_at(of, done.fit, RESULTS.undetermined)
    assert shot_turns(fit, done.tracks, look=lambda _: pytest.fail("compared")) == []


def test_few_tracks_do_not_hold_one_shot_to_another(done):
    number, frame, points = done.tracks.views()
    _, first, track = np.unique(number, return_index=True, return_inverse=True)
    across = (frame[first][track] < CUT) & (frame >= CUT)
    few = ~across | (track < np.unique(track[across])[9])

    def kept(which, weight=None):
        return Tracks.from_arrays(
            number[which], frame[which], points[which], image_size=SIZE, frames=FRAMES, weight=weight
        )

    np.testing.assert_array_equal(linked_well(done.tracks, done.fit).frame, done.tracks.frame)
    np.testing.assert_array_equal(linked_well(kept(few), done.fit).frame, kept(~across).frame)
    weight = 1.0 + np.arange(len(number)) % 5
    weighted = linked_well(kept(few, weight[few]), done.fit)
    np.testing.assert_array_equal(weighted.view_weights(), kept(~across, weight[~across]).view_weights())
    longer = Tracks.from_arrays(number, frame, points, image_size=SIZE, frames=FRAMES + 1)
    with pytest.raises(ValueError, match=f"has {FRAMES} frames and they have {FRAMES + 1}"):
        linked_well(longer, done.fit)
