"""Plots: what is drawn is what was fitted."""

import numpy as np

import zoomjax as zj
from zoomjax import synthetic
from zoomjax.plot import plot_model


def test_model_plot_shows_every_frame_and_the_polynomial():
    lens = synthetic.nikkor_18_200()
    lines = synthetic.board_lines(lens, synthetic.focal_sweep(6), spacing=80)
    small = zj.compress(lines)
    figure = plot_model(zj.fit_zoom(small), zj.fit_frames(small), lines)
    above, below = figure.axes[:2], figure.axes[2:]
    assert len(below) == 2
    for i, axes in enumerate(above):
        curve = max(axes.lines, key=lambda line: len(line.get_xdata()))
        for inverse, value in zip(*curve.get_data(), strict=True):
            expected = lens.zoom(np.clip(1 / inverse, 20.56, 127.36))[i] / lens.scale ** (2 * i + 2)
            np.testing.assert_allclose(value, expected, rtol=1e-6, atol=1e-22)
        [dots] = [line for line in axes.lines if line.get_marker() == "o"]
        np.testing.assert_allclose(dots.get_xdata(), 1 / np.asarray(lines.focal))
    for axes in below:
        [dots] = axes.containers
        assert len(dots.lines[0].get_xdata()) == 6
    [scale] = above[0].child_axes
    assert [label.get_text() for label in scale.get_xticklabels()] == ["25", "30", "40", "50", "70", "100"]
