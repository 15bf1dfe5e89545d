"""Folders of results: files are published together, and replace only files that zoomjax wrote.

The files written are listed in ``.zoomjax.json`` in the same folder, with size and SHA-256. An existing
file that does not match the list belongs to the user: it is replaced only on request, and never removed.

Results are made in a temporary folder inside, then renamed one by one. Before that, the list gets the old
and the new files, so that the next run recognises all files even if this one is killed in between.
"""

import contextlib
import fnmatch
import hashlib
import json
import os
import stat
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path, PurePosixPath

from .._core.arguments import check_flag
from .._core.files import TEMPORARY, locked, place_named, remove_left, removed, undisturbed, unfinished

LIST = ".zoomjax.json"
"""The name of the list."""

OF_A_LENS = (
    *("summary.json", "report.html", "model.png", "lines/*", "before-after.jpg"),
    *("motion.png", "panorama.jpg", "import.json"),
)
"""What commands write about their ``lens.json``: the next one that writes a lens there removes it.

What was measured, lines, tracks and focal lengths, stays.
"""

_LARGEST_LIST = 100_000_000  # bytes

_Prints = list[tuple[int, str]]
"""Sizes and SHA-256 that a file may have: two while results are being replaced."""


@contextlib.contextmanager
def results_folder(
    folder: str | os.PathLike[str],
    names: Iterable[str] = (),
    *,
    clears: Sequence[str] = (),
    overwrite: bool = False,
) -> Iterator[Path]:
    """Yield an empty folder, whose files are moved to `folder` together if the block succeeds.

    `folder` is created if it does not exist, and checked for writing before any work. If the block fails,
    everything is as before.

    Args:
        folder: the folder for the results.
        names: files that will be written, as far as known: relative to `folder`, with slashes.
        clears: patterns of files of an earlier run that are removed unless the block writes them again.
        overwrite: whether to replace files that zoomjax did not write, or that were changed since.

    Raises:
        FileExistsError: such a file exists and `overwrite` is False; or a folder has the name of a file.
        TypeError: `overwrite` is neither True nor False.
        OSError: the folder cannot be created or written; the message names it.
    """
    check_flag("overwrite", overwrite)
    folder = Path(folder)
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    with unfinished(folder):
        try:
            with removed(lambda: _begun(folder)) as part, locked(part):
                with locked(folder, wait=True):  # else another process may be changing the list
                    _check(folder, names, overwrite)
                with place_named(folder):
                    (part / "new").mkdir()
                    yield part / "new"
                    _publish(part, folder, clears, overwrite)
        except BaseException:
            with contextlib.suppress(OSError):  # missing or not empty
                for path in made:
                    path.rmdir()
            raise


def _begun(folder: Path) -> Path:
    """Create the folder, and a temporary one inside."""
    last: OSError | None = None
    for _ in range(5):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            part = Path(tempfile.mkdtemp(dir=folder, prefix=TEMPORARY))
        except OSError as error:
            last = error
            if not isinstance(error, FileNotFoundError):
                break  # else another process that made the folder, too, has just removed it again
        else:
            remove_left(folder)
            return part
    assert last is not None
    raise OSError(f"Cannot write in the folder {folder}: {last.strerror or last}.") from last


def _check(folder: Path, names: Iterable[str], overwrite: bool) -> None:
    """Check that no file of the user would be replaced.

    Raises:
        FileExistsError: as `results_folder`.
    """
    known = _listed(folder)
    paths = {name: folder / name for name in names}
    folders = {path.parent for path in paths.values()} - {folder}
    for path in paths.values():
        if path.is_dir() and not path.is_symlink():
            raise FileExistsError(f"{path} is a folder, but a file must be written: choose another folder.")
    if overwrite:
        return
    foreign = [path for path in sorted(folders) if os.path.lexists(path) and not _is_folder(path)]
    foreign += [
        path
        for name, path in paths.items()
        if path.parent not in foreign
        and os.path.lexists(path)
        and not _is_one(path, (known or {}).get(name))
    ]
    if known is None:
        foreign.append(folder / LIST)
    if foreign:
        more = f" (and {len(foreign) - 1} more)" if len(foreign) > 1 else ""
        raise FileExistsError(
            f"{foreign[0]}{more} would be replaced, but zoomjax did not write it, or it was changed since: "
            "choose another folder, or give argument overwrite."
        )


def _publish(part: Path, folder: Path, clears: Sequence[str], overwrite: bool) -> None:
    """Move the new files into place and remove old ones: all, or after an error none."""
    new = {path.relative_to(part / "new").as_posix(): path for path in sorted(_files(part / "new"))}
    prints = {name: [_print(path)] for name, path in new.items()}
    with locked(folder, wait=True):
        _check(folder, new, overwrite)
        known = _listed(folder) or {}
        stale = [
            name
            for name in known
            if name not in new
            and any(fnmatch.fnmatchcase(name, pattern) for pattern in clears)
            and _is_folder((folder / name).parent)
            and _is_one(folder / name, known[name])
        ]
        after = {name: of for name, of in known.items() if os.path.lexists(folder / name)} | prints
        after = {name: of for name, of in after.items() if name not in stale}
        both = {name: known.get(name, []) + after.get(name, []) for name in (known | after)}
        (part / "both").write_text(_written(both))
        (part / "after").write_text(_written(after))
        with undisturbed(), _Moves(part) as moves:
            moves.put(part / "both", folder / LIST)
            for parent in sorted({(folder / name).parent for name in new} - {folder}):
                moves.make_folder(parent)
            for name, path in new.items():
                moves.put(path, folder / name)
            for name in stale:
                moves.take(folder / name)
            moves.put(part / "after", folder / LIST)
        for parent in {(folder / name).parent for name in stale} - {folder}:
            with contextlib.suppress(OSError):  # unless something else is in it
                parent.rmdir()


class _Moves:
    """Renames that are undone if the block fails. Replaced files are kept in `part` until then."""

    def __init__(self, part: Path):
        self._old = part / "old"
        self._old.mkdir()
        self._undo: list[Callable[[], object]] = []

    def __enter__(self) -> "_Moves":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        while kind is not None and self._undo:
            with contextlib.suppress(OSError):
                self._undo.pop()()

    def put(self, path: Path, target: Path) -> None:
        """Move a file into place. An existing file is replaced without a gap."""
        if os.path.lexists(target):
            kept = self._old / str(len(self._undo))
            try:
                os.link(target, kept, follow_symlinks=False)
            except (OSError, NotImplementedError):  # no hard links
                os.rename(target, kept)
            self._undo.append(lambda: os.replace(kept, target))
            os.replace(path, target)
        else:
            os.replace(path, target)
            self._undo.append(target.unlink)

    def take(self, target: Path) -> None:
        """Move a file or a link away."""
        kept = self._old / str(len(self._undo))
        os.rename(target, kept)
        self._undo.append(lambda: os.replace(kept, target))

    def make_folder(self, target: Path) -> None:
        """Create a folder, in place of a file if there is one."""
        if _is_folder(target):
            return
        if os.path.lexists(target):
            self.take(target)
        target.mkdir()
        self._undo.append(target.rmdir)


def _files(folder: Path) -> Iterator[Path]:
    return (path for path in folder.rglob("*") if not path.is_dir())


def _is_folder(path: Path) -> bool:
    """Whether the path is a folder, and not a link to one."""
    return path.is_dir() and not path.is_symlink()


def _is_one(path: Path, prints: _Prints | None) -> bool:
    """Whether the path is a regular file with the listed content."""
    try:
        state = path.lstat()
        if not prints or not stat.S_ISREG(state.st_mode) or state.st_size not in dict(prints):
            return False
        return _print(path) in prints
    except OSError:
        return False


def _print(path: Path) -> tuple[int, str]:
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        return file.tell(), digest


def _listed(folder: Path) -> dict[str, _Prints] | None:
    """The files in the list; None if the list's file is something else."""
    path = folder / LIST
    if not os.path.lexists(path):
        return {}
    try:
        state = path.lstat()
        if not stat.S_ISREG(state.st_mode) or state.st_size > _LARGEST_LIST:
            return None
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["zoomjax results"] != 1:
            return None
        return {
            name: [(int(size), str(digest)) for size, digest in prints]
            for name, prints in content["files"].items()
            if _is_within(name)
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None


def _is_within(name: str) -> bool:
    """Whether a listed name stays in its folder, at most one level down."""
    path = PurePosixPath(name)
    plain = not path.is_absolute() and ".." not in path.parts and "\\" not in name and ":" not in name
    return plain and "\0" not in name and 1 <= len(path.parts) <= 2


def _written(files: dict[str, _Prints]) -> str:
    return json.dumps({"zoomjax results": 1, "files": files}, indent=1) + "\n"
