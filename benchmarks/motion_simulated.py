"""Simulated tracks of `benchmarks/motion.py`: errors beside the bound, and times."""

import resource
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from zoomjax import PolynomialZoom, ZoomLens
from zoomjax.app.motion_calibration import MotionCalibration
from zoomjax.fit import RESULTS, MotionFit, fit_motion
from zoomjax.models import certify
from zoomjax.scenes import MotionScene, motion_tracks, pan_and_zoom
from zoomjax.tracks import load_tracks

SIZE = (1920, 1080)
SHOWN = np.stack(np.meshgrid(*(np.linspace(0, n - 1, 9) for n in SIZE)), -1).reshape(-1, 2)
_DRAWS = 60
_LENS = {"low": 1200.0, "ratio": 4.0}

KINDS: dict[str, tuple[dict, dict]] = {
    "pan 30°, zoom 1:4": ({}, {}),
    "noise 0.5 px": ({}, {"noise": 0.5}),
    "pan 10°": ({"pan": 10}, {}),
    "pan 5°": ({"pan": 5}, {}),
    "pan 2°": ({"pan": 2}, {}),
    "pan 1°": ({"pan": 1}, {}),
    "no tilt": ({"tilt": 0}, {}),
    "zoom 1:10": ({"ratio": 10.0}, {}),
    "f 2,400 to 7,100 px, pan 10°": ({"low": 2400.0, "ratio": 2.96, "pan": 10}, {}),
    "50 tracks a frame": ({}, {"views": 50}),
    "tracks live 10 frames": ({}, {"life": 10}),
    "30 % of tracks on moving things": ({}, {"moving": 0.3}),
    "80 % of tracks on moving things": ({}, {"moving": 0.8}),
    "points kept as a map": ({}, {"returns": True}),
    "zoom without turning": ({"pan": 0, "tilt": 0}, {}),
}
"""Path and tracks that differ from the first line's."""


Rows = Iterator[tuple[str, dict]]
"""Names of rows, and what they are made of."""


def random_lens(seed: int, low: float, ratio: float) -> ZoomLens:
    """A random lens that does not fold, from a focal length to so many times it."""
    rng = np.random.default_rng(seed)
    centre = (np.array(SIZE) - 1) / 2 + rng.normal(0, 6, 2)
    while True:
        k = rng.normal(size=(3, 2)) * [[0.02, 0.005], [0.05, 0.01], [0.1, 0.03]]
        zoom = PolynomialZoom(2, jnp.asarray(k), jnp.array(low))
        lens = ZoomLens(zoom, jnp.asarray(centre), jnp.array([low, ratio * low]), SIZE, "px")
        if certify(lens).certified:
            return lens


def random_scene(seed: int, path: dict, tracks: dict, frames: int = 150) -> tuple[ZoomLens, MotionScene]:
    """A random lens, and tracks of it on a random path."""
    given = _LENS | {"pan": 30, "tilt": 5} | path
    lens = random_lens(seed, given["low"], given["ratio"])
    where = pan_and_zoom(lens, frames, pan=given["pan"], tilt=given["tilt"], seed=seed)
    options = {"views": 200, "life": 40, "noise": 0.3} | tracks
    return lens, motion_tracks(lens, *where, seed=seed, **options)


@eqx.filter_jit
def corrected(lens: ZoomLens, focal: jax.Array):
    """Points of the image corrected at each focal length, without what is common to all of them, px."""
    points = jax.vmap(lambda f: lens(f).undistort(SHOWN))(focal)
    return points - jnp.mean(points, axis=1, keepdims=True)


def displaced(lens: ZoomLens, other: ZoomLens, focal: np.ndarray, own: np.ndarray) -> float:
    """RMS distance over the image of points corrected by two lenses at their own focal lengths, px."""
    missed = corrected(other, jnp.asarray(own)) - corrected(lens, jnp.asarray(focal))
    return float(jnp.sqrt(jnp.mean(jnp.sum(missed**2, axis=-1))))


def bounds(fit: MotionFit, frames: np.ndarray, rng: np.random.Generator) -> tuple[float, float]:
    """What the covariance says of the errors of f, relative, and of the lens, px: RMS."""
    lens = wide(fit.lens)
    assert lens.shift is not None
    start, unravel = ravel_pytree((lens.zoom.parameters, lens.shift.parameters))
    focal = np.asarray(fit.focal)[frames]
    sizes = []
    without_readout = np.delete(np.arange(len(fit.covariance)), -2)
    covariance = 0.95 * np.asarray(fit.covariance)[np.ix_(without_readout, without_readout)]
    for draw in rng.multivariate_normal(np.zeros(len(start) + 1), covariance, _DRAWS):
        parameters = unravel(start + draw[:-1])
        moved = eqx.tree_at(lambda lens: (lens.zoom.parameters, lens.shift.parameters), lens, parameters)
        sizes.append(displaced(lens, moved, focal, focal * np.exp(draw[-1])))
    std = np.asarray(fit.focal_std / fit.focal)
    return float(np.sqrt(0.95 * np.nanmean(std**2))), float(np.sqrt(np.mean(np.square(sizes))))


def errors(lens: ZoomLens, focal: np.ndarray, fit: MotionFit, frames: np.ndarray) -> tuple[float, float]:
    """Of all focal lengths, relative, and of the lens, px: RMS."""
    own = np.asarray(fit.focal)
    return float(np.sqrt(np.nanmean((own / focal - 1) ** 2))), displaced(
        lens, wide(fit.lens), focal[frames], own[frames]
    )


def wide(lens: ZoomLens) -> ZoomLens:
    """The lens, taken beyond its focal lengths: a fitted f may lie there by its error."""
    return ZoomLens(
        lens.zoom,
        lens.centre,
        lens.focal_range * np.array([0.5, 2]),
        lens.image_size,
        "px",
        shift=lens.shift,
    )


def simulated(clips: int, only: str, stored: dict[str, list[dict]]) -> Rows:
    """Errors and bounds of each kind of clip: a row after each clip."""
    for kind, (path, tracks) in KINDS.items():
        if only not in kind:
            continue
        found = list(stored.get(kind, []))
        for seed in range(len(found), clips):
            lens, scene = random_scene(seed, path, tracks)
            begin = time.perf_counter()
            fit = fit_motion(scene.tracks, throw=False)
            seconds = time.perf_counter() - begin
            frames = np.arange(0, len(scene.focal), 15)
            own, bound = (
                errors(wide(lens), scene.focal, fit, frames),
                bounds(fit, frames, np.random.default_rng(0)),
            )
            good = bool(fit.fit.result == RESULTS.successful)
            diverged = good and own[0] > max(3 * bound[0], 0.01)
            times = np.arange(len(scene.focal)) / 25
            verdict = MotionCalibration(Path(), scene.tracks, fit, times).verdict
            found.append(
                {
                    "f": own[0],
                    "lens": own[1],
                    "f_bound": bound[0],
                    "lens_bound": bound[1],
                    "good": good,
                    "diverged": diverged,
                    "verdict": verdict,
                    "seconds": seconds,
                }
            )
            yield kind, _summary(found)


def _summary(found: list[dict]) -> dict:
    """The row of a kind from its clips so far, so that a run that is stopped leaves what it has."""
    accepted = [clip for clip in found if clip["good"]] or found
    mean = {
        name: float(np.sqrt(np.mean([clip[name] ** 2 for clip in accepted])))
        for name in ("f", "f_bound", "lens", "lens_bound")
    }
    return mean | {
        "clips": len(found),
        "diverged": sum(clip["diverged"] for clip in found),
        "told": sum(not clip["good"] for clip in found),
        "doubted": _doubted(found),
        "silent": sum(clip["diverged"] and clip.get("verdict", "good") == "good" for clip in found),
        "seconds": float(np.median([clip["seconds"] for clip in found])),
        "found": list(found),
    }


def _doubted(found: list[dict]) -> int | None:
    """How many clips have a verdict that is not good; None where clips of before have none stored."""
    if any("verdict" not in clip for clip in found):
        return None
    return sum(clip["verdict"] != "good" for clip in found)


def timed(only: str) -> Rows:
    """Seconds of a fit, the second in the process, and the most memory that the process has had.

    It reads the tracks of a file, which another process has written.
    """
    for frames in (150, 1500, 10_000):
        if only not in f"{frames:,}":
            continue
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "tracks.npz"
            with ProcessPoolExecutor(1, get_context("spawn")) as other:
                focal = other.submit(_written, path, frames).result()
            tracks = load_tracks(path)
        begin = time.perf_counter()
        fit_motion(tracks, throw=False)
        first = time.perf_counter()
        fit = fit_motion(tracks, throw=False)
        jax.block_until_ready(fit.focal)
        seconds = [first - begin, time.perf_counter() - first]
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        shown = np.arange(0, frames, max(frames // 10, 1))
        own = errors(wide(random_lens(0, **_LENS)), focal, fit, shown)
        bound = bounds(fit, shown, np.random.default_rng(0))
        yield (
            f"{frames:,} frames",
            {
                "first": seconds[0],
                "second": seconds[1],
                "GB": memory,
                "f": own[0],
                "lens": own[1],
                "f_bound": bound[0],
                "lens_bound": bound[1],
                "result": bool(fit.fit.result == RESULTS.successful),
            },
        )


def _written(path: Path, frames: int) -> np.ndarray:
    """Write the tracks of a clip, and return its focal lengths."""
    jax.config.update("jax_enable_x64", True)
    scene = random_scene(0, {}, {}, frames)[1]
    scene.tracks.save(path)
    return scene.focal
