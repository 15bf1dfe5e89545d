"""Thousands of photos through `calibrate`: where the time goes, memory, and the size of lines.npz.

    python -m benchmarks.photos [--photos N] [--cache FOLDER] [--output FILE]

Photos of the striped board are rendered at 40 focal lengths, and stored again and again under other names
with other noise in their last rows, so that every file is another. They are calibrated as the command line
does it. With --cache, photos and detections are kept in that folder, and those of an earlier run are used.
Results go to benchmarks/results/photos.md and photos.json.
"""

import argparse
import os
import tempfile
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import psutil

from zoomjax.app.demo import write_photos
from zoomjax.app.drawings import drawing
from zoomjax.app.focal_sources import lines_of
from zoomjax.app.image_calibration import ImageCalibration, calibrate_images
from zoomjax.app.image_job import ImageJob
from zoomjax.app.model_choice import WantedModel
from zoomjax.app.report import report
from zoomjax.io.exif import exif_with_focal
from zoomjax.io.photo import read_focal

from .shared import RESULTS, machine, machine_line, table, write

_DIFFERENT = 40
_SIZE = (1072, 712)


def write_many(folder: Path, number: int) -> None:
    """Photos of few scenes in many files, no two of which are the same."""
    with tempfile.TemporaryDirectory() as few:
        originals = write_photos(few, number=min(number, _DIFFERENT), image_size=_SIZE)
        read = [(path, cv2.imread(str(path)), read_focal(path)) for path in originals]
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    for index in range(number):
        path, image, focal = read[index % len(read)]
        target = folder / f"{path.stem}-{index:05d}.jpg"
        if target.exists():
            continue
        assert image is not None  # written above
        image = image.copy()
        image[-2:] = rng.integers(0, 40, image[-2:].shape, dtype=np.uint8)
        exif = np.frombuffer(exif_with_focal(focal or 1.0), np.uint8)
        _, content = cv2.imencodeWithMetadata(".jpg", image, [cv2.IMAGE_METADATA_EXIF], [exif])
        target.write_bytes(content.tobytes())


class Watch:
    """Seconds of each stage, and the most memory of this process meanwhile, MB."""

    def __init__(self, first: str):
        self.seconds: dict[str, float] = {}
        self.memory: dict[str, float] = {}
        self._process, self._over = psutil.Process(), threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._name, self._begin = first, time.perf_counter()
        self._thread.start()

    def stage(self, name: str) -> None:
        """End a stage, and begin another; one of the same name goes on."""
        now = time.perf_counter()
        self.seconds[self._name] = self.seconds.get(self._name, 0.0) + now - self._begin
        self._name, self._begin = name, now

    def end(self) -> None:
        """End the last stage."""
        self.stage("")
        self._over.set()
        self._thread.join()

    def _look(self) -> None:
        while not self._over.wait(0.05):
            name, now = self._name, self._process.memory_info().rss / 1e6
            self.memory[name] = max(self.memory.get(name, 0.0), now)


def run(photos: Path, cache: Path, out: Path) -> tuple[ImageCalibration, Watch]:
    """One calibration, as the command line runs it."""
    kept = cache.exists() and any(cache.iterdir())
    watch = Watch("reading detections" if kept else "detecting lines")
    workers = len(os.sched_getaffinity(0))
    job = ImageJob((str(photos),), workers=workers, cache=cache, model=WantedModel("polynomial"))
    done = calibrate_images(job, stage=watch.stage)
    watch.stage("Making the report")
    out.mkdir()
    with drawing(done, out / "lines") as drawn:
        page = report(done.calibration, done, pictures=drawn.pictures())
        watch.stage("Drawing the lines and writing the results")
        drawn.wait()
    done.calibration.make(out, about=done.about(), pages={"report.html": page})
    watch.end()
    return done, watch


def bytes_a_point(done: ImageCalibration, file: Path) -> float:
    """Size of the lines of photos that are all different: copies of a photo compress too well."""
    few = done.used[:: -(-len(done.used) // _DIFFERENT)]  # sorted by scene
    focal = np.array([done.focals.focal[one.name] for one in few])
    lines = lines_of(few, focal, done.focals.unit)
    lines.save(file)
    return file.stat().st_size / np.sum(np.asarray(lines.mask))


def main() -> None:
    """Measure and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--photos", type=int, default=2000)
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--output", type=Path, default=RESULTS / "photos.md")
    chosen = parser.parse_args()
    results: dict = {"photos": chosen.photos, "machine": machine()}
    with tempfile.TemporaryDirectory() as name:
        kept = chosen.cache or Path(name)
        write_many(kept / "photos", chosen.photos)
        done, watch = run(kept / "photos", kept / "cache", Path(name) / "out")
        results |= {"seconds": watch.seconds, "memory_MB": watch.memory}
        rows = [
            [stage[:1].lower() + stage[1:], f"{seconds:.1f}", f"{watch.memory.get(stage, 0):.0f}"]
            for stage, seconds in watch.seconds.items()
        ]
        files = list((Path(name) / "out" / "lines").iterdir())
        points = int(np.sum(np.asarray(done.calibration.lines.mask)))
        results |= {
            "lines": len(done.calibration.rejected),
            "points": points,
            "overlays": len(files),
            "lines_npz_MB": points * bytes_a_point(done, Path(name) / "few.npz") / 1e6,
            "report_MB": (Path(name) / "out" / "report.html").stat().st_size / 1e6,
        }
    page = [
        "# Thousands of photos",
        "",
        "Made by `python -m benchmarks.photos`, which says what is measured.",
        "",
        f"{chosen.photos:,} photos of {_SIZE[0]} x {_SIZE[1]} px with {results['lines']:,} lines of "
        f"{results['points']:,} points. `lines.npz` has {results['lines_npz_MB']:.0f} MB, `report.html` "
        f"{results['report_MB']:.1f} MB; {results['overlays']} photos are drawn with their lines.",
        "",
        *table(["stage", "s", "memory at most, MB"], rows),
        "",
        f"{machine_line(results['machine'])}",
        "",
    ]
    write(chosen.output, "\n".join(page), results)


if __name__ == "__main__":
    main()
