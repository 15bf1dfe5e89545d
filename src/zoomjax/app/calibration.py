"""What a calibration found: the fits, the key figures, and a folder of results.

It prints nothing; plots are made by `plot`.
"""

import dataclasses
import functools
import importlib.metadata
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from .._core.arguments import kinds_checked
from .._core.text import percentages, span
from .._core.types import AnyArray
from ..fit.result import RESULTS, FrameFits, ZoomFit, is_status
from ..lines.lines import Lines
from ..models.about import RELATIVE, UNKNOWN
from ..models.registry import distortion_model_name
from ..models.zoom import PolynomialZoom
from ..trust.assessment import NEGLIGIBLE, Assessment
from ..trust.bands import displacement_std
from ..trust.misfit import FEWEST
from ..trust.next_photo import Suggestion
from ..trust.own_centres import OwnCentres
from ..trust.selection import Selection
from .centre_found import CentreFound
from .coefficients import coefficient_names, coefficient_rows, finite, pixel_polynomials
from .outward import middle_centre, outward
from .results_folder import OF_A_LENS, results_folder

FILES = ("lens.json", "lines.npz", "summary.json", "model.png")
"""What `Calibration.write` writes."""

_LITTLE = 0.01
"""Share of the RMS that weights may change without a word."""

_NAMES = {"corrected": "corrected photo", "one for all frames": "model"}

_ENOUGH = NEGLIGIBLE / 5
"""Standard deviation of the displacement, in diagonals, below which no further photo is needed."""


@dataclasses.dataclass(frozen=True)
class Calibration:
    """The zoom model fitted to lines, and the fits it is compared with.

    Attributes:
        lines: the lines.
        fit: the zoom model's fit.
        frames: separate fits of the frames.
        rms_uncorrected, rms_algebraic: each frame's RMS, px, without correction and with the algebraic
            estimate, which is None for another distortion model than the radial polynomial.
        rejected: which lines have weight 0: left out by hand, or not straight in the scene.
        line_rms: RMS of each line under the zoom model, px, rejected lines included.
        next_photo: the photo that would reduce the uncertainty most.
        focal_sigma: standard deviation of each frame's focal length, included in the bands; 0: exact.
        rms_held_out: each frame's RMS, px, under the zoom model of all others; NaN if that fit fails.
        rms_frames_held_out: that of each tenth of a frame's lines under the model of its other lines.
        centre: the centre of distortion, and how it was found.
        assessment: the verdict, with what was found and what to do about it.
        selection: how the model was selected; None if it was given.
        own_centres: the centres of single frames; None where there are none to tell.
        in_image: whether all RMS are of distances in the distorted image, not in the corrected one.
    """

    lines: Lines
    fit: ZoomFit
    frames: FrameFits
    rms_uncorrected: np.ndarray
    rms_algebraic: np.ndarray | None
    rejected: np.ndarray
    line_rms: np.ndarray
    next_photo: Suggestion
    focal_sigma: np.ndarray
    rms_held_out: np.ndarray
    rms_frames_held_out: np.ndarray
    centre: CentreFound
    assessment: Assessment
    selection: Selection | None = None
    own_centres: OwnCentres | None = None
    in_image: bool = True

    @functools.cached_property
    def corner(self) -> list[tuple[float, float, float]]:
        """Displacement of the farthest corner at both ends of the focal range and in its middle.

        For each focal length: the focal length, the displacement away from the centre, px, of the corner
        farthest from it, and the standard deviation of the displacement, px.
        """
        lens = self.fit.lens
        low, high = (float(f) for f in lens.focal_range)
        centre = middle_centre(lens)
        last = np.array(lens.image_size) - 1
        corner = np.where(centre > last / 2, 0.0, last)
        focal = [low, *([float(np.sqrt(low * high)), high] if high > low else [])]
        std = np.asarray(displacement_std(self.fit, corner, focal=np.array(focal)))
        return list(zip(focal, outward(lens, corner, focal).tolist(), std.tolist(), strict=True))

    @property
    def focal_known(self) -> bool:
        """Whether f is known: of one photo alone, a number may stand for it."""
        return self.fit.lens.about.get("focal") != UNKNOWN

    def focal_text(self) -> str:
        """The range of focal lengths in words."""
        low, high = (float(f) for f in self.fit.lens.focal_range)
        if not self.focal_known:
            return "focal length not known"
        return f"f = {span(low, high, self.fit.lens.focal_unit)}"

    def allowed_for(self) -> str:
        """Sentences on what the bands include and what not; empty if there is nothing to say."""
        share, told = self.focal_sigma / np.asarray(self.lines.focal), []
        if share.any():
            told = [f"include those of the focal lengths, {percentages(share)}, one error for all of one f"]
        if np.unique(np.asarray(self.lines.frame)).size < FEWEST:
            told.append(
                f"do not include errors of the model and of its centre, which take {FEWEST} photos to tell"
            )
        noise = " What the next photo would improve is of the noise alone." if share.any() else ""
        return f"Standard deviations {', and '.join(told)}.{noise}" if told else ""

    def enough(self) -> bool:
        """Whether a further photo could improve nothing that can be seen."""
        visible = _ENOUGH * self.assessment.evidence.diagonal
        return self.assessment.verdict == "good" and self.next_photo.before < visible

    def advice(self) -> str:
        """What to photograph next, or that there is enough, or that something else comes first."""
        causes = [finding.advice for finding in self.assessment.findings if finding.cause]
        if causes:
            return f"{causes[0]} That comes before another photo."
        photo = self.next_photo
        if not self.enough():
            return (
                photo.sentence if self.focal_known else dataclasses.replace(photo, focal_unit="").sentence
            )
        return (
            "Enough: the standard deviation that noise gives the displacement, in the geometric mean over "
            f"image and focal range, is {photo.before:.2g} px, {photo.after:.2g} px with the best photo."
        )

    def rows(self) -> list[tuple[str, np.ndarray]]:
        """Rows of a table like the paper's Table 1: the correction and each frame's RMS, px."""
        if len(self.rms_uncorrected) == 1:  # then all models of the zoom are that of the frame
            return [("no correction", self.rms_uncorrected), (self.kind, np.asarray(self.fit.frame_rms))]
        return [
            ("no correction", self.rms_uncorrected),
            ("frame by frame", np.asarray(self.frames.frame_rms)),
            *([] if self.rms_algebraic is None else [(f"{self.kind} (algebraic)", self.rms_algebraic)]),
            (self.kind, np.asarray(self.fit.frame_rms)),
        ]

    @property
    def kind(self) -> str:
        """What the model is called in tables."""
        if len(self.rms_uncorrected) == 1:
            return "corrected"
        if np.unique(np.asarray(self.lines.focal)).size == 1:
            return "one for all frames"
        return "zoom polynomial" if isinstance(self.fit.lens.zoom, PolynomialZoom) else "zoom model"

    def held_out_rows(self) -> dict[str, np.ndarray]:
        """For some of the `rows`, each frame's RMS on lines that were not used in the fit, px."""
        if len(self.rms_uncorrected) == 1:
            return {self.kind: self.rms_frames_held_out}
        return {"frame by frame": self.rms_frames_held_out, self.kind: self.rms_held_out}

    @property
    def held_out(self) -> str:
        """What `held_out_rows` are of, in a sentence."""
        if len(self.rms_uncorrected) == 1:
            return "Held out: each tenth of the lines, under the model of the others."
        return (
            "Held out: each frame, under the model of the others; frame by frame, each tenth of its lines."
        )

    @property
    def rms_equal(self) -> float:
        """RMS under the zoom model, px, if all lines that count weighed the same."""
        kept, frame = ~self.rejected, np.asarray(self.lines.frame)
        square, number = (
            np.bincount(frame[kept], of, len(self.rms_uncorrected))
            for of in (self.line_rms[kept] ** 2, None)
        )
        return rms_over_frames(np.sqrt(square / np.where(number > 0, number, np.nan)))

    @property
    def weighting(self) -> str:
        """What the weights of lines do to the RMS values, in sentences; empty where that is little."""
        if abs(self.rms_equal - float(self.fit.rms)) <= _LITTLE * float(self.fit.rms):
            return ""
        name = _NAMES.get(self.kind, self.kind)
        return (
            "Lines have weights in these values, the lower the more they stand out from the others. If all "
            f"that are not rejected weighed the same, that of the {name} would be {self.rms_equal:.4f} px."
        )

    def warnings(self, names: Sequence[str] | None = None) -> list[str]:
        """User-facing warnings about the zoom model, and about frames without a good fit.

        `names` are the names of the frames; by default their numbers, from 0.
        """
        warnings = [] if is_status(result := self.fit.result, RESULTS.successful) else [RESULTS[result]]
        for message in dict.fromkeys(filter(None, messages := self.frames.messages())):
            frames = [
                names[frame] if names else str(frame)
                for frame, other in enumerate(messages)
                if other == message
            ]
            which = ", ".join(frames[:8]) + (", ..." if len(frames) > 8 else "")
            warnings.append(
                f"{len(frames)} of {len(messages)} frames have no good separate fit "
                f"(frames {which}). {message}"
            )
        return warnings

    def summary(self) -> dict[str, Any]:
        """All figures as plain numbers and strings, for JSON; computed once."""
        return dict(self._summary)

    @functools.cached_property
    def _summary(self) -> dict[str, Any]:
        lens = self.fit.lens
        frame = np.asarray(self.lines.frame)
        fits = {
            "frame": range(len(self.rms_uncorrected)),
            "focal": np.asarray(self.lines.focal).tolist(),
            "focal_sigma": self.focal_sigma.tolist(),
            "lines": np.bincount(frame, minlength=len(self.rms_uncorrected)).tolist(),
            "rms_none": finite(self.rms_uncorrected),
            "rms_frames": finite(np.asarray(self.frames.frame_rms)),
            "rms_zoom": finite(np.asarray(self.fit.frame_rms)),
            "rms_held_out": finite(self.rms_held_out),
            "rms_frames_held_out": finite(self.rms_frames_held_out),
        }
        return (
            self.assessment.summary()
            | {
                "distances": "distorted image" if self.in_image else "corrected image",
                "rms_none": rms_over_frames(self.rms_uncorrected),
                "rms_algebraic": None if (of := self.rms_algebraic) is None else rms_over_frames(of),
                "rms_frames": float(self.frames.rms),
                "rms_zoom": float(self.fit.rms),
                "rms_zoom_equal_weights": finite([self.rms_equal])[0],
                "rms_held_out": finite([rms_over_frames(self.rms_held_out)])[0],
                "rms_frames_held_out": finite([rms_over_frames(self.rms_frames_held_out)])[0],
                "frames": len(self.rms_uncorrected),
                "lines": len(frame),
                "rejected_lines": int(self.rejected.sum()),
                "rejected": [
                    {"line": int(line), "frame": int(frame[line]), "rms": float(self.line_rms[line])}
                    for line in np.flatnonzero(self.rejected)[np.argsort(-self.line_rms[self.rejected])]
                ],
                "points": int(np.sum(np.asarray(self.lines.mask))),
                "focal_range": np.asarray(lens.focal_range).tolist(),
                "focal_known": self.focal_known,
                "focal_scale": "relative" if lens.about.get("focal") == RELATIVE else "absolute",
                "focal_unit": lens.focal_unit,
                "image_size": list(lens.image_size),
                "result": RESULTS[self.fit.result] or "successful",
                "certificate": {k: np.asarray(v).item() for k, v in vars(self.fit.certificate).items()},
                "rms_unconstrained": float(self.fit.rms_unconstrained),
                "frames_without_a_model": sum(map(bool, self.frames.messages())),
                "warnings": self.warnings(),
                "model": type(lens.zoom).__name__,
                "distortion_model": distortion_model_name(lens.distortion_model),
                "centre": self.centre.summary(),
                "pixel_polynomials": self.pixel_polynomials().tolist(),
                "coefficients": self.coefficient_rows(),
                "parameters": np.asarray(lens.zoom.parameters).tolist(),
                "corner_displacement": [
                    {"focal": f, "px": moved, "std": finite([std])[0]} for f, moved, std in self.corner
                ],
                "next_photo": {
                    "focal": self.next_photo.focal,
                    "direction": self.next_photo.direction,
                    "region": self.next_photo.region,
                    "displacement_std": finite([self.next_photo.before])[0],
                    "displacement_std_with_it": finite([self.next_photo.after])[0],
                    "enough": self.enough(),
                    "sentence": self.advice(),
                },
                "parameter_sigma": finite(np.sqrt(np.diag(np.asarray(self.fit.covariance)))),
                "per_frame": [
                    dict(zip(fits, row, strict=True)) for row in zip(*fits.values(), strict=True)
                ],
                "versions": {
                    name: importlib.metadata.version(name) for name in ("zoomjax", "jax", "optimistix")
                },
            }
            | ({"selection": self.selection.summary()} if self.selection else {})
        )

    def pixel_polynomials(self) -> np.ndarray:
        """As `coefficients.pixel_polynomials`, of the lens."""
        return pixel_polynomials(self.fit.lens)

    def coefficient_names(self) -> dict[str, int]:
        """As `coefficients.coefficient_names`, of the lens."""
        return coefficient_names(self.fit.lens)

    def coefficient_rows(self) -> list[list[float]]:
        """As `coefficients.coefficient_rows`, of the lens."""
        return coefficient_rows(self.fit.lens)

    def write(
        self,
        folder: str | os.PathLike[str],
        about: dict[str, Any] | None = None,
        pages: Mapping[str, str] | None = None,
        *,
        overwrite: bool = False,
    ) -> None:
        """Write lens.json, lines.npz, summary.json and model.png: all of them, or after an error none.

        Args:
            folder: the folder to write to.
            about: additional entries of summary.json.
            pages: additional text files: their contents by name.
            overwrite: whether to replace files that zoomjax did not write, or that were changed since.

        Raises:
            OSError: the folder cannot be written, or it has such a file and `overwrite` is False.
        """
        names = [*FILES, *(pages or {})]
        with results_folder(folder, names, clears=OF_A_LENS, overwrite=overwrite) as part:
            self.make(part, about, pages)

    @kinds_checked
    def make(
        self,
        folder: str | os.PathLike[str],
        about: dict[str, Any] | None = None,
        pages: Mapping[str, str] | None = None,
        *,
        lines: bool = True,
    ) -> None:
        """Write the files of `write`, with or without the lines, into an empty `results_folder`."""
        from .plot import plot_model, save_plot  # so that `calibrate` does not need Matplotlib

        folder = Path(folder)
        self.fit.lens.save(folder / "lens.json")
        if lines:
            self.lines.save(folder / "lines.npz")
        (folder / "summary.json").write_text(json.dumps(self.summary() | (about or {}), indent=2) + "\n")
        save_plot(plot_model(self.fit, self.frames, self.lines), folder / "model.png")
        for name, text in (pages or {}).items():
            (folder / name).write_text(text, encoding="utf-8")


def rms_over_frames(frame_rms: Float[AnyArray, "frame"]) -> float:
    """Root of the mean of the frames' squared RMS: eq. 13 from eq. 3. NaN frames are ignored."""
    known = np.asarray(frame_rms)[~np.isnan(frame_rms)]
    return float(np.sqrt(np.mean(known**2))) if known.size else np.nan
