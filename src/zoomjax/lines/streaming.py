"""Data sets in many files, one file in memory at a time: what is kept of each are its triangles."""

import contextlib
import functools
import os
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Executor
from typing import Any, TypeVar

from .._core.executors import arrived, checked_executor, in_order, sent
from .compressed import CompressedLines, compress
from .lines import Lines
from .npz import load_lines

Path = TypeVar("Path", bound=str | os.PathLike[str])


def stream(
    paths: Iterable[Path],
    *,
    terms: int = 2,
    read: Callable[[Path], Lines] = load_lines,
    executor: Executor | None = None,
) -> Generator[CompressedLines, None, None]:
    """The compressed lines of each file, in order.

    Files of different frames become one data set by ``concatenate(list(stream(paths)))``, files with chunks
    of points of the same lines by ``functools.reduce(merge, stream(paths, read=chunk))``, with
    ``chunk = functools.partial(load_lines, chunk=True)``.

    Args:
        paths: the files.
        terms: as for `compress`.
        read: reads a file, by default one of `Lines.save`. For an executor of processes it must be a
            function that can be pickled.
        executor: where files are read and compressed, each by a task; None: here. Triangles come back.

    Raises:
        RuntimeError: the executor gave up.
        TypeError: `paths` is one path, whose letters would be files.
        And what `read` and `compress` raise, of the first such file.

    Example:
        >>> import pathlib, tempfile
        >>> import numpy as np
        >>> row = np.stack([np.arange(500.0), np.full(500, 20.0)], axis=-1)
        >>> folder = pathlib.Path(tempfile.mkdtemp())
        >>> for focal in (24, 70):
        ...     lines = Lines.from_ragged([row, row + 1], [0, 0], [focal], image_size=(640, 480))
        ...     lines.save(folder / f"{focal}.npz")
        >>> [float(small.focal[0]) for small in stream(sorted(folder.iterdir()))]
        [24.0, 70.0]
    """
    if isinstance(paths, str | bytes | os.PathLike):
        raise TypeError(f"Argument paths must be a list of files, [first, second], but it is {paths!r}.")
    if executor is None:
        for path in paths:
            yield compress(read(path), terms)
        return
    task = functools.partial(_reduced, terms=terms, read=read)
    with contextlib.closing(
        in_order(checked_executor(executor), task, paths, there=_absolute, file=lambda path: path)
    ) as done:
        for one in done:
            if one.error is not None:
                raise one.error
            assert one.result is not None
            yield arrived(one.result)


def _absolute(path: Any) -> Any:
    """For a worker, which is in another folder; what is no file here may be an address."""
    if not os.path.exists(path):
        return path
    return os.path.abspath(path) if isinstance(path, str) else type(path)(os.path.abspath(path))


def _reduced(path: Path, *, terms: int, read: Callable[[Path], Lines]) -> CompressedLines:
    """In a worker: the triangles, on their way."""
    return sent(compress(read(path), terms))
