"""Signals that end a run, and how it ends."""

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
    """End a run by a signal: a handler."""
    _signals.append(number)
    if not is_unfinished():  # an exception in the midst of importing JAX can abort the process
        leave(128 + number)
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    sys.exit(128 + number)


def swallowed(unraisable: "sys.UnraisableHookArgs") -> None:
    """Tell of exceptions that cannot be raised, unless it is a run's end."""
    if not isinstance(unraisable.exc_value, KeyboardInterrupt | SystemExit):  # those are for `go_on`
        sys.__unraisablehook__(unraisable)


def go_on() -> None:
    """Between two steps: end after all if what `end_run` raised was swallowed, as in callbacks of JAX."""
    if _signals:
        end_run(_signals[0], None)


def leave(status: int) -> NoReturn:
    """At once: the usual way out waits for a compiler thread, and can crash in it."""
    with contextlib.suppress(OSError):
        os.write(2, f"{LAST_WORDS[status]}\n".encode())  # a handler may be within print
    os._exit(status)
