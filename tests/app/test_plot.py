"""Plots: what is drawn is what was fitted."""

import dataclasses
import io
import itertools

import equinox as eqx
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

import zoomjax as zj
from zoomjax import scenes
from zoomjax.app.coverage import plot_coverage, plot_radius
from zoomjax.app.plot import plot_distortion, plot_model, plot_primitives, plot_residues, save_plot


@pytest.mark.parametrize("kind", ["svg", "png"])
@pytest.mark.parametrize("layout", ["constrained", None])
def test_plots_are_drawn_once_and_are_the_same_to_the_last_byte(kind, layout):
    def written(save):
        figure, drawn = Figure(figsize=(3, 2), layout=layout), []
        axes = figure.subplots()
        axes.plot([1e-3, 2e5], [3.0, 4.0], label="a line")
        axes.set(title="a title", ylabel="$k_1$  (px$^{-2}$)")
        axes.legend()
        patch = figure.patch.draw
        figure.patch.draw = lambda renderer: (drawn.append(renderer), patch(renderer))
        about = {"format": kind, "metadata": {"Date": None} if kind == "svg" else {}}
        file = io.BytesIO()
        with matplotlib.rc_context({"svg.hashsalt": "zoomjax"}):
            save(figure, file, **about)
        return file.getvalue(), len(drawn)

    once, number = written(save_plot)
    other, _ = written(lambda figure, *of, **about: figure.savefig(*of, dpi=150, **about))
    assert number == 1
    assert once == other


@pytest.mark.slow
def test_frames_of_one_focal_length_stand_side_by_side():
    lens = scenes.nikkor_18_200()
    lines = scenes.board_lines(lens, np.full(3, 24.0), spacing=150, noise=0.1)
    small = zj.compress(lines)
    fit, each = zj.fit_zoom(small, zoom=zj.PolynomialZoom(degree=0)), zj.fit_frames(small)
    own, common = np.asarray(each.frame_rms), np.asarray(fit.frame_rms)
    residues = plot_residues(lines, own, own, common)
    for axes in (plot_model(fit, each, lines).axes[0], residues.axes[0]):
        dots = next(line for line in axes.lines if "frame" in str(line.get_label()))
        assert np.asarray(dots.get_xdata()).tolist() == [1, 2, 3]
        names = axes.get_legend_handles_labels()[1] or [str(line.get_label()) for line in axes.lines]
        assert "common model" in names
        assert not axes.child_axes  # no focal lengths above
    assert residues.axes[0].get_xlabel() == "frame"


@pytest.mark.slow
def test_model_plot_shows_every_frame_and_the_polynomial():
    lens = scenes.nikkor_18_200()
    lines = scenes.board_lines(lens, scenes.focal_sweep(6), spacing=80)
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


@pytest.fixture(scope="module")
def folding():
    """A lens that folds at 0.86 of its half diagonal at 20 mm, and does nothing at 80 mm."""
    zoom = zj.PolynomialZoom(1, jnp.array([[0.15], [-0.6]]), jnp.array(20.0))
    return zj.ZoomLens(zoom, jnp.array([319.5, 239.5]), jnp.array([20.0, 80.0]), (640, 480))


def bent_lines(axes):
    """The grid as the lens shows it: the lines in the colour of models."""
    return [line for line in axes.lines if line.get_color() == "#c2410c"]


def test_distortion_plot_shows_the_grid_as_the_lens_does(fit):
    figure = plot_distortion(fit.lens, focal=35.0, exaggeration=1.0)
    grid = figure.axes[0]
    straight = [line for line in grid.lines if line.get_color() == "0.75"]
    assert len(straight) == 22  # 13 upright, 9 level
    for line, bent in zip(straight, bent_lines(grid), strict=True):
        seen = fit.lens(35.0).distort(np.asarray(line.get_xydata()))
        np.testing.assert_allclose(bent.get_xydata(), seen, atol=1e-9)


@pytest.mark.parametrize(("focal", "times"), [(20.56, 1), (127.36, 5)])
def test_a_small_distortion_is_exaggerated_and_the_plot_says_so(fit, focal, times):
    """Corners are off by 180 and 40 px of 4288 at the ends of the range."""
    grid = plot_distortion(fit.lens, focal=focal).axes[0]
    corner = bent_lines(grid)[0].get_xydata()[0]
    seen = np.asarray(fit.lens(focal).distort(np.zeros(2)))
    np.testing.assert_allclose(corner, times * seen, atol=1e-9)
    labels = [text.get_text() for text in grid.get_legend().get_texts()]
    assert ("distortion × 5" in labels[1]) == (times == 5)


def test_distortion_plot_shows_displacement_and_standard_deviation_of_a_fit(fit):
    figure = plot_distortion(fit, focal=[20.56, 127.36])
    assert len(figure.axes) == 6  # two grids, two fields, two colour bars
    field = figure.axes[1]
    filled, arrows, contours = field.collections
    corner = float(np.hypot(*fit.lens(20.56).undistort(np.zeros(2))))
    assert filled.levels[-2] < corner <= filled.levels[-1]
    points = np.asarray(arrows.get_offsets())
    moved = np.asarray(fit.lens(20.56).undistort(points)) - points
    np.testing.assert_allclose(np.stack([arrows.U, arrows.V], -1), moved, atol=1e-9)
    largest = float(zj.displacement_std(fit, np.zeros(2), focal=20.56))
    assert 0 < contours.levels[0] < contours.levels[-1] < largest
    figure.savefig(io.BytesIO(), format="svg")


def test_a_fold_leaves_a_gap_in_the_distortion_plot(folding):
    figure = plot_distortion(folding, focal=20.0)
    grid, field, _ = figure.axes
    bent = np.concatenate([line.get_xydata() for line in bent_lines(grid)])
    assert 0 < np.isnan(bent).any(axis=-1).sum() < len(bent)
    filled, arrows = field.collections
    beyond = np.hypot(*(arrows.get_offsets() - [319.5, 239.5]).T) > float(folding(20.0).monotone_radius)
    assert beyond.any()
    np.testing.assert_array_equal(arrows.Umask, beyond)
    assert "folded over" in field.get_title()
    assert not any(path.contains_point((0, 0)) for path in filled.get_paths())
    figure.savefig(io.BytesIO(), format="png")


@pytest.mark.parametrize("beyond", [slice(-1, None), slice(0, None)], ids=["one point", "all of a line"])
def test_points_beyond_a_fold_are_left_out_of_residuals(folding, beyond):
    rows = [np.stack([np.linspace(100, 500, 9), np.full(9, y)], axis=1) for y in (100.0, 240.0, 400.0)]
    far = rows[0].copy()
    far[beyond, 0] += 3000
    lines = zj.Lines.from_ragged([*rows, far], [0] * 4, [20.0], image_size=(4000, 4000))
    figure = plot_radius(lines, folding, np.ones(4))
    [dots] = figure.axes[0].lines
    assert dots.get_xdata().max() < float(folding(20.0).monotone_radius)
    assert np.isfinite(dots.get_ydata()).all()


def test_a_lens_without_distortion_can_be_drawn(folding):
    figure = plot_distortion(folding, focal=80.0)
    for line in bent_lines(figure.axes[0]):
        assert np.ptp(line.get_xydata(), axis=0).min() < 1e-9
    assert len(figure.axes[1].collections) == 1  # no arrows of rounding errors
    figure.savefig(io.BytesIO(), format="png")


@pytest.mark.parametrize(
    "focal", [[1140, 3071, 4946, 6947, 8840], [18.0, 35.0, 50.0, 200.0], [4.0, 20.0, 900.0], [20.0, 45.0]]
)
def test_labels_of_focal_lengths_do_not_overlap(focal):
    ends = np.array([[100.0, 100.0], [300.0, 200.0], [500.0, 300.0]])
    number = len(focal)
    lines = zj.Lines.from_ragged([ends] * number, range(number), focal, image_size=(640, 480))
    figure = plot_coverage(lines, np.ones(number))
    figure.draw_without_rendering()
    right = figure.axes[1]
    low, high = right.get_xlim()
    ticks = [*right.xaxis.get_major_ticks(), *right.xaxis.get_minor_ticks()]
    boxes = [
        tick.label1.get_window_extent()
        for tick in ticks
        if low <= tick.get_loc() <= high and tick.label1.get_text()
    ]
    boxes.sort(key=lambda box: box.x0)
    assert len(boxes) >= 2
    assert all(one.x1 + 2 < other.x0 for one, other in itertools.pairwise(boxes))


def test_plots_of_what_does_not_belong_together_are_refused():
    """A model of k1 alone was drawn as k2 beside frames that have both, a lens about the wrong middle."""
    lens = scenes.nikkor_18_200((320, 214))
    lines = scenes.board_lines(lens, scenes.focal_sweep(4), spacing=60, noise=0.1)
    small = zj.compress(lines)
    fit, each = zj.fit_zoom(small, terms=1), zj.fit_frames(small, terms=1)
    others = {
        "coefficients": zj.fit_frames(small, terms=2),
        "distortion model": dataclasses.replace(each, distortion_model=zj.models.Division()),
        "frames": eqx.tree_at(lambda of: of.coefficients, each, each.coefficients[:3]),
    }
    for what, other in others.items():
        with pytest.raises(ValueError, match=f"{what} is"):
            plot_model(fit, other, small)
    with pytest.raises(ValueError, match="images of size"):
        plot_primitives(lines, scenes.nikkor_18_200((640, 428)), [0])
