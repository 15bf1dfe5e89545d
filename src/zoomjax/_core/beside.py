"""Programs that are compiled in threads, beside what runs before them.

In a new process each program of a fit is traced and compiled before it runs. Tracing holds Python's lock,
and compiling does not: so the programs of a fit are traced one after the other by one thread, and compiled
each by its own, while the fit runs the first of them. On one core that takes as long as ever.
"""

import contextlib
import threading
from collections.abc import Callable, Hashable, Sequence
from typing import Any

Lower = Callable[[], Any]
"""Traces and lowers a program: what it returns has a method ``compile``."""

_BEGUN: dict[Hashable, threading.Event] = {}
"""Of programs that are being compiled, by their functions: set when that is done."""

_HERE = threading.local()


def compile_beside(programs: Sequence[tuple[Hashable, Lower]]) -> None:
    """Begin to compile programs, in this order; an error is left to the call that will meet it again.

    Args:
        programs: for each its function, and what lowers it.
    """
    done = {function: threading.Event() for function, _ in programs}
    _BEGUN.update(done)

    def lower_all():
        _HERE.is_beside = True
        for function, lower in programs:
            lowered = None
            with contextlib.suppress(Exception):
                lowered = lower()
            if not _in_thread(_compile, lowered, done[function]):
                done[function].set()

    if not _in_thread(lower_all):
        for event in done.values():
            event.set()


def _in_thread(function, *args):
    """Call a function in a thread of its own; return whether there is one."""
    try:
        threading.Thread(target=function, args=args).start()
    except RuntimeError:  # there are too many
        return False
    return True


def _compile(lowered, done):
    try:
        if lowered is not None:
            with contextlib.suppress(Exception):
                lowered.compile()
    finally:
        done.set()


def wait_for(function: Hashable) -> None:
    """Wait for a program that is being compiled, which would else be compiled twice."""
    begun = _BEGUN.get(function)
    # What is traced beside may run a program, and it must not wait for itself.
    if begun is not None and not getattr(_HERE, "is_beside", False):
        begun.wait()
        _BEGUN.pop(function, None)
