"""How fast lines become a lens: compression, both fits, and what they are measured against.

    python -m benchmarks.fit [--spacing PX] [--output FILE]

Scene: the paper's board through its published lens, 50 focal lengths, edge points every `spacing` px (1
gives about 10 million points), noise 0.5 px, float64. Everything in one process, alternating where two
things are compared; seconds are medians, lower is better. Accuracy stands beside time: the largest error of
the fitted displacement at the image's corner, px. Results go to benchmarks/results/fit.md and fit.json.
"""

import argparse
import ctypes
import json
import platform
import statistics
import threading
import time
from collections.abc import Callable
from functools import reduce
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import psutil
import scipy.optimize

import zoomjax as zj
from zoomjax import scenes

from .shared import RESULTS, machine, write


def seconds(function: Callable, *arguments, repeats: int = 7) -> float:
    """Median time of a call after a first one that compiles."""
    jax.block_until_ready(function(*arguments))
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def once(function: Callable, *arguments):
    """Result and time of a single call, compilation included."""
    start = time.perf_counter()
    result = jax.block_until_ready(function(*arguments))
    return result, time.perf_counter() - start


@jax.jit
def memory_pass(points):
    """The least that anything can do which reads the points: their sum of squares."""
    return jnp.sum(points * points)


def corner_error(zoom, truth: zj.ZoomLens) -> float:
    """Largest error of the displacement at a corner over the focal range, px."""
    focal = jnp.asarray(scenes.focal_sweep())
    radius = jnp.hypot(*truth.centre) / truth.scale
    powers = radius ** jnp.asarray([3, 5])
    difference = jax.vmap(zoom)(focal) - jax.vmap(truth.zoom)(focal)
    return float(jnp.max(jnp.abs(difference @ powers)) * truth.scale)


def scipy_fit(lines: zj.Lines, focal_ref: float):
    """The same residuals in NumPy, minimised by MINPACK through SciPy, from zero."""
    scale = lines.scale
    mask = np.asarray(lines.mask)
    z = np.where(mask[..., None], (np.asarray(lines.points) - np.asarray(lines.centre)) / scale, 0)
    squared = np.einsum("lpc,lpc->lp", z, z)
    frame, count = np.asarray(lines.frame), mask.sum(1)
    per_frame = np.bincount(frame)
    weight = scale * np.sqrt(1 / (per_frame.size * per_frame[frame] * count))
    basis = (focal_ref / np.asarray(lines.focal)[frame])[:, None] ** np.arange(3)

    def residuals(parameters):
        k = basis @ parameters.reshape(3, 2)
        corrected = z * (1 + squared * (k[:, :1] + squared * k[:, 1:]))[..., None]
        mean = corrected.sum(1) / count[:, None]
        corrected -= np.where(mask[..., None], mean[:, None], 0)
        x, y = corrected[..., 0], corrected[..., 1]
        xx, xy, yy = (np.einsum("lp,lp->l", a, b) for a, b in ((x, x), (x, y), (y, y)))
        angle = np.arctan2(2 * xy, xx - yy) / 2
        distance = -np.sin(angle)[:, None] * x + np.cos(angle)[:, None] * y
        return (weight[:, None] * distance)[mask]

    return scipy.optimize.least_squares(residuals, np.zeros(6), method="lm", xtol=1e-10, ftol=1e-10)


def release_freed_memory() -> None:
    """Give memory that has been freed back to the system, where glibc keeps it and would hide a peak."""
    if platform.libc_ver()[0] == "glibc":
        ctypes.CDLL(None).malloc_trim(0)


class PeakMemory:
    """The most memory the process held during a block, sampled, less what it held before `baseline`."""

    def __init__(self, baseline: int):
        self.baseline, self.peak, self.done = baseline, 0, threading.Event()

    def __enter__(self):
        def watch():
            process = psutil.Process()
            while not self.done.wait(0.001):
                self.peak = max(self.peak, process.memory_info().rss - self.baseline)

        self.thread = threading.Thread(target=watch)
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.done.set()
        self.thread.join()


def growth(truth: zj.ZoomLens, base: zj.Lines) -> list[dict]:
    """Time against the number of points: three scenes, and ten chunks of the base merged one by one."""
    rows = []
    for spacing in (100.0, 10.0):
        lines = scenes.board_lines(truth, scenes.focal_sweep(), spacing=spacing, noise=0.5)
        rows.append(growth_row(lines))
    rows.append(growth_row(base))

    rng = np.random.default_rng(1)
    zj.lines.merge(*[zj.compress(base)] * 2)
    spent = 0.0

    def chunks():
        nonlocal spent
        for _ in range(10):
            noise = 0.1 * rng.standard_normal(base.points.shape)
            points = jax.block_until_ready(base.points + noise)
            chunk = eqx.tree_at(lambda lines: lines.points, base, points)
            start = time.perf_counter()
            small = jax.block_until_ready(zj.compress(chunk))
            spent += time.perf_counter() - start
            del chunk, points, noise
            yield small

    with PeakMemory(psutil.Process().memory_info().rss) as memory:
        merged, total = once(lambda: reduce(zj.lines.merge, chunks()))
    points = float(jnp.sum(merged.counts))
    rows.append(
        {"points": points, "compress": spent, "fit": seconds(zj.fit_zoom, merged), "extra": memory.peak}
    )
    print(
        f"  streamed: {total:.1f} s with the making of the chunks, extra memory {memory.peak / 1e6:.0f} MB"
    )
    return rows


def growth_row(lines: zj.Lines) -> dict:
    small = zj.compress(lines)
    return {
        "points": float(jnp.sum(lines.mask)),
        "compress": seconds(zj.compress, lines),
        "fit": seconds(zj.fit_zoom, small),
    }


def run(spacing: float) -> dict:
    """All measurements."""
    truth = scenes.nikkor_18_200()
    process = psutil.Process()
    tiny = scenes.board_lines(truth, scenes.focal_sweep(4), spacing=400, noise=0.5)
    jax.block_until_ready(zj.compress(tiny).triangle)  # JAX itself is in the baseline
    before = process.memory_info().rss
    made, making = once(lambda: scenes.board_lines(truth, scenes.focal_sweep(), spacing=spacing, noise=0.5))
    points = int(jnp.sum(made.mask))
    tensor = made.points.nbytes
    print(f"{points:,} points on {len(made.frame):,} lines, {tensor / 1e6:.0f} MB, made in {making:.0f} s")

    results: dict = {"points": points, "lines": len(made.frame), "tensor_MB": tensor / 1e6}
    small, results["compress_first"] = once(zj.compress, made)
    fit, results["fit_first"] = once(zj.fit_zoom, small)
    each, results["frames_first"] = once(zj.fit_frames, small)
    release_freed_memory()
    held = process.memory_info().rss - before
    with PeakMemory(before) as memory:
        jax.block_until_ready(zj.fit_zoom(zj.compress(made)))
    results["peak_over_tensor"] = (memory.peak - held + tensor) / tensor
    results["compile_fit"] = results["fit_first"] - seconds(zj.fit_zoom, small)

    passes, compressions = [], []
    for _ in range(5):
        passes.append(seconds(memory_pass, made.points))
        compressions.append(seconds(zj.compress, made, repeats=3))
    results["memory_pass"], results["compress"] = (statistics.median(t) for t in (passes, compressions))
    results["compress_over_pass"] = statistics.median(
        c / p for c, p in zip(compressions, passes, strict=True)
    )
    results["fit"] = seconds(zj.fit_zoom, small, repeats=21)
    results["frames"] = seconds(zj.fit_frames, small, repeats=21)
    results["algebraic"] = seconds(zj.fit.algebraic_zoom, small, repeats=21)
    results["certificate"] = seconds(zj.models.certify, fit.lens, repeats=21)
    results["rms"] = {"zoom": float(fit.rms), "frames": float(each.rms)}
    results["corner_error"] = corner_error(fit.lens.zoom, truth)
    print(json.dumps(results, indent=1))

    results["any_centre_first"] = once(zj.lines.compress_any_centre, made)[1]
    results["any_centre"] = seconds(zj.lines.compress_any_centre, made, repeats=3)
    any_centre = zj.lines.compress_any_centre(made)
    results["centre_fit"] = seconds(zj.fit.fit_centre, any_centre, repeats=5)
    results["robust_fit"] = seconds(zj.fit_robust, small, repeats=5)

    full = zj.fit_zoom(made)
    results["full_fit"] = seconds(zj.fit_zoom, made, repeats=1)
    results["full_difference"] = float(
        jnp.max(jnp.abs(full.lens.zoom.parameters - fit.lens.zoom.parameters))
    )
    single = jax.tree.map(lambda a: a.astype(jnp.float32) if a.dtype == jnp.float64 else a, made)
    results["float32"] = {
        "memory_pass": seconds(memory_pass, single.points),
        "compress": seconds(zj.compress, single, repeats=3),
        "fit": seconds(zj.fit_zoom, zj.compress(single)),
        "corner_error": corner_error(zj.fit_zoom(zj.compress(single)).lens.zoom, truth),
    }
    solution, results["scipy_fit"] = once(scipy_fit, made, float(fit.lens.zoom.focal_ref))
    results["scipy_difference"] = float(
        np.max(np.abs(solution.x.reshape(3, 2) - np.asarray(fit.lens.zoom.parameters)))
    )
    together = results["compress"] + results["fit"]
    results["scipy_over_ours"] = results["scipy_fit"] / together
    results["full_over_ours"] = results["full_fit"] / together
    results["growth"] = growth(truth, made)
    return results


def markdown(results: dict) -> str:
    """The results as a page."""
    r, m = results, results["machine"]
    rows = [
        ("one memory pass (sum of squares)", f"{r['memory_pass'] * 1e3:.1f} ms", ""),
        ("compression", f"{r['compress'] * 1e3:.0f} ms", f"{r['compress_over_pass']:.1f} memory passes"),
        ("zoom fit, compressed", f"{r['fit'] * 1e3:.1f} ms", f"corner error {r['corner_error']:.4f} px"),
        ("frame by frame, compressed", f"{r['frames'] * 1e3:.1f} ms", ""),
        ("algebraic estimate", f"{r['algebraic'] * 1e3:.1f} ms", ""),
        (
            "certificate of invertibility",
            f"{r['certificate'] * 1e3:.2f} ms",
            f"{100 * r['certificate'] / r['fit']:.1f} % of the zoom fit, which makes it",
        ),
        (
            "robust fit, compressed",
            f"{r['robust_fit'] * 1e3:.0f} ms",
            f"{r['robust_fit'] / r['fit']:.1f} times the zoom fit",
        ),
        (
            "compression for any centre",
            f"{r['any_centre'] * 1e3:.0f} ms",
            f"{r['any_centre'] / r['compress']:.1f} times that for one, "
            f"{r['any_centre_first']:.0f} s with compiling",
        ),
        (
            "zoom and centre fit after it",
            f"{r['centre_fit'] * 1e3:.0f} ms",
            "with its covariance and guard",
        ),
        (
            "zoom fit, full tensors",
            f"{r['full_fit']:.1f} s",
            f"{r['full_over_ours']:.0f} times ours; coefficients within {r['full_difference']:.0e}",
        ),
        (
            "scipy.optimize.least_squares",
            f"{r['scipy_fit']:.1f} s",
            f"{r['scipy_over_ours']:.0f} times ours; coefficients within {r['scipy_difference']:.0e}",
        ),
        ("compiling fit_zoom", f"{r['compile_fit']:.1f} s", "once for a shape"),
        ("peak memory", f"{r['peak_over_tensor']:.2f} tensors", f"tensor {r['tensor_MB']:.0f} MB"),
    ]
    single = r["float32"]
    rows += [
        ("float32: memory pass", f"{single['memory_pass'] * 1e3:.1f} ms", ""),
        ("float32: compression", f"{single['compress'] * 1e3:.0f} ms", ""),
        (
            "float32: zoom fit",
            f"{single['fit'] * 1e3:.1f} ms",
            f"corner error {single['corner_error']:.4f} px",
        ),
    ]
    lines = [
        "# Fitting",
        "",
        f"`python -m benchmarks.fit`: {r['points']:,} points on {r['lines']:,} lines in 50 frames (the "
        "paper's board through its published lens, noise 0.5 px), float64 unless stated.",
        "",
        f"{m['cpu']}, {m['cores']} cores, {m['memory_GB']} GB; Python {m['python']}, jax {m['jax']}, "
        f"optimistix {m['optimistix']}, numpy {m['numpy']}, scipy {m['scipy']}; on {m['device']}. Medians.",
        "",
        "| | time or size | |",
        "|---|---:|---|",
        *(f"| {a} | {b} | {c} |" for a, b, c in rows),
        "",
        "| points | compression | fit after it |",
        "|---:|---:|---:|",
        *(
            f"| {g['points']:,.0f} | {g['compress'] * 1e3:.0f} ms | {g['fit'] * 1e3:.0f} ms |"
            for g in r["growth"]
        ),
        "",
        "The last row is streamed: ten chunks, compressed one after the other and merged, in "
        f"{r['growth'][-1]['extra'] / 1e6:.0f} MB beside the chunk that is there from the start.",
        "",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--spacing", type=float, default=1.0, help="distance of the points on a line, px")
    parser.add_argument("--output", type=Path, default=RESULTS / "fit.md")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    measured = {"machine": machine(), **run(options.spacing)}
    write(options.output, markdown(measured), measured)
