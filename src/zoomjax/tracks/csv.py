"""Tracks as CSV: one row per view, with the columns ``track,frame,x,y`` and, if there are any, ``weight``.

``track`` is any integer; ``frame`` counts from 0; ``x,y`` are px, (0, 0) the centre of the first pixel;
``weight`` is relative to other views, at least 0. Rows may come in any order.
"""

import csv
import os
from collections.abc import Sequence

import numpy as np

from .._core.arguments import kinds_checked
from .._core.files import whole_file
from ..io.text_table import read_text_table
from .tracks import Tracks


@kinds_checked
def read_tracks_csv(
    path: str | os.PathLike[str], *, image_size: Sequence[int], frames: int | None = None
) -> Tracks:
    """Read tracks from a ``track,frame,x,y`` or ``track,frame,x,y,weight`` file, in float64.

    Args:
        path: a file that `zoomjax.io.text_table` can read; columns in any order, others are ignored.
        image_size: (width, height) px.
        frames: number of frames of the clip; by default one more than the last frame with a view.

    Raises:
        OSError: the file cannot be read.
        ValueError: a column is missing, a value is not a number, or `Tracks.from_arrays` refuses them. The
            message names the file.

    Warns:
        UserWarning: tracks of one view are dropped.
    """
    table = read_text_table(path, "tracks", numbers=("track", "frame", "x", "y"), optional=("weight",))
    track, frame = (table.integers(name) for name in ("track", "frame"))
    points = np.stack([table.numbers["x"], table.numbers["y"]], axis=1)
    weight = table.numbers.get("weight")
    try:
        return Tracks.from_arrays(track, frame, points, image_size=image_size, frames=frames, weight=weight)
    except ValueError as error:
        raise table.error(str(error)) from error


@kinds_checked
def write_tracks_csv(tracks: Tracks, path: str | os.PathLike[str]) -> None:
    """Write tracks as ``track,frame,x,y``, with all the digits of their dtype.

    Weights are one more column, ``weight``, if there are any.
    """
    track, frame, points = tracks.views()
    columns = {"track": track, "frame": frame, "x": points[:, 0], "y": points[:, 1]}
    if (weight := tracks.view_weights()) is not None:
        columns["weight"] = weight
    with whole_file(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))
