"""The verdict on a calibration from photos: that of the fit, and what the photos say about themselves."""

from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from .._core.text import plain
from ..trust.assessment import Finding
from .equipment import equipment_of

_LISTED = 4


def findings_of_photos(photos: Iterable[Path]) -> list[Finding]:
    """What speaks against one lens having taken all photos: different bodies or lenses in their EXIF data.

    Photos that name no camera or lens, or that cannot be read any more, say nothing.
    """
    bodies, lenses = Counter[str](), Counter[str]()
    for found in map(equipment_of, photos):
        bodies.update(filter(None, [found.camera]))
        lenses.update(filter(None, [found.lens]))
    return [*_mixed("lenses", lenses), *_mixed("cameras", bodies)]


def _mixed(what: str, names: Counter[str]) -> Iterable[Finding]:
    if len(names) < 2:
        return
    listed = ", ".join(f"{plain(name)} ({_photos(number)})" for name, number in names.most_common(_LISTED))
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    yield Finding(
        f"different {what}",
        "doubtful",
        f"the photos were taken with {len(names)} different {what}, by their EXIF data: {listed}{more}.",
        "Calibrate the photos of each lens and camera by themselves.",
        cause=True,
    )


def _photos(number: int) -> str:
    return f"{number} photo" + "s" * (number != 1)
