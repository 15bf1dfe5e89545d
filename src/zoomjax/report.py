"""report.html: a calibration on one page, to read and to hand on.

The page needs nothing but itself: its style and its plots are in it, and it has no script. Every text goes
through `_text`, which escapes it. Plots are drawn for a light background; browsers in dark mode invert
them.

Once per calibration; most of the time is drawing.
"""

import base64
import io
from collections.abc import Iterable, Sequence
from html import escape
from typing import TYPE_CHECKING
from urllib.parse import quote

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from ._text import plain
from .calibration import Calibration, rms_over_frames
from .plot import plot_distortion, plot_model, plot_primitives, plot_residues
from .selection import COLUMNS

if TYPE_CHECKING:
    from .vision.image_calibration import ImageCalibration

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
        _element("header", [_element("h1", "Zoom lens calibration"), _element("p", " · ".join(about))]),
        _headline(calibration),
        *(_element("aside", [_element("strong", "Beware: "), warning]) for warning in warnings),
        _section("straightness", "How straight lines are", _straightness(calibration)),
        _section("lens", "The lens", _lens(calibration)),
        _section("distortion", "What it does to images", _distortion(calibration)),
        _section("next", "The next photo", [_element("p", calibration.next.sentence)]),
        _section("frames", "Frame by frame", _frames(calibration, images)),
        _element("footer", _footer(calibration, images)),
    ]
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>Zoom lens calibration, {escape(about[0])}</title>\n<style>{_STYLE}</style>\n</head>\n"
        "<body>\n<main>\n" + "\n".join(body) + "\n</main>\n</body>\n</html>\n"
    )


def _headline(calibration: Calibration) -> "_Html":
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
    figures = [_element("div", [_element("dt", name), _element("dd", value)]) for value, name in cards]
    return _element("dl", figures, class_="cards")


def _straightness(calibration: Calibration) -> list["_Html"]:
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
        _element(
            "p",
            "Distance of corrected points to the straight lines through them, over all frames. Held out: "
            "of lines that were not fitted, each frame under the polynomial of all others, and a tenth of "
            "its lines at a time under its own model.",
        ),
        _table("Straightness", ["", "RMS, px", "held out, px", "over frame by frame"], rows),
        *_choice(calibration),
        _plot(figure, "What is left of each frame against 1/f", class_="box plot"),
    ]


def _choice(calibration: Calibration) -> list["_Html"]:
    """How the model was chosen, if it was."""
    if calibration.selection is None:
        return []
    rows = calibration.selection.rows()
    return [_element("p", f"{calibration.selection.title}:"), _table("The choice", [*COLUMNS], rows)]


def _lens(calibration: Calibration) -> list["_Html"]:
    lens = calibration.zoom.lens
    polynomials = [
        _element(
            "p",
            [
                _Html(f"<i>k</i><sub>{i}</sub>(<i>f</i>) = "),
                *(_term(value, power) for power, value in enumerate(column)),
                _Html(f" &ensp;px<sup>−{2 * i}</sup>"),
            ],
        )
        for i, column in enumerate(calibration.pixel_polynomials().T, start=1)
    ]
    x, y = (float(value) for value in np.asarray(lens.centre))
    return [
        _element("p", f"With f in {lens.focal_unit}, and radii in px from the point ({x:.6g}, {y:.6g}):"),
        _box("Polynomials", polynomials, "box formulas"),
        _element("p", _certificate(calibration)),
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


def _distortion(calibration: Calibration) -> list["_Html"]:
    lens, focal = calibration.zoom.lens, np.asarray(calibration.lines.focal)
    unit = lens.focal_unit
    ends = sorted({float(focal.min()), float(focal.max())})
    frames = sorted({int(np.argmin(focal)), int(np.argmax(focal))}, key=lambda frame: focal[frame])
    rows = [
        (f"{f:.4g} {unit}", f"{moved:+.2f}".replace("-", "−"), _uncertainty(std))
        for f, moved, std in calibration.corner()
    ]
    return [
        _element("p", "Corrected, the corner farthest from the centre moves outwards (−: inwards) by"),
        _table("The corner", ["f", "px", "± px"], rows),
        *([_element("p", calibration.allowed_for())] if calibration.allowed_for() else []),
        _plot(
            plot_distortion(calibration.zoom, focal=ends),
            "A straight grid as the lens shows it, and where pixels belong, at both ends of the zoom",
        ),
        _element("p", "The points of the widest and of the longest frame, as seen and as corrected:"),
        _plot(
            plot_primitives(calibration.lines, lens, frames),
            "Points before and after correction",
            kind="png",
        ),
    ]


def _frames(calibration: Calibration, images: "ImageCalibration | None") -> list["_Html"]:
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
    return [_element("p", told), _table("Frames", [*head, "worst lines"], rows)]


def _frame_name(number: int, images: "ImageCalibration | None") -> "str | _Html":
    if images is None:
        return str(number)
    return _element("a", images.used[number].name, href=quote(f"lines/{images.overlays()[number]}"))


def _worst_lines(calibration: Calibration, members: np.ndarray) -> list["_Html"]:
    """The worst lines of a frame that count, and of those that were rejected."""
    worst = members[np.argsort(-calibration.line_rms[members], kind="stable")]
    rejected = calibration.rejected[worst]
    points, mask = calibration.lines.points, np.asarray(calibration.lines.mask)
    told = []
    for line in [*worst[~rejected][:_WORST], *worst[rejected][:_WORST_REJECTED]]:
        x, y = np.asarray(points[line])[mask[line]].mean(axis=0)
        what = f"{line} at ({x:.0f}, {y:.0f}): {calibration.line_rms[line]:.2f} px"
        if calibration.rejected[line]:
            told.append(_element("span", [what, ", ", _element("b", "rejected")], class_="rejected"))
        else:
            told.append(_element("span", what))
    return told


def _footer(calibration: Calibration, images: "ImageCalibration | None") -> list["_Html"]:
    files = ["lens.json", "summary.json", "lines.npz", "model.png"]
    links = [_element("a", name, href=name) for name in files]
    more = [_element("p", f"Focal lengths: {images.focals.origin}.")] if images else []
    versions = ", ".join(f"{name} {of}" for name, of in calibration.summary()["versions"].items())
    return [*more, _element("p", ["Beside this page: ", _joined(links), "."]), _element("p", versions)]


def _term(value: float, power: int) -> "_Html":
    """A term of a polynomial in 1/f, with its sign."""
    mantissa, exponent = f"{abs(value):.4e}".split("e")
    sign = "−" if value < 0 else "+" if power else ""
    over = ("", "/<i>f</i>")[power > 0] + (f"<sup>{power}</sup>" if power > 1 else "")
    times = f" × 10<sup>{int(exponent)}</sup>".replace("-", "−") if int(exponent) else ""
    return _Html(f'<span class="term">{sign} {mantissa}{times}{over}</span> ')


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


class _Html(str):
    """Text that is HTML already."""


_Content = str | Iterable[str]


def _text(content: _Content) -> _Html:
    """Escaped, unless it is HTML; of several parts, each."""
    if isinstance(content, _Html):
        return content
    return _Html(escape(_shown(content)) if isinstance(content, str) else "".join(map(_text, content)))


def _shown(text: str) -> str:
    """Without orders to whoever reads it; warnings have lines."""
    return "\n".join(map(plain, text.split("\n")))


def _joined(parts: Sequence[str]) -> _Html:
    return _Html(", ".join(map(_text, parts)))


def _element(name: str, content: _Content, **attributes: str) -> _Html:
    """``<name ...>content</name>``; attributes are written as in Python: ``class_``, ``aria_label``."""
    given = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{escape(value)}"' for key, value in attributes.items()
    )
    return _Html(f"<{name}{given}>{_text(content)}</{name}>")


def _section(key: str, title: str, content: _Content) -> _Html:
    return _element("section", [_element("h2", title), _text(content)], id=key)


def _box(label: str, content: _Content, class_: str = "box") -> _Html:
    """What may be wider than a phone: it scrolls by itself, also by keyboard."""
    return _element("div", content, class_=class_, role="region", aria_label=label, tabindex="0")


def _table(label: str, head: Sequence[str], rows: Iterable[Sequence[_Content]]) -> _Html:
    """A table whose first column names the rows."""
    lines = [
        _element("tr", [_element("th", row[0], scope="row"), *(_element("td", cell) for cell in row[1:])])
        for row in rows
    ]
    names = _element("tr", [_element("th", name, scope="col") for name in head])
    return _box(label, _element("table", [_element("thead", names), _element("tbody", lines)]), "box fit")


def _plot(figure: Figure, label: str, *, class_: str = "box wide plot", kind: str = "svg") -> _Html:
    """A plot; a wide one is not made smaller than can be read."""
    file = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "zoomjax"}):
        figure.savefig(file, format=kind, dpi=150, metadata={"Date": None} if kind == "svg" else {})
    content = base64.b64encode(file.getvalue()).decode()
    width, height = (f"{96 * side:.0f}" for side in figure.get_size_inches())
    image = _Html(
        f'<img src="data:image/{kind.replace("svg", "svg+xml")};base64,{content}" alt="{escape(label)}" '
        f'width="{width}" height="{height}">'
    )
    return _element("figure", _box(label, image, class_))


_STYLE = """
:root { color-scheme: light dark; --page: #f6f5f2; --card: #fff; --ink: #1c1917; --soft: #6b645c;
  --rule: #e3dfd8; --model: #c2410c; --warn: #fff4e5; --link: #1e3a5f; }
@media (prefers-color-scheme: dark) {
  :root { --page: #0f0f0f; --card: #1a1a1a; --ink: #ececea; --soft: #a8a29a; --rule: #35322e;
    --model: #fb8a4c; --warn: #33240f; --link: #9cc3ee; }
  .plot img { filter: invert(0.898) hue-rotate(180deg); } }
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; }
body { margin: 0; background: var(--page); color: var(--ink);
  font: 1rem/1.55 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
main { max-width: 66rem; margin: auto; padding: clamp(1rem, 4vw, 2.5rem); overflow-wrap: anywhere; }
h1 { font-size: clamp(1.6rem, 5vw, 2.3rem); line-height: 1.15; letter-spacing: -0.02em; margin: 0; }
h2 { font-size: 1.25rem; margin: 0 0 0.5rem; }
p { margin: 0 0 0.8rem; max-width: 46rem; }
header p, footer { color: var(--soft); }
header p { margin: 0.5rem 0 1.5rem; }
section { margin-top: 2.5rem; }
footer { margin-top: 3rem; padding-top: 1rem; border-top: 1px solid var(--rule); font-size: 0.9rem; }
a { color: var(--link); }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(9.5rem, 1fr)); gap: 0.75rem;
  margin: 0; }
.cards div { display: flex; flex-direction: column-reverse; justify-content: flex-end;
  background: var(--card);
  border: 1px solid var(--rule); border-radius: 0.6rem; padding: 0.9rem 1rem; }
dd { margin: 0; font-size: 1.45rem; font-weight: 650; letter-spacing: -0.01em; line-height: 1.25;
  font-variant-numeric: tabular-nums; }
dt { color: var(--soft); font-size: 0.85rem; line-height: 1.35; margin-top: 0.2rem; }
aside { background: var(--warn); border-left: 4px solid var(--model); border-radius: 0.3rem;
  padding: 0.8rem 1rem; margin-top: 1rem; white-space: pre-line; }
.box { overflow-x: auto; background: var(--card); border: 1px solid var(--rule); border-radius: 0.6rem;
  margin: 0 0 1rem; }
.fit { width: fit-content; max-width: 100%; }
.formulas { padding: 0.8rem 1rem 0; }
.formulas p { max-width: none; font-variant-numeric: tabular-nums; }
.term { white-space: nowrap; }
figure { margin: 0 0 1rem; }
.plot { padding: 0.75rem; }
.plot img { display: block; max-width: 100%; height: auto; margin: auto; }
.wide img { min-width: 36rem; }
table { border-collapse: collapse; width: 100%; font-size: 0.92rem; font-variant-numeric: tabular-nums; }
th, td { padding: 0.45rem 0.9rem; text-align: right; vertical-align: top; white-space: nowrap;
  border-top: 1px solid var(--rule); }
thead th { border-top: 0; color: var(--soft); font-weight: 500; }
th:first-child { text-align: left; font-weight: 500; }
#frames td:last-child, #frames th:last-child { text-align: left; }
#frames td span { display: block; }
.rejected { color: var(--soft); }
.rejected b { color: var(--model); font-weight: 600; }
@media (max-width: 32rem) { th, td { padding: 0.4rem 0.6rem; } }
sub, sup { line-height: 0; }
@media print { body { background: none; } .box { overflow: visible; } }
"""
