"""Frames far apart in a clip, compared with one another."""

import cv2
import numpy as np
import pytest

from zoomjax.scenes import leaves
from zoomjax.tracks import KeyFrames

from .._clips import write_frames

SIZE = (640, 360)
SHIFT = np.array([150, 40])


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    """A view of a scene, another one from 150 px to the left of it, and one of another scene."""
    scene, other = leaves((1024, 512), seed=1), leaves((1024, 512), seed=2)
    x, y = SHIFT
    views = [scene[:360, :640], scene[y : y + 360, x : x + 640], other[:360, :640]]
    grown = cv2.resize(scene[100:280, 200:520], SIZE, interpolation=cv2.INTER_CUBIC)
    folder = tmp_path_factory.mktemp("views")
    flat = np.full((360, 640, 3), 90, np.uint8)
    clip = folder / "clip.mp4"
    write_frames(clip, [np.ascontiguousarray(view) for view in [*views, grown, flat]])
    with pytest.raises(ValueError, match=r"has 5, but .*clip.mp4 has no such frame"):
        KeyFrames(clip, [1, 5])
    return KeyFrames(clip, [0, 1, 2, 3, 4])


def test_points_match_where_they_show_the_same(seen):
    one, other = seen.matches(0, 1)
    off = np.linalg.norm(one - other - SHIFT, axis=1)
    assert len(off) > 100
    assert np.mean(off < 1) > 0.9


def test_another_scene_hardly_matches(seen):
    assert len(seen.matches(0, 2)[0]) < 0.2 * len(seen.matches(0, 1)[0])


def test_a_flat_frame_matches_nothing(seen):
    assert [of.shape for of in seen.matches(0, 4) + seen.matches(4, 4)] == [(0, 2)] * 4


@pytest.mark.parametrize(
    ("one", "other", "carry", "same"),
    [
        (0, 1, lambda points: points + SHIFT, True),
        (0, 1, lambda points: points + 1.4 * SHIFT, False),
        (0, 2, lambda points: points, False),
        (0, 3, lambda points: points / 2 + np.array([200, 100]), True),
        (0, 1, lambda points: np.full_like(points, np.nan), False),
        (0, 1, lambda points: points + 4 * SHIFT, False),
        (0, 4, lambda points: points, False),
        (4, 0, lambda points: points, False),
    ],
)
def test_frames_are_alike_where_most_of_their_parts_are(seen, one, other, carry, same):
    assert seen.alike(one, other, carry, SIZE) == same
