"""The end of a command's process: at once, when all is done.

JAX gives back its memory piece by piece, and Python takes apart what it has imported. That takes as long as
importing it, and the system does it in no time.
"""

import atexit
import contextlib
import os
import sys
from collections.abc import Iterator


@contextlib.contextmanager
def ending_at_once() -> Iterator[None]:
    """End the process after its exit handlers, if the block exits with a status. Enter it first of all.

    Of the handlers, that of JAX is left out. What cannot be written to the end, as into a pipe that nobody
    reads any more, is left to Python, which says so.
    """
    status: list[int] = []
    atexit.register(_end, status)  # the first is called last
    try:
        yield
    except SystemExit as exit:
        if isinstance(exit.code, int | None):
            status.append(exit.code or 0)
            if clean_up := getattr(sys.modules.get("jax._src.api"), "clean_up", None):
                atexit.unregister(clean_up)
        raise


def _end(status: list[int]) -> None:
    if status:
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status[0])
