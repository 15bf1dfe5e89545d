"""Never silently wrong, nothing lost: inputs tried, and how many were wrong, lost, crashed or hung.

    python -m benchmarks.reliability [--sections NAME ...] [--count SECTION=N ...] [--seed N] [--output F]

One table a section, a row a search. "Wrong" is an answer that is not right and says nothing of it; "lost"
what a user had and has no more; "crashed" an error from inside instead of a sentence, or a process that
died; "hung" one that did not end in its time. All must be 0. Refusals are right answers. float64.

Sections: `inverse` (round trips of all distortion models), `certificates`, `compression` and `fits`
(directed and random searches, reliability_core.py), `fuzz` (mutated files for every reader), `interruption`
(signals, full disks, two processes) and `memory` (resident memory and file handles over long runs). Results
go to benchmarks/results/reliability.md and reliability.json; sections that are not run again are kept.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

import jax

from .shared import RESULTS, machine, machine_line, table, write

COLUMNS = ("tried", "wrong", "lost", "crashed", "hung")

Rows = dict[str, dict]


def inverse(count: int, seed: int) -> Rows:
    from .reliability_inverse import inverse_round_trips

    return _rows("round trips", inverse_round_trips(count, seed))


def certificates(count: int, seed: int) -> Rows:
    from . import reliability_core

    return {"zoom polynomials next to a fold": reliability_core.certificates(count, seed)}


def compression(count: int, seed: int) -> Rows:
    from . import reliability_core

    return {"lines of all kinds": reliability_core.compression(count, seed)}


def fits(count: int, seed: int) -> Rows:
    from . import reliability_core

    return {"scenes of all kinds": reliability_core.fits(count, seed)}


def fuzz(count: int, seed: int) -> Rows:
    from . import reliability_fuzz

    return _rows("files", reliability_fuzz.run(count, seed))


def interruption(count: int, seed: int) -> Rows:
    from . import reliability_interrupt

    return _rows("interrupted commands", reliability_interrupt.run(count, seed))


def memory(count: int, seed: int) -> Rows:
    from . import reliability_memory

    del count, seed
    return _rows("long runs", reliability_memory.run())


SECTIONS: dict[str, tuple[Callable[[int, int], Rows], int]] = {
    "inverse": (inverse, 10_000_000),
    "certificates": (certificates, 100_000),
    "compression": (compression, 20_000),
    "fits": (fits, 600),
    "fuzz": (fuzz, 100_000),
    "interruption": (interruption, 200),
    "memory": (memory, 1),
}
"""What runs each section, and how many inputs by default (`fuzz`: for each reader)."""


def _rows(name: str, found: dict) -> Rows:
    """What a search returned, a row each: it may be one row, or rows by name."""
    nested = bool(found) and all(isinstance(value, dict) for value in found.values())
    return found if nested else {name: found}


def page(results: dict) -> str:
    """The page that the results make."""
    lines = [
        "# Reliability",
        "",
        "Inputs tried by `benchmarks/reliability.py`, and how many gave a wrong answer without a word, "
        "lost what a user had, crashed, or did not end. docs/reliability.md says what is promised and how "
        "it is tested.",
        "",
    ]
    for name, section in results.items():
        rows = [
            [row, *(f"{counts.get(column, 0):,}" for column in COLUMNS)]
            for row, counts in section["rows"].items()
        ]
        lines += [f"## {name.capitalize()}", "", *table(["", *COLUMNS], rows), ""]
        for row, counts in section["rows"].items():
            others = [
                f"{key} {value}" for key, value in counts.items() if key not in COLUMNS and value != []
            ]
            if others:
                lines += [f"{row.capitalize()}: {', '.join(others)}.", ""]
        lines += [
            f"Seed {section['seed']}, {section['seconds']:.0f} s. {machine_line(section['machine'])}",
            "",
        ]
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sections", nargs="+", choices=SECTIONS, default=list(SECTIONS))
    parser.add_argument("--count", nargs="+", default=[], metavar="SECTION=N", help="inputs to try")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=RESULTS / "reliability.md")
    options = parser.parse_args()
    counts = {name: count for name, (_, count) in SECTIONS.items()}
    for given in options.count:
        name, _, number = given.partition("=")
        if name not in SECTIONS or not number.isdigit():
            parser.error(f"--count must be such as fits=1000, a section and a number, but it is {given!r}")
        counts[name] = int(number)
    jax.config.update("jax_enable_x64", True)
    stored = options.output.with_suffix(".json")
    results = json.loads(stored.read_text()) if stored.exists() else {}
    for name in options.sections:
        begin = time.perf_counter()
        rows = SECTIONS[name][0](counts[name], options.seed)
        results[name] = {
            "rows": rows,
            "count": counts[name],
            "seed": options.seed,
            "seconds": time.perf_counter() - begin,
            "machine": machine(),
        }
        results = {name: results[name] for name in SECTIONS if name in results}
        write(options.output, page(results), results)  # after each, as they take hours
    bad = sum(
        counts.get(column, 0)
        for section in results.values()
        for counts in section["rows"].values()
        for column in COLUMNS[1:]
    )
    raise SystemExit(1 if bad else 0)


if __name__ == "__main__":
    main()
