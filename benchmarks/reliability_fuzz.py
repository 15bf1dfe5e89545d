"""Damaged files of every kind that zoomjax reads: how many are read wrongly, lost, crash it or hang it.

    python -m benchmarks.reliability_fuzz --count 100000

Files are made from sound ones by a seeded generator (`mutations`), and each is given to the
reader of its kind, in another process: decoders are C code. "wrong" is an object that is not sound (a lens
with NaN), an error that does not name the file, or ten warnings; "lost" is a sound file that is not read;
"crashed" is any other exception, or a process that died; "hung" took a minute. That a changed number in a
file is another number cannot be told.
"""

import argparse
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from .mutations import READERS, Outcomes, damaged


def run(count: int = 1000, seed: int = 0, readers: list[str] | None = None) -> dict[str, dict]:
    """For each reader: tried, wrong, lost, crashed, hung; read and refused; the first examples; seconds."""
    with Outcomes(os.cpu_count() or 1) as outcomes:
        return {
            name: _one(outcomes, name, round(READERS[name].share * count), seed)
            for name in READERS
            if readers is None or name in readers
        }


def _one(outcomes: Outcomes, name: str, count: int, seed: int) -> dict:
    rng, start = np.random.default_rng(seed), time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        corpus = READERS[name].corpus(Path(folder))

    def files() -> Iterator[bytes]:
        for _ in range(count):
            yield damaged(corpus[rng.integers(len(corpus))], rng, corpus[rng.integers(len(corpus))])

    result: dict = {"tried": 0, "wrong": 0, "lost": 0, "crashed": 0, "hung": 0, "read": 0, "refused": 0}
    result["lost"] = sum(text != "read" for _, text in outcomes.of(name, corpus))
    examples: list[str] = []
    for content, text in outcomes.of(name, files()):
        result["tried"] += 1
        result[text.partition(":")[0]] += 1
        if text not in ("read", "refused") and len(examples) < 5:
            examples.append(f"{text[:300]}: {content[:60]!r}")
    return result | {"examples": examples, "seconds": round(time.perf_counter() - start, 1)}


def main() -> None:
    parser = argparse.ArgumentParser(description="Damaged files, read.")
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--reader", action="append", choices=list(READERS))
    arguments = parser.parse_args()
    for name, row in run(arguments.count, arguments.seed, arguments.reader).items():
        print(name, {key: value for key, value in row.items() if key != "examples"})
        for example in row["examples"]:
            print("   ", example)


if __name__ == "__main__":
    main()
