"""Grids rendered with exact truth, and real photos of boards and dots."""

import warnings

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.detect import grid as module
from zoomjax.detect._saddles import grown_board
from zoomjax.detect.grid import find_checkerboard, find_dots

SIZE = (400, 300)
CENTRE = (np.array(SIZE) - 1) / 2
SQUARE = np.array([[28.0, 0, 45.5], [0, 28, 41.5], [0, 0, 1]])
OBLIQUE = np.array([[32.0, -4, 52.25], [5, 29, 38.5], [0.012, 0.008, 1]])
POSES = {"square": SQUARE, "oblique": OBLIQUE}
LENSES = {"straight": (0.0, 0.0), "barrel": (0.1, 0.03), "pincushion": (-0.08, 0.0)}
OVER = 8  # samples a pixel, along x and y
ROWS, COLUMNS = 8, 11

poses = pytest.mark.parametrize("pose", POSES.values(), ids=POSES)
lenses = pytest.mark.parametrize("k", LENSES.values(), ids=LENSES)


def lens(k):
    return zj.Distortion(jnp.array(k), jnp.array(CENTRE), jnp.array(np.hypot(*SIZE) / 2))


def mapped(homography, points):
    out = np.concatenate([points, np.ones_like(points[..., :1])], axis=-1) @ homography.T
    return out[..., :2] / out[..., 2:]


def nodes(rows=ROWS, columns=COLUMNS):
    return np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).astype(float)


def rendered(pattern, pose, k=(0.0, 0.0), low=30, high=220):
    """The image of a pattern, a function of positions on its plane to 0 or 1, each pixel an average."""
    width, height = SIZE
    x, y = ((np.arange(side * OVER) + 0.5) / OVER - 0.5 for side in SIZE)
    corrected = np.asarray(lens(k).undistort(jnp.array(np.stack(np.meshgrid(x, y), axis=-1))))
    bright = pattern(mapped(np.linalg.inv(pose), corrected))
    mean = bright.reshape(height, OVER, width, OVER).mean(axis=(1, 3))
    return np.rint(low + (high - low) * mean).astype(np.uint8)


def seen(pose, k, points):
    return np.asarray(lens(k).distort(jnp.array(mapped(pose, points))))


def squares(places):
    """A checkerboard with ROWS x COLUMNS inner corners, the first at (0, 0), on white."""
    i, j = np.floor(places[..., 0]), np.floor(places[..., 1])
    board = (i >= -1) & (i < COLUMNS) & (j >= -1) & (j < ROWS)
    return np.where(board, (i + j) % 2, 1.0)


def dots(places, radius=0.22, absent=()):
    """ROWS x COLUMNS dark dots on white, less the absent ones."""
    close = np.clip(np.rint(places), 0, [COLUMNS - 1, ROWS - 1])
    dark = np.hypot(*np.moveaxis(places - close, -1, 0)) < radius
    for row, column in absent:
        dark &= ~((close[..., 0] == column) & (close[..., 1] == row))
    return 1.0 - dark


def rms(difference):
    return np.sqrt(np.nanmean(np.sum(difference**2, axis=-1)))


@lenses
@poses
def test_corners_of_a_board_are_found_where_they_are(pose, k):
    found = find_checkerboard(rendered(squares, pose, k))
    assert found is not None
    assert found.dtype == np.float64
    assert found.shape == (ROWS, COLUMNS, 2)
    assert rms(found - seen(pose, k, nodes())) < 0.05


PARTLY = {
    "left": np.array([[30.0, 0, -50], [2, 30, 41.5], [0, 0, 1]]),
    "corner": np.array([[40.0, 3, 150], [-2, 40, 120.5], [0, 0, 1]]),
    "turned": np.array([[36.0, 30, -60], [-30, 36, 130.5], [0, 0, 1]]),
    "oblique": np.array([[40.0, -4, -60], [5, 40, -50], [0.012, 0.008, 1]]),
}


def matched(found, truth):
    """The true corner nearest to each one found."""
    offset = np.linalg.norm(found[:, None] - truth[None], axis=-1)
    assert len(set(offset.argmin(axis=1).tolist())) == len(found)
    return truth[offset.argmin(axis=1)]


@lenses
@pytest.mark.parametrize("pose", PARTLY.values(), ids=PARTLY)
def test_a_board_partly_outside_of_the_image_is_found_as_far_as_it_is_seen(pose, k):
    """Every corner well within the image, where it is, and rows and columns that are those of the board."""
    image = rendered(squares, pose, k)
    grid = find_checkerboard(image)
    assert grid is not None
    truth = np.nan_to_num(seen(pose, k, nodes()).reshape(-1, 2), nan=-1e6)  # beyond the lens's fold
    depth = np.minimum(truth, np.subtract(SIZE, 1) - truth).min(axis=1)
    found = grid[np.isfinite(grid[..., 0])]
    assert (depth > 8).sum() <= len(found) <= (depth > 0).sum() < ROWS * COLUMNS
    assert rms(found - matched(found, truth)) < 0.1
    place = {tuple(corner): divmod(index, COLUMNS) for index, corner in enumerate(truth.tolist())}
    for axis in (0, 1):
        for line in grid.swapaxes(0, axis):
            points = line[np.isfinite(line[:, 0])]
            there = (
                np.array([place[tuple(p)] for p in matched(points, truth).tolist()]) if len(points) else []
            )
            assert len(points) < 2 or 0 in np.ptp(there, axis=0)


def slanted(shrinking):
    """Seen at a slant: columns shrink to the right, in the beginning to half from one to the next."""
    return np.array([[60 + 200 * shrinking, 0, 20], [150 * shrinking, 36, 24], [shrinking, 0, 1]])


@pytest.mark.parametrize("shrinking", [0.15, 0.25])
@lenses
def test_a_strongly_foreshortened_board_is_found_whole(shrinking, k):
    pose = slanted(shrinking)
    grid = find_checkerboard(rendered(squares, pose, k))
    assert grid is not None
    assert grid.shape == (ROWS, COLUMNS, 2)
    assert rms(grid - seen(pose, k, nodes())) < 0.15


def test_foreshortened_dots_are_found_as_far_as_they_are_alike():
    """Those of the two columns nearest to the camera are much larger than others, and so no spots."""
    found = find_dots(rendered(dots, slanted(0.2)))
    assert found is not None
    assert found.shape == (ROWS, COLUMNS - 2, 2)
    assert rms(found - mapped(slanted(0.2), nodes())[:, 2:]) < 0.3


@pytest.mark.parametrize(("columns", "found"), [(0, True), (COLUMNS - 1, False)])
def test_a_grid_that_hangs_together_by_few_edges_is_no_board(columns, found):
    """Rows of corners, of which edges join one column only: as on stairs by chance."""
    image = rendered(squares, SQUARE).astype(float)
    y, x = np.indices(image.shape)
    for middle in mapped(SQUARE, nodes()[:-1] + np.array([0, 0.5]))[:, :columns].reshape(-1, 2):
        faded = np.exp(-(((x - middle[0]) / 9) ** 4) - ((y - middle[1]) / 6) ** 4)
        image += faded * (125 - image)
    assert (grown_board(np.rint(image).astype(np.uint8)) is not None) == found


def charuco(ratio):
    """Like `squares`, with a marker of so much of its side in each white square."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250)
    board = cv2.aruco.CharucoBoard((COLUMNS + 1, ROWS + 1), 1.0, ratio, dictionary)
    side = 120  # pixels of a square: each bit of a marker has whole ones
    image = board.generateImage(((COLUMNS + 1) * side, (ROWS + 1) * side), marginSize=0)

    def pattern(places):
        i, j = np.moveaxis(np.floor((places + 1) * side).astype(int), -1, 0)
        inside = (i >= 0) & (j >= 0) & (i < image.shape[1]) & (j < image.shape[0])
        shown = image[np.clip(j, 0, image.shape[0] - 1), np.clip(i, 0, image.shape[1] - 1)] / 255
        return np.where(inside, shown, 1.0)

    return pattern


@pytest.mark.parametrize("ratio", [0.5, 0.75])
@lenses
@pytest.mark.parametrize("pose", [OBLIQUE, PARTLY["corner"]], ids=["whole", "partly"])
def test_boards_with_markers_are_found_without_their_dictionary(pose, k, ratio):
    """ChArUco boards: corners of squares, and none of markers."""
    grid = find_checkerboard(rendered(charuco(ratio), pose, k))
    assert grid is not None
    truth = np.nan_to_num(seen(pose, k, nodes()).reshape(-1, 2), nan=-1e6)
    depth = np.minimum(truth, np.subtract(SIZE, 1) - truth).min(axis=1)
    found = grid[np.isfinite(grid[..., 0])]
    assert len(found) >= 0.9 * (depth > 8).sum()
    assert rms(found - matched(found, truth)) < 0.15


def test_hidden_corners_are_nan_and_the_board_grows_around_them():
    image = rendered(squares, OBLIQUE)
    truth = mapped(OBLIQUE, nodes())
    hidden = truth[2:5, 4:6].reshape(-1, 2)
    middle = tuple(np.rint(hidden.mean(axis=0)).astype(int).tolist())
    covered = cv2.circle(image, middle, 50, 128, -1)
    grid = find_checkerboard(covered)
    assert grid.shape == (ROWS, COLUMNS, 2)
    far = np.linalg.norm(truth - middle, axis=-1)
    assert np.isnan(grid[far < 48]).all()
    assert np.isfinite(grid[far > 60]).all()
    assert rms((grid - truth)[far > 60]) < 0.1


def test_no_corner_is_passed_over(data):
    """A board of which OpenCV's search skips columns, and one whose last row is outside in part."""
    for name, least in (("calibration1", 47), ("calibration5", 53)):
        grid = find_checkerboard(cv2.imread(str(data / "wide" / "board" / f"{name}.jpg")))
        assert grid.shape == (6, 9, 2)
        assert np.isfinite(grid[..., 0]).sum() >= least
        for rest in (np.diff(grid, n=2, axis=0), np.diff(grid, n=2, axis=1)):
            assert np.nanmax(abs(rest)) < 20  # px: steps are 80 to 130, and change slowly


@pytest.mark.parametrize("bright", [False, True])
@lenses
@poses
def test_dots_are_found_where_they_are(pose, k, bright):
    image = rendered(dots, pose, k)
    found = find_dots(255 - image if bright else image)
    assert found is not None
    assert found.shape == (ROWS, COLUMNS, 2)
    assert rms(found - seen(pose, k, nodes())) < 0.05


@pytest.mark.parametrize(("pattern", "find"), [(squares, find_checkerboard), (dots, find_dots)])
def test_noise_and_uneven_light_move_nodes_little(pattern, find, rng):
    image = rendered(pattern, OBLIQUE) * np.linspace(0.5, 1, SIZE[0])
    image = image + 3 * rng.standard_normal(image.shape)
    found = find(np.clip(np.rint(image), 0, 255).astype(np.uint8))
    assert found.shape == (ROWS, COLUMNS, 2)
    assert rms(found - mapped(OBLIQUE, nodes())) < 0.15


@pytest.mark.parametrize("turns", range(4))
def test_rows_of_dots_run_to_the_right_and_columns_down_however_the_image_is_turned(turns):
    image = np.ascontiguousarray(np.rot90(rendered(dots, OBLIQUE), turns))
    grid = zj.detect.GridDetector().find(image)
    assert grid.shape[:2] == ((ROWS, COLUMNS) if turns % 2 == 0 else (COLUMNS, ROWS))
    assert (np.diff(grid[..., 0], axis=1) > 0).all()
    assert (np.diff(grid[..., 1], axis=0) > 0).all()


def turned_back(points, size):
    """Where points of an image turned by a quarter (`np.rot90`) were in the image, of this size."""
    return np.stack([size[0] - 1 - points[..., 1], points[..., 0]], axis=-1)


@pytest.mark.parametrize("turns", range(4))
@pytest.mark.parametrize("first", [0, 1])
def test_corners_of_a_board_are_the_same_ones_however_the_image_is_turned(turns, first):
    """Of odd by even corners: the first square is dark. Seen on its side, rows are columns."""
    image = rendered(lambda places: abs(first - squares(places)), OBLIQUE)
    upright = find_checkerboard(image)
    found = find_checkerboard(np.ascontiguousarray(np.rot90(image, turns)))
    for turn in range(turns):  # the last of the turns first
        found = turned_back(found, SIZE if (turns - turn) % 2 else SIZE[::-1])
    if turns % 2:
        assert found.shape[:2] == (COLUMNS, ROWS)
        found = np.rot90(found, 1 if ROWS % 2 == 0 else 3)
    np.testing.assert_allclose(found, upright, atol=0.1)
    middle = (upright[0, 0] + upright[1, 1]) / 2
    assert image[tuple(np.rint(middle[::-1]).astype(int))] < 100


@pytest.mark.parametrize("pattern", [squares, dots])
def test_every_row_and_column_is_a_line_in_order(pattern):
    lines = zj.detect.GridDetector()(rendered(pattern, OBLIQUE))
    assert [len(line) for line in lines] == [COLUMNS] * ROWS + [ROWS] * COLUMNS
    truth = mapped(OBLIQUE, nodes())
    for line, expected in zip(lines, [*truth, *truth.swapaxes(0, 1)], strict=True):
        assert line.dtype == np.float64
        np.testing.assert_allclose(line, expected, atol=0.2)


@pytest.mark.slow
def test_the_lines_of_several_images_give_back_their_lens():
    """The whole way: images, lines, fit."""
    k = LENSES["barrel"]
    found = [zj.detect.GridDetector()(rendered(dots, pose, k)) for pose in (SQUARE, OBLIQUE)]
    lines = zj.Lines.from_ragged(
        [line for image in found for line in image],
        np.repeat([0, 0], [len(image) for image in found]),
        [50.0],
        image_size=SIZE,
    )
    fitted = zj.fit_zoom(lines, zoom=zj.PolynomialZoom(degree=0)).lens(50.0)
    corners = np.array([[0.0, 0.0], [399.0, 0.0], [200.0, 20.0]])
    np.testing.assert_allclose(fitted.undistort(corners), lens(k).undistort(corners), atol=0.3)


def test_absent_dots_are_nan_and_left_out_of_their_lines():
    absent = [(2, 3), (5, 10), (0, 6)]
    image = rendered(lambda places: dots(places, absent=absent), OBLIQUE)
    grid = zj.detect.GridDetector().find(image)
    np.testing.assert_array_equal(np.argwhere(np.isnan(grid[..., 0])), sorted(absent))
    assert rms(grid - mapped(OBLIQUE, nodes())) < 0.05
    lengths = [len(line) for line in zj.detect.GridDetector()(image)]
    assert lengths[:ROWS] == [10, 11, 10, 11, 11, 10, 11, 11]
    assert sum(lengths) == 2 * (ROWS * COLUMNS - 3)


def test_dots_cut_by_the_images_edge_do_not_count():
    """A part of a dot has its centroid elsewhere."""
    endless = rendered(
        lambda places: 1.0 * (np.hypot(*np.moveaxis(places % 1 - 0.5, -1, 0)) > 0.25), SQUARE
    )
    grid = find_dots(endless)
    exact = (grid - SQUARE[:2, 2]) / 28 - 0.5
    assert grid.shape[:2] == (10, 13)
    np.testing.assert_allclose(exact, np.rint(exact), atol=0.01)


def test_corners_found_only_in_a_smaller_image_are_where_they_are(monkeypatch):
    search = module._search
    monkeypatch.setattr(module, "_SCALES", (0.75,))
    monkeypatch.setattr(module, "grown_board", lambda grey: None)
    monkeypatch.setattr(
        module, "_search", lambda grey, size, flags: search(grey, size, flags) if flags else None
    )
    found = find_checkerboard(rendered(squares, OBLIQUE))
    error = found - mapped(OBLIQUE, nodes())
    assert rms(error) < 0.15
    assert abs(error.mean(axis=(0, 1))).max() < 0.03  # half a pixel of either image would be 0.17


def test_corners_found_in_a_smaller_image_are_sharpened_in_the_full_one(monkeypatch):
    full = find_checkerboard(rendered(squares, OBLIQUE))
    monkeypatch.setattr(module, "_SCALES", (0.75,))
    monkeypatch.setattr(module, "grown_board", lambda grey: None)
    np.testing.assert_allclose(find_checkerboard(rendered(squares, OBLIQUE)), full, atol=1e-3)


@pytest.mark.parametrize("pattern", [squares, dots])
def test_colour_is_grey_in_three_channels(pattern):
    image = rendered(pattern, OBLIQUE)
    colour = zj.detect.GridDetector()(np.repeat(image[..., None], 3, axis=2))
    for line, same in zip(zj.detect.GridDetector()(image), colour, strict=True):
        np.testing.assert_array_equal(line, same)


@pytest.mark.parametrize(("pattern", "find"), [(squares, find_checkerboard), (dots, find_dots)])
def test_nodes_of_large_images_are_where_they_are(pattern, find):
    """They are searched at a smaller size."""
    image = rendered(pattern, OBLIQUE)
    large = cv2.resize(image, None, fx=6, fy=6, interpolation=cv2.INTER_LINEAR)
    found = find(large)
    assert found.shape == (ROWS, COLUMNS, 2)
    assert rms((found + 0.5) / 6 - 0.5 - mapped(OBLIQUE, nodes())) < 0.05


def test_dots_are_searched_for_unless_a_board_is_whole(monkeypatch):
    monkeypatch.setattr(module, "find_dots", lambda grey: pytest.fail("dots were searched for"))
    image = rendered(squares, OBLIQUE)
    np.testing.assert_array_equal(zj.detect.GridDetector().find(image), find_checkerboard(image))
    other = nodes(20, 20)
    monkeypatch.setattr(module, "find_dots", lambda grey: other)
    hidden = image.copy()
    hidden[120:170, 170:230] = 220
    np.testing.assert_array_equal(zj.detect.GridDetector().find(hidden), other)


def test_strided_views_are_read_as_they_are():
    image = rendered(dots, OBLIQUE)
    wide = np.repeat(image, 2, axis=1)
    np.testing.assert_array_equal(find_dots(wide[:, ::2]), find_dots(image))


def nothing(rng):
    yield np.full((300, 400), 127, np.uint8)
    yield np.zeros((300, 400, 3), np.uint8)
    yield rng.integers(0, 256, (300, 400)).astype(np.uint8)
    yield cv2.GaussianBlur(rng.integers(0, 256, (300, 400)).astype(np.uint8), (0, 0), 3)
    yield np.full((1, 1), 9, np.uint8)
    yield rng.integers(0, 256, (5, 7)).astype(np.uint8)
    yield cv2.circle(np.zeros((300, 400), np.uint8), (200, 150), 40, 255, -1)


def test_images_without_a_grid_give_no_lines(rng):
    for image in nothing(rng):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert zj.detect.GridDetector()(image) == []


def test_scattered_spots_are_no_grid(rng):
    image = np.full((300, 400), 220, np.uint8)
    for x, y in rng.uniform((10, 10), (390, 290), (150, 2)).astype(int):
        cv2.circle(image, (int(x), int(y)), 4, 30, -1)
    assert zj.detect.GridDetector()(image) == []


def test_grids_smaller_than_asked_do_not_count():
    image = rendered(squares, OBLIQUE)
    assert len(zj.detect.GridDetector(fewest=ROWS)(image)) == ROWS + COLUMNS
    assert find_checkerboard(image) is not None
    assert zj.detect.GridDetector(fewest=ROWS + 1)(image) == []


@pytest.mark.parametrize("fewest", [2, 3.5, "four", True])
def test_wrong_setting_raises(fewest, unchecked):
    with pytest.raises(ValueError, match="fewest must be an integer of at least 3"):
        zj.detect.GridDetector(fewest=fewest)


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((30, 40), np.float32),
        np.zeros((30, 40, 4), np.uint8),
        np.zeros(30, np.uint8),
        np.zeros((0, 40), np.uint8),
    ],
    ids=["float", "four channels", "row", "empty"],
)
def test_other_images_raise(image, unchecked):
    with pytest.raises(ValueError, match="image must be uint8 of shape"):
        zj.detect.GridDetector()(image)


def test_a_detector_is_abstract_or_final():
    assert issubclass(zj.detect.GridDetector, zj.detect.AbstractDetector)
    with pytest.raises(TypeError, match="abstract"):
        zj.detect.AbstractDetector()
    assert issubclass(zj.detect.AbstractDetector, eqx.Module)


@pytest.mark.slow
def test_the_boards_of_a_real_zoom_camera_are_found(data):
    """Without being told their size; reference corners were found by another method."""
    with np.load(data / "zoomcam" / "corners_22x15.npz") as stored:
        reference = dict(zip(stored["name"].tolist(), stored["corners"].astype(float), strict=True))
    photos = sorted((data / "zoomcam").glob("zoom_*/*.png"))
    assert len(photos) == 30
    squared = []
    for path in photos:
        found = zj.detect.GridDetector().find(cv2.imread(str(path)))
        if found is not None and found.shape == (15, 22, 2):
            known = reference[path.name].reshape(-1, 2)
            offset = found.reshape(-1, 1, 2) - known[None]
            nearest = np.sum(offset**2, axis=-1).argmin(axis=1)
            assert len(set(nearest.tolist())) == 330
            squared.append(np.sum((found.reshape(-1, 2) - known[nearest]) ** 2, axis=-1))
    assert len(squared) >= 28
    assert np.sqrt(np.mean(squared)) < 0.35
    assert np.median(np.sqrt(squared)) < 0.2


@pytest.mark.slow
def test_a_real_grid_of_dots_is_found(data):
    image = cv2.imread(str(data / "line_patterns" / "dot_pattern_05.jpg"))
    grid = zj.detect.GridDetector().find(image)
    # 52 rows and 85 columns have whole dots; one corner of the image is covered.
    assert grid.shape[:2] == (52, 85)
    assert np.isfinite(grid[..., 0]).sum() > 4380
    for line in zj.detect.GridDetector()(image):
        if len(line) > 40:  # a parabola is what the lens leaves of a line
            middle = line - line.mean(axis=0)
            along, across = (middle @ np.linalg.svd(middle, full_matrices=False)[2].T).T
            rest = across - np.polyval(np.polyfit(along, across, 2), along)
            assert np.median(abs(rest)) < 0.05


@pytest.mark.slow
def test_football_shows_no_grid(data):
    frames = sorted((data / "broadcast_frames").glob("*.jpg"))[::5]
    assert len(frames) > 3
    assert all(zj.detect.GridDetector()(cv2.imread(str(path))) == [] for path in frames)
