"""What compiled code prints meanwhile is dropped, or heard, and is printed again afterwards."""

import os
import re
import subprocess
import sys

from zoomjax._core.quiet import heard, silent


def test_compiled_code_is_silent(capfd):
    with silent():
        os.write(1, b"from C\n")
        os.write(2, b"an error from C\n")
        print("from Python")
    os.write(1, b"heard\n")
    os.write(2, b"heard, too\n")
    told = capfd.readouterr()
    assert told.out == "heard\n"
    assert told.err == "heard, too\n"


def test_lines_of_compiled_code_are_heard_and_others_passed_on(capfd):
    with heard(re.compile(rb"from C|more")) as lines:
        os.write(2, b"from C: damage\nof another thread\n")
        os.write(2, b"more\n")
    assert lines == ["from C: damage", "more"]
    os.write(2, b"afterwards\n")
    assert capfd.readouterr().err == "of another thread\nafterwards\n"


def test_nothing_is_heard_where_stderr_is_closed():
    code = (
        "import os, re; from zoomjax._core.quiet import heard; os.close(2)\n"
        "with heard(re.compile(b'')) as lines: pass\nprint(lines)"
    )
    done = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, check=True, text=True)
    assert done.stdout == "[]\n"


def test_nothing_is_heard_where_no_temporary_file_can_be_made(capfd, monkeypatch):
    """Else no photo could be read there."""

    def refuse():
        raise FileNotFoundError("No usable temporary directory found")

    monkeypatch.setattr("zoomjax._core.quiet.tempfile.TemporaryFile", refuse)
    with heard(re.compile(rb"from C")) as lines:
        os.write(2, b"from C\n")
    assert lines == []
    assert capfd.readouterr().err == "from C\n"
