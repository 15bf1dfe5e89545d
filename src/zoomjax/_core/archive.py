"""Reading of ``.npz`` archives that anybody may have written: nothing unpickled, no memory filled."""

import math
import os
import zipfile
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

_MOST_UNPACKED = 100_000_000
"""Bytes that a file may always become in memory; beyond, at most `_MOST_TIMES` its size."""

_MOST_TIMES = 100

Result = TypeVar("Result")


def read_archive(
    path: str | os.PathLike[str],
    what: str,
    make: Callable[[dict[str, np.ndarray]], Result],
    *,
    format: tuple[str, int],
    writer: str,
) -> Result:
    """What an ``.npz`` file holds.

    Args:
        path: the file.
        what: what it holds, for errors.
        make: makes it from the file's arrays; a KeyError is an array that is missing.
        format: the name and the last version of the format; the file states both.
        writer: what writes such files, for errors.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is truncated, of another kind, of a later version, or would fill the memory, or
            `make` refuses it; the message names the file.
    """
    stored = _arrays(path, what)
    try:
        if str(stored.get("format")) != format[0]:
            raise ValueError(f"it holds no {what}; {writer} writes such a file")
        if (version := stored["version"].item()) not in range(1, format[1] + 1):
            raise ValueError(
                f"its format version is {version!r} and this zoomjax reads up to {format[1]}; "
                "update zoomjax"
            )
        return make(stored)
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError) as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else str(error).rstrip(".")
        raise ValueError(f"Cannot read {what} from {os.fspath(path)}: {reason}.") from error


def check_unpacked(size: int, file_size: int) -> None:
    """Refuse a small file that would unpack to fill the memory.

    Raises:
        ValueError: it would.
    """
    if size > max(_MOST_UNPACKED, _MOST_TIMES * file_size):
        raise ValueError(f"it would take {size / 1e9:.1f} GB of memory, far more than its own size")


def checked_counts(counts: Any, entries: Any) -> np.ndarray:
    """How many of a table's entries belong to each of its groups, in order.

    Raises:
        ValueError: they are no such numbers, or padding all groups to the largest would fill the memory.
    """
    if counts.ndim != 1 or not np.issubdtype(counts.dtype, np.integer) or entries.ndim != 2:
        raise ValueError("its points and counts are no tables of numbers")
    largest = int(counts.max(initial=0))
    if counts.min(initial=0) < 0 or largest > len(entries) or counts.sum() != len(entries):
        raise ValueError("its points and counts disagree")
    check_unpacked(counts.size * largest * 2 * entries.itemsize, entries.nbytes)
    return counts


def _arrays(path: str | os.PathLike[str], what: str) -> dict[str, np.ndarray]:
    """All arrays of the file."""
    with open(path, "rb") as opened:
        try:
            if not zipfile.is_zipfile(opened):
                raise ValueError("it is not an .npz archive")
            with zipfile.ZipFile(opened) as members:
                size = sum(member.file_size for member in members.infolist())
                check_unpacked(size, os.fstat(opened.fileno()).st_size)
                for member in members.infolist():
                    _check_header(members, member)
            opened.seek(0)
            archive = np.load(opened, allow_pickle=False)
            return {name: np.asarray(archive[name]) for name in archive.files}
        # Damaged archives raise whatever zipfile, zlib, struct or the tokenizer of headers stumbles over.
        except Exception as error:
            reason = str(error).rstrip(".") or type(error).__name__
            raise ValueError(f"Cannot read {what} from {os.fspath(path)}: {reason}.") from error


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
