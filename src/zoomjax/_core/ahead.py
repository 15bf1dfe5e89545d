"""Programs that are read from disk before they are asked for, in a thread.

A calibration runs many programs, one after the other, and each takes its time to be read. Which they are
depends on its data, and is known when all photos have been searched for lines. But mostly they are those
of the last time. So a list of these is kept beside the programs, and they are read in the meantime.
"""

import contextlib
import hashlib
import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from .files import whole_file
from .kept import Key, opened, store
from .programs import all_settings

_MOST = 500
"""Programs of a list."""

_LINE = re.compile(r"([0-9a-f]{64}) (\d)")


@contextlib.contextmanager
def programs_ahead(occasion: str) -> Iterator[bool]:
    """Read the programs that were used on such an occasion the last time; note those of this time.

    The thread ends with the block, and they are noted if it ends well.

    Yields:
        Whether none are known of such an occasion, and those of this time will be noted.
    """
    kept = store()
    if kept.folder is None:
        yield False
        return
    file = kept.folder / f"{hashlib.sha256(occasion.encode()).hexdigest()}.used"
    begun = set(kept.used)
    with ThreadPoolExecutor(1, "programs") as pool:
        kept.ahead.update({key: pool.submit(opened, *key, ahead=True) for key in _listed(file)})
        try:
            yield not kept.ahead
        finally:
            kept.ahead.clear()
            pool.shutdown(cancel_futures=True)
    _note(file, [key for key in kept.used if key not in begun])


def _listed(file: Path) -> list[Key]:
    """The programs of a list; none where it is damaged, or from another version."""
    kinds = all_settings()
    try:
        lines = file.read_text().split("\n", _MOST)[:_MOST]
    except (OSError, ValueError):
        return []
    found = [_LINE.fullmatch(line) for line in lines]
    return [(of[1], kinds[int(of[2])]) for of in found if of and int(of[2]) < len(kinds)]


def _note(file: Path, used: list[Key]) -> None:
    kinds = all_settings()
    lines = [f"{name} {kinds.index(settings)}\n" for name, settings in used if settings in kinds]
    with contextlib.suppress(OSError), whole_file(file) as part:
        part.write_text("".join(lines))
