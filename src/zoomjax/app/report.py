"""report.html: a calibration from lines on one page.

Its text is in ``templates/report.html``; this module computes the values. Runs once per calibration; most
of the time is plotting.
"""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .._core.text import span
from ..models.registry import distortion_model_name
from ..trust.assessment import Verdict
from ..trust.selection import COLUMNS
from .board_plot import plot_boards
from .calibration import Calibration, rms_over_frames
from .centre_plot import FEWEST, plot_own_centres
from .choice import colour_limit
from .coverage import plot_coverage, plot_radius
from .page import Run, counted, data_url, embedded_data, embedded_plot, rendered, short
from .pictures import Pictures
from .plot import plot_distortion, plot_model, plot_primitives, plot_residues
from .slider import slider

if TYPE_CHECKING:
    from .image_calibration import ImageCalibration

_MOST_FRAMES = 300
"""Limit for the list of frames and for vector plots. It keeps the page readable."""

_COLUMNS = ("before", "after", "left out", "alone", "lines", "worst lines")
"""Of the list of frames: RMS distances, the number of lines and the worst of them."""

_WORST, _WORST_REJECTED = 3, 2
"""How many lines of a frame are listed: of those that count, and of the rejected ones."""


def report(
    calibration: Calibration,
    images: "ImageCalibration | None" = None,
    *,
    pictures: Iterable[Pictures] = (),
    run: Run | None = None,
) -> str:
    """Render the report as HTML.

    Args:
        calibration: the calibration to report.
        images: the images in which the lines were found. The page then lists them by name, with links to
            their pictures in the folder ``lines/`` next to it.
        pictures: pictures of some of the images, to be embedded; asked for when all else is done.
        run: what was run.
    """
    lens = calibration.fit.lens
    versions = calibration.summary()["versions"]
    run, moving = run or Run(), slider(calibration.fit)
    verdicts = images.verdicts() if images else []
    return rendered(
        "report.html",
        title=run.title,
        about=[
            calibration.focal_text(),
            f"{lens.image_size[0]} × {lens.image_size[1]} px",
            counted(len(calibration.rms_uncorrected), "photo" if images else "frame"),
            counted(len(calibration.rejected), "line"),
            counted(int(np.sum(np.asarray(calibration.lines.mask))), "point"),
        ],
        several=len(calibration.rms_uncorrected) > 1,
        zooms=_zooms(calibration) > 1,
        verdict=calibration.assessment,
        cards=_cards(calibration),
        warnings=images.warnings() if images else calibration.warnings(),
        slider=embedded_data(moving),
        slider_times=f"{moving['times']:g}" if moving and moving["times"] > 1 else None,
        straightness=_straightness(calibration),
        coverage=_coverage(calibration),
        lens=_lens(calibration),
        distortion=_distortion(calibration),
        board=_board(calibration, images),
        next=calibration.advice(),
        frames=_frames(calibration, images, verdicts),
        images=images,
        run=run.rows,
        files=["lens.json", "summary.json", "lines.npz", "model.png"],
        versions=", ".join(f"{name} {of}" for name, of in versions.items()),
        **_photos(calibration, images, pictures, verdicts),  # the last: they may be still being drawn
    )


def _photos(
    calibration: Calibration,
    images: "ImageCalibration | None",
    pictures: Iterable[Pictures],
    verdicts: Sequence[tuple[Verdict, str]],
) -> dict[str, Any]:
    """Photos before and after, each with the verdict on it, and the limit of their colours."""
    shown = []
    if images is not None:
        for one in pictures:
            verdict, reason = verdicts[one.frame]
            shown.append({"verdict": verdict, "reason": reason, **_photo(calibration, images, one)})
    return {"photos": shown, "limit": f"{colour_limit(calibration):.2g}" if shown else None}


def _photo(calibration: Calibration, images: "ImageCalibration", one: Pictures) -> dict[str, Any]:
    """A photo before and after, with crops of its worst lines."""
    focal = float(np.asarray(calibration.lines.focal)[one.frame])
    rms = np.asarray(calibration.fit.frame_rms)[one.frame], calibration.rms_uncorrected[one.frame]
    return {
        "name": images.used[one.frame].name,
        "focal": f"{focal:.5g}",
        "unit": calibration.lines.focal_unit if calibration.focal_known else "",
        "rms": [f"{float(value):.2g}" if np.isfinite(value) else "–" for value in rms],
        "before": data_url(one.before, "jpeg"),
        "after": data_url(one.after, "jpeg"),
        "crops": [
            {"line": line, "rms": f"{calibration.line_rms[line]:.2g}", "source": data_url(crop, "jpeg")}
            for line, crop in one.crops.items()
        ],
    }


def _cards(calibration: Calibration) -> list[tuple[str, str]]:
    """The key figures at the top of the page: of photos left out, where they are known."""
    found = calibration.assessment.evidence
    left_out, own = (
        rms_over_frames(of) for of in (calibration.rms_held_out, calibration.rms_frames_held_out)
    )
    none, zoom = (rms_over_frames(of) for of in (calibration.rms_uncorrected, calibration.fit.frame_rms))
    after = left_out if np.isfinite(left_out) else zoom
    where = " at the zoom where it is largest" if _zooms(calibration) > 1 else ""
    cards = [
        (
            f"{short(none)} → {short(after)} px",
            "from straight: lines before → after correction",
        ),
        (f"{none / after:.3g} times" if after > 0 else "∞", "straighter"),
        (
            f"{short(found.displacement)} px",
            f"shift of pixels by the correction, RMS{where}",
        ),
        (
            f"± {short(found.std)} px" if np.isfinite(found.std) else "unknown",
            f"its uncertainty, RMS{where}",
        ),
    ]
    if np.isfinite(left_out) and np.isfinite(own):
        cards[0] = (cards[0][0], cards[0][1] + ", in photos left out of the fit")
        cards.append((f"{short(own)} px", "from straight after a correction for each photo alone"))
    return cards


def _coverage(calibration: Calibration) -> list[dict[str, Any]]:
    weight = (~calibration.rejected).astype(float)
    lens = calibration.fit.lens
    plots = [
        embedded_plot(
            plot_coverage(calibration.lines, weight), "Coverage of the image and of the zoom by lines"
        )
    ]
    label = "Residuals against the distance from the centre"
    return [*plots, embedded_plot(plot_radius(calibration.lines, lens, weight), label, class_="box plot")]


def _zooms(calibration: Calibration) -> int:
    """The number of focal lengths."""
    return np.unique(np.asarray(calibration.lines.focal)).size


def _straightness(calibration: Calibration) -> dict[str, Any]:
    each = rms_over_frames(calibration.frames.frame_rms)
    held_out = {name: rms_over_frames(frames) for name, frames in calibration.held_out_rows().items()}
    figure = plot_residues(
        calibration.lines,
        calibration.rms_uncorrected,
        np.asarray(calibration.frames.frame_rms),
        np.asarray(calibration.fit.frame_rms),
    )
    chosen, along = calibration.selection, " against 1/f" if _zooms(calibration) > 1 else ""
    return {
        "against": "vs. frame by frame" if len(calibration.rms_uncorrected) > 1 else "vs. corrected",
        "rows": [
            (
                name,
                f"{held_out[name]:.4f}" if held_out.get(name, np.nan) > 0 else "",
                f"{value:.4f}",
                "" if name in ("frame by frame", "corrected") else _excess(value, each),
            )
            for name, value in ((name, rms_over_frames(frames)) for name, frames in calibration.rows())
        ],
        "unit": f"px of the {'distorted' if calibration.in_image else 'corrected'} image",
        "weighting": calibration.weighting,
        "choice": chosen
        and {"title": chosen.title, "columns": COLUMNS, "rows": chosen.rows(), "why": chosen.why},
        "plot": embedded_plot(figure, f"Residual RMS of each frame{along}", class_="box plot"),
    }


def _lens(calibration: Calibration) -> dict[str, Any]:
    names = calibration.coefficient_names()
    return {
        "unit": calibration.fit.lens.focal_unit,
        "centre": _centre(calibration),
        "centre_found": calibration.centre.sentence,
        "centres": _own_centres(calibration),
        "coefficients": _coefficients(calibration),
        "distortion_model": distortion_model_name(calibration.fit.lens.distortion_model),
        "formula": calibration.fit.lens.distortion_model.formula,
        "names": list(names),
        "polynomials": [
            (name[0], name[1:], order, [_term(value, power) for power, value in enumerate(column)])
            for (name, order), column in zip(names.items(), calibration.pixel_polynomials().T, strict=False)
        ],
        "certificate": _certificate(calibration),
        "plot": embedded_plot(
            plot_model(calibration.fit, calibration.frames, calibration.lines),
            "Distortion coefficients against 1/f: separate fits of the frames, and the zoom model"
            if _zooms(calibration) > 1
            else "Distortion coefficients: separate fits of the frames, and the common model",
            kind="svg" if len(calibration.rms_uncorrected) <= _MOST_FRAMES else "png",
        ),
    }


def _centre(calibration: Calibration) -> str:
    """Where radii are measured from."""
    lens = calibration.fit.lens
    if lens.shift is not None:
        return ", which moves along the zoom"
    x, y = (float(value) for value in np.asarray(lens.centre))
    return f" ({x:.6g}, {y:.6g})"


def _own_centres(calibration: Calibration) -> Any:
    """The centres of single frames beside that of the lens; None where too few tell theirs."""
    own = calibration.own_centres
    if own is None or own.known.sum() < FEWEST:
        return None
    figure = plot_own_centres(calibration.fit, own, np.asarray(calibration.lines.focal))
    return embedded_plot(
        figure, "Centre of distortion of single frames, and of the lens", class_="box plot"
    )


def _coefficients(calibration: Calibration) -> list[tuple[str, ...]]:
    """Of a model other than polynomials, focal lengths and coefficients, px; nothing for these."""
    if calibration.pixel_polynomials().size:
        return []
    rows = calibration.coefficient_rows()
    return [(f"{f:.4g}", *(f"{value:+.4e}" for value in values)) for f, *values in rows]


def _certificate(calibration: Calibration) -> str:
    lens, proof = calibration.fit.lens, calibration.fit.certificate
    low, high = (float(f) for f in lens.focal_range)
    known = calibration.focal_known
    at = f"at f = {float(proof.focal):.4g} {lens.focal_unit}, " * known
    where = f" at {'any focal length from ' * (low < high)}{span(low, high, lens.focal_unit)}" * known
    found = f"{float(proof.slope):.3g}, {at}{float(proof.radius):.0f} px from the centre"
    if proof.certified:
        return (
            f"The lens is proved to be invertible: the corrected image does not fold over{where}. The "
            "slope of the corrected radius (1 without distortion, 0 at a fold) is at least "
            f"{float(proof.least):.3g}; the smallest slope found is {found}."
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
    lens, focal = calibration.fit.lens, np.asarray(calibration.lines.focal)
    known = calibration.focal_known
    ends = sorted({float(focal.min()), float(focal.max())})
    frames = sorted({int(np.argmin(focal)), int(np.argmax(focal))}, key=lambda frame: focal[frame])
    return {
        "rows": [
            (
                f"{f:.4g} {lens.focal_unit}" if known else "any",
                f"{moved:+.2f}".replace("-", "−"),
                _uncertainty(std),
            )
            for f, moved, std in calibration.corner
        ],
        "allowed_for": calibration.allowed_for(),
        "grid": embedded_plot(
            plot_distortion(calibration.fit, focal=ends),
            "A straight grid, distorted, and the displacement of pixels, at both ends of the zoom",
        ),
        "points": embedded_plot(
            plot_primitives(calibration.lines, lens, frames),
            "Points before and after correction",
            kind="png",
        ),
    }


def _board(calibration: Calibration, images: "ImageCalibration | None") -> dict[str, Any] | None:
    """How bent the board is, and its bundle adjustment beside straightness; or why there is none."""
    if images is None or not images.board():
        return None
    told, bundle = images.board(), images.bundle
    if bundle is None:
        return {"sentences": told, "plot": None}
    place = [bundle.names[int(np.argmax(bundle.number == zoom))] for zoom in range(len(bundle.fit.focal))]
    rows = bundle.compared(calibration.fit.lens, [images.focals.focal[name] for name in place])
    head = ["f of the bundle, px", "as seen, px", "lens.json, px", "bundle, px"]
    known = calibration.focal_known
    zooms = bundle.of_boards() if known else []
    return {
        "sentences": told,
        "head": [f"f {bundle.before}, {bundle.unit}", *head] if known else head,
        "rows": rows if known else [row[1:] for row in rows],
        "plot": embedded_plot(
            plot_boards(bundle.fit, zooms), "Height of the board's corners over its plane"
        ),
    }


def _frames(
    calibration: Calibration, images: "ImageCalibration | None", verdicts: Sequence[tuple[Verdict, str]]
) -> dict[str, Any]:
    """The list of frames, of photos each with the verdict on it, and each with its least straight lines."""
    summary = calibration.summary()["per_frame"]
    worst = np.argsort(-np.asarray(calibration.fit.frame_rms), kind="stable")[:_MOST_FRAMES]
    shown = worst[np.lexsort([worst, np.asarray(calibration.lines.focal)[worst]])]
    lines = calibration.lines
    members = np.split(
        np.argsort(lines.frame, kind="stable"),
        np.cumsum(np.bincount(lines.frame, minlength=len(summary)))[:-1],
    )
    unit, overlays = f"f, {lines.focal_unit}", images.overlays() if images else [""] * len(summary)
    return {
        "number": len(summary),
        "head": [*(["photo", "verdict"] if images else ["frame"]), unit, *_COLUMNS],
        "rows": [
            {
                "name": images.used[number].name if images else str(number),
                "picture": f"lines/{overlays[number]}" if overlays[number] else None,
                "verdict": verdicts[number] if verdicts else None,
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
        for key in ("rms_none", "rms_zoom", "rms_held_out", "rms_frames")
    )
    counted = f"{frame['lines']:,}" + (f" ({rejected.sum()} rejected)" if rejected.any() else "")
    return [f"{frame['focal']:.4g}", *values, counted]


def _worst_lines(calibration: Calibration, members: np.ndarray) -> list[dict[str, Any]]:
    """The worst lines of a frame: of those that count, and of the rejected ones."""
    worst = members[np.argsort(-calibration.line_rms[members], kind="stable")]
    rejected = calibration.rejected[worst]
    points, mask = np.asarray(calibration.lines.points), np.asarray(calibration.lines.mask)
    listed = []
    for line in [*worst[~rejected][:_WORST], *worst[rejected][:_WORST_REJECTED]]:
        x, y = points[line][mask[line]].mean(axis=0)
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
