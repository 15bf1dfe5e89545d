"""Memory that is free goes back to the system."""

import ctypes


def give_back() -> None:
    """Return what has been freed, where the C library keeps it and has a call for that (glibc).

    A compiler frees hundreds of megabytes in small pieces, which stay with the process otherwise.
    """
    trim = getattr(_library(), "malloc_trim", None)
    if trim is not None:
        trim(0)


def _library() -> ctypes.CDLL | None:
    """The process itself, with the C library; None where it has no such name (Windows)."""
    try:
        return ctypes.CDLL(None)
    except (OSError, TypeError):
        return None
