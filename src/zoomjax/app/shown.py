"""What the command line prints when a calibration is done: tables, JSON or only the verdict."""

import dataclasses
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from .._core.copies import by_url
from .._core.text import plain
from ._flags import with_flags
from .console import show_calibration, show_frames, show_images, show_verdict, tell, tell_written

if TYPE_CHECKING:
    from .calibration import Calibration
    from .image_calibration import ImageCalibration
    from .undistort_files import Outcome

NOT_GOOD = 3
"""Exit status of ``--strict`` where the verdict is not good."""


@dataclasses.dataclass(frozen=True)
class Shown:
    """How results are shown: the options ``--strict``, ``--quiet``, ``--json`` and ``--verbose``."""

    strict: bool = False
    quiet: bool = False
    as_json: bool = False
    verbose: bool = False

    def __post_init__(self):
        """Check that they go together."""
        if self.verbose and (self.quiet or self.as_json):
            raise ValueError("--verbose has no effect with --quiet or --json: leave one of them out.")

    def lines(self, calibration: "Calibration", output: Path, *, robust: bool) -> None:
        """Show a calibration from lines, and end by its verdict."""
        if self._all(calibration, output):
            show_calibration(calibration)
            if robust:
                rejected = int(calibration.rejected.sum())
                print(f"\n{rejected} lines are not straight in the scene and were rejected.")
            if self.verbose:
                show_frames(calibration)
        tell(calibration.warnings())
        if not (self.quiet or self.as_json):
            tell_written(output)
        self._end(calibration)

    def images(self, done: "ImageCalibration", output: Path) -> None:
        """Show a calibration from images, and end by its verdict."""
        if self._all(done.calibration, output):
            show_calibration(done.calibration)
            if self.verbose:
                show_frames(done.calibration, [detection.name for detection in done.used])
            show_images(done, output)
        else:
            tell(done.warnings())
        self._end(done.calibration)

    def _all(self, calibration: "Calibration", output: Path) -> bool:
        """Whether everything is to be shown as text; else the verdict or the JSON is."""
        if self.as_json:
            print(json.dumps(json.loads((output / "summary.json").read_text()), indent=2))
        elif self.quiet:
            show_verdict(calibration)
        return not (self.as_json or self.quiet)

    def _end(self, calibration: "Calibration") -> None:
        if self.strict and calibration.assessment.verdict != "good":
            raise typer.Exit(NOT_GOOD)


def show_outcome(done: "Outcome", *, quiet: bool, as_json: bool) -> None:
    """Print what ``zoomjax undistort`` has done: on stdout results, on stderr what was skipped."""
    skipped = {by_url(path): with_flags(reason) for path, reason in done.skipped.items()}
    notes = [*map(by_url, done.notes)]
    if as_json:
        files = [{"source": by_url(str(source)), "target": str(target)} for source, target in done.files]
        print(json.dumps({"files": files, "skipped": skipped, "notes": notes}, indent=2))
        return
    for told in () if quiet else filter(None, (*done.sentence.split("\n"), *notes)):
        print(plain(told))
    for path, reason in skipped.items():
        print(plain(f"Skipped {path}: {reason}"), file=sys.stderr)
