"""Frames that are woven of two fields, in files that do not say so."""

import warnings

import cv2
import numpy as np
import pytest

from zoomjax.scenes import leaves, motion_clip, pan_and_zoom
from zoomjax.tracks import track_frames, track_video

from .._clips import write_frames
from .test_video import lens

FRAMES = 24


def stripes():
    """Rows that differ from their neighbours, with boxes among them."""
    image = np.full((512, 1024, 3), 40, np.uint8)
    image[1::2] = 210
    rng = np.random.default_rng(1)
    for left, top in rng.integers(0, (1000, 500), (400, 2)).tolist():
        cv2.rectangle(image, (left, top), (left + 12, top + 9), rng.integers(0, 255, 3).tolist(), -1)
    return image


def fields(texture, *, pan=10.0, tilt=3.0):
    """Pictures of 50 fields a second."""
    focal, rotation = pan_and_zoom(lens(), 200, pan=pan, tilt=tilt)
    part = slice(60, 60 + 2 * FRAMES)
    return list(motion_clip(lens(), focal[part], rotation[part], texture=texture, noise=1.5).frames())


def woven(pictures, first=0):
    """Frames of two of them each, of which the one has the even rows."""
    frames = [even.copy() for even in pictures[first::2]]
    for frame, odd in zip(frames, pictures[1 - first :: 2], strict=True):
        frame[1::2] = odd[1::2]
    return frames


@pytest.fixture(scope="module")
def leaf_fields():
    return fields(leaves((512, 256)))


@pytest.mark.parametrize("first", [0, 1])
def test_woven_fields_are_warned_of_in_files_that_do_not_say_so(leaf_fields, tmp_path, first):
    path = write_frames(tmp_path / "woven.mp4", woven(leaf_fields, first), options={"crf": "26"})
    with pytest.warns(UserWarning, match="interlaced.* Deinterlace it first"):
        track_video(path)


def test_a_file_that_says_so_is_warned_of_once(leaf_fields, tmp_path):
    options = {"flags": "+ildct", "x264-params": "tff=1"}
    path = write_frames(tmp_path / "said.mp4", woven(leaf_fields), options=options)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        track_video(path)
    assert len(told) == 1


def test_a_file_that_says_so_later_is_warned_of_once(leaf_fields, tmp_path):
    """As where something else comes before a film."""
    options = {"flags": "+ildct", "x264-params": "tff=1"}
    parts = [
        write_frames(tmp_path / "whole.h264", leaf_fields[:3]),
        write_frames(tmp_path / "woven.h264", woven(leaf_fields), options=options),
    ]
    (tmp_path / "later.h264").write_bytes(b"".join(part.read_bytes() for part in parts))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        track_video(tmp_path / "later.h264")
    assert ["interlaced" in str(one.message) for one in told] == [True]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("texture", "motion"),
    [(leaves, {}), (stripes, {}), (stripes, {"pan": 1.0, "tilt": 10.0})],
)
def test_nothing_is_said_of_whole_pictures(texture, motion, tmp_path):
    """Warnings are errors."""
    frames = fields(texture(), **motion)[::2]
    track_frames(frames)
    track_video(write_frames(tmp_path / "whole.mp4", frames, options={"crf": "26"}))
    track_frames([frames[n] for n in np.repeat(np.arange(FRAMES), [2, 3] * (FRAMES // 2))])


def test_a_rolling_shutter_is_no_field():
    focal, rotation = pan_and_zoom(lens(), 100, pan=20)
    part = slice(30, 30 + FRAMES)
    track_frames(motion_clip(lens(), focal[part], rotation[part], noise=1.5, shutter=0.9).frames())
