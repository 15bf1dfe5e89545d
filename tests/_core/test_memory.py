import ctypes
import sys
from pathlib import Path

import pytest

from zoomjax._core import memory


def resident() -> int:
    """Bytes of this process in memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


@pytest.mark.skipif(not hasattr(memory._library(), "malloc_trim"), reason="another C library than glibc")
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="no /proc")
def test_what_is_freed_in_small_pieces_goes_back():
    library = ctypes.CDLL(None)
    library.malloc.restype = ctypes.c_void_p
    library.malloc.argtypes = [ctypes.c_size_t]
    library.free.argtypes = [ctypes.c_void_p]
    pieces = [library.malloc(60_000) for _ in range(4000)]
    for piece in pieces:
        ctypes.memset(piece, 1, 60_000)
    for piece in pieces[:-1]:  # the last one keeps the top of the heap
        library.free(piece)
    held = resident()
    memory.give_back()
    assert resident() < held - 150e6
    library.free(pieces[-1])


def test_where_there_is_no_such_call_nothing_happens(monkeypatch):
    monkeypatch.setattr(memory, "_library", lambda: None)
    memory.give_back()
