"""Many lenses at once: `zoomjax.fit.many` and `zoomjax.trust.select_many` beside loops over what they
do for one, on zooms of the lensfun database.

    python -m benchmarks.many [--fit NAME] [--lenses N] [--output FILE]

Each zoom with five or more calibrated focal lengths becomes 25 straight lines a focal length, seen through
it and compressed (`benchmarks.real.lensfun.data`). All in one process, but for what is said to be *in
processes*, one for each core. Seconds are of the second call, as the first compiles; lower is better. The
largest difference between the two is over all numbers of all results, of a number's size or 1, whichever is
larger. With --fit one of the fits is measured, and the other's results are kept. Results go to
benchmarks/results/many.md and many.json.
"""

import argparse
import functools
import json
import multiprocessing
import os
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import equinox as eqx
import jax
import numpy as np

import zoomjax as zj
from zoomjax.fit import many
from zoomjax.trust import select_many

from .real.lensfun.data import LEVEL, UPRIGHT, make_lines, read_lenses
from .shared import RESULTS, machine, machine_line, table, write

Sets = list[zj.lines.CompressedLines]


def fits_of(selections: Iterable[zj.trust.Selection]) -> list[zj.ZoomFit]:
    """The fits of the models chosen: of selections what is compared here."""
    return [selection.fit for selection in selections]


@functools.cache
def processes() -> ProcessPoolExecutor:
    """One for each core; they stay until the end."""
    return ProcessPoolExecutor(os.cpu_count(), mp_context=multiprocessing.get_context("spawn"))


FITS: dict[str, tuple[Callable[[Sets], object], Callable[[Sets], object]]] = {
    "fit_zoom": (many, lambda sets: [zj.fit_zoom(lines, throw=False) for lines in sets]),
    "fit_robust": (
        lambda sets: many(sets, zj.fit_robust),
        lambda sets: [zj.fit_robust(lines, throw=False) for lines in sets],
    ),
    "select_model": (
        lambda sets: fits_of(select_many(sets)),
        lambda sets: fits_of(zj.select_model(lines) for lines in sets),
    ),
    "select_model, in processes": (
        lambda sets: fits_of(select_many(sets, executor=processes())),
        lambda sets: fits_of(zj.select_model(lines) for lines in sets),
    ),
}
"""What is done for all at once, and in a loop."""


def data_sets(most: int | None) -> list[zj.lines.CompressedLines]:
    """The lines of each lens, compressed."""
    lenses = read_lenses()[:most]
    whole = zj.compress(make_lines(lenses))
    triangle, focal, sets, begin = np.asarray(whole.triangle), np.asarray(whole.focal), [], 0
    for lens in lenses:
        frames = len(lens.frames)
        own = slice(begin, begin + frames)
        of_lines = slice(own.start * (UPRIGHT + LEVEL), own.stop * (UPRIGHT + LEVEL))
        arrays = triangle[of_lines], np.repeat(np.arange(frames), UPRIGHT + LEVEL), focal[own]
        where = eqx.tree_at(lambda lines: (lines.triangle, lines.frame, lines.focal), whole, arrays)
        sets.append(jax.device_put(where))
        begin += frames
    return sets


def timed(function: Callable[[], object]) -> tuple[object, dict]:
    """The result; seconds of the first and the second call, and of the processor in the second."""
    begin = time.perf_counter()
    jax.block_until_ready(function())
    between, processor = time.perf_counter(), time.process_time()
    result = jax.block_until_ready(function())
    return result, {
        "first": between - begin,
        "second": time.perf_counter() - between,
        "processor": time.process_time() - processor,
    }


def difference(some: object, others: object) -> float:
    """The largest difference between two results, relative to what is larger than 1."""
    leaves = ([np.asarray(leaf, float) for leaf in jax.tree.leaves(tree)] for tree in (some, others))
    apart = [np.abs(a - b) / np.maximum(1, np.abs(b)) for a, b in zip(*leaves, strict=True)]
    return float(max(np.max(of) for of in apart if of.size))


def run(most: int | None, names: Iterable[str], kept: dict) -> dict:
    """All measurements; those of fits that are not named are kept."""
    sets = data_sets(most)
    results: dict = {
        "lenses": len(sets),
        "frames": sum(len(lines.focal) for lines in sets),
        "lines": sum(len(lines.frame) for lines in sets),
        "largest": max(len(lines.frame) for lines in sets),
    }
    fits = {name: kept[name] for name in FITS if name in kept}
    for name in names:
        (together, in_turn), load = FITS[name], os.getloadavg()[0]
        at_once, own = timed(lambda of=together: of(sets))
        one_by_one, loop = timed(lambda of=in_turn: of(sets))
        apart = difference(at_once, one_by_one)
        fits[name] = {"many": own, "loop": loop, "difference": apart, "load": load}
    return results | {"fits": fits, "machine": machine()}


def page(results: dict) -> str:
    """The page of results."""

    load = max(row["load"] for row in results["fits"].values())
    rows = [
        [
            "`{}`{}{}".format(*name.partition(",")),
            f"{row['many']['second']:.2f} s",
            f"{row['loop']['second']:.2f} s",
            f"{1e3 * row['many']['processor'] / results['lenses']:.1f} ms",
            f"{1e3 * row['loop']['processor'] / results['lenses']:.1f} ms",
            f"{row['difference']:.0e}",
        ]
        for name, row in results["fits"].items()
    ]
    return "\n".join(
        [
            "# Many lenses at once",
            "",
            "Made by `python -m benchmarks.many`, which says what is measured.",
            "",
            f"{results['lenses']} zooms of the lensfun database, {results['frames']:,} focal lengths and "
            f"{results['lines']:,} lines in all, {results['largest']:,} of them of one lens. Seconds of "
            "the second call, as the first compiles; and in it the time of the processor for each lens, of "
            "this process alone. Rows are of different days, on some of which the machine was half as "
            "fast: compare with the loop of the same row.",
            "",
            *table(
                ["", "at once", "a loop", "at once, a lens", "a loop, a lens", "largest difference"],
                rows,
            ),
            "",
            "Each fit comes with its covariance and certificate. The machine's load average was "
            f"{load:.0f} when this began. Where that is more than it has cores, others shared "
            "them, and seconds are longer than they need be, and the time of the processor a little.",
            "",
            machine_line(results["machine"]),
            "",
        ]
    )


def main() -> None:
    """Measure, and write the page."""
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--lenses", type=int, help="only so many (default: all)")
    parser.add_argument("--output", type=Path, default=RESULTS / "many.md", help="default: %(default)s")
    parser.add_argument("--fit", choices=FITS, help="only this one (default: all)")
    options = parser.parse_args()
    stored = options.output.with_suffix(".json")
    kept = json.loads(stored.read_text())["fits"] if options.fit and stored.exists() else {}
    results = run(options.lenses, [options.fit] if options.fit else FITS, kept)
    write(options.output, page(results), results)


if __name__ == "__main__":
    main()
