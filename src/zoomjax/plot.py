"""Plots, with matplotlib (the extra ``zoomjax[app]``). Figures are returned, not shown or saved."""

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .fit import FrameFits, ZoomFit
from .lines import AbstractLines

_MODEL, _FRAMES = "#c2410c", "#1e3a5f"


def plot_model(zoom: ZoomFit, each: FrameFits, lines: AbstractLines) -> Figure:
    """The distortion coefficients against 1/f: each frame by itself, and the zoom model (Figure 8).

    Below each coefficient stands by how much the frames differ from the model, with bars of one standard
    deviation of the frame's own fit; frames whose lines do not determine it have no dot.

    Args:
        zoom: the fitted zoom model.
        each: the frames fitted by themselves.
        lines: what both were fitted to; only its focal lengths are used.
    """
    lens = zoom.lens
    terms = each.coefficients.shape[1]
    to_pixel = lens.scale ** (-2.0 * np.arange(1, terms + 1))
    focal = np.asarray(lines.focal)
    grid = np.linspace(1 / focal.max(), 1 / focal.min(), 200)
    frames = np.asarray(each.coefficients) * to_pixel
    sigma = np.sqrt(np.diagonal(np.asarray(each.covariance), axis1=1, axis2=2)) * to_pixel

    def model(focal: np.ndarray) -> np.ndarray:
        return (
            np.asarray(jax.vmap(lens.zoom)(jnp.asarray(focal, jnp.asarray(lines.focal).dtype))) * to_pixel
        )

    curve, expected = model(1 / grid), model(focal)
    figure = Figure(figsize=(4.8 * terms, 5.2), layout="constrained")
    figure.suptitle(
        f"RMS {float(zoom.rms):.3f} px by the zoom model, {float(each.rms):.3f} px frame by frame",
        fontsize=10,
    )
    axes = figure.subplots(2, terms, sharex=True, squeeze=False, height_ratios=[2.2, 1])
    for i, (above, below) in enumerate(axes.T):
        known = np.isfinite(sigma[:, i])
        x, unit = 1 / focal[known], f"px$^{{-{2 * i + 2}}}$"
        above.plot(x, frames[known, i], "o", markersize=3.5, color=_FRAMES, label="each frame by itself")
        above.plot(grid, curve[:, i], color=_MODEL, linewidth=1.8, label="zoom model")
        _label(above, f"$k_{i + 1}$", unit, curve[:, i])
        difference = frames[known, i] - expected[known, i]
        below.errorbar(
            x, difference, sigma[known, i], fmt="o", markersize=2.5, linewidth=0.9, color=_FRAMES
        )
        _label(below, "frame − model", unit, np.append(difference, sigma[known, i]))
        below.axhline(0, color=_MODEL, linewidth=1.2, zorder=0)
        below.set_xlabel(f"$1/f$  (1/{lens.focal_unit})")
        below.locator_params(axis="x", nbins=6)  # labels of focal lengths in px are long
        _show_focal_lengths(above, focal, lens.focal_unit)
    figure.axes[0].legend(frameon=False)
    return figure


def _label(axes: Axes, quantity: str, unit: str, values: np.ndarray) -> None:
    """Name the y axis, with the power of ten in its unit rather than in a corner."""
    largest = np.max(np.abs(values), initial=0)
    power = int(np.floor(np.log10(largest))) if largest > 0 else 0
    axes.set_ylabel(f"{quantity}\n($10^{{{power}}}$ {unit})")
    axes.yaxis.set_major_formatter(lambda y, _: f"{y / 10.0**power:.4g}")
    axes.axhline(0, color="0.85", linewidth=0.8, zorder=0)
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(x=0.03)


def _show_focal_lengths(axes: Axes, focal: np.ndarray, unit: str) -> None:
    """A second scale above, with round focal lengths."""
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
