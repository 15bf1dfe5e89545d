"""Clips whose frames repeat, fade, dissolve or rest, from pixels to the verdict of the command."""

import functools

import cv2
import numpy as np
import pytest

from zoomjax.scenes import leaves, motion_clip
from zoomjax.tracks import load_tracks

from .test_clips import FRAMES, lens, path, summary_of, track, write_clip, zoomjax

pytestmark = pytest.mark.slow


@functools.cache
def pictures(seed=None):
    """Frames of the moving camera; with a seed, of another scene, backwards."""
    options = {} if seed is None else {"texture": leaves((1024, 512), seed=seed)}
    return list(motion_clip(lens(), *path(), noise=2, **options).frames())[:: 1 if seed is None else -1]


def calibrated(folder, images):
    """The command's sentence, the summary and the track of a clip of these images."""
    write_clip(folder / "clip.mp4", images)
    done = zoomjax("calibrate", "clip.mp4", "-o", "out", cwd=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout, summary_of(folder / "out"), track(folder / "out")


def off(found, frames):
    """Of the focal lengths of the clip's frames, which show those of the scene."""
    return abs(found["focal"] / path()[0][frames] - 1)


def told(summary):
    """What is found, by what it is about."""
    return {one["about"]: one["found"] for one in summary["findings"]}


def test_frames_of_another_rate_are_told_and_count_once(tmp_path):
    """25 frames a second to 30: one in five is there twice."""
    frames = np.arange(FRAMES * 6 // 5) * 5 // 6
    said, summary, found = calibrated(tmp_path, [pictures()[n] for n in frames])
    assert said.startswith("Good:")
    assert told(summary).keys() == {"repeated frames"}
    assert told(summary)["repeated frames"].startswith("7 of 43 frames repeat the one before")
    assert off(found, frames).max() < 0.005
    weight = load_tracks(tmp_path / "out" / "tracks.npz").view_weights()
    assert weight.min() < 0.6 * weight.max()


def test_nothing_is_said_of_a_camera_at_rest(tmp_path):
    """Its frames are the same, as they should be."""
    frames = np.r_[[0] * 12, :FRAMES]
    said, summary, found = calibrated(tmp_path, [pictures()[n] for n in frames])
    assert said.startswith("Good:")
    assert told(summary) == {}
    assert off(found, frames).max() < 0.005


def test_a_fade_through_black_is_told_and_holds_the_clip_together(tmp_path):
    light = np.clip(abs(np.arange(FRAMES) - 18) / 8 - 0.1, 0, 1)
    faded = [np.rint(of * image).astype(np.uint8) for of, image in zip(light, pictures(), strict=True)]
    said, summary, found = calibrated(tmp_path, faded)
    assert said.startswith("Good:")
    assert told(summary).keys() == {"cuts", "frames without points"}
    assert "All shots show one scene, and are joined" in told(summary)["cuts"]
    assert "frames 18 to 19" in told(summary)["frames without points"]
    dark = (np.arange(FRAMES) > 17) & (np.arange(FRAMES) < 20)
    assert off(found, np.arange(FRAMES))[~dark].max() < 0.005


def test_a_dissolve_is_told(tmp_path):
    share = np.clip((np.arange(FRAMES) - 14) / 8, 0, 1)
    mixed = [
        cv2.addWeighted(one, 1 - of, other, of, 0)
        for of, one, other in zip(share.tolist(), pictures(), pictures(seed=5), strict=True)
    ]
    said, summary, found = calibrated(tmp_path, mixed)
    assert said.startswith("Doubtful: next to nothing is seen both before and after frame")
    assert told(summary).keys() == {"dissolves"}
    assert off(found, np.arange(FRAMES)).max() < 0.005
