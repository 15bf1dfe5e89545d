"""Memory and open files while many images are looked at: they do not grow.

    python -m benchmarks.reliability_memory

Of this process and of those that it begins, after the first quarter of the images (all libraries are there
by then) and at the end. Images are small, so that what is kept of each would show, not hide in their size.
"""

import argparse
import contextlib
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import psutil

import zoomjax as zj
from zoomjax.detect.batch import detect
from zoomjax.detect.sources import Source, find_photos, video_frames

from .mutations import READERS, damaged

_SIZE = (192, 128)


def run(photos: int = 300, frames: int = 2000, bad: int = 1000, workers: int = 2) -> dict[str, dict]:
    """For each kind: images; MB that this process and its workers grew by, at most; and open files."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        return {
            "photos": _watched(_photos(folder / "photos", photos), photos, workers),
            "video frames": _watched(_frames(folder / "still.mkv", frames), frames, workers),
            "bad files": _watched(_bad(folder / "bad", bad), bad, workers),
        }


def _picture(number: int) -> np.ndarray:
    image = np.full((_SIZE[1], _SIZE[0], 3), 40, np.uint8)
    for left in range(20 + number % 17, _SIZE[0] - 20, 40):
        image[:, left : left + 20] = 200
    return cv2.GaussianBlur(image, (0, 0), 0.8)


def _photos(folder: Path, number: int) -> Iterable[Source]:
    folder.mkdir()
    for index in range(number):
        cv2.imwrite(str(folder / f"{index:05d}.jpg"), _picture(index))
    return find_photos([folder])


def _frames(path: Path, number: int) -> Iterable[Source]:
    with av.open(str(path), "w") as out:
        video: Any = out.add_stream("mpeg4", rate=30)
        video.width, video.height = _SIZE
        for index in range(number):
            out.mux(video.encode(av.VideoFrame.from_ndarray(_picture(index), "bgr24")))
        out.mux(video.encode(None))
    return video_frames(path, 35.0, number)


def _bad(folder: Path, number: int) -> Iterable[Source]:
    folder.mkdir()
    rng = np.random.default_rng(0)
    kinds = [READERS[name] for name in ("JPEG", "PNG", "WebP", "TIFF", "BMP")]
    corpora = [kind.corpus(folder) for kind in kinds]
    for index in range(number):
        kind, corpus = kinds[index % 5], corpora[index % 5]
        content = damaged(corpus[rng.integers(len(corpus))], rng)
        (folder / f"{index:05d}{kind.suffix}").write_bytes(content)
    return find_photos([folder])


def _watched(sources: Iterable[Source], number: int, workers: int) -> dict:
    start, done, problems = time.perf_counter(), 0, 0
    early = late = _held()
    for found in detect(sources, zj.EdgeDetector(), workers=workers):
        done += 1
        problems += bool(found.problem)
        if done == number // 4:
            early = _held()
        if done == number - 1:
            late = _held()
    grown = {name: round(late[name] - early[name], 1) for name in early}
    return {"tried": done, "problems": problems, **grown, "seconds": round(time.perf_counter() - start, 1)}


def _held() -> dict[str, float]:
    """MB resident and files open, of this process and of its workers."""
    own: Any = psutil.Process()
    held = {"MB": 0.0, "MB of workers": 0.0, "files": 0, "processes": 0}
    for process in (own, *own.children(recursive=True)):
        with contextlib.suppress(psutil.NoSuchProcess, psutil.AccessDenied):
            held["MB" if process == own else "MB of workers"] += process.memory_info().rss / 1e6
            held["files"] += process.num_fds() if psutil.POSIX else process.num_handles()
            held["processes"] += 1
    return held


def main() -> None:
    parser = argparse.ArgumentParser(description="Memory while many images are looked at.")
    for name, default in (("photos", 300), ("frames", 2000), ("bad", 1000), ("workers", 2)):
        parser.add_argument(f"--{name}", type=int, default=default)
    for name, row in run(**vars(parser.parse_args())).items():
        print(name, row)


if __name__ == "__main__":
    main()
