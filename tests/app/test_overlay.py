"""Lines drawn over images."""

import numpy as np
import pytest

from zoomjax.app.overlay import colour, draw_lines, for_picture
from zoomjax.detect.sources import shrunk

LINE = np.stack([np.full(80, 30.0), np.arange(10.0, 90.0)], axis=-1)


def test_a_line_is_drawn_where_it_is_in_a_colour():
    image = np.full((100, 100), 200, np.uint8)
    picture = draw_lines(image, [LINE], [False])
    coloured = np.ptp(picture.astype(int), axis=2) > 60
    assert coloured[15:85, 30].all()
    assert not coloured[:, :28].any()
    assert not coloured[:, 33:].any()
    assert image.min() == 200


@pytest.mark.parametrize("points", [2, 3, 5000])
def test_a_bent_line_is_drawn_along_all_its_points(points):
    image = np.zeros((600, 800, 3), np.uint8)
    along = np.linspace(0, 1, points)
    bent = np.stack([30 + 700 * along, 100 + 300 * along**2], axis=1)
    y, x = np.nonzero(draw_lines(image, [bent], [False]).any(axis=2))
    if points > 3:
        assert abs(y - 100 - 300 * ((x - 30) / 700) ** 2).max() < 2.5
    assert abs(x.min() - 30) <= 2
    assert abs(x.max() - 730) <= 2


def test_rejected_lines_are_dashed_and_red():
    picture = draw_lines(np.zeros((100, 100, 3), np.uint8), [LINE], [True]).astype(int)
    red = (picture[..., 2] > 150) & (picture[..., 0] < 100)
    assert 0.3 < red[15:85, 30].mean() < 0.8


@pytest.mark.parametrize("points", [2, 5, 22, 700])
def test_dashes_go_from_end_to_end_however_many_points_there_are(points):
    line = np.stack([np.linspace(20, 620, points), np.full(points, 50.0)], axis=1)
    row = draw_lines(np.zeros((100, 640), np.uint8), [line], [True])[50, :, 2] > 0
    assert row[20:40].any()
    assert row[600:622].any()
    assert 0.4 < row[20:621].mean() < 0.7
    assert (np.diff(row[20:621].astype(int)) == 1).sum() > 10


def test_lines_are_coloured_by_how_far_they_are_from_straight():
    lines = [LINE + np.array([20.0 * i, 0]) for i in range(3)]
    picture = draw_lines(np.zeros((100, 100), np.uint8), lines, [False] * 3, rms=[0.0, 0.5, 9.0], limit=1.0)
    blue, _, red = np.moveaxis(picture[50, [30, 50, 70]].astype(int), -1, 0)
    assert blue[0] > blue[1] > blue[2]
    assert red[0] < red[1] < red[2]
    assert (colour(0.0), colour(9.0)) == ((255, 200, 0), (0, 120, 255))


def test_numbers_are_written_and_a_legend_is_added():
    image = np.zeros((300, 400, 3), np.uint8)
    line = LINE + np.array([170.0, 100.0])
    bare = draw_lines(image, [line], [False])
    picture = draw_lines(image, [line], [False], labels={0: "17"}, legend=True)
    assert picture.shape[0] > 300
    assert picture.shape[1] == 400
    rows, columns = np.nonzero((picture[:300] != bare).any(axis=-1))
    assert 100 < rows.mean() < 200
    assert 170 < columns.mean() < 230


def test_numbers_of_lines_beside_each_other_do_not_cover_each_other():
    """Whichever lines are numbered: here the first and the fourth of those drawn."""
    image = np.zeros((300, 400, 3), np.uint8)
    lines = [np.stack([np.full(280, 200.0 + n), np.arange(10.0, 290)], axis=-1) for n in range(4)]
    bare = draw_lines(image, lines, [False] * 4)
    written = [
        (draw_lines(image, lines, [False] * 4, labels=labels) != bare).any(axis=(1, 2)).sum()
        for labels in ({0: "41"}, {0: "41", 3: "102"})
    ]
    assert written[1] >= 1.9 * written[0]


@pytest.mark.parametrize("shape", [(3000, 4000), (4000, 3000, 3)])
def test_large_images_are_made_smaller_with_their_lines(shape):
    image = np.zeros(shape, np.uint8)
    line = np.stack([np.full(2500, 999.5), np.arange(2500.0)], axis=-1)
    picture = draw_lines(image, [line], [False])
    assert max(picture.shape) == 2000
    found = np.flatnonzero(picture[100].max(axis=1) > 60)
    assert found.mean() == pytest.approx(499.5, abs=0.5)


def test_an_image_without_lines_is_only_dimmed():
    picture = draw_lines(np.full((20, 30), 100, np.uint8), [], [])
    assert (picture == 55).all()


@pytest.mark.parametrize("size", [(1424, 2144), (1424, 2143), (500, 300), (2848, 4288, 3), (4096, 1024)])
def test_pictures_are_as_large_as_asked_and_show_the_same(size):
    tall, wide = size[:2]
    rows, columns = np.indices((tall, wide))
    image = np.rint(120 + 100 * np.sin(rows / tall * 9) * np.cos(columns / wide * 7)).astype(np.uint8)
    image = np.stack([image] * size[2], axis=-1) if len(size) > 2 else image
    picture, scale = for_picture(image, 600)
    plain, expected = shrunk(image, 600)
    assert scale == pytest.approx(expected, rel=1e-12)
    assert picture.shape == plain.shape
    assert np.abs(picture.astype(int) - plain).max() <= 2
