"""Masked arrays of NumPy: what is masked would count, so they are refused by all that takes arrays."""

from typing import Any

import numpy as np
import pytest

import zoomjax as zj
from zoomjax import detect, focal, models, scenes, tracks
from zoomjax.focal.pitch import PITCH_LINES

pytestmark = pytest.mark.usefixtures("unchecked")

IMAGE: Any = np.ma.masked_array(np.full((96, 128), 90, np.uint8), False)
IMAGE[20:40] = np.ma.masked
POINTS = np.ma.masked_array(np.random.default_rng(0).uniform(0, 90, (5, 2)), False)
POINTS[2] = np.ma.masked
LENS = scenes.nikkor_18_200((128, 96))
PLAIN = {name: np.array(ends) for name, ends in PITCH_LINES.items()}

CALLS = {
    "EdgeDetector": lambda: detect.EdgeDetector()(IMAGE),
    "GridDetector": lambda: detect.GridDetector()(IMAGE),
    "PitchDetector": lambda: detect.PitchDetector()(IMAGE),
    "find_checkerboard": lambda: detect.find_checkerboard(IMAGE),
    "find_dots": lambda: detect.find_dots(IMAGE),
    "track_frames": lambda: tracks.track_frames([IMAGE, IMAGE]),
    "undistort_image": lambda: zj.undistort_image(IMAGE, LENS(35.0)),
    "warp_image": lambda: zj.warp_image(IMAGE.astype(np.float32), LENS(35.0)),
    "Camera.project": lambda: models.Camera(LENS, pixel_pitch=0.2).project(
        np.ma.masked_array(np.ones((2, 3)), [[True] * 3, [False] * 3]), 35.0
    ),
    "Camera.rays": lambda: models.Camera(LENS, pixel_pitch=0.2).rays(POINTS, 35.0),
    "focal_from_pitch": lambda: focal.focal_from_pitch(
        {**PLAIN, "Middle line": POINTS}, principal=np.zeros(2)
    ),
    "name_pitch_lines": lambda: focal.name_pitch_lines(
        [POINTS] * 4, principal=np.zeros(2), image_size=(128, 96)
    ),
    "the principal point of name_pitch_lines": lambda: focal.name_pitch_lines(
        list(PLAIN.values()), principal=np.ma.masked_array([60.0, 40.0], [True, False]), image_size=(9, 9)
    ),
}


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
def test_a_mask_is_not_dropped(call):
    with pytest.raises(ValueError, match="is a masked array, and masks are not kept"):
        call()
