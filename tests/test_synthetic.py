import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from _reference import undistorted
from conftest import NOISE
from zoomjax import synthetic

ENDS = (20.56, 127.36)


def test_nikkor_has_the_published_polynomials(truth):
    for f in (20.56, 35.0, 127.36):
        k1 = 2.26e-9 - 7.19e-7 / f + 2.14e-5 / f**2
        k2 = 1.74e-17 + 7.36e-15 / f - 6.55e-13 / f**2
        np.testing.assert_allclose(truth(f).pixel_coefficients, [k1, k2], rtol=1e-12)


def test_nikkor_is_invertible_over_its_images(truth):
    for f in ENDS:
        assert truth(f).monotone_radius > truth.scale


def test_focal_lengths_are_even_in_one_over_f():
    focal = synthetic.focal_sweep()
    assert focal.shape == (50,)
    np.testing.assert_allclose(focal[[0, -1]], ENDS)
    np.testing.assert_allclose(np.diff(1 / focal), np.diff(1 / focal)[0])


def test_magnification_inverts_equation_14():
    board = synthetic.StripedBoard()
    for f in ENDS:
        seen = board.magnification(f) * board.pixel  # mm on the sensor of 1 mm on the board
        assert board.distance * seen / (1 + seen) == pytest.approx(f)


def test_stripes_have_two_edges_each():
    board = synthetic.StripedBoard()
    assert board.edges(0).shape == (62,)
    assert board.edges(1).shape == (46,)
    np.testing.assert_allclose(np.diff(board.edges(0)), 1330 / 62)


def test_board_fills_the_papers_images(truth):
    board = synthetic.StripedBoard()
    width, height = (board.magnification(ENDS[0]) * side for side in board.size)
    assert width == pytest.approx(20.56 / (1185 - 20.56) * 1330 / 23.7 * 4288)
    assert 0.95 < width / truth.image_size[0] < 1
    assert height > truth.image_size[1]


def test_undistorted_lines_are_straight_and_parallel_to_an_axis(clean, truth):
    for line, frame in zip(clean.to_ragged(), clean.frame, strict=True):
        d = truth(clean.focal[frame])
        corrected = undistorted(line, d.coefficients, d.centre, d.scale)
        assert np.ptp(corrected, axis=0).min() < 1e-9


def test_lines_of_both_kinds_are_seen_in_every_frame(clean):
    extent = np.array([np.ptp(line, axis=0) for line in clean.to_ragged()])
    vertical = extent[:, 1] > extent[:, 0]
    for index in range(len(clean.focal)):
        kinds = vertical[np.asarray(clean.frame) == index]
        assert 0 < kinds.sum() < len(kinds)


def test_points_are_within_the_image_and_lines_are_long(clean):
    for line in clean.to_ragged():
        assert (line >= 0).all()
        assert (line <= np.array([4287, 2847])).all()
        assert np.hypot(*(line[-1] - line[0])) >= 284.8


def test_noise_is_as_asked_and_comes_from_the_seed(clean, noisy, truth):
    error = np.concatenate(noisy.to_ragged()) - np.concatenate(clean.to_ragged())
    assert error.std() == pytest.approx(NOISE, rel=0.02)
    assert abs(error.mean()) < 0.02
    one, same, other = (
        synthetic.board_lines(truth, np.array([127.36]), spacing=200.0, noise=1.0, seed=seed)
        for seed in (3, 3, 4)
    )
    np.testing.assert_array_equal(one.points, same.points)
    assert (one.points != other.points).any()


def test_spacing_sets_the_number_of_points(truth):
    coarse, fine = (
        synthetic.board_lines(truth, np.array([60.0]), spacing=spacing).counts.sum()
        for spacing in (80.0, 20.0)
    )
    assert fine / coarse == pytest.approx(4, rel=0.05)


def test_dtype_is_that_of_the_lens(truth):
    single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), truth)
    lines = synthetic.board_lines(single, np.array([60.0]), spacing=80.0, noise=0.1)
    assert isinstance(lines, zj.Lines)
    assert lines.points.dtype == jnp.float32
