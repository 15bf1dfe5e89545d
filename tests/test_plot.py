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
    assert len(figure.axes) == 2
    for i, axes in enumerate(figure.axes):
        curve = max(axes.lines, key=lambda line: len(line.get_xdata()))
        for inverse, value in zip(*curve.get_data(), strict=True):
            expected = lens.zoom(np.clip(1 / inverse, 20.56, 127.36))[i] / lens.scale ** (2 * i + 2)
            np.testing.assert_allclose(value, expected, rtol=1e-6, atol=1e-22)
        [dots] = axes.containers
        assert len(dots.lines[0].get_xdata()) == 6
