"""Tracks read from the ``.npz`` files that `Tracks.save` writes."""

import os

import numpy as np

from .._core.archive import checked_counts, read_archive
from .._core.arguments import kinds_checked
from .tracks import FORMAT, VERSION, Tracks


@kinds_checked
def load_tracks(path: str | os.PathLike[str]) -> Tracks:
    """Read tracks that `Tracks.save` wrote.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is truncated, of another kind, or of a later version; the message names it.
    """
    return read_archive(path, "tracks", _tracks, format=(FORMAT, VERSION), writer="Tracks.save")


def _tracks(stored: dict[str, np.ndarray]) -> Tracks:
    counts, number = checked_counts(stored["counts"], stored["points"]), stored["number"]
    if number.shape != counts.shape or len(np.unique(number)) != number.size:
        raise ValueError("its counts and numbers of tracks disagree")
    return Tracks.from_arrays(
        np.repeat(number, counts),
        stored["frame"],
        stored["points"],
        image_size=stored["image_size"].tolist(),
        frames=stored["frames"].item(),
        weight=stored.get("weight"),
    )
