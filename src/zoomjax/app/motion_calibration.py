"""A calibration from how a clip moves: tracks, the fit to them, and a folder of results."""

import csv
import dataclasses
import importlib.metadata
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from .._core.text import with_std
from ..detect.batch import Detection
from ..fit.joining import joined
from ..fit.motion import LOOPS, fit_motion
from ..fit.motion_fit import MotionFit
from ..fit.result import RESULTS
from ..fit.zoom import CentreArgument
from ..io.video_reader import decode_video
from ..lines.lines import Lines
from ..models.zoom import PolynomialZoom
from ..tracks.again import find_again
from ..tracks.tracks import Tracks
from ..trust.assessment import VERDICTS, Finding, Verdict
from ..trust.bands import displacement_std
from .joined_shots import linked_well, turns_of_shots
from .model_choice import WantedModel
from .outward import outward

FILES = ("lens.json", "track.csv", "tracks.npz", "summary.json", "motion.png", "panorama.jpg")
"""What `MotionCalibration.make` writes."""

_LOOSE_SCALE = 0.01
"""Standard deviation of the common factor of focal lengths, relative, from which it is worth a word."""

_TOLD_SHUTTER = 0.1
"""Standard deviation of the readout, in frames, below which it is told."""

_ROUGH, _WRONG = 0.8, 1.2
"""px, of the noise of points: two and three times what the way of a point there and back may miss, so that
more is hardly noise. Much moves by itself, or what is seen is no camera that turns."""

_MISSED = 9.0  # times the noise, squared: views beyond do not follow the model
_FEW = 0.3  # of the views that do follow it: below, most of what is seen may move by itself
# Of the views that follow, the share for which the loss hardly flattens: 0.94 of noise alone. Where four of
# five points are on things that move, what these are off is taken for noise, and the share is 0.7 to 0.76.
_CLOSE = 0.77
_MANY = 9.0  # focal lengths, more than any model needs
_HARMLESS = 5e-4  # of the pupil's offset over distances: its standard deviation, by the test
_WORTH = 0.03  # share of more views for which it is fitted again
_LEAST_ZOOM = 1.2  # between the ends of the focal lengths


@dataclasses.dataclass(frozen=True)
class MotionCalibration:
    """The lens and the path of a camera, from a clip.

    Attributes:
        clip: the clip.
        tracks: what was followed in it.
        fit: the lens and the path.
        times: of each frame, its number in the file and its time, s; NaN where the file has none.
        lines: straight lines in its frames that were fitted, too.
    """

    clip: Path
    tracks: Tracks
    fit: MotionFit
    times: np.ndarray
    lines: Lines | None = None

    def following(self) -> float:
        """The share of the views that follow the model: the rest are on things that move, or mistakes."""
        return float(np.mean(self._missed() < _MISSED))

    def _missed(self) -> np.ndarray:
        """Of each view, the square of what it is off over where the loss begins to flatten."""
        residual = np.asarray(self.fit.residual)[np.asarray(self.tracks.mask)]
        return (residual / (2.3849 * float(self.fit.noise))) ** 2

    def corner(self) -> list[tuple[float, float, float]]:
        """Displacement of the image's corner, px, and its standard deviation, at some focal lengths."""
        lens = self.fit.lens
        low, high = (float(f) for f in lens.focal_range)
        focal = [low, float(np.sqrt(low * high)), high]
        corner = np.zeros(2)
        std = np.asarray(displacement_std(self.fit.fit, corner, focal=np.array(focal)))
        return list(zip(focal, outward(lens, corner, focal).tolist(), std.tolist(), strict=True))

    def scale_std(self) -> float:
        """Standard deviation of the factor common to all focal lengths, relative."""
        return float(np.sqrt(self.fit.covariance[-1, -1]))

    @property
    def findings(self) -> list[Finding]:
        """What the clip cannot tell, with what to do about it: the worst first; empty if all is good."""
        found = [*self._of_turning(), *self._of_zooming(), *self._of_points(), *self._of_frames()]
        return sorted(found, key=lambda of: -VERDICTS.index(of.verdict))

    def _of_turning(self) -> Iterator[Finding]:
        if self.fit.fit.result == RESULTS.undetermined:
            yield Finding(
                "turning",
                "not determined",
                "the camera hardly turns, so the scale of the focal lengths is not determined: only their "
                "ratios are. The lens straightens lines all the same.",
                "Film again and turn the camera by some 10 degrees or more while it zooms.",
            )
        elif self.fit.fit.result != RESULTS.successful:
            message = RESULTS[self.fit.fit.result]
            again = "Film a scene at rest again, and turn slowly."
            yield Finding("fit", "not determined", message[:1].lower() + message[1:], again)
        elif self.scale_std() > _LOOSE_SCALE:
            yield Finding(
                "scale",
                "doubtful",
                f"all focal lengths have a common factor that is known to {self.scale_std():.1%} only.",
                "Turn the camera farther while it zooms.",
            )

    def _of_zooming(self) -> Iterator[Finding]:
        low, high = (float(f) for f in self.fit.lens.focal_range)
        if high < _LEAST_ZOOM * low:
            yield Finding(
                "zoom",
                "good",
                f"the focal length hardly changes, {low:.0f} to {high:.0f} px: this is one zoom only.",
                "Zoom while you film, if the lens is to be known at other focal lengths.",
            )

    def _of_points(self) -> Iterator[Finding]:
        missed = self._missed()
        if (share := self.following()) < _FEW:
            yield Finding(
                "moving things",
                "not determined",
                f"only {share:.0%} of the tracked points move as a camera that turns makes them: much in "
                "the clip moves by itself, or the camera does not stand still.",
                "Use a tripod, and film a scene at rest.",
            )
        elif (close := float(np.mean(missed[missed < _MISSED] < 1))) < _CLOSE:
            yield Finding(
                "moving things",
                "doubtful",
                f"only {close:.0%} of the points that follow the camera do so as closely as noise lets "
                "them: many may be on things that move.",
                "Use a tripod, and film a scene at rest.",
            )
        yield from self._of_parallax()
        if (noise := float(self.fit.noise)) > _ROUGH:
            yield Finding(
                "noise",
                "doubtful" if noise <= _WRONG else "not determined",
                f"points are off the model by {noise:.2f} px: the clip is blurred, much in it moves by "
                "itself, or things near the camera shift as it turns.",
                "Turn more slowly, and film a scene at rest.",
            )

    def _of_parallax(self) -> Iterator[Finding]:
        if (spread := float(self.fit.lever_std)) > 0:
            yield Finding(
                "parallax",
                "doubtful" if float(self.fit.parallax) > _HARMLESS else "good",
                "near points move differently from far ones as the camera turns, by a share of "
                f"{spread:.2%}: its entrance pupil is off the axis of rotation. That is modelled, but the "
                "part that all points share looks like a lens, and is assumed: focal lengths may be off by "
                "once or twice that share, and the lens with them. The bands allow for that.",
                "Turn the camera about its entrance pupil, or film what is farther away.",
            )

    def _of_frames(self) -> Iterator[Finding]:
        shots, scenes = (int(np.max(np.asarray(of))) + 1 for of in (self.fit.shot, self.fit.scene))
        if shots > 1:
            told = "All shots show one scene, and are joined. They share one lens."
            if scenes > 1:
                told = (
                    f"Its {shots} shots show {scenes} scenes. They share one lens, but how the camera "
                    "turned between scenes is not known; the panorama is of the longest."
                )
            yield Finding(
                "cuts",
                "good",
                f"the clip has {shots - 1} cut{'s' * (shots > 2)}. {told}",
                "Check that all of them were filmed with the same lens.",
            )
        if missing := int(np.sum(~np.isfinite(np.asarray(self.fit.focal)))):
            yield Finding(
                "frames without points",
                "good",
                f"{missing} frames show nothing that can be followed: their f is interpolated.",
                "Look at these frames in the corrected clip.",
            )

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
        pan, tilt = np.ptp(np.asarray(self.fit.pan_and_tilt), axis=0)
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
                f"Time from the first row to the last: {float(self.fit.readout):.2f} ± "
                f"{float(self.fit.readout_std):.2g} of a frame"
            )
        return [
            f"\n{views:,} views of {len(self.tracks.number):,} points in {self.tracks.frames:,} frames",
            *more,
            f"Standard deviation of the common scale of the focal lengths: {self.scale_std():.2%}",
            f"Centre of distortion: ({where[0][0]:.1f}, {where[0][1]:.1f}) px at {low:.0f} px, "
            f"({where[1][0]:.1f}, {where[1][1]:.1f}) px at {high:.0f} px",
            f"The correction moves a corner by {', '.join(corner)}.",
            "Check panorama.jpg: where things that do not move are blurred, there are errors.",
        ]

    def summary(self) -> dict[str, Any]:
        """All figures as plain numbers and strings, for JSON."""
        fit, lens = self.fit, self.fit.lens
        return {
            "verdict": self.verdict,
            "verdict_sentence": self.sentence,
            "findings": [dataclasses.asdict(finding) for finding in self.findings],
            "clip": self.clip.name,
            "frames": self.tracks.frames,
            "tracks": len(self.tracks.number),
            "views": int(np.sum(np.asarray(self.tracks.mask))),
            "views_that_follow": self.following(),
            "noise": float(fit.noise),
            "lines": 0 if self.lines is None else len(self.lines.frame),
            "line_noise": None if self.lines is None else float(fit.line_noise),
            "readout": float(fit.readout),
            "readout_std": float(fit.readout_std),
            "rms": float(fit.fit.rms),
            "focal_range": [float(f) for f in lens.focal_range],
            "focal_unit": lens.focal_unit,
            "focal_scale_std": self.scale_std(),
            "turned": np.ptp(np.asarray(self.fit.pan_and_tilt), axis=0).tolist(),
            "shots": int(np.max(np.asarray(fit.shot))) + 1,
            "scenes": int(np.max(np.asarray(fit.scene))) + 1,
            "image_size": list(lens.image_size),
            "result": RESULTS[fit.fit.result] or "successful",
            "corner_displacement": [{"focal": f, "px": px, "std": std} for f, px, std in self.corner()],
            "parameters": np.asarray(lens.zoom.parameters).tolist(),
            "versions": {
                name: importlib.metadata.version(name) for name in ("zoomjax", "jax", "optimistix")
            },
        }

    def write_track(self, path: Path) -> None:
        """Write ``frame,seconds,focal,sigma``, which `undistort` takes; focal and sigma in px.

        Between frames of which f is known 1/f is interpolated. The farther from these, the less is that
        known: f may have changed as fast as in the fastest tenth of the frames.
        """
        focal, std = (np.asarray(values) for values in (self.fit.focal, self.fit.focal_std))
        known = np.flatnonzero(np.isfinite(focal))
        every = np.arange(len(focal))
        place = np.searchsorted(known, every)
        beside = known[np.clip([place - 1, place], 0, len(known) - 1)]
        far = np.min(np.abs(beside - every), axis=0)
        changes = np.abs(np.diff(focal))
        changes = changes[np.isfinite(changes)]
        fast = np.quantile(changes, 0.9) if len(changes) else 0.0
        focal = 1 / np.interp(every, known, 1 / focal[known])
        std = np.hypot(np.interp(every, known, std[known]), far * fast)
        with path.open("w", newline="") as file:
            table = csv.writer(file)
            table.writerow(["frame", "seconds", "focal", "sigma"])
            for (number, seconds), f, sigma in zip(self.times.tolist(), focal, std, strict=True):
                table.writerow([int(number), f"{seconds:.4f}", f"{f:.4f}", f"{sigma:.4f}"])

    def make(self, folder: Path, stage: Callable[[str], None] = lambda _: None) -> None:
        """Write the files of `FILES` into an empty folder."""
        from .motion_plot import plot_motion  # so that the rest does not need Matplotlib
        from .panorama import write_panorama
        from .plot import save_plot

        stage("Writing the results")
        self.fit.lens.save(folder / "lens.json")
        self.tracks.save(folder / "tracks.npz")
        self.write_track(folder / "track.csv")
        (folder / "summary.json").write_text(json.dumps(self.summary(), indent=2) + "\n")
        save_plot(plot_motion(self.fit), folder / "motion.png")
        stage("Joining frames into a panorama")
        write_panorama(self.clip, self.fit, folder / "panorama.jpg")


def calibrate_motion(
    clip: Path,
    tracks: Tracks,
    *,
    found: Sequence[Detection] = (),
    model: WantedModel = WantedModel(),  # noqa: B008, it is frozen
    centre: CentreArgument = "fit",
    stage: Callable[[str], None] = lambda _: None,
) -> MotionCalibration:
    """Fit the path of the camera and the lens to what was followed in a clip.

    Args:
        clip: the clip.
        tracks: of `track_video`.
        found: lines in frames of the clip, by `video_frames` and `detect`.
        model: the zoom model; by default a polynomial of degree 2 in 1/f with two coefficients.
        centre: the centre of distortion: "fit", linear in 1/f, or "image".
        stage: called with a description before each step that takes time.

    Raises:
        ValueError: float64 is not enabled.
        RuntimeError: the fit failed.
    """
    with decode_video(clip) as (_, frames):
        times = np.array([(number, time) for number, time, _ in frames], float)
    stage("Fitting the camera's path and the lens")
    candidate = model.base(np.arange(1.0, _MANY))
    shift = PolynomialZoom(degree=1) if centre == "fit" else None
    lines, line_frames = _lines_of(found, times)

    def fitted(tracks, begin=None):
        fit = fit_motion(
            tracks,
            begin=begin,
            zoom=candidate.zoom,
            terms=candidate.terms,
            shift=shift,
            lines=lines,
            line_frames=line_frames,
        )
        return jax.block_until_ready(fit)

    fit = begin = fitted(tracks)
    turns = []
    if fit.shot.max() > 0 and fit.fit.result == RESULTS.successful:
        stage("Joining shots of the same scene")
        turns = turns_of_shots(clip, fit, tracks)
        fit, begin = (joined(fit, tracks, turns, scaled=scaled) for scaled in (False, True))
    if tracks.frames <= LOOPS and fit.fit.result == RESULTS.successful:
        stage("Finding points again where the camera comes back")
        more = linked_well(find_again(clip, tracks, carry=begin.carried), fit)
        if np.sum(more.mask) > (1 + (0 if turns else _WORTH)) * np.sum(tracks.mask):
            stage("Fitting the path that is closed")
            tracks, fit = more, fitted(more, begin)
    return MotionCalibration(clip, tracks, fit, times, lines)


def _lines_of(found, times):
    """All lines, and the numbers of their frames among those of the tracks."""
    seen = [detection for detection in found if detection.lines]
    if not seen:
        return None, None
    number = [int(Path(detection.name).stem.rpartition("-")[2]) for detection in seen]  # of `video_frames`
    lines = Lines.from_ragged(
        [line for detection in seen for line in detection.lines],
        np.repeat(np.arange(len(seen)), [len(detection.lines) for detection in seen]),
        np.ones(len(seen)),
        image_size=seen[0].image_size,
        focal_unit="px",
    )
    return lines, np.searchsorted(times[:, 0], number)
