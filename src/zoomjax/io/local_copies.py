"""Files named by URL: copied here before anything else looks at them.

`fsspec` finds and reads them, in object stores, on servers and in archives. What reads URLs of a certain
kind, such as ``s3fs``, is a package of its own, and takes its settings from the environment.
"""

import contextlib
import glob
import itertools
import os
import tempfile
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath
from typing import Any

from .._core.copies import Origin, forget, is_url, make_copy, name_by_url, shown_url
from .._core.text import reason

_AT_ONCE = 8
"""Files that are copied at once, from where that makes sense."""


@contextlib.contextmanager
def local_copies(
    inputs: Iterable[str | os.PathLike[str]],
    *,
    kinds: Sequence[tuple[str, ...]] = (("",),),
    besides: tuple[str, ...] = (),
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Iterator[list[str]]:
    """Copies of what URLs name, for the time of the block.

    Args:
        inputs: paths, and URLs of files, of folders, and of patterns such as ``s3://bucket/shots/*.jpg``.
        kinds: ends of file names: of a folder or pattern, files of the first kind that it has are copied.
            By default all.
        besides: ends of names of files that are copied with them.
        progress: called with the number of files copied, and how many there are.

    Yields:
        The inputs. In place of a URL is the path of its copy, or of a folder with the files of its folder
        or pattern. These are removed after the block.

    Raises:
        ImportError: fsspec is not installed, or the package that it needs for such a URL.
        FileNotFoundError: a URL names nothing.
        OSError: it cannot be read. Of several files, all of them; or two of them would have one name here.

    Warns:
        UserWarning: a file cannot be copied; it is left out.

    Example:
        >>> import pathlib, tempfile
        >>> folder = pathlib.Path(tempfile.mkdtemp())
        >>> _ = (folder / "a.jpg").write_bytes(b"...")
        >>> with local_copies([f"file://{folder}/*.jpg"]) as inputs:
        ...     [path.name for path in pathlib.Path(inputs[0]).iterdir()]
        ['a.jpg']
    """
    given = [os.fspath(one) for one in inputs]
    if not any(map(is_url, given)):
        yield given
        return
    with tempfile.TemporaryDirectory(prefix="zoomjax-", ignore_cleanup_errors=True) as folder:
        files: dict[Path, Origin] = {}
        for number, one in enumerate(given):
            if is_url(one):
                given[number], own = _planned(one, Path(folder) / str(number), kinds, besides)
                files |= own
        _copy(files, progress)
        try:
            yield given
        finally:
            for path in files:
                forget(path)


def _planned(
    url: str, folder: Path, kinds: Sequence[tuple[str, ...]], besides: tuple[str, ...]
) -> tuple[str, dict[Path, Origin]]:
    """What takes the place of a URL, and which files are to be copied where."""
    system, place = _system(url)
    with _told(url):
        if system.exists(place) and not (url.endswith("/") or system.isdir(place)):
            own = _parts(place)[-2:]  # with its folder, whose name is told
            name_by_url(folder, _without(url, len(own)))
            return str(folder.joinpath(*own)), {folder.joinpath(*own): Origin(system, place)}
        if glob.has_magic(_plain(place)) and not system.exists(place):
            folders, found = _divided(system, system.glob(place))
        else:
            folders, found = [place], []
        chosen = _of_a_kind(found, kinds, besides) or _of_a_kind(
            [inner for one in folders for inner in system.find(one)], kinds, besides
        )
    if not chosen:
        raise FileNotFoundError(f"There is nothing to read at {shown_url(url)}.")
    fixed = list(itertools.takewhile(lambda part: not glob.has_magic(part), _parts(place)))
    top = folder / (fixed[-1] if fixed else "all")
    name_by_url(top, _without(url, len(_parts(place)) - len(fixed)))
    own = dict[Path, Origin]()
    for one in chosen:
        other = own.setdefault(path := top.joinpath(*_parts(one)[len(fixed) :]), Origin(system, one)).place
        if other != one:
            raise OSError(
                f"{shown_url(other)} and {shown_url(one)} would have one name here, {path.name}: give the "
                "URL of each by itself."
            )
    return str(top), own


def _without(url: str, number: int) -> str:
    """A URL without so many names at its end; of a file in an archive, that of the archive goes first."""
    first, chain, rest = url.partition("::")
    if chain and "://" not in first:
        return _without(rest, number)
    kept = first.rstrip("/").rsplit("/", number)[0]
    return f"{rest}/{kept.partition('://')[2]}".rstrip("/") if chain else kept


def _divided(system: Any, places: Iterable[str]) -> tuple[list[str], list[str]]:
    """The folders, and the files."""
    both: tuple[list[str], list[str]] = [], []
    for place in places:
        both[not system.isdir(place)].append(place)
    return both


def _of_a_kind(
    places: Sequence[str], kinds: Sequence[tuple[str, ...]], besides: tuple[str, ...]
) -> list[str]:
    """The files of the first kind that there is, and those besides them."""

    def those(ends: tuple[str, ...]) -> list[str]:
        return [place for place in places if _plain(place).lower().endswith(ends)]

    first = next(filter(None, map(those, kinds)), [])
    return [*dict.fromkeys([*first, *those(besides)])] if first else []


def _system(url: str) -> tuple[Any, str]:
    """The file system of a URL, and the place in it."""
    try:
        import fsspec
    except ModuleNotFoundError as error:
        raise ImportError('URLs need fsspec: pip install "zoomjax[cluster]"') from error
    with _told(url):
        return fsspec.core.url_to_fs(url)


@contextlib.contextmanager
def _told(url):
    """Whatever goes wrong elsewhere is an error of the file."""
    try:
        yield
    except ImportError as error:
        raise ImportError(f"{shown_url(url)} cannot be read: {reason(error)}") from error
    except Exception as error:  # of any package
        raise OSError(f"{shown_url(url)} cannot be read: {reason(error)}") from error


def _plain(place: str) -> str:
    """A place without the query of a server's URL."""
    return place.partition("?")[0] if place.startswith(("http://", "https://")) else place


def _parts(place: str) -> list[str]:
    """The names on the way to a place, none of which leads elsewhere."""
    return [part for part in PurePosixPath(_plain(place)).parts if part not in ("/", "..")]


def _copy(files: dict[Path, Origin], progress: Callable[[int, int], None]) -> None:
    """Copy all; a warning of those that cannot be, and an error if none can."""

    def copied(path: Path) -> Exception | None:
        try:
            make_copy(files[path], path)
        except Exception as error:  # of any package
            return error
        return None

    at_once = _AT_ONCE if all(of.system.async_impl for of in files.values()) else 1
    problems: list[str] = []
    with ThreadPoolExecutor(at_once) as pool:
        for done, (path, error) in enumerate(zip(files, pool.map(copied, files), strict=True), start=1):
            if error is not None:
                problems.append(f"{shown_url(files[path].place)} cannot be copied: {reason(error)}")
            progress(done, len(files))
    if len(problems) == len(files):
        raise OSError(problems[0])
    for problem in problems:
        warnings.warn(f"{problem.rstrip('.')}. It is left out.", stacklevel=4)
