"""Which pieces of edges become one line, and which stay apart: pieces made by hand, with exact places."""

import dataclasses

import cv2
import numpy as np
import pytest

from zoomjax.detect._collinear import _checked, collinear, thin_bars
from zoomjax.detect._edge_points import edge_points
from zoomjax.detect._frame_model import OneFrame
from zoomjax.detect._joining import border_lines
from zoomjax.detect._segments import Fragments, fragments
from zoomjax.detect._units import units_of

SIZE = (1200, 800)
STRAIGHT = OneFrame.of_values(SIZE, (0.0, 0.0, 0.0, 0.0))
EXACT = 0.15
"""px by which lines may be bent."""


@dataclasses.dataclass(frozen=True)
class Piece:
    """A level piece of an edge from x to x, brighter below (+1) or above, with a contrast."""

    low: float
    high: float
    y: float = 400.0
    side: int = 1
    contrast: float = 100.0

    def points(self):
        x = np.arange(self.low, self.high + 1)
        return np.stack([x, np.full_like(x, self.y)], axis=1)


def lines(*pieces, sigma=EXACT):
    """The number of the line of each piece."""
    points = [piece.points() for piece in pieces]
    gradient = [
        np.tile([0.0, of.side * of.contrast], (len(p), 1)) for of, p in zip(pieces, points, strict=True)
    ]
    made = Fragments.of(
        np.concatenate(points), np.concatenate(gradient), np.array([len(p) for p in points])
    )
    return collinear(made, STRAIGHT, sigma, thin_bars(made)).tolist()


def are_one(*pieces, sigma=EXACT):
    return len(set(lines(*pieces, sigma=sigma))) == 1


def test_pieces_of_one_edge_join_from_end_to_end():
    assert are_one(Piece(100, 200), Piece(230, 330), Piece(360, 460))


@pytest.mark.parametrize(("visible", "gap", "joins"), [(40, 70, True), (40, 95, False), (250, 95, True)])
def test_a_longer_gap_needs_longer_pieces(visible, gap, joins):
    assert are_one(Piece(100, 100 + visible), Piece(100 + visible + gap, 100 + 2 * visible + gap)) == joins


@pytest.mark.parametrize(("gap", "joins"), [(8, True), (40, False)])
def test_another_side_is_brighter_only_where_pieces_touch(gap, joins):
    """As at the corners of a checkerboard; farther off it is the edge of another thing."""
    assert are_one(Piece(100, 200), Piece(200 + gap, 300 + gap, side=-1)) == joins
    assert are_one(Piece(100, 200), Piece(200 + gap, 300 + gap))


@pytest.mark.parametrize(("aside", "joins"), [(0.8, True), (2.4, False)])
def test_another_side_is_brighter_only_without_a_jump(aside, joins):
    """However far lines may be bent: the two edges of the thinnest bar are that far apart."""
    pieces = Piece(100, 200), Piece(208, 308, y=400 + aside, side=-1)
    assert are_one(*pieces, sigma=0.6) == joins


@pytest.mark.parametrize(("thick", "joins"), [(3.0, False), (9.0, True)])
def test_an_edge_of_a_thin_bar_goes_on_as_that_edge(thick, joins):
    """The upper edge of a bar meets the lower one, beside which the upper one begins again farther off."""
    pieces = Piece(100, 200), Piece(208, 408, y=401.0, side=-1), Piece(212, 408, y=401 - thick)
    label = lines(*pieces, sigma=0.6)
    assert (label[0] == label[1]) == joins


def test_edges_of_a_rendered_bar_stay_apart_at_a_crossing():
    """A dark bar of 2 px: left of the crossing it is as dark below, and has an upper edge alone.

    Right of it something dark stands above, so that the upper edge begins again after the lower one.
    """
    over = 8
    y, x = (np.indices((100 * over, 400 * over)) + 0.5) / over - 0.5
    photo = np.full(y.shape, 160.0)
    photo[(abs(x - 200) < 180) & (abs(y - 51) < 1)] = 100
    photo[(abs(x - 110) < 90) & (abs(y - 65) < 15)] = 100
    photo[(abs(x - 210) < 9) & (abs(y - 35) < 17)] = 100
    photo = cv2.GaussianBlur(cv2.resize(photo, (400, 100), interpolation=cv2.INTER_AREA), (0, 0), 0.7)
    pieces = fragments(edge_points(np.rint(photo).astype(np.uint8)))
    label = collinear(pieces, OneFrame((400, 100)), 0.6, thin_bars(pieces))
    for line in border_lines(pieces, label):
        along = line[abs(line[:, 1] - 51) < 4]
        assert len(along) == 0 or np.ptp(along[:, 1]) < 1.5


@pytest.mark.parametrize(("ratio", "joins"), [(3.0, True), (6.0, False)])
def test_neighbours_have_like_contrast(ratio, joins):
    assert are_one(Piece(100, 200), Piece(230, 330, contrast=100 * ratio)) == joins
    assert are_one(Piece(100, 200), Piece(230, 330, contrast=100 / ratio)) == joins


@pytest.mark.parametrize(("aside", "joins"), [(0.3, True), (2.5, False)])
def test_a_piece_beside_the_line_is_none_of_it(aside, joins):
    assert are_one(Piece(100, 300), Piece(330, 530, y=400 + aside)) == joins


@pytest.mark.parametrize("thick", [2.0, 3.0, 6.0])
def test_both_edges_of_a_thin_bar_stay_two_lines(thick):
    """Each broken where something stands before it: an upper piece goes on as an upper one."""
    upper = [Piece(100, 300), Piece(330, 530)]
    lower = [Piece(100, 300, 400 + thick, -1), Piece(330, 530, 400 + thick, -1)]
    label = lines(*upper, *lower)
    assert label[0] == label[1] != label[2] == label[3]


def test_edges_beside_each_other_stay_two_lines_whatever_their_sides():
    label = lines(Piece(100, 500), Piece(150, 450, y=401.0))
    assert label[0] != label[1]


def test_a_piece_belongs_to_one_line():
    """Of two lines that could take it, the nearer end does."""
    label = lines(Piece(100, 300), Piece(320, 400), Piece(450, 650, y=400.4), Piece(450, 650, y=404.0))
    assert label[0] == label[1] == label[2] != label[3]


def kept(*pieces):
    """Which pieces of a line stay in it when each is left out in turn."""
    points = [piece.points() for piece in pieces]
    gradient = np.tile([0.0, 100.0], (sum(map(len, points)), 1))
    made = Fragments.of(np.concatenate(points), gradient, np.array([len(p) for p in points]))
    units = units_of(made, STRAIGHT, thin_bars(made))
    return (_checked(units, np.zeros(len(pieces), int), EXACT) >= 0).tolist()


@pytest.mark.parametrize(("aside", "stays"), [(0.2, True), (3.0, False)])
def test_a_piece_that_the_rest_does_not_predict_leaves_its_line(aside, stays):
    assert kept(Piece(100, 500), Piece(520, 900), Piece(920, 935, y=400 + aside)) == [True, True, stays]


def test_a_long_wrong_piece_leaves_its_line_and_the_others_stay():
    """Though all others are off any line with it."""
    right = [Piece(low, low + 60) for low in (100, 180, 260, 340, 420)]
    assert kept(*right, Piece(500, 720, y=406)) == [True] * 5 + [False]


def test_of_several_wrong_pieces_each_leaves_its_line():
    right = [Piece(low, low + 60) for low in (100, 180, 260, 340, 420)]
    assert kept(*right, Piece(500, 530, y=404), Piece(540, 600, y=395)) == [True] * 5 + [False] * 2


def test_of_two_pieces_the_longer_one_stays():
    assert kept(Piece(100, 200), Piece(220, 260, y=406)) == [True, False]
