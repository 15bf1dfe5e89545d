"""What a folder of results knows of its lines beside them, for another fit to the same lines.

A file of lines holds points and focal lengths, and the centre that was found. How uncertain the focal
lengths are, which of them are shared, and whether the lines are those of a flat board, is in the summary.
"""

import contextlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .._core.text import listed
from ..lines.lines import Lines
from ..lines.npz import load_lines
from ..models.lens import load_lens
from ..trust.assessment import Finding


class Earlier(NamedTuple):
    """What is known of lines beside them.

    Attributes:
        sigma: standard deviations of the focal lengths; None if nothing is known of them.
        shared: for each frame a number, the same for those of one focal length; None if none share one.
        centre: whether the centre was fitted.
        flat: whether the lines are those of a flat board in the place of a bent one.
        lost: whether focal lengths may be uncertain of which it is not known by how much.
    """

    sigma: np.ndarray | None = None
    shared: np.ndarray | None = None
    centre: bool = False
    flat: bool = False
    lost: bool = False

    def about(self) -> dict[str, Any]:
        """The entry of summary.json, for a fit after that."""
        return {
            "focal_sigma": None if self.sigma is None else self.sigma.tolist(),
            "shared": None if self.shared is None else self.shared.tolist(),
            "centre": self.centre,
            "flat": self.flat,
            "lost": self.lost,
        }

    def findings(self) -> list[Finding]:
        """What the bands of another fit lack."""
        found = []
        if self.flat:
            found.append(
                Finding(
                    "shape of the board",
                    "doubtful",
                    "the lines are those of a flat board, computed from a bent one. How uncertain its "
                    "shape is, the bands of the calibration from its photos say, and these do not.",
                    "Calibrate from the photos again, or take the bands from there.",
                )
            )
        if self.lost:
            found.append(
                Finding(
                    "focal lengths",
                    "doubtful",
                    "how uncertain the focal lengths of some lines are is not known, as the summary beside "
                    "them is damaged, or of others: they count as exact.",
                    "Give their standard deviation (--focal-sigma), or calibrate from the photos again.",
                )
            )
        return found


def is_of_results(file: Path) -> bool:
    """Whether a file of lines is one of the results of a calibration, with lens and summary beside it."""
    return file.name == "lines.npz" and all(
        file.with_name(name).is_file() for name in ("lens.json", "summary.json")
    )


def earlier_of(files: Sequence[Path], lines: Lines) -> Earlier:
    """What the summaries beside files of lines know of them; the frames of the files follow each other.

    Focal lengths of files without a summary are exact, as they are where there is none at all.

    Raises:
        ValueError: the lens beside a file cannot be read, which tells whether a focal length is known.
    """
    for file in filter(is_of_results, files):
        _check_lens(file)
    parts = [_of_file(file) for file in files]
    if all(part is None for part in parts):
        return Earlier()
    known = [part for part in parts if part is not None]
    centre, flat = len(parts) == 1 and known[0].centre, any(part.flat for part in known)
    sizes = [
        _frames(file) if part is None else len(part.focal) for file, part in zip(files, parts, strict=True)
    ]
    told = np.repeat([part is not None for part in parts], sizes)
    focal = np.asarray(lines.focal, float)
    given = np.concatenate([part.focal for part in known])
    if told.size != focal.size or not np.allclose(given, focal[told], rtol=1e-6):
        return Earlier(centre=centre, flat=flat, lost=True)
    sigma, shared = np.zeros(focal.size), np.arange(focal.size)
    sigma[told] = np.concatenate([part.sigma for part in known])
    starts = np.cumsum([0, *sizes])
    for part, start in zip(parts, starts, strict=False):
        if part is not None:
            shared[start : start + len(part.focal)] = start + part.shared
    together = np.unique(shared).size < shared.size
    return Earlier(sigma, shared if together else None, centre, flat, any(part.lost for part in known))


def findings_of_counted_again(files: Sequence[Path], rejected: np.ndarray) -> list[Finding]:
    """That lines count that the fits beside their files left out: a remark, for it may be what is wanted.

    Args:
        files: of lines, which follow each other.
        rejected: which of them do not count now.
    """
    if not any(map(is_of_results, files)):
        return []
    before = np.concatenate([_left_out(file) for file in files])
    again = [str(line) for line in np.flatnonzero(before & ~rejected).tolist()]
    if not again:
        return []
    one = len(again) == 1
    return [
        Finding(
            "lines left out before",
            "good",
            f"{'a line' if one else f'{len(again)} lines'} that the fit before this one left out "
            f"count{'s' * one} again: {listed(again, _MOST)}.",
            f"To leave {'it' if one else 'them'} out, add {'it' if one else 'them'} to --exclude.",
        )
    ]


_MOST = 20


def _left_out(file: Path) -> np.ndarray:
    """Which lines of a file the fit beside it left out; none, where there is no summary of that."""
    out = np.zeros(len(load_lines(file).frame), bool)
    if is_of_results(file):
        with contextlib.suppress(AttributeError, IndexError, KeyError, OSError, TypeError, ValueError):
            summary = json.loads(file.with_name("summary.json").read_text())
            lines = [int(one["line"]) for one in summary["rejected"]]
            out[lines if summary["lines"] == len(out) else []] = True
    return out


class _Part(NamedTuple):
    """What the summary beside one file knows of its frames; `shared` counts from the file's first."""

    focal: np.ndarray
    sigma: np.ndarray
    shared: np.ndarray
    centre: bool
    flat: bool
    lost: bool


def _check_lens(file: Path) -> None:
    """Check that the lens beside a file of lines can be read."""
    try:
        load_lens(file.with_name("lens.json"))
    except (OSError, ValueError) as error:
        raise ValueError(
            f"{file} is of a folder of results whose lens.json cannot be read, and so it is not known what "
            f"its focal lengths are. {error} Mend it, or move {file.name} to another folder."
        ) from error


def _of_file(file: Path) -> _Part | None:
    """None without a summary. Of one that is damaged, or of another version, focal lengths are lost."""
    if not is_of_results(file):
        return None
    try:
        return _of_summary(json.loads(file.with_name("summary.json").read_text()))
    except (AttributeError, KeyError, OSError, TypeError, ValueError):
        focal = np.asarray(load_lines(file).focal, float)
        number = len(focal)
        return _Part(focal, np.zeros(number), np.arange(number), centre=False, flat=False, lost=True)


def _of_summary(summary: dict[str, Any]) -> _Part:
    centre = summary["centre"]["how"] in ("fitted", "moving")
    if before := summary.get("earlier"):
        focal = np.array([float(row["focal"]) for row in summary["per_frame"]])
        sigma, shared = before["focal_sigma"], before["shared"]
        sigma = np.zeros(len(focal)) if sigma is None else np.asarray(sigma, float)
        shared = np.arange(len(focal)) if shared is None else np.asarray(shared, int)
        fitted, flat, lost = (
            centre or bool(before["centre"]),
            bool(before["flat"]),
            before.get("lost", False),
        )
        good = np.isfinite(sigma) & (sigma >= 0)
        if sigma.shape != focal.shape or shared.shape != focal.shape or not good.all():
            sigma, shared, lost = np.zeros(len(focal)), np.arange(len(focal)), True
        return _Part(focal, sigma, _by_first(shared), fitted, flat, bool(lost))
    images = summary["images"]
    sigma = np.array([float(image["focal_sigma"] or 0) for image in images])
    if not (np.isfinite(sigma) & (sigma >= 0)).all():
        raise ValueError
    shared = np.arange(len(images))
    for number, group in enumerate(summary.get("focal_groups") or ()):
        there = [i for i, image in enumerate(images) if image["name"] in group["names"]]
        shared[there] = len(images) + number
    return _Part(
        np.array([float(image["focal"]) for image in images]),
        sigma,
        _by_first(shared),
        centre,
        bool((summary.get("board") or {}).get("flat_lines")),
        lost=False,
    )


def _by_first(shared: np.ndarray) -> np.ndarray:
    """The same groups, each by the number of its first frame."""
    _, first, group = np.unique(shared, return_index=True, return_inverse=True)
    return first[group]


def _frames(file: Path) -> int:
    return len(load_lines(file).focal)
