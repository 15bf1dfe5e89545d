"""A command's process ends at once, and loses nothing by it."""

import subprocess
import sys

import pytest

_PROGRAM = """
import atexit, sys
from zoomjax.app.ending import ending_at_once

atexit.register(print, "handler of Python's end")
with ending_at_once():
    atexit.register(print, "handler of the command")
    print("done")
    {end}
"""


def ended(end, **how):
    return subprocess.run(
        [sys.executable, "-c", _PROGRAM.format(end=end)], capture_output=True, text=True, timeout=60, **how
    )


@pytest.mark.parametrize(
    ("end", "status"), [("sys.exit()", 0), ("sys.exit(0)", 0), ("sys.exit(2)", 2), ("raise SystemExit", 0)]
)
def test_handlers_run_and_what_was_printed_is_written(end, status):
    done = ended(end)
    assert (done.returncode, done.stdout) == (status, "done\nhandler of the command\n")


@pytest.mark.parametrize("end", ["sys.exit('a sentence')", "raise ValueError('a sentence')", "pass"])
def test_every_other_end_is_that_of_python(end):
    done = ended(end)
    assert done.returncode == (0 if end == "pass" else 1)
    assert done.stdout == "done\nhandler of the command\nhandler of Python's end\n"
    assert ("a sentence" in done.stderr) == (end != "pass")


@pytest.mark.skipif(sys.platform != "linux", reason="there is no full device")
def test_what_cannot_be_written_is_no_success():
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-c", _PROGRAM.format(end="sys.exit()")], stdout=full, stderr=subprocess.PIPE
        )
    assert done.returncode
    assert b"No space left" in done.stderr


def test_jax_is_not_taken_apart():
    done = ended("import jax; jax._src.api.clear_backends = lambda: print('taken apart'); sys.exit()")
    assert done.stdout == "done\nhandler of the command\n"
