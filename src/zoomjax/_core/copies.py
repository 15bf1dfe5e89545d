"""Copies of files that are elsewhere, and where they are from.

A worker on another machine does not see a copy: it makes its own, under the same path, which is there until
the worker gets a task with another one, or ends.
"""

import atexit
import contextlib
import os
import re
from pathlib import Path
from typing import Any, NamedTuple

from .files import whole_file

_ORIGINS: dict[str, "Origin"] = {}
"""Of the copies that there are, by their whole paths."""

_NAMES: dict[str, str] = {}
"""Of folders of copies, what a URL has in their place; these stay, for messages at the end."""

_MADE: list[str] = []
"""The copy that this process has made as a worker."""


class Origin(NamedTuple):
    """A file elsewhere.

    Attributes:
        system: a file system of fsspec.
        place: the file's name in it.
    """

    system: Any
    place: str


def is_url(text: str) -> bool:
    """Whether a text is a URL, or several that are chained by ``::``."""
    return "://" in text and re.match(r"[A-Za-z][A-Za-z0-9+.-]+(::|://)", text) is not None


def shown_url(url: str) -> str:
    """A URL without a user's name and password."""
    return re.sub(r"(?<=://)[^/@]*@", "", url)


def name_by_url(folder: Path, url: str) -> None:
    """From now on `by_url` puts a URL in the place of a folder."""
    _NAMES[str(folder)] = shown_url(url)


def by_url(text: str) -> str:
    """A text with the URLs of copies in the place of their paths."""
    for folder, url in _NAMES.items():
        text = re.sub(rf"{re.escape(folder)}(?!\w)", lambda _, url=url: url, text)
    return text


def make_copy(origin: Origin, path: Path) -> None:
    """Copy a file, whole or not at all, and remember where it is from."""
    os.makedirs(path.parent, mode=0o700, exist_ok=True)
    with whole_file(path) as part:
        origin.system.get_file(origin.place, str(part))
    _ORIGINS[os.path.abspath(path)] = origin


def origin_of(path: str | os.PathLike[str]) -> Origin | None:
    """Where a file is from, if it is a copy."""
    return _ORIGINS.get(os.path.abspath(path))


def forget(path: str | os.PathLike[str]) -> None:
    """Forget where a copy is from."""
    _ORIGINS.pop(os.path.abspath(path), None)


def have_copy(path: str, origin: Origin) -> None:
    """In a worker: make a copy where there is none, in place of the last one made so."""
    if os.path.exists(path):
        return
    drop_copy()
    make_copy(origin, Path(path))
    _MADE.append(path)


@atexit.register
def drop_copy() -> None:
    """In a worker: remove the copy that was made last, and folders that are empty then."""
    while _MADE:
        path = _MADE.pop()
        forget(path)
        with contextlib.suppress(OSError):
            os.remove(path)
            os.removedirs(os.path.dirname(path))
