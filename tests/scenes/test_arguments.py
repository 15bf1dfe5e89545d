"""Arguments of scenes that make no sense are refused by name."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes

FOCAL = np.array([24.0, 50.0])


def in_px(lens):
    """The lens with focal lengths in px, as clips need them."""
    return dataclasses.replace(lens, focal_unit="px")


def moving(lens):
    """It, and a path of three frames."""
    return in_px(lens), *scenes.pan_and_zoom(in_px(lens), 3)


def scaled(lens):
    """The lens for images of half the size, whose focal lengths stay those of the whole."""
    with pytest.warns(UserWarning, match="distortion is scaled"):
        return zj.models.lens_for_size(lens, tuple(side // 2 for side in lens.image_size))


def noisy(lens, **options):
    return scenes.with_noise(scenes.board_lines(lens, FOCAL), jax.random.key(0), **options)


def seeded(seed):
    """Calls that take a seed, each with this one."""
    return {
        "motion_lines": lambda lens: scenes.motion_lines(lens, FOCAL, seed=seed),
        "broadcast_lines": lambda lens: scenes.broadcast_lines(lens, FOCAL, seed=seed),
        "board_lines": lambda lens: scenes.board_lines(lens, FOCAL, seed=seed),
        "board_photo": lambda lens: scenes.board_photo(lens, 24.0, noise=0, seed=seed),
        "leaves": lambda lens: scenes.leaves((64, 48), seed=seed),
        "pan_and_zoom": lambda lens: scenes.pan_and_zoom(in_px(lens), 3, seed=seed),
        "motion_tracks": lambda lens: scenes.motion_tracks(*moving(lens), seed=seed),
        "motion_clip": lambda lens: scenes.motion_clip(*moving(lens), seed=seed),
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
    "pan_and_zoom frames": (lambda lens: scenes.pan_and_zoom(in_px(lens), 0), "frames"),
    "pan_and_zoom pan": (lambda lens: scenes.pan_and_zoom(in_px(lens), 3, pan=np.nan), "pan"),
    "pan_and_zoom lens": (lambda lens: scenes.pan_and_zoom(lens.zoom, 3), "lens"),
    "nikkor_18_200 size": (lambda lens: scenes.nikkor_18_200((640,)), "image_size"),
    "leaves size": (lambda lens: scenes.leaves((640, 480.5)), "size"),
    "focal_sweep shortest": (lambda lens: scenes.focal_sweep(3, shortest=-5), "shortest"),
    "focal_sweep number": (lambda lens: scenes.focal_sweep(0), "number"),
    "motion_tracks life": (
        lambda lens: scenes.motion_tracks(*moving(lens), life=0.5),
        "life",
    ),
    "motion_tracks moving": (
        lambda lens: scenes.motion_tracks(*moving(lens), moving=30),
        "moving",
    ),
    "motion_clip moving": (
        lambda lens: scenes.motion_clip(*moving(lens), moving=0.9),
        "moving",
    ),
    "motion_lines noise True": (lambda lens: scenes.motion_lines(lens, FOCAL, noise=True), "noise"),
    "motion_lines spacing np.True_": (
        lambda lens: scenes.motion_lines(lens, FOCAL, spacing=np.True_),
        "spacing",
    ),
    "board_photo blur True": (lambda lens: scenes.board_photo(lens, 24.0, blur=True), "blur"),
    "board_photo levels": (lambda lens: scenes.board_photo(lens, 24.0, levels=(False, 215)), "levels"),
    "pan_and_zoom tilt": (lambda lens: scenes.pan_and_zoom(in_px(lens), 3, tilt=True), "tilt"),
    "motion_tracks pupil": (
        lambda lens: scenes.motion_tracks(*moving(lens), pupil=True),
        "pupil",
    ),
    "motion_clip density": (
        lambda lens: scenes.motion_clip(*moving(lens), density=True),
        "density",
    ),
    "pan_and_zoom mm": (lambda lens: scenes.pan_and_zoom(lens, 3), "lens"),
    "motion_tracks mm": (lambda lens: scenes.motion_tracks(lens, *moving(lens)[1:]), "lens"),
    "motion_clip mm": (lambda lens: scenes.motion_clip(lens, *moving(lens)[1:]), "lens"),
    "pan_and_zoom scaled": (lambda lens: scenes.pan_and_zoom(scaled(in_px(lens)), 3), "lens"),
    "board_lines beyond the board": (
        lambda lens: scenes.board_lines(lens, FOCAL, board=scenes.StripedBoard(distance=40.0)),
        "focal",
    ),
    "board_photo at the board": (
        lambda lens: scenes.board_photo(lens, 24.0, board=scenes.StripedBoard(distance=24.0)),
        "focal",
    ),
    "StripedBoard distance": (lambda lens: scenes.StripedBoard(distance=-1185.0), "distance"),
    "StripedBoard pixel_pitch": (lambda lens: scenes.StripedBoard(pixel_pitch=0.0), "pixel_pitch"),
    "StripedBoard stripes": (lambda lens: scenes.StripedBoard(stripes=(31, 0)), "stripes"),
    "StripedBoard size": (lambda lens: scenes.StripedBoard(size=(1330.0, np.nan)), "size"),
    "with_noise std": (lambda lens: noisy(lens, std=-1.0), "std"),
    "with_noise correlation 1": (lambda lens: noisy(lens, std=1.0, correlation=1.0), "correlation"),
    "with_noise correlation": (lambda lens: noisy(lens, std=1.0, correlation=-0.5), "correlation"),
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


def test_a_board_is_seen_alike_by_focal_lengths_in_mm_and_px():
    """In px they were taken for mm: of 1500 px the board, at 1185 mm, was seen in a mirror."""
    lens = scenes.nikkor_18_200((320, 214))
    pitch = scenes.StripedBoard.before(lens).pixel_pitch
    low, high = np.asarray(lens.focal_range) / pitch
    zoom = dataclasses.replace(lens.zoom, focal_ref=lens.zoom.focal_ref / pitch)
    same = zj.ZoomLens(zoom, lens.centre, jnp.array([low, high]), lens.image_size, "px")
    one, other = scenes.board_lines(lens, FOCAL), scenes.board_lines(same, FOCAL / pitch)
    np.testing.assert_array_equal(one.frame, other.frame)
    np.testing.assert_allclose(one.points, other.points, atol=1e-9)
    photos = [scenes.board_photo(of, f) for of, f in ((lens, 50.0), (same, 50.0 / pitch))]
    assert np.abs(np.subtract(*photos, dtype=float)).max() <= 1
