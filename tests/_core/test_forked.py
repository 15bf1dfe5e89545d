"""Processes forked from a server, or begun anew where there is none."""

import os
import subprocess
import sys

import pytest

PROGRAM = """
from zoomjax._core.forked import import_ahead, process_context

def told(connection):
    import sys
    connection.send("colorsys" in sys.modules)

if __name__ == "__main__":
    import_ahead("colorsys")
    context = process_context()
    ours, theirs = context.Pipe()
    process = context.Process(target=told, args=(theirs,))
    process.start()
    print(context.get_start_method(), ours.recv())
    process.join()
"""


def told(folder, temporary) -> str:
    program = folder / "program.py"
    program.write_text(PROGRAM)
    temporary.mkdir(parents=True)
    own = {**os.environ, "TMPDIR": str(temporary)}
    done = subprocess.run(
        [sys.executable, str(program)], env=own, capture_output=True, text=True, check=True
    )
    assert not done.stderr
    return done.stdout.strip()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere processes are begun anew")
def test_processes_have_what_was_imported_ahead(tmp_path):
    assert told(tmp_path, tmp_path / "t") == "forkserver True"


def test_processes_are_begun_anew_where_there_can_be_no_server(tmp_path):
    assert told(tmp_path, tmp_path / ("a" * 120)) == "spawn False"
