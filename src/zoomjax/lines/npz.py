"""Lines read from the ``.npz`` files that `Lines.save` writes."""

import math
import os
import zipfile

import numpy as np

from .._core.arguments import kinds_checked
from .lines import FORMAT, VERSION, Lines

_MOST_UNPACKED = 100_000_000
"""Bytes that a file may always become in memory; beyond, at most `_MOST_TIMES` its size."""

_MOST_TIMES = 100


@kinds_checked
def load_lines(path: str | os.PathLike[str]) -> Lines:
    """Read lines that `Lines.save` wrote.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is truncated, of another kind, or of a later version; the message names it.
    """
    stored = _read_archive(path)
    try:
        if str(stored.get("format")) != FORMAT:
            raise ValueError("it holds no line primitives; Lines.save writes such a file")
        if (version := stored["version"].item()) != VERSION:
            raise ValueError(
                f"its format version is {version!r} and this zoomjax reads {VERSION}; update zoomjax"
            )
        points, counts = stored["points"], stored["counts"]
        if counts.ndim != 1 or not np.issubdtype(counts.dtype, np.integer) or points.ndim != 2:
            raise ValueError("its points and counts are no tables of numbers")
        largest = int(counts.max(initial=0))
        if counts.min(initial=0) < 0 or largest > len(points) or counts.sum() != len(points):
            raise ValueError("its points and counts disagree")
        _check_unpacked(counts.size * largest * 2 * points.itemsize, points.nbytes)
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
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError) as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else str(error).rstrip(".")
        raise ValueError(f"Cannot read lines from {os.fspath(path)}: {reason}.") from error


def _read_archive(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """All arrays of an ``.npz`` file, nothing unpickled."""
    with open(path, "rb") as opened:
        try:
            if not zipfile.is_zipfile(opened):
                raise ValueError("it is not an .npz archive")
            with zipfile.ZipFile(opened) as members:
                size = sum(member.file_size for member in members.infolist())
                _check_unpacked(size, os.fstat(opened.fileno()).st_size)
                for member in members.infolist():
                    _check_header(members, member)
            opened.seek(0)
            archive = np.load(opened, allow_pickle=False)
            return {name: np.asarray(archive[name]) for name in archive.files}
        # Damaged archives raise whatever zipfile, zlib, struct or the tokenizer of headers stumbles over.
        except Exception as error:
            reason = str(error).rstrip(".") or type(error).__name__
            raise ValueError(f"Cannot read lines from {os.fspath(path)}: {reason}.") from error


def _check_unpacked(size: int, file_size: int) -> None:
    """Refuse a small file that would unpack to fill the memory."""
    if size > max(_MOST_UNPACKED, _MOST_TIMES * file_size):
        raise ValueError(f"it would take {size / 1e9:.1f} GB of memory, far more than its own size")


def _check_header(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> None:
    """Refuse an array that claims to be larger than what is stored of it, before memory is taken for it."""
    if not member.filename.endswith(".npy"):
        return
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        old = version == (1, 0)
        read = np.lib.format.read_array_header_1_0 if old else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
        if not dtype.hasobject and math.prod(shape) * dtype.itemsize != member.file_size - file.tell():
            raise ValueError(f"the size of its {member.filename[:-4]} is not what it claims to be")
