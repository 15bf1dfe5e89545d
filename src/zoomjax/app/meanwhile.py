"""Photos that are removed, or replaced by others, while they are calibrated from.

Each is read when its lines are searched for, and again for its EXIF data, and to draw the lines over it.
Minutes lie between.
"""

import contextlib
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from .._core.text import listed, plain
from ..detect.batch import Detection
from ..detect.sources import Source
from ..trust.assessment import Finding

State = tuple[int, int]
"""Bytes of a file, and when it was written, ns."""

_MOST = 4


def states_of(photos: Iterable[Source]) -> dict[str, State | None]:
    """The states of photos, by name; None for what is not there."""
    return {photo.name: _state(photo.path) for photo in photos if photo.path is not None}


def _state(path: Path) -> State | None:
    try:
        about = path.stat()
    except OSError:
        return None
    return about.st_size, about.st_mtime_ns


def findings_of_changed(used: Iterable[Detection], states: Mapping[str, State | None]) -> list[Finding]:
    """That photos used are not what they were when the work began."""
    used = list(used)
    names = [d.name for d in used if d.name in states and _state(Path(d.file)) != states[d.name]]
    if not names:
        return []
    was = "photo was" if len(used) == 1 else "photos was" if len(names) == 1 else "photos were"
    return [
        Finding(
            "photos changed meanwhile",
            "doubtful",
            f"{len(names)} of {len(used)} {was} changed or removed while the calibration ran "
            f"({listed(map(plain, names), _MOST)}): lines may be of one photo, and EXIF data of another.",
            "Calibrate again when the photos do not change any more.",
            cause=True,
        )
    ]


def image_of(source: Source, size: tuple[int, int], state: State | None = None) -> np.ndarray:
    """The pixels in which lines were found; black where the photo is gone, or is another one.

    Args:
        source: the photo, or a frame of a video.
        size: of the image in which they were found, px.
        state: of the file before that, if it is known.
    """
    if source.path is None or state is None or _state(source.path) == state:
        with contextlib.suppress(OSError, ValueError):
            image = source.read()[0]
            if image.shape[1::-1] == tuple(size):
                return image
    return np.zeros(size[::-1], np.uint8)
