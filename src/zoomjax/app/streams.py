"""Standard streams of a process that was started without them, as by ``2>&-``, or by some services."""

import os
import sys


def open_streams() -> None:
    """Open those that are closed on what leads nowhere. Call it before any file is opened.

    Else a file may get the number of a closed stream, and what libraries print. Python's own streams
    are None without them.
    """
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number)
        except OSError:
            opened = os.open(os.devnull, os.O_RDWR)  # the lowest number that is free: this one
            os.set_inheritable(opened, True)
            if getattr(sys, name) is None:
                setattr(sys, name, os.fdopen(number, mode, closefd=False))
