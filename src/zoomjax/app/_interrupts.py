"""Signals that end a run."""

import contextlib
import os
import signal
import sys
from typing import NoReturn

from .._core.files import is_unfinished

INTERRUPTED = 128 + signal.SIGINT  # Typer's exit status for Ctrl-C, too
LAST_WORDS: dict[int, str] = {
    INTERRUPTED: "Interrupted.",
    128 + signal.SIGTERM: "Ended by a signal.",
}


_signals: list[int] = []


def end_run(number: int, _: object) -> NoReturn:
    """Signal handler that ends the run."""
    _signals.append(number)
    if not is_unfinished():  # an exception during the import of JAX can abort the process
        leave(128 + number)
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    sys.exit(128 + number)


def swallowed(unraisable: "sys.UnraisableHookArgs") -> None:
    """Report exceptions that cannot be raised, except those that end the run."""
    if not isinstance(unraisable.exc_value, KeyboardInterrupt | SystemExit):  # those are for `go_on`
        sys.__unraisablehook__(unraisable)


def go_on() -> None:
    """End the run between two steps if the exception of `end_run` was lost, as in callbacks of JAX."""
    if _signals:
        end_run(_signals[0], None)


def leave(status: int) -> NoReturn:
    """Exit at once: a normal exit waits for a compiler thread, and can crash in it."""
    with contextlib.suppress(OSError):
        os.write(2, f"{LAST_WORDS[status]}\n".encode())  # not print: the signal may have interrupted one
    os._exit(status)
