"""Lines read from the ``.npz`` files that `Lines.save` writes."""

import os

import numpy as np

from .._core.archive import checked_counts, read_archive
from .._core.arguments import kinds_checked
from .._core.steps import unpacked
from .lines import FORMAT, VERSION, Lines


@kinds_checked
def load_lines(path: str | os.PathLike[str]) -> Lines:
    """Read lines that `Lines.save` wrote.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is truncated, of another kind, or of a later version; the message names it.
    """
    return read_archive(path, "lines", _lines, format=(FORMAT, VERSION), writer="Lines.save")


def _lines(stored: dict[str, np.ndarray]) -> Lines:
    points = unpacked(stored["steps"], stored["step"]) if "steps" in stored else stored["points"]
    counts = checked_counts(stored["counts"], points)
    lines = Lines.from_ragged(
        np.split(points, np.cumsum(counts)[:-1]),
        stored["frame"],
        stored["focal"],
        image_size=stored["image_size"].tolist(),
        focal_unit=str(stored["focal_unit"]),
        centre=stored["centre"],
        focus=stored.get("focus"),
    )
    if "weight" not in stored:
        return lines
    if stored["weight"].shape != counts.shape:
        raise ValueError("its weights and counts disagree")
    return lines.weighted(stored["weight"][lines.number])
