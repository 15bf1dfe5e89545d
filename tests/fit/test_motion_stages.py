"""The stages of `fit_motion`: which start goes on, and when a stage ends."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from zoomjax import PolynomialZoom, ZoomLens
from zoomjax.fit import RESULTS, _motion_stages
from zoomjax.fit._columns import Rows
from zoomjax.fit._motion_problem import Asked, Given, problem_of
from zoomjax.fit._motion_stages import STAGES, _size_of_change, _size_of_views, begun, in_stages
from zoomjax.fit._motion_start import starts_of, views_by_frame
from zoomjax.models import RadialPolynomial
from zoomjax.scenes import motion_tracks, pan_and_zoom

SIZE, FRAMES = (1280, 720), 24


@pytest.fixture(scope="module")
def problem():
    zoom = PolynomialZoom(2, jnp.array([[0.02, 0.0], [-0.05, 0.01], [-0.15, 0.05]]), jnp.array(800.0))
    lens = ZoomLens(zoom, jnp.array([645.0, 356.0]), jnp.array([800.0, 2400.0]), SIZE, "px")
    path = pan_and_zoom(lens, FRAMES, pan=25, tilt=6)
    tracks = motion_tracks(lens, *path, views=50, life=12, noise=0.3, seed=3).tracks
    return problem_of(Given(tracks, None, None, None, None), asked())


def asked():
    return Asked(PolynomialZoom(), RadialPolynomial(), 2, PolynomialZoom(degree=1), None)


@pytest.fixture(scope="module")
def starts(problem):
    frames, tracks = len(problem.data.log_focal), problem.data.structure.tracks
    by_frame = views_by_frame(problem.piece, problem.moment, frames)
    part = jnp.zeros(frames, int), jnp.zeros(tracks, int)
    return starts_of(problem.data.points, tracks, float(SIZE[0]), by_frame, part)


def chosen(problem, starts):
    paths, spreads = starts
    to = asked()
    return begun(problem.data, paths, spreads, to.zoom, to.shift, to.distortion_model, to.terms)


@pytest.fixture
def steps(monkeypatch):
    """Steps of the solver, call by call."""
    taken = []
    solved = _motion_stages._solved

    def counted(*args):
        found = solved(*args)
        taken.append(int(found[3]))
        return found

    monkeypatch.setattr(_motion_stages, "_solved", counted)
    return taken


@pytest.mark.slow
def test_a_start_without_hope_is_given_up_and_the_same_one_goes_on(problem, starts, steps, monkeypatch):
    model, noise = chosen(problem, starts)
    quick = sum(steps)
    steps.clear()
    monkeypatch.setattr(_motion_stages, "_HOPELESS", np.inf)
    whole, noise_of_whole = chosen(problem, starts)
    assert quick < sum(steps)
    np.testing.assert_array_equal(model.path.log_focal, whole.path.log_focal)
    np.testing.assert_array_equal(noise.points, noise_of_whole.points)


def test_the_best_start_goes_on_wherever_it_is_among_them(problem, starts):
    model, noise = chosen(problem, starts)
    worst_first = jax.tree.map(lambda leaf: leaf[::-1], starts)
    turned, noise_of_turned = chosen(problem, worst_first)
    np.testing.assert_allclose(turned.path.log_focal, model.path.log_focal, atol=0.03)
    np.testing.assert_allclose(noise_of_turned.points, noise.points, rtol=0.02)


@pytest.mark.slow
def test_a_fit_that_still_moves_after_all_its_turns_has_not_settled(problem, starts, monkeypatch):
    model, noise = chosen(problem, starts)
    solved = _motion_stages._solved

    def restless(*args):
        *found, _, size = solved(*args)
        return *found, jnp.asarray(50.0), size

    monkeypatch.setattr(_motion_stages, "_solved", restless)
    monkeypatch.setattr(_motion_stages, "_MOST_REPEATS", 2)
    parts, *_ = in_stages(problem.data, model, noise, problem.scene, problem.linked)
    assert parts["fit"].result == RESULTS.nonlinear_max_steps_reached


def test_what_moves_all_views_counts_in_full_and_a_single_ray_hardly(problem):
    data = problem.data
    views = int(data.there.sum())
    change = jnp.broadcast_to(jnp.array([0.03, -0.04]), data.points.shape)
    np.testing.assert_allclose(_size_of_views(data, change), 0.05 * np.sqrt(views))
    alone = jnp.where((data.structure.track == 2)[:, None], change, 0)
    count = int(np.sum(np.asarray(data.structure.track)[:views] == 2))
    assert count > 5
    assert _size_of_views(data, alone) < 0.01 * 0.05 * np.sqrt(count)


def test_changes_in_a_long_clip_are_those_of_its_parts_in_the_mean(problem):
    data = problem.data
    longer = eqx.tree_at(lambda data: data.log_focal, data, jnp.zeros(600))
    others = jnp.zeros((12, 5)), jnp.full((FRAMES, 4), 0.1), jnp.full(3, 0.1)
    rows = Rows(jnp.broadcast_to(jnp.array([0.03, -0.04]), data.points.shape), *others)
    size, in_parts = _size_of_change(data, rows), _size_of_change(longer, rows)
    np.testing.assert_allclose(in_parts, size / 2)


def test_a_first_frame_that_does_not_fit_the_others_finds_its_way(problem, starts, monkeypatch):
    """All others would have to move back: too dear in a long clip, or in a short one with less freedom."""
    model, noise = chosen(problem, starts)
    expected, *_ = in_stages(problem.data, model, noise, problem.scene, problem.linked)
    path = model.path._replace(log_focal=model.path.log_focal.at[0].add(-0.12))
    model = eqx.tree_at(lambda m: m.path, model, path)
    monkeypatch.setattr(_motion_stages, "STAGES", (*STAGES[:2], STAGES[2]._replace(own=0.005)))
    parts, *_ = in_stages(problem.data, model, noise, problem.scene, problem.linked)
    std = np.asarray(expected["focal_std"])[:FRAMES]
    off = np.abs(np.asarray(parts["focal"]) - np.asarray(expected["focal"]))[:FRAMES]
    np.testing.assert_array_less(off, 0.3 * std)
    assert parts["fit"].result == RESULTS.successful
