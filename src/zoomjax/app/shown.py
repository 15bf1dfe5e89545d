"""What the command line prints when a calibration is done: tables, JSON or only the verdict."""

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from .console import show_calibration, show_images, show_verdict, tell, tell_written

if TYPE_CHECKING:
    from .calibration import Calibration
    from .image_calibration import ImageCalibration

NOT_GOOD = 3
"""Exit status of ``--strict`` where the verdict is not good."""


@dataclasses.dataclass(frozen=True)
class Shown:
    """How results are shown: the options ``--strict``, ``--quiet`` and ``--json``."""

    strict: bool = False
    quiet: bool = False
    as_json: bool = False

    def lines(self, calibration: "Calibration", output: Path, *, robust: bool) -> None:
        """Show a calibration from lines, and end by its verdict."""
        if self._all(calibration, output):
            show_calibration(calibration)
            if robust:
                rejected = int(calibration.rejected.sum())
                print(f"\n{rejected} lines are not straight in the scene and were rejected.")
        tell(calibration.warnings())
        if not (self.quiet or self.as_json):
            tell_written(output)
        self._end(calibration)

    def images(self, done: "ImageCalibration", output: Path) -> None:
        """Show a calibration from images, and end by its verdict."""
        if self._all(done.calibration, output):
            show_calibration(done.calibration)
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
