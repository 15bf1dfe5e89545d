"""A calibration from how a clip moves: tracks, the fit to them, and a folder of results."""

import csv
import dataclasses
import functools
import importlib.metadata
import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from .._core.text import with_std
from ..detect.batch import Detection
from ..fit.contradiction import CONTRADICTED, OTHER_LENS
from ..fit.joining import join_shots
from ..fit.losses import IGNORED_LINE
from ..fit.motion import LOOPS, fit_motion
from ..fit.motion_fit import MotionFit
from ..fit.result import RESULTS
from ..fit.shots import linked_well, shot_turns
from ..fit.zoom import CentreArgument
from ..lines.lines import Lines
from ..models.about import RELATIVE
from ..models.lens import ZoomLens
from ..models.registry import distortion_model_name
from ..models.zoom import PolynomialZoom
from ..tracks.again import find_again
from ..tracks.key_frames import KeyFrames
from ..tracks.repeats import originals
from ..tracks.tracks import Tracks
from ..trust.assessment import VERDICTS, Finding, Verdict
from ..trust.bands import displacement_std
from ._flags import with_flags
from .clip_lines import MOST, draw_frames, frames_with_lines, image_rows, lines_of_frames
from .coefficients import coefficient_rows, finite, pixel_polynomials
from .frame_findings import frames_of, repeated_frames
from .heard import passed_on
from .known_focals import KnownFocals
from .model_choice import WantedModel
from .motion_figures import all_focals, centre_summary, frame_rows, line_rms, rms_uncorrected, turned
from .motion_findings import (
    findings_of_motion,
    following,
    follows,
    is_relative,
    scale_std,
    with_contradictions,
)
from .outward import outward
from .relative import NOTE, SENTENCE

FILES = ("lens.json", "track.csv", "tracks.npz", "summary.json", "motion.png", "panorama.jpg")
"""What `MotionCalibration.make` writes; where lines were fitted, too, also lines.npz and lines/."""

_CONTRADICTION = rf".* known focal lengths contradict the tracks|{CONTRADICTED}|{OTHER_LENS}"
"""Warnings of `fit_motion`, of which findings tell."""
_TOLD_SHUTTER = 0.1
"""Standard deviation of the readout, in frames, below which it is told."""

_MANY = 9.0  # focal lengths, more than any model needs
_FEWEST = 4  # different frames, as a polynomial of degree 2 takes three
_WORTH = 0.03  # share of more views for which it is fitted again


@dataclasses.dataclass(frozen=True)
class MotionCalibration:
    """The lens and the path of a camera, from a clip.

    Attributes:
        clip: the clip.
        tracks: what was followed in it.
        fit: the lens and the path.
        times: of each frame, its number in the file and its time, s; NaN where the file has none.
        found: what was found in frames in which lines were searched for.
        lines: the lines, each frame with its f; None if none were.
        known: focal lengths that were known beforehand.
        warnings: what the user was warned of on the way.
        contradicted: how tracks contradict the scale of what was known, or one lens of all shots.
    """

    clip: Path
    tracks: Tracks
    fit: MotionFit
    times: np.ndarray
    found: tuple[Detection, ...] = ()
    lines: Lines | None = None
    known: KnownFocals | None = None
    warnings: tuple[str, ...] = ()
    contradicted: tuple[str, ...] = ()

    def following(self) -> float:
        """The share of the views that follow the model: the rest are on things that move, or mistakes."""
        return following(self.fit, self.tracks)

    def corner(self) -> list[tuple[float, float, float]]:
        """Displacement of the image's corner, px, and its standard deviation, at some focal lengths."""
        lens = self.fit.lens
        low, high = (float(f) for f in lens.focal_range)
        focal = [low, float(np.sqrt(low * high)), high]
        corner = np.zeros(2)
        std = np.asarray(displacement_std(self.fit.fit, corner, focal=np.array(focal)))
        return list(zip(focal, outward(lens, corner, focal).tolist(), std.tolist(), strict=True))

    def known_of_frames(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Of each frame the focal length that was known and its standard deviation; None if none was."""
        return None if self.known is None else self.known.of_frames(self.times[:, 0])

    def scale_std(self) -> float:
        """Standard deviation of the factor common to all focal lengths, relative."""
        return scale_std(self.fit)

    def is_relative(self) -> bool:
        """Whether only the ratios of focal lengths are known."""
        return is_relative(self.fit)

    @property
    def lens(self) -> ZoomLens:
        """The lens, which says so where its focal lengths are relative."""
        lens = self.fit.lens
        if not self.is_relative():
            return lens
        return dataclasses.replace(lens, about={**lens.about, "focal": RELATIVE})

    @functools.cached_property
    def line_rms(self) -> np.ndarray:
        """RMS distance of each line's points from straight under the lens, px of the image."""
        return np.zeros(0) if self.lines is None else line_rms(self.fit, self.lines)

    @property
    def rejected(self) -> np.ndarray:
        """Which lines are too far from straight to count."""
        return self.line_rms > IGNORED_LINE * float(self.fit.line_noise)

    @functools.cached_property
    def rms_uncorrected(self) -> float:
        """RMS distance, px, of views that follow from where the path alone puts them, without a lens."""
        return rms_uncorrected(self.fit, self.tracks, follows(self.fit, self.tracks))

    @functools.cached_property
    def findings(self) -> list[Finding]:
        """What the clip cannot tell, with what to do about it: the worst first; empty if all is good."""
        numbers = self.times[:, 0].astype(int)
        found = findings_of_motion(self.fit, self.tracks, self.known_of_frames(), numbers=numbers)
        return with_contradictions(found, self.contradicted)

    @property
    def verdict(self) -> Verdict:
        """The worst of the findings' verdicts; "good" if there are none."""
        return VERDICTS[max((VERDICTS.index(of.verdict) for of in self.findings), default=0)]

    @property
    def sentence(self) -> str:
        """The verdict and its main reason."""
        if self.verdict != "good":
            return f"{self.verdict.capitalize()}: {self.findings[0].found}"
        low, high = (float(f) for f in self.fit.lens.focal_range)
        pan, tilt = turned(self.fit)
        return (
            f"Good: {self.following():.0%} of the tracked points follow a camera that turns by {pan:.1f} "
            f"by {tilt:.1f} degrees and zooms from {low:.0f} to {high:.0f} px, within "
            f"{float(self.fit.noise):.2f} px."
        )

    def figures(self) -> list[str]:
        """The figures, in lines of text."""
        views = int(np.sum(np.asarray(self.tracks.mask)))
        corner = [f"{with_std(moved, std, 'px')} at {f:.4g} px" for f, moved, std in self.corner()]
        lens = self.fit.lens
        low, high = (float(f) for f in lens.focal_range)
        where = [np.asarray(lens(f).centre) for f in (low, high)]
        more = []
        if self.lines is not None:
            lines = self.lines
            more.append(
                f"{len(lines.frame):,} straight lines in {len(lines.focal):,} of them, "
                f"off by {float(self.fit.line_noise):.2f} px"
            )
        if float(self.fit.readout_std) < _TOLD_SHUTTER:
            more.append(
                "Time from the first row to the last: "
                + with_std(float(self.fit.readout), float(self.fit.readout_std), "of a frame")
            )
        return [
            f"\n{views:,} views of {len(self.tracks.number):,} points in {self.tracks.frames:,} frames",
            *more,
            SENTENCE
            if self.is_relative()
            else f"Standard deviation of the common scale of the focal lengths: {self.scale_std():.2%}",
            f"Centre of distortion: ({where[0][0]:.1f}, {where[0][1]:.1f}) px at {low:.0f} px, "
            f"({where[1][0]:.1f}, {where[1][1]:.1f}) px at {high:.0f} px",
            f"Distance of points that follow: {self.rms_uncorrected:.2f} px without a correction, "
            f"{float(self.fit.fit.rms):.2f} px with it (RMS)",
            f"The correction moves a corner by {', '.join(corner)}.",
            "Check panorama.jpg: where things that do not move are blurred, there are errors.",
        ]

    def summary(self) -> dict[str, Any]:
        """All figures as plain numbers and strings, for JSON: under the names of `Calibration.summary`."""
        fit, lens = self.fit, self.fit.lens
        readout, readout_std, scale = finite([float(fit.readout), float(fit.readout_std), self.scale_std()])
        return {
            "verdict": self.verdict,
            "verdict_sentence": self.sentence,
            "findings": [dataclasses.asdict(finding) for finding in self.findings],
            "warnings": list(self.warnings),
            "clip": self.clip.name,
            "frames": self.tracks.frames,
            "repeated_frames": repeated_frames(self.tracks),
            "frames_without_points": int(np.sum(~np.isfinite(np.asarray(fit.focal)))),
            "tracks": len(self.tracks.number),
            "views": int(np.sum(np.asarray(self.tracks.mask))),
            "views_that_follow": self.following(),
            "noise": float(fit.noise),
            **self._of_lines(),
            "readout": readout,
            "readout_std": readout_std,
            "distances": "distorted image",
            "rms_none": self.rms_uncorrected,
            "rms_zoom": float(fit.fit.rms),
            "rms": float(fit.fit.rms),
            "rms_unconstrained": float(fit.fit.rms_unconstrained),
            "focal_range": [float(f) for f in lens.focal_range],
            "focal_unit": lens.focal_unit,
            "focal_source": "motion",
            "focal_known": not self.is_relative(),
            "focal_scale": "relative" if self.is_relative() else "absolute",
            "focal_scale_std": scale,
            "known_focal": [] if self.known is None else self.known.rows(),
            "turned": list(turned(fit)),
            "shots": int(np.max(np.asarray(fit.shot))) + 1,
            "scenes": int(np.max(np.asarray(fit.scene))) + 1,
            "image_size": list(lens.image_size),
            "result": RESULTS[fit.fit.result] or "successful",
            "certificate": {k: np.asarray(v).item() for k, v in vars(fit.fit.certificate).items()},
            "model": type(lens.zoom).__name__,
            "distortion_model": distortion_model_name(lens.distortion_model),
            "centre": centre_summary(fit),
            "pixel_polynomials": pixel_polynomials(lens).tolist(),
            "coefficients": coefficient_rows(lens),
            "parameters": np.asarray(lens.zoom.parameters).tolist(),
            "parameter_sigma": finite(np.sqrt(np.diag(np.asarray(fit.fit.covariance)))),
            "corner_displacement": [
                {"focal": f, "px": moved, "std": finite([std])[0]} for f, moved, std in self.corner()
            ],
            "per_frame": frame_rows(fit, self.tracks, self.times),
            "versions": {
                name: importlib.metadata.version(name) for name in ("zoomjax", "jax", "optimistix")
            },
        }

    def _of_lines(self) -> dict[str, Any]:
        """What the summary says of lines."""
        if self.lines is None:
            return {"lines": 0, "line_noise": None}
        frame = np.asarray(self.lines.frame)
        std = all_focals(self.fit)[1][frames_with_lines(self.found, self.times[:, 0])]
        worst = np.flatnonzero(self.rejected)[np.argsort(-self.line_rms[self.rejected])]
        return {
            "lines": len(frame),
            "line_noise": float(self.fit.line_noise),
            "rejected_lines": int(self.rejected.sum()),
            "rejected": [
                {"line": int(line), "frame": int(frame[line]), "rms": float(self.line_rms[line])}
                for line in worst
            ],
            "points": int(np.sum(np.asarray(self.lines.mask))),
            "images": image_rows(self.found, self.lines, std, self.rejected),
            "unused": {of.name: with_flags(of.problem) for of in self.found if not of.lines},
        }

    def write_track(self, path: Path) -> None:
        """Write ``frame,seconds,focal,sigma``, which `undistort` takes; focal and sigma in px.

        Where focal lengths are relative, a comment before that says so.
        """
        focal, std = all_focals(self.fit)
        with path.open("w", newline="") as file:
            if self.is_relative():
                file.write(NOTE + "\n")
            table = csv.writer(file)
            table.writerow(["frame", "seconds", "focal", "sigma"])
            for (number, seconds), f, sigma in zip(self.times.tolist(), focal, std, strict=True):
                time = f"{seconds:.4f}" if np.isfinite(seconds) else ""
                table.writerow([int(number), time, f"{f:.4f}", f"{sigma:.4f}"])

    def make(
        self,
        folder: Path,
        stage: Callable[[str], None] = lambda _: None,
        *,
        overlays: str = "some",
        about: Mapping[str, Any] | None = None,
    ) -> None:
        """Write the files of `FILES`, and of lines lines.npz and pictures in lines/, into an empty folder.

        Args:
            folder: the folder.
            stage: called with a description before each step that takes time.
            overlays: which frames to draw with their lines: "some", "all" or "none".
            about: more entries of summary.json.
        """
        from .motion_plot import plot_motion  # so that the rest does not need Matplotlib
        from .panorama import write_panorama
        from .plot import save_plot

        stage("Writing the results")
        self.lens.save(folder / "lens.json")
        self.tracks.save(folder / "tracks.npz")
        self.write_track(folder / "track.csv")
        summary = self.summary() | dict(about or {})
        (folder / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
        save_plot(plot_motion(self.fit), folder / "motion.png")
        stage("Joining frames into a panorama")
        write_panorama(self.clip, self.fit, folder / "panorama.jpg")
        if self.lines is not None:
            stage("Drawing the lines")
            self.lines.save(folder / "lines.npz")
            of_lines = self.lines, self.line_rms, self.rejected
            draw_frames(self.clip, self.found, *of_lines, folder / "lines", most=MOST[overlays])


def calibrate_motion(
    clip: Path,
    tracks: Tracks,
    *,
    found: Sequence[Detection] = (),
    known: KnownFocals | None = None,
    model: WantedModel = WantedModel(),  # noqa: B008, it is frozen
    centre: CentreArgument = "fit",
    stage: Callable[[str], None] = lambda _: None,
) -> MotionCalibration:
    """Fit the path of the camera and the lens to what was followed in a clip.

    Args:
        clip: the clip.
        tracks: of `track_video`.
        found: lines in frames of the clip, by `video_frames` and `detect`.
        known: focal lengths that are known beforehand.
        model: the zoom and distortion model; by default polynomials of degree 2 in 1/f for two radial
            coefficients.
        centre: the centre of distortion: "fit", linear in 1/f, or "image".
        stage: called with a description before each step that takes time.

    Raises:
        ValueError: float64 is not enabled, the clip does not move, or a known focal length is of a frame
            that is not there.
        RuntimeError: the fit failed.
    """
    times = frames_of(clip)
    if (moments := len(np.unique(originals(tracks)))) < _FEWEST:
        raise ValueError(
            f"{clip} shows {moments} frame{'s' * (moments > 1)} and copies: f is found from how it moves."
        )
    focal, focal_std = (None, None) if known is None else known.of_frames(times[:, 0])
    stage("Fitting the camera's path and the lens")
    candidate = model.base(np.arange(1.0, _MANY))
    shift = PolynomialZoom(degree=1) if centre == "fit" else None
    lines, line_frames = lines_of_frames(found, times[:, 0])

    def fitted(tracks, begin=None):
        with warnings.catch_warnings(record=True) as caught:
            warnings.filterwarnings("always", _CONTRADICTION)
            fit = fit_motion(
                tracks,
                begin=begin,
                zoom=candidate.zoom,
                distortion_model=candidate.distortion_model,
                terms=candidate.terms,
                shift=shift,
                lines=lines,
                line_frames=line_frames,
                focal=focal,
                focal_std=focal_std,
            )
        told = passed_on(caught, but=_CONTRADICTION)
        contradicted.extend(of for of in told if of.startswith((CONTRADICTED, OTHER_LENS)))
        return jax.block_until_ready(fit)

    contradicted, turns = list[str](), []
    fit = begin = fitted(tracks)
    if fit.shot.max() > 0 and fit.fit.result == RESULTS.successful:
        stage("Joining shots of the same scene")
        turns = shot_turns(fit, tracks, look=functools.partial(KeyFrames, clip))
    if turns:
        begin = join_shots(fit, turns, tracks=tracks, scaled=True)
        fit = join_shots(fit, turns, tracks=tracks)
    if tracks.frames <= LOOPS and fit.fit.result == RESULTS.successful:
        stage("Finding points again where the camera comes back")
        more = linked_well(find_again(clip, tracks, carry=begin.carried), fit)
        if np.sum(more.mask) > (1 + (0 if turns else _WORTH)) * np.sum(tracks.mask):
            stage("Fitting the path that is closed")
            tracks, fit = more, fitted(more, begin)
    if lines is not None:
        lines = eqx.tree_at(lambda lines: lines.focal, lines, all_focals(fit)[0][line_frames])
    return MotionCalibration(clip, tracks, fit, times, tuple(found), lines, known, (), tuple(contradicted))
