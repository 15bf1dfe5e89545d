"""report.html: a calibration on one page, to read and to hand on.

The page needs nothing but itself: its style and its plots are in it, and it has no script. Every text goes
through `element`, which escapes it. Plots are drawn for a light background; browsers in dark mode invert
them.

Once per calibration; most of the time is drawing.
"""

import base64
import io
from html import escape
from typing import TYPE_CHECKING
from urllib.parse import quote

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from ..trust.selection import COLUMNS
from ._html import STYLE, Html, box, element, joined, section, table
from .calibration import Calibration, rms_over_frames
from .plot import plot_distortion, plot_model, plot_primitives, plot_residues

if TYPE_CHECKING:
    from .image_calibration import ImageCalibration

_MOST_FRAMES = 300
"""In the list of frames, and as vectors in plots: the page stays readable, and far below 2 MB."""

_WORST, _WORST_REJECTED = 3, 2
"""How many lines of a frame are named."""


def report(calibration: Calibration, images: "ImageCalibration | None" = None) -> str:
    """The page, as HTML.

    Args:
        calibration: what it is about.
        images: what the lines were found in. The page then names them, and links to their pictures in
            ``lines/`` beside it.
    """
    lens = calibration.zoom.lens
    low, high = (float(f) for f in lens.focal_range)
    about = [
        f"f = {low:.4g} to {high:.4g} {lens.focal_unit}",
        f"{lens.image_size[0]} × {lens.image_size[1]} px",
        _number(len(calibration.none), "frame"),
        _number(len(calibration.rejected), "line"),
        _number(int(np.sum(np.asarray(calibration.lines.mask))), "point"),
    ]
    warnings = images.warnings() if images else calibration.warnings()
    body = [
        element("header", [element("h1", "Zoom lens calibration"), element("p", " · ".join(about))]),
        _headline(calibration),
        *(element("aside", [element("strong", "Beware: "), warning]) for warning in warnings),
        section("straightness", "How straight lines are", _straightness(calibration)),
        section("lens", "The lens", _lens(calibration)),
        section("distortion", "What it does to images", _distortion(calibration)),
        section("next", "The next photo", [element("p", calibration.next.sentence)]),
        section("frames", "Frame by frame", _frames(calibration, images)),
        element("footer", _footer(calibration, images)),
    ]
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>Zoom lens calibration, {escape(about[0])}</title>\n<style>{STYLE}</style>\n</head>\n"
        "<body>\n<main>\n" + "\n".join(body) + "\n</main>\n</body>\n</html>\n"
    )


def _headline(calibration: Calibration) -> "Html":
    """The figures that decide whether to look any further."""
    none, zoom, each = (
        rms_over_frames(values)
        for values in (calibration.none, calibration.zoom.frame_rms, calibration.each.frame_rms)
    )
    std = max(std for _, _, std in calibration.corner())
    certified = bool(calibration.zoom.certificate.certified)
    cards = [
        (f"{zoom:.3g} px", "from straight, RMS, with the zoom polynomial"),
        (f"{none / zoom:.3g} times" if zoom > 0 else "∞", "straighter than without correction"),
        (_excess(zoom, each), "over every frame by itself"),
        (f"± {std:.2g} px" if np.isfinite(std) else "unknown", "at the corner, where it is least certain"),
        ("proved" if certified else "not proved", "to be invertible at every focal length"),
    ]
    figures = [element("div", [element("dt", name), element("dd", value)]) for value, name in cards]
    return element("dl", figures, class_="cards")


def _straightness(calibration: Calibration) -> list["Html"]:
    each = rms_over_frames(calibration.each.frame_rms)
    held_out = {name: rms_over_frames(frames) for name, frames in calibration.held_out_rows().items()}
    rows = [
        (
            name,
            f"{value:.4f}",
            f"{held_out[name]:.4f}" if held_out.get(name, np.nan) > 0 else "",
            "" if name == "frame by frame" else _excess(value, each),
        )
        for name, value in ((name, rms_over_frames(frames)) for name, frames in calibration.rows())
    ]
    figure = plot_residues(
        calibration.lines,
        calibration.none,
        np.asarray(calibration.each.frame_rms),
        np.asarray(calibration.zoom.frame_rms),
    )
    return [
        element(
            "p",
            "Distance of corrected points to the straight lines through them, over all frames. Held out: "
            "of lines that were not fitted, each frame under the polynomial of all others, and a tenth of "
            "its lines at a time under its own model.",
        ),
        table("Straightness", ["", "RMS, px", "held out, px", "over frame by frame"], rows),
        *_choice(calibration),
        _plot(figure, "What is left of each frame against 1/f", class_="box plot"),
    ]


def _choice(calibration: Calibration) -> list["Html"]:
    """How the model was chosen, if it was."""
    if calibration.selection is None:
        return []
    rows = calibration.selection.rows()
    return [element("p", f"{calibration.selection.title}:"), table("The choice", [*COLUMNS], rows)]


def _lens(calibration: Calibration) -> list["Html"]:
    lens = calibration.zoom.lens
    polynomials = [
        element(
            "p",
            [
                Html(f"<i>k</i><sub>{i}</sub>(<i>f</i>) = "),
                *(_term(value, power) for power, value in enumerate(column)),
                Html(f" &ensp;px<sup>−{2 * i}</sup>"),
            ],
        )
        for i, column in enumerate(calibration.pixel_polynomials().T, start=1)
    ]
    x, y = (float(value) for value in np.asarray(lens.centre))
    return [
        element("p", f"With f in {lens.focal_unit}, and radii in px from the point ({x:.6g}, {y:.6g}):"),
        box("Polynomials", polynomials, "box formulas"),
        element("p", _certificate(calibration)),
        _plot(
            plot_model(calibration.zoom, calibration.each, calibration.lines),
            "The distortion coefficients against 1/f: each frame by itself, and the zoom model",
            kind="svg" if len(calibration.none) <= _MOST_FRAMES else "png",
        ),
    ]


def _certificate(calibration: Calibration) -> str:
    lens, proof = calibration.zoom.lens, calibration.zoom.certificate
    low, high = (float(f) for f in lens.focal_range)
    found = (
        f"{float(proof.slope):.3g}, at f = {float(proof.focal):.4g} {lens.focal_unit}, "
        f"{float(proof.radius):.0f} px from the centre"
    )
    if proof.certified:
        return (
            f"It is proved to be invertible: at no focal length from {low:.4g} to {high:.4g} "
            f"{lens.focal_unit} is the corrected image folded over. The slope of the corrected radius, 1 "
            f"where there is no distortion and 0 at a fold, is nowhere below {float(proof.least):.3g}; the "
            f"least one found is {found}."
        )
    if proof.folded:
        return (
            "It is not invertible: the corrected image is folded over. The slope of the corrected radius, "
            f"which must be positive, goes down to {found}."
        )
    return f"No fold was found, but none is ruled out: the least slope of the corrected radius is {found}."


def _distortion(calibration: Calibration) -> list["Html"]:
    lens, focal = calibration.zoom.lens, np.asarray(calibration.lines.focal)
    unit = lens.focal_unit
    ends = sorted({float(focal.min()), float(focal.max())})
    frames = sorted({int(np.argmin(focal)), int(np.argmax(focal))}, key=lambda frame: focal[frame])
    rows = [
        (f"{f:.4g} {unit}", f"{moved:+.2f}".replace("-", "−"), _uncertainty(std))
        for f, moved, std in calibration.corner()
    ]
    return [
        element("p", "Corrected, the corner farthest from the centre moves outwards (−: inwards) by"),
        table("The corner", ["f", "px", "± px"], rows),
        *([element("p", calibration.allowed_for())] if calibration.allowed_for() else []),
        _plot(
            plot_distortion(calibration.zoom, focal=ends),
            "A straight grid as the lens shows it, and where pixels belong, at both ends of the zoom",
        ),
        element("p", "The points of the widest and of the longest frame, as seen and as corrected:"),
        _plot(
            plot_primitives(calibration.lines, lens, frames),
            "Points before and after correction",
            kind="png",
        ),
    ]


def _frames(calibration: Calibration, images: "ImageCalibration | None") -> list["Html"]:
    """The list of frames, each with the lines that are least straight."""
    summary = calibration.summary()["per_frame"]
    shown = np.sort(np.argsort(-np.asarray(calibration.zoom.frame_rms), kind="stable")[:_MOST_FRAMES])
    lines = calibration.lines
    members = np.split(
        np.argsort(lines.frame, kind="stable"),
        np.cumsum(np.bincount(lines.frame, minlength=len(summary)))[:-1],
    )
    rows = []
    for number in shown.tolist():
        frame, rejected = summary[number], calibration.rejected[members[number]]
        counted = f"{frame['lines']:,}" + (f" ({rejected.sum()} rejected)" if rejected.any() else "")
        values = (
            "" if frame[key] is None else f"{frame[key]:.3f}"  # of a frame whose lines are all rejected
            for key in ("rms_zoom", "rms_frames", "rms_none")
        )
        name = _frame_name(number, images)
        rows.append(
            (name, f"{frame['focal']:.4g}", *values, counted, _worst_lines(calibration, members[number]))
        )
    head = ["frame", f"f, {lines.focal_unit}", "polynomial", "by itself", "uncorrected", "lines"]
    told = (
        "RMS distances, px, as corrected by the zoom polynomial, by the frame's own model, and not at all. "
        "The worst lines are given with their row in lines.npz and a place, px."
    )
    if len(shown) < len(summary):
        told += f" Of {len(summary):,} frames, these are the {len(shown)} that the polynomial fits worst."
    if images:
        told += " Names lead to the lines found in the images."
    return [element("p", told), table("Frames", [*head, "worst lines"], rows)]


def _frame_name(number: int, images: "ImageCalibration | None") -> "str | Html":
    if images is None:
        return str(number)
    return element("a", images.used[number].name, href=quote(f"lines/{images.overlays()[number]}"))


def _worst_lines(calibration: Calibration, members: np.ndarray) -> list["Html"]:
    """The worst lines of a frame that count, and of those that were rejected."""
    worst = members[np.argsort(-calibration.line_rms[members], kind="stable")]
    rejected = calibration.rejected[worst]
    points, mask = calibration.lines.points, np.asarray(calibration.lines.mask)
    told = []
    for line in [*worst[~rejected][:_WORST], *worst[rejected][:_WORST_REJECTED]]:
        x, y = np.asarray(points[line])[mask[line]].mean(axis=0)
        what = f"{line} at ({x:.0f}, {y:.0f}): {calibration.line_rms[line]:.2f} px"
        if calibration.rejected[line]:
            told.append(element("span", [what, ", ", element("b", "rejected")], class_="rejected"))
        else:
            told.append(element("span", what))
    return told


def _footer(calibration: Calibration, images: "ImageCalibration | None") -> list["Html"]:
    files = ["lens.json", "summary.json", "lines.npz", "model.png"]
    links = [element("a", name, href=name) for name in files]
    more = [element("p", f"Focal lengths: {images.focals.origin}.")] if images else []
    versions = ", ".join(f"{name} {of}" for name, of in calibration.summary()["versions"].items())
    return [*more, element("p", ["Beside this page: ", joined(links), "."]), element("p", versions)]


def _term(value: float, power: int) -> "Html":
    """A term of a polynomial in 1/f, with its sign."""
    mantissa, exponent = f"{abs(value):.4e}".split("e")
    sign = "−" if value < 0 else "+" if power else ""
    over = ("", "/<i>f</i>")[power > 0] + (f"<sup>{power}</sup>" if power > 1 else "")
    times = f" × 10<sup>{int(exponent)}</sup>".replace("-", "−") if int(exponent) else ""
    return Html(f'<span class="term">{sign} {mantissa}{times}{over}</span> ')


def _excess(value: float, reference: float) -> str:
    """How much more than the reference it is."""
    if reference <= 0:
        return "–"
    ratio = value / reference
    return f"{100 * (ratio - 1):+.2f} %" if ratio < 2 else f"{ratio:.1f} times"


def _uncertainty(std: float) -> str:
    return f"{std:.2g}" if np.isfinite(std) else "not determined"


def _number(count: int, noun: str) -> str:
    return f"{count:,} {noun}" + ("" if count == 1 else "s")


def _plot(figure: Figure, label: str, *, class_: str = "box wide plot", kind: str = "svg") -> Html:
    """A plot; a wide one is not made smaller than can be read."""
    file = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "zoomjax"}):
        figure.savefig(file, format=kind, dpi=150, metadata={"Date": None} if kind == "svg" else {})
    content = base64.b64encode(file.getvalue()).decode()
    width, height = (f"{96 * side:.0f}" for side in figure.get_size_inches())
    image = Html(
        f'<img src="data:image/{kind.replace("svg", "svg+xml")};base64,{content}" alt="{escape(label)}" '
        f'width="{width}" height="{height}">'
    )
    return element("figure", box(label, image, class_))
