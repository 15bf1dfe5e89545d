"""Markings of pitches: rendered ones, whose middles are known, and broadcast frames labelled by hand."""

import itertools
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

import zoomjax as zj

GRASS, WHITE = (50, 145, 75), (225, 240, 232)
SIZE = (1280, 720)
FINER = 4

LABELS = json.loads(Path(__file__).with_name("pitch_labels.json").read_text())
NEAR = 3.0


class Scene:
    """A pitch drawn at four times the size, then averaged and made noisy."""

    def __init__(self, size=SIZE):
        self.large = np.full((FINER * size[1], FINER * size[0], 3), GRASS, np.uint8)

    def _at(self, point):
        """A position at the scale of the drawing, in units of 1/16 px."""
        return tuple(round(16 * ((value + 0.5) * FINER - 0.5)) for value in point)

    def line(self, start, end, width):
        """A marking whose middle runs between two positions."""
        along = np.subtract(end, start) / np.hypot(*np.subtract(end, start))
        aside = width / 2 * np.array([-along[1], along[0]])
        corners = [start + aside, end + aside, end - aside, start - aside]
        cv2.fillConvexPoly(self.large, np.array([self._at(c) for c in corners]), WHITE, cv2.LINE_AA, 4)

    def curve(self, points, width):
        """A marking along many positions."""
        for start, end in itertools.pairwise(points):
            self.line(np.array(start), np.array(end), width)

    def blob(self, middle, axes, colour):
        """An ellipse of one colour, as a player."""
        scaled = tuple(16 * FINER * axis for axis in axes)
        cv2.ellipse(self.large, self._at(middle), scaled, 0, 0, 360, colour, cv2.FILLED, cv2.LINE_AA, 4)

    def shot(self, rng, noise=4.0, blur=0.7):
        """The photograph."""
        small = cv2.resize(self.large, None, fx=1 / FINER, fy=1 / FINER, interpolation=cv2.INTER_AREA)
        small = cv2.GaussianBlur(small, (0, 0), blur).astype(float)
        return np.clip(np.rint(small + noise * rng.standard_normal(small.shape)), 0, 255).astype(np.uint8)


def ellipse(middle, axes, parts=400):
    """Points around an ellipse."""
    angle = np.linspace(0, 2 * np.pi, parts)
    return np.add(middle, np.stack([axes[0] * np.cos(angle), axes[1] * np.sin(angle)], axis=-1))


def across(points, start, end):
    """px from points to the straight line through two positions."""
    along = np.subtract(end, start) / np.hypot(*np.subtract(end, start))
    return (points - np.asarray(start)) @ np.array([-along[1], along[0]])


def extent(line):
    """px from end to end."""
    return np.hypot(*(line[-1] - line[0]))


@pytest.mark.parametrize("width", [3, 5, 8])
@pytest.mark.parametrize("angle", [0, 3, 30, 45, 60, 88, 135])
def test_points_are_in_the_middle_of_a_marking(rng, width, angle):
    way = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    start, end = np.array([640.3, 360.2]) - 300 * way, np.array([640.3, 360.2]) + 300 * way
    scene = Scene()
    scene.line(start, end, width)
    (line,) = zj.detect.PitchDetector()(scene.shot(rng))
    error = across(line, start, end)
    assert abs(error.mean()) < 0.05
    assert np.sqrt(np.mean(error**2)) < 0.2
    assert extent(line) > 580


def test_grass_of_two_brightnesses_does_not_move_a_marking(rng):
    scene = Scene()
    half = FINER * 360
    scene.large[:half] = np.array(GRASS) * 0.7
    scene.line(np.array([200, 359.5]), np.array([1100, 359.5]), 5)
    (line,) = zj.detect.PitchDetector()(scene.shot(rng))
    assert abs(np.mean(line[:, 1] - 359.5)) < 0.1


def test_a_marking_behind_a_player_is_one_line(rng):
    start, end = np.array([100.0, 200.0]), np.array([1200.0, 500.0])
    scene = Scene()
    scene.line(start, end, 5)
    scene.blob((650, 350), (18, 45), (30, 30, 200))
    (line,) = zj.detect.PitchDetector()(scene.shot(rng))
    assert extent(line) > 1100
    assert abs(across(line, start, end)).max() < 1
    assert not np.any(abs(line[:, 0] - 650) < 10)


@pytest.mark.parametrize("axes", [(90, 60), (300, 90), (500, 140), (620, 300)])
def test_circles_on_the_pitch_are_no_lines(rng, axes):
    scene = Scene()
    scene.curve(ellipse((640, 360), axes), 5)
    assert zj.detect.PitchDetector()(scene.shot(rng)) == []


def test_a_line_through_a_circle_is_found_whole(rng):
    start, end = np.array([600.0, 30.0]), np.array([690.0, 690.0])
    scene = Scene()
    scene.curve(ellipse((645, 360), (300, 110)), 5)
    scene.line(start, end, 5)
    (line,) = zj.detect.PitchDetector()(scene.shot(rng))
    assert extent(line) > 620
    assert abs(across(line, start, end)).max() < 1


def test_lines_bent_by_a_lens_are_found(rng):
    x = np.linspace(100, 1180, 200)
    y = 150 - 20 * (1 - ((x - 640) / 540) ** 2)
    scene = Scene()
    scene.curve(np.stack([x, y], axis=-1), 5)
    (line,) = zj.detect.PitchDetector()(scene.shot(rng))
    error = line[:, 1] - (150 - 20 * (1 - ((line[:, 0] - 640) / 540) ** 2))
    assert np.sqrt(np.mean(error**2)) < 0.2


def test_what_is_not_on_grass_is_no_marking(rng):
    scene = Scene()
    scene.large[: FINER * 200] = (120, 60, 40)
    scene.line(np.array([100, 100]), np.array([1100, 120]), 5)  # on a board
    scene.line(np.array([100, 200]), np.array([1100, 200]), 6)  # the board's lower border
    scene.line(np.array([100.0, 400.0]), np.array([1100.0, 420.0]), 5)
    (line,) = zj.detect.PitchDetector()(scene.shot(rng))
    assert abs(across(line, (100, 400), (1100, 420))).max() < 1


def test_coloured_lines_and_wide_ones_are_no_markings(rng):
    scene = Scene()
    scene.line(np.array([100, 500]), np.array([1100, 600]), 40)
    shot = scene.shot(rng, noise=0)
    cv2.line(shot, (100, 200), (1100, 260), (60, 220, 230), 5, cv2.LINE_AA)
    assert zj.detect.PitchDetector()(shot) == []


def test_least_length_is_a_share_of_the_diagonal(rng):
    scene = Scene()
    scene.line(np.array([300, 300]), np.array([500, 320]), 5)  # 0.137 of the diagonal
    shot = scene.shot(rng)
    assert len(zj.detect.PitchDetector(least_length=0.12)(shot)) == 1
    assert zj.detect.PitchDetector(least_length=0.15)(shot) == []


def test_the_longest_line_comes_first(rng):
    scene = Scene()
    scene.line(np.array([100, 600]), np.array([500, 640]), 5)
    scene.line(np.array([100, 100]), np.array([1100, 300]), 5)
    lines = zj.detect.PitchDetector()(scene.shot(rng))
    assert [line.dtype for line in lines] == [np.float64, np.float64]
    assert extent(lines[0]) > extent(lines[1])


def test_an_image_without_grass_has_no_markings(rng):
    assert zj.detect.PitchDetector()(rng.integers(0, 256, (360, 640, 3), np.uint8)) == []
    assert zj.detect.PitchDetector()(np.zeros((360, 640, 3), np.uint8)) == []
    assert zj.detect.PitchDetector()(np.full((360, 640, 3), 255, np.uint8)) == []


def test_bare_grass_has_no_markings(rng):
    assert zj.detect.PitchDetector()(Scene().shot(rng, noise=12)) == []


@pytest.mark.parametrize("size", [(32, 32), (33, 500), (500, 33)])
def test_small_images_are_taken(size):
    assert zj.detect.PitchDetector()(np.full((*size[::-1], 3), GRASS, np.uint8)) == []


def test_a_grey_image_is_refused(unchecked):
    with pytest.raises(ValueError, match="colour image"):
        zj.detect.PitchDetector()(np.zeros((360, 640), np.uint8))


@pytest.mark.parametrize("image", [None, np.zeros((360, 640, 3)), np.zeros((360, 640, 4), np.uint8)])
def test_what_is_no_image_is_refused(unchecked, image):
    with pytest.raises(ValueError, match="Argument image"):
        zj.detect.PitchDetector()(image)


@pytest.mark.parametrize("share", [-0.1, 1.1])
def test_a_length_that_is_no_share_is_refused(share):
    with pytest.raises(ValueError, match="least_length"):
        zj.detect.PitchDetector(least_length=share)


def sampled(lines):
    """Points along polylines, every half px."""
    parts = []
    for line in lines:
        for start, end in itertools.pairwise(np.array(line)):
            number = max(int(2 * np.hypot(*(end - start))), 1)
            parts.append(start + (end - start) * np.arange(number)[:, None] / number)
    return np.concatenate(parts)


def is_near(points, others):
    """Whether points are within 3 px of one of others."""
    return cKDTree(others).query(points)[0] <= NEAR


@pytest.fixture(scope="module")
def found(data):
    """For each labelled frame the lines found."""
    detector = zj.detect.PitchDetector()
    folder = data / "broadcast_frames"
    return {name: detector(cv2.imread(str(folder / f"{name}.jpg"))) for name in LABELS}


@pytest.mark.parametrize("name", LABELS)
def test_markings_of_broadcast_frames_are_found(found, name):
    points = np.concatenate(found[name])
    label = sampled(LABELS[name]["lines"])
    assert np.mean(is_near(label, points)) >= 0.8
    steps = [np.minimum(np.hypot(*np.diff(line, axis=0, append=line[-1:]).T), NEAR) for line in found[name]]
    right = is_near(points, label)
    assert np.average(right, weights=np.concatenate(steps)) >= 0.95


@pytest.mark.parametrize("name", LABELS)
def test_arcs_of_broadcast_frames_are_not_found(found, name):
    arcs, label = sampled(LABELS[name]["arcs"]), sampled(LABELS[name]["lines"])
    for line in found[name]:
        assert np.mean(is_near(line, arcs) & ~is_near(line, label)) < 0.05
