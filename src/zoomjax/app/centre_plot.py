"""A picture of the centre of distortion: that of each frame, and the one fitted to all."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from ..fit.result import ZoomFit
from ..trust.own_centres import OwnCentres
from .colours import FRAMES, MODEL

FEWEST = 3
"""Frames with a centre of their own that make a picture."""

_HELD = 2.4477  # standard deviations of the ellipse that holds 95 % of a plane
_STEPS = 21  # in 1/f, of the way of a centre that moves
_SEEN = 90.0  # per cent of the frames that lie within the picture


def plot_own_centres(fit: ZoomFit, own: OwnCentres, focal: np.ndarray) -> Figure:
    """Plot the centres of single frames, and that of the fit with its confidence ellipse.

    Bars are standard deviations. Of a centre that moves along the zoom the way is drawn. Frames whose lines
    do not determine a centre, or one far away, are left out.

    Args:
        fit: the fit; if its centre was fitted (`ZoomFit.joint`), the ellipse is drawn.
        own: what the frames say.
        focal: of each frame.
    """
    middle = (np.array(fit.lens.image_size) - 1) / 2
    away, std = (own.centre - middle)[own.known], own.std[own.known]
    inverse = 1 / focal[own.known]
    ends = np.asarray(fit.lens.focal_range)
    along = 1 / np.linspace(1 / ends[0], 1 / ends[1], _STEPS if fit.lens.shift is not None else 1)
    way = np.stack([np.asarray(fit.lens.centre_at(float(f))) for f in along]) - middle
    fitted = way[len(way) // 2]
    figure = Figure(figsize=(5.6, 4.6), layout="constrained")
    axes = figure.subplots()
    axes.errorbar(*away.T, xerr=std[:, 0], yerr=std[:, 1], fmt="none", ecolor="0.85", elinewidth=0.8)
    several = np.ptp(inverse) > 0
    colour = {"c": inverse, "cmap": "viridis"} if several else {"color": FRAMES}
    dots = axes.scatter(*away.T, s=16, zorder=2, label="of a frame", **colour)
    if several:
        figure.colorbar(dots, label=f"$1/f$  (1/{fit.lens.focal_unit})", shrink=0.85)
    axes.plot(0, 0, "+", color="0.35", markersize=12, zorder=3, label="middle of the image")
    if len(way) > 1:
        axes.plot(*way.T, color=MODEL, linewidth=1.5, zorder=4, label="of the lens, along the zoom")
    else:
        told = "of the lens" if fit.joint is None else "of the lens, fitted; 95 %"
        axes.plot(*fitted, "x", color=MODEL, markersize=8, zorder=4, label=told)
    if fit.joint is not None and len(way) == 1:
        values, vectors = np.linalg.eigh(fit.lens.scale**2 * np.asarray(fit.joint, float)[-2:, -2:])
        width, height = 2 * _HELD * np.sqrt(values)
        angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
        place = (float(fitted[0]), float(fitted[1]))
        axes.add_patch(Ellipse(place, width, height, angle=angle, fill=False, edgecolor=MODEL, zorder=4))
    reach = np.abs(np.concatenate([away - fitted, [fitted]])).max(axis=1)
    half = max(1.25 * float(np.percentile(reach, _SEEN)), 1.1 * float(np.abs(fitted).max())) + 1e-6
    half = max(half, 1.1 * float(np.abs(way - fitted).max()))
    axes.set(xlim=(fitted[0] - half, fitted[0] + half), ylim=(fitted[1] + half, fitted[1] - half))
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlabel("centre of distortion, $x$  (px from the middle of the image)")
    axes.set_ylabel("$y$  (px)")
    axes.legend(frameon=False, fontsize="small")
    axes.spines[["top", "right"]].set_visible(False)
    return figure
