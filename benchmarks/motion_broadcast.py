"""The frames of a real broadcast for `benchmarks/motion.py`: chained, and beside the pitch's focal lengths.

There is no truth. Two things that know nothing of each other tell the focal length: how the frames fit one
another, and, of each frame, the named lines of the pitch with its measures. The camera turns by a few
degrees and hardly zooms. In a second fit the lines of the pitch count by their straightness, not by their
measures.
"""

from pathlib import Path

import av
import cv2
import numpy as np

from zoomjax import Lines
from zoomjax.app.panorama import write_panorama
from zoomjax.detect import PitchDetector
from zoomjax.fit import RESULTS, MotionFit, fit_motion
from zoomjax.focal import focal_from_pitch, name_pitch_lines
from zoomjax.tracks import track_frames

from .motion_simulated import Rows

_BAND = 1.96  # standard deviations of a 95 % band


def broadcast(folder: Path, only: str, panorama: Path | None) -> Rows:
    """Focal lengths from motion, with lines and without, and from the pitch; and a panorama, if wanted."""
    files = sorted((folder / "broadcast_frames").glob("*.jpg"))
    images = [image for file in files if (image := cv2.imread(str(file))) is not None]
    tracks = track_frames(images)
    found = [PitchDetector()(image) for image in images]
    size = (images[0].shape[1], images[0].shape[0])
    lines = Lines.from_ragged(
        [line for of_frame in found for line in of_frame],
        np.repeat(np.arange(len(found)), [len(of_frame) for of_frame in found]),
        np.ones(len(found)),
        image_size=size,
    )
    for name, more in {"tracks": {}, "tracks and lines": {"lines": lines}}.items():
        if only not in name:
            continue
        fit = fit_motion(tracks, throw=False, **more)
        if panorama is not None:
            _panorama(images, fit, panorama.with_name(f"{panorama.stem}-{name.split()[-1]}.jpg"))
        yield name, _compared(fit, found, size)


def _compared(fit: MotionFit, found: list, size: tuple[int, int]) -> dict:
    """f of the frames from motion and, where the pitch tells it, from the pitch."""
    focal, std = np.asarray(fit.focal), np.asarray(fit.focal_std)
    rows = []
    for frame, lines in enumerate(found):
        distortion = fit.lens(float(focal[frame]))
        principal = np.asarray(distortion.centre)
        straight = [np.asarray(distortion.undistort(np.asarray(line, float))) for line in lines]
        named = name_pitch_lines(straight, principal=principal, image_size=size)
        if named and np.isfinite((pitch := focal_from_pitch(named, principal=principal)).focal):
            rows.append([frame, focal[frame], std[frame], float(pitch.focal), float(pitch.std)])
    frame, own, own_std, theirs, their_std = np.array(rows).reshape(-1, 5).T
    return {
        "frames": len(found),
        "turned": float(np.hypot(*np.ptp(np.asarray(fit.pan_and_tilt), axis=0))),
        "zoomed": float(np.nanmax(focal) / np.nanmin(focal)),
        "noise": float(fit.noise),
        "f": float(np.nanmedian(focal)),
        "f_std": float(np.nanmedian(std)),
        "pitch_frames": len(rows),
        "pitch": float(np.median(theirs)),
        "pitch_std": float(np.median(their_std)),
        "ratio": float(np.median(own / theirs)),
        "within": float(np.mean(abs(own - theirs) < _BAND * np.hypot(own_std, their_std))),
        "good": bool(fit.fit.result == RESULTS.successful),
        "found": rows,
    }


def _panorama(images: list, fit: MotionFit, path: Path) -> None:
    """The mean of the frames where the fit puts them."""
    clip = path.with_suffix(".mkv")
    with av.open(str(clip), "w") as out:
        video = out.add_stream("ffv1", rate=25)
        video.height, video.width = images[0].shape[:2]
        video.pix_fmt = "bgr0"
        for image in images:
            out.mux(video.encode(av.VideoFrame.from_ndarray(image, "bgr24")))
        out.mux(video.encode(None))
    write_panorama(clip, fit, path)
    clip.unlink()
