"""Plots, with matplotlib (the extra ``zoomjax[app]``). Figures are returned, not shown or saved."""

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from .fit import FrameFits, ZoomFit
from .lines import AbstractLines

_MODEL, _FRAMES = "#c2410c", "#1e3a5f"


def plot_model(zoom: ZoomFit, each: FrameFits, lines: AbstractLines) -> Figure:
    """The distortion coefficients against 1/f: each frame by itself, and the zoom model (Figure 8).

    Args:
        zoom: the fitted zoom model.
        each: the frames fitted by themselves, with bars of one standard deviation.
        lines: what both were fitted to; only its focal lengths are used.
    """
    lens = zoom.lens
    terms = each.coefficients.shape[1]
    to_pixel = lens.scale ** (-2.0 * np.arange(1, terms + 1))
    inverse = 1 / np.asarray(lines.focal)
    sigma = np.sqrt(np.diagonal(np.asarray(each.covariance), axis1=1, axis2=2))
    grid = np.linspace(inverse.min(), inverse.max(), 200)
    curves = np.asarray(jax.vmap(lens.zoom)(jnp.asarray(1 / grid, jnp.asarray(lines.focal).dtype)))

    figure = Figure(figsize=(4.6 * terms, 3.8), layout="constrained")
    for i, axes in enumerate(np.atleast_1d(figure.subplots(1, terms))):
        known = np.isfinite(sigma[:, i])
        axes.axhline(0, color="0.85", linewidth=0.8, zorder=0)
        axes.errorbar(
            inverse[known],
            np.asarray(each.coefficients)[known, i] * to_pixel[i],
            sigma[known, i] * to_pixel[i],
            fmt="o",
            markersize=3.5,
            linewidth=0.8,
            color=_FRAMES,
            label="each frame by itself",
        )
        axes.plot(grid, curves[:, i] * to_pixel[i], color=_MODEL, linewidth=1.8, label="zoom polynomial")
        axes.set_xlabel(f"$1/f$  (1/{lens.focal_unit})")
        axes.set_ylabel(f"$k_{i + 1}$  (px$^{{-{2 * i + 2}}}$)")
        axes.ticklabel_format(axis="y", style="sci", scilimits=(0, 0))
        axes.spines[["top", "right"]].set_visible(False)
        axes.margins(x=0.03)
    figure.axes[0].legend(frameon=False)
    return figure
