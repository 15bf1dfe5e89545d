"""The command line from end to end: what a user waits for, and where the time goes.

    ZOOMJAX_DATA=FOLDER python -m benchmarks.end_to_end [--only NAME ...] [--repeats N] [--output FILE]

Three runs of `zoomjax`, each in a process of its own and with a cache of its own:

* demo: `zoomjax demo` where nothing was compiled before, as after installing.
* photos: twelve photos of 12 megapixels to `report.html`, after nine other photos.
* boards: the thirty 720p photos of a checkerboard by a zoom camera (real data), `--detector grid`, after
  twenty of them in other files; beside `cv2.findChessboardCornersSB` on the same photos, a process for each
  core.

Seconds are by the clock; runs and rival take turns, and medians are given. Stages are those that the
command line prints. Results go to benchmarks/results/end_to_end.md and end_to_end.json.
"""

import argparse
import concurrent.futures
import json
import multiprocessing
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2

from zoomjax.app.demo import write_photos

from .shared import RESULTS, machine, machine_line, real_data, table, write

ASKED = {"demo": 25.0, "photos": 12.0, "boards": 1.05}
"""Seconds at most; of the boards, times the rival's."""

_PATTERN = (22, 15)
_STAGE = re.compile(r"^ {2}([A-Z].*?)(?:: \d+ of \d+)? +(\d+\.\d\d) s$", re.MULTILINE)


def command(arguments: list, cache: Path) -> dict:
    """Seconds of one command in a process of its own, in all and of each stage, and of the processor."""
    own = {**os.environ, "ZOOMJAX_CACHE": str(cache)}
    own.pop("JAX_COMPILATION_CACHE_DIR", None)
    before = os.times()
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "zoomjax", *map(str, arguments)], env=own, capture_output=True, text=True
    )
    seconds, after = time.perf_counter() - start, os.times()
    if done.returncode:
        raise SystemExit(done.stderr)
    stages: dict[str, float] = {}
    for name, took in _STAGE.findall(done.stderr):
        stages[name] = float(took)  # which is printed again and again while a stage goes on
    used = after.children_user + after.children_system - before.children_user - before.children_system
    return {"seconds": seconds, "processor": used, "stages": stages}


def demo(folder: Path, _: Path | None) -> dict:
    """The first command of a new user."""
    return {"now": command(["demo", "-o", folder / "demo"], folder / "cache")}


def photos(folder: Path, _: Path | None) -> dict:
    """Twelve large photos, after nine others."""
    size = (4288, 2848)
    few = write_photos(folder / "first", number=9, image_size=size, seed=100)
    many = write_photos(folder / "second", number=12, image_size=size)
    first = command(["calibrate", *few, "-o", folder / "lens1"], folder / "cache")
    return {"first": first, "now": command(["calibrate", *many, "-o", folder / "lens2"], folder / "cache")}


def boards(folder: Path, data: Path | None) -> dict:
    """Thirty photos of a checkerboard, after twenty of them in other files."""
    assert data is not None
    given = sorted((data / "zoomcam").glob("zoom_*/*.png"))
    other = []
    for path in given[::3] + given[1::3]:
        image = cv2.imread(str(path))
        assert image is not None
        target = folder / "first" / path.parent.name / f"{path.stem}.jpg"
        target.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(target), image, [cv2.IMWRITE_JPEG_QUALITY, 95])
        other.append(target)
    options = ["--detector", "grid", "--focal", "plane", "--shared-focal", "folder"]
    first = command(["calibrate", *other, *options, "-o", folder / "lens1"], folder / "cache")
    fresh = multiprocessing.get_context("spawn")  # JAX's threads are in this process
    with concurrent.futures.ProcessPoolExecutor(os.cpu_count(), fresh) as pool:
        list(pool.map(_corners_found, map(str, given[:2])))  # the processes begin
        start = time.perf_counter()
        found = sum(pool.map(_corners_found, map(str, given)))
        rival = {"seconds": time.perf_counter() - start, "found": found}
    now = command(["calibrate", *given, *options, "-o", folder / "lens2"], folder / "cache")
    return {"first": first, "rival": rival, "now": now}


def _corners_found(path: str) -> bool:
    """Whether OpenCV finds the whole board, on one thread."""
    cv2.setNumThreads(1)
    grey = cv2.imread(path, cv2.IMREAD_GRAYSCALE)
    assert grey is not None
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    return bool(cv2.findChessboardCornersSB(grey, _PATTERN, flags=flags)[0])


RUNS: dict[str, Callable[[Path, Path | None], dict]] = {"demo": demo, "photos": photos, "boards": boards}


def median(runs: list[dict]) -> dict:
    """The median of each number in dictionaries of one form."""
    keys = dict.fromkeys(key for run in runs for key in run)
    found = {}
    for key in keys:
        values = [run[key] for run in runs if key in run]
        found[key] = median(values) if isinstance(values[0], dict) else statistics.median(values)
    return found


def ratio(name: str, result: dict) -> float:
    """What is asked for: seconds, or of the boards the ratio to the rival's."""
    seconds = result["now"]["seconds"]
    return seconds / result["rival"]["seconds"] if name == "boards" else seconds


def page(results: dict) -> str:
    """The page of results."""
    titles = {
        "demo": "`zoomjax demo`, nothing compiled before",
        "photos": "twelve photos of 12 megapixels to `report.html`, after nine others",
        "boards": "thirty 720p photos of a board, after twenty others",
    }
    runs = results["runs"]
    rows, told = [], []
    for name, result in runs.items():
        now, asked = result["now"], f"{ASKED[name]:g}"
        met = "yes" if ratio(name, result) <= ASKED[name] else "no"
        row = f"{now['seconds']:.1f} s"
        if name == "boards":
            row += f", {ratio(name, result):.2f} times OpenCV's {result['rival']['seconds']:.1f} s"
            asked += " times"
        rows.append([titles[name], row, f"{now['processor']:.1f} s", asked, met])
        columns = [key for key in ("first", "now") if key in result]
        stages = dict.fromkeys(stage for key in columns for stage in result[key]["stages"])
        lines = [
            [stage, *(f"{result[key]['stages'].get(stage, 0):.2f}" for key in columns)] for stage in stages
        ]
        for key in columns:
            result[key]["rest"] = result[key]["seconds"] - sum(result[key]["stages"].values())
        lines.append(["the rest", *(f"{result[key]['rest']:.2f}" for key in columns)])
        lines.append(["all", *(f"{result[key]['seconds']:.2f}" for key in columns)])
        heads = ["s"] if len(columns) == 1 else ["the photos before, s", "these photos, s"]
        told += ["", f"## {name.capitalize()}", "", *table(["stage", *heads], lines)]
    return "\n".join(
        [
            "# From end to end",
            "",
            "Made by `python -m benchmarks.end_to_end`, which says what is measured. Medians over "
            f"{results['repeats']} of each.",
            "",
            *table(["", "by the clock", "of the processor", "asked", "met"], rows),
            *told,
            "",
            machine_line(results["machine"]),
            "",
        ]
    )


def main() -> None:
    """Measure, print, and write the results page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--only", nargs="+", choices=RUNS, default=list(RUNS), help="the runs to measure anew"
    )
    parser.add_argument("--repeats", type=int, default=3, help="how often each is run")
    parser.add_argument("--output", type=Path, default=RESULTS / "end_to_end.md", help="the page to write")
    arguments = parser.parse_args()
    data = real_data(parser) if "boards" in arguments.only else None
    stored = arguments.output.with_suffix(".json")
    runs = json.loads(stored.read_text())["runs"] if stored.exists() else {}
    found: dict[str, list[dict]] = {name: [] for name in arguments.only}
    for _ in range(arguments.repeats):
        for name in arguments.only:
            with tempfile.TemporaryDirectory() as folder:
                found[name].append(RUNS[name](Path(folder), data))
    measured = {name: median(of) for name, of in found.items()}
    merged = {name: (runs | measured)[name] for name in RUNS if name in runs | measured}
    results = {"machine": machine(), "repeats": arguments.repeats, "runs": merged}
    write(arguments.output, page(results), results)


if __name__ == "__main__":
    main()
