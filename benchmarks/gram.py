"""What a bare Gram product of the columns costs beside compression, and what it loses.

    python -m benchmarks.gram [--lines N] [--output FILE]

Compression could add up the products of its seven columns (1, z, r²z, r⁴z) and factor the sum, or add up
the 22 monomials behind it. Both are timed without any factorisation, in as many threads as there are cores,
as compression works; in turns with compression and with one pass over the points' memory (the sum of
squares). So are the products of the 21 columns that are exact for any centre, beside `compress_any_centre`.
The loss is the RMS that a straight line is given at no distortion, where it is zero: the largest
of 300 lines, 640 x 480 px. Results go to benchmarks/results/gram.md and gram.json.
"""

import argparse
import os
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import zoomjax as zj
from zoomjax.lines import compress_any_centre

from .shared import RESULTS, machine, machine_line, table, write

POINTS = 3427
"""A line: with 2,986 lines, the points of benchmarks/fit.py."""
SIZE = (640, 480)
TURNS = 9


def columns(points):
    """The seven columns of one line, (7, point)."""
    z = points.T
    t = jnp.sum(z * z, axis=0)
    return jnp.concatenate([jnp.ones((1, t.shape[0]), t.dtype), z, t * z, t * t * z])


def gram(points):
    """The Gram matrix of the columns of one line."""
    a = columns(points)
    return a @ a.T


def any_gram(points):
    """The Gram matrix of the monomials up to degree 5: of two coefficients, about any centre."""
    x, y = points.T[:, None]
    degree = [jnp.ones_like(x)]
    for _ in range(5):
        degree.append(jnp.concatenate([x * degree[-1], y * degree[-1][-1:]]))
    a = jnp.concatenate(degree)
    return a @ a.T


def monomials(points):
    """The 22 sums that make up the Gram matrix: the count is known."""
    x, y = points.T
    t = x * x + y * y
    powers = [jnp.ones_like(t)]
    for _ in range(4):
        powers.append(powers[-1] * t)
    second = [jnp.sum(a * p) for p in powers for a in (x * x, x * y, y * y)]
    first = [jnp.sum(a * p) for p in powers[:3] for a in (x, y)]
    return jnp.stack([*second, *first])


def threaded(one: Callable, side_by_side: int | None = None) -> Callable:
    """A function of all lines, each core working through a share of them, one or a few at a time."""
    mapped = jax.jit(lambda points: jax.lax.map(one, points, batch_size=side_by_side))
    cores = os.cpu_count() or 1

    def all_lines(points):
        shares = np.array_split(np.arange(len(points)), cores)
        with ThreadPoolExecutor(cores) as pool:
            parts = pool.map(
                lambda share: jax.block_until_ready(mapped(points[share[0] : share[-1] + 1])), shares
            )
            return list(parts)

    return all_lines


def in_turns(functions: dict[str, Callable[[], object]]) -> dict[str, float]:
    """Median seconds of each."""
    times: dict[str, list[float]] = {name: [] for name in functions}
    for turn in range(TURNS + 1):
        for name, function in functions.items():
            start = time.perf_counter()
            jax.block_until_ready(function())
            if turn:  # the first compiles
                times[name].append(time.perf_counter() - start)
    return {name: statistics.median(t) for name, t in times.items()}


def straight_lines(dtype) -> np.ndarray:
    """Points on straight lines, (line, point, 2) px."""
    rng = np.random.default_rng(0)
    start, end = rng.uniform((0, 0), SIZE, (2, 300, 1, 2))
    return (start + np.linspace(0, 1, 400)[:, None] * (end - start)).astype(dtype)


def losses(dtype) -> dict[str, float]:
    """The largest RMS, px, of straight lines at no distortion, by way of both."""
    points = straight_lines(dtype)
    lines = zj.Lines.from_ragged(list(points), np.arange(300), np.full(300, 50.0), image_size=SIZE)
    scale = np.hypot(*SIZE) / 2
    z = ((points - (np.array(SIZE) - 1) / 2) / scale).astype(dtype)
    grams = np.asarray(jax.vmap(gram)(jnp.asarray(z)))
    mean = grams[:, 0, 1:3] / grams[:, :1, 0]
    scatter = grams[:, 1:3, 1:3] / grams[:, :1, :1] - mean[:, :, None] * mean[:, None]
    by_gram = np.sqrt(np.abs(np.linalg.eigvalsh(scatter)[:, 0])) * scale
    ours = np.asarray(zj.frame_rms(zj.compress(lines), None))
    return {"gram": float(by_gram.max()), "compress": float(ours.max())}


def run(number: int) -> dict:
    """All figures."""
    key = jax.random.key(0)
    points = jax.random.uniform(key, (number, POINTS, 2), minval=-0.7, maxval=0.7, dtype=jnp.float64)
    image = jnp.asarray(points * np.hypot(*SIZE) / 2)
    frame = np.zeros(number, int)
    lines = zj.Lines(
        points=image,
        mask=jnp.ones(image.shape[:2], bool),
        frame=frame,
        focal=np.array([50.0]),
        centre=np.zeros(2),
        image_size=SIZE,
        focal_unit="mm",
    )
    one_pass = jax.jit(lambda points: jnp.sum(points * points))
    by_gram, by_sums, by_any = threaded(gram), threaded(monomials, 2), threaded(any_gram)
    seconds = in_turns(
        {
            "pass": lambda: one_pass(points),
            "gram": lambda: by_gram(points),
            "monomials": lambda: by_sums(points),
            "compress": lambda: zj.compress(lines).triangle,
            "any_gram": lambda: by_any(points),
            "any_centre": lambda: compress_any_centre(lines).triangle,
        }
    )
    passes = {name: t / seconds["pass"] for name, t in seconds.items()}
    floors = {dtype: losses(dtype) for dtype in ("float64", "float32")}
    load = os.getloadavg()[0]
    return {
        "machine": machine(),
        "load": load,
        "lines": number,
        "points": number * POINTS,
        "seconds": seconds,
        "passes": passes,
        "straight line, px": floors,
    }


def page(r: dict) -> str:
    """The results as a page."""
    names = {
        "pass": "one pass over memory (sum of squares)",
        "gram": "columns and their Gram product, no factorisation",
        "monomials": "sums of the 22 monomials, no factorisation",
        "compress": "`compress`",
        "any_gram": "the 21 columns for any centre and their Gram product, no factorisation",
        "any_centre": "`compress_any_centre`",
    }
    times = [
        [name, f"{r['seconds'][key] * 1e3:.0f} ms", f"{r['passes'][key]:.1f}"]
        for key, name in names.items()
    ]
    floors = [
        [dtype, *(f"{loss[key]:.1e} px" for key in ("gram", "compress"))]
        for dtype, loss in r["straight line, px"].items()
    ]
    return "\n".join(
        [
            "# A Gram product instead of compression",
            "",
            f"`python -m benchmarks.gram`: {r['points']:,} points on {r['lines']:,} lines, float64, in "
            f"turns; medians of {TURNS}. Load average {r['load']:.1f}.",
            "",
            *table(["", "time", "memory passes"], times),
            "",
            "## What a straight line is given",
            "",
            "RMS at no distortion, where it is zero: the largest of 300 lines of 400 points, 640 × 480 px.",
            "",
            *table(["", "by the Gram matrix", "by `compress`"], floors),
            "",
            machine_line(r["machine"]),
            "",
        ]
    )


def main() -> None:
    """Measure, print, and write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--lines", type=int, default=2986)
    parser.add_argument("--output", type=Path, default=RESULTS / "gram.md")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    results = run(options.lines)
    write(options.output, page(results), results)


if __name__ == "__main__":
    main()
