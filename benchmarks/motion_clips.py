"""Clips of `benchmarks/motion.py` that are pictures: rendered ones through the command line."""

import csv
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

import av
import cv2
import numpy as np
import skimage.data
import skimage.util

from zoomjax import ZoomLens, load_lens
from zoomjax.io.video_reader import decode_video
from zoomjax.scenes import MotionClip, motion_clip, pan_and_zoom
from zoomjax.tracks import track_video

from .motion_simulated import Rows, displaced, random_lens, wide

RENDERED: dict[str, dict] = {
    "photographs, pan 30°": {},
    "photographs, pan 30°, 30 % moving": {"moving": 0.3},
}
"""Clips, by what `motion_clip` makes of them."""

_PHOTOS = ("astronaut", "chelsea", "coffee", "rocket", "hubble_deep_field", "retina", "gravel", "grass")
_LARGER = 3  # px of the texture to a px of a photograph
_PANORAMA = (8192, 4096)
_COMMAND = [sys.executable, "-c", "from zoomjax.app.cli import main; main()"]


def rendered(only: str, frames: int = 150) -> Rows:
    """Errors of `zoomjax calibrate clip.mp4` for rendered clips of 1080p."""
    for kind, options in RENDERED.items():
        if only not in kind:
            continue
        lens = random_lens(0, 1200.0, 4.0)
        focal, rotation = pan_and_zoom(lens, frames, pan=30, tilt=5, seed=0)
        clip = motion_clip(lens, focal, rotation, texture=photographs(), noise=2, **options)
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder)
            write_video(place / "clip.mp4", clip.frames())
            yield kind, _calibrated(place, clip)


def tracking(only: str, frames: int = 150) -> Rows:
    """Seconds in which points are followed through a rendered clip: the median of three runs."""
    name = "1080p, photographs"
    if only not in name:
        return
    lens = random_lens(0, 1200.0, 4.0)
    focal, rotation = pan_and_zoom(lens, frames, pan=30, tilt=5, seed=0)
    clip = motion_clip(lens, focal, rotation, texture=photographs(), noise=2)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "clip.mp4"
        write_video(path, clip.frames())
        seconds, decoding, tracks = [], [], track_video(path)
        for _ in range(3):
            begin = time.perf_counter()
            track_video(path)
            middle = time.perf_counter()
            with decode_video(path) as (_, items):
                for _, _, image in items:
                    image()
            seconds.append(middle - begin)
            decoding.append(time.perf_counter() - middle)
    yield (
        name,
        {
            "frames": frames,
            "seconds": float(np.median(seconds)),
            "decoding": float(np.median(decoding)),
            "tracks": len(tracks.number),
            "views": int(np.sum(np.asarray(tracks.mask))),
        },
    )


def photographs() -> np.ndarray:
    """A panorama put together from the photographs that scikit-image carries, blue, green, red."""
    width, height = _PANORAMA
    panorama, rng = np.zeros((height, width, 3), np.uint8), np.random.default_rng(0)
    photos = [_photo(name) for name in _PHOTOS]
    top = 0
    while top < height:
        left, tall = 0, 1100
        while left < width:
            photo = photos[rng.integers(len(photos))][:tall, : width - left]
            part = panorama[top : top + len(photo), left : left + photo.shape[1]]
            part[:] = photo[: len(part)]
            left += photo.shape[1]
        top += tall
    return panorama


def _photo(name):
    image = skimage.util.img_as_ubyte(getattr(skimage.data, name)())
    image = image if image.ndim == 3 else image[..., None].repeat(3, axis=-1)
    factor = max(_LARGER * 512 / min(image.shape[:2]), 1)
    return cv2.resize(image[..., 2::-1], None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)


def write_video(path: Path, frames: Iterable[np.ndarray]) -> None:
    """Frames, blue, green, red, as H.264 at the encoder's own quality."""
    with av.open(str(path), "w") as out:
        video = out.add_stream("libx264", rate=25)
        for number, image in enumerate(frames):
            if number == 0:
                video.height, video.width = image.shape[:2]
                video.pix_fmt = "yuv420p"
            out.mux(video.encode(av.VideoFrame.from_ndarray(image, "bgr24")))
        out.mux(video.encode(None))


def _calibrated(folder: Path, clip: MotionClip) -> dict:
    """What the command line finds of a clip, beside the truth."""
    begin = time.perf_counter()
    command = [*_COMMAND, "calibrate", "clip.mp4", "-o", "out"]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    seconds = time.perf_counter() - begin
    summary = json.loads((folder / "out" / "summary.json").read_text())
    with (folder / "out" / "track.csv").open() as file:
        own = np.array([float(row["focal"]) for row in csv.DictReader(file)])
    some = np.arange(0, len(own), 15)
    lens: ZoomLens = load_lens(folder / "out" / "lens.json")
    return {
        "frames": len(own),
        "f": float(np.sqrt(np.mean((own / clip.focal - 1) ** 2))),
        "f_bound": float(summary["focal_scale_std"]),
        "lens": displaced(wide(clip.lens), wide(lens), clip.focal[some], own[some]),
        "noise": summary["noise"],
        "follow": summary["views_that_follow"],
        "verdict": summary["verdict_sentence"],
        "seconds": seconds,
    }
