"""Calibrations as the command line runs them: with stages, a report, and what was run."""

import contextlib
import dataclasses
import datetime
import importlib
import os
import shlex
import sys
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .._core.copies import shown_url
from .._core.text import listed
from .cluster import cluster_executor
from .console import REPORT, progress_bar, stages

if TYPE_CHECKING:
    from ..lines.lines import Lines
    from .calibration import Calibration
    from .image_calibration import ImageCalibration
    from .image_job import ImageJob
    from .model_choice import WantedCentre, WantedModel
    from .page import Run

_MOST = 4
"""Folders and cameras named in the report."""


def calibrate_lines(
    lines: "Lines",
    folder: Path,
    stage: Callable[[str], None],
    *,
    model: "WantedModel",
    centre: "WantedCentre",
    focal_sigma: str | None,
    robust: bool,
    files: Sequence[Path],
    names: Collection[str],
    focal_known: bool = True,
) -> "Calibration":
    """Calibrate from lines of files, and write those results into the folder that have such names.

    Where `focal_known` is false, a number stands for the one focal length of all lines. Of lines in a
    folder of results the summary tells how uncertain focal lengths are, unless that is given; and where
    their centre was fitted, it is fitted again from the middle of the image. What it says against the
    photos or the clip stays.
    """
    from .calibrating import calibrate
    from .earlier import earlier_of, findings_of_counted_again
    from .equipment import with_earlier, without_focal
    from .focal_sources import focal_sigmas
    from .relative import findings_of_relative
    from .report import report
    from .said_before import findings_before, findings_of_lenses
    from .verdict import findings_of_surer

    known = earlier_of(files, lines)
    if known.centre and centre in ("fit", "moving"):
        lines = lines.about((np.array(lines.image_size) - 1) / 2)
    sigma = focal_sigmas("0" if focal_sigma is None else focal_sigma, lines.focal)
    if focal_sigma is None and known.sigma is not None:
        sigma = known.sigma
    before = np.zeros(len(sigma)) if known.sigma is None else known.sigma
    surer = findings_of_surer(sigma, before, unit=lines.focal_unit, of="frames (the fit before this one)")
    known = known._replace(sigma=sigma, lost=known.lost and focal_sigma is None)
    calibration = calibrate(
        lines,
        model=model,
        centre=centre,
        focal_sigma=sigma,
        shared=known.shared,
        robust=robust,
        stage=stage,
    )
    lens = with_earlier(calibration.fit.lens, files)
    found = [*known.findings(), *findings_of_relative(lens), *surer]
    found += findings_of_counted_again(files, calibration.rejected)
    found += [*findings_of_lenses(files), *findings_before(files, given_sigma=focal_sigma is not None)]
    assessment = calibration.assessment.joined_by(found)
    zoom = dataclasses.replace(calibration.fit, lens=lens if focal_known else without_focal(lens))
    calibration = dataclasses.replace(calibration, assessment=assessment, fit=zoom)
    stage("Writing the results")
    pages = {REPORT: report(calibration, run=what_is_run(title_of(list(map(str, files)))))}
    kept = np.maximum(sigma, before)  # a smaller one that is given is for this fit: what was measured stays
    about = {"earlier": known._replace(sigma=kept).about()}
    calibration.make(folder, about=about, pages=pages, lines="lines.npz" in names)
    return calibration


_USED_LATER = ("scipy.optimize", f"{__package__}.report")
"""Modules that take their time to be read: that is done while photos are searched."""


def calibrate_images(
    job: "ImageJob", folder: Path, *, title: str, quiet: bool = False, cluster: str | None = None
) -> "ImageCalibration":
    """Calibrate from images, perhaps on a cluster of Dask, and write the results into the folder."""
    from .._core.ahead import programs_ahead
    from .drawings import drawing
    from .image_calibration import calibrate_images
    from .plans import photo_sizes
    from .rehearsal import rehearsing

    # The cluster stays open: photos that disagree with the lens are searched again.
    with contextlib.ExitStack() as beside:
        settings = job.detector, job.focal, job.shared_focal, job.centre, job.model
        beside.enter_context(ThreadPoolExecutor(1)).map(importlib.import_module, _USED_LATER)
        first = beside.enter_context(programs_ahead(f"{settings} {next(photo_sizes(job), None)}"))
        begin = beside.enter_context(rehearsing(first and job.workers > 1))
        with cluster_executor(cluster, quiet=quiet) as executor, contextlib.ExitStack() as shown:
            progress = shown.enter_context(progress_bar("Detecting lines", quiet=quiet))

            def stage(name: str) -> None:
                nonlocal current
                if current is None:  # replace the bar by the stages
                    shown.close()
                    current = shown.enter_context(stages(quiet=quiet))
                current(name)

            current: Callable[[str], None] | None = None
            done = calibrate_images(job, progress=progress, stage=stage, executor=executor, begun=begin)
            stage("Making the report")
            from .report import report

            done.verdicts()  # threads that draw would take turns with its many small steps
            drawn = beside.enter_context(drawing(done, folder / "lines"))
            page = report(done.calibration, done, pictures=drawn.pictures(), run=what_is_run(title, done))
        with progress_bar("Drawing the lines and writing the results", quiet=quiet) as progress:
            drawn.wait(progress)
            done.calibration.make(folder, about=done.about(), pages={REPORT: page})
    return done


def what_is_run(title: str, images: "ImageCalibration | None" = None) -> "Run":
    """For the report: the command, its folder, the date and the camera."""
    from .page import Run

    now = datetime.datetime.now().astimezone()
    rows = [
        ("Command", shlex.join(["zoomjax", *map(shown_url, sys.argv[1:])])),
        ("In the folder", os.getcwd()),
        ("Date", now.strftime("%Y-%m-%d %H:%M %Z")),
    ]
    if images is not None and not images.job.video:
        rows += _cameras(Path(detection.file) for detection in images.used)
    return Run(title, tuple(rows))


def _cameras(photos: Iterable[Path]) -> list[tuple[str, str]]:
    """What the photos were taken with, where it is known: a row for all."""
    from .equipment import equipment_of

    found = map(equipment_of, photos)
    names = Counter(name for one in found if (name := ", ".join(filter(None, (one.camera, one.lens)))))
    if len(names) < 2:
        return [("Camera", name) for name in names]
    return [
        ("Cameras", listed((f"{name} ({number})" for name, number in names.most_common()), _MOST, "; "))
    ]


def title_of(inputs: list[str]) -> str:
    """What is calibrated, in words: the folders that are named, or those of the files; or the one file."""
    if len(inputs) == 1 and Path(inputs[0]).is_file():
        return Path(inputs[0]).name
    return listed(dict.fromkeys(map(_folder_name, inputs)), _MOST)


def _folder_name(path: str) -> str:
    """The name of a folder, or of that which a file or a pattern is in."""
    here = Path(path)
    name = here.name if here.is_dir() or not here.parent.name else here.parent.name
    return name if name not in ("", ".", "..") else here.resolve().name
