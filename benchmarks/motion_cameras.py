"""Lenses of real broadcast cameras for `benchmarks/motion.py`: tracks and pitch lines seen through them."""

import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from zoomjax import Distortion, Lines, ZoomLens
from zoomjax.fit import RESULTS, MotionFit, fit_motion
from zoomjax.models import TableZoom
from zoomjax.scenes import MotionScene, motion_tracks

from .motion_simulated import SHOWN, SIZE, Rows, corrected, wide
from .real.study_broadcast import SCALE, Clip, looking_at, pitch_lines, read_clip


class FrameLenses:
    """The lenses of a clip's frames: radial polynomials that invert OpenCV's, and one lens of them all.

    Frames of one focal length have others by its last digits, by which the lens tells them apart.
    """

    def __init__(self, clip: Clip, frames: np.ndarray):
        self.focal = clip.focal[frames] * (1 + 1e-9 * np.arange(len(frames)))
        self.centre = clip.principal[frames]
        self.k = [_inverse(f, k) for f, k in zip(clip.focal[frames], clip.k[frames], strict=True)]
        middle, order = (np.array(SIZE) - 1) / 2, np.argsort(1 / self.focal)
        each = np.array(self.k)[order], (self.centre[order] - middle) / SCALE
        zoom, shift = (TableZoom(parameters=of, knots=1 / self.focal[order]) for of in each)
        ends = np.array([self.focal.min(), self.focal.max()])
        self.lens = ZoomLens(zoom, middle, ends, SIZE, "px", shift=shift)


def _inverse(focal: float, k: np.ndarray) -> np.ndarray:
    """Four coefficients that correct what OpenCV's distort, over the image."""
    r = np.linspace(0, 1.1, 200)[1:]
    bent = r * SCALE * (1 + (r * SCALE / focal) ** 2 * (k[0] + (r * SCALE / focal) ** 2 * k[1])) / SCALE
    powers = bent[:, None] ** (2 * np.arange(1, 5) + 1)
    found = np.linalg.lstsq(powers, r - bent)[0]
    assert abs(powers @ found - (r - bent)).max() * SCALE < 0.02
    return found


def real_scene(
    clip: Clip, pupil: float, seed: int = 0
) -> tuple[FrameLenses, MotionScene, Lines, np.ndarray]:
    """Tracks and pitch lines of a clip; the frames of the lines."""
    frames = np.arange(0, len(clip.focal), 4)
    lenses = FrameLenses(clip, frames)
    time = np.linspace(0, 2 * np.pi * len(frames) / 150, len(frames))
    aims = np.column_stack([30 * np.sin(1.3 * time), 5 + 10 * np.sin(2.1 * time), 0 * time])
    turns = np.stack([looking_at(clip.position, aim) for aim in aims])
    scene = motion_tracks(lenses.lens, lenses.focal, turns, noise=0.5, pupil=pupil, seed=seed)
    rng = np.random.default_rng(seed)
    some = np.arange(0, len(frames), 5)
    seen = [pitch_lines(clip, frames[place], turns[place]) for place in some]
    points = [line[::5] + rng.normal(0, 0.5, line[::5].shape) for lines in seen for line in lines]
    number = np.repeat(np.arange(len(some)), [len(lines) for lines in seen])
    long = [len(line) >= 5 for line in points]
    points = [np.clip(line, 0, np.array(SIZE) - 1) for line, use in zip(points, long, strict=True) if use]
    used, place = np.unique(number[long], return_inverse=True)
    lines = Lines.from_ragged(points, place, np.ones(len(used)), image_size=SIZE, focal_unit="px")
    return lenses, scene, lines, some[used]


def real(folder: Path, only: str, draws: int, stored: dict[str, list[dict]]) -> Rows:
    """Errors of each clip as it is, with the pupil off the axis, and with lines: a row after each draw."""
    for path in sorted((folder / "broadcast_cameras").glob("*.npz")):
        clip = read_clip(path)
        for kind, pupil, with_lines in (
            ("", 0, False),
            (", pupil 0.2 m", 0.2, False),
            (", lines", 0, True),
        ):
            name = clip.name + kind
            found = list(stored.get(name, []))
            for seed in range(len(found), draws if only in name else 0):
                lenses, scene, lines, line_frames = real_scene(clip, pupil, seed)
                more = {"lines": lines, "line_frames": line_frames} if with_lines else {}
                begin = time.perf_counter()
                fit = fit_motion(scene.tracks, throw=False, **more)
                found.append(_drawn(lenses, scene, fit) | {"seconds": time.perf_counter() - begin})
                yield name, {"frames": len(scene.focal)} | _summary(found)


def _drawn(lenses: FrameLenses, scene: MotionScene, fit: MotionFit) -> dict:
    """Errors of one draw, over all frames."""
    own = np.asarray(fit.focal)
    missed = corrected(wide(fit.lens), fit.focal) - _corrected_truly(np.array(lenses.k), lenses.centre)
    ratio, std = np.log(own / scene.focal), np.asarray(fit.focal_std) / own
    return {
        "f": float(np.sqrt(np.mean(np.expm1(ratio) ** 2))),
        "factor": float(np.expm1(np.mean(ratio))),
        "f_bound": float(np.sqrt(np.mean(std**2))),
        "lens": float(np.sqrt(np.mean(np.sum(np.square(missed), axis=-1)))),
        "noise": float(fit.noise),
        "good": bool(fit.fit.result == RESULTS.successful),
    }


@eqx.filter_jit
def _corrected_truly(k, centre):
    """Points of the image corrected by the lens of each frame, without what is common to all, px."""
    points = jax.vmap(lambda k, c: Distortion(k, c, jnp.array(SCALE)).undistort(SHOWN))(k, centre)
    return points - jnp.mean(points, axis=1, keepdims=True)


def _summary(found: list[dict]) -> dict:
    """The row of a clip from its draws so far: what is in the middle of them, and the worst."""
    of = {name: np.array([draw[name] for draw in found]) for name in found[0]}
    return {
        "draws": len(found),
        "f": float(np.median(of["f"])),
        "f_worst": float(np.max(of["f"])),
        "f_bound": float(np.median(of["f_bound"])),
        "f_ratio": float(np.sqrt(np.mean((of["f"] / of["f_bound"]) ** 2))),
        "lens": float(np.median(of["lens"])),
        "lens_worst": float(np.max(of["lens"])),
        "told": int(np.sum(~of["good"])),
        "seconds": float(np.median(of["seconds"])),
        "found": list(found),
    }
