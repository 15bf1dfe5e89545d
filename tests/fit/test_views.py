"""The scale of residuals of which many are mistakes."""

import jax.numpy as jnp
import numpy as np
import pytest

from zoomjax.fit._views import MEDIAN_OF_SIZE, core_median


def sizes(wrong, seed=0, number=4000):
    """Lengths of vectors of two normal numbers, and as many others as make the share `wrong`."""
    rng = np.random.default_rng(seed)
    good = np.linalg.norm(rng.standard_normal((number, 2)), axis=1)
    return rng.permutation(np.append(good, rng.uniform(0, 400, int(number * wrong / (1 - wrong)))))


@pytest.mark.parametrize("wrong", [0.0, 0.3, 0.6, 0.7])
def test_mistakes_do_not_widen_the_scale(wrong):
    size = sizes(wrong)
    assert core_median(jnp.asarray(size), jnp.ones(len(size), bool)) == pytest.approx(
        MEDIAN_OF_SIZE, rel=0.05
    )


def test_what_is_not_there_does_not_count():
    size = sizes(0.0)
    more = np.append(size, np.zeros(3000))
    there = np.arange(len(more)) < len(size)
    assert core_median(jnp.asarray(more), jnp.asarray(there)) == pytest.approx(np.median(size))


@pytest.mark.parametrize("size", [[0.0, 0.0, 0.0], [2.0], [2.0, 2.0]])
def test_exact_and_few_residuals_have_their_median(size):
    size = jnp.array(size)
    assert core_median(size, jnp.ones(len(size), bool)) == size[0]


def test_without_residuals_there_is_no_scale():
    assert jnp.isnan(core_median(jnp.ones(3), jnp.zeros(3, bool)))


@pytest.mark.parametrize("number", [1, 2, 3, 4, 7, 8, 9, 1001, 1002])
def test_equal_weights_give_the_same_median(number):
    size = jnp.asarray(sizes(0.3)[:number])
    there = jnp.asarray(np.random.default_rng(1).uniform(size=number) < 0.9).at[0].set(True)
    for weight in (1.0, 0.1, 1 / 3):
        assert core_median(size, there, jnp.full(number, weight)) == core_median(size, there)


def test_whole_weights_are_as_copies():
    size, rng = sizes(0.3, number=700), np.random.default_rng(2)
    weight = rng.integers(1, 4, len(size))
    copies = np.repeat(size, weight)
    found = core_median(jnp.asarray(size), jnp.ones(len(size), bool), jnp.asarray(weight, float))
    assert found == core_median(jnp.asarray(copies), jnp.ones(len(copies), bool))


def test_what_hardly_weighs_does_not_move_the_median():
    size = sizes(0.0)
    more = jnp.asarray(np.append(size, np.zeros(9000)))
    weight = jnp.where(jnp.arange(len(more)) < len(size), 1.0, 1e-9)
    found = core_median(more, jnp.ones(len(more), bool), weight)
    assert found == pytest.approx(np.median(size), rel=1e-3)
