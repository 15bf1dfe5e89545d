"""The command line in a process of its own, as users run it."""

import json
import subprocess
import sys

from zoomjax.app.results_folder import results_folder

COMMAND = [sys.executable, "-c", "from zoomjax.app.cli import main; main()"]

# As in a terminal: what runs in the background of a shell inherits that Ctrl-C is ignored.
INTERRUPTIBLE = [
    sys.executable,
    "-c",
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    "from zoomjax.app.cli import main; main()",
]

DATA = {"lines.npz", "tracks.npz", "track.csv"}
ABOUT = {
    *("summary.json", "report.html", "model.png", "lines/0001-a.jpg", "before-after.jpg"),
    *("motion.png", "panorama.jpg", "import.json"),
}


def write_earlier(folder):
    """Results of commands of all kinds, one after the other: of which none is about the next lens."""
    with results_folder(folder) as part:
        (part / "lines").mkdir()
        for name in ("lens.json", *DATA, *ABOUT):
            (part / name).write_text("earlier")


def still_earlier(folder):
    """Which of them are left."""
    found = [path for path in folder.rglob("*") if path.is_file() and path.read_bytes() == b"earlier"]
    return {path.relative_to(folder).as_posix() for path in found}


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


def one_after_another(folder, commands):
    """Status and output of commands, given as words, run in a folder after each other in one process."""
    done = subprocess.run(
        [sys.executable, "-c", SEVERAL],
        input=json.dumps([(str(folder), ["zoomjax", *map(str, words)]) for words in commands]),
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    return [tuple(told) for told in json.loads(done.stdout.splitlines()[-1])]
