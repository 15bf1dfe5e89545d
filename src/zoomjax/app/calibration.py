"""A whole calibration: from lines to the fits, the key figures and a folder of results.

The command line runs this. It prints nothing; plots are made by `plot`.
"""

import dataclasses
import importlib.metadata
import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from .._core.text import span
from .._core.types import AnyArray
from ..fit.energy import line_squares
from ..fit.focal_lengths import with_focal_sigma
from ..fit.image_metric import in_image
from ..fit.result import RESULTS, FrameFits, ZoomFit
from ..fit.straightness import frame_rms
from ..fit.zoom import CentreArgument
from ..lines.lines import Lines
from ..models.about import UNKNOWN
from ..models.registry import family_name
from ..models.zoom import PolynomialZoom
from ..trust.assessment import NEGLIGIBLE, Assessment, assess
from ..trust.bands import displacement_std
from ..trust.cross_validation import held_out_frames, held_out_zoom
from ..trust.misfit import with_misfit
from ..trust.next_photo import Suggestion, suggest_next
from ..trust.selection import Selection
from .fitting import Metric, algebraic_rms, fitted
from .model_choice import CentreFound, WantedModel
from .outward import outward
from .results_folder import OF_A_LENS, results_folder

FILES = ("lens.json", "lines.npz", "summary.json", "model.png")
"""What `Calibration.write` writes."""

_ENOUGH = NEGLIGIBLE / 5
"""Standard deviation of the displacement, in diagonals, below which no further photo is needed."""


@dataclasses.dataclass(frozen=True)
class Calibration:
    """The zoom model fitted to lines, and the fits it is compared with.

    Attributes:
        lines: the lines.
        zoom: the zoom model's fit.
        each: separate fits of the frames.
        none, algebraic: each frame's RMS, px, without correction and with the algebraic estimate, which
            is None for another distortion model than the radial polynomial.
        rejected: which lines have weight 0: left out by hand, or not straight in the scene.
        line_rms: RMS of each line under the zoom model, px, rejected lines included.
        next: the photo that would reduce the uncertainty most.
        focal_sigma: standard deviation of each frame's focal length, included in the bands; 0: exact.
        held_out: each frame's RMS, px, under the zoom model fitted to all others; NaN if that fit fails.
        each_held_out: each frame's RMS, px, each tenth of its lines under the model of its other lines.
        centre: the centre of distortion, and how it was found.
        assessment: the verdict, with what was found and what to do about it.
        selection: how the model was selected; None if it was given.
        in_image: whether all RMS are of distances in the distorted image, not in the corrected one.
    """

    lines: Lines
    zoom: ZoomFit
    each: FrameFits
    none: np.ndarray
    algebraic: np.ndarray | None
    rejected: np.ndarray
    line_rms: np.ndarray
    next: Suggestion
    focal_sigma: np.ndarray
    held_out: np.ndarray
    each_held_out: np.ndarray
    centre: CentreFound
    assessment: Assessment
    selection: Selection | None = None
    in_image: bool = True

    def corner(self) -> list[tuple[float, float, float]]:
        """Displacement of the farthest corner at both ends of the focal range and in its middle.

        Returns:
            For each focal length: the focal length, the displacement away from the centre, px, of the
            corner farthest from it, and the standard deviation of the displacement, px.
        """
        lens = self.zoom.lens
        low, high = (float(f) for f in lens.focal_range)
        centre = np.asarray(lens.centre)
        last = np.array(lens.image_size) - 1
        corner = np.where(centre > last / 2, 0.0, last)
        focal = [low, *([float(np.sqrt(low * high)), high] if high > low else [])]
        std = np.asarray(displacement_std(self.zoom, corner, focal=np.array(focal)))
        return list(zip(focal, outward(lens, corner, focal).tolist(), std.tolist(), strict=True))

    @property
    def focal_known(self) -> bool:
        """Whether f is known: of one photo alone, a number may stand for it."""
        return self.zoom.lens.about.get("focal") != UNKNOWN

    def focal_text(self) -> str:
        """The range of focal lengths in words."""
        low, high = (float(f) for f in self.zoom.lens.focal_range)
        if not self.focal_known:
            return "focal length not known"
        return f"f = {span(low, high, self.zoom.lens.focal_unit)}"

    def allowed_for(self) -> str:
        """A sentence on the uncertainty of focal lengths in the bands; empty if they are exact."""
        share = self.focal_sigma / np.asarray(self.lines.focal)
        if not share.any():
            return ""
        return (
            "Standard deviations include those of the focal lengths, "
            f"{share.min():.2%} to {share.max():.2%}. The next photo is chosen without them."
        )

    def enough(self) -> bool:
        """Whether a further photo could improve nothing that can be seen."""
        visible = _ENOUGH * self.assessment.evidence.diagonal
        return self.assessment.verdict == "good" and self.next.before < visible

    def advice(self) -> str:
        """What to photograph next, or that there is enough, or that something else comes first."""
        causes = [finding.advice for finding in self.assessment.findings if finding.cause]
        if causes:
            return f"{causes[0]} That comes before another photo."
        if not self.enough():
            return self.next.sentence if self.focal_known else replace(self.next, focal_unit="").sentence
        return (
            "Enough: the standard deviation of the displacement, in the geometric mean over image and "
            f"focal range, is {self.next.before:.2g} px, {self.next.after:.2g} px with the best next photo."
        )

    def rows(self) -> list[tuple[str, np.ndarray]]:
        """Rows of a table like the paper's Table 1: the correction and each frame's RMS, px."""
        if len(self.none) == 1:  # then all models of the zoom are that of the frame
            return [("no correction", self.none), (self.kind, np.asarray(self.zoom.frame_rms))]
        return [
            ("no correction", self.none),
            ("frame by frame", np.asarray(self.each.frame_rms)),
            *([] if self.algebraic is None else [(f"{self.kind} (algebraic)", self.algebraic)]),
            (self.kind, np.asarray(self.zoom.frame_rms)),
        ]

    @property
    def kind(self) -> str:
        """What the zoom model is called in tables."""
        if len(self.none) == 1:
            return "corrected"
        return "zoom polynomial" if isinstance(self.zoom.lens.zoom, PolynomialZoom) else "zoom model"

    def held_out_rows(self) -> dict[str, np.ndarray]:
        """For some of the `rows`, each frame's RMS on lines that were not used in the fit, px."""
        if len(self.none) == 1:
            return {self.kind: self.each_held_out}
        return {"frame by frame": self.each_held_out, self.kind: self.held_out}

    def warnings(self, names: Sequence[str] | None = None) -> list[str]:
        """User-facing warnings about the zoom model, and about frames without a good fit.

        `names` are the names of the frames; by default their numbers, from 0.
        """
        warnings = [RESULTS[self.zoom.result]] if self.zoom.result != RESULTS.successful else []
        for message in dict.fromkeys(filter(None, messages := self.each.messages())):
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
        """All figures as plain numbers and strings, for JSON."""
        lens = self.zoom.lens
        low, high = (float(f) for f in lens.focal_range)
        frame = np.asarray(self.lines.frame)
        fits = {
            "frame": range(len(self.none)),
            "focal": np.asarray(self.lines.focal).tolist(),
            "focal_sigma": self.focal_sigma.tolist(),
            "lines": np.bincount(frame, minlength=len(self.none)).tolist(),
            "rms_none": _finite(self.none),
            "rms_frames": _finite(np.asarray(self.each.frame_rms)),
            "rms_zoom": _finite(np.asarray(self.zoom.frame_rms)),
            "rms_held_out": _finite(self.held_out),
            "rms_frames_held_out": _finite(self.each_held_out),
        }
        return (
            self.assessment.summary()
            | {
                "distances": "distorted image" if self.in_image else "corrected image",
                "rms_none": rms_over_frames(self.none),
                "rms_algebraic": None if self.algebraic is None else rms_over_frames(self.algebraic),
                "rms_frames": float(self.each.rms),
                "rms_zoom": float(self.zoom.rms),
                "rms_held_out": _finite([rms_over_frames(self.held_out)])[0],
                "rms_frames_held_out": _finite([rms_over_frames(self.each_held_out)])[0],
                "frames": len(self.none),
                "lines": len(frame),
                "rejected_lines": int(self.rejected.sum()),
                "rejected": [
                    {"line": int(line), "frame": int(frame[line]), "rms": float(self.line_rms[line])}
                    for line in np.flatnonzero(self.rejected)[np.argsort(-self.line_rms[self.rejected])]
                ],
                "points": int(np.sum(np.asarray(self.lines.mask))),
                "focal_range": [low, high],
                "focal_known": self.focal_known,
                "focal_unit": lens.focal_unit,
                "image_size": list(lens.image_size),
                "result": RESULTS[self.zoom.result] or "successful",
                "certificate": {name: of.item() for name, of in vars(self.zoom.certificate).items()},
                "rms_unconstrained": float(self.zoom.rms_unconstrained),
                "frames_without_a_model": sum(map(bool, self.each.messages())),
                "warnings": self.warnings(),
                "model": type(lens.zoom).__name__,
                "family": family_name(lens.family),
                "centre": self.centre.summary(),
                "pixel_polynomials": self.pixel_polynomials().tolist(),
                "coefficients": self.coefficient_rows(),
                "parameters": np.asarray(lens.zoom.parameters).tolist(),
                "corner_displacement": [
                    {"focal": f, "px": moved, "std": _finite([std])[0]} for f, moved, std in self.corner()
                ],
                "next_photo": {
                    "focal": self.next.focal,
                    "direction": self.next.direction,
                    "region": self.next.region,
                    "displacement_std": _finite([self.next.before])[0],
                    "displacement_std_with_it": _finite([self.next.after])[0],
                    "enough": self.enough(),
                    "sentence": self.advice(),
                },
                "parameter_sigma": _finite(np.sqrt(np.diag(np.asarray(self.zoom.covariance)))),
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
        """Coefficients of ``f^(-j)`` (rows) of each coefficient (columns) in px, as printed in the paper.

        None, of shape (0, 0), for another model.
        """
        model = self.zoom.lens.zoom
        if not isinstance(model, PolynomialZoom):
            return np.zeros((0, 0))
        normalised = np.asarray(model.in_inverse_focal())
        return normalised / self.zoom.lens.scale ** self.zoom.lens.family.orders(normalised.shape[1])

    def coefficient_names(self) -> dict[str, int]:
        """Names of the coefficients, k1, ..., kN and p1, p2, and the powers of 1/px in their units."""
        family = self.zoom.lens.family
        size = np.asarray(self.zoom.lens(self.zoom.lens.focal_range[0]).coefficients).size
        radial, orders = size - family.size(0), family.orders(size).tolist()
        names = [f"k{i + 1}" if i < radial else f"p{i + 1 - radial}" for i in range(size)]
        return dict(zip(names, orders, strict=True))

    def coefficient_rows(self) -> list[list[float]]:
        """Focal length and k1, ..., kN, px, at some focal lengths over the range, evenly in 1/f."""
        lens = self.zoom.lens
        low, high = (float(f) for f in lens.focal_range)
        focal = np.unique(1 / np.linspace(1 / low, 1 / high, 5))
        return [[f, *np.asarray(lens(f).pixel_coefficients).tolist()] for f in focal.tolist()]

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
        self.zoom.lens.save(folder / "lens.json")
        if lines:
            self.lines.save(folder / "lines.npz")
        (folder / "summary.json").write_text(json.dumps(self.summary() | (about or {}), indent=2) + "\n")
        save_plot(plot_model(self.zoom, self.each, self.lines), folder / "model.png")
        for name, text in (pages or {}).items():
            (folder / name).write_text(text, encoding="utf-8")


def calibrate(
    lines: Lines,
    *,
    model: WantedModel = WantedModel(),  # noqa: B008, it is frozen
    centre: CentreArgument | None = "fit",
    robust: bool = False,
    metric: Metric = in_image,
    focal_sigma: float | Float[np.ndarray, "frame"] = 0.0,
    shared: Int[np.ndarray, "frame"] | None = None,
    widened: Callable[[ZoomFit], ZoomFit] = lambda fit: fit,
    stage: Callable[[str], None] = lambda _: None,
) -> Calibration:
    """Fit the zoom model, and the models it is compared with.

    Args:
        lines: the lines; computed in float64 if that is enabled, whatever their dtype.
        model: the zoom model; by default the one of least cross-validation error.
        centre: the centre of distortion: "fit", "image", its coordinates, px, or None for that of the
            lines. With "fit" it is that of the lines where they do not determine another, or where lines
            that were not fitted are not straighter about it.
        robust: whether to reject lines that are not straight in the scene. All figures are then computed
            from the remaining lines.
        metric: where distances are measured: `in_image`, where the noise is, or, as in the paper,
            `in_corrected`.
        focal_sigma: standard deviation of the focal lengths: a number, or one per frame; 0 where exact.
        shared: for each frame a number: frames of one number share a focal length and its error.
        widened: adds to the uncertainty of a fit what the lines do not show of it.
        stage: called with a description before each step that takes time.

    Raises:
        ValueError: an argument is not one of these, or there are too few focal lengths for the model.
        RuntimeError: the solver failed.
    """
    used = fitted(lines, model, centre, robust=robust, metric=metric, stage=stage)
    exact, small, terms = used.zoom, used.lines, used.model.terms
    sigma = np.broadcast_to(focal_sigma, lines.focal.shape)
    zoom = exact
    if sigma.any():
        zoom = with_focal_sigma(exact, small, focal_sigma=sigma, shared=shared)
    zoom = widened(with_misfit(zoom, used.held))
    stage("Checking the fit on lines left out")
    held_out, each_held_out = np.full(len(sigma), np.nan), held_out_frames(small, terms=terms)
    if len(sigma) > 1:
        held_out = held_out_zoom(small, zoom=used.model)
    lines = (lines.weighted(np.asarray(small.weight)) if robust else lines).about(np.asarray(small.centre))
    return Calibration(
        lines=lines,
        zoom=zoom,
        each=used.each,
        none=np.asarray(frame_rms(small, None)),
        algebraic=algebraic_rms(small, used.model),
        rejected=np.asarray(lines.weight) == 0
        if lines.weight is not None
        else np.zeros(len(lines.frame), bool),
        line_rms=np.sqrt(line_squares(small, zoom.lens.zoom)),
        next=suggest_next(exact, small),  # from the noise alone, without focal_sigma
        focal_sigma=sigma,
        held_out=held_out,
        each_held_out=each_held_out,
        centre=used.centre.as_uncertain_as(zoom),
        assessment=assess(lines, zoom, compressed=small, held_out=held_out, each_held_out=each_held_out),
        selection=used.selection,
        in_image=small.metric == "distorted",
    )


def rms_over_frames(frame_rms: Float[AnyArray, "frame"]) -> float:
    """Root of the mean of the frames' squared RMS: eq. 13 from eq. 3. NaN frames are ignored."""
    known = np.asarray(frame_rms)[~np.isnan(frame_rms)]
    return float(np.sqrt(np.mean(known**2))) if known.size else np.nan


def _finite(values: Iterable[float]) -> list[float | None]:
    """Values for JSON, which has no infinity: None means that a value is not determined."""
    return [float(v) if np.isfinite(v) else None for v in values]
