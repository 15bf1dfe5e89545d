"""Focal lengths and the lens from how a clip moves: errors beside the Cramér-Rao bound, and times.

    python -m benchmarks.motion [--sections NAME ...] [--only TEXT] [--clips N] [--data FOLDER]

`simulated`: tracks with exact truth, of random lenses on random paths; everything is started from nothing.
f is the RMS over the clips of the error of all focal lengths, relative. The lens's error is the RMS
distance of corrected points over the image, without a shift common to all of them, which turns the camera.
The bound of each is what the covariance of the fit says, without what the robust loss loses. A clip
diverged if its focal lengths are off by more than 3 times the bound and 1 %, and the fit says nothing.
Errors are those of clips of which the fit does not say that it failed.

`real`: focal lengths, principal points and lenses of the shared broadcast clips, every fourth frame; the
camera stands where it stood, and what it looks at wanders over the pitch, as the data does not tell that.
Tracks of points of a stadium, noise 0.5 px, the centre unknown. The pupil is on the axis of rotation, or
before it; and with the pitch's lines in every fifth frame, a point each 20 px, noise 0.5 px.

`time`: seconds of a second fit in the process, tracking apart, and the memory of the process.

Results go to benchmarks/results/motion.md and motion.json after each row. With --only, other rows stay.
"""

import argparse
import json
import os
import resource
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from zoomjax import Distortion, Lines, PolynomialZoom, ZoomLens
from zoomjax.fit import RESULTS, MotionFit, fit_motion
from zoomjax.models import certify
from zoomjax.scenes import MotionScene, motion_tracks, pan_and_zoom

from .real.study_broadcast import SCALE, Clip, looking_at, pitch_lines, read_clip
from .shared import RESULTS as FOLDER
from .shared import machine, machine_line, table, write

SIZE = (1920, 1080)
_SHOWN = np.stack(np.meshgrid(*(np.linspace(0, n - 1, 9) for n in SIZE)), -1).reshape(-1, 2)
_DRAWS = 60

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
}
"""Path and tracks that differ from the first line's."""


def random_scene(seed: int, path: dict, tracks: dict, frames: int = 150) -> tuple[ZoomLens, MotionScene]:
    """A random lens, and tracks of it on a random path."""
    rng = np.random.default_rng(seed)
    given = {"low": 1200.0, "ratio": 4.0, "pan": 30, "tilt": 5} | path
    low, high = given["low"], given["low"] * given["ratio"]
    centre = (np.array(SIZE) - 1) / 2 + rng.normal(0, 6, 2)
    while True:
        k = rng.normal(size=(3, 2)) * [[0.02, 0.005], [0.05, 0.01], [0.1, 0.03]]
        zoom = PolynomialZoom(2, jnp.asarray(k), jnp.array(low))
        lens = ZoomLens(zoom, jnp.asarray(centre), jnp.array([low, high]), SIZE, "px")
        if certify(lens).certified:
            break
    where = pan_and_zoom(lens, frames, pan=given["pan"], tilt=given["tilt"], seed=seed)
    options = {"views": 200, "life": 40, "noise": 0.3} | tracks
    return lens, motion_tracks(lens, *where, seed=seed, **options)


@eqx.filter_jit
def corrected(lens: ZoomLens, focal: jax.Array):
    """Points of the image corrected at each focal length, without what is common to all of them, px."""
    points = jax.vmap(lambda f: lens(f).undistort(_SHOWN))(focal)
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
    for draw in rng.multivariate_normal(
        np.zeros(len(start) + 1), 0.95 * np.asarray(fit.covariance), _DRAWS
    ):
        parameters = unravel(start + draw[:-1])
        moved = eqx.tree_at(lambda lens: (lens.zoom.parameters, lens.shift.parameters), lens, parameters)
        sizes.append(displaced(lens, moved, focal, focal * np.exp(draw[-1])))
    std = np.asarray(fit.focal_std / fit.focal)
    return float(np.sqrt(0.95 * np.nanmean(std**2))), float(np.sqrt(np.mean(np.square(sizes))))


def errors(lens: ZoomLens, scene: MotionScene, fit: MotionFit, frames: np.ndarray) -> tuple[float, float]:
    """Of all focal lengths, relative, and of the lens, px: RMS."""
    own = np.asarray(fit.focal)
    return float(np.sqrt(np.nanmean((own / scene.focal - 1) ** 2))), displaced(
        lens, wide(fit.lens), scene.focal[frames], own[frames]
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


Rows = Iterator[tuple[str, dict]]


def simulated(clips: int, only: str) -> Rows:
    """Errors and bounds of each kind of clip."""
    for kind, (path, tracks) in KINDS.items():
        found = []
        if only not in kind:
            continue
        for seed in range(clips):
            lens, scene = random_scene(seed, path, tracks)
            begin = time.perf_counter()
            fit = fit_motion(scene.tracks, throw=False)
            seconds = time.perf_counter() - begin
            frames = np.arange(0, len(scene.focal), 15)
            own, bound = (
                errors(wide(lens), scene, fit, frames),
                bounds(fit, frames, np.random.default_rng(0)),
            )
            good = bool(fit.fit.result == RESULTS.successful)
            found.append(
                {
                    "f": own[0],
                    "lens": own[1],
                    "f_bound": bound[0],
                    "lens_bound": bound[1],
                    "good": good,
                    "diverged": good and own[0] > max(3 * bound[0], 0.01),
                    "seconds": seconds,
                }
            )
        accepted = [clip for clip in found if clip["good"]] or found
        mean = {
            name: float(np.sqrt(np.mean([clip[name] ** 2 for clip in accepted])))
            for name in ("f", "f_bound", "lens", "lens_bound")
        }
        yield (
            kind,
            mean
            | {
                "clips": clips,
                "diverged": sum(clip["diverged"] for clip in found),
                "told": sum(not clip["good"] for clip in found),
                "seconds": float(np.median([clip["seconds"] for clip in found])),
                "found": found,
            },
        )


class FrameLenses:
    """The lenses of a clip's frames, by focal length: a radial polynomial that inverts OpenCV's."""

    def __init__(self, clip: Clip, frames: np.ndarray):
        self.image_size, self.focal = SIZE, clip.focal[frames] * (1 + 1e-9 * np.arange(len(frames)))
        self.centre = clip.principal[frames]
        self.k = [_inverse(f, k) for f, k in zip(clip.focal[frames], clip.k[frames], strict=True)]

    def __call__(self, focal: float) -> Distortion:
        """The lens of the frame with this focal length."""
        frame = int(np.argmin(abs(self.focal - focal)))
        return Distortion(self.k[frame], self.centre[frame], np.array(SCALE))


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
    lenses: Any = FrameLenses(clip, frames)
    time = np.linspace(0, 2 * np.pi * len(frames) / 150, len(frames))
    aims = np.column_stack([30 * np.sin(1.3 * time), 5 + 10 * np.sin(2.1 * time), 0 * time])
    turns = np.stack([looking_at(clip.position, aim) for aim in aims])
    scene = motion_tracks(lenses, lenses.focal, turns, noise=0.5, pupil=pupil, seed=seed)
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


def real(folder: Path, only: str) -> Rows:
    """Errors of each clip: as it is, with the pupil before the axis, and with the pitch's lines."""
    for path in sorted((folder / "broadcast_cameras").glob("*.npz")):
        clip = read_clip(path)
        for kind, pupil, with_lines in (
            ("", 0, False),
            (", pupil 0.2 m", 0.2, False),
            (", lines", 0, True),
        ):
            if only not in clip.name + kind:
                continue
            lenses, scene, lines, line_frames = real_scene(clip, pupil)
            more = {"lines": lines, "line_frames": line_frames} if with_lines else {}
            begin = time.perf_counter()
            fit = fit_motion(scene.tracks, throw=False, **more)
            seconds = time.perf_counter() - begin
            own, shown = np.asarray(fit.focal), np.arange(0, len(scene.focal), 15)
            missed = []
            for frame in shown:
                pair = (wide(fit.lens)(float(own[frame])), lenses(float(scene.focal[frame])))
                a, b = (np.asarray(distortion.undistort(_SHOWN)) for distortion in pair)
                missed.append((a - a.mean(axis=0)) - (b - b.mean(axis=0)))
            yield (
                clip.name + kind,
                {
                    "frames": len(own),
                    "f": float(np.sqrt(np.mean((own / scene.focal - 1) ** 2))),
                    "f_bound": float(np.sqrt(np.mean((np.asarray(fit.focal_std) / own) ** 2))),
                    "lens": float(np.sqrt(np.mean(np.sum(np.square(missed), axis=-1)))),
                    "good": bool(fit.fit.result == RESULTS.successful),
                    "seconds": seconds,
                },
            )


def timed(only: str) -> Rows:
    """Seconds of a fit, the second in the process, and the most memory that the process has had."""
    for frames in (150, 1500, 10_000):
        if only not in f"{frames:,}":
            continue
        lens, scene = random_scene(0, {}, {}, frames)
        begin = time.perf_counter()
        fit_motion(scene.tracks, throw=False)
        first = time.perf_counter()
        fit = fit_motion(scene.tracks, throw=False)
        jax.block_until_ready(fit.focal)
        seconds = [first - begin, time.perf_counter() - first]
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        shown = np.arange(0, frames, max(frames // 10, 1))
        own = errors(wide(lens), scene, fit, shown)
        yield (
            f"{frames:,}",
            {
                "first": seconds[0],
                "second": seconds[1],
                "GB": memory,
                "f": own[0],
                "lens": own[1],
            },
        )


def page(results: dict) -> str:
    """The page that the results make."""
    lines = [
        "# Lens and focal lengths from motion",
        "",
        "`benchmarks/motion.py` says how it is measured.",
        "",
    ]
    if "simulated" in results:
        rows = [
            [
                kind,
                f"{100 * r['f']:.3f}",
                f"{100 * r['f_bound']:.3f}",
                f"{r['f'] / r['f_bound']:.2f}",
                f"{r['lens']:.3f}",
                f"{r['lens_bound']:.3f}",
                f"{r['lens'] / r['lens_bound']:.2f}",
                str(r["clips"]),
                str(r["diverged"]),
                str(r["told"]),
            ]
            for kind, r in results["simulated"]["rows"].items()
        ]
        header = [
            "simulated tracks",
            "f, %",
            "bound",
            "ratio",
            "lens, px",
            "bound",
            "ratio",
            "clips",
            "diverged",
            "refused",
        ]
        lines += [
            "## Simulated tracks",
            "",
            *table(header, rows),
            "",
            machine_line(results["simulated"]["machine"]),
            "",
        ]
    if "real" in results:
        rows = [
            [
                clip,
                str(r["frames"]),
                f"{100 * r['f']:.3f}",
                f"{100 * r['f_bound']:.3f}",
                f"{r['lens']:.3f}",
                "yes" if r["good"] else "no",
            ]
            for clip, r in results["real"]["rows"].items()
        ]
        header = ["real lenses", "frames", "f, %", "its sd", "lens, px", "successful"]
        lines += ["## Real lenses", "", *table(header, rows), "", machine_line(results["real"]["machine"])]
        lines += [""]
    if "time" in results:
        rows = [
            [
                frames,
                f"{r['first']:.1f}",
                f"{r['second']:.1f}",
                f"{r['GB']:.1f}",
                f"{100 * r['f']:.3f}",
                f"{r['lens']:.3f}",
            ]
            for frames, r in results["time"]["rows"].items()
        ]
        header = ["frames", "first fit, s", "second, s", "GB", "f, %", "lens, px"]
        lines += ["## Time", "", *table(header, rows), "", machine_line(results["time"]["machine"]), ""]
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    names = ("simulated", "real", "time")
    parser.add_argument("--sections", nargs="+", choices=names, default=list(names))
    parser.add_argument("--only", default="", help="rows whose names have this text")
    parser.add_argument("--clips", type=int, default=20, help="of each kind")
    parser.add_argument("--data", type=Path, default=os.environ.get("ZOOMJAX_DATA"), help="shared data")
    parser.add_argument("--output", type=Path, default=FOLDER / "motion.md")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    stored = options.output.with_suffix(".json")
    results = json.loads(stored.read_text()) if stored.exists() else {}
    for name in options.sections:
        if name == "real" and options.data is None:
            parser.error("--data or ZOOMJAX_DATA must name the folder of the shared data")
        rows = {
            "simulated": lambda: simulated(options.clips, options.only),
            "real": lambda: real(options.data, options.only),
            "time": lambda: timed(options.only),
        }[name]()
        if not options.only:
            results.pop(name, None)
        section = results.setdefault(name, {"rows": {}})
        section["machine"] = machine()
        for key, row in rows:
            section["rows"][key] = row
            print(key, {k: v for k, v in row.items() if k != "found"}, flush=True)
            write(options.output, page(results), results, quiet=True)
    print(page(results))


if __name__ == "__main__":
    main()
