"""Problems: one layer over a data set, whatever the distortion model and the metric."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.fit.image_metric import in_corrected
from zoomjax.fit.problem import Problem, data_of, posed

HEADER = ["frame", "focal", "focus", "centre", "image_size", "focal_unit", "number", "weight"]
DIVISION = zj.models.Division()


def test_a_problem_has_the_lines_and_frames_of_its_data(small):
    problem = zj.fit.in_image(small)
    assert isinstance(problem, Problem)
    assert all(getattr(problem, name) is getattr(small, name) for name in HEADER)
    assert len(jax.tree.leaves(problem)) == len(jax.tree.leaves(small))  # nothing is held twice
    np.testing.assert_array_equal(problem.counts, small.counts)


def test_the_problem_of_the_paper_is_the_data_set(small):
    assert posed(small, zj.models.RadialPolynomial(), "corrected") is small
    assert in_corrected(zj.fit.in_image(small)) is small
    assert (
        zj.fit.with_distortion_model(zj.fit.with_distortion_model(small, DIVISION), small.distortion_model)
        is small
    )


def test_model_and_metric_commute_and_make_one_layer(noisy):
    one = zj.fit.in_image(zj.fit.with_distortion_model(noisy, DIVISION))
    other = zj.fit.with_distortion_model(zj.fit.in_image(noisy), DIVISION)
    assert isinstance(one, Problem)
    assert eqx.tree_equal(one, other)
    assert data_of(one) is noisy
    assert (one.distortion_model, one.metric) == (DIVISION, "distorted")


def test_what_is_not_asked_for_stays(noisy):
    moving = posed(noisy, DIVISION, any_centre=True)
    seen = zj.fit.in_image(moving)
    assert isinstance(seen, Problem)
    assert seen.any_centre
    assert seen.metric == "distorted"
    fixed = seen.about(noisy.centre)
    assert isinstance(fixed, Problem)
    assert not fixed.any_centre
    assert (fixed.distortion_model, fixed.metric) == (DIVISION, "distorted")


def test_lines_for_any_centre_end_with_their_centre_under_the_polynomial(noisy):
    problem = zj.fit.in_image(zj.lines.compress_any_centre(noisy, 1))
    assert isinstance(problem, Problem)
    assert problem.any_centre


@pytest.mark.parametrize("name", ["focal", "weight", "centre"])
def test_changes_of_a_problem_are_changes_of_its_data(noisy, name):
    like = noisy.frame if name == "weight" else getattr(noisy, name)
    new = jnp.full(like.shape, 7.0)
    problem = eqx.tree_at(
        lambda lines: getattr(lines, name), zj.fit.in_image(noisy), new, is_leaf=lambda leaf: leaf is None
    )
    assert getattr(problem, name) is getattr(data_of(problem), name) is new


def test_compressed_for_fewer_coefficients_is_refused(noisy):
    k = jnp.zeros((4, 3))
    with pytest.raises(ValueError, match=r"compress\(lines, terms=3\)"):
        zj.frame_rms(zj.fit.in_image(zj.compress(noisy, 2)), k)
    with pytest.raises(ValueError, match="Division needs lines compressed for 8 terms"):
        zj.frame_rms(zj.fit.with_distortion_model(zj.compress(noisy, 2), DIVISION), k[:, :1])
