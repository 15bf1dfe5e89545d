"""``zoomjax calibrate`` for a clip whose focal lengths nobody knows: from how the image moves."""

import dataclasses
import json
import shlex
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from .._core.text import plain
from .console import REPORT, print_verdict, progress_bar, stages
from .heard import heard
from .options import IDLE_FOR_MOTION, refuse_idle
from .plans import tell_plan
from .runs import what_is_run
from .shown import NOT_GOOD, Shown

if TYPE_CHECKING:
    from ..detect.batch import Detection
    from .known_focals import KnownFocals
    from .model_choice import WantedCentre, WantedModel
    from .motion_calibration import MotionCalibration


@dataclasses.dataclass(frozen=True)
class ClipJob:
    """What to calibrate, and how.

    Attributes:
        inputs: the clip.
        output: folder of the results.
        model: the zoom model, and the distortion model.
        centre: of distortion: "fit" or "image".
        known: focal lengths of some frames, as `known_focals` takes them, or one of its `MEASURED`; and
            what it takes with them:
        focal_unit, focal_sigma, pixel_pitch: their unit, standard deviation, and px in it.
        lines: whether straight lines in the frames are fitted, too; then also:
        detector: of lines, by name.
        frames: the most frames in which they are searched for.
        workers: number of processes that search.
        cache: folder of what was found in frames before; None for none.
        overlays: which frames are drawn with their lines: "some", "all" or "none".
        overwrite: whether to replace files that zoomjax did not write.
        by_default: whether motion is tried as nothing else is given.
    """

    inputs: Sequence[str]
    output: Path
    model: "WantedModel"
    centre: "WantedCentre"
    known: tuple[str, ...] = ()
    focal_unit: str | None = None
    focal_sigma: str | None = None
    pixel_pitch: float | None = None
    lines: bool = False
    detector: str = "edges"
    frames: int = 60
    workers: int = 1
    cache: Path | None = None
    overlays: str = "some"
    overwrite: bool = False
    by_default: bool = False

    def __post_init__(self):
        """Check the settings before any work.

        Raises:
            ValueError: there is not one video, or an option has no effect here.
        """
        from ..models.requirements import refusal
        from .image_job import is_video

        if len(self.inputs) != 1 or not is_video(self.inputs[0]):
            raise ValueError("--focal motion is for one video: its motion determines the focal lengths.")
        if self.centre not in ("fit", "image"):
            raise ValueError("With --focal motion, --centre is fit or image: it moves along the zoom.")
        if self.model.distortion_model == "auto":
            raise ValueError("With --focal motion, --distortion-model names one: none are compared.")
        distortion_model = self.model.first_distortion_model
        if self.lines and refusal("fit_motion with lines", distortion_model=distortion_model):
            raise ValueError("With --lines, --distortion-model is radial or division.")
        self._check_measured()
        self.known_focals()

    def _check_measured(self) -> None:
        from .known_focals import MEASURED

        asked = [word for word in self.known if word in MEASURED]
        if not asked:
            return
        if len(self.known) > 1:
            raise ValueError(f"--known-focal {asked[0]} stands by itself: leave the others out.")
        wanted = MEASURED[asked[0]]
        if not self.lines or self.detector != wanted:
            raise ValueError(f"--known-focal {asked[0]} needs --lines --detector {wanted}.")
        if (self.focal_unit, self.focal_sigma, self.pixel_pitch) != (None, None, None):
            raise ValueError(
                "--focal-unit, --focal-sigma and --pixel-pitch have no effect with --known-focal "
                f"{asked[0]}, which measures px: leave them out."
            )

    @property
    def measured(self) -> str | None:
        """What the frames tell focal lengths by, if they are to."""
        from .known_focals import MEASURED

        return next((word for word in self.known if word in MEASURED), None)

    def known_focals(self) -> "KnownFocals | None":
        """The focal lengths that are known beforehand; None if none are."""
        from .known_focals import known_focals

        if self.measured:
            return None
        of = {"unit": self.focal_unit, "sigma": self.focal_sigma, "pitch": self.pixel_pitch}
        return known_focals(self.known, **of) if self.known else None


def wants_motion(inputs: Sequence[str], focal: str | None, spacing: str | None) -> bool:
    """Whether focal lengths are to come from motion: asked for, or a video alone."""
    from .image_job import is_video

    alone = focal is None and spacing is None and len(inputs) == 1 and is_video(inputs[0])
    return focal == "motion" or alone


def refuse_idle_for_clips(context: typer.Context) -> None:
    """Refuse options that have no effect on a clip whose motion gives its focal lengths."""
    idle, given = IDLE_FOR_MOTION, context.params
    if not given["known_focal"]:
        idle = (*idle, "focal_sigma", "focal_unit", "pixel_pitch")
    if not given["with_lines"]:
        idle = (*idle, "overlays")
    refuse_idle(context, idle, "with --focal motion")
    if not given["with_lines"]:
        refuse_idle(context, ("detector", "frames", "jobs", "cache"), "without --lines")


def calibrate_clip(job: ClipJob, show: Shown, *, dry_run: bool) -> None:
    """Calibrate from a clip, write the results and show them."""
    from .clip_report import clip_report
    from .frame_findings import frames_of
    from .model_choice import one_centre
    from .motion_calibration import FILES, calibrate_motion
    from .results_folder import OF_A_LENS, results_folder

    clip, known = Path(job.inputs[0]), job.known_focals()
    if known is not None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # they are said as its points are followed
            known.of_frames(frames_of(clip)[:, 0])  # before any work
    if dry_run:
        besides = f", and from lines in up to {job.frames} frames" * job.lines
        if known is not None:
            besides = (
                f", from {len(known.frame)} known focal length{'s' * (len(known.frame) > 1)}" + besides
            )
        if job.measured:
            besides += f", whose {job.measured} tells f"
        plan = f"Focal lengths and lens from how {plain(str(clip))} moves{besides}."
        tell_plan([plan], job.output, as_json=show.as_json)
        return
    if job.by_default and not (show.quiet or show.as_json):
        found = f"they and the lens are found from how {plain(str(clip))} moves"
        print(f"No focal lengths are given (--focal): {found}.", file=sys.stderr)
    names = [*FILES, REPORT, *["lines.npz"] * job.lines]
    with (
        heard() as told,
        results_folder(job.output, names, clears=OF_A_LENS, overwrite=job.overwrite) as folder,
    ):
        with progress_bar("Following points", quiet=show.quiet) as progress:
            from ..tracks.video import track_video

            tracks = track_video(clip, progress=progress)
        found = _lines(job, show) if job.lines else ()
        if job.measured:
            from .known_focals import measured_focals

            known = measured_focals(found, job.measured)
        with stages(quiet=show.quiet) as stage:
            done = calibrate_motion(
                clip,
                tracks,
                found=found,
                known=known,
                model=job.model,
                centre=one_centre(job.centre),
                stage=stage,
            )
            done = dataclasses.replace(done, warnings=tuple(told))
            about = {"detector": job.detector if job.lines else None}
            done.make(
                folder,
                stage,
                overlays=job.overlays,
                about=about,
            )
            stage("Making the report")
            page = clip_report(done, folder / "panorama.jpg", run=what_is_run(clip.name))
            (folder / REPORT).write_text(page, encoding="utf-8")
    _show(done, job, show)
    if show.strict and done.verdict != "good":
        raise typer.Exit(NOT_GOOD)


def _lines(job: ClipJob, show: Shown) -> "Sequence[Detection]":
    """What the detector finds in frames of the clip."""
    from ..detect.batch import DETECTORS, detect
    from ..detect.sources import video_frames

    frames = video_frames(job.inputs[0], 1.0, job.frames)  # nobody knows its focal lengths
    found = detect(frames, DETECTORS[job.detector](), workers=job.workers, cache=job.cache)
    with progress_bar("Detecting lines", quiet=show.quiet) as progress:
        seen = []
        for number, detection in enumerate(found, start=1):
            seen.append(detection)
            progress(number, job.frames)
    if not any(detection.lines for detection in seen):
        raise ValueError(
            f"No lines were found in {len(seen)} frames of {plain(job.inputs[0])}: leave --lines out."
        )
    return seen


def _show(done: "MotionCalibration", job: ClipJob, show: Shown) -> None:
    """Print what was found: as JSON, the verdict alone, or all."""
    from rich.console import Console

    if show.as_json:
        print(json.dumps(json.loads((job.output / "summary.json").read_text()), indent=2))
        return
    print_verdict(done.verdict, done.sentence, done.findings)
    if show.quiet:
        return
    console = Console()
    for line in done.figures():
        console.print(line, highlight=False)
    from .motion_calibration import FILES

    if job.lines:
        where = plain(str(job.output / "lines"))
        if job.overlays != "none":
            print(f"\nCheck the detected lines, drawn over each frame, in {where}.")
    files = [
        REPORT,
        *FILES,
        *["lines.npz"] * job.lines,
        *["lines/"] * (job.lines and job.overlays != "none"),
    ]
    print(f"\nWritten to {plain(str(job.output))}: {', '.join(files)}")
    lens, track = job.output / "lens.json", job.output / "track.csv"
    print(f"Correct the clip with {correction_command(lens, job.inputs[0], track=track)}")


def correction_command(lens: Path, clip: str, *, track: Path) -> str:
    """The command that corrects a clip, as a shell takes it."""
    first, second, third = (shlex.quote(plain(str(path))) for path in (lens, clip, track))
    return f"zoomjax undistort {first} {second} --focal {third} -o corrected.mp4"
