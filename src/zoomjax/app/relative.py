"""Tracks that belong to the lens beside them: of relative focal lengths, as of a clip that zooms without
turning, and of focal lengths in its unit.
"""

import contextlib
import warnings
from pathlib import Path

from ..models.about import RELATIVE
from ..models.lens import ZoomLens, load_lens
from ..trust.assessment import Finding

NOTE = (
    "# Relative focal lengths: only their ratios are known. They belong to the lens.json beside this file."
)
"""The first line of a track of such focal lengths."""

SENTENCE = (
    "Focal lengths are relative: their common factor is not known, in lens.json as in track.csv. Use both "
    "together: with other focal lengths the lens is wrong."
)


def findings_of_relative(lens: ZoomLens) -> list[Finding]:
    """For a lens of lines of a clip whose focal lengths are relative: that it has such, too."""
    if lens.about.get("focal") != RELATIVE:
        return []
    return [
        Finding(
            "focal lengths",
            "not determined",
            "the lines are of a clip whose focal lengths are relative: their common factor is not known, "
            "and with other focal lengths than those of its track.csv the lens is wrong.",
            "Calibrate the clip again with a known focal length (--known-focal 24@0).",
        )
    ]


def warn_of_relative(lens: ZoomLens, focal: str | None) -> None:
    """Warn of a lens with relative focal lengths, and others given for it; or the other way round."""
    of_lens, of_track = lens.about.get("focal") == RELATIVE, focal is not None and is_relative_track(focal)
    if of_lens and not of_track:
        warnings.warn(
            "The focal lengths of this lens are relative: only their ratios are known. Give argument focal "
            "the track.csv of its own calibration, or calibrate again with a known focal length.",
            stacklevel=3,
        )
    if of_track and not of_lens:
        warnings.warn(
            f"The focal lengths of {focal} are relative: only their ratios are known. Use them with the "
            "lens.json of their own calibration, or calibrate again with a known focal length.",
            stacklevel=3,
        )


def is_relative_track(path: str | Path) -> bool:
    """Whether a file is a track of relative focal lengths, or a folder with such tracks."""
    path = Path(path)
    if path.is_dir():
        return any(is_relative_track(each) for each in path.glob("*.csv") if each.is_file())
    if not path.is_file():
        return False
    with path.open("rb") as file:
        head = file.read(4 * len(NOTE))
    text = head.decode("utf-16" if head[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8", errors="replace")
    return text.lstrip('\ufeff"').startswith(NOTE.partition(":")[0])


def refuse_other_unit(track: str, unit: str) -> None:
    """Refuse a track of results in another unit than that of the lens.json beside it, which is its own."""
    path, own = Path(track), unit
    if path.name == "track.csv":
        with contextlib.suppress(OSError, ValueError):
            own = load_lens(path.with_name("lens.json")).focal_unit
    if own != unit:
        raise ValueError(
            f"The focal lengths of {track} are in {own}, as those of the lens.json beside it: give "
            f"argument focal_unit {own}."
        )
