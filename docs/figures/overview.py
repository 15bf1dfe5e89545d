"""Draw overview.png, the picture of the README: ``python docs/figures/overview.py``.

Synthetic: the paper's board through its published lens, edge noise 0.5 px. The displacement by the lens is
drawn five times too large, so that it can be seen.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

import zoomjax as zj
from zoomjax import scenes

INK, MODEL = "#1e3a5f", "#c2410c"
EXAGGERATION = 5

jax.config.update("jax_enable_x64", True)
truth = scenes.nikkor_18_200()
lines = scenes.board_lines(truth, scenes.focal_sweep(25), spacing=40, noise=0.5)
small = zj.compress(lines)
fit, each = zj.fit_zoom(small), zj.fit_frames(small)
corner_radius = float(np.hypot(*truth.centre)) / truth.scale
powers = corner_radius ** np.array([3, 5]) * truth.scale

figure = Figure(figsize=(12, 3.6), layout="constrained")
grid = figure.add_gridspec(1, 4, width_ratios=[1, 1, 1, 1.15])
frames = [
    (0, f"f = 20.6 mm, distortion × {EXAGGERATION}"),
    (24, f"f = 127 mm, distortion × {EXAGGERATION}"),
    (0, "f = 20.6 mm, corrected"),
]
for column, (frame, title) in enumerate(frames):
    axes = figure.add_subplot(grid[column])
    distortion = fit.lens(float(lines.focal[frame]))
    for line, of in zip(lines.to_ragged(), np.asarray(lines.frame), strict=True):
        if of == frame:
            corrected = np.asarray(distortion.undistort(line))
            shown = corrected if column == 2 else corrected + EXAGGERATION * (line - corrected)
            axes.plot(*shown.T, color=INK, linewidth=0.6)
    axes.set_title(title, fontsize=10, loc="left")
    axes.set(aspect="equal", xlim=(-250, 4538), ylim=(3098, -250))
    axes.set_axis_off()
    axes.add_patch(Rectangle((0, 0), 4287, 2847, fill=False, color="0.7", linewidth=0.8))

axes = figure.add_subplot(grid[3])
inverse = 1 / np.asarray(lines.focal)
smooth = np.linspace(inverse.min(), inverse.max(), 200)
curve = np.asarray(jax.vmap(fit.lens.zoom)(jnp.asarray(1 / smooth))) @ powers
axes.axhline(0, color="0.85", linewidth=0.8)
axes.plot(
    inverse, np.asarray(each.coefficients) @ powers, "o", color=INK, markersize=4, label="frame by frame"
)
axes.plot(smooth, curve, color=MODEL, linewidth=1.8, label="one model, six numbers")
axes.set_title("displacement of the image's corner (px)", fontsize=10, loc="left")
axes.set_xlabel("1/f  (1/mm)")
axes.spines[["top", "right"]].set_visible(False)
axes.legend(frameon=False, fontsize=9)
figure.savefig(Path(__file__).with_suffix(".png"), dpi=130)
