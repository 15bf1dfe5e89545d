"""Photos with the lines found in them, drawn while something else is done."""

import concurrent.futures
import contextlib
import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from ..detect.sources import Source
from .choice import colour_limit
from .overlay import draw_lines

if TYPE_CHECKING:
    from .image_calibration import ImageCalibration, Progress

_QUALITY = 88


@contextlib.contextmanager
def drawing(images: "ImageCalibration", folder: Path) -> Iterator[Callable[["Progress"], None]]:
    """Draw the lines over some of the images, into a new folder, in threads while the block runs.

    Frames of a video, which come one after another, are drawn when they are waited for.

    Yields:
        What waits for the pictures, and tells of each.
    """
    folder.mkdir()
    parts = zip(images.used, images.members(), images.overlays(), strict=True)
    targets = {one.name: (one.lines, members, folder / name) for one, members, name in parts if name}
    draw = functools.partial(_drawn, images, targets)
    sources = (source for source in images.job.sources()[0] if source.name in targets)
    with concurrent.futures.ThreadPoolExecutor(max(1, images.job.workers)) as pool:
        begun = [pool.submit(draw, source) for source in sources] if images.job.video is None else []

        def wait(progress: "Progress") -> None:
            done = (one.result() for one in begun) if begun else map(draw, sources)
            for number, _ in enumerate(done, start=1):
                progress(number, len(targets))

        try:
            yield wait
        finally:
            pool.shutdown(cancel_futures=True)


def _drawn(
    images: "ImageCalibration",
    targets: dict[str, tuple[tuple[np.ndarray, ...], np.ndarray, Path]],
    source: Source,
) -> None:
    """Draw one image's lines, and write the picture."""
    lines, members, target = targets[source.name]
    picture = draw_lines(
        source.read()[0],
        lines,
        images.calibration.rejected[members].tolist(),
        rms=images.calibration.line_rms[members],
        limit=colour_limit(images.calibration),
        labels={place: str(line) for place, line in enumerate(members.tolist())},
        legend=True,
    )
    done, content = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    assert done
    target.write_bytes(content.tobytes())
