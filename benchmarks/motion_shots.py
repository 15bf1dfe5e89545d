"""Clips with a cut for `benchmarks/motion.py`: two shots of one scene, rendered, and joined or not."""

import tempfile
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from zoomjax.app.motion_calibration import calibrate_motion
from zoomjax.fit import MotionFit, fit_motion
from zoomjax.scenes import leaves, motion_clip
from zoomjax.tracks import track_video

from .motion_clips import write_video
from .motion_simulated import Rows, random_lens

_CUT, _DENSITY = 40, 2000.0


def shots(only: str) -> Rows:
    """f of the second shot and the rotation across the cut, each shot alone and joined."""
    lens = random_lens(0, 1200.0, 3.0)
    first = _shot((-15, 12), (0, 4), (1250, 1900), _CUT)
    kinds = {
        "two shots of 40 frames": (_shot((28, 0), (6, 2), (1500, 2900), _CUT), 0),
        "the second of 12 frames, turning 1.5°": (_shot((4, 5.5), (2, 2), (1700, 1950), 12), 0),
        "the second of another scene": (_shot((28, 0), (6, 2), (1500, 2900), _CUT), 1),
    }
    for name, (second, scene) in kinds.items():
        if only not in name:
            continue
        frames = []
        for part, seed in ((first, 0), (second, scene)):
            frames += motion_clip(
                lens, *part, texture=leaves(seed=seed), density=_DENSITY, noise=2
            ).frames()
        focal, rotation = (np.concatenate(both) for both in zip(first, second, strict=True))
        with tempfile.TemporaryDirectory() as folder:
            clip = Path(folder) / "clip.mp4"
            write_video(clip, frames)
            tracks = track_video(clip)
            alone = fit_motion(tracks, throw=False)
            done = calibrate_motion(clip, tracks)
        yield (
            name,
            {
                "frames": len(focal),
                "scenes": int(np.max(np.asarray(done.fit.scene))) + 1,
                **{f"alone_{key}": value for key, value in _of_second(alone, focal).items()},
                **_of_second(done.fit, focal),
                "rotation": _across(done.fit, rotation),
            },
        )


def _shot(
    pan: tuple[float, float], tilt: tuple[float, float], focal: tuple[float, float], number: int
) -> tuple[np.ndarray, np.ndarray]:
    """Focal lengths and rotations of so many frames between these ends, degrees and px."""
    angles = np.column_stack([np.linspace(*tilt, number), np.linspace(*pan, number)])
    return np.geomspace(*focal, number), Rotation.from_euler("xy", -angles, degrees=True).as_matrix()


def _of_second(fit: MotionFit, focal: np.ndarray) -> dict[str, float]:
    """The RMS error of f in the second shot and its deviation, relative."""
    own, std = (np.asarray(of)[_CUT:] for of in (fit.focal, fit.focal_std))
    return {
        "f": float(np.sqrt(np.mean((own / focal[_CUT:] - 1) ** 2))),
        "f_bound": float(np.sqrt(np.mean((std / own) ** 2))),
    }


def _across(fit: MotionFit, rotation: np.ndarray) -> float:
    """The error of the turn from the frame before the cut to the one after it, degrees; NaN if unknown."""
    scene = np.asarray(fit.scene)
    if scene[_CUT - 1] != scene[_CUT]:
        return float("nan")
    own, true = (of[_CUT] @ of[_CUT - 1].T for of in (np.asarray(fit.rotation), rotation))
    return float(np.degrees(Rotation.from_matrix(own @ true.T).magnitude()))
