"""Line primitives as text: a row a point, with the columns ``frame,line,x,y`` and perhaps ``focal``.

``frame`` and ``line`` are integers of the writer's choice; a line is one pair of both, its points in the
order of their rows. ``x,y`` are px, (0, 0) the centre of the top-left pixel. Focal lengths come from the
column ``focal``, the same in all rows of a frame, or from a second file with the columns ``frame,focal``.
"""

import csv
import os
import warnings
from collections.abc import Mapping, Sequence

import numpy as np

from .._files import whole_file
from ..lines import Lines


def read_lines_csv(
    path: str | os.PathLike[str],
    *,
    image_size: Sequence[int],
    focal: Mapping[int, float] | Sequence[float] | None = None,
    focal_unit: str = "mm",
) -> Lines:
    """Read lines from a ``frame,line,x,y[,focal]`` file, in float64.

    Args:
        path: the file; columns in any order, others are ignored.
        image_size: (width, height) px.
        focal: focal length by frame number, where the file has no column ``focal``; a sequence counts
            frames from 0.
        focal_unit: "mm" or "px".

    Raises:
        ValueError: a column is missing, a value is no number, or a frame has no focal length, or
            `Lines.from_ragged` raises one; the message names the file.
    """
    columns = _read(path, required=("frame", "line", "x", "y"), optional=("focal",))
    frame, line = (_integers(columns[name], name, path) for name in ("frame", "line"))
    frames, index = np.unique(frame, return_inverse=True)
    if "focal" in columns:
        _check_focal(columns["focal"], path)
        lowest, highest = np.full(frames.size, np.inf), np.full(frames.size, -np.inf)
        np.minimum.at(lowest, index, columns["focal"])
        np.maximum.at(highest, index, columns["focal"])
        if (lowest != highest).any():
            bad = frames[np.argmax(lowest != highest)]
            raise ValueError(f"Cannot read lines from {path}: frame {bad} has two focal lengths.")
        focals = lowest
    elif focal is None:
        raise ValueError(
            f"Cannot read lines from {path}: no focal lengths. Add a column focal, or give a file with the "
            "columns frame,focal."
        )
    else:
        focal = focal if isinstance(focal, Mapping) else dict(enumerate(focal))
        missing = [int(f) for f in frames if int(f) not in focal]
        if missing:
            raise ValueError(
                f"Cannot read lines from {path}: no focal length for {len(missing)} of its "
                f"{frames.size} frames (the first are {', '.join(map(str, missing[:5]))})."
            )
        focals = np.array([focal[int(f)] for f in frames])

    order = np.lexsort((line, index))  # stable: points keep the order of their rows
    starts = np.flatnonzero(np.diff(index[order]) | np.diff(line[order])) + 1
    points = np.stack([columns["x"], columns["y"]], axis=1)[order]
    try:
        return Lines.from_ragged(
            np.split(points, starts),
            index[order][np.concatenate([[0], starts])],
            focals,
            image_size=image_size,
            focal_unit=focal_unit,
        )
    except ValueError as error:
        raise ValueError(f"Cannot read lines from {os.fspath(path)}: {error}") from error


def write_lines_csv(lines: Lines, path: str | os.PathLike[str]) -> None:
    """Write lines as ``frame,line,x,y,focal``, with all the digits of their dtype."""
    frame, focal = np.asarray(lines.frame), np.asarray(lines.focal)
    with whole_file(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["frame", "line", "x", "y", "focal"])
        for number, points in enumerate(lines.to_ragged()):
            m = int(frame[number])
            writer.writerows([m, number, x, y, focal[m]] for x, y in points)


def read_focal_csv(path: str | os.PathLike[str]) -> dict[int, float]:
    """Read focal lengths by frame number from a file with the columns ``frame,focal``.

    Raises:
        ValueError: a column is missing, a value is no number, or not positive, or a frame comes twice.
    """
    columns = _read(path, required=("frame", "focal"))
    frame = _integers(columns["frame"], "frame", path)
    if np.unique(frame).size < frame.size:
        raise ValueError(f"Cannot read focal lengths from {path}: a frame comes twice.")
    _check_focal(columns["focal"], path)
    return dict(zip(frame.tolist(), columns["focal"].tolist(), strict=True))


def _check_focal(focal: np.ndarray, path) -> None:
    good = np.isfinite(focal) & (focal > 0)
    if not good.all():
        raise ValueError(
            f"Cannot read focal lengths from {os.fspath(path)}: they must be finite positive numbers, but "
            f"one is {focal[np.argmin(good)]}."
        )


def _read(path, *, required, optional=()) -> dict[str, np.ndarray]:
    """The named columns as float64."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            first = file.readline()
            header = [name.strip() for name in next(csv.reader([first]), [])]
            missing = [name for name in required if name not in header]
            if missing:
                hint = "; separate columns by commas" if ";" in first or "\t" in first else ""
                raise ValueError(
                    f"the first line must name the columns {','.join(required)}, but "
                    f"{' and '.join(missing)} is not among them{hint}"
                )
            names = [name for name in (*required, *optional) if name in header]
            used = [header.index(name) for name in names]
            start = file.tell()
            try:
                with warnings.catch_warnings():
                    warnings.filterwarnings("ignore", ".*input contained no data")  # told below
                    table = np.loadtxt(file, delimiter=",", usecols=used, ndmin=2, comments=None)
            except (ValueError, IndexError):
                file.seek(start)
                raise ValueError(_first_bad_row(file, header, names)) from None
        if not len(table):
            raise ValueError("there are no rows")
    except (ValueError, csv.Error) as error:  # UnicodeDecodeError is one too
        raise ValueError(f"Cannot read {os.fspath(path)}: {error}.") from error
    return dict(zip(names, table.T, strict=True))


def _first_bad_row(file, header, names) -> str:
    """What is wrong with the first row that holds no numbers; rows are counted from 1, the header's."""
    for number, row in enumerate(csv.reader(file), start=2):
        if row and len(row) < len(header):
            return f"row {number} has {len(row)} columns and the first has {len(header)}"
        for name in names if row else ():
            try:
                float(row[header.index(name)])
            except ValueError:
                return f"{name} in row {number} is {row[header.index(name)]!r}, which is no number"
    return "it holds something else than numbers"


def _integers(values: np.ndarray, name: str, path) -> np.ndarray:
    if not (abs(values) < 2**53).all() or (values != np.floor(values)).any():
        raise ValueError(f"Cannot read {os.fspath(path)}: column {name} must hold integers.")
    return values.astype(np.int64)
