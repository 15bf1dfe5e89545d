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

SEVERAL = """
import contextlib, io, json, os, sys
from zoomjax.app.cli import main
told = []
for folder, words in json.load(sys.stdin):
    os.chdir(folder)
    sys.argv = words
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            main()
            status = 0
        except SystemExit as end:
            status = end.code or 0
    told.append([status, said.getvalue()])
print(json.dumps(told))
"""
"""Run [folder, words] after each other in one process, which compiles what they share once."""
