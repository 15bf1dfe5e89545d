"""Arguments of scenes that make no sense are refused by name."""

import numpy as np
import pytest

from zoomjax import scenes

FOCAL = np.array([24.0, 50.0])

WRONG = {
    "motion_lines spacing 0": (lambda lens: scenes.motion_lines(lens, FOCAL, spacing=0), "spacing"),
    "motion_lines spacing -5": (lambda lens: scenes.motion_lines(lens, FOCAL, spacing=-5), "spacing"),
    "motion_lines noise -1": (lambda lens: scenes.motion_lines(lens, FOCAL, noise=-1), "noise"),
    "motion_lines number 0": (lambda lens: scenes.motion_lines(lens, FOCAL, number=0), "number"),
    "broadcast_lines spacing 0": (lambda lens: scenes.broadcast_lines(lens, FOCAL, spacing=0), "spacing"),
    "broadcast_lines f": (lambda lens: scenes.broadcast_lines(lens, np.array([-5.0])), "focal"),
    "board_lines f": (lambda lens: scenes.board_lines(lens, np.array([24.0, np.nan])), "focal"),
    "board_lines spacing": (lambda lens: scenes.board_lines(lens, FOCAL, spacing=np.inf), "spacing"),
    "board_lines noise": (lambda lens: scenes.board_lines(lens, FOCAL, noise=np.nan), "noise"),
    "board_photo f": (lambda lens: scenes.board_photo(lens, -24.0), "focal"),
    "board_photo blur": (lambda lens: scenes.board_photo(lens, 24.0, blur=-1), "blur"),
    "board_photo vignetting": (lambda lens: scenes.board_photo(lens, 24.0, vignetting=2), "vignetting"),
    "pan_and_zoom frames": (lambda lens: scenes.pan_and_zoom(lens, 0), "frames"),
    "pan_and_zoom pan": (lambda lens: scenes.pan_and_zoom(lens, 3, pan=np.nan), "pan"),
    "pan_and_zoom lens": (lambda lens: scenes.pan_and_zoom(lens.zoom, 3), "lens"),
    "nikkor_18_200 size": (lambda lens: scenes.nikkor_18_200((640,)), "image_size"),
    "leaves size": (lambda lens: scenes.leaves((640, 480.5)), "size"),
    "focal_sweep shortest": (lambda lens: scenes.focal_sweep(3, shortest=-5), "shortest"),
    "focal_sweep number": (lambda lens: scenes.focal_sweep(0), "number"),
    "motion_tracks life": (
        lambda lens: scenes.motion_tracks(lens, *scenes.pan_and_zoom(lens, 3), life=0.5),
        "life",
    ),
    "motion_tracks moving": (
        lambda lens: scenes.motion_tracks(lens, *scenes.pan_and_zoom(lens, 3), moving=30),
        "moving",
    ),
    "motion_clip moving": (
        lambda lens: scenes.motion_clip(lens, *scenes.pan_and_zoom(lens, 3), moving=0.9),
        "moving",
    ),
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("call", WRONG)
def test_nonsense_is_refused_by_name(call):
    made, name = WRONG[call]
    with pytest.raises((ValueError, TypeError), match=f"Argument {name} must"):
        made(scenes.nikkor_18_200((320, 214)))
