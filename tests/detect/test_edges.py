"""Borders rendered with exact truth, and real boards and lines."""

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes
from zoomjax.detect._edge_points import _quantile, _slope

SIZE = (2144, 1424)


def true_positions(board, focal, axis):
    return board.magnification(focal) * board.edges(axis)


def matched(lines, lens, focal):
    """For each line the true border nearest to it, and its points' distances from there, px."""
    board, d = scenes.StripedBoard.before(lens), lens(focal)
    result = []
    for line in lines:
        corrected = np.asarray(d.undistort(jnp.asarray(line))) - np.asarray(d.centre)
        offers = []
        for axis in (0, 1):
            edges = true_positions(board, focal, axis)
            index = int(np.argmin(abs(edges - corrected[:, axis].mean())))
            offers.append(((axis, index), corrected[:, axis] - edges[index]))
        result.append(min(offers, key=lambda offer: np.mean(offer[1] ** 2)))
    return result


@pytest.mark.slow
@pytest.mark.parametrize(("blur", "noise", "within"), [(0.7, 0, 0.03), (0, 0, 0.03), (1, 5, 0.10)])
@pytest.mark.parametrize("focal", [20.56, 60.0])
def test_borders_are_found_where_they_are(focal, blur, noise, within):
    lens = scenes.nikkor_18_200(SIZE)
    photo = scenes.board_photo(lens, focal, blur=blur, noise=noise)
    found = matched(zj.EdgeDetector()(photo), lens, focal)
    errors = np.concatenate([error for _, error in found])
    assert max(np.sqrt(np.mean(error**2)) for _, error in found) < 0.3  # none is false
    assert np.sqrt(np.mean(errors**2)) < within
    assert abs(errors.mean()) < 0.005
    names = [name for name, _ in found]
    assert len(set(names)) == len(names)  # each once
    visible = scenes.board_lines(lens, np.array([focal]), spacing=8).to_ragged()
    long = [line for line in visible if np.hypot(*(line[-1] - line[0])) > min(SIZE) / 4]
    seen = {name for name, _ in matched(long, lens, focal)}
    assert len(seen & set(names)) >= 0.95 * len(seen)


def drawn(*shapes, size=(480, 360), ground=60, blur=0.8):
    """Anti-aliased shapes on a ground: 8 samples a pixel each way."""
    over = 8
    big = np.full((size[1] * over, size[0] * over), ground, np.uint8)
    for draw in shapes:
        draw(big, over)
    small = cv2.resize(big, size, interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(small, (0, 0), blur) if blur else small


def bar(corners, level=200):
    return lambda image, over: cv2.fillPoly(image, [np.rint(np.array(corners) * over).astype(int)], level)


def disc(centre, radius, level=120):
    return lambda image, over: cv2.circle(
        image, tuple(over * np.array(centre)), over * radius, level, -1, cv2.LINE_AA
    )


BARS = [
    bar([(40 + 60 * i, 15), (65 + 60 * i, 15), (75 + 60 * i, 345), (50 + 60 * i, 345)]) for i in range(6)
]


def sides(lines):
    """Those along the bars, without the rows of the bars' ends, if these were joined across the gaps."""
    assert sum(np.ptp(line[:, 0]) > np.ptp(line[:, 1]) for line in lines) in (0, 2)
    return [line for line in lines if np.ptp(line[:, 0]) < np.ptp(line[:, 1])]


def test_both_edges_of_a_stripe_are_lines():
    lines = sides(zj.EdgeDetector()(drawn(*BARS)))
    assert len(lines) == 12
    for line in lines:
        assert line.dtype == np.float64
        assert (np.diff(line[:, 1]) > 0).all() or (np.diff(line[:, 1]) < 0).all()


def test_a_negative_has_the_same_lines():
    image = drawn(*BARS)
    for line, same in zip(zj.EdgeDetector()(image), zj.EdgeDetector()(255 - image), strict=True):
        np.testing.assert_allclose(line, same, atol=0.02)


def test_what_covers_a_border_does_not_cut_it_in_two():
    image = drawn(*BARS, disc((180, 180), 40))
    lines = sides(zj.EdgeDetector()(image))
    assert len(lines) == 12
    covered = [line for line in lines if np.diff(line[:, 1]).max() > 40]
    assert len(covered) == 2


def test_circles_are_no_lines():
    """Of any radius for which a person would see an arc."""
    for radius in (20, 60, 130):
        lines = zj.EdgeDetector()(drawn(*BARS[:1], *BARS[5:], disc((245, 180), radius, 220)))
        for line in lines:
            assert abs(line[:, 0] - 245).min() > radius + 5 or np.ptp(line[:, 1]) > 300


def test_corners_end_lines():
    square = [(120, 60), (360, 60), (360, 300), (120, 300)]
    lines = zj.EdgeDetector()(drawn(bar(square)))
    assert len(lines) == 4
    for line in lines:
        assert np.ptp(line, axis=0).min() < 0.5
        assert 220 < np.ptp(line, axis=0).max() < 240.5


def squares(bloom=0.0):
    """A checkerboard of 12 x 9 squares, turned a little, bright ones larger by `bloom` px to each side."""
    over, step = 8, 36
    y, x = (np.indices((360 * over, 480 * over)) + 0.5) / over - 0.5
    u = (np.cos(0.1) * (x - 240) + np.sin(0.1) * (y - 180)) / step
    v = (-np.sin(0.1) * (x - 240) + np.cos(0.1) * (y - 180)) / step
    inside = (abs(u) < 6) & (abs(v) < 4.5)
    bright = np.where(inside, (np.floor(u) + np.floor(v + 0.5)) % 2, 1.0)
    if bloom:
        reach = 2 * round(bloom * over) + 1
        bright = cv2.dilate(bright, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach)))
    small = cv2.resize(bright, (480, 360), interpolation=cv2.INTER_AREA)
    return np.rint(30 + 190 * cv2.GaussianBlur(small, (0, 0), 0.8)).astype(np.uint8)


@pytest.mark.parametrize("bloom", [0.0, 0.5])
def test_rows_and_columns_of_a_checkerboard_are_whole_lines(bloom):
    """The contrast flips at every square, and bright squares may have grown."""
    lines = zj.EdgeDetector()(squares(bloom))
    u = [np.cos(0.1) * (line[:, 0] - 240) + np.sin(0.1) * (line[:, 1] - 180) for line in lines]
    v = [-np.sin(0.1) * (line[:, 0] - 240) + np.cos(0.1) * (line[:, 1] - 180) for line in lines]
    columns = [a.mean() for a, b in zip(u, v, strict=True) if np.ptp(b) > 0.8 * 9 * 36]
    rows = [b.mean() for a, b in zip(u, v, strict=True) if np.ptp(a) > 0.8 * 12 * 36]
    inner_columns, inner_rows = 36 * np.arange(-5, 6), 36 * (np.arange(-4, 4) + 0.5)
    np.testing.assert_allclose([c for c in np.sort(columns) if abs(c) < 190], inner_columns, atol=0.3)
    np.testing.assert_allclose([r for r in np.sort(rows) if abs(r) < 140], inner_rows, atol=0.3)


def test_images_without_borders_give_no_lines(rng):
    noise = rng.integers(0, 256, (200, 300)).astype(np.uint8)
    for image in (
        np.full((200, 300), 127, np.uint8),
        noise,
        cv2.GaussianBlur(noise, (0, 0), 4),
        np.tile(np.linspace(0, 255, 300).astype(np.uint8), (200, 1)),
    ):
        assert zj.EdgeDetector()(image) == []


def test_colour_is_grey_in_three_channels():
    image = drawn(*BARS)
    colour = zj.EdgeDetector()(np.repeat(image[..., None], 3, axis=2))
    for line, same in zip(zj.EdgeDetector()(image), colour, strict=True):
        np.testing.assert_allclose(line, same, atol=1e-9)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (None, "cannot read"),
        (np.zeros((100, 100), np.float32), "uint8"),
        (np.zeros((100, 100, 4), np.uint8), "shape"),
        (np.zeros((20, 100), np.uint8), "32 px"),
    ],
)
def test_other_images_raise(image, message, unchecked):
    with pytest.raises(ValueError, match=message):
        zj.EdgeDetector()(image)


@pytest.mark.parametrize("name", ["least_length", "least_cover"])
def test_settings_are_shares(name, unchecked):
    with pytest.raises(ValueError, match=f"{name} must be 0 to 1"):
        zj.EdgeDetector(**{name: 1.5})


def test_every_line_of_a_printed_grid_is_found_once(data):
    """Counted besides as changes from dark to bright along a column and a row between the bars."""
    image = cv2.imread(str(data / "line_patterns" / "line_pattern_01.jpg"), cv2.IMREAD_GRAYSCALE)
    lines = zj.EdgeDetector()(image)
    _, bright = cv2.threshold(cv2.GaussianBlur(image, (0, 0), 2), 0, 1, cv2.THRESH_OTSU)
    for axis in (0, 1):
        along = [line for line in lines if np.ptp(line[:, axis]) < np.ptp(line[:, 1 - axis])]
        middle = image.shape[axis] // 2
        # Between the bars, where most is bright.
        place = max(range(middle - 40, middle + 40), key=lambda p: bright.take(p, axis=axis).mean())
        changes = int(np.sum(np.diff(bright.take(place, axis=axis).astype(int)) != 0))
        crossing = [
            float(np.interp(place, *_sorted(line, 1 - axis)))
            for line in along
            if line[:, 1 - axis].min() < place < line[:, 1 - axis].max()
        ]
        assert abs(len(crossing) - changes) <= 2  # the outermost are cut by the image's border
        assert np.diff(np.sort(crossing)).min() > 4
        assert np.median([np.ptp(line[:, 1 - axis]) for line in along]) > 0.98 * image.shape[axis]


def _sorted(line, axis):
    order = np.argsort(line[:, axis])
    return line[order, axis], line[order, 1 - axis]


@pytest.mark.slow
def test_the_rows_and_columns_of_real_boards_are_found_whole(data):
    """Of a real zoom camera; the corners are a reference found by another method."""
    with np.load(data / "zoomcam" / "corners_22x15.npz") as stored:
        corners = dict(zip(stored["name"].tolist(), stored["corners"].astype(float), strict=True))
    cover = []
    for path in sorted((data / "zoomcam").glob("zoom_*/*.png"))[::3]:
        lines = zj.EdgeDetector()(cv2.imread(str(path)))
        grid = corners[path.name]
        for row in [*grid, *grid.swapaxes(0, 1)]:
            along = (row[-1] - row[0]) / np.hypot(*(row[-1] - row[0]))
            t, e = (row - row[0]) @ along, (row - row[0]) @ (-along[1], along[0])
            best = 0.0
            for line in lines:
                u, v = (line - row[0]) @ along, (line - row[0]) @ (-along[1], along[0])
                on = (u > 0) & (u < t[-1]) & (abs(v - np.interp(u, t, e)) < 3)
                if on.sum() > 0.9 * ((u > 0) & (u < t[-1])).sum() > 5:
                    best = max(best, np.ptp(u[on]) / t[-1])
            cover.append(best)
    assert np.mean(np.array(cover) > 0.85) > 0.9


def test_slopes_are_those_of_sobel(rng):
    """To the last digit: fractions for weights are only another way through OpenCV."""
    image = rng.integers(0, 256, (57, 83), np.uint8)
    for order in ((1, 0), (0, 1)):
        np.testing.assert_array_equal(_slope(image, *order), cv2.Sobel(image, cv2.CV_16S, *order, ksize=5))


@pytest.mark.parametrize("share", [0.25, 0.5, 0.995])
def test_quantiles_are_those_of_numpy(rng, share):
    for size in (70, 71, 1000):
        levels = rng.integers(0, 400, size, np.int16)
        assert _quantile(levels, share) == pytest.approx(np.quantile(levels, share), rel=1e-12)
