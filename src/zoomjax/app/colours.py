"""Colours of plots. Those of drawn lines are in overlay.py, those of the page in templates/report.css."""

from matplotlib.colors import LinearSegmentedColormap

MODEL, FRAMES, PALE = "#c2410c", "#1e3a5f", "#7da3c8"
"""The model, what is measured of single frames, and what is in the background."""

DEPTHS = LinearSegmentedColormap.from_list("zoomjax", ["#ffffff", PALE])
SHADES = LinearSegmentedColormap.from_list("coverage", ["#ffffff", FRAMES])
