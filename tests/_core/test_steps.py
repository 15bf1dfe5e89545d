"""Points as whole steps: nothing lost, and much less space."""

import io

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from hypothesis.extra.numpy import arrays

from zoomjax._core.steps import STEP, packed, unpacked


@given(
    arrays(
        np.int32, st.tuples(st.integers(0, 40), st.just(2)), elements=st.integers(-(2**30) + 1, 2**30 - 1)
    )
)
def test_whole_steps_come_back_as_they_were(steps):
    points = steps * STEP
    back = unpacked(**packed(points))
    assert back.dtype == points.dtype
    np.testing.assert_array_equal(back, points)


@given(
    arrays(
        np.float32, (7, 2), elements=st.integers(-4_000_000, 4_000_000).map(lambda n: np.float32(n * STEP))
    )
)
def test_so_do_those_of_float32(points):
    back = unpacked(**packed(points))
    assert back.dtype == np.float32
    np.testing.assert_array_equal(back, points)


@pytest.mark.parametrize("bad", [0.1, STEP / 2, np.nan, np.inf, 2.0**21, -(2.0**20)])
def test_other_points_are_left_as_they_are(bad):
    assert packed(np.array([[1.0, 2.0], [bad, 3.0]])) is None


def test_lines_take_a_fifth_of_the_space():
    """Points every 4 px, with a noise of 0.1 px in both coordinates; edges, smoother, take a tenth."""
    rng, t = np.random.default_rng(0), np.arange(0, 3000, 4.0)[:, None]
    lines = [
        rng.uniform(0, 3000, 2) + t * [np.cos(a), np.sin(a)] + 0.1 * rng.standard_normal((len(t), 2))
        for a in rng.uniform(0, np.pi, 40)
    ]
    points = np.rint(np.concatenate(lines) / STEP) * STEP
    np.savez_compressed(file := io.BytesIO(), **packed(points))
    assert len(file.getvalue()) < 3 * len(points)


@pytest.mark.parametrize(
    ("steps", "step", "message"),
    [
        (np.zeros((2, 4), np.uint8), np.array(STEP), "no table"),
        (np.zeros((2, 3, 5), np.uint8), np.array(STEP), "no table"),
        (np.zeros((2, 4, 5), np.int32), np.array(STEP), "no table"),
        (np.zeros((2, 4, 5), np.uint8), np.array(0.5), "length that is not known"),
        (np.zeros((2, 4, 5), np.uint8), np.array(1), "length that is not known"),
        (np.zeros((2, 4, 5), np.uint8), np.array([STEP]), "length that is not known"),
    ],
)
def test_arrays_of_another_kind_are_refused(steps, step, message):
    with pytest.raises(ValueError, match=message):
        unpacked(steps, step)
