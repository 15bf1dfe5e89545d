"""What is said of single frames of a clip."""

import numpy as np
import pytest

from zoomjax.app.frame_findings import of_repeated, ranges, repeated_frames
from zoomjax.scenes import motion_tracks, pan_and_zoom

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
