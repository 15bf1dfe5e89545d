"""Focal lengths from planes: exact scenes, sampled noise, OpenCV's calibration, and a real zoom camera."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes

BOARD = scenes.StripedBoard()
PLANE = np.stack(np.meshgrid(np.arange(9.0), np.arange(6.0)), axis=-1).reshape(-1, 2)
PRINCIPAL = np.array([640.0, 350.0])
TILTS = ((0.5, 0.1, 0.3), (-0.4, 0.5, 1.0), (0.2, -0.6, -0.5))


def crossings(board=BOARD):
    """Where the edges of the stripes cross, mm."""
    across = np.meshgrid(board.edges(0), board.edges(1))
    return np.stack(across, axis=-1).reshape(-1, 2)


def photographed(lens, f, board=BOARD):
    """Corrected and distorted crossings that are within the image, px, and the crossings, mm."""
    places = crossings(board)
    corrected = np.asarray(lens.centre) + board.magnification(f) * places
    inside = ((corrected >= 0) & (corrected <= np.array(lens.image_size) - 1)).all(axis=1)
    seen = np.asarray(lens(f).distort(jnp.array(corrected[inside])))
    return corrected[inside], seen, places[inside]


def from_board(points, board, **settings):
    return zj.focal.focal_from_board(
        points, board, **{"distance": BOARD.distance, "pixel_pitch": BOARD.pixel_pitch} | settings
    )


def views(focal, tilts=TILTS, plane=PLANE, depth=20.0):
    """Pictures of the plane turned about x, y and z, px."""
    pictures = []
    for tilt in tilts:
        turn = cv2.Rodrigues(np.array(tilt))[0]
        placed = np.c_[plane - plane.mean(axis=0), np.zeros(len(plane))] @ turn.T + [0.5, -0.3, depth]
        pictures.append(focal * placed[:, :2] / placed[:, 2:] + PRINCIPAL)
    return np.array(pictures)


# Eq. 14: a board parallel to the sensor.


@pytest.mark.parametrize("f", [20.56, 35.0, 127.36])
def test_projected_boards_give_their_focal_length(truth, f):
    corrected, _, board = photographed(truth, f)
    assert len(board) > 40
    estimate = from_board(corrected, board)
    np.testing.assert_allclose(estimate.focal, f, rtol=1e-12)
    assert estimate.rms < 1e-9
    assert estimate.std < 1e-9


@pytest.mark.parametrize("f", scenes.focal_sweep(6))
def test_projected_boards_corrected_by_a_fitted_lens_do_within_a_thousandth(truth, fit, f):
    """Seen through the true lens with half a px of noise, corrected by what was fitted to other points."""
    _, seen, board = photographed(truth, float(f))
    noise = 0.5 * np.random.default_rng(int(f)).standard_normal(seen.shape)
    corrected = fit.lens(float(f)).undistort(jnp.array(seen + noise))
    assert from_board(corrected, board).focal == pytest.approx(f, rel=1e-3)


def test_without_correction_the_distortion_is_taken_for_focal_length(truth):
    f = 20.56
    _, seen, board = photographed(truth, f)
    raw = from_board(seen, board)
    assert abs(raw.focal / f - 1) > 0.01
    assert raw.rms > 10


def test_pitch_alone_gives_equation_14():
    """Two neighbouring stripes: r_c and R."""
    pitch, seen = 40.0, 3.0
    board = np.array([[0.0, 0.0], [0.0, pitch], [0.0, 2 * pitch]])
    image = np.array([[7.0, 5.0], [7.0, 5 + seen], [7.0, 5 + 2 * seen]])
    estimate = from_board(image, board, distance=1000.0, pixel_pitch=0.25)
    r_c = seen * 0.25
    assert estimate.focal == pytest.approx(1000 * r_c / (pitch + r_c))


def test_a_board_may_be_turned_in_its_plane_and_moved(truth):
    corrected, _, board = photographed(truth, 60.0)
    turn = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    assert from_board(corrected, board @ turn.T + 300).focal == pytest.approx(60)


@pytest.mark.parametrize("compiled", [False, True])
def test_a_board_may_be_given_with_y_upwards(truth, compiled):
    """No turn brings it to its image: f was that of the side by which it is longer, 12 in place of 60."""
    corrected, _, board = photographed(truth, 60.0)
    call = jax.jit(from_board) if compiled else from_board
    straight, mirrored = (call(corrected, board * side) for side in (np.array([1, 1]), np.array([1, -1])))
    np.testing.assert_allclose(mirrored.focal, 60, rtol=1e-12)
    assert mirrored.rms < 1e-9
    np.testing.assert_allclose(mirrored.std, straight.std, atol=1e-9)


def test_standard_deviation_from_a_board_is_that_of_sampled_noise(truth, rng):
    corrected, _, board = photographed(truth, 60.0)
    chosen = rng.choice(len(board), 12, replace=False)
    corrected, board = corrected[chosen], board[chosen]
    noise = 0.7 * rng.standard_normal((4000, *corrected.shape))
    sample = jax.vmap(lambda error: from_board(corrected + error, board))(jnp.array(noise))
    assert sample.focal.mean() == pytest.approx(60, abs=float(4 * sample.focal.std() / np.sqrt(4000)))
    assert np.sqrt((sample.std**2).mean()) == pytest.approx(float(sample.focal.std()), rel=0.05)
    assert (sample.rms**2).mean() == pytest.approx(2 * 0.7**2 * (1 - 4 / 24), rel=0.02)


def test_equation_14_under_jit_and_differentiated(truth):
    corrected, _, board = photographed(truth, 60.0)
    solved = jax.jit(from_board)(corrected, board)
    np.testing.assert_allclose(solved.focal, 60.0)
    slope = jax.grad(lambda d: from_board(corrected, board, distance=d).focal)(BOARD.distance)
    assert slope == pytest.approx(60 / BOARD.distance)


@pytest.mark.parametrize(
    "settings", [{"distance": 0.0}, {"distance": -5.0}, {"pixel_pitch": 0.0}, {"distance": np.nan}]
)
def test_lengths_must_be_positive(settings):
    with pytest.raises(ValueError, match="must be finite and positive"):
        from_board(PLANE, PLANE, **settings)


@pytest.mark.parametrize("pitch", [3.9, 3.9e-6, np.array(5.5), jnp.array(5.5e-6)])
def test_pixels_in_another_unit_are_refused(pitch):
    with pytest.raises(ValueError, match="pixel_pitch must be the width of a pixel on the sensor in mm"):
        from_board(PLANE, PLANE, pixel_pitch=pitch)
    assert np.isfinite(from_board(PLANE, PLANE, pixel_pitch=1).focal)  # of points in mm


def test_lists_are_arrays(truth):
    corrected, _, board = photographed(truth, 60.0)
    listed = from_board(np.asarray(corrected).tolist(), np.asarray(board).tolist())
    assert float(listed.focal) == pytest.approx(float(from_board(corrected, board).focal))
    with pytest.raises(ValueError, match="points must hold real numbers"):
        from_board([["a", "b"]] * 4, PLANE[:4])


def test_a_board_of_one_point_raises():
    with pytest.raises(RuntimeError, match="must differ"):
        from_board(PLANE[:4], np.ones((4, 2)))


@pytest.mark.parametrize("board", [PLANE[:7], PLANE[:2], np.zeros((54, 3))])
def test_boards_of_other_shapes_raise(board, unchecked):
    with pytest.raises(ValueError, match="of one shape"):
        from_board(PLANE[: min(len(board), 2)] if len(board) < 3 else PLANE, board)


# Zhang: oblique views.


@pytest.mark.parametrize("focal", [300.0, 1200.0, 7000.0])
def test_exact_views_give_their_focal_length(focal):
    together, each = zj.focal.focal_from_planes(views(focal), PLANE, principal=PRINCIPAL)
    np.testing.assert_allclose(together.focal, focal, rtol=1e-9)
    np.testing.assert_allclose(each.focal, focal, rtol=1e-9)
    assert each.focal.shape == each.std.shape == each.rms.shape == (3,)
    assert together.std < 1e-6
    assert together.rms < 1e-9


@pytest.mark.parametrize("tilts", [TILTS, TILTS[:1]], ids=["three views", "one view"])
def test_standard_deviation_from_planes_is_that_of_sampled_noise(tilts, rng):
    exact, number = views(1200.0, tilts), 2000
    noise = jnp.array(0.3 * rng.standard_normal((number, *exact.shape)))
    together, each = jax.vmap(
        lambda error: zj.focal.focal_from_planes(exact + error, PLANE, principal=PRINCIPAL)
    )(noise)
    assert together.focal.mean() == pytest.approx(1200, abs=float(0.2 * together.focal.std()))
    assert np.sqrt((together.std**2).mean()) == pytest.approx(float(together.focal.std()), rel=0.07)
    for view in range(len(tilts)):
        spread = float(each.focal[:, view].std())
        assert np.sqrt((each.std[:, view] ** 2).mean()) == pytest.approx(spread, rel=0.1)
    assert (together.rms**2).mean() == pytest.approx(2 * 0.3**2 * (1 - 8 / 108), rel=0.02)


def test_together_views_know_more_than_each(rng):
    noisy = views(1200.0) + 0.3 * rng.standard_normal((3, len(PLANE), 2))
    together, each = zj.focal.focal_from_planes(noisy, PLANE, principal=PRINCIPAL)
    assert together.std < 1.05 * each.std.min()
    assert abs(together.focal - 1200) < 4 * together.std


def test_views_of_other_points_are_used_together(rng):
    """As photos in which other parts of a board are seen; one with none changes nothing."""
    seen = views(1200.0, (*TILTS, (0.0, 0.3, 0.0)))
    noisy = seen + 0.1 * rng.standard_normal(seen.shape)
    mask = np.ones(seen.shape[:2], bool)
    mask[0, 30:] = mask[1, :20] = mask[-1] = False
    noisy[~mask] = 1e4
    planes = np.stack([PLANE + shift for shift in range(len(seen))])
    together, each = zj.focal.focal_from_planes(noisy, planes, principal=PRINCIPAL, mask=mask)
    assert float(together.focal) == pytest.approx(1200, abs=4 * float(together.std))
    assert float(together.std) < 12
    without, _ = zj.focal.focal_from_planes(noisy[:-1], planes[:-1], principal=PRINCIPAL, mask=mask[:-1])
    assert float(without.focal) == pytest.approx(float(together.focal), rel=1e-9)
    assert float(without.std) == pytest.approx(float(together.std), rel=1e-9)
    assert np.isnan(each.focal[-1])
    alone, _ = zj.focal.focal_from_planes(noisy[:1, :30], PLANE[:30], principal=PRINCIPAL)
    assert float(alone.focal) == pytest.approx(float(each.focal[0]), rel=1e-9)
    assert float(alone.std) == pytest.approx(float(each.std[0]), rel=1e-9)


def test_masks_that_do_not_fit_raise(unchecked):
    seen = views(1200.0)
    with pytest.raises(ValueError, match="mask must have shape"):
        zj.focal.focal_from_planes(seen, PLANE, principal=PRINCIPAL, mask=np.ones(len(PLANE), bool))
    mask = np.ones(seen.shape[:2], bool)
    mask[0, 4:] = False
    with pytest.raises(ValueError, match="at least 5 valid points, or none, but one has 4"):
        zj.focal.focal_from_planes(seen, PLANE, principal=PRINCIPAL, mask=mask)


def test_unit_place_and_turn_of_the_plane_do_not_matter(rng):
    noisy = views(1200.0) + 0.3 * rng.standard_normal((3, len(PLANE), 2))
    known = zj.focal.focal_from_planes(noisy, PLANE, principal=PRINCIPAL)
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    other = zj.focal.focal_from_planes(noisy, 25 * PLANE @ turn.T + 1000, principal=PRINCIPAL)
    for one, same in zip(jax.tree.leaves(known), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(one, same, rtol=1e-6)


def test_a_view_closer_to_squarely_says_less(rng):
    tilts = [(angle, 0.0, 0.2) for angle in (0.6, 0.3, 0.15)]
    noisy = views(1200.0, tilts) + 0.1 * rng.standard_normal((3, len(PLANE), 2))
    _, each = zj.focal.focal_from_planes(noisy, PLANE, principal=PRINCIPAL)
    relative = each.std / each.focal
    assert relative[0] < relative[1] < relative[2]


def test_a_view_that_says_nothing_is_nan_and_infinitely_uncertain():
    """A bulge that no plane seen by a camera could have: both equations ask for a negative 1/f²."""
    turned = (PLANE - PLANE.mean(axis=0)) @ np.diag([1.5, 1.0])
    stretched = 100 * turned / (1 + 0.02 * turned[:, :1]) + PRINCIPAL
    together, each = zj.focal.focal_from_planes(stretched[None], PLANE, principal=PRINCIPAL)
    assert np.isnan(together.focal)
    assert np.isnan(each.focal).all()
    assert np.isposinf(each.std).all()


def test_a_square_view_weighs_nothing_beside_an_oblique_one(rng):
    noisy = views(1200.0, [TILTS[0], (0.0, 0.0, 0.1)]) + 0.1 * rng.standard_normal((2, len(PLANE), 2))
    together, each = zj.focal.focal_from_planes(noisy, PLANE, principal=PRINCIPAL)
    assert not each.std[1] < 20 * each.std[0]
    assert together.focal == pytest.approx(float(each.focal[0]), abs=float(2 * each.std[0]))


def test_float32_is_kept_and_close():
    points = jnp.asarray(views(1200.0), jnp.float32)
    plane, principal = jnp.asarray(PLANE, jnp.float32), jnp.asarray(PRINCIPAL, jnp.float32)
    together, _ = zj.focal.focal_from_planes(points, plane, principal=principal)
    assert together.focal.dtype == together.std.dtype == jnp.float32
    assert together.focal == pytest.approx(1200, rel=1e-3)


@pytest.mark.parametrize(
    "points", [np.zeros((54, 2)), np.zeros((2, 53, 2)), np.zeros((2, 54, 3))], ids=["flat", "fewer", "3d"]
)
def test_views_of_other_shapes_raise(points, unchecked):
    with pytest.raises(ValueError, match="shape"):
        zj.focal.focal_from_planes(points, PLANE, principal=PRINCIPAL)


def test_no_views_and_few_points_raise(unchecked):
    with pytest.raises(ValueError, match="view"):
        zj.focal.focal_from_planes(np.zeros((0, 54, 2)), PLANE, principal=PRINCIPAL)
    with pytest.raises(ValueError, match="n >= 5"):
        zj.focal.focal_from_planes(views(1200.0)[:, :4], PLANE[:4], principal=PRINCIPAL)


def test_the_two_focal_lengths_differ_by_the_focus():
    """Eq. 14 gives the thin lens's f; the homography the distance to the image, d / (d - f) times it."""
    f, distance, pixel = 50.0, 1000.0, 0.005
    image_distance = f * distance / (distance - f)
    plane = 20 * (PLANE - PLANE.mean(axis=0))
    square = plane * image_distance / distance / pixel
    assert from_board(square, plane, distance=distance, pixel_pitch=pixel).focal == pytest.approx(f)
    oblique = views(image_distance / pixel, plane=plane, depth=distance)
    together, _ = zj.focal.focal_from_planes(oblique, plane, principal=PRINCIPAL)
    assert together.focal * pixel == pytest.approx(image_distance)


# Lines of a plane.

FIELD = np.array(
    [
        [[0.0, 0.0], [8.0, 0.0]],
        [[0.0, 5.0], [8.0, 5.0]],
        [[0.0, 0.0], [0.0, 5.0]],
        [[8.0, 0.0], [8.0, 5.0]],
        [[0.0, 0.0], [8.0, 5.0]],
    ]
)
"""A rectangle and a diagonal."""


def seen_on(lines, focal=1200.0, tilt=TILTS[0], number=5):
    """Places on the lines, and where they are in the image, px."""
    along = np.linspace(0.1, 0.8, number)[:, None]
    places = lines[:, :1] + along * (lines[:, 1:] - lines[:, :1])
    return views(focal, [tilt], places.reshape(-1, 2))[0].reshape(places.shape)


def from_lines(points, lines=FIELD, **settings):
    return zj.focal.focal_from_lines(points, lines, principal=PRINCIPAL, **settings)


@pytest.mark.parametrize("tilt", TILTS)
@pytest.mark.parametrize("focal", [300.0, 1200.0, 7000.0])
def test_exact_lines_give_their_focal_length(focal, tilt):
    estimate = from_lines(seen_on(FIELD, focal, tilt))
    np.testing.assert_allclose(estimate.focal, focal, rtol=1e-9)
    assert estimate.std < 1e-6
    assert estimate.rms < 1e-9


def test_four_lines_of_two_points_are_enough():
    estimate = from_lines(seen_on(FIELD[:4], number=2), FIELD[:4])
    np.testing.assert_allclose(estimate.focal, 1200, rtol=1e-9)


def test_which_points_describe_a_line_and_its_unit_do_not_matter(rng):
    noisy = seen_on(FIELD) + 0.3 * rng.standard_normal((5, 5, 2))
    known = from_lines(noisy)
    slid = FIELD[:, :1] + np.array([[-0.5], [30.0]]) * (FIELD[:, 1:] - FIELD[:, :1])
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    for lines in (slid, FIELD[:, ::-1], 25 * FIELD @ turn.T + 1000, FIELD * [1, -1]):
        for one, same in zip(
            jax.tree.leaves(known), jax.tree.leaves(from_lines(noisy, lines)), strict=True
        ):
            np.testing.assert_allclose(one, same, rtol=1e-7)


def test_masked_points_change_nothing(rng):
    noisy = seen_on(FIELD) + 0.3 * rng.standard_normal((5, 5, 2))
    known = from_lines(noisy)
    points = np.full((7, 9, 2), np.nan)
    points[:5, 2:7] = noisy
    lines = np.concatenate([FIELD, FIELD[:2] + np.array([3.0, 0.1])])
    for one, same in zip(
        jax.tree.leaves(known),
        jax.tree.leaves(from_lines(points, lines, mask=np.isfinite(points[..., 0]))),
        strict=True,
    ):
        np.testing.assert_allclose(one, same, rtol=1e-9)


@pytest.mark.parametrize("number", [3, 12])
def test_standard_deviation_from_lines_is_that_of_sampled_noise(number, rng):
    exact = seen_on(FIELD, tilt=(0.8, 0.5, 0.2), number=number)
    noise = jnp.array(0.2 * rng.standard_normal((2000, *exact.shape)))
    sample = jax.vmap(lambda error: from_lines(exact + error))(noise)
    assert sample.focal.mean() == pytest.approx(1200, abs=float(0.2 * sample.focal.std()))
    assert np.sqrt((sample.std**2).mean()) == pytest.approx(float(sample.focal.std()), rel=0.1)
    freedom = 1 - 8 / (5 * number)
    assert (sample.rms**2).mean() == pytest.approx(0.2**2 * freedom, rel=0.04)


def test_points_at_the_same_places_say_more_if_the_places_are_known(rng):
    places = FIELD[:, :1] + np.linspace(0.1, 0.8, 5)[:, None] * (FIELD[:, 1:] - FIELD[:, :1])
    noisy = seen_on(FIELD) + 0.3 * rng.standard_normal((5, 5, 2))
    together, _ = zj.focal.focal_from_planes(
        noisy.reshape(1, -1, 2), places.reshape(-1, 2), principal=PRINCIPAL
    )
    lines = from_lines(noisy)
    assert together.std < lines.std
    assert abs(together.focal - lines.focal) < 3 * lines.std


@pytest.mark.slow
def test_gradients_are_finite_differences(rng):
    """Far from an exact fit, where the squares' second derivatives are not Gauss and Newton's."""
    noisy = seen_on(FIELD) + 5 * rng.standard_normal((5, 5, 2))
    flat = views(1200.0, TILTS[:1]) + 5 * rng.standard_normal((1, len(PLANE), 2))
    for solve, points in (
        (from_lines, noisy),
        (lambda points: zj.focal.focal_from_planes(points, PLANE, principal=PRINCIPAL)[0], flat),
    ):
        direction = rng.standard_normal(points.shape)
        for of in (lambda points, solve=solve: solve(points).focal, lambda p, s=solve: s(p).std):
            backward = jnp.sum(jax.grad(of)(jnp.array(points)) * direction)
            forward = jax.jvp(of, (jnp.array(points),), (jnp.array(direction),))[1]
            step = 1e-4
            difference = (of(points + step * direction) - of(points - step * direction)) / (2 * step)
            np.testing.assert_allclose(backward, forward, rtol=1e-9)
            np.testing.assert_allclose(backward, difference, rtol=1e-6)


def test_under_jit_and_in_float32(rng):
    noisy = seen_on(FIELD) + 0.3 * rng.standard_normal((5, 5, 2))
    known = from_lines(noisy).focal
    np.testing.assert_allclose(jax.jit(from_lines)(noisy).focal, known, rtol=1e-9)
    single = zj.focal.focal_from_lines(
        *(jnp.asarray(array, jnp.float32) for array in (noisy, FIELD)),
        principal=jnp.asarray(PRINCIPAL, jnp.float32),
    )
    assert single.focal.dtype == single.std.dtype == jnp.float32
    assert single.focal == pytest.approx(float(known), rel=1e-3)


SPOKES = np.stack([np.full((6, 2), 3.0), 3 + 2 * np.stack([np.cos(range(6)), np.sin(range(6))], -1)], 1)
PARALLELS = FIELD[:1] + np.array([0, 1, 2.5, 4, 7])[:, None, None] * [0.2, 1.0]


@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize(
    ("lines", "number"),
    [
        (FIELD[:3], 5),
        (FIELD[:1], 2),
        (np.zeros((0, 2, 2)), 3),
        (PARALLELS, 4),
        (np.concatenate([PARALLELS, FIELD[3:4]]), 4),
        (SPOKES, 4),
        (np.concatenate([SPOKES, FIELD[:1]]), 4),
        (np.concatenate([FIELD[:3], 0.5 * (FIELD[:1] + FIELD[:1, ::-1]) + [[0.0, 0.0], [4.0, 0.0]]]), 5),
        (FIELD[:4], 1),
        (FIELD, 1),
        (FIELD[[0, 0, 0, 0]], 9),
    ],
    ids=[
        *("three", "one", "none", "parallel", "parallel and one", "through a point"),
        *("through a point and one", "one twice", "four points", "five points", "the same"),
    ],
)
def test_lines_that_determine_nothing_are_nan_and_infinitely_uncertain(lines, number, noise, rng):
    points = seen_on(lines, number=number) if len(lines) else np.zeros((0, 3, 2))
    estimate = from_lines(points + noise * rng.standard_normal(points.shape), lines)
    assert np.isnan(estimate.focal)
    assert np.isposinf(estimate.std)


@pytest.mark.parametrize(
    ("points", "lines", "mask"),
    [
        (np.zeros((4, 2)), FIELD[:4], None),
        (np.zeros((4, 3, 3)), FIELD[:4], None),
        (np.zeros((4, 3, 2)), FIELD, None),
        (np.zeros((4, 3, 2)), FIELD[:4, 0], None),
        (np.zeros((4, 3, 2)), FIELD[:4], np.ones((4, 2), bool)),
    ],
)
def test_lines_of_other_shapes_raise(points, lines, mask, unchecked):
    with pytest.raises(ValueError, match="must have shapes"):
        from_lines(points, lines, mask=mask)


# A real zoom camera.


@pytest.fixture(scope="module")
def zoomcam(data):
    """For each zoom its focal length by the data's authors, and the corrected corners of all photos."""
    with np.load(data / "zoomcam" / "corners_22x15.npz") as stored:
        zoom, corners = stored["zoom"], stored["corners"].astype(float)
    table = np.loadtxt(data / "zoomcam" / "focal_px.csv", delimiter=",", skiprows=1)
    frame = np.searchsorted(table[:, 0], zoom)
    lines = zj.Lines.from_grids(corners, frame, table[:, 1], image_size=(1280, 720), focal_unit="px")
    lens = zj.fit_zoom(lines).lens
    corrected = [
        np.asarray(lens(focal).undistort(jnp.array(corners[zoom == z].reshape(-1, 330, 2))))
        for z, focal in table
    ]
    return lens, table[:, 1], corrected


REAL_PLANE = np.stack(np.meshgrid(np.arange(22.0), np.arange(15.0)), axis=-1).reshape(-1, 2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("zoom", "within"),
    # At the longest, OpenCV's calibration of the same corners is 8 % longer than the authors' too.
    list(enumerate([0.05, 0.05, 0.05, 0.05, 0.08])),
)
def test_focal_lengths_of_a_real_zoom_camera(zoomcam, zoom, within):
    lens, focal, corrected = zoomcam
    _, each = zj.focal.focal_from_planes(corrected[zoom], REAL_PLANE, principal=np.asarray(lens.centre))
    assert np.nanmedian(each.focal) == pytest.approx(focal[zoom], rel=within)


@pytest.mark.slow
@pytest.mark.parametrize("zoom", range(5))
def test_focal_lengths_of_a_real_zoom_camera_are_those_of_opencv(zoomcam, zoom):
    """cv2.calibrateCamera on the same corrected corners, with the same principal point."""
    lens, focal, corrected = zoomcam
    together, _ = zj.focal.focal_from_planes(corrected[zoom], REAL_PLANE, principal=np.asarray(lens.centre))
    board = np.c_[REAL_PLANE, np.zeros(330)].astype(np.float32)
    x, y = np.asarray(lens.centre)
    guess = np.array([[focal[zoom], 0, x], [0, focal[zoom], y], [0, 0, 1]])
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO
    flags |= cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    pictures = [picture.astype(np.float32) for picture in corrected[zoom]]
    _, matrix, *_ = cv2.calibrateCamera(
        [board] * len(pictures), pictures, (1280, 720), guess, None, flags=flags
    )
    assert together.focal == pytest.approx(matrix[0, 0], rel=0.01)


KNOWN_LINES = np.array([[[0, 0], [5, 0]], [[0, 3], [5, 3]], [[0, 0], [0, 3]], [[5, 0], [5, 3.0]]])


@pytest.mark.parametrize("principal", [[640.0], 640.0, [640.0, 350.0, 1.0], [np.nan, 350.0]], ids=str)
@pytest.mark.usefixtures("unchecked")
def test_a_principal_point_is_one_point(principal):
    """One number was taken for x and y."""
    positions = np.zeros((4, 3, 2))
    calls = {
        "planes": lambda: zj.focal.focal_from_planes(views(900.0), PLANE, principal=principal),
        "lines": lambda: zj.focal.focal_from_lines(positions, KNOWN_LINES, principal=principal),
        "pitch": lambda: zj.focal.focal_from_pitch({"Middle line": np.ones((3, 2))}, principal=principal),
        "names": lambda: zj.focal.name_pitch_lines([], principal=principal, image_size=(1280, 720)),
    }
    for call in calls.values():
        with pytest.raises(ValueError, match="Argument principal must be"):
            call()


@pytest.mark.parametrize("entry", [0.5, 2])
@pytest.mark.usefixtures("unchecked")
def test_a_mask_holds_booleans(entry):
    """Numbers were weights of points, or how often they count."""
    mask = np.full((3, len(PLANE)), entry)
    with pytest.raises(ValueError, match="Argument mask must hold booleans"):
        zj.focal.focal_from_planes(views(900.0), PLANE, principal=PRINCIPAL, mask=mask)
    with pytest.raises(ValueError, match="Argument mask must hold booleans"):
        zj.focal.focal_from_lines(
            np.zeros((4, 3, 2)), KNOWN_LINES, principal=PRINCIPAL, mask=np.full((4, 3), entry)
        )


def test_gradients_by_views_with_masked_points_that_are_not_numbers():
    """As detectors give corners that are not seen: one of them made all derivatives NaN."""
    images = views(900.0)
    mask = np.ones(images.shape[:2], bool)
    mask[0, [3, 7]] = mask[2] = False

    def focal(points, plane, principal):
        return zj.focal.focal_from_planes(points, plane, principal=principal, mask=mask)[0].focal

    def gradients(fill):
        points = np.where(mask[..., None], images, fill)
        plane = np.where(mask[..., None], np.broadcast_to(PLANE, images.shape), fill)
        return jax.grad(focal, argnums=(0, 1, 2))(*map(jnp.asarray, (points, plane, PRINCIPAL)))

    for found, expected in zip(gradients(np.nan), gradients(0.0), strict=True):
        assert np.abs(expected).max() > 0
        np.testing.assert_array_equal(found, expected)
