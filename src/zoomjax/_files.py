"""Writing files whole or not at all; where what can be made again is kept."""

import contextlib
import errno
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path


def cache_folder(kind: str) -> Path:
    """A folder for what can be made again: in ``ZOOMJAX_CACHE``, else in the user's cache."""
    if named := os.environ.get("ZOOMJAX_CACHE"):
        return Path(named) / kind
    base = os.environ.get("LOCALAPPDATA" if os.name == "nt" else "XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "zoomjax" / kind


@contextlib.contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary path beside `path`, which takes its place only if the block succeeds.

    Raises:
        OSError: the folder does not exist or cannot be written; the message names it.
    """
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, "cannot write a file where there is a folder", str(path))
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
    except OSError as error:
        raise type(error)(
            error.errno, f"cannot write in the folder {path.parent}: {error.strerror}"
        ) from error
    os.close(handle)
    part = Path(name)
    try:
        yield part
        umask = os.umask(0)
        os.umask(umask)
        part.chmod(0o666 & ~umask)  # mkstemp's 0600 is for secrets; a result is an ordinary file
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
