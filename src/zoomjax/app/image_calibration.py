"""Calibration from photos or a video: what ``zoomjax calibrate`` does with images."""

import contextlib
import dataclasses
import functools
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import numpy as np

from .._core.text import plain
from ..detect.batch import DETECTORS, NO_LINES, Detection, detect
from ..detect.sources import Source
from ..models.smooth import SmoothZoom
from ..trust.assessment import Finding, Verdict
from ._flags import with_flags
from .board_bundle import BoardBundle, bundle_of, sharing_options
from .calibrating import calibrate
from .calibration import Calibration
from .choice import chosen_frames
from .drawings import drawing
from .equipment import KnownLens, known_lens, with_equipment, without_focal
from .focal_sources import GRID, MEASURED, Focals, choose_focals, focal_sigmas, known_focals, lines_of
from .image_job import ImageJob, overlay_name
from .meanwhile import State, findings_of_changed, states_of
from .model_choice import one_centre
from .rehearsal import Part
from .results_folder import OF_A_LENS, results_folder
from .turned import findings_of_turned
from .tying import Bend, tied, to_search_again
from .undetermined import told_undetermined
from .usable import OTHER_SIZE, usable_of
from .verdict import (
    findings_of_edges,
    findings_of_exif,
    findings_of_focals,
    findings_of_own_focals,
    findings_of_photos,
    findings_of_sizes,
    nothing_usable,
    verdict_of_photo,
)

MOST_OVERLAYS = 200
"""Images drawn with their lines, unless all are asked for."""

_MOST_GROUPS = 20
"""Groups of photos with one focal length that are listed."""

Progress = Callable[[int, int], None]
"""Called with the number of images done and their total."""


@dataclasses.dataclass(frozen=True)
class ImageCalibration:
    """A calibration with its images.

    Attributes:
        job: the settings.
        calibration: the fits; one frame for each used image, in their order.
        used: the detections in the used images.
        focals: the focal lengths of the used images.
        images: the names of all images, in order; overlays are numbered by their place in it, from 1.
        unused: for each image that was not used, the reason.
        bundle: the bundle adjustment of the grids in them; None if there are too few.
        board_note: why there is none, or what would make it better; empty if nothing.
        tied: the names of the images in which lines were found again under the lens of all images.
        lens: what the prior of the zoom model knows of the lens; None if nothing.
        states: of the files of photos before the work began.
    """

    job: ImageJob
    calibration: Calibration
    used: tuple[Detection, ...]
    focals: Focals
    images: tuple[str, ...]
    unused: dict[str, str]
    bundle: BoardBundle | None = None
    board_note: str = ""
    tied: tuple[str, ...] = ()
    lens: KnownLens | None = None
    states: Mapping[str, State | None] = dataclasses.field(default_factory=dict)

    def members(self) -> list[np.ndarray]:
        """For each used image, the numbers of its lines among those of the calibration."""
        counts = [len(detection.lines) for detection in self.used]
        return np.split(np.arange(sum(counts)), np.cumsum(counts)[:-1])

    def rejected(self) -> list[np.ndarray]:
        """For each used image, which of its lines were rejected as not straight in the scene."""
        return [self.calibration.rejected[members] for members in self.members()]

    def verdicts(self) -> list[tuple[Verdict, str]]:
        """For each used image the verdict on it, and why it is not good."""
        return self._verdicts

    @functools.cached_property
    def _verdicts(self) -> list[tuple[Verdict, str]]:
        parts = enumerate(zip(self.used, self.rejected(), strict=True))
        return [verdict_of_photo(self.calibration, frame, *part) for frame, part in parts]

    def about(self) -> dict[str, Any]:
        """The entries of summary.json about the images."""
        images = [
            {
                "name": detection.name,
                "focal": self.focals.focal[detection.name],
                "focal_sigma": self.focals.deviation.get(detection.name),
                "lines": len(detection.lines),
                "rejected": int(rejected.sum()),
                "unexplained": detection.unexplained,
                "searched_again": detection.name in self.tied,
                "verdict": verdict,
                "reason": reason,
            }
            for detection, rejected, (verdict, reason) in zip(
                self.used, self.rejected(), self.verdicts(), strict=True
            )
        ]
        return {
            "detector": self.job.detector,
            "focal_source": self.focals.origin,
            "board": self.bundle and self.bundle.about(),
            "board_note": self.board_note,
            "prior": self.prior() or None,
            "focal_groups": [dataclasses.asdict(group) for group in self.focals.groups],
            "images": images,
            "unused": self.unused,
        }

    def prior(self) -> str:
        """What the prior of the zoom model knows of the lens, in a sentence; empty if nothing."""
        used = isinstance(self.calibration.fit.lens.zoom, SmoothZoom)
        return self.lens.sentence() if used and self.lens else ""

    def board(self) -> list[str]:
        """How bent the board is, or why that is not known, in sentences; none where no grids were found."""
        told = [self.board_note] if self.board_note else []
        return [*(self.bundle.sentences() if self.bundle else ()), *told]

    def shared(self) -> list[str]:
        """Which images share a focal length, in sentences; none where that was not asked for."""
        if self.focals.one_zoom is False:
            return [_OF_SEVERAL]
        if self.job.shared_focal is None and not self.focals.one_zoom:
            return []
        groups = [group.sentence(self.focals.unit) for group in self.focals.groups]
        rest = len(groups) - _MOST_GROUPS
        more = [f"{rest} more groups are listed in summary.json."] if rest > 0 else []
        supposed = [_SUPPOSED] if self.focals.one_zoom else []
        return [*supposed, *groups[:_MOST_GROUPS], *more] or ["No two photos share a focal length."]

    def warnings(self) -> list[str]:
        """User-facing warnings: images that were not used, and those of the calibration."""
        warnings = []
        if self.unused:
            listed = [f"{plain(name)}: {plain(why)}" for name, why in self.unused.items()]
            rest = len(listed) - 8
            warnings.append(
                f"{len(listed)} of {len(listed) + len(self.used)} images are not used.\n  "
                + "\n  ".join(listed[:8] + ([f"and {rest} more, in summary.json"] if rest > 0 else []))
            )
        return warnings + self.calibration.warnings([plain(detection.name) for detection in self.used])

    def overlays(self) -> list[str]:
        """For each used image, the name of its picture in ``lines/``; empty if it is not drawn."""
        numbers = {name: number for number, name in enumerate(self.images, start=1)}
        most = {"some": MOST_OVERLAYS, "all": len(self.used), "none": 0}[self.job.overlays]
        drawn = set(chosen_frames(self.calibration, most)) if most else set()
        return [
            overlay_name(numbers[detection.name], detection.name) if frame in drawn else ""
            for frame, detection in enumerate(self.used)
        ]

    def write(
        self,
        folder: str | os.PathLike[str],
        progress: Progress = lambda done, total: None,
        pages: Mapping[str, str] | None = None,
        *,
        overwrite: bool = False,
    ) -> None:
        """Write the files of `Calibration.write`, and each image with its detected lines in ``lines/``."""
        names = [*self.job.results(), *(pages or {})]
        with results_folder(folder, names, clears=OF_A_LENS, overwrite=overwrite) as part:
            self.make(part, progress, pages)

    def make(
        self,
        folder: Path,
        progress: Progress = lambda done, total: None,
        pages: Mapping[str, str] | None = None,
    ) -> None:
        """Write the files of `write` into an empty folder, such as that of a `results_folder`."""
        with drawing(self, folder / "lines", most=0) as drawn:
            drawn.wait(progress)
        self.calibration.make(folder, about=self.about(), pages=pages)


def calibrate_images(
    job: ImageJob,
    *,
    progress: Progress = lambda done, total: None,
    stage: Callable[[str], None] = lambda _: None,
    executor: Executor | None = None,
    begun: Callable[[Part], None] = lambda _: None,
) -> ImageCalibration:
    """Detect lines in images, find focal lengths, reject lines that are not straight, and fit the model.

    Args:
        job: the settings.
        progress: called after each image.
        stage: called with a description before each later step.
        executor: where lines are detected, instead of the job's processes: see `zoomjax.detect.detect`.
        begun: called with what is calibrated before it is.

    Raises:
        FileNotFoundError: an input does not exist.
        ValueError: no image can be used, no focal length was found, or there are too few of them.
        RuntimeError: the lines do not determine the model.
    """
    sources, total = job.sources()
    states = states_of(sources) if job.video is None else {}
    detections = _detected(job, sources, lambda done: progress(done, total), executor)
    done = _calibrated(job, detections, stage, begun)
    known = _disagreeing(done, detections) if job.tied and job.detector == "edges" else {}
    if known:
        stage("Finding lines again under the lens of all photos")
        detections, replaced = tied(
            detections,
            known,
            lambda known: _detected(job, _bent(job, detections, known), lambda _: None, executor),
        )
        if replaced:
            done = dataclasses.replace(_calibrated(job, detections, stage, begun), tied=tuple(replaced))
    changed = findings_of_changed(done.used, states)
    return dataclasses.replace(_joined(done, changed), states=states)


def _detected(
    job: ImageJob, sources: Iterable[Source], progress: Callable[[int], None], executor: Executor | None
) -> list[Detection]:
    """What is found in images; `progress` is called with the number of those done."""
    detections = []
    looked = detect(
        sources,
        DETECTORS[job.detector](),
        grid=job.grid,
        workers=job.workers if executor is None else 0,
        cache=job.cache,
        executor=executor,
    )
    with contextlib.closing(looked):  # ends the processes after an error, too
        for detection in looked:
            detections.append(detection)
            progress(len(detections))
    return detections


def _bent(job: ImageJob, detections: Sequence[Detection], known: dict[str, Bend]) -> Iterable[Source]:
    """Some of the images, with what is known of how bent they are."""
    for source in job.again(d for d in detections if d.name in known):
        yield dataclasses.replace(source, bend=known[source.name])


def _disagreeing(done: ImageCalibration, detections: Sequence[Detection]) -> dict[str, Bend]:
    """The images that are to be searched again, and how bent the lens makes them."""
    lens = done.calibration.fit.lens
    ours = [d for d in detections if d.image_size == lens.image_size and d.problem in ("", NO_LINES)]
    empty = [d for d in ours if d.problem]
    focal = done.focals.focal | known_focals(empty, done.job.focal, done.focals)
    return to_search_again(ours, focal, lens)


def _calibrated(
    job: ImageJob,
    detections: Sequence[Detection],
    stage: Callable[[str], None],
    begun: Callable[[Part], None],
) -> ImageCalibration:
    """The calibration from what was found in all images."""
    images = tuple(d.name for d in detections)
    unused = {d.name: with_flags(d.problem) for d in detections if d.problem}
    usable, others = usable_of(detections)
    unused |= others
    if not usable:
        raise ValueError(nothing_usable(detections))
    stage("Finding the focal lengths")
    source = "track" if job.video and job.focal not in (None, *MEASURED) else job.focal
    if job.video and job.focal is None:
        source = "board"
    if source is None and job.detector == "pitch" and not job.board and not any(d.focal for d in usable):
        source = "pitch"
    focals = choose_focals(usable, source, unit=job.focal_unit, board=job.board, sharing=job.sharing)
    made = None
    if job.detector == "grid":
        stage("Fitting the shape of the board")
        made = bundle_of(_having(usable, focals), focals, one_centre(job.centre), job.other_sharing)
        if focals.one_zoom and not made.of_one_zoom(focals.groups):
            focals = dataclasses.replace(choose_focals(usable, "plane"), one_zoom=False)
            made = bundle_of(_having(usable, focals), focals, one_centre(job.centre), job.other_sharing)
    unused |= {d.name: focals.absence(d) for d in usable if d.name not in focals.focal}
    used = _having(usable, focals)
    known = None
    if job.video is None and focals.known and focals.unit == "mm":
        photos = [Path(d.file) for d in used]
        known = known_lens(photos, [focals.focal[d.name] for d in used], used[0].image_size)
    bundle, told = (None, "") if made is None else (made.bundle, made.told)
    if bundle is not None and focals.origin == GRID:
        focals = bundle.measured(focals)
        unused |= {d.name: focals.absence(d) for d in used if d.name not in focals.focal}
        used = _having(used, focals)
    if job.focal_sigma is not None:
        sigma = focal_sigmas(job.focal_sigma, np.array(list(focals.focal.values())))
        focals = focals.deviating_by(dict(zip(focals.focal, sigma.tolist(), strict=True)))
    while True:
        shown = used if bundle is None else bundle.lines_used(used)
        lines = lines_of(shown, np.array([focals.focal[d.name] for d in used]), focals.unit)
        sigma = np.array([focals.deviation.get(d.name, 0.0) for d in used])
        model = dataclasses.replace(job.model, lens=known)
        begun(part := Part(lines, model, job.centre, sigma, _shared(used, focals)))
        widened = (lambda fit: fit) if bundle is None else bundle.widened
        with told_undetermined(job, images, used, unused):
            calibration = calibrate(**part.arguments(), widened=widened, stage=stage)
        done = ImageCalibration(job, calibration, used, focals, images, unused)
        done = dataclasses.replace(done, bundle=bundle, board_note=told, lens=known)
        hopeless = {d.name for d, rejected in zip(used, done.rejected(), strict=True) if rejected.all()}
        if not hopeless:
            return _with_findings(_with_equipment(done))
        unused = unused | dict.fromkeys(sorted(hopeless), _NONE_AGREES)
        used = tuple(d for d in used if d.name not in hopeless)


def _having(detections: Sequence[Detection], focals: Focals) -> tuple[Detection, ...]:
    """The images that have a focal length."""
    return tuple(d for d in detections if d.name in focals.focal)


def _shared(used: Sequence[Detection], focals: Focals) -> np.ndarray | None:
    """For each image a number, the same for those that share a focal length; None if none do."""
    if not focals.groups:
        return None
    own = np.arange(len(used))
    group = np.array([focals.number_of_group(detection.name) for detection in used])
    return np.where(group >= 0, len(used) + group, own)


def _with_equipment(done: ImageCalibration) -> ImageCalibration:
    """The same with camera and lens in the lens, as the photos used tell, and whether f is known."""
    if done.job.video is not None:
        return done
    photos = [Path(detection.file) for detection in done.used]
    zoom = done.calibration.fit
    lens = with_equipment(zoom.lens, photos)
    if not done.focals.known:
        lens = without_focal(lens)
    zoom = dataclasses.replace(zoom, lens=lens)
    return dataclasses.replace(done, calibration=dataclasses.replace(done.calibration, fit=zoom))


def _with_findings(done: ImageCalibration) -> ImageCalibration:
    """The same with what the photos and their focal lengths say about themselves in the verdict."""
    found = findings_of_focals(done.focals) + findings_of_edges(done.used)
    if done.job.video is None:
        found += findings_of_photos([Path(d.file) for d in done.used], done.used[0].image_size)
        others = sum(why.startswith(OTHER_SIZE) for why in done.unused.values())
        found += findings_of_sizes(others, len(done.used)) + _findings_of_exif(done)
        found += findings_of_turned(
            done.calibration.lines, done.calibration.fit.lens, [d.name for d in done.used]
        )
    done = _joined(done, found)
    options = sharing_options(done.used, done.focals, done.job.other_sharing)
    return _joined(done, findings_of_own_focals(options, done.calibration.assessment.verdict))


def _joined(done: ImageCalibration, found: Sequence[Finding]) -> ImageCalibration:
    """The same with more findings."""
    assessment = done.calibration.assessment.joined_by(found)
    calibration = dataclasses.replace(done.calibration, assessment=assessment)
    return dataclasses.replace(done, calibration=calibration)


def _findings_of_exif(done: ImageCalibration) -> list[Finding]:
    focals, used = done.focals, done.used
    in_mm = focals.known and focals.unit == "mm"
    return findings_of_exif(used, focals.focal, in_mm=in_mm, measured=done.job.focal in (None, *MEASURED))


_SUPPOSED = (
    "All photos are taken to be of one zoom: nothing says otherwise, and one focal length explains them. "
    "If they are of several, give --focal."
)

_OF_SEVERAL = "The photos are not all of one zoom: one focal length for all does not explain them."

_NONE_AGREES = "none of its lines is straight under the lens of the other images. Check its focal length"
