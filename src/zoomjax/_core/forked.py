"""Processes forked from one that has imported what they need: it is imported once, and while others work.

A process that computes with JAX has threads, and must not be forked. So a server is begun that only
imports, and forks from there (`multiprocessing`'s). Linux alone: elsewhere libraries of the system do not
stand it, and processes are begun anew.
"""

import atexit
import contextlib
import multiprocessing
import os
import signal
import sys
from multiprocessing import forkserver
from typing import Any


def import_ahead(module: str) -> None:
    """Begin to import a module for processes that `process_context` will begin: for programs of ours alone.

    It does not wait. The server ends with this process. Where it cannot begin, as without a folder for
    temporary files whose path is short enough for a socket, processes are begun anew.
    """
    if sys.platform != "linux" or _SERVED:
        return
    multiprocessing.set_forkserver_preload([module])
    held = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # Ctrl-C is for this process
    try:
        forkserver.ensure_running()
    except OSError:
        return
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, held)
    _SERVED.append(module)
    atexit.register(_end)


def process_context() -> Any:
    """How processes are begun: forked after `import_ahead`, else anew."""
    return multiprocessing.get_context("forkserver" if _SERVED else "spawn")


def _end() -> None:
    """End the server, which would take its time, and wait for it, so that its time counts as ours."""
    server: Any = forkserver
    with contextlib.suppress(ProcessLookupError, TypeError):
        os.kill(server._forkserver._forkserver_pid, signal.SIGKILL)
    server._forkserver._stop()


_SERVED: list[str] = []
