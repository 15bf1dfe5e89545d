"""Vanishing points: they find the lens that pieces of parallel lines were bent by, and no others."""

import dataclasses

import equinox as eqx
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes
from zoomjax.trust import assess, vanishing_points

LENS = scenes.nikkor_18_200()
FOCAL = scenes.focal_sweep(3)


def scaled(lens, factor):
    """A lens of so much of the displacement; exactly so for the radial polynomial."""
    return eqx.tree_at(lambda lens: lens.zoom.parameters, lens, factor * np.asarray(lens.zoom.parameters))


@pytest.fixture(scope="module")
def whole():
    return scenes.board_lines(LENS, FOCAL, spacing=60, noise=0.5)


@pytest.fixture(scope="module")
def pieces(whole):
    """A quarter of each line, anywhere."""
    rng, short = np.random.default_rng(0), []
    for line in whole.to_ragged():
        start = rng.integers(0, len(line) - len(line) // 4)
        short.append(line[start : start + len(line) // 4])
    return zj.Lines.from_ragged(short, whole.frame, FOCAL, image_size=whole.image_size)


@pytest.mark.parametrize("factor", [0.8, 0.9, 1.0, 1.2])
def test_the_factor_leads_back_to_the_true_lens(pieces, factor):
    found = vanishing_points(pieces, scaled(LENS, factor))
    assert found.photos == 3
    assert found.std < 0.02
    assert abs(found.factor * factor - 1) < 0.02
    if factor == 1.0:
        assert abs(found.factor - 1) < 4 * found.std
        assert found.miss < 0.3
    assert found.lines > 0.9 * len(pieces.frame)


def test_the_deviation_is_that_of_repetitions(whole):
    rng, factors, stds = np.random.default_rng(1), [], []
    for _ in range(12):
        short = []
        for line in whole.to_ragged():
            start = rng.integers(0, len(line) - len(line) // 4)
            short.append(
                line[start : start + len(line) // 4] + 0.5 * rng.standard_normal((len(line) // 4, 2))
            )
        found = vanishing_points(
            zj.Lines.from_ragged(short, whole.frame, FOCAL, image_size=whole.image_size), LENS
        )
        factors.append(found.factor)
        stds.append(found.std)
    assert abs(np.mean(factors) - 1) < 3 * np.mean(stds)
    assert 0.4 < np.mean(stds) / np.std(factors) < 2.5


def test_lines_that_span_the_image_tell_nothing(whole):
    for factor in (0.5, 1.0):
        found = vanishing_points(whole, scaled(LENS, factor))
        assert found.lines > 100
        assert found.std > 0.1


def test_lines_of_any_direction_have_no_vanishing_points():
    rng, t = np.random.default_rng(2), np.linspace(0, 1, 20)[:, None]
    for _ in range(10):
        ends = rng.uniform(0, (4287, 2847), (60, 2, 2))
        points = list(ends[:, :1] + t * (ends[:, 1:] - ends[:, :1]))
        lines = zj.Lines.from_ragged(points, np.zeros(60, int), [50.0], image_size=(4288, 2848))
        found = vanishing_points(lines, LENS)
        assert (found.lines, found.points, found.photos) == (0, 0, 0)
        assert np.isnan(found.factor)


def test_many_edges_of_one_thing_are_no_vanishing_point():
    offset = np.array([0.0, 9.0])
    row = np.stack([np.linspace(100, 4000, 50), np.linspace(200, 1900, 50)], axis=-1)
    points = [row + place * offset for place in range(8)]
    lines = zj.Lines.from_ragged(points, np.zeros(8, int), [50.0], image_size=(4288, 2848))
    assert vanishing_points(lines, scaled(LENS, 0.0)).points == 0


def test_lines_without_weight_do_not_count(pieces):
    weight = np.asarray(pieces.frame) == 0
    found = vanishing_points(pieces.weighted(weight.astype(float)), LENS)
    assert found.photos == 1
    assert found.lines <= weight.sum()


def test_a_lens_for_other_images_is_refused(pieces):
    with pytest.raises(ValueError, match="in px"):
        vanishing_points(pieces, dataclasses.replace(LENS, focal_unit="px"))


@pytest.mark.parametrize("factor", [0.6, 1.0])
def test_the_verdict_minds_what_straightness_does_not_show(pieces, factor):
    fit = zj.fit_zoom(zj.compress(pieces))
    fit = eqx.tree_at(lambda fit: fit.lens, fit, scaled(fit.lens, factor))
    found = assess(pieces, fit)
    about = [finding.about for finding in found.findings]
    assert ("vanishing points" in about) == (factor == 0.6)
    summary = found.summary()["evidence"]["vanishing"]
    assert summary["factor"] == found.evidence.vanishing.factor
