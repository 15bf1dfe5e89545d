"""A process that is started without standard streams."""

import shlex
import subprocess
import sys

import pytest


@pytest.mark.skipif(sys.platform == "win32", reason="its shell closes no streams")
@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&-", "<&- >&- 2>&-"])
def test_a_closed_stream_is_like_one_that_leads_nowhere(closed):
    command = f"{shlex.join([sys.executable, '-m', 'zoomjax', 'formats'])} {closed}"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    assert ("colmap" in done.stdout) == (">&-" not in closed.split())


@pytest.mark.skipif(sys.platform == "win32", reason="its shell closes no streams")
def test_no_file_gets_the_number_of_a_closed_stream():
    program = (
        "import os; from zoomjax.app.streams import open_streams; open_streams(); "
        "os.write(3, str(os.open(os.devnull, os.O_RDONLY)).encode())"
    )
    command = f"{shlex.join([sys.executable, '-c', program])} 3>&1 <&- >&- 2>&-"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, timeout=60)
    assert int(done.stdout) > 3
