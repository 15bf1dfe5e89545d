"""Plots with matplotlib (extra ``zoomjax[app]``). Functions return figures; nothing is shown."""

import io
import os
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from ..fit.centre import FrameCentres
from ..fit.result import FrameFits, ZoomFit
from ..fit.same_camera import check_alike, check_camera, check_lines_of
from ..lines.base import AbstractLines
from ..lines.lines import Lines
from ..models.lens import ZoomLens
from ..trust.bands import coefficient_std, displacement_std
from .colours import DEPTHS, FRAMES, MODEL
from .outward import distortions_at

_EXAGGERATIONS = np.outer(10.0 ** np.arange(7), (1, 2, 5)).ravel()
_VISIBLE = 0.03  # of the image's longer side: how far the drawn grid is bent at least
_STEP = 7  # from one arrow to the next, in points at which the field is known
_ROUNDING = 1e-6  # of half the diagonal: smaller displacements are none


def save_plot(figure: Figure, file: str | os.PathLike[str] | io.BytesIO, **how: Any) -> None:
    """As ``figure.savefig(file, dpi=150, **how)``, in three quarters of the time, with the same bytes.

    Matplotlib draws a figure with a layout twice: at first with a renderer that does nothing, when it needs
    the layout alone.
    """
    engine, draw = figure.get_layout_engine(), figure.draw

    def lay_out_or_draw(renderer: Any) -> None:
        if engine is not None and figure.get_layout_engine() is engine:  # it has another when it is drawn
            engine.execute(figure)
        else:
            draw(renderer)

    figure.draw = lay_out_or_draw
    try:
        figure.savefig(file, dpi=150, **how)
    finally:
        del figure.draw


def plot_model(zoom: ZoomFit, each: FrameFits, lines: AbstractLines) -> Figure:
    """Plot the distortion coefficients against 1/f: separate fits of the frames, and the zoom model (Figure
    8).

    Below each coefficient stands by how much the frames differ from the model, with bars of one standard
    deviation of the frame's own fit; frames whose lines do not determine it have no dot. Around the model
    are shaded one and two of its standard deviations, where the lines determine it. Frames of one focal
    length stand side by side.

    Args:
        zoom: the fitted zoom model.
        each: the frames fitted by themselves.
        lines: what both were fitted to; only its focal lengths are used.

    Raises:
        ValueError: both are not of these frames, with the same coefficients of the same distortion model.
    """
    lens = zoom.lens
    check_lines_of(zoom, lines)
    check_alike(zoom, each)
    terms = each.coefficients.shape[1]
    orders = lens.distortion_model.orders(terms)
    to_pixel = lens.scale ** (-1.0 * orders)
    focal = np.asarray(lines.focal)
    place, along_what, one = _along(focal, lens.focal_unit)
    margin, of = (0.5, "common") if one else (0.0, "zoom")
    grid = np.linspace(place.min() - margin, place.max() + margin, 200)
    along = np.full(200, focal[0]) if one else 1 / grid
    frames = np.asarray(each.coefficients) * to_pixel
    sigma = np.sqrt(np.diagonal(np.asarray(each.covariance), axis1=1, axis2=2)) * to_pixel

    def model(focal: np.ndarray) -> np.ndarray:
        return np.stack([d.coefficients for d in distortions_at(lens, focal)]) * to_pixel

    curve, expected = model(along), model(focal)
    spread = np.asarray(coefficient_std(zoom, along)) * to_pixel
    figure = Figure(figsize=(4.8 * terms, 5.2), layout="constrained")
    figure.suptitle(
        f"RMS {float(zoom.rms):.3f} px by the {of} model, {float(each.rms):.3f} px frame by frame",
        fontsize=10,
    )
    axes = figure.subplots(2, terms, sharex=True, squeeze=False, height_ratios=[2.2, 1])
    for i, (above, below) in enumerate(axes.T):
        known = np.isfinite(sigma[:, i])
        x, unit = place[known], f"px$^{{-{orders[i]}}}$"
        above.plot(
            x, frames[known, i], "o", markersize=3.5, color=FRAMES, label="separate fit of each frame"
        )
        above.plot(grid, curve[:, i], color=MODEL, linewidth=1.8, label=f"{of} model")
        _shade(above, grid, curve[:, i], spread[:, i])
        name = f"k_{i + 1}" if orders[i] > 1 else f"p_{i + 1 - np.sum(orders > 1)}"
        _label(above, f"${name}$", unit, curve[:, i])
        difference = frames[known, i] - expected[known, i]
        below.errorbar(x, difference, sigma[known, i], fmt="o", markersize=2.5, linewidth=0.9, color=FRAMES)
        _shade(below, grid, 0.0, spread[:, i])
        _label(below, "frame − model", unit, np.append(difference, sigma[known, i]))
        below.axhline(0, color=MODEL, linewidth=1.2, zorder=0)
        below.set_xlabel(along_what)
        below.locator_params(axis="x", nbins=6, integer=one)  # labels of focal lengths in px are long
        if not one:
            _show_focal_lengths(above, focal, lens.focal_unit)
    figure.axes[0].legend(frameon=False)
    return figure


def plot_residues(
    lines: AbstractLines,
    none: Float[np.ndarray, "frame"],
    each: Float[np.ndarray, "frame"],
    zoom: Float[np.ndarray, "frame"],
    *,
    unit: str = "px",
) -> Figure:
    """Plot each frame's RMS against 1/f: uncorrected, frame by frame, zoom model (Figures 9 and 10).

    Frames of one focal length stand side by side.

    Args:
        lines: only their focal lengths are used.
        none, each, zoom: each frame's RMS without correction, frame by frame, and with the zoom model.
        unit: unit of the RMS values.
    """
    focal = np.asarray(lines.focal)
    place, along_what, one = _along(focal, lines.focal_unit)
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.subplots()
    size = 4 if len(focal) < 100 else 2.5
    axes.plot(place, none, "x", color="0.55", markersize=size + 1, label="no correction")
    axes.plot(place, each, "o", color=FRAMES, markersize=size + 2, fillstyle="none", label="frame by frame")
    label = "common model" if one else "zoom model"
    axes.plot(place, zoom, "o", color=MODEL, markersize=size, label=label)
    axes.set_ylim(0)
    axes.set_ylabel(f"RMS distance to the lines  ({unit})")
    axes.set_xlabel(along_what)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False)
    if one:
        axes.locator_params(axis="x", integer=True)
    else:
        _show_focal_lengths(axes, focal, lines.focal_unit)
    return figure


def plot_primitives(lines: Lines, lens: ZoomLens, frames: Sequence[int]) -> Figure:
    """Plot the points of some frames, distorted and corrected (Figures 5 and 6). One row per frame.

    The outline is the border of the image, which the correction bends. A lens for others is refused.
    """
    check_camera(lens, lines)
    figure = Figure(figsize=(9, 3.1 * len(frames)), layout="constrained")
    width, height = lines.image_size
    border = np.concatenate(
        [
            np.linspace(start, end, 100)
            for start, end in pairwise(
                np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]]) * [width - 1, height - 1]
            )
        ]
    )
    mask, index = np.asarray(lines.mask), np.asarray(lines.frame)
    for row, frame in zip(figure.subplots(len(frames), 2, squeeze=False), frames, strict=True):
        number = range(len(lines.focal))[frame]
        focal = float(np.asarray(lines.focal)[number])
        chosen = index == number
        points = np.asarray(lines.points)[chosen][mask[chosen]].astype(float)
        distortion = lens(focal)
        for axes, mapped in zip(row, (np.asarray, distortion.undistort), strict=True):
            axes.plot(*np.asarray(mapped(points)).T, ".", markersize=0.5, color=FRAMES, rasterized=True)
            axes.plot(*np.asarray(mapped(border)).T, color=MODEL, linewidth=1)
            axes.set_aspect("equal")
            axes.invert_yaxis()
            axes.set_axis_off()
        row[0].set_title(f"$f$ = {focal:.2f} {lines.focal_unit}: {chosen.sum()} lines", fontsize=9)
        row[1].set_title("corrected", fontsize=9)
    return figure


def plot_centres(centres: FrameCentres, lines: AbstractLines) -> Figure:
    """Plot each frame's centre of distortion, and by how much it lowers the frame's RMS (Figure 7).

    Crosses show standard deviations. Frames whose lines do not determine a centre are left out.
    """
    known = np.asarray(centres.determined)
    away = (np.asarray(centres.each.centre) - np.asarray(lines.centre))[known]
    gain = 100 * (1 - np.asarray(centres.each.frame_rms) / np.asarray(centres.rms_fixed))[known]
    focal = np.asarray(lines.focal)
    figure = Figure(figsize=(9.6, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    std = np.asarray(centres.std)[known]
    left.errorbar(*away.T, xerr=std[:, 0], yerr=std[:, 1], fmt="none", ecolor="0.85", elinewidth=0.8)
    dots = left.scatter(*away.T, c=1 / focal[known], s=16, cmap="viridis", zorder=2)
    left.plot(0, 0, "+", color=MODEL, markersize=12, label="the image's centre")
    figure.colorbar(dots, label=f"$1/f$  (1/{lines.focal_unit})", shrink=0.85)
    left.set_aspect("equal", adjustable="datalim")
    left.set_xlabel("centre of distortion, $x$  (px from the image's)")
    left.set_ylabel("$y$  (px)")
    left.invert_yaxis()
    left.legend(frameon=False)
    right.plot(1 / focal[known], gain, "o", markersize=3.5, color=FRAMES)
    right.axhline(0, color="0.85", linewidth=0.8, zorder=0)
    right.set_ylabel("RMS lower by  (%)")
    right.set_xlabel(f"$1/f$  (1/{lines.focal_unit})")
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def plot_distortion(
    lens: ZoomLens | ZoomFit, *, focal: float | Sequence[float], exaggeration: float | None = None
) -> Figure:
    """Plot how a lens distorts a straight grid, and the displacement of each pixel by the correction.

    One row per focal length. Left: a straight grid, and the same grid distorted by the lens. Right: the
    distance of each pixel from its corrected point, with arrows towards it, and for a fit contours of its
    standard deviation. Beyond a fold there is no corrected point: grid lines end there, and the right plot
    is hatched.

    Args:
        lens: a lens, or a fit.
        focal: one focal length or several, in the lens's unit.
        exaggeration: factor by which the distortion of the grid is drawn larger than it is; by default the
            smallest of 1, 2, 5, 10, ... that makes it visible.
    """
    fit, lens = (lens, lens.lens) if isinstance(lens, ZoomFit) else (None, lens)
    focals = np.atleast_1d(np.asarray(focal, float)).tolist()
    width, height = lens.image_size
    figure = Figure(figsize=(9.6, len(focals) * (1.2 + 4 * height / width)), layout="constrained")
    for f, (left, right) in zip(focals, figure.subplots(len(focals), 2, squeeze=False), strict=True):
        _draw_grid(left, lens, f, exaggeration)
        _draw_field(figure, right, lens, fit, f)
        for axes in (left, right):
            axes.set_aspect("equal")
            axes.invert_yaxis()
            axes.set_xlabel("$x$  (px)", fontsize=8)
            axes.set_ylabel("$y$  (px)", fontsize=8)
            axes.tick_params(labelsize=8)
            axes.locator_params(nbins=5)
    return figure


def _draw_grid(axes: Axes, lens: ZoomLens, focal: float, exaggeration: float | None) -> None:
    """A straight grid in grey, and the same grid distorted by the lens."""
    width, height = lens.image_size
    cells = np.maximum(2, np.round(12 * np.array([width, height]) / max(width, height)).astype(int))
    x, y = (np.linspace(0, side - 1, 8 * n + 1) for side, n in zip((width, height), cells, strict=True))
    straight = [np.stack(np.broadcast_arrays(at, y), -1) for at in x[::8]]
    straight += [np.stack(np.broadcast_arrays(x, at), -1) for at in y[::8]]
    points = np.concatenate(straight)
    off = np.asarray(lens(focal).distort(points)) - points
    farthest = np.max(np.nan_to_num(_lengths(off)))
    if exaggeration is None:
        enough = _EXAGGERATIONS[_EXAGGERATIONS * farthest >= _VISIBLE * max(width, height)]
        exaggeration = float(enough[0]) if len(enough) else 1.0
    bent = np.split(points + exaggeration * off, np.cumsum([len(line) for line in straight])[:-1])
    for line, seen in zip(straight, bent, strict=True):
        axes.plot(*line.T, color="0.75", linewidth=0.8, zorder=1)
        axes.plot(*seen.T, color=MODEL, linewidth=1.1, zorder=2)
    axes.set_title(f"$f$ = {focal:.4g} {lens.focal_unit}: a straight grid, distorted", fontsize=9)
    more = "" if exaggeration == 1 else f", distortion × {exaggeration:g}"
    _explain(
        axes,
        Line2D([], [], color="0.75", label="straight"),
        Line2D([], [], color=MODEL, label=f"distorted by the lens{more}"),
    )
    axes.spines[:].set_visible(False)


def _draw_field(figure: Figure, axes: Axes, lens: ZoomLens, fit: ZoomFit | None, focal: float) -> None:
    """Distance and direction of pixels to their corrected points, with standard deviations."""
    points = _raster(lens)
    moved = np.asarray(lens(focal).undistort(points)) - points
    distance = np.ma.masked_invalid(_lengths(moved))
    distance[distance < _ROUNDING * lens.scale] = 0
    levels = MaxNLocator(7, steps=[1, 2, 2.5, 5, 10]).tick_values(0, float(distance.filled(0).max()) or 1)
    axes.patch.set(hatch="////", edgecolor="0.75")  # what shows beyond a fold
    filled = axes.contourf(*np.moveaxis(points, -1, 0), distance, levels, cmap=DEPTHS)
    bar = figure.colorbar(filled, ax=axes, shrink=0.8)
    bar.set_label("displacement  (px)", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    some = np.s_[_STEP // 2 :: _STEP, _STEP // 2 :: _STEP]
    at, arrows = points[some], np.ma.masked_invalid(moved[some])
    longest = float(distance[some].filled(0).max())
    if longest > 0:
        scale = longest / (at[0, 1, 0] - at[0, 0, 0])  # the longest reaches to the next
        axes.quiver(
            *np.moveaxis(at, -1, 0),
            *np.moveaxis(arrows, -1, 0),
            color=FRAMES,
            angles="xy",
            scale_units="xy",
            scale=scale,
            width=0.004,
        )
    fold = " (hatched: folded over)" if distance.mask.any() else ""
    axes.set_title(f"$f$ = {focal:.4g} {lens.focal_unit}: displacement by the correction{fold}", fontsize=9)
    if fit is not None:
        rough, folded = points[::2, ::2], np.ma.getmaskarray(distance)[::2, ::2]  # it is smooth
        std = np.asarray(displacement_std(fit, rough, focal=focal))
        _draw_std(axes, rough, np.ma.masked_where(folded | ~np.isfinite(std), std))
    axes.set(xlim=(0, lens.image_size[0] - 1), ylim=(0, lens.image_size[1] - 1))


def _draw_std(axes: Axes, points: np.ndarray, std: np.ma.MaskedArray) -> None:
    """Contours of the standard deviation, labelled in px."""
    largest = float(std.filled(0).max())
    if largest == 0:
        _explain(axes, Line2D([], [], linestyle="", label="standard deviation not determined by the lines"))
        return
    levels = MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]).tick_values(0, largest)[1:-1]
    drawn = axes.contour(
        *np.moveaxis(points, -1, 0), std, levels, colors=MODEL, linestyles="--", linewidths=1.1
    )
    axes.clabel(drawn, fmt="%g", fontsize=7)
    _explain(axes, Line2D([], [], color=MODEL, linestyle="--", label="standard deviation  (px)"))


def _explain(axes: Axes, *handles: Line2D) -> None:
    """A legend below the axes."""
    axes.legend(
        handles=handles,
        loc="upper center",
        bbox_to_anchor=(0.5, -0.17),
        ncols=len(handles),
        frameon=False,
        fontsize=8,
    )


def _raster(lens: ZoomLens) -> np.ndarray:
    """Evenly spaced points over the image, an odd number each way: (row, column, 2) px."""
    number = [max(2, round(14 * side / max(lens.image_size))) * _STEP | 1 for side in lens.image_size]
    sides = (np.linspace(0, side - 1, n) for side, n in zip(lens.image_size, number, strict=True))
    return np.stack(np.meshgrid(*sides), axis=-1)


def _lengths(vectors: np.ndarray) -> np.ndarray:
    return np.hypot(vectors[..., 0], vectors[..., 1])


def _along(focal: np.ndarray, unit: str) -> tuple[np.ndarray, str, bool]:
    """Where frames are along an axis and what it is called; side by side where all are of one f."""
    one = bool(np.ptp(focal) == 0)
    if one:
        return np.arange(1, len(focal) + 1), "frame", one
    return 1 / focal, f"$1/f$  (1/{unit})", one


def _shade(axes: Axes, x: np.ndarray, middle: np.ndarray | float, std: np.ndarray) -> None:
    """Bands of one and two standard deviations, the inner one darker."""
    if not np.isfinite(std).all():
        return
    for times, label in ((2, "±1 and ±2 standard deviations"), (1, None)):
        axes.fill_between(
            x,
            middle - times * std,
            middle + times * std,
            color=MODEL,
            alpha=0.16,
            linewidth=0,
            label=label,
        )


def _label(axes: Axes, quantity: str, unit: str, values: np.ndarray) -> None:
    """Label the y axis, with the power of ten in its unit rather than in a corner."""
    largest = np.max(np.abs(values), initial=0)
    power = int(np.floor(np.log10(largest))) if largest > 0 else 0
    axes.set_ylabel(f"{quantity}\n($10^{{{power}}}$ {unit})")
    axes.yaxis.set_major_formatter(lambda y, _: f"{y / 10.0**power:.4g}")
    axes.axhline(0, color="0.85", linewidth=0.8, zorder=0)
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(x=0.03)


def _show_focal_lengths(axes: Axes, focal: np.ndarray, unit: str) -> None:
    """A second axis on top, with round focal lengths."""
    steps = np.array([1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 7])
    decade = 10.0 ** np.arange(np.floor(np.log10(focal.min())), np.ceil(np.log10(focal.max())) + 1)
    candidates = np.sort(np.outer(decade, steps).ravel())
    candidates = candidates[(candidates >= focal.min() * 0.99) & (candidates <= focal.max() * 1.01)]
    span, shown = 1 / focal.min() - 1 / focal.max(), []
    for f in candidates:  # from the widest gaps in 1/f on, never closer than a tenth of the axis
        if not shown or 1 / shown[-1] - 1 / f >= 0.1 * span:
            shown.append(float(f))
    above = axes.secondary_xaxis("top")
    above.set_ticks([1 / f for f in shown], [f"{f:g}" for f in shown], fontsize=8)
    above.set_xlabel(f"$f$  ({unit})", fontsize=8)
    above.spines["top"].set_visible(False)
