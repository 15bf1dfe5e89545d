"""The results as a page."""

import numpy as np

from ...shared import table
from .data import LEVEL, SIZE, UPRIGHT

OURS = "SmoothZoom, other half's prior"
"""The model that others are compared with."""

KNOWN = "SmoothZoom.for_lens, other half's prior"
"""The same with what is known of the lens: the ends of its range, and the crop factor."""

FITTED = "the same, told the ends fitted"
"""The same, where the range of the lens is taken to be what was photographed."""

_COLUMNS = ("", "25 %", "median", "75 %", "90 %", "interval of the median", "corner, median", "lenses")


def markdown(results: dict) -> str:
    """The page, of what `study.study` measured and the machine that it ran on."""
    models = results["models"]
    order = sorted(models, key=lambda name: models[name]["left_out"]["rms"][1])
    sections = (
        _about(results),
        _left_out(results, order),
        _lens_by_lens(results, order),
        _few(results),
        _part(results),
        _in_sample(results, order),
        _floor(results),
        _check(results),
    )
    return "\n".join(line for section in sections for line in [*section, ""])


def _about(r: dict) -> list[str]:
    m = r["machine"]
    times = ", ".join(f"{name} {s:.0f} s" for name, s in r["times"].items() if "fit_zoom" not in name)
    return [
        "# Six hundred real zoom lenses",
        "",
        f"`python -m benchmarks.real.lensfun`: {r['lenses']} rectilinear zooms of the lensfun database "
        f"(lensfunpy {m['lensfunpy']}) calibrated at five or more focal lengths, {r['frames']:,} in all, "
        f"of which {r['left_out']:,} are interior and left out in turn. {r['tables']} of the tables are "
        f"distinct, and {r['families']} families of lenses have neither a name nor a table in common: "
        f"intervals (95 %) are by bootstrap over families. {UPRIGHT + LEVEL} lines a focal length, seen in "
        f"{SIZE[0]} × {SIZE[1]} px, no noise but that of the calibrations. RMS distance to straightness, "
        "px, of each lens; quantiles over the lenses.",
        "",
        f"{m['cpu']}, {m['cores']} cores, {m['memory_GB']} GB; Python {m['python']}, jax {m['jax']}, numpy "
        f"{m['numpy']}, scipy {m['scipy']}; on {m['device']}. The study took {r['seconds']:.0f} s, "
        f"compilation included, and {r['processor']:.0f} s of processor time, on a machine with a load of "
        f"{r['load']:.1f} ({times}).",
    ]


def _left_out(r: dict, order: list[str]) -> list[str]:
    floor = _row(
        "its own optimum (no model can do better)",
        r["frames_alone_interior"],
        ["", "0", str(r["lenses"])],
    )
    rows = [floor, *(_model_row(r, name, "left_out") for name in order)]
    return [
        "## A focal length left out",
        "",
        *table(_COLUMNS, rows),
        "",
        "`corner` is how far, px, the displacement at the image's corner is from that of the frame's own "
        "optimum. The prior of `SmoothZoom` was learned from the other half of the lenses, families kept "
        "together, and so was that of `SmoothZoom.for_lens`, which knows the ends of the lens's range and "
        "the crop factor; as it is in the package it was learned from all, so that its row is in sample. "
        "What shape the prior has was found with all lenses at hand (see docs/zoom-models.md). Monotone "
        "cubics and the nearest frame are no models of the package; `degree chosen inside` takes the "
        "degree, 1 to 3, that predicts best within the focal lengths it may see. Power law and two regions "
        "are fitted to k1 and k2.",
    ]


def _lens_by_lens(r: dict, order: list[str]) -> list[str]:
    rows = [
        [
            name,
            f"{p['ratio']:.3f}",
            _between(p["ratio_interval"]),
            f"{100 * p['better']:.0f} %",
            *(f"{d:+.3f} ({low:+.3f} to {high:+.3f})" for d, low, high in p["differences"]),
        ]
        for name, p in ((name, r["paired"][name]) for name in order if name != OURS)
    ]
    return [
        "## Lens by lens",
        "",
        "`SmoothZoom` with the other half's prior against each model, on the same lenses: the geometric "
        "mean of the ratio of their errors, the part of the lenses on which it is better, and the "
        "difference of the quantiles, px, with paired intervals.",
        "",
        *table(("against", "ratio", "interval", "better", "25 %", "median", "75 %", "90 %"), rows),
    ]


def _of_few(errors: dict) -> list[str]:
    rows = [
        [name, number, *(f"{x:.3f}" for x in of[number])]
        for number in next(iter(errors.values()))
        for name, of in errors.items()
    ]
    return table(("", "fitted", "25 %", "median", "75 %", "90 %"), rows)


def _few(r: dict) -> list[str]:
    return [
        "## Few focal lengths",
        "",
        "Only so many are fitted: both ends of the zoom and, between them, those nearest to an even "
        "spacing in 1/f. Errors at the other ones, by the quantiles over the lenses. `for_lens` knows the "
        "ends of the lens's range and the crop factor.",
        "",
        *_of_few(r["few"]),
    ]


def _part(r: dict) -> list[str]:
    part = r["part"]
    return [
        "## A part of the range",
        "",
        f"The same of {part['lenses']} lenses with seven or more focal lengths of which the longer half is "
        "photographed. `for_lens` knows the whole range of the lens, and is about its shortest focal "
        "length (or, in its second row, is told that the lens had that half alone).",
        "",
        *_of_few(part["errors"]),
    ]


def _in_sample(r: dict, order: list[str]) -> list[str]:
    least = r["frames_alone"][1] + 1e-3
    rows = [
        _row("no correction", r["none"], ["", "", str(r["lenses"])]),
        _row("frame by frame", r["frames_alone"], ["", "0", str(r["lenses"])]),
        *(
            _model_row(r, name, "in_sample")
            for name in order
            if r["models"][name]["in_sample"]["rms"][1] > least
        ),
    ]
    return [
        "## In sample",
        "",
        *table(_COLUMNS, rows),
        "",
        "Tables and splines with an entry at each focal length are frame by frame in sample.",
    ]


def _floor(r: dict) -> list[str]:
    twice = r["twice"]["rms"]
    return [
        "## The floor",
        "",
        f"{r['twice']['pairs']} times the database has a lens twice, calibrated by hand on sensors of "
        "different sizes. Corrected by the one calibration, lines of the other at the same focal lengths "
        "(within 2 %) are less straight than by its own; over √2, that is what one calibration is wrong "
        f"by: 25 / 50 / 75 / 90 %: {' / '.join(f'{x:.3f}' for x in twice)} px (two copies of the lens "
        "differ, too). The frame left out is one calibration, and the prediction is made from others: even "
        f"the true curve would be off by about {np.hypot(twice[1], r['frames_alone_interior'][1]):.2f} px "
        "in the median, with what two coefficients cannot follow.",
    ]


def _check(r: dict) -> list[str]:
    rows = [
        [name, str(number), f"{median:.0e}", f"{largest:.0e}"]
        for name, number, median, largest in r["check"]
    ]
    return [
        "## How far the study's fits are from those of fit_zoom",
        "",
        "Every 16th lens, if it has up to 8 focal lengths, its middle one left out: difference, px, of the "
        "RMS there. It is rounding, for the scene's lines are symmetric about the image's axes: their "
        "direction then does not depend on k, and the energy is exactly quadratic in it.",
        "",
        *table(("", "fits", "median", "largest"), rows),
    ]


def _row(name: str, figures: list[float], more: list[str]) -> list[str]:
    return [name, *(f"{x:.3f}" for x in figures), *more]


def _model_row(r: dict, name: str, which: str) -> list[str]:
    model = r["models"][name]
    corner = f"{model[which]['corner'][1]:.2f}"
    more = [_between(model[which]["median_interval"]), corner, str(model["lenses"])]
    return _row(name, model[which]["rms"], more)


def _between(ends: list[float]) -> str:
    return f"{ends[0]:.3f} to {ends[1]:.3f}"
