"""Correction of photos one by one, here or on an executor: what a task is, and what comes back of it."""

import contextlib
import dataclasses
import functools
import os
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from .._core.executors import arrived, checked_executor, in_order, is_away, sent
from .._core.files import whole_file
from ..correct.framing import Framing, frame_output
from ..correct.photo import Correction, check_ahead, corrected_photo
from ..correct.redistort import check_framed
from ..models.lens import ZoomLens
from ..models.sizes import at_focal, lens_for_size

BAD_FILE = (ValueError, OSError, RuntimeError, MemoryError, cv2.error)
"""Errors of one file that do not stop the others."""


def _same(size: tuple[int, int]) -> str:
    return "same"


SAME = _same
"""The framing of the input, for each image size."""


@dataclasses.dataclass(frozen=True)
class CommonFraming:
    """The framing for each image size, common to all focal lengths of a range.

    Attributes:
        lens: the lens.
        keep: what of the image is shown, as for `undistort_image`.
        low, high: the shortest and the longest focal length.
        redistort: whether corrected images are given, and distortion is applied.
        made: the framings made so far, by size; they go along to workers.
    """

    lens: ZoomLens
    keep: str
    low: float
    high: float
    redistort: bool
    made: dict[tuple[int, int], Framing] = dataclasses.field(default_factory=dict)

    def __call__(self, size: tuple[int, int]) -> Framing:
        """The framing of images of a size."""
        if size not in self.made:
            self.made[size] = self._make(size)
        return self.made[size]

    def _make(self, size: tuple[int, int]) -> Framing:
        dtype, some = np.asarray(self.lens.centre).dtype, 65 if self.low < self.high else 1
        spread = (1 / np.linspace(1 / self.low, 1 / self.high, some)).astype(dtype)
        original = self.lens.image_size if self.redistort and self.keep == "grow" else size
        scaled = lens_for_size(self.lens, original)
        framing = frame_output([at_focal(scaled, f) for f in spread], original, keep=self.keep)
        if self.redistort:
            check_framed(framing, size)
        return framing


class _Task(NamedTuple):
    """A photo, where its correction goes, and its focal length; None: that of its EXIF data.

    `before` is the file that is in place of the result.
    """

    source: Path
    target: Path
    focal: float | Exception | None
    before: tuple[int, ...] | None


_ELSEWHERE = (
    "its worker wrote it to a folder that is not this one: the output folder must be one that workers share"
)


def _file(path: Path) -> tuple[int, ...] | None:
    """What tells a file from the one that it replaced; None where there is none."""
    try:
        about = path.stat()
    except OSError:
        return None
    return about.st_ino, about.st_size, about.st_mtime_ns


def _replaced(task: _Task) -> bool:
    """Whether a file is there that was not before."""
    if _file(task.target) != task.before:
        return True
    with contextlib.suppress(OSError):
        os.listdir(task.target.parent)  # a folder on another machine may be remembered as it was
    return _file(task.target) != task.before


def corrected_photos(
    pairs: Sequence[tuple[Path, Path]],
    correction: Correction,
    focal_of: Callable[[Path], float] | None,
    executor: Executor | None,
) -> Generator[tuple[Path, Path, list[str] | Exception], None, None]:
    """Correct each source into its target, in order: with what was lost of it, or why it is not there.

    Args:
        pairs: sources and targets.
        correction: what is done.
        focal_of: gives the focal length of a source; None: that of its EXIF data.
        executor: where it is done; None: here.

    Raises:
        OSError: a target cannot be written; those before it are complete.
    """
    tasks = (_Task(*pair, _known(focal_of, pair[0]), _file(pair[1])) for pair in pairs)
    if executor is None:
        for task in tasks:
            yield task.source, task.target, _corrected(task, correction)
        return
    work = functools.partial(_corrected_there, correction=_sent(correction))
    with contextlib.closing(
        in_order(checked_executor(executor), work, tasks, there=_absolute, file=lambda task: task.source)
    ) as done:
        for one in done:
            if isinstance(one.error, OSError):  # of the target
                raise one.error
            if one.result is None:
                yield one.item.source, one.item.target, RuntimeError(f"its task failed: {one.told()}")
            elif isinstance(one.result, list) and not _replaced(one.item):
                yield one.item.source, one.item.target, RuntimeError(_ELSEWHERE)
            else:
                yield one.item.source, one.item.target, one.result


def foreseen(correction: Correction, focal_of: Callable[[Path], float], source: Path) -> str:
    """What is known of the correction of a photo before any work; it raises what is known to be refused."""
    focal = focal_of(source)
    check_ahead(source, correction)
    return f", f = {focal:g} {correction.lens.focal_unit}"


def _absolute(task: _Task) -> _Task:
    """For a worker, which is in another folder."""
    return task._replace(source=task.source.absolute(), target=task.target.absolute())


def _known(focal_of: Callable[[Path], float] | None, source: Path) -> float | Exception | None:
    try:
        return None if focal_of is None else focal_of(source)
    except BAD_FILE as error:
        return error


def _corrected(task: _Task, correction: Correction) -> list[str] | Exception:
    """Correct a photo and write it: what was lost of it, or why it cannot be corrected."""
    if isinstance(task.focal, Exception):
        return task.focal
    try:
        content, lost = corrected_photo(task.source, task.target.suffix, correction, task.focal)
    except BAD_FILE as error:
        return error
    task.target.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(task.target) as part:
        part.write_bytes(content)
    return lost


def _sent(correction: Correction) -> Correction:
    """A correction that can be sent, with the framing of images of the lens's own size made."""
    keep = correction.keep
    if isinstance(keep, CommonFraming):
        with contextlib.suppress(ValueError):  # which the photo's task will say
            keep(correction.lens.image_size)
        keep = dataclasses.replace(keep, lens=sent(keep.lens))
    return dataclasses.replace(correction, lens=sent(correction.lens), keep=keep)


def _corrected_there(task: _Task, *, correction: Correction) -> list[str] | Exception:
    """In a worker: the same."""
    if is_away():
        cv2.setNumThreads(1)  # workers share a machine's cores
    keep = correction.keep
    if isinstance(keep, CommonFraming):
        keep = dataclasses.replace(keep, lens=arrived(keep.lens))
    return _corrected(task, dataclasses.replace(correction, lens=arrived(correction.lens), keep=keep))
