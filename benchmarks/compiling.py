"""What is compiled: programs and seconds of each function, for a first data set and for one of other sizes.

    python -m benchmarks.compiling [--against CHECKOUT] [--output FILE]

Each process starts from nothing. The last one starts with what another left in the cache on disk. With
--against, another checkout of zoomjax is measured in the same run. Results go to
benchmarks/results/compiling.md and compiling.json.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from .shared import RESULTS, machine, machine_line, table, write

SIZES = ((12, 20, 40), (17, 26, 33))
"""Frames, lines a frame, and points a line, of the two data sets."""


def _lines(frames: int, lines: int, points: int):
    """Lines that a Nikkor 18-200 bends."""
    import numpy as np

    import zoomjax as zj
    from zoomjax import scenes

    rng, lens, focal = np.random.default_rng(frames), scenes.nikkor_18_200(), scenes.focal_sweep(frames)
    ends = rng.uniform(0, lens.image_size, (frames, lines, 2, 2))
    along = np.linspace(0, 1, points)[:, None]
    straight = ends[:, :, :1] + along * (ends[:, :, 1:] - ends[:, :, :1])
    bent = np.stack([np.asarray(lens(f).distort(one)) for f, one in zip(focal, straight, strict=True)])
    bent = np.clip(bent + 0.2 * rng.standard_normal(bent.shape), 0, np.array(lens.image_size) - 1)
    frame = np.repeat(np.arange(frames), lines)
    return zj.Lines.from_ragged(list(bent.reshape(-1, points, 2)), frame, focal, image_size=lens.image_size)


def _steps(sizes: tuple[int, int, int]) -> dict[str, Callable[[], object]]:
    """What a calibration does, in its order; a step uses what those before it gave."""
    import numpy as np

    import zoomjax as zj
    from zoomjax.fit import fit_centre, with_focal_sigma
    from zoomjax.lines import compress_any_centre
    from zoomjax.trust import assess, cross_validate_zoom, suggest_next, with_misfit

    lines, got = _lines(*sizes), {}

    def kept(name: str, function: Callable[[], object]) -> Callable[[], object]:
        return lambda: got.setdefault(name, function())

    return {
        "compress": kept("small", lambda: zj.compress(lines)),
        "fit_zoom": kept("fit", lambda: zj.fit_zoom(got["small"])),
        "fit_frames": lambda: zj.fit_frames(got["small"]),
        "fit_robust": lambda: zj.fit_robust(got["small"]),
        "compress_any_centre": kept("held", lambda: compress_any_centre(lines)),
        "fit_centre": lambda: fit_centre(got["held"]),
        "select_model": lambda: zj.select_model(got["small"]),
        "cross_validate_zoom": lambda: cross_validate_zoom(got["small"]),
        "with_misfit": lambda: with_misfit(got["fit"], got["small"]),
        "with_focal_sigma": lambda: with_focal_sigma(got["fit"], got["small"], focal_sigma=0.3),
        "assess": lambda: assess(lines, got["fit"]),
        "suggest_next": lambda: suggest_next(got["fit"], got["small"]),
        "displacement_std": lambda: zj.displacement_std(got["fit"], np.zeros((9, 2)), focal=30.0),
    }


def _measure() -> dict:
    """Programs, seconds in all, and seconds of the compiler, of each step and data set, in this process."""
    import jax

    import zoomjax as zj

    jax.config.update("jax_enable_x64", True)
    if folder := os.environ.get("ZOOMJAX_BENCH_CACHE"):
        zj.cache_compiled(folder)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    seconds: list[float] = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, duration_secs, **_: (
            seconds.append(duration_secs) if "backend_compile" in event else None
        )
    )
    found = {}
    for name, sizes in zip(("first", "other"), SIZES, strict=True):
        for step, function in _steps(sizes).items():
            seconds.clear()
            begin, processor = time.perf_counter(), time.process_time()
            jax.block_until_ready(jax.tree.leaves(function()))
            row = {
                "programs": len(seconds),
                "compiler": sum(seconds),
                "seconds": time.perf_counter() - begin,
                "processor": time.process_time() - processor,
            }
            found.setdefault(step, {})[name] = row
    return found


def _solver_alone() -> dict:
    """Seconds of a Levenberg-Marquardt on the residuals of `fit_zoom`, in a process that did nothing else.

    Without a start, a covariance, a certificate and a status, from no distortion, under ``jax.jit``.
    """
    import equinox as eqx
    import jax
    import numpy as np
    import optimistix as optx

    import zoomjax as zj
    from zoomjax.fit import residuals

    jax.config.update("jax_enable_x64", True)
    small = zj.compress(_lines(*SIZES[0]))
    zoom = zj.PolynomialZoom(degree=2).prepare(np.asarray(small.focal), 2)

    def function(parameters, lines):
        model = eqx.tree_at(lambda of: of.parameters, zoom, parameters)
        return residuals(lines, jax.vmap(model)(lines.focal))

    @eqx.filter_jit
    def solved(lines):
        solver = optx.LevenbergMarquardt(rtol=1e-9, atol=1e-9)
        return optx.least_squares(function, solver, zoom.parameters, args=lines).value

    begin, processor = time.perf_counter(), time.process_time()
    jax.block_until_ready(solved(small))
    return {"seconds": time.perf_counter() - begin, "processor": time.process_time() - processor}


def _in_a_process(source: Path | None, cache: str, what: str = "_measure") -> dict:
    """The measurement in a process of its own, of this or another checkout."""
    own = {**os.environ, "ZOOMJAX_BENCH_CACHE": cache}
    if source is not None:
        own["PYTHONPATH"] = str(source / "src")
    script = f"import json; from benchmarks.compiling import {what}; print(json.dumps({what}()))"
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", script], env=own, capture_output=True, text=True
    )
    if done.returncode:
        raise SystemExit(done.stderr)
    return json.loads(done.stdout.splitlines()[-1])


def _cell(row: dict) -> str:
    return f"{row['programs']} / {row['processor']:.2f}"


def page(results: dict) -> str:
    """The page of results."""
    runs = {name: results[name] for name in ("before", "now", "kept") if name in results}
    heads = {
        "before": ("before", "before, other sizes"),
        "now": ("now", "now, other sizes"),
        "kept": ("now, with what an earlier process kept",),
    }
    columns = [(run, part) for run in runs for part in ("first", "other")[: len(heads[run])]]
    steps = list(results["now"])
    rows = [[f"`{step}`", *(_cell(runs[run][step][part]) for run, part in columns)] for step in steps]
    sums = {
        column: {
            key: sum(runs[column[0]][step][column[1]][key] for step in steps)
            for key in ("programs", "seconds", "processor")
        }
        for column in columns
    }
    rows.append(["all", *(_cell(sums[column]) for column in columns)])
    first, other = SIZES
    alone, asked = results["alone"], ("fit_zoom", "fit_frames", "fit_robust")
    clock = ", ".join(f"`{step}` {results['now'][step]['first']['seconds']:.2f} s" for step in asked)
    return "\n".join(
        [
            "# What is compiled",
            "",
            "Made by `python -m benchmarks.compiling`, which says what is measured.",
            "",
            f"A process fits {first[0]} frames of {first[1]} lines of {first[2]} points, and then, as "
            f"*other sizes*, {other[0]} frames of {other[1]} lines of {other[2]} points. Programs "
            "compiled or read from the cache, and seconds of processor time in all, of which the "
            "computation itself takes milliseconds. The one is padded to 256 lines and the other to 1024: "
            "both sizes are compiled, and other data sets between them then compile nothing.",
            "",
            *table(["function", *(head for run in runs for head in heads[run])], rows),
            "",
            f"By the clock, the first time: {clock}. A Levenberg-Marquardt of optimistix alone, on the "
            "residuals of `fit_zoom` and under `jax.jit`, without a start, a covariance, a certificate and "
            f"a status: {alone['seconds']:.2f} s, {alone['processor']:.2f} s of the processor.",
            "",
            machine_line(results["machine"]),
            "",
        ]
    )


def main() -> None:
    """Measure, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--against", type=Path, help="another checkout of zoomjax")
    parser.add_argument(
        "--output", type=Path, default=RESULTS / "compiling.md", help="default: %(default)s"
    )
    options = parser.parse_args()
    results: dict = {"machine": machine()}
    if options.against is not None:
        results["before"] = _in_a_process(options.against.resolve(), "")
    results["now"] = _in_a_process(None, "")
    results["alone"] = _in_a_process(None, "", "_solver_alone")
    with tempfile.TemporaryDirectory() as cache:
        _in_a_process(None, cache)
        results["kept"] = _in_a_process(None, cache)
    write(options.output, page(results), results)


if __name__ == "__main__":
    main()
