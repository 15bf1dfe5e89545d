"""Nothing is printed by compiled code meanwhile, and everything afterwards."""

import os

from zoomjax._core.quiet import silent


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
