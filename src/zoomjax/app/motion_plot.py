"""Plots of a calibration from motion: where the camera looked, how it zoomed, and the lens."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..fit.motion_fit import MotionFit
from ..trust.bands import displacement_std
from .colours import FRAMES, MODEL, PALE
from .outward import outward

_BAND = 1.96  # standard deviations of a 95 % band


def plot_motion(fit: MotionFit) -> Figure:
    """Focal length and direction of each frame, and what the lens does to the corner at each zoom."""
    figure = Figure(figsize=(11, 7), layout="constrained")
    axes = figure.subplots(2, 2)
    _focal(axes[0, 0], fit)
    _direction(axes[0, 1], fit)
    _corner(axes[1, 0], fit)
    _residuals(axes[1, 1], fit)
    return figure


def _focal(axes: Axes, fit: MotionFit) -> None:
    focal, std = np.asarray(fit.focal), np.asarray(fit.focal_std)
    frame, cuts = np.arange(len(focal)), np.flatnonzero(np.diff(np.asarray(fit.shot))) + 1
    for part in np.split(frame, cuts):  # so that no line leads from shot to shot
        of = focal[part], _BAND * std[part]
        axes.fill_between(part, of[0] - of[1], of[0] + of[1], color=MODEL, alpha=0.25, lw=0)
        axes.plot(part, of[0], color=MODEL, marker="." if len(part) == 1 else "")
    axes.set(xlabel="frame", ylabel="focal length, px", title="How the camera zoomed")
    axes.margins(x=0)


def _direction(axes: Axes, fit: MotionFit) -> None:
    angles, shot = np.asarray(fit.pan_and_tilt), np.asarray(fit.shot)
    seen = np.isfinite(np.asarray(fit.focal))
    for number in np.unique(shot[seen & (shot >= 0)]).tolist():
        of_shot = angles[seen & (shot == number)]
        axes.plot(of_shot[:, 0], of_shot[:, 1], color=FRAMES, lw=1)
        axes.plot(*of_shot[0], "o", color=MODEL, ms=5)
    axes.set(
        xlabel="to the right, degrees",
        ylabel="up, degrees",
        title="Direction of the camera (dot: the start)",
    )
    axes.set_aspect("equal", adjustable="datalim")


def _corner(axes: Axes, fit: MotionFit) -> None:
    lens = fit.lens
    low, high = (float(f) for f in lens.focal_range)
    focal = 1 / np.linspace(1 / low, 1 / high, 60)
    corner = np.zeros(2)
    moved = outward(lens, corner, focal)
    std = np.asarray(displacement_std(fit.fit, corner, focal=focal))
    axes.fill_between(focal, moved - _BAND * std, moved + _BAND * std, color=MODEL, alpha=0.25, lw=0)
    axes.plot(focal, moved, color=MODEL)
    axes.axhline(0, color="0.7", lw=0.8, zorder=0)
    axes.set(
        xlabel="focal length, px",
        ylabel="outwards, px",
        title="How far the correction moves a corner",
    )
    axes.margins(x=0)


def _residuals(axes: Axes, fit: MotionFit) -> None:
    residual = np.asarray(fit.residual)
    residual = np.sort(residual[np.isfinite(residual)])  # others pad
    share = np.arange(1, len(residual) + 1) / len(residual)
    axes.plot(residual, share, color=FRAMES)
    noise = float(fit.noise)
    sizes = np.geomspace(noise / 10, max(noise * 10, residual[-1]), 200)
    axes.plot(sizes, 1 - np.exp(-((sizes / noise) ** 2) / 2), color=PALE, ls="--", zorder=0)
    axes.set_xscale("log")
    axes.set(
        xlabel="distance of a tracked point from the model, px",
        ylabel="share of points",
        title=f"Residuals (dashed: noise of {noise:.2f} px alone)",
        ylim=(0, 1),
    )
