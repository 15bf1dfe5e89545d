"""Focal lengths from football pitches: exact views, names, and the annotations of real broadcasts."""

import json

import cv2
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.focal.pitch import PITCH_LINES

PRINCIPAL = np.array([639.5, 359.5])
LEFT = [name for name in PITCH_LINES if "left" in name] + ["Side line top"]
CAMERA = np.array([-1.0, 70.0, -13.0])
"""In the stands, 70 m from the middle of the pitch and 13 m above it; z points downwards."""


def seen(focal=3000.0, names=LEFT, pan=-0.3, tilt=1.4, number=5):
    """Points on the lines as a broadcast camera sees them, px, corrected."""
    turn = cv2.Rodrigues(np.array([tilt, 0.0, 0.0]))[0].T @ cv2.Rodrigues(np.array([0.0, 0.0, pan]))[0].T
    annotations = {}
    for name in names:
        places = np.c_[np.linspace(*PITCH_LINES[name], number), np.zeros(number)]
        placed = (places - CAMERA) @ turn.T
        annotations[name] = focal * placed[:, :2] / placed[:, 2:] + PRINCIPAL
    return annotations


def from_pitch(annotations):
    return zj.focal.focal_from_pitch(annotations, principal=PRINCIPAL)


def test_the_markings_are_those_of_the_laws_of_the_game():
    assert len(PITCH_LINES) == 17
    ends = {name: np.array(line) for name, line in PITCH_LINES.items()}
    length = {name: np.linalg.norm(line[1] - line[0]) for name, line in ends.items()}
    for name, side in {
        **{"Side line top": 105.0, "Side line left": 68.0, "Middle line": 68.0},
        **{"Big rect. left main": 40.32, "Big rect. right top": 16.5},
        **{"Small rect. right main": 18.32, "Small rect. left bottom": 5.5},
    }.items():
        assert length[name] == pytest.approx(side), name
    for name, line in ends.items():
        other = ends[name.replace("left", "right")] * [-1, 1]
        if "left" in name:
            assert sorted(other.tolist()) == sorted(line.tolist())
        if name.endswith("top"):
            assert (line[:, 1] < 0).all()


@pytest.mark.parametrize("focal", [1500.0, 3000.0, 5000.0])
def test_exact_views_give_their_focal_length(focal):
    estimate = from_pitch(seen(focal))
    np.testing.assert_allclose(estimate.focal, focal, rtol=1e-9)
    assert estimate.std < 1e-3
    assert estimate.rms < 1e-8


def test_one_call_compiles_for_all_pictures_alike(compilations):
    from_pitch(seen())
    compilations()
    from_pitch(seen(4000.0, LEFT[:5], number=7))
    assert compilations() == 0


def test_lists_will_do_and_unknown_names_are_left_out():
    known = from_pitch(seen())
    listed = {name: points.tolist() for name, points in seen().items()}
    more = {
        "Goal left crossbar": [[1.0, 2.0], [3.0, 4.0]],
        "Circle left": [[5.0, 6.0]] * 9,
        "Side line left": [],
    }
    other = {**more, **listed}
    assert from_pitch(other).focal == known.focal


def test_too_few_lines_are_nan_and_infinitely_uncertain():
    estimate = from_pitch(seen(names=["Middle line", "Side line top", "Side line left"]))
    assert np.isnan(estimate.focal)
    assert np.isposinf(estimate.std)


@pytest.mark.parametrize("annotations", [{}, {"Circle central": [[1.0, 2.0]]}])
def test_no_known_name_raises(annotations):
    with pytest.raises(ValueError, match=r"'Middle line'"):
        from_pitch(annotations)


@pytest.mark.parametrize(
    "points", [[1.0, 2.0], [[1.0, 2.0, 3.0]], [[1.0, np.nan]], [[1.0, 2.0], [3.0]], "px"]
)
def test_positions_must_be_pairs_of_numbers(points):
    with pytest.raises(ValueError, match=r"'Middle line' must be a"):
        from_pitch({**seen(), "Middle line": points})


# Real broadcasts.


@pytest.fixture(scope="module")
def frames(data):
    return list(json.loads((data / "pitch_lines" / "wc14_half.json").read_text()).values())


def test_focal_lengths_of_real_broadcasts(frames):
    """Beside those of another program, from the same frames."""
    estimates = [from_pitch(frame["lines"]) for frame in frames]
    focal = np.array([estimate.focal for estimate in estimates])
    ratio = focal / [frame["camera_pred"]["f_px"] for frame in frames]
    assert np.isfinite(ratio).mean() > 0.85
    assert np.nanmedian(ratio) == pytest.approx(1, abs=0.02)
    assert np.nanmedian(abs(ratio - np.nanmedian(ratio))) < 0.06
    few = [sum(name in PITCH_LINES for name in frame["lines"]) < 4 for frame in frames]
    assert np.isnan(focal[few]).all()
    assert np.nanmedian([estimate.rms for estimate in estimates]) < 1.5


def named(lines):
    return zj.focal.name_pitch_lines(lines, principal=PRINCIPAL, image_size=(1280, 720))


def in_image(annotations, rng, noise=0.5):
    """What is in the picture of at least 60 px, with noise, in any order."""
    lines = {}
    for name, points in annotations.items():
        points = points[np.all((points >= 0) & (points <= [1279, 719]), axis=1)]
        if len(points) > 2 and np.hypot(*np.ptp(points, axis=0)) > 60:
            lines[name] = points + noise * rng.standard_normal(points.shape)
    return {name: lines[name] for name in rng.permutation(list(lines)).tolist()}


@pytest.mark.parametrize("seed", range(24))
def test_lines_are_called_by_their_names_or_not_at_all(seed):
    rng = np.random.default_rng(seed)
    focal, pan, tilt = rng.uniform(1500, 5000), rng.uniform(-0.5, 0.5), rng.uniform(1.3, 1.42)
    names = [name for name in PITCH_LINES if rng.uniform() < 0.85]
    lines = in_image(seen(focal, names, pan=pan, tilt=tilt, number=200), rng)
    some = dict(named(list(lines.values())))
    for name, points in some.items():
        np.testing.assert_array_equal(points, lines[name])
    if some:
        assert len(some) == len(lines)
        estimate = from_pitch(some)
        assert abs(estimate.focal / focal - 1) < max(0.02, 5 * estimate.std / focal)
    elif len(lines) > 6:
        ways = {PITCH_LINES[name][0][0] == PITCH_LINES[name][1][0] for name in lines}
        pytest.fail(f"{sorted(lines)} have no names, {ways}")


def test_lines_of_other_things_have_no_name():
    rng = np.random.default_rng(7)
    lines = in_image(seen(1800.0, list(PITCH_LINES), number=200), rng)
    assert len(lines) > 6
    other = [np.linspace([100, 650], [900, 690], 20), np.linspace([1200, 60], [1270, 500], 20)]
    found = named([*other, *lines.values()])
    assert sorted(found) == sorted(lines)
    for name, points in found.items():
        np.testing.assert_array_equal(points, lines[name])


def test_pieces_of_a_line_are_one():
    lines = in_image(seen(3000.0, number=200), np.random.default_rng(3))
    longest = max(lines, key=lambda name: len(lines[name]))
    cut = np.array_split(lines.pop(longest), 2)
    found = named([*cut, *lines.values()])
    np.testing.assert_array_equal(found[longest], np.concatenate(cut))


@pytest.mark.parametrize(
    "lines",
    [
        [],
        [np.zeros((5, 2))] * 6,
        [np.linspace([0, y], [1279, y + 20], 30) for y in (100, 200, 300, 400, 500)],  # of one direction
        [np.linspace([300, 100], end, 30) for end in ([900, 150], [800, 600], [100, 700], [1200, 400])],
        [np.linspace([640, 360] + 300 * np.array([np.cos(a), np.sin(a)]), [640, 100], 9) for a in range(7)],
    ],
    ids=["none", "points", "parallels", "a fan", "a star"],
)
def test_lines_that_are_no_pitch_have_no_names(lines):
    assert named(lines) == {}


def test_positions_that_are_none_are_refused():
    with pytest.raises(ValueError, match="'line 1' must be a finite array"):
        named([np.zeros((3, 2)), np.full((3, 2), np.nan)])


@pytest.mark.slow
def test_real_annotations_get_their_names(frames):
    """Frames of 2 to 9 lines: two in three are named, all of those with 7 lines or more, none wrongly."""
    bend = zj.Distortion(np.array([-0.0416]), PRINCIPAL, np.array(np.hypot(1280, 720) / 2))
    number = {True: 0, False: 0}
    for frame in frames:
        lines = {name: np.array(points) for name, points in frame["lines"].items() if name in PITCH_LINES}
        lines = {name: np.asarray(bend.undistort(points)) for name, points in lines.items()}
        found = named(list(lines.values()))
        for name, points in found.items():
            np.testing.assert_array_equal(points, lines[name])
        number[bool(found)] += 1
        assert found or len(lines) < 7
    assert number[True] >= 62
