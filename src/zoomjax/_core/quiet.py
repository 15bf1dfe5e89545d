"""Silence of libraries that print from compiled code, to the process's streams or to Python's."""

import contextlib
import io
import os
import sys
import threading
from collections.abc import Iterator

_LOCK = threading.Lock()


@contextlib.contextmanager
def silent() -> Iterator[None]:
    """Nothing is printed meanwhile, not even by compiled code; by other threads neither."""
    with _LOCK, contextlib.ExitStack() as stack:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError, AttributeError):  # closed, or no stream
                stream.flush()
        for number in (1, 2):
            try:
                kept = os.dup(number)
            except OSError:  # it is closed
                continue
            stack.callback(os.close, kept)
            stack.callback(os.dup2, kept, number)
            with open(os.devnull, "wb") as nowhere:
                os.dup2(nowhere.fileno(), number)
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            yield
