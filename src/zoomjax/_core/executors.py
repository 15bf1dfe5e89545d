"""Work on any executor of `concurrent.futures`: handed over ahead, its results in the order of the work.

A task runs where the executor puts it, perhaps on another machine. It computes in the precision that is set
here, and its warnings are told here. Arrays of JAX go there as NumPy's, for they are cut to float32 where
they are unpacked without float64.
"""

import collections
import contextlib
import dataclasses
import functools
import hashlib
import os
import platform
import stat
import threading
import warnings
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from typing import Any, Generic, NamedTuple, TypeVar

import jax
import numpy as np

from .arrays import widest
from .copies import Origin, have_copy, origin_of
from .text import reason

_MOST_AHEAD = 4096
"""Tasks that are handed over before the first of them is done: some for each of a thousand workers."""

_END = 2**16
"""Bytes at both ends of a file by which it is known."""

_MOST_BYTES = 2**29
"""What these hold together: pixels of a clip that is decoded here, or packets that come back."""

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclasses.dataclass(frozen=True)
class Done(Generic[Item, Result]):
    """What became of an item: the task's result, or its error, of which the other is None."""

    item: Item
    result: Result | None
    error: Exception | None

    def told(self) -> str:
        """What the error says, and of what kind it is."""
        assert self.error is not None
        return f"{type(self.error).__name__}: {reason(self.error).rstrip('.')}"


def checked_executor(executor: Any) -> Executor:
    """Refuse what is no executor.

    Raises:
        TypeError: it is something else, such as a client of Dask.
    """
    if isinstance(executor, Executor):
        return executor
    raise TypeError(
        "Argument executor must be an executor of concurrent.futures, such as ProcessPoolExecutor(4) or "
        f"Dask's client.get_executor(), but its type is {type(executor).__name__}."
    )


def in_order(
    executor: Executor,
    task: Callable[[Item], Result],
    items: Iterable[Item],
    *,
    size: Callable[[Item], int] = lambda item: 0,
    there: Callable[[Item], Item] = lambda item: item,
    file: Callable[[Item], str | os.PathLike[str] | None] = lambda item: None,
) -> Generator[Done[Item, Result], None, None]:
    """``task(item)`` of each item, in their order. Closing the generator cancels what has not begun.

    Args:
        executor: where tasks run; it stays open.
        task: a function that can be pickled, as can items and results.
        items: taken as they are handed over, at most some thousands ahead.
        size: bytes that an item takes until it is done.
        there: makes of an item what the task is given: whole paths, as workers are in other folders.
        file: what the task reads, if it is a file: a worker where it has another size, or others of the
            bytes at its ends, does not run it, and
            one that does not see it makes a copy, if it is one (`copies`).

    Raises:
        RuntimeError: the executor gave up, as a process pool does when one of its processes dies.
    """
    away = functools.partial(_away, task, _here(), jax.config.jax_enable_x64)  # pyright: ignore
    pending: collections.deque[tuple[Item, Future]] = collections.deque()
    told: set[str] = set()
    held = 0

    def first() -> Done[Item, Result]:
        nonlocal held
        item, future = pending.popleft()
        held -= size(item)
        try:
            result, messages = future.result()
        except (BrokenExecutor, CancelledError) as error:
            raise _gave_up(error) from error
        except Exception as error:
            return Done(item, None, error)
        for text, kind in messages:
            if text not in told:
                told.add(text)
                warnings.warn(text, kind, stacklevel=4)
        return Done(item, result, None)

    try:
        for item in items:
            while pending and (len(pending) >= _MOST_AHEAD or held + size(item) > _MOST_BYTES):
                yield first()
            try:
                future = executor.submit(functools.partial(away, file=_seen(file(item))), there(item))
            except BrokenExecutor as error:
                raise _gave_up(error) from error
            pending.append((item, future))
            held += size(item)
            while pending and pending[0][1].done():
                yield first()
        while pending:
            yield first()
    finally:
        for _, future in pending:
            future.cancel()


class _Seen(NamedTuple):
    """A file's whole path, its size and its ends as they are here, and where it is from if it is a copy."""

    path: str
    size: int
    ends: bytes
    origin: Origin | None


def _seen(file: str | os.PathLike[str] | None) -> _Seen | None:
    """None where there is no file."""
    with contextlib.suppress(OSError):
        if file is not None:
            size, ends = _size_and_ends(file)
            return _Seen(os.path.abspath(file), size, ends, origin_of(file))
    return None


def _size_and_ends(file: str | os.PathLike[str]) -> tuple[int, bytes]:
    """The size of a file, and a checksum of its first and last bytes; of a pipe nothing is read."""
    found = os.stat(file)
    if not stat.S_ISREG(found.st_mode):
        return found.st_size, b""
    with open(file, "rb") as content:
        ends = content.read(_END)
        content.seek(max(found.st_size - _END, 0))
        ends += content.read(_END)
    return found.st_size, hashlib.blake2b(ends, digest_size=16).digest()


def _check_same(file: _Seen | None) -> None:
    """In a worker: raise ValueError where a file is another one than where the work comes from."""
    found = file and _seen(file.path)
    if file and found and found.size != file.size:
        raise ValueError(
            f"the worker on {platform.node()} sees another file {file.path}, of {found.size} bytes instead "
            f"of {file.size}: workers must see the same files"
        )
    if file and found and found.ends != file.ends:
        raise ValueError(
            f"the worker on {platform.node()} sees another file {file.path}, of the same size: workers "
            "must see the same files"
        )


def _gave_up(error: Exception) -> RuntimeError:
    told = reason(error).rstrip(".")
    return RuntimeError(
        f"The executor gave up ({type(error).__name__}{': ' * bool(told)}{told}). Begin again with a new "
        "one. A cluster of Dask goes on when a worker dies; a process pool does not."
    )


Tree = TypeVar("Tree")


@dataclasses.dataclass(frozen=True)
class _Sent:
    """An array of JAX on its way."""

    array: np.ndarray


def sent(tree: Tree) -> Tree:
    """A pytree for a task, in which it is `arrived` again."""
    return jax.tree.map(lambda leaf: _Sent(np.asarray(leaf)) if isinstance(leaf, jax.Array) else leaf, tree)


def arrived(tree: Tree) -> Tree:
    """What was `sent`, with the arrays of JAX that it had."""
    return jax.tree.map(lambda leaf: jax.device_put(leaf.array) if isinstance(leaf, _Sent) else leaf, tree)


def is_away() -> bool:
    """Whether this is a task in a process of its own, or on another machine."""
    return getattr(_own, "away", False)


_own = threading.local()


def _here() -> tuple[str, int]:
    return platform.node(), os.getpid()


def _away(
    task: Callable[[Any], Any],
    home: tuple[str, int],
    wide: bool,
    item: Any,
    *,
    file: _Seen | None,
) -> tuple[Any, list[tuple[str, type[Warning]]]]:
    """In a worker: the result of a task, and its warnings, where nobody would see them."""
    with widest(wide):
        if _here() == home:
            return task(item), []
        if file and file.origin:
            have_copy(file.path, file.origin)
        _check_same(file)
        _own.away, _own.told = True, []
        _listen()
        try:
            return task(item), _own.told
        finally:
            _own.away, _own.told = False, None


@functools.cache
def _listen() -> None:
    """From now on, keep warnings of threads that run a task."""
    show = warnings.showwarning

    def keep(message, category, *where, **more) -> None:
        told = getattr(_own, "told", None)
        if told is None:
            show(message, category, *where, **more)
        else:
            told.append((str(message), category))

    warnings.showwarning = keep
