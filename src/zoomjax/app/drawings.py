"""Pictures of photos: with the lines found in them, and small ones for the report.

Each photo is read once for all of them, in threads, while something else is done.
"""

import contextlib
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from ..detect.sources import Source
from .choice import chosen_frames, colour_limit
from .meanwhile import image_of
from .overlay import draw_lines
from .pictures import MOST, Photos, Pictures, pictures_of

_QUALITY = 88


class Drawn:
    """Pictures that are being drawn: of each photo with lines over it, and maybe small ones."""

    def __init__(self, made: Iterator[Pictures | None], number: int):
        self._made, self._number = made, number
        self._done: list[Pictures | None] = []

    def wait(self, progress: Callable[[int, int], None] = lambda done, total: None) -> None:
        """Wait for all of them, and tell of each."""
        for number in range(1, self._number + 1):
            if number > len(self._done):
                self._done.append(next(self._made))
            progress(number, self._number)

    def pictures(self) -> Iterator[Pictures]:
        """The small ones, sorted by f; waits for all when the first is asked for."""
        self.wait()
        yield from sorted(filter(None, self._done), key=lambda one: (one.focal, one.frame))


@contextlib.contextmanager
def drawing(images: Photos, folder: Path, most: int = MOST) -> Iterator[Drawn]:
    """Draw photos into a new folder, and small pictures of so many, in threads while the block runs.

    Small ones are of the photos fitted worst, and of others over the zoom. Frames of a video, which come
    one after another, are drawn when they are waited for.
    """
    folder.mkdir()
    overlays = dict(zip((one.name for one in images.used), images.overlays(), strict=True))
    targets = {name: folder / target for name, target in overlays.items() if target}
    chosen = {images.used[frame].name for frame in chosen_frames(images.calibration, most)}
    shown = [(frame, of) for frame, of in enumerate(images.used) if of.name in {*targets, *chosen}]
    frames = {of.name: frame for frame, of in shown}
    draw = functools.partial(_drawn, images, images.members(), frames, targets, chosen)
    sources = images.job.again(of for _, of in shown)
    with ThreadPoolExecutor(max(1, images.job.workers)) as pool:
        made = map(draw, sources) if images.job.video is not None else pool.map(draw, sources)
        try:
            yield Drawn(made, len(frames))
        finally:
            pool.shutdown(cancel_futures=True)


def _drawn(
    images: Photos,
    members: list[np.ndarray],
    frames: Mapping[str, int],
    targets: Mapping[str, Path],
    chosen: set[str],
    source: Source,
) -> Pictures | None:
    """Draw the lines of one photo, write the picture, and make the small ones."""
    frame = frames[source.name]
    image = image_of(source, images.used[frame].image_size, images.states.get(source.name))
    if target := targets.get(source.name):
        write_overlay(
            target,
            image,
            images.used[frame].lines,
            members[frame],
            rms=images.calibration.line_rms,
            rejected=images.calibration.rejected,
            limit=colour_limit(images.calibration),
        )
    return pictures_of(images, frame, image) if source.name in chosen else None


def write_overlay(
    target: Path,
    image: np.ndarray,
    points: Sequence[np.ndarray],
    own: np.ndarray,
    *,
    rms: np.ndarray,
    rejected: np.ndarray,
    limit: float,
) -> None:
    """Write a picture with its lines, each with its number.

    Args:
        target: the file.
        image: the picture.
        points: of each of its lines.
        own: their numbers among all lines.
        rms: of all lines, px.
        rejected: whether each one does not count.
        limit: the RMS, px, from which on a line has the last colour.
    """
    picture = draw_lines(
        image,
        points,
        rejected[own].tolist(),
        rms=rms[own],
        limit=limit,
        labels={place: str(line) for place, line in enumerate(own.tolist())},
        legend=True,
    )
    done, content = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    assert done
    target.write_bytes(content.tobytes())
