"""A video of two hours on the command line: time, and memory, which must not grow with its length.

    python -m benchmarks.long_video [--hours H] [--output FILE]

The striped board at 40 focal lengths, each for an equal part of the video, 25 frames a second, with sound.
`zoomjax undistort` corrects all of it, by a table of focal lengths, and `zoomjax calibrate` finds the lens
from it with that table. A video of a tenth of the length goes before, for comparison. Memory is that of the
command and of the processes that it begins. Results go to benchmarks/results/long_video.md and
long_video.json.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import psutil

from zoomjax.app.demo import write_photos
from zoomjax.io.photo import read_focal

from .shared import RESULTS, machine, machine_line, table, write

_SIZE, _RATE, _SOUND, _FOCALS = (320, 212), 25, 8000, 40


def write_video(path: Path, photos: list[np.ndarray], frames: int) -> None:
    """Each photo for an equal part of the frames, a mark that moves in it, and a tone."""
    with av.open(str(path), "w") as out:
        video: Any = out.add_stream("libx264", rate=_RATE, options={"preset": "ultrafast", "g": "250"})
        (video.width, video.height), video.pix_fmt = _SIZE, "yuv420p"
        sound: Any = out.add_stream("aac", rate=_SOUND, layout="mono")
        second = (8000 * np.sin(2 * np.pi * 300 / _SOUND * np.arange(_SOUND))).astype(np.int16)[None]
        for index in range(frames):
            image = photos[index * len(photos) // frames].copy()
            image[-8:, index % _SIZE[0]] = 255
            frame: Any = av.VideoFrame.from_ndarray(image, "bgr24")
            frame.pts = index
            out.mux(video.encode(frame))
            if index % _RATE == 0:
                part = av.AudioFrame.from_ndarray(second, "s16", "mono")
                part.sample_rate, part.pts = _SOUND, index // _RATE * _SOUND
                out.mux(sound.encode(part))
        out.mux(video.encode())
        out.mux(sound.encode())


def watched(*command: str) -> dict[str, float]:
    """Seconds of a command of zoomjax, and the most MB."""
    begin = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "zoomjax", *command], stdout=subprocess.DEVNULL)
    whole, rows = psutil.Process(process.pid), []
    while process.poll() is None:
        try:
            rows.append(sum(p.memory_info().rss for p in [whole, *whole.children(recursive=True)]) / 1e6)
        except psutil.NoSuchProcess:
            continue
        time.sleep(0.2)
    assert process.returncode == 0, command
    return {"seconds": time.perf_counter() - begin, "MB": max(rows)}


def run(hours: float) -> dict[str, dict[str, float]]:
    """Both commands, of a video of so many hours."""
    frames = round(3600 * hours * _RATE)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        files = write_photos(folder / "photos", number=_FOCALS, image_size=_SIZE)
        focals = [read_focal(file) or 0.0 for file in files]
        clip, track = folder / "long.mp4", folder / "focal.csv"
        write_video(clip, [np.asarray(cv2.imread(str(file))) for file in files], frames)
        rows = [f"{index},{focals[index * _FOCALS // frames]:.9g}" for index in range(frames)]
        track.write_text("\n".join(["frame,focal", *rows, ""]))
        found, corrected = folder / "found", folder / "corrected.mp4"
        results = {"calibrate": watched("calibrate", str(clip), "--focal", str(track), "-o", str(found))}
        lens = str(found / "lens.json")
        results["undistort"] = watched(
            "undistort", lens, str(clip), "--focal", str(track), "-o", str(corrected)
        )
        with av.open(str(corrected)) as done:
            there = sum(packet.pts is not None for packet in done.demux(video=0))
            assert there == frames, (there, frames)
            assert abs((done.duration or 0) / av.time_base - frames / _RATE) < 1
        return results | {"video": {"frames": frames, "MB": clip.stat().st_size / 1e6}}


def main() -> None:
    """Measure and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--hours", type=float, default=2.0)
    parser.add_argument("--output", type=Path, default=RESULTS / "long_video.md")
    chosen = parser.parse_args()
    few, many = run(chosen.hours / 10), run(chosen.hours)
    rows = [
        [
            f"`zoomjax {name}`",
            *(f"{one[name][key]:.0f}" for key in ("seconds", "MB") for one in (few, many)),
            f"{many['video']['frames'] / many[name]['seconds']:.0f}",
        ]
        for name in ("calibrate", "undistort")
    ]
    page = [
        "# A video of two hours\n",
        "Made by `python -m benchmarks.long_video`, which says what is measured.\n",
        f"{_SIZE[0]} × {_SIZE[1]} px, H.264 with sound: {few['video']['frames']:,} frames, and "
        f"{many['video']['frames']:,} in a file of {many['video']['MB']:.0f} MB.\n",
        *table(["", "s, of a tenth", "s", "MB at most, of a tenth", "MB at most", "frames/s"], rows),
        "",
        machine_line(machine()),
    ]
    write(chosen.output, "\n".join(page) + "\n", {"tenth": few, "whole": many, "machine": machine()})


if __name__ == "__main__":
    main()
