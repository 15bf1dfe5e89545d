"""Libraries that print from compiled code, to the process's streams or to Python's: silent, or heard."""

import contextlib
import io
import os
import re
import sys
import tempfile
import threading
from collections.abc import Generator, Iterator

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


@contextlib.contextmanager
def heard(ours: re.Pattern[bytes]) -> Generator[list[str], None, None]:
    """Lines that compiled code prints on stderr meanwhile and that begin like ours; there when it ends.

    They are not printed then. Others are, such as those of other threads. Nothing is heard where stderr is
    closed, or where no temporary file can be made.
    """
    lines: list[str] = []
    with _LOCK, contextlib.ExitStack() as stack:
        try:
            kept = os.dup(2)
            stack.callback(os.close, kept)
            file = stack.enter_context(tempfile.TemporaryFile())
        except OSError:  # it is closed, or nothing can be written anywhere
            file = kept = None
        if file is None or kept is None:
            yield lines
            return
        with contextlib.suppress(OSError, ValueError, AttributeError):
            sys.stderr.flush()
        os.dup2(file.fileno(), 2)
        try:
            yield lines
        finally:
            os.dup2(kept, 2)
            file.seek(0)
            for line in file.read().splitlines(keepends=True):
                if ours.match(line):
                    lines.append(line.decode("utf-8", "replace").strip())
                else:
                    os.write(2, line)
