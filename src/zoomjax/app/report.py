"""report.html: a calibration on one page.

The page is self-contained: style and plots are embedded, and there is no script. Its text is in
``templates/report.html``, its colours are in ``templates/report.css``; this module computes the values.
Plots are drawn for a light background; browsers in dark mode invert them.

Runs once per calibration; most of the time is plotting.
"""

import base64
import functools
import io
from typing import TYPE_CHECKING, Any

import jinja2
import matplotlib
import numpy as np
from matplotlib.figure import Figure

from .._core.text import plain
from ..trust.selection import COLUMNS
from .calibration import Calibration, rms_over_frames
from .plot import plot_distortion, plot_model, plot_primitives, plot_residues

if TYPE_CHECKING:
    from .image_calibration import ImageCalibration

_MOST_FRAMES = 300
"""Limit for the list of frames and for vector plots. It keeps the page readable and far below 2 MB."""

_WORST, _WORST_REJECTED = 3, 2
"""How many lines of a frame are listed: of those that count, and of the rejected ones."""


def report(calibration: Calibration, images: "ImageCalibration | None" = None) -> str:
    """Render the report as HTML.

    Args:
        calibration: the calibration to report.
        images: the images in which the lines were found. The page then lists them by name, with links to
            their pictures in the folder ``lines/`` next to it.
    """
    lens = calibration.zoom.lens
    low, high = (float(f) for f in lens.focal_range)
    versions = calibration.summary()["versions"]
    return (
        _templates()
        .get_template("report.html")
        .render(
            about=[
                f"f = {low:.4g} to {high:.4g} {lens.focal_unit}",
                f"{lens.image_size[0]} × {lens.image_size[1]} px",
                _number(len(calibration.none), "frame"),
                _number(len(calibration.rejected), "line"),
                _number(int(np.sum(np.asarray(calibration.lines.mask))), "point"),
            ],
            cards=_cards(calibration),
            warnings=images.warnings() if images else calibration.warnings(),
            straightness=_straightness(calibration),
            lens=_lens(calibration),
            distortion=_distortion(calibration),
            next=calibration.next.sentence,
            frames=_frames(calibration, images),
            images=images,
            files=["lens.json", "summary.json", "lines.npz", "model.png"],
            versions=", ".join(f"{name} {of}" for name, of in versions.items()),
        )
    )


@functools.cache
def _templates() -> jinja2.Environment:
    """The Jinja templates. All text is escaped and free of control characters."""
    return jinja2.Environment(
        loader=jinja2.PackageLoader("zoomjax.app"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=lambda value: _shown(value) if type(value) is str else value,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


def _shown(text: str) -> str:
    """Text without control characters, except line breaks."""
    return "\n".join(map(plain, text.split("\n")))


def _cards(calibration: Calibration) -> list[tuple[str, str]]:
    """The key figures at the top of the page."""
    none, zoom, each = (
        rms_over_frames(values)
        for values in (calibration.none, calibration.zoom.frame_rms, calibration.each.frame_rms)
    )
    std = max(std for _, _, std in calibration.corner())
    certified = bool(calibration.zoom.certificate.certified)
    return [
        (f"{zoom:.3g} px", "RMS distance to straight lines, zoom polynomial"),
        (f"{none / zoom:.3g} times" if zoom > 0 else "∞", "straighter than without correction"),
        (_excess(zoom, each), "RMS, compared with a separate fit of each frame"),
        (f"± {std:.2g} px" if np.isfinite(std) else "unknown", "largest standard deviation at the corner"),
        ("proved" if certified else "not proved", "invertible at every focal length"),
    ]


def _straightness(calibration: Calibration) -> dict[str, Any]:
    each = rms_over_frames(calibration.each.frame_rms)
    held_out = {name: rms_over_frames(frames) for name, frames in calibration.held_out_rows().items()}
    figure = plot_residues(
        calibration.lines,
        calibration.none,
        np.asarray(calibration.each.frame_rms),
        np.asarray(calibration.zoom.frame_rms),
    )
    chosen = calibration.selection
    return {
        "rows": [
            (
                name,
                f"{value:.4f}",
                f"{held_out[name]:.4f}" if held_out.get(name, np.nan) > 0 else "",
                "" if name == "frame by frame" else _excess(value, each),
            )
            for name, value in ((name, rms_over_frames(frames)) for name, frames in calibration.rows())
        ],
        "choice": chosen and {"title": chosen.title, "columns": COLUMNS, "rows": chosen.rows()},
        "plot": _plot(figure, "Residual RMS of each frame against 1/f", class_="box plot"),
    }


def _lens(calibration: Calibration) -> dict[str, Any]:
    x, y = (float(value) for value in np.asarray(calibration.zoom.lens.centre))
    return {
        "unit": calibration.zoom.lens.focal_unit,
        "centre": f"{x:.6g}, {y:.6g}",
        "centre_found": calibration.centre.sentence,
        "coefficients": _coefficients(calibration),
        "polynomials": [
            [_term(value, power) for power, value in enumerate(column)]
            for column in calibration.pixel_polynomials().T
        ],
        "certificate": _certificate(calibration),
        "plot": _plot(
            plot_model(calibration.zoom, calibration.each, calibration.lines),
            "Distortion coefficients against 1/f: separate fits of the frames, and the zoom model",
            kind="svg" if len(calibration.none) <= _MOST_FRAMES else "png",
        ),
    }


def _coefficients(calibration: Calibration) -> list[tuple[str, ...]]:
    """Of a model other than polynomials, focal lengths and coefficients, px; nothing for these."""
    if calibration.pixel_polynomials().size:
        return []
    rows = calibration.coefficient_rows()
    return [(f"{f:.4g}", *(f"{value:+.4e}" for value in values)) for f, *values in rows]


def _certificate(calibration: Calibration) -> str:
    lens, proof = calibration.zoom.lens, calibration.zoom.certificate
    low, high = (float(f) for f in lens.focal_range)
    found = (
        f"{float(proof.slope):.3g}, at f = {float(proof.focal):.4g} {lens.focal_unit}, "
        f"{float(proof.radius):.0f} px from the centre"
    )
    if proof.certified:
        return (
            "The lens is proved to be invertible: the corrected image does not fold over at any focal "
            f"length from {low:.4g} to {high:.4g} {lens.focal_unit}. The slope of the corrected radius (1 "
            f"without distortion, 0 at a fold) is at least {float(proof.least):.3g}; the smallest slope "
            f"found is {found}."
        )
    if proof.folded:
        return (
            "The lens is not invertible: the corrected image folds over. The slope of the corrected radius "
            f"must be positive, but falls to {found}."
        )
    return (
        "Invertibility is not proved: no fold was found, but a fold cannot be excluded. The smallest slope "
        f"of the corrected radius is {found}."
    )


def _distortion(calibration: Calibration) -> dict[str, Any]:
    lens, focal = calibration.zoom.lens, np.asarray(calibration.lines.focal)
    ends = sorted({float(focal.min()), float(focal.max())})
    frames = sorted({int(np.argmin(focal)), int(np.argmax(focal))}, key=lambda frame: focal[frame])
    return {
        "rows": [
            (f"{f:.4g} {lens.focal_unit}", f"{moved:+.2f}".replace("-", "−"), _uncertainty(std))
            for f, moved, std in calibration.corner()
        ],
        "allowed_for": calibration.allowed_for(),
        "grid": _plot(
            plot_distortion(calibration.zoom, focal=ends),
            "A straight grid, distorted, and the displacement of pixels, at both ends of the zoom",
        ),
        "points": _plot(
            plot_primitives(calibration.lines, lens, frames),
            "Points before and after correction",
            kind="png",
        ),
    }


def _frames(calibration: Calibration, images: "ImageCalibration | None") -> dict[str, Any]:
    """The list of frames, each with its least straight lines."""
    summary = calibration.summary()["per_frame"]
    shown = np.sort(np.argsort(-np.asarray(calibration.zoom.frame_rms), kind="stable")[:_MOST_FRAMES])
    lines = calibration.lines
    members = np.split(
        np.argsort(lines.frame, kind="stable"),
        np.cumsum(np.bincount(lines.frame, minlength=len(summary)))[:-1],
    )
    unit = f"f, {lines.focal_unit}"
    return {
        "number": len(summary),
        "head": ["frame", unit, "polynomial", "separate", "uncorrected", "lines", "worst lines"],
        "rows": [
            {
                "name": images.used[number].name if images else str(number),
                "picture": f"lines/{images.overlays()[number]}" if images else None,
                "cells": _frame_cells(summary[number], calibration.rejected[members[number]]),
                "worst": _worst_lines(calibration, members[number]),
            }
            for number in shown.tolist()
        ],
    }


def _frame_cells(frame: dict[str, Any], rejected: np.ndarray) -> list[str]:
    """Its focal length, RMS values and number of lines."""
    values = (
        "" if frame[key] is None else f"{frame[key]:.3f}"  # of a frame whose lines are all rejected
        for key in ("rms_zoom", "rms_frames", "rms_none")
    )
    counted = f"{frame['lines']:,}" + (f" ({rejected.sum()} rejected)" if rejected.any() else "")
    return [f"{frame['focal']:.4g}", *values, counted]


def _worst_lines(calibration: Calibration, members: np.ndarray) -> list[dict[str, Any]]:
    """The worst lines of a frame: of those that count, and of the rejected ones."""
    worst = members[np.argsort(-calibration.line_rms[members], kind="stable")]
    rejected = calibration.rejected[worst]
    points, mask = calibration.lines.points, np.asarray(calibration.lines.mask)
    listed = []
    for line in [*worst[~rejected][:_WORST], *worst[rejected][:_WORST_REJECTED]]:
        x, y = np.asarray(points[line])[mask[line]].mean(axis=0)
        text = f"{line} at ({x:.0f}, {y:.0f}): {calibration.line_rms[line]:.2f} px"
        listed.append({"text": text, "rejected": bool(calibration.rejected[line])})
    return listed


def _term(value: float, power: int) -> dict[str, Any]:
    """One term of a polynomial in 1/f, with its sign."""
    mantissa, exponent = f"{abs(value):.4e}".split("e")
    return {
        "sign": "−" if value < 0 else "+" if power else "",
        "mantissa": mantissa,
        "exponent": str(int(exponent)).replace("-", "−") if int(exponent) else "",
        "power": power,
    }


def _excess(value: float, reference: float) -> str:
    """By how much a value exceeds the reference: per cent, or a factor from 2 on."""
    if reference <= 0:
        return "–"
    ratio = value / reference
    return f"{100 * (ratio - 1):+.2f} %" if ratio < 2 else f"{ratio:.1f} times"


def _uncertainty(std: float) -> str:
    return f"{std:.2g}" if np.isfinite(std) else "not determined"


def _number(count: int, noun: str) -> str:
    return f"{count:,} {noun}" + ("" if count == 1 else "s")


def _plot(
    figure: Figure, label: str, *, class_: str = "box wide plot", kind: str = "svg"
) -> dict[str, str | int]:
    """A plot, embedded as a data URL, with its natural size so that text stays readable."""
    file = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "zoomjax"}):
        figure.savefig(file, format=kind, dpi=150, metadata={"Date": None} if kind == "svg" else {})
    content = base64.b64encode(file.getvalue()).decode()
    width, height = (f"{96 * side:.0f}" for side in figure.get_size_inches())
    source = f"data:image/{kind.replace('svg', 'svg+xml')};base64,{content}"
    return {"source": source, "label": label, "class": class_, "width": width, "height": height}
