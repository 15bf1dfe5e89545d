"""Arguments of scenes that make no sense are refused by name."""

import numpy as np
import pytest

from zoomjax import scenes

FOCAL = np.array([24.0, 50.0])


def seeded(seed):
    """Calls that take a seed, each with this one."""
    return {
        "motion_lines": lambda lens: scenes.motion_lines(lens, FOCAL, seed=seed),
        "broadcast_lines": lambda lens: scenes.broadcast_lines(lens, FOCAL, seed=seed),
        "board_lines": lambda lens: scenes.board_lines(lens, FOCAL, seed=seed),
        "board_photo": lambda lens: scenes.board_photo(lens, 24.0, noise=0, seed=seed),
        "leaves": lambda lens: scenes.leaves((64, 48), seed=seed),
        "pan_and_zoom": lambda lens: scenes.pan_and_zoom(lens, 3, seed=seed),
        "motion_tracks": lambda lens: scenes.motion_tracks(lens, *scenes.pan_and_zoom(lens, 3), seed=seed),
        "motion_clip": lambda lens: scenes.motion_clip(lens, *scenes.pan_and_zoom(lens, 3), seed=seed),
    }


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
    "motion_lines noise True": (lambda lens: scenes.motion_lines(lens, FOCAL, noise=True), "noise"),
    "motion_lines spacing np.True_": (
        lambda lens: scenes.motion_lines(lens, FOCAL, spacing=np.True_),
        "spacing",
    ),
    "board_photo blur True": (lambda lens: scenes.board_photo(lens, 24.0, blur=True), "blur"),
    "board_photo levels": (lambda lens: scenes.board_photo(lens, 24.0, levels=(False, 215)), "levels"),
    "pan_and_zoom tilt": (lambda lens: scenes.pan_and_zoom(lens, 3, tilt=True), "tilt"),
    "motion_tracks pupil": (
        lambda lens: scenes.motion_tracks(lens, *scenes.pan_and_zoom(lens, 3), pupil=True),
        "pupil",
    ),
    "motion_clip density": (
        lambda lens: scenes.motion_clip(lens, *scenes.pan_and_zoom(lens, 3), density=True),
        "density",
    ),
    **{
        f"{name} seed {seed!r}": (call, "seed")
        for seed in (-1, 1.5, "1", True)
        for name, call in seeded(seed).items()
    },
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("call", WRONG)
def test_nonsense_is_refused_by_name(call):
    made, name = WRONG[call]
    with pytest.raises((ValueError, TypeError), match=f"Argument {name} must"):
        made(scenes.nikkor_18_200((320, 214)))
