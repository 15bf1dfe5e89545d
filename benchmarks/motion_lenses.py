"""Clips of several shots for `benchmarks/motion.py`, of one camera and of two: which have two lenses."""

import dataclasses
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from zoomjax import PolynomialZoom, ZoomLens
from zoomjax.app.motion_calibration import MotionCalibration
from zoomjax.fit import MotionFit, fit_motion
from zoomjax.fit.contradiction import OTHER_LENS
from zoomjax.models import certify
from zoomjax.scenes import motion_tracks, pan_and_zoom
from zoomjax.tracks import Tracks

from .motion_simulated import SIZE, Rows, random_lens

_LOW, _RATIO, _FRAMES, _TURN = 1200.0, 3.0, 24, 72


class Kind(NamedTuple):
    """How clips differ from those of two shots of one camera, both zooming, with noise of 0.3 px.

    Attributes:
        other: the second camera's lens, as `_other` names it; of one camera there is none.
        tracks: options of `motion_tracks`.
        still: how many of the shots, from the last one, have one zoom.
        shots: how many there are, of the cameras in turn.
        pan: degrees from end to end.
        near: whether the first shot shows points that are 15 to 40 m away.
    """

    other: str = ""
    tracks: dict[str, Any] = {}  # noqa: RUF012, it is not written to
    still: int = 0
    shots: int = 2
    pan: float = 30.0
    near: bool = False


KINDS = {
    "one camera": Kind(),
    "one camera, noise 0.1 px": Kind(tracks={"noise": 0.1}),
    "one camera, noise 0.5 px": Kind(tracks={"noise": 0.5}),
    "one camera, pan 5°": Kind(pan=5),
    "one camera, the second at one zoom": Kind(still=1),
    "one camera, four shots": Kind(shots=4),
    "one camera, 30 % of tracks on moving things": Kind(tracks={"moving": 0.3}),
    "one camera, tracks drift 0.03 px a frame": Kind(tracks={"drift": 0.03}),
    "one camera, rolling shutter": Kind(tracks={"shutter": 0.4}),
    "one camera, pupil 0.2 m, one shot near": Kind(tracks={"pupil": 0.2}, near=True),
    "one camera, a lens of degree 4, noise 0.1 px": Kind("degree 4", {"noise": 0.1}),
    "half the distortion": Kind("half"),
    "half the distortion, noise 0.1 px": Kind("half", {"noise": 0.1}),
    "half the distortion, noise 0.5 px": Kind("half", {"noise": 0.5}),
    "twice the focal scale": Kind("twice"),
    "twice the focal scale, noise 0.5 px": Kind("twice", {"noise": 0.5}),
    "half and twice": Kind("both"),
    "another lens": Kind("another"),
    "another lens, four shots in turn": Kind("another", shots=4),
    "another lens, pan 5°": Kind("another", pan=5),
    "another lens, the second at one zoom": Kind("another", still=1),
    "another lens, both at one zoom": Kind("another", still=2),
}


def _lenses(kind: str, seed: int) -> list[ZoomLens]:
    """The lenses of the cameras."""
    first = random_lens(seed, _LOW, _RATIO)
    k, low = np.asarray(first.zoom.parameters), _LOW
    if kind == "":
        return [first]
    if kind == "degree 4":
        k = np.concatenate([k, [[0.05, -0.02], [-0.06, 0.02]]])
        only = _with(first, k, low)
        return [only] if certify(only).certified else [first]
    if kind == "another":
        return [first, random_lens(seed + 1000, _LOW, _RATIO)]
    k = k / 2 if kind in ("half", "both") else k
    return [first, _with(first, k, 2 * low if kind in ("twice", "both") else low)]


def _with(lens: ZoomLens, k: np.ndarray, low: float) -> ZoomLens:
    zoom = PolynomialZoom(len(k) - 1, jnp.asarray(k), jnp.array(low))
    lens = dataclasses.replace(lens, zoom=zoom)
    return eqx.tree_at(lambda lens: lens.focal_range, lens, jnp.array([low, _RATIO * low]))


def _clip(kind: Kind, seed: int) -> tuple[Tracks, list[np.ndarray]]:
    """The tracks of a clip, none of which goes across a cut, and the true focal lengths of each shot."""
    lenses = _lenses(kind.other, seed)
    rng = np.random.default_rng((seed, 1))
    number, scenes = _FRAMES * 2 // kind.shots, []
    for shot in range(kind.shots):
        lens = lenses[shot % len(lenses)]
        focal, rotation = pan_and_zoom(lens, _TURN, pan=kind.pan, tilt=5, seed=4 * seed + shot)
        first = int(rng.integers(_TURN - number))
        focal, rotation = focal[first:][:number], rotation[first:][:number]
        if shot >= kind.shots - kind.still:
            focal = np.full(number, focal[0])
        options = {"views": 120, "life": 15, "noise": 0.3} | kind.tracks
        if kind.near:
            options["distance"] = (15.0, 40.0) if shot == 0 else (60.0, 200.0)
        scenes.append(motion_tracks(lens, focal, rotation, seed=4 * seed + shot, **options))
    return _cut_together([(scene.tracks, scene.focal) for scene in scenes])


def _cut_together(shots: list[tuple[Tracks, np.ndarray]]) -> tuple[Tracks, list[np.ndarray]]:
    """Tracks of shots one after the other, and their focal lengths."""
    parts, tracks, frames = [], 0, 0
    for of, focal in shots:
        track, frame, points = of.views()
        parts.append((track + tracks, frame + frames, points))
        tracks, frames = tracks + int(track.max()) + 1, frames + len(focal)
    track, frame, points = (np.concatenate(of) for of in zip(*parts, strict=True))
    joined = Tracks.from_arrays(track, frame, points, image_size=SIZE, frames=frames)
    return joined, [focal for _, focal in shots]


def two_lenses(clips: int, only: str, stored: dict[str, list[dict]]) -> Rows:
    """How many clips of each kind are told to have two lenses, and what f is off by: a row after each."""
    for name, kind in KINDS.items():
        if only not in name:
            continue
        found = list(stored.get(name, []))
        for seed in range(len(found), clips):
            tracks, focals = _clip(kind, seed)
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                fit = fit_motion(tracks, throw=False)
            told = tuple(str(of.message) for of in caught if str(of.message).startswith(OTHER_LENS))
            found.append(_found(tracks, fit, focals, told))
            yield name, _summary(found)


def _found(
    tracks: Tracks, fit: MotionFit, focals: list[np.ndarray], told: tuple[str, ...]
) -> dict[str, Any]:
    own, std = np.asarray(fit.focal), np.asarray(fit.focal_std)
    cuts = np.cumsum([len(focal) for focal in focals])[:-1]
    off = [np.nanmedian(of) for of in np.split(np.abs(np.log(own / np.concatenate(focals))), cuts)]
    worst = int(np.argmax(off))
    f, bound = float(off[worst]), float(np.nanmedian(np.split(std / own, cuts)[worst]))
    times = np.zeros((tracks.frames, 2))
    verdicts = [MotionCalibration(Path(), tracks, fit, times, contradicted=of).verdict for of in ((), told)]
    return {
        "f": f,
        "f_bound": bound,
        "told": bool(told),
        "good_without": verdicts[0] == "good",
        "silent": verdicts[1] == "good" and f > max(3 * bound, 0.01),
        "message": told[0] if told else "",
    }


def _summary(found: list[dict]) -> dict:
    """The row of a kind from its clips so far."""
    f = [clip["f"] for clip in found]
    return {
        "clips": len(found),
        "off": sum(clip["f"] > max(3 * clip["f_bound"], 0.01) for clip in found),
        "told": sum(clip["told"] for clip in found),
        "good_without": sum(clip["good_without"] for clip in found),
        "silent": sum(clip["silent"] for clip in found),
        "f": float(np.median(f)),
        "f_untold": max((clip["f"] for clip in found if not clip["told"]), default=float("nan")),
        "found": list(found),
    }
