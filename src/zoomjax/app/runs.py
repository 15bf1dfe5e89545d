"""Calibrations as the command line runs them: with stages, a report, and what was run."""

import contextlib
import datetime
import os
import shlex
import sys
from collections.abc import Callable, Collection
from pathlib import Path
from typing import TYPE_CHECKING

from .console import REPORT, progress_bar, stages

if TYPE_CHECKING:
    from ..fit.zoom import CentreArgument
    from ..lines.lines import Lines
    from .calibration import Calibration
    from .image_calibration import ImageCalibration
    from .image_job import ImageJob
    from .model_choice import WantedModel
    from .report import Run


def calibrate_lines(
    lines: "Lines",
    folder: Path,
    stage: Callable[[str], None],
    *,
    model: "WantedModel",
    centre: "CentreArgument",
    focal_sigma: str | None,
    robust: bool,
    title: str,
    names: Collection[str],
) -> "Calibration":
    """Calibrate from lines, and write those results into the folder that have such names."""
    from .calibration import calibrate
    from .focal_sources import focal_sigmas
    from .report import report

    sigma = focal_sigmas(focal_sigma or "0", lines.focal)
    calibration = calibrate(
        lines, model=model, centre=centre, focal_sigma=sigma, robust=robust, stage=stage
    )
    stage("Writing the results")
    pages = {REPORT: report(calibration, run=what_is_run(title))}
    calibration.make(folder, pages=pages, lines="lines.npz" in names)
    return calibration


def calibrate_images(
    job: "ImageJob", folder: Path, *, title: str, quiet: bool = False
) -> "ImageCalibration":
    """Calibrate from images, and write the results into the folder."""
    from .image_calibration import calibrate_images
    from .pictures import pictures
    from .report import report

    with contextlib.ExitStack() as shown:
        progress = shown.enter_context(progress_bar("Detecting lines", quiet=quiet))

        def stage(name: str) -> None:
            nonlocal current
            if current is None:  # replace the bar by the stages
                shown.close()
                current = shown.enter_context(stages(quiet=quiet))
            current(name)

        current: Callable[[str], None] | None = None
        done = calibrate_images(job, progress=progress, stage=stage)
        stage("Making the report")
        page = report(done.calibration, done, pictures=pictures(done), run=what_is_run(title, done))
    with progress_bar("Drawing the lines and writing the results", quiet=quiet) as progress:
        done.make(folder, progress, pages={REPORT: page})
    return done


def what_is_run(title: str, images: "ImageCalibration | None" = None) -> "Run":
    """For the report: the command, its folder, the date and the camera."""
    from .equipment import equipment_of
    from .report import Run

    now = datetime.datetime.now().astimezone()
    rows = [
        ("Command", shlex.join(["zoomjax", *sys.argv[1:]])),
        ("In the folder", os.getcwd()),
        ("Date", now.strftime("%Y-%m-%d %H:%M %Z")),
    ]
    if images is not None and not images.job.video:
        found = equipment_of(Path(images.used[0].file))
        if names := ", ".join(filter(None, (found.camera, found.lens))):
            rows.append(("Camera", names))
    return Run(title, tuple(rows))


def title_of(inputs: list[str]) -> str:
    """What is calibrated, in a word: the folder, or the file, that is named first."""
    first = Path(inputs[0])
    name = first.name if first.is_dir() or not first.parent.name else first.parent.name
    if len(inputs) == 1 and first.is_file():
        name = first.name
    return name if name not in ("", ".", "..") else first.resolve().name
