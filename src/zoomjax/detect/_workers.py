"""Processes for one task at a time: a crash, a hang or a lack of memory costs one task only.

Decoders are C code, and files are not trusted. `concurrent.futures` gives up at the first process that dies
and has no time limit. Pools whose processes share a pipe and its locks (pebble's) can wait for ever for a
lock whose holder died. Here each process has its own pipe, and a thread that waits for it.
"""

import concurrent.futures
import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

import cv2

from .._core.forked import process_context

_STARTS = 3
"""Tries to begin a process: another's want of memory may end one, a program that cannot run ends all."""

_START_SECONDS = 120.0


class LostError(Exception):
    """A task's process has died twice, or took too long; the message says which."""


class Workers:
    """Processes, begun with their first items, and ended with the block that they serve."""

    def __init__(self, task: Callable[[Any], Any], number: int, seconds: float):
        """Set the task, the largest number of processes, and the time limit per item.

        Task, items and results are sent as pickles.
        """
        self._task, self._seconds = task, seconds
        self._threads = concurrent.futures.ThreadPoolExecutor(number, "worker", _leave_interrupts)
        self._own = threading.local()
        self._lock, self._closed = threading.Lock(), False
        self._processes: set[BaseProcess] = set()

    def submit(self, item: Any) -> concurrent.futures.Future:
        """A future of ``task(item)``, computed in a process.

        It raises `LostError` if the process dies or takes too long, `RuntimeError` if none can be started.
        """
        return self._threads.submit(self._do, item)

    def __enter__(self) -> "Workers":
        return self

    def __exit__(self, *_) -> None:
        with self._lock:
            self._closed = True
            for process in self._processes:
                process.kill()
        self._threads.shutdown(cancel_futures=True)
        for process in self._processes:
            process.join()
            process.close()

    def _do(self, item: Any) -> Any:
        """In a thread: the result from this thread's process, or from a new one if it dies.

        A process may be killed because another took the memory, so a task is tried twice.
        """
        for last in (False, True):
            connection = self._connection()
            try:
                connection.send(item)
                if not connection.poll(self._seconds):
                    raise LostError(f"detection took more than {self._seconds:.0f} s")
                return connection.recv()
            except (EOFError, OSError) as error:
                code = self._discard()
                if last:
                    raise LostError(f"the detection process ended {_how(code)}") from error
            except BaseException:
                self._discard()
                raise
        raise AssertionError

    def _connection(self) -> Connection:
        """The connection to this thread's process, started and ready."""
        if getattr(self._own, "process", None) is not None:
            return self._own.connection
        for _ in range(_STARTS):
            connection = self._begun()
            with contextlib.suppress(EOFError, OSError):
                if connection.poll(_START_SECONDS) and connection.recv():
                    return connection
            self._discard()
        raise RuntimeError(
            "A detection process cannot be started, perhaps because memory is short. Try again with fewer "
            "processes."
        )

    def _begun(self) -> Connection:
        context = process_context()
        connection, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(theirs, self._task, self._seconds), daemon=True)
        with self._lock:
            if self._closed:
                raise LostError("detection was cancelled")
            process.start()
            self._processes.add(process)
        theirs.close()  # so that its end is seen here when the process ends
        self._own.process, self._own.connection = process, connection
        return connection

    def _discard(self) -> int | None:
        """End this thread's process, and return its exit code."""
        process, self._own.process = self._own.process, None
        self._own.connection.close()
        process.join(1.0)  # it may be dying: its own exit code tells more than that of the kill
        with self._lock:
            if self._closed:
                return None
            self._processes.remove(process)
        process.kill()
        process.join()
        code = process.exitcode
        process.close()
        return code


def _leave_interrupts() -> None:
    """Ctrl-C is for the main thread; processes that this thread begins never see it."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})


def _how(code: int | None) -> str:
    if code is None or code >= 0:
        return f"with exit status {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    return f"by {name}: the image is damaged, or takes too much memory"


def _serve(connection: Connection, task: Callable[[Any], Any], seconds: float) -> None:
    """The loop of a process: do tasks until there are no more items or the other end is closed."""
    _confine()
    connection.send(True)
    while True:
        try:
            item = connection.recv()
        except EOFError:
            return
        if hasattr(signal, "alarm"):  # ends this process even if nobody is left to do so
            signal.alarm(int(seconds) + 10)
        connection.send(task(item))
        if hasattr(signal, "alarm"):
            signal.alarm(0)


def _confine() -> None:
    """Restrict this process: one core, half of the memory, no core dumps, no terminal output.

    Messages of decoders do not name the file, so they are dropped. On Linux this process is the first to be
    killed when memory runs out.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
    with contextlib.suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    if sys.platform != "linux":
        return
    import resource

    resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))
    page = os.sysconf("SC_PAGE_SIZE")
    with contextlib.suppress(OSError, ValueError):
        with open("/proc/self/statm") as file:
            held = int(file.read().split()[0]) * page  # libraries reserve addresses that they never use
        most, hard = (
            held + os.sysconf("SC_PHYS_PAGES") * page // 2,
            resource.getrlimit(resource.RLIMIT_AS)[1],
        )
        if hard == resource.RLIM_INFINITY or most < hard:
            resource.setrlimit(resource.RLIMIT_AS, (most, hard))
    with contextlib.suppress(OSError), open("/proc/self/oom_score_adj", "w") as file:
        file.write("1000")
