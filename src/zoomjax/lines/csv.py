"""Line primitives as CSV: one row per point, with the columns ``frame,line,x,y`` and optionally ``focal``.

``frame`` and ``line`` are arbitrary integers. Each pair of them is a line, with its points in the order of
the rows. ``x,y`` are px, (0, 0) the centre of the top-left pixel. Focal lengths come from the
column ``focal``, the same in all rows of a frame, or from a second file with the columns ``frame,focal``.
"""

import csv
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .._core.arguments import kinds_checked
from .._core.checks import warn_caller
from .._core.files import whole_file
from .._core.text import listed
from ..io.text_table import read_text_table
from .lines import Lines


@kinds_checked
def read_lines_csv(
    path: str | os.PathLike[str],
    *,
    image_size: Sequence[int],
    focal: Mapping[int, float] | Sequence[float] | float | int | None = None,
    focal_unit: str = "mm",
) -> Lines:
    """Read lines from a ``frame,line,x,y[,focal]`` file, in float64.

    Args:
        path: a file that `zoomjax.io.text_table` can read; columns in any order, others are ignored.
        image_size: (width, height) px.
        focal: focal length by frame number, if the file has no column ``focal``; a sequence counts
            frames from 0, a column of pandas has their numbers as its index, and a number is that of all
            frames.
        focal_unit: "mm" or "px".

    Warns:
        UserWarning: the points of a line come in parts that do not lie on one.

    Raises:
        ValueError: a column is missing, a value is not a number, a frame has no focal length, focal lengths
            are both in the file and in `focal`, or `Lines.from_ragged` refuses the lines. The message names
            the file.
    """
    table = read_text_table(path, "lines", numbers=("frame", "line", "x", "y"), optional=("focal",))
    columns = table.numbers
    frame, line = (table.integers(name) for name in ("frame", "line"))
    frames, index = np.unique(frame, return_inverse=True)
    if "focal" in columns:
        if focal is not None:
            raise table.error(
                "it has a column focal, but focal lengths are also given separately. Leave one of them out"
            )
        table.check("focal", columns["focal"] > 0, "positive")
        lowest, highest = np.full(frames.size, np.inf), np.full(frames.size, -np.inf)
        np.minimum.at(lowest, index, columns["focal"])
        np.maximum.at(highest, index, columns["focal"])
        if (lowest != highest).any():
            bad = frames[np.argmax(lowest != highest)]
            raise table.error(f"frame {bad} has two focal lengths")
        focals = lowest
    elif focal is None:
        raise table.error(
            "it has no focal lengths. Add a column focal, or give a file with the columns frame,focal"
        )
    else:
        if isinstance(focal, Mapping):
            known = dict(focal)
        elif hasattr(focal, "index") and hasattr(focal, "to_dict"):  # a column of pandas
            column: Any = focal
            known = column.to_dict()
        else:
            given = np.asarray(focal, float)
            known = dict(enumerate(given)) if given.ndim else dict.fromkeys(frames.tolist(), given)
            if given.ndim and frames.size and len(given) > (last := int(frames.max())) + 1:
                raise table.error(
                    f"its last frame is {last}, and there are {len(given)} focal lengths, of frames 0 to "
                    f"{len(given) - 1}: give them by the frames' numbers, {{{last}: ...}}"
                )
        missing = [int(f) for f in frames if int(f) not in known]
        if missing:
            raise table.error(
                f"there is no focal length for {len(missing)} of its {frames.size} frames (the first are "
                f"{', '.join(map(str, missing[:5]))})"
            )
        focals = np.array([known[int(f)] for f in frames])

    order = np.lexsort((line, index))  # stable: points keep the order of their rows
    starts = np.flatnonzero(np.diff(index[order]) | np.diff(line[order])) + 1
    points = np.stack([columns["x"], columns["y"]], axis=1)
    try:
        lines = Lines.from_ragged(
            np.split(points[order], starts),
            index[order][np.concatenate([[0], starts])],
            focals,
            image_size=image_size,
            focal_unit=focal_unit,
        )
    except ValueError as error:
        raise table.error(str(error)) from error
    _warn_of_two_in_one(frame, line, np.clip(points, -_OUTMOST, _OUTMOST), table.rows)
    return lines


_OFF, _BENT = 3.0, 4.0
"""How far parts of two lines are off a common one, at least: px, and in units of what the longest part is,
if it were bent like this over the whole length."""

_JUMP = 5.0
"""Mean steps from one point to the next, from which another line may begin."""

_NOISE = 0.1
"""px: parts are no straighter than that."""

_OUTMOST = 1e9
"""px: points farther out are moved there, so that no square of a distance overflows."""


def _warn_of_two_in_one(frame, line, points, rows) -> None:
    """Warn of a number that seems to stand for two lines of a frame, whose rows or points come apart."""
    begins = np.flatnonzero(np.diff(frame, prepend=frame[:1] - 1) | np.diff(line, prepend=line[:1] - 1))
    begins = np.sort(np.concatenate([begins, _jumps(points, begins)]))
    parts = np.split(points, begins[1:])
    names = list(zip(frame[begins].tolist(), line[begins].tolist(), strict=True))
    if len(set(names)) == len(names):
        return
    told: dict[tuple[int, int], list[int]] = {}
    for place, name in enumerate(names):
        told.setdefault(name, []).append(place)
    bad = [name for name, places in told.items() if _are_two([parts[place] for place in places])]
    if bad:
        (one, number), more = bad[0], f", and {len(bad) - 1} more are like it" if len(bad) > 1 else ""
        where = listed((str(rows[begins[place]]) for place in told[bad[0]]), 3, " and ")
        warn_caller(
            f"The points of line {number} of frame {one}, in parts from the rows {where} on, do not lie on "
            f"one line{more}. If they are several lines, give each a number of its own."
        )


def _jumps(points: np.ndarray, begins: np.ndarray) -> np.ndarray:
    """Where the longest step between points is far longer than the others of these rows."""
    if not len(points):
        return begins[:0]
    step = np.linalg.norm(np.diff(points, axis=0, prepend=points[:1]), axis=1)
    step[begins] = 0
    longest, number = np.maximum.reduceat(step, begins), np.diff(begins, append=len(points))
    others = (np.add.reduceat(step, begins) - longest) / number
    far = np.flatnonzero(longest > _JUMP * others)
    places = [begins[i] + step[begins[i] : begins[i] + number[i]].argmax() for i in far]
    return np.array(places, begins.dtype)


def _are_two(parts: list[np.ndarray]) -> bool:
    """Whether parts of three points or more are each straighter than all of them together can be."""
    if len(parts) < 2 or min(map(len, parts)) < 3:
        return False
    (off, length), (own, longest) = (
        _bend(np.concatenate(parts)),
        max(map(_bend, parts), key=lambda one: one[1]),
    )
    bent = max(own, _NOISE) * (length / max(longest, _NOISE)) ** 2
    return off > max(_OFF, _BENT * bent)


def _bend(points: np.ndarray) -> tuple[float, float]:
    """How far points are from their line, at most, and how long it is, px."""
    away = points - points.mean(axis=0)
    along, across = (away @ np.linalg.svd(away, full_matrices=False)[2].T).T
    return float(np.abs(across).max()), float(np.ptp(along))


@kinds_checked
def write_lines_csv(lines: Lines, path: str | os.PathLike[str]) -> None:
    """Write lines as ``frame,line,x,y,focal``, with all the digits of their dtype.

    Raises:
        ValueError: the lines have weights, a focus, or another centre than the image's, for which there is
            no column.
    """
    centre = (np.array(lines.image_size) - 1) / 2
    beside = {
        "weights": lines.weight is not None,
        "a focus": lines.focus is not None,
        "another centre than the image's": not np.allclose(lines.centre, centre, rtol=0, atol=1e-3),
    }
    if lost := [name for name, there in beside.items() if there]:
        raise ValueError(
            f"Argument lines has {' and '.join(lost)}, and a CSV file has no column for that: save the "
            "lines as .npz, lines.save(path)."
        )
    frame, focal = np.asarray(lines.frame), np.asarray(lines.focal)
    with whole_file(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["frame", "line", "x", "y", "focal"])
        for number, points in enumerate(lines.to_ragged()):
            m = int(frame[number])
            writer.writerows([m, number, x, y, focal[m]] for x, y in points)


@kinds_checked
def read_focal_csv(path: str | os.PathLike[str]) -> dict[int, float]:
    """Read focal lengths by frame number from a file with the columns ``frame,focal``.

    Raises:
        ValueError: a column is missing, a value is not a positive number, or a frame is listed twice.
    """
    table = read_text_table(path, "focal lengths", numbers=("frame", "focal"))
    frame, focal = table.integers("frame"), table.numbers["focal"]
    table.check("focal", focal > 0, "positive")
    first = np.zeros(frame.size, bool)
    first[np.unique(frame, return_index=True)[1]] = True
    if not first.all():
        bad = int(np.argmin(first))
        raise table.error(f"frame {frame[bad]} comes twice, the second time in row {table.rows[bad]}")
    return dict(zip(frame.tolist(), focal.tolist(), strict=True))
