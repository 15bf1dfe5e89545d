"""Plots of where lines lie, in the image and over the zoom, and of how residuals depend on the radius."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from ..lines.lines import Lines
from ..models.lens import ZoomLens
from .colours import FRAMES, MODEL, SHADES
from .outward import distortions_at

_CELLS, _RINGS = 16, 12
_LEAST_STRETCH = 0.01  # beyond a fold, where it may vanish, residuals tell nothing
_MOST_POINTS = 50_000  # are enough to average over in the rings


def plot_coverage(lines: Lines, weight: np.ndarray) -> Figure:
    """Plot how many lines pass each part of the image, and how many there are at each focal length, if any.

    Args:
        lines: the lines.
        weight: of each line; those of weight 0 are left out.
    """
    width, height = lines.image_size
    zoomed = len(lines.focal) > 1
    figure = Figure(figsize=(9.6 if zoomed else 4.8, 3.6), layout="constrained")
    left, *others = figure.subplots(1, 1 + zoomed, squeeze=False)[0]
    counted = np.asarray(lines.mask) & (weight > 0)[:, None]
    line, point = np.nonzero(counted)
    cell = max(width, height) / _CELLS
    columns, rows = (int(np.ceil(side / cell)) for side in (width, height))
    x, y = np.clip(np.asarray(lines.points)[line, point] // cell, 0, [columns - 1, rows - 1]).T.astype(int)
    passed = np.unique((line * rows + y) * columns + x) % (rows * columns)
    number = np.bincount(passed, minlength=rows * columns).reshape(rows, columns)
    extent = (0, columns * cell, rows * cell, 0)
    shown = left.imshow(number, cmap=SHADES, extent=extent, vmin=0, interpolation="nearest")
    left.set(xlim=(0, width), ylim=(height, 0), xlabel="$x$  (px)", ylabel="$y$  (px)")
    left.set_title("lines through each part of the image", fontsize=10)
    figure.colorbar(shown, ax=left, shrink=0.8)
    for right in others:
        _by_focal(right, lines, weight)
    return figure


def _by_focal(right, lines, weight):
    """How many lines there are at each focal length."""
    focal = np.asarray(lines.focal)
    per_frame = np.bincount(np.asarray(lines.frame)[weight > 0], minlength=len(focal))
    right.vlines(focal, 0, per_frame, color=FRAMES, linewidth=1)
    right.plot(focal, per_frame, "o", color=FRAMES, markersize=4)
    right.set(ylim=(0, None), xlabel=f"$f$  ({lines.focal_unit})", ylabel="lines")
    if focal.max() > 2 * focal.min():
        right.set_xscale("log")
        # As many as there is room for.
        steps = (1, 1.5, 2, 3, 5, 7) if focal.max() < 10 * focal.min() else (1, 2, 5)
        right.xaxis.set_major_locator(LogLocator(subs=steps))
        right.xaxis.set_minor_locator(NullLocator())
        right.xaxis.set_major_formatter(lambda f, _: f"{f:g}")
        right.tick_params(axis="x", labelsize=8)
    right.set_title("lines in each photo", fontsize=10)
    right.spines[["top", "right"]].set_visible(False)


def plot_radius(lines: Lines, lens: ZoomLens, weight: np.ndarray) -> Figure:
    """Plot the RMS residual of points against their distance from the centre of distortion.

    Points beyond the fold of the lens, which have no corrected position, are left out.

    Args:
        lines: the lines.
        lens: the lens that corrects them.
        weight: of each line; those of weight 0 are left out.
    """
    kept = np.flatnonzero(weight > 0)
    step = max(1, int(np.asarray(lines.mask)[kept].sum() / _MOST_POINTS))
    radius, residual = _residuals(lines, lens, kept[::step])
    edges = np.linspace(0, radius.max(initial=0) + 1e-9, _RINGS + 1)
    ring = np.digitize(radius, edges) - 1
    number = np.bincount(ring, minlength=_RINGS)[:_RINGS]
    squares = np.bincount(ring, residual**2, minlength=_RINGS)[:_RINGS]
    known = number > 0
    figure = Figure(figsize=(6.4, 3.4), layout="constrained")
    axes = figure.subplots()
    middle = (edges[1:] + edges[:-1]) / 2
    rms = np.sqrt(squares[known] / number[known])
    axes.plot(middle[known], rms, "o", color=MODEL, markersize=5)
    axes.set(ylim=(0, 1.15 * rms.max(initial=0) or 1), xlim=(0, edges[-1]))
    axes.set_xlabel("distance from the centre of distortion  (px)")
    axes.set_ylabel("RMS residual  (px)")
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def _residuals(lines: Lines, lens: ZoomLens, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances of points from the centre, and, in the distorted image, from their lines, px."""
    points, mask = np.asarray(lines.points)[chosen], np.asarray(lines.mask)[chosen]
    frame, focal = np.asarray(lines.frame)[chosen], np.asarray(lines.focal)
    corrected, away = np.zeros(points.shape), np.zeros(points.shape)
    stretch = np.zeros((*points.shape, 2))  # by which the correction stretches, along x and along y
    shown = np.unique(frame)
    for index, distortion in zip(shown, distortions_at(lens, focal[shown].tolist()), strict=True):
        own = (frame == index)[:, None] & mask
        corrected[own] = distortion.undistort(points[own])
        for axis, step in enumerate(np.eye(2) / 2):
            ends = (np.asarray(distortion.undistort(points[own] + way)) for way in (step, -step))
            stretch[own, axis] = np.nan_to_num(next(ends) - next(ends))
        away[own] = points[own] - np.asarray(distortion.centre)
    mask = mask & np.isfinite(corrected).all(axis=-1)
    corrected = np.where(mask[..., None], corrected, 0)
    mean = corrected.sum(axis=1) / np.maximum(mask.sum(axis=1), 1)[:, None]
    rows = np.where(mask[..., None], corrected - mean[:, None], 0)
    normal = np.linalg.eigh(np.einsum("lpc,lpd->lcd", rows, rows))[1][..., 0]
    across = np.linalg.norm(np.einsum("lpac,lc->lpa", stretch, normal), axis=-1)
    residual = np.einsum("lpc,lc->lp", rows, normal) / np.maximum(across, _LEAST_STRETCH)
    return np.hypot(away[..., 0], away[..., 1])[mask], residual[mask]
