"""What a GPU makes of it: compression against the memory's bandwidth, fits, points and images.

    python -m benchmarks.gpu [--spacing PX] [--points N N] [--output FILE]

Measured on JAX's default device, whatever that is. *Queued* calls are started one after the other, compiled
whole, without waiting for the one before: what the device itself takes. *Alone* is one call as users write
it, until its result is there. The bandwidth is that of copying a large array, bytes read and written
together; a floor is the time in which it passes what a function must read. Seconds are medians, lower is
better. Results go to benchmarks/results/gpu.md and gpu.json.
"""

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import zoomjax as zj
from zoomjax import scenes

from .correct import HD, PHOTO, differentiable
from .fit import corner_error, memory_pass, once, seconds
from .pipeline import RATIOS, functions, operands
from .shared import RESULTS, machine, machine_line, table, write

COPIED = 2**29
"""Numbers of four bytes: beyond any cache."""

COMPARED = 200
"""Lines whose triangles are compared with NumPy's."""

TURNS = 9
"""Through all functions of points."""

DTYPES = (np.float64, np.float32)


def queued(function: Callable, *arguments, calls: int = 20, rounds: int = 5) -> float:
    """Median time of a call among calls that do not wait for each other; a first one compiles."""
    jax.block_until_ready(function(*arguments))
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        jax.block_until_ready([function(*arguments) for _ in range(calls)][-1])
        times.append((time.perf_counter() - start) / calls)
    return statistics.median(times)


def bandwidth() -> float:
    """Bytes/s that a copy reads and writes."""
    array = jnp.arange(COPIED, dtype=jnp.float32)
    return 2 * array.nbytes / queued(jax.jit(lambda array: array + 1), array)


def gram(triangles: np.ndarray) -> np.ndarray:
    """``R^T R``, normalised to a unit diagonal."""
    products = np.einsum("lij,lik->ljk", triangles, triangles)
    size = np.sqrt(np.einsum("ljj->lj", products))
    return products / size[:, :, None] / size[:, None]


def by_householder(lines: zj.Lines) -> np.ndarray:
    """Triangles of the first lines by NumPy, in float64."""
    triangles = []
    for points, mask in zip(lines.points[:COMPARED], lines.mask[:COMPARED], strict=True):
        z = (np.asarray(points, float)[np.asarray(mask)] - np.asarray(lines.centre, float)) / lines.scale
        squared = np.sum(z * z, axis=1, keepdims=True)
        triangles.append(np.linalg.qr(np.hstack([squared**0, z, squared * z, squared**2 * z]), mode="r"))
    return np.stack(triangles)


def compression(lines: zj.Lines, truth: zj.ZoomLens, rate: float) -> dict:
    """Compression and the fits after it."""
    arrays, rest = eqx.partition(lines, eqx.is_array)
    triangle = jax.jit(lambda arrays: zj.compress(eqx.combine(arrays, rest)).triangle)
    every = jax.jit(lambda arrays: zj.lines.compress_any_centre(eqx.combine(arrays, rest)).triangle)
    small, first = once(zj.compress, lines)
    fit, fit_first = once(zj.fit_zoom, small)
    error = gram(np.asarray(small.triangle[:COMPARED], float)) - gram(by_householder(lines))
    result = {
        "MB": (lines.points.nbytes + lines.mask.nbytes) / 1e6,
        "memory_pass": queued(memory_pass, lines.points),
        "first": first,
        "alone": seconds(zj.compress, lines),
        "queued": queued(triangle, arrays),
        "any_centre": queued(every, arrays, calls=5),
        "error": float(np.max(np.abs(error))),
        "fit_first": fit_first,
        "fit": seconds(zj.fit_zoom, small, repeats=21),
        "frames": seconds(zj.fit_frames, small, repeats=21),
        "robust": seconds(zj.fit_robust, small),
        "corner_error": corner_error(fit.lens.zoom, truth),
    }
    result["floor"] = 1e6 * result["MB"] / rate
    result["fraction"] = result["floor"] / result["queued"]
    return result


def in_dtype(lines: zj.Lines, dtype: type) -> zj.Lines:
    return jax.tree.map(lambda a: a.astype(dtype) if jnp.issubdtype(a.dtype, jnp.floating) else a, lines)


def points_queued(dtype: type, number: int) -> dict[str, float]:
    """What is done with points, in turns."""
    compiled = functions(*operands(dtype, number))
    turns = [
        {name: queued(function, *arguments, rounds=1) for name, (function, arguments) in compiled.items()}
        for _ in range(TURNS)
    ]
    return {name: statistics.median(turn[name] for turn in turns) for name in compiled}


def run(spacing: float, numbers: Sequence[int]) -> dict:
    """All measurements."""
    rate = bandwidth()
    truth = scenes.nikkor_18_200()
    lines = scenes.board_lines(truth, scenes.focal_sweep(), spacing=spacing, noise=0.5)
    results: dict = {
        "machine": {**machine(), "device": jax.devices()[0].device_kind},
        "bandwidth": rate,
        "points": int(jnp.sum(lines.mask)),
        "lines": len(lines.frame),
        "compression": {},
        "pipeline": {},
    }
    for dtype in DTYPES:
        results["compression"][np.dtype(dtype).name] = compression(in_dtype(lines, dtype), truth, rate)
    for number in numbers:
        results["pipeline"][str(number)] = {
            np.dtype(dtype).name: points_queued(dtype, number) for dtype in DTYPES
        }
    results["images"] = {"1080p": differentiable(HD, 15), "12 MP": differentiable(PHOTO, 15)}
    return results


def page(r: dict) -> str:
    """The results as a page."""
    kinds = r["compression"]

    def row(name: str, text: Callable[[dict], str]) -> list[str]:
        return [name, *(text(kinds[kind]) for kind in kinds)]

    times = [
        row("points and mask", lambda c: f"{c['MB']:.0f} MB"),
        row("floor: one read at that bandwidth", lambda c: f"{1e3 * c['floor']:.3f} ms"),
        row("sum of squares of the points, queued", lambda c: f"{1e3 * c['memory_pass']:.3f} ms"),
        row("`compress`, queued", lambda c: f"{1e3 * c['queued']:.2f} ms"),
        row("the floor of it", lambda c: f"{100 * c['fraction']:.1f} %"),
        row("`compress`, alone", lambda c: f"{1e3 * c['alone']:.1f} ms"),
        row("`compress` with compiling", lambda c: f"{c['first']:.1f} s"),
        row("`compress_any_centre`, queued", lambda c: f"{1e3 * c['any_centre']:.1f} ms"),
        row("`fit_zoom`, compressed, alone", lambda c: f"{1e3 * c['fit']:.1f} ms"),
        row("`fit_zoom` with compiling", lambda c: f"{c['fit_first']:.1f} s"),
        row("`fit_frames`, compressed, alone", lambda c: f"{1e3 * c['frames']:.1f} ms"),
        row("`fit_robust`, compressed, alone", lambda c: f"{1e3 * c['robust']:.0f} ms"),
        row("largest error of RᵀR, of a unit diagonal", lambda c: f"{c['error']:.0e}"),
        row("corner error of the fit", lambda c: f"{c['corner_error']:.4f} px"),
    ]
    counts = list(r["pipeline"])
    columns = [(number, kind) for number in counts for kind in kinds]
    heads = [f"{int(number):,} points, {kind}" for number, kind in columns]
    names = r["pipeline"][counts[0]][next(iter(kinds))]
    points = [
        [name, *(f"{1e3 * r['pipeline'][number][kind][name]:.3f}" for number, kind in columns)]
        for name in names
    ]
    ratios = [
        [
            a,
            b,
            *(f"{r['pipeline'][n][kind][a] / r['pipeline'][n][kind][b]:.2f}" for n, kind in columns),
            "" if asked is None else f"{asked:g}",
        ]
        for a, b, asked in RATIOS
        if a in names and b in names
    ]
    sizes = r["images"]
    images = [
        [name, *(f"{sizes[size]['ms'][name]:.2f}" for size in sizes)] for name in sizes["1080p"]["ms"]
    ]
    return "\n".join(
        [
            "# On a GPU",
            "",
            machine_line(r["machine"]),
            "",
            f"`python -m benchmarks.gpu`. A copy moves {r['bandwidth'] / 1e12:.2f} TB/s, read and written. "
            "Queued: calls compiled whole, that do not wait for each other; alone: one call, until its "
            "result is there. Medians.",
            "",
            "## Compression and fits",
            "",
            f"{r['points']:,} points on {r['lines']:,} lines in 50 frames (the scene of fit.md).",
            "",
            *table(["", *kinds], times),
            "",
            "Compression is modified Gram-Schmidt on seven columns a line, written and read again for each "
            "column that is done. That is what it takes, and not the one read of the floor.",
            "",
            "## Points",
            "",
            "Ratios of queued times, as in pipeline.md.",
            "",
            *table(["time of", "over that of", *heads, "asked"], ratios),
            "",
            "Queued, ms:",
            "",
            *table(["", *heads], points),
            "",
            "Whether Newton's steps arrived everywhere is a branch of `distort`. That this is what it "
            "costs beyond plain Newton, as the host waits for the device, is a guess: it was not profiled.",
            "",
            "## Images",
            "",
            "Three channels, ms, alone; `remap` is OpenCV's on the CPU.",
            "",
            *table(["", *sizes], images),
            "",
        ]
    )


def main() -> None:
    """Measure, print, and write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--spacing", type=float, default=1.0, help="distance of the points on a line, px")
    parser.add_argument("--points", type=int, nargs="+", default=[524_288, 2**24])
    parser.add_argument("--output", type=Path, default=RESULTS / "gpu.md")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    results = run(options.spacing, options.points)
    write(options.output, page(results), results)


if __name__ == "__main__":
    main()
