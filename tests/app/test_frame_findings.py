"""What is said of single frames of a clip."""

import jax.numpy as jnp
import numpy as np
import pytest

from zoomjax.app.frame_findings import of_blind, of_dissolves, of_repeated, ranges, repeated_frames
from zoomjax.app.motion_findings import _of_known
from zoomjax.fit import MotionFit
from zoomjax.scenes import motion_tracks, pan_and_zoom
from zoomjax.tracks import Tracks

from ..tracks.test_repeats import repeated
from ..tracks.test_video import lens


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ([7], "frame 7"),
        ([3, 4, 5], "frames 3 to 5"),
        ([3, 4, 9], "frames 3 to 4 and 9"),
        ([0, 2, 4, 6, 8], "frames 0, 2, 4, 6 and 8"),
        ([0, 2, 3, 4, 6, 8, 10, 12, 13], "frames 0, 2 to 4, 6, 8 and 3 others"),
    ],
)
def test_frames_are_named_in_ranges(numbers, words):
    assert ranges(np.array(numbers)) == words


def test_frames_that_repeat_others_are_counted_and_told():
    scene = motion_tracks(lens(), *pan_and_zoom(lens(), 20, pan=10), views=30, life=8, noise=0.2)
    assert repeated_frames(scene.tracks) == 0
    assert not [*of_repeated(scene.tracks)]
    tracks = repeated(scene.tracks, [1, 2, 1, 1] * 5)
    assert repeated_frames(tracks) == 5
    [finding] = of_repeated(tracks)
    assert finding.verdict == "good"
    assert finding.found.startswith("5 of 25 frames repeat the one before, ")
    assert "frame rate that it was filmed at" in finding.advice


@pytest.mark.filterwarnings("ignore:Dropped")
def test_a_dissolve_is_told_where_it_is():
    """Two scenes of which both are seen in three frames, where the fit follows the second."""
    scene = motion_tracks(lens(), *pan_and_zoom(lens(), 20, pan=10), views=30, life=15, noise=0.2)
    track, frame, points = scene.tracks.views()
    before, after = frame < 11, frame >= 8
    tracks = Tracks.from_arrays(
        np.concatenate([2 * track[before], 2 * track[after] + 1]),
        np.concatenate([frame[before], frame[after]]),
        np.concatenate([points[before], points[after] + 0.5]),
        image_size=scene.tracks.image_size,
        frames=20,
    )
    name, moment, _ = tracks.views()
    numbers, one_shot = np.arange(20), np.zeros(20, int)
    follows = (name % 2 == 1) | (moment < 8)
    [finding] = of_dissolves(tracks, follows, one_shot, numbers)
    assert finding.verdict == "doubtful"
    assert "before and after frame 8:" in finding.found
    assert not [*of_dissolves(tracks, follows, np.where(numbers < 8, 0, 1), numbers)]  # a cut is told
    all_follow = np.ones(np.sum(np.asarray(scene.tracks.mask)), bool)
    assert not [*of_dissolves(scene.tracks, all_follow, one_shot, numbers)]


@pytest.mark.parametrize(
    ("blind", "verdict", "words"),
    [
        ([], None, ""),
        ([3], "good", "1 frame shows nothing that can be followed: frame 13. It may be black"),
        ([3, 4], "good", "2 frames show nothing that can be followed: frames 13 to 14. They"),
        (
            [0, 3, 4, 9],
            "doubtful",
            "4 of 10 frames show nothing that can be followed: frames 10, 13",
        ),
    ],
)
def test_frames_that_show_nothing_are_named(blind, verdict, words):
    fit = object.__new__(MotionFit)
    focal = np.full(10, 900.0)
    focal[blind] = np.nan
    object.__setattr__(fit, "focal", jnp.asarray(focal))
    found = list(of_blind(fit, np.arange(10, 20)))
    assert [of.verdict for of in found] == [verdict] * (verdict is not None)
    assert all(of.found.startswith(words) for of in found)


@pytest.mark.parametrize("least", [0.0, 0.3, 0.5])
def test_the_end_of_a_zoom_is_no_repeated_frame(least):
    """Frames on both sides of the end are alike, and beside them it moves half as fast as farther on."""
    frame = np.arange(20)
    place = 2.0 * (frame - 9.5 + least) ** 2 / 10
    points = np.stack([np.add.outer(20 * np.arange(30), place)] * 2, axis=-1)
    points = points + np.random.default_rng(0).normal(0, 0.05, points.shape)
    track = np.repeat(np.arange(30), 20)
    tracks = Tracks.from_arrays(track, np.tile(frame, 30), points.reshape(-1, 2), image_size=(900, 600))
    assert repeated_frames(tracks) == 0


def findings_of_known(off, std):
    """What is said of ten known focal lengths by which f is off by such a share."""
    focal = np.linspace(900, 1800, 10)
    fit = object.__new__(MotionFit)
    object.__setattr__(fit, "focal", jnp.append(focal * (1 + off), jnp.nan))
    given, sigma = np.append(focal, 700), np.append(std * focal, 0.01)
    return [of.found for of in _of_known(fit, (given, sigma)) if of.verdict != "good"]


def test_known_focal_lengths_that_contradict_only_together_are_told():
    alone = findings_of_known(0.3, 0.06)
    assert len(alone) == 1
    assert "of its standard deviations away" in alone[0]
    [together] = findings_of_known(0.09, 0.06)
    assert together.startswith("motion and lines say that f is 8.6% longer than what is known of 11 frames")
    assert findings_of_known(0.03, 0.06) == []
