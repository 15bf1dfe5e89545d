"""Models chosen for many lenses: each as by itself."""

import multiprocessing
from concurrent.futures import ProcessPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.trust import select_many

CANDIDATES = [*(zj.PolynomialZoom(degree=degree) for degree in range(3)), zj.SmoothZoom()]


@pytest.fixture(scope="module")
def boards(truth):
    """Three of one lens, and one that does not change along the zoom."""
    made = [
        zj.scenes.board_lines(truth, zj.scenes.focal_sweep(number), spacing=200, noise=0.3, seed=number)
        for number in (4, 6, 7)
    ]
    still = zj.fit_zoom(zj.compress(made[0]), zoom=zj.PolynomialZoom(0)).lens
    return [*made, zj.scenes.board_lines(still, zj.scenes.focal_sweep(6), spacing=200, noise=0.3)]


@pytest.fixture(scope="module")
def sets(boards):
    return [zj.compress(lines) for lines in boards]


def assert_same(got, wanted):
    assert str(got) == str(wanted)
    assert (got.chosen.name, got.hold_out, got.folds, got.rule) == (
        wanted.chosen.name,
        wanted.hold_out,
        wanted.folds,
        wanted.rule,
    )
    assert jax.tree.structure(got.fit) == jax.tree.structure(wanted.fit)
    for a, b in zip(jax.tree.leaves(got.fit), jax.tree.leaves(wanted.fit), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-9)


LINES = {"hold_out": "line", "folds": 3, "seed": 1, "rule": "least"}


@pytest.mark.slow
@pytest.mark.parametrize("how", [{}, LINES], ids=["default", "lines, least"])
def test_each_selection_is_that_of_its_data_set_alone(sets, how):
    found = select_many(sets, CANDIDATES, **how)
    assert len({one.chosen.name for one in found}) > 1
    for one, lines in zip(found, sets, strict=True):
        assert_same(one, zj.select_model(lines, CANDIDATES, **how))


@pytest.mark.parametrize("centre", [(470.0, 330.0), pytest.param("fit", marks=pytest.mark.slow)])
def test_the_centre_is_that_of_each(boards, centre):
    some = [zj.lines.compress_any_centre(lines) for lines in boards[1:3]]
    for one, lines in zip(select_many(some, CANDIDATES, centre=centre), some, strict=True):
        assert_same(one, zj.select_model(lines, CANDIDATES, centre=centre))


def test_a_data_set_that_cannot_be_compared_is_named(sets):
    nothing = sets[1].weighted(np.zeros(len(sets[1].frame)))
    with pytest.raises(ValueError, match=r"^Data set 1: "):
        select_many([sets[0], nothing], CANDIDATES)


@pytest.fixture(scope="module")
def pool():
    """A process, as of any executor."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as made:
        yield made


@pytest.mark.parametrize(
    "how",
    [
        {"centre": jnp.array([2141.123456789, 1420.987654321])},
        pytest.param(LINES | {"centre": "fit"}, marks=pytest.mark.slow),
    ],
    ids=["given", "fitted"],
)
def test_an_executor_selects_the_same_of_the_candidates_here(boards, pool, how):
    any_centre = [zj.lines.compress_any_centre(lines) for lines in boards[2:]]
    models = [zj.models.Model(zoom, 2) for zoom in CANDIDATES[1:]]
    there = select_many(any_centre, models, executor=pool, **how)
    for got, here in zip(there, select_many(any_centre, models, **how), strict=True):
        assert str(got) == str(here)
        assert got.chosen is here.chosen
        assert got.best is here.best
        assert [of.candidate for of in got.compared] == models
        for a, b in zip(jax.tree.leaves(got.fit), jax.tree.leaves(here.fit), strict=True):
            assert type(a) is type(b)
            np.testing.assert_array_equal(a, b)


def test_candidates_by_default_serve_an_executor(sets, pool):
    (got,) = select_many(sets[1:2], executor=pool)
    assert_same(got, zj.select_model(sets[1]))


def test_a_data_set_is_named_by_an_executor(sets, pool):
    nothing = sets[1].weighted(np.zeros(len(sets[1].frame)))
    with pytest.raises(ValueError, match=r"^Data set 1: "):
        select_many([sets[0], nothing], CANDIDATES, executor=pool)


@pytest.mark.usefixtures("unchecked")
def test_wrong_candidates_and_executors_are_refused(sets, pool):
    with pytest.raises(TypeError, match="must be a list of zoom models"):
        select_many(sets, CANDIDATES[0], executor=pool)
    with pytest.raises(TypeError, match=r"Argument executor must be an executor of concurrent\.futures"):
        select_many(sets, CANDIDATES, executor=2)
