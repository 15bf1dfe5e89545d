"""Writing of files completely or not at all, and the folder of caches.

Until it is complete, a file has a temporary name, ``.zoomjax-*``, in its folder. A run that is killed
leaves it there, and the next one removes it. A lock shows whether a process still uses it; the operating
system releases the lock when the process ends.
"""

import contextlib
import errno
import functools
import os
import re
import shutil
import signal
import stat
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import FrameType

import platformdirs

try:
    import fcntl
except ModuleNotFoundError:  # Windows
    fcntl = None

TEMPORARY = ".zoomjax-"
"""How temporary names begin."""

_LEFT = re.compile(re.escape(TEMPORARY) + r"[a-z0-9_]{8}(\.part)?")
_FRESH = 60.0  # s, that a process has to lock what it made
_OLD = 7 * 86400.0  # s, after which what cannot be locked counts as left


def cache_folder(kind: str) -> Path | None:
    """A folder for caches: in ``ZOOMJAX_CACHE``, else in the user's cache.

    None if there is no home folder: never a folder that others can write to.
    """
    if named := os.environ.get("ZOOMJAX_CACHE"):
        return Path(named) / kind
    try:
        folder = platformdirs.user_cache_path("zoomjax", appauthor=False)
    except RuntimeError:
        return None
    return folder / kind if folder.is_absolute() else None


_unfinished: list[Path] = []


@contextlib.contextmanager
def unfinished(path: Path) -> Iterator[None]:
    """While the block runs, something is there that it must remove again."""
    _unfinished.append(path)
    try:
        yield
    finally:
        _unfinished.remove(path)


def is_unfinished() -> bool:
    """Whether anything is: if not, a process may be left at once."""
    return bool(_unfinished)


@contextlib.contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path next to `path`, which replaces it only if the block succeeds.

    A link to a file is replaced, and not followed.

    Raises:
        OSError: the folder does not exist or cannot be written, or `path` is not a regular file; the
        message
            names it.
    """
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, "cannot write a file where there is a folder", str(path))
    if path.exists() and not path.is_file():
        raise FileExistsError(errno.EEXIST, "cannot write a file in place of a device", str(path))
    _remove_left_once(path.parent.absolute())
    with unfinished(path), removed(lambda: _file_beside(path)) as part:
        with locked(part), place_named(path):
            yield part
        umask = os.umask(0)
        os.umask(umask)
        part.chmod(0o666 & ~umask)  # mkstemp's 0600 is for secrets; a result is an ordinary file
        part.replace(path)


@contextlib.contextmanager
def whole_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary folder, whose files go to the folder `path` only if the block succeeds.

    The folder is made if it is not there. Files of the same names in it are replaced, others stay.

    Raises:
        OSError: `path` is a file, or its parent does not exist or cannot be written; the message names it.
    """
    path = Path(path)
    if path.exists() and not path.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, "cannot make a folder where there is a file", str(path))
    _remove_left_once(path.parent.absolute())
    with unfinished(path), removed(lambda: _folder_beside(path)) as part:
        with locked(part), place_named(path):
            yield part
        path.mkdir(exist_ok=True)
        for file in sorted(part.iterdir()):
            if (path / file.name).is_dir():
                raise IsADirectoryError(
                    errno.EISDIR, "cannot write a file where there is a folder", str(path / file.name)
                )
        for file in sorted(part.iterdir()):
            file.replace(path / file.name)


@contextlib.contextmanager
def removed(make: Callable[[], Path]) -> Iterator[Path]:
    """Yield the temporary file or folder that `make` makes, and remove what is left of it in the end.

    No signal comes between: it would leave something behind that no `finally` knows of yet.
    """
    part: Path | None = None
    try:
        with undisturbed():
            part = make()
        yield part
    finally:
        if part is not None:
            with undisturbed():
                _remove(part)


def _remove(part: Path) -> None:
    if part.is_dir():
        shutil.rmtree(part, ignore_errors=True)
    else:
        part.unlink(missing_ok=True)


def _file_beside(path: Path) -> Path:
    with _told(path.parent):
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=TEMPORARY, suffix=".part")
    os.close(handle)
    return Path(name)


def _folder_beside(path: Path) -> Path:
    with _told(path.parent):
        return Path(tempfile.mkdtemp(dir=path.parent, prefix=TEMPORARY))


@contextlib.contextmanager
def _told(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise type(error)(error.errno, f"cannot write in the folder {folder}: {error.strerror}") from error


@contextlib.contextmanager
def place_named(path: Path) -> Iterator[None]:
    """Errors of a full disk name what could not be written: the system does not."""
    try:
        yield
    except OSError as error:
        if error.errno not in _FULL or TEMPORARY not in str(error.filename or TEMPORARY):
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


_FULL = {errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC)}


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Delay signals that end a run until the (short) block is done."""
    if threading.current_thread() is not threading.main_thread():  # only the main thread handles signals
        yield
        return
    came: list[tuple[signal.Signals, FrameType | None]] = []
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    handlers = {number: handler for number, handler in handlers.items() if callable(handler)}
    try:
        for number in handlers:
            signal.signal(number, lambda number, frame: came.append((signal.Signals(number), frame)))
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for number, frame in came[:1]:
            handlers[number](number, frame)


def settled(path: Path) -> Path:
    """The path, without what changes its meaning as folders are made.

    While ``new`` is not there, nothing is found at ``new/../a``; once it is made, that is ``a``.
    """
    last_is_name = path.name != ".."
    folder = path.parent if last_is_name else path
    if ".." not in folder.parts or folder.exists():
        return path
    folder = Path(os.path.realpath(folder))
    return folder / path.name if last_is_name else folder


def refuse_existing(targets: Iterable[Path], *, overwrite: bool) -> None:
    """Refuse to replace existing files: to be called before any work.

    A link counts as an existing file, even if broken.

    Raises:
        FileExistsError: one of `targets` exists, and `overwrite` is False.
    """
    there = [] if overwrite else [path for path in dict.fromkeys(targets) if os.path.lexists(settled(path))]
    if there:
        raise FileExistsError(
            f"{_several(there)} and would be replaced: choose another place, or give argument overwrite."
        )


def refuse_inputs(targets: Iterable[Path], inputs: Iterable[str | os.PathLike[str]]) -> None:
    """Refuse to write to a file that is read, whatever it is called: through links, ``..`` or upper case.

    Raises:
        ValueError: one of `targets` is one of `inputs`.
    """
    read = {}
    for path in inputs:
        with contextlib.suppress(OSError):
            about = os.stat(path)
            read[about.st_dev, about.st_ino] = path
    for target in targets:
        with contextlib.suppress(OSError):
            about = os.stat(settled(target))
            if (same := read.get((about.st_dev, about.st_ino))) is not None:
                what = "" if os.fspath(same) == str(target) else f" {os.fspath(same)}"
                raise ValueError(f"The output {target} is the input{what}. Choose another place.")


def refuse_links(folder: Path, targets: Iterable[Path]) -> None:
    """Refuse to write through a link or ``..`` within a folder of results: it may lead out of it.

    The folder itself may be a link, as may be what it lies in.

    Raises:
        ValueError: a folder between `folder` and one of `targets` is a link, or ``..``.
    """
    targets = list(targets)
    for target in targets:
        if folder in target.parents and ".." in target.relative_to(folder).parts:
            raise ValueError(f"The output {target} is not in the folder {folder}. Choose another place.")
    between = {parent for target in targets for parent in target.parents if folder in parent.parents}
    for parent in sorted(between):
        if parent.is_symlink():
            raise ValueError(
                f"The folder {parent} is a link, and results are written into {folder} alone. Remove the "
                "link, or choose another place."
            )


def _several(paths: list[Path]) -> str:
    """That these paths exist: the first, and the number of others."""
    more = len(paths) - 1
    if not more:
        return f"{paths[0]} already exists"
    return f"{paths[0]} and {more} more {'file' if more == 1 else 'files'} already exist"


@contextlib.contextmanager
def locked(path: Path, *, wait: bool = False) -> Iterator[None]:
    """Lock a file or folder, if need be after a `wait`; some network file systems have no locks."""
    with contextlib.ExitStack() as stack:
        if fcntl:
            with contextlib.suppress(OSError):
                handle = os.open(path, os.O_RDONLY)
                stack.callback(os.close, handle)
                fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        yield


def remove_left(folder: Path) -> None:
    """Remove what runs that were killed left in a folder; what is in use, or not of zoomjax, stays."""
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if name := _LEFT.fullmatch(entry.name):
                with contextlib.suppress(OSError):
                    _remove_if_left(Path(entry.path), is_file=bool(name[1]))


_remove_left_once = functools.lru_cache(maxsize=64)(remove_left)


def _remove_if_left(path: Path, *, is_file: bool) -> None:
    state = path.lstat()
    if not (stat.S_ISREG if is_file else stat.S_ISDIR)(state.st_mode):
        return
    age = time.time() - state.st_mtime
    if age < (_FRESH if fcntl else _OLD):
        return
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW) if fcntl else None
    try:
        if fcntl and handle is not None:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)  # else somebody uses it
        if is_file:
            path.unlink()
        else:
            shutil.rmtree(path, ignore_errors=True)
    finally:
        if handle is not None:
            os.close(handle)
