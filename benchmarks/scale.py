"""How work grows with workers, and what it would take for a thousand of them.

    python -m benchmarks.scale [--photos N] [--output FILE]

Clusters of Dask on this machine with 1, 2 and 4 workers, a process of one thread each: lines found in
rendered photographs of the paper's board, and files of points compressed by `zj.lines.stream`. The rate,
higher is better, stands beside the ideal, that of one worker times the workers or cores, whichever are
fewer. The cost of a task is the CPU time of client and scheduler, one process here, for tasks that do
nothing. What a thousand workers would do is on paper and a simulation, with their assumptions beside them;
nobody has run it. Results go to benchmarks/results/scale.md and scale.json.
"""

import argparse
import heapq
import logging
import os
import pickle
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from distributed import Client

import zoomjax as zj
from zoomjax._core.executors import in_order
from zoomjax.app.demo import write_photos
from zoomjax.detect.batch import _sent

from .shared import RESULTS, machine, machine_line, table, write

WORKERS = (1, 2, 4)
SIZE = (1072, 712)
FILES, LINES, POINTS = 8, 60, 2000

MANY = 1000
"""Workers of the simulation."""

PHOTOS = 10**6
PHOTO_BYTES = 5e6
ALL_POINTS = 10**12
POINTS_A_LINE = 3400
STORAGE = 20e9
"""Bytes a second that a storage gives to all workers: an assumption."""

DEATHS = 1e-5
"""Share of tasks whose worker dies, halfway in the mean: an assumption."""


def nothing(item: int) -> int:
    return item


def timed(work: Iterable) -> tuple[float, list]:
    start = time.perf_counter()
    done = list(work)
    return time.perf_counter() - start, done


def cpu(client: Any) -> float:
    """CPU seconds of all workers so far."""
    return sum(client.run(time.process_time).values())


def measured(number: int, photos: list, files: list[Path]) -> dict:
    """Rates with so many workers."""
    detector = zj.detect.EdgeDetector()
    with Client(n_workers=number, threads_per_worker=1, dashboard_address=None) as client:
        executor = client.get_executor(pure=False)
        list(zj.detect.detect(photos[: 2 * number], detector, executor=executor))
        before = cpu(client)
        of_photos, found = timed(zj.detect.detect(photos, detector, executor=executor))
        photo_cpu = (cpu(client) - before) / len(photos)
        assert not any(detection.problem for detection in found)
        list(zj.lines.stream(files[:1] * 2 * number, executor=executor))
        before = cpu(client)
        of_points, _ = timed(zj.lines.stream(files, executor=executor))
        point_cpu = (cpu(client) - before) / (len(files) * LINES * POINTS)
        before = time.process_time()
        of_tasks, _ = timed(in_order(executor, nothing, range(500)))
        task_cpu = (time.process_time() - before) / 500
    return {
        "workers": number,
        "photos_per_s": len(photos) / of_photos,
        "cpu_s_per_photo": photo_cpu,
        "points_per_s": len(files) * LINES * POINTS / of_points,
        "cpu_ns_per_point": 1e9 * point_cpu,
        "task_ms": 1000 * of_tasks / 500,
        "task_cpu_ms": 1000 * task_cpu,
    }


def write_points(folder: Path) -> list[Path]:
    """Files of points of the board's lines."""
    rng, x, files = np.random.default_rng(0), np.linspace(9, 1900, POINTS), []
    for number in range(FILES):
        height = np.linspace(5, 1070, LINES)
        points = [np.stack([x, y + rng.standard_normal(POINTS)], axis=-1) for y in height]
        lines = zj.Lines.from_ragged(points, [0] * LINES, [24.0 + number], image_size=(1920, 1080))
        lines.save(folder / f"{number}.npz")
        files.append(folder / f"{number}.npz")
    return files


def simulated(tasks: int, seconds: float, dispatch: float, spread: float = 0.3) -> float:
    """Seconds until all tasks are done: one scheduler hands them to `MANY` workers, each when it is free.

    A task takes `seconds` with a relative standard deviation of `spread`, lognormal. One whose worker dies
    takes half as long again; the worker is back at once.
    """
    rng = np.random.default_rng(0)
    sigma = np.sqrt(np.log(1 + spread**2))
    lasting = seconds * rng.lognormal(-(sigma**2) / 2, sigma, tasks)
    lasting *= np.where(rng.uniform(size=tasks) < DEATHS, 1.5, 1)
    free, scheduler, last = [0.0] * MANY, 0.0, 0.0
    for each in lasting.tolist():
        scheduler = max(scheduler, free[0]) + dispatch
        end = scheduler + each
        heapq.heapreplace(free, end)
        last = max(last, end)
    return last


def main(photos: int, output: Path) -> None:
    jax.config.update("jax_enable_x64", True)
    logging.getLogger("distributed").setLevel(logging.ERROR)  # workers end slowly on a busy machine
    cores = os.cpu_count() or 1
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        few = write_photos(folder / "photos", number=6, image_size=SIZE)
        sources = zj.detect.find_photos(few)
        many = (sources * -(-photos // len(sources)))[:photos]
        files = write_points(folder)
        rows = [measured(number, many, files) for number in WORKERS]
        sent = pickle.dumps(_sent(sources[0], detector=zj.detect.EdgeDetector(), grid="none", cache=None))
        [detection] = zj.detect.detect(sources[:1], zj.detect.EdgeDetector())
    points = sum(len(line) for line in detection.lines)
    dispatch = min(row["task_cpu_ms"] for row in rows) / 1000
    photo = min(row["cpu_s_per_photo"] for row in rows)
    point = min(row["cpu_ns_per_point"] for row in rows) * 1e-9
    size = 10**8
    tasks = ALL_POINTS // size
    predicted = {
        "photos_work_s": PHOTOS * photo / MANY,
        "photos_dispatch_s": PHOTOS * dispatch,
        "photos_storage_s": PHOTOS * PHOTO_BYTES / STORAGE,
        "photos_simulated_s": simulated(PHOTOS, photo, dispatch),
        "photos_received_GB": PHOTOS * len(sent) / 1e9,
        "points_work_s": ALL_POINTS * point / MANY,
        "points_storage_s": ALL_POINTS * 16 / STORAGE,
        "points_dispatch_s": tasks * dispatch,
        "points_simulated_s": simulated(tasks, size * point, dispatch),
        "points_received_GB": ALL_POINTS / POINTS_A_LINE * 392 / 1e9,
    }
    results = {
        "machine": machine(),
        "load_before": load,
        "rows": rows,
        "bytes_per_photo": len(sent),
        "points_per_photo": points,
        "predicted": predicted,
    }
    write(output, page(results, cores, photos), results)


def page(results: dict, cores: int, photos: int) -> str:
    rows, p = results["rows"], results["predicted"]
    one = rows[0]
    lines = [
        "# Work over workers",
        "",
        f"{machine_line(results['machine'])} {cores} cores, so that more than {cores} workers can "
        f"gain nothing. "
        f"Others used them, too: the load was {results['load_before']:.1f} before the run, and "
        f"rates vary with it. "
        "CPU seconds do so less.",
        "",
        f"{photos} photographs of {SIZE[0]} x {SIZE[1]} px, and {FILES} files of {LINES} lines of "
        f"{POINTS} points. "
        "Dask, each worker a process of one thread. Ideal: the rate of one worker times workers or cores.",
        "",
        *table(
            [
                "workers",
                "photos/s",
                "ideal",
                "CPU s a photo",
                "million points/s",
                "ideal",
                "CPU ns a point",
                "ms a task",
                "CPU ms a task",
            ],
            [
                [
                    str(row["workers"]),
                    f"{row['photos_per_s']:.2f}",
                    f"{one['photos_per_s'] * min(row['workers'], cores):.2f}",
                    f"{row['cpu_s_per_photo']:.3f}",
                    f"{row['points_per_s'] / 1e6:.2f}",
                    f"{one['points_per_s'] * min(row['workers'], cores) / 1e6:.2f}",
                    f"{row['cpu_ns_per_point']:.0f}",
                    f"{row['task_ms']:.2f}",
                    f"{row['task_cpu_ms']:.2f}",
                ]
                for row in rows
            ],
        ),
        "",
        f"Of a photo {results['bytes_per_photo']:,} bytes come back, its "
        f"{results['points_per_photo']:,} points.",
        "",
        f"## {MANY} workers, on paper and simulated",
        "",
        "Nobody has run this. Assumed: workers as fast as a core here, by the least CPU time above; one "
        "process that hands over a task at a time, at the least CPU time of a task above; a storage of "
        f"{STORAGE / 1e9:.0f} GB/s, with all workers on it; photos of {PHOTO_BYTES / 1e6:.0f} MB, and "
        "as many pixels as those above; files of 10^8 points of 16 bytes; lines of "
        f"{POINTS_A_LINE} points; a worker dies in {DEATHS:g} of the tasks. The simulation adds the spread "
        "of the tasks' times, 30 %, and the wait for the last ones; it has no storage.",
        "",
        *table(
            ["seconds", "work, by workers", "handing over", "reading", "simulated", "comes back, GB"],
            [
                [
                    "a million photos",
                    *(
                        f"{p[f'photos_{part}_s']:,.0f}"
                        for part in ("work", "dispatch", "storage", "simulated")
                    ),
                    f"{p['photos_received_GB']:,.1f}",
                ],
                [
                    "10^12 points",
                    *(
                        f"{p[f'points_{part}_s']:,.0f}"
                        for part in ("work", "dispatch", "storage", "simulated")
                    ),
                    f"{p['points_received_GB']:,.1f}",
                ],
            ],
        ),
        "",
        "The largest of the first three is the bound. Triangles of 10^12 points are more than "
        "one machine should hold: "
        "processes that keep their own, and fit them where they are (`zj.lines.shard`), exchange "
        "sums alone.",
        "",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--photos", type=int, default=24, help="number of photographs")
    parser.add_argument("--output", type=Path, default=RESULTS / "scale.md")
    arguments = parser.parse_args()
    main(arguments.photos, arguments.output)
