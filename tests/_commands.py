"""The command line in a process of its own, as users run it."""

import sys

COMMAND = [sys.executable, "-c", "from zoomjax.app.cli import main; main()"]

# As in a terminal: what runs in the background of a shell inherits that Ctrl-C is ignored.
INTERRUPTIBLE = [
    sys.executable,
    "-c",
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    "from zoomjax.app.cli import main; main()",
]
