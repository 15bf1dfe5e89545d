"""Lines read from the ``.npz`` files that `Lines.save` writes."""

import functools
import operator
import os

import equinox as eqx
import numpy as np

from .._core.archive import checked_counts, read_archive
from .._core.arguments import kinds_checked
from .._core.steps import unpacked
from .lines import FORMAT, VERSION, Lines


@kinds_checked
def load_lines(path: str | os.PathLike[str], *, chunk: bool = False) -> Lines:
    """Read lines that `Lines.save` wrote.

    Args:
        path: the file.
        chunk: whether the file holds only some of the lines' points, as for `Lines.from_ragged`: then every
            line is kept, to be compressed and merged with its other points.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is truncated, of another kind, or of a later version; the message names it.
    """
    make = functools.partial(_lines, chunk=chunk)
    return read_archive(path, "lines", make, format=(FORMAT, VERSION), writer="Lines.save")


def _lines(stored: dict[str, np.ndarray], *, chunk: bool = False) -> Lines:
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
        chunk=chunk,
    )
    for name in ("focal", "centre"):  # of the points' dtype so far
        if stored[name].dtype.kind == "f" and stored[name].dtype != getattr(lines, name).dtype:
            lines = eqx.tree_at(operator.attrgetter(name), lines, stored[name])
    of_lines = {name: stored[name] for name in ("weight", "number") if name in stored}
    if any(values.shape != counts.shape or values.dtype.kind not in "fiu" for values in of_lines.values()):
        raise ValueError("its weights or numbers, and its counts, disagree")
    of_lines = {name: values[lines.number] for name, values in of_lines.items()}  # of those of three points
    if "number" in of_lines:
        lines = eqx.tree_at(lambda lines: lines.number, lines, of_lines["number"])
    return lines.weighted(of_lines["weight"]) if "weight" in of_lines else lines
