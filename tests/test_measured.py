"""What docs/measured.md says of real cameras: the studies of benchmarks/real, and their geometry."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

import benchmarks
import zoomjax as zj
from benchmarks.real.lensfun.page import markdown
from benchmarks.real.study import DEFAULT, candidates, choose, root_mean
from benchmarks.real.study_broadcast import (
    Clip,
    corrected,
    distorted,
    looking_at,
    pitch_lines,
    seen,
    truly_straight,
)
from benchmarks.real.study_pitch import line_left_out
from benchmarks.real.study_zoomcam import in_double, random_halves
from benchmarks.real.zoomcam import read_zoomcam

RESULTS = Path(benchmarks.__file__).parent / "results"

MODELS = {model.name: model for model in candidates()}


@pytest.fixture(scope="module")
def zoomcam(data):
    return zj.compress(in_double(read_zoomcam(data / "zoomcam")))


@pytest.fixture
def clip(rng):
    """Ten frames of a camera beside the pitch with the distortion of a broadcast lens."""
    focal = np.linspace(2600, 5900, 10)
    k = np.stack([focal**2, focal**4], axis=-1) * [0.03 / 1100**2, 0.012 / 1100**4]
    principal = np.array([945, 510]) + rng.uniform(-5, 5, (10, 2))
    return Clip("made up", focal, principal, k, np.array([0.0, -67.0, 12.0]))


def in_sample(lines, name):
    k = MODELS[name].coefficients(lines, np.asarray(lines.focal))
    return float(root_mean(np.asarray(zj.frame_rms(lines, k)) ** 2))


@pytest.mark.slow
def test_real_zoom_camera_in_sample_is_as_an_independent_program_found(zoomcam):
    assert float(zj.fit_frames(zoomcam).rms) == pytest.approx(0.8796, abs=6e-5)
    for degree, expected in enumerate((0.9969, 0.8855, 0.8809, 0.8802)):
        assert in_sample(zoomcam, f"zoom polynomial, degree {degree}") == pytest.approx(expected, abs=6e-5)


@pytest.mark.slow
def test_degree_2_is_as_good_as_each_zoom_by_itself_on_photos_held_out(zoomcam):
    focal = np.asarray(zoomcam.focal)
    excess = []
    for half in random_halves(zoomcam, 6):
        train, test = zoomcam.weighted(half), zoomcam.weighted(1 - half)
        k = MODELS[DEFAULT].coefficients(train, focal)
        zoom, each = (
            root_mean(np.asarray(zj.frame_rms(test, coefficients)) ** 2)
            for coefficients in (k, zj.fit_frames(train).coefficients)
        )
        excess.append(zoom / each - 1)
    assert np.mean(excess) <= 0.005


def test_halves_have_half_of_the_photos_of_each_zoom_whole(zoomcam):
    photo = np.asarray(zoomcam.number) // 37
    frame = np.asarray(zoomcam.frame)
    for half in random_halves(zoomcam, 3):
        of_photo = np.array([np.unique(half[photo == one]) for one in np.unique(photo)])
        assert of_photo.shape == (116, 1)
        assert [int(half[frame == zoom].sum()) // 37 for zoom in range(5)] == [12, 11, 11, 10, 12]


def test_distortion_is_that_of_opencv_and_inverted(clip, rng):
    world = rng.uniform([-8, -4, 30], [8, 4, 60], (50, 3))
    for f, c, k in zip(clip.focal, clip.principal, clip.k, strict=True):
        camera = np.array([[f, 0, c[0]], [0, f, c[1]], [0, 0, 1]])
        theirs = cv2.projectPoints(world, np.zeros(3), np.zeros(3), camera, np.pad(k, (0, 2)))[0][:, 0]
        straight = f * world[:, :2] / world[:, 2:]
        ours = distorted(straight, f, k)
        np.testing.assert_allclose(c + ours, theirs, atol=1e-9)
        back = corrected(ours[None], np.array([f]), k[None])[0]
        np.testing.assert_allclose(back, straight, atol=1e-8)


def test_pitch_lines_seen_are_points_of_the_pitch(clip):
    turn = looking_at(clip.position, np.array([44.0, 5.0, 0.0]))
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    found = pitch_lines(clip, 0, turn)
    assert len(found) >= 4
    for line in found:
        offset = (line - clip.principal[0])[None]
        straight = corrected(offset, clip.focal[:1], clip.k[:1])[0]
        rays = np.pad(straight / clip.focal[0], ((0, 0), (0, 1)), constant_values=1) @ turn
        ground = clip.position + rays * (-clip.position[2] / rays[:, 2:])
        # On one of the pitch's lines: x or y is constant, and one that the pitch has.
        along = [(abs(x), (0, 36, 47, 52.5)) for x in ground[:, :1].T]
        along += [(abs(y), (9.16, 20.16, 34)) for y in ground[:, 1:2].T]
        assert min(np.abs(place - at).max() for place, known in along for at in known) < 1e-6


def test_lines_of_a_broadcast_are_straight_through_the_true_lens_and_found_again(clip):
    points, frame = seen(clip, np.random.default_rng(0))
    lines = zj.Lines.from_ragged(points, frame, clip.focal, image_size=(1920, 1080), focal_unit="px")
    assert truly_straight(clip, lines).max() < 1e-8
    assert np.asarray(zj.frame_rms(lines, None)).max() > 0.5


def test_chosen_frames_have_the_lines_and_figures_that_they_had(small):
    frames = np.array([3, 1])
    chosen = choose(small, frames, 150)
    assert chosen.triangle.shape[0] == 300
    k = np.array([[0.02, -0.01]] * 4)
    np.testing.assert_allclose(
        zj.frame_rms(chosen, k[frames]), np.asarray(zj.frame_rms(small, k))[frames], rtol=1e-12
    )


@pytest.mark.slow
def test_a_line_left_out_is_corrected_as_the_others_of_its_frame_ask_for(ragged):
    lines = zj.compress(ragged, terms=1)
    frame = np.asarray(lines.frame)
    squares = np.zeros(9)
    for line in range(9):
        only = np.arange(9) == line
        k = zj.fit_frames(lines.weighted(1.0 - only), terms=1).coefficients
        squares[line] = zj.frame_rms(lines.weighted(only), k)[frame[line]] ** 2
    expected = np.bincount(frame, squares) / np.bincount(frame)
    np.testing.assert_allclose(line_left_out(lines, 1), expected, rtol=1e-6)


def test_the_page_of_six_hundred_lenses_is_made_of_its_results():
    page = RESULTS / "lensfun.md"
    assert markdown(json.loads(page.with_suffix(".json").read_text())) == page.read_text(encoding="utf-8")
