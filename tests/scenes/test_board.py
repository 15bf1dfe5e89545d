import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes

from .._reference import undistorted
from ..conftest import NOISE

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
    focal = scenes.focal_sweep()
    assert focal.shape == (50,)
    np.testing.assert_allclose(focal[[0, -1]], ENDS)
    np.testing.assert_allclose(np.diff(1 / focal), np.diff(1 / focal)[0])


def test_magnification_inverts_equation_14():
    board = scenes.StripedBoard()
    for f in ENDS:
        seen = board.magnification(f) * board.pixel_pitch  # mm on the sensor of 1 mm on the board
        assert board.distance * seen / (1 + seen) == pytest.approx(f)


def test_stripes_have_two_edges_each():
    board = scenes.StripedBoard()
    assert board.edges(0).shape == (62,)
    assert board.edges(1).shape == (46,)
    np.testing.assert_allclose(np.diff(board.edges(0)), 1330 / 62)


def test_board_fills_the_papers_images(truth):
    board = scenes.StripedBoard()
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
        scenes.board_lines(truth, np.array([127.36]), spacing=200.0, noise=1.0, seed=seed)
        for seed in (3, 3, 4)
    )
    np.testing.assert_array_equal(one.points, same.points)
    assert (one.points != other.points).any()


def test_spacing_sets_the_number_of_points(truth):
    coarse, fine = (
        scenes.board_lines(truth, np.array([60.0]), spacing=spacing).counts.sum()
        for spacing in (80.0, 20.0)
    )
    assert fine / coarse == pytest.approx(4, rel=0.05)


def test_dtype_is_that_of_the_lens(truth):
    single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), truth)
    lines = scenes.board_lines(single, np.array([60.0]), spacing=80.0, noise=0.1)
    assert isinstance(lines, zj.Lines)
    assert lines.points.dtype == jnp.float32


def test_nikkor_of_smaller_images_is_the_same_lens(truth):
    small = scenes.nikkor_18_200((2144, 1424))
    for f in ENDS:
        scaled = np.array([4, 16]) * truth(f).pixel_coefficients
        np.testing.assert_allclose(small(f).pixel_coefficients, scaled)
    board = scenes.StripedBoard.before(small)
    assert board.magnification(30.0) == pytest.approx(scenes.StripedBoard().magnification(30.0) / 2)


SMALL = (96, 64)


def in_white(position, board):
    """Whether positions, mm from the middle of the board, are on a stripe of it: by definition."""
    stripe, on, within = [], [], []
    for axis in (0, 1):
        edges = board.edges(axis)
        count = np.searchsorted(edges, position[..., axis], side="right")
        on.append(count % 2 == 1)
        within.append((count > 0) & (count < len(edges)))
        stripe.append(edges[1] - edges[0])
    return (on[0] & within[1]) | (on[1] & within[0])


@pytest.mark.parametrize("focal", [30.0, 127.36])
def test_photo_is_the_integral_of_the_scene_over_each_pixel(focal):
    lens = scenes.nikkor_18_200(SMALL)
    board = scenes.StripedBoard.before(lens)
    photo = scenes.board_photo(lens, focal, blur=0, noise=0, vignetting=0, levels=(0, 250))
    fine = (np.arange(40) + 0.5) / 40 - 0.5
    x, y = np.meshgrid(np.add.outer(np.arange(96), fine).ravel(), np.add.outer(np.arange(64), fine).ravel())
    d = lens(focal)
    seen = undistorted(np.stack([x, y], axis=-1), d.coefficients, d.centre, d.scale)
    white = in_white((seen - np.asarray(d.centre)) / board.magnification(focal), board)
    exact = 250 * white.reshape(64, 40, 96, 40).mean((1, 3))
    # 40 samples a side tell coverage to 1/80 a border at worst, and two borders meet in a corner.
    assert np.abs(photo - exact).max() <= 1 + 250 * 2 / 80
    assert abs(np.mean(photo - exact)) < 0.02
    assert np.ptp(photo) == 250


def test_photo_has_the_blur_noise_and_vignetting_asked_for():
    large = scenes.nikkor_18_200((536, 356))
    sharp, soft = (
        scenes.board_photo(large, 127.36, blur=blur, noise=0, vignetting=0).astype(float)
        for blur in (0, 1.5)
    )
    row = int(np.argmax(sharp.std(axis=1)))
    step = int(np.argmax(np.abs(np.diff(sharp[row, 20:-20])))) + 20
    slope = np.gradient(soft[row])[step - 9 : step + 11]
    position = np.arange(20)
    mean = np.average(position, weights=slope)
    variance = np.average((position - mean) ** 2, weights=slope)
    # Central differences of a step have variance 1/4; how it falls on the pixels adds 0 to 1/4.
    assert 1.5**2 + 0.22 < variance < 1.5**2 + 0.53
    lens = scenes.nikkor_18_200(SMALL)
    plain, noisy, other = (
        scenes.board_photo(lens, 30.0, noise=noise, seed=seed).astype(float)
        for noise, seed in ((0, 0), (5, 1), (5, 2))
    )
    assert np.std(noisy - plain) == pytest.approx(5, rel=0.05)
    assert np.std(noisy - other) == pytest.approx(5 * np.sqrt(2), rel=0.05)
    full, dimmed = (scenes.board_photo(lens, 127.36, noise=0, vignetting=v).astype(float) for v in (0, 0.4))
    corner = np.hypot(*SMALL) / 2
    squared = ((np.arange(96) - 47.5) ** 2 + (np.arange(64) - 31.5)[:, None] ** 2) / corner**2
    np.testing.assert_allclose(dimmed, full * (1 - 0.4 * squared), atol=2.5)


def test_photo_shows_its_edges_where_the_lines_say(truth):
    lens = scenes.nikkor_18_200((536, 356))
    photo = scenes.board_photo(lens, 60.0, blur=0, noise=0, vignetting=0, levels=(0, 250)).astype(float)
    lines = scenes.board_lines(lens, np.array([60.0]), spacing=1)
    distances = []
    for line in lines.to_ragged():
        axis = int(np.argmin(np.ptp(line, axis=0)))  # the coordinate that hardly changes
        image = photo if axis else photo.T
        for point in line[::7]:
            place, other = point[axis], round(point[1 - axis])
            window = slice(int(place) - 4, int(place) + 5)
            if window.start < 0 or window.stop > image.shape[0]:
                continue
            profile = image[window, other]
            if {profile[0], profile[-1]} == {0.0, 250.0} and len(np.unique(profile)) <= 4:
                dark = profile[0] == 0
                white = profile.sum() / 250  # px of white in the window
                found = window.start - 0.5 + (9 - white if dark else white)
                distances.append(found - place)
    assert len(distances) > 100
    assert np.abs(distances).max() < 0.06  # other is rounded, and lines are tilted
    assert abs(np.mean(distances)) < 0.005


def test_focal_lengths_at_which_the_lens_folds_everywhere_are_refused():
    with pytest.raises(ValueError, match="Argument focal must be within the range of the lens, but at 200"):
        scenes.board_lines(scenes.nikkor_18_200(), np.array([60.0, 200.0]), spacing=99)


@pytest.mark.parametrize("centre", [[200.0, 150.0], [400.0, 320.0]], ids=str)
def test_edges_reach_the_corners_farthest_from_a_centre_off_the_middle(centre):
    """They ended as far from the centre as the first corner is."""
    zoom = zj.PolynomialZoom(0, jnp.array([[0.05]]), jnp.array(20.0))
    lens = zj.ZoomLens(zoom, jnp.array(centre), jnp.array([20.0, 80.0]), (640, 480))
    lines = scenes.board_lines(lens, np.array([30.0]), spacing=5)
    longest = np.array([np.ptp(line, axis=0) for line in lines.to_ragged()]).max(axis=0)
    assert (longest > np.array([639, 479]) - 12).all()
