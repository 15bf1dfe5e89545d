"""Shots of a clip that do not have one lens, and those that have."""

import warnings
from typing import Any, cast

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

from zoomjax import PolynomialZoom
from zoomjax.fit import _motion_apart, _motion_stages, fit_motion
from zoomjax.fit._motion_apart import heterogeneity
from zoomjax.fit._motion_repeated import Pulls
from zoomjax.fit.contradiction import OTHER_LENS
from zoomjax.scenes import motion_lines, motion_tracks, pan_and_zoom
from zoomjax.tracks import Tracks

from ._turning import FRAMES, SIZE, turning_lens


def lens(distortion=1.0, scale=1.0):
    """That of a camera, with so much of the distortion, or a focal scale so many times as long."""
    zoom = PolynomialZoom(2, distortion * turning_lens().zoom.parameters, jnp.array(800.0 * scale))
    of = lambda lens: (lens.zoom, lens.focal_range)  # noqa: E731
    return eqx.tree_at(of, turning_lens(), (zoom, scale * turning_lens().focal_range))


def clip(lenses, *, frames=FRAMES, pan=25, noise=0.3, first=None, **options):
    """Tracks of shots by these lenses, none of which goes across a cut, and the focal lengths."""
    parts, focals, count = [], [], 0
    for number, one in enumerate(lenses):
        focal, rotation = pan_and_zoom(one, frames, pan=pan, tilt=6, seed=number)
        more = {"noise": noise} | options | (first if first is not None and number == 0 else {})
        scene = motion_tracks(one, focal, rotation, views=60, life=12, seed=number, **more)
        track, frame, points = scene.tracks.views()
        parts.append((track + count, frame + frames * number, points))
        count += track.max() + 1
        focals.append(focal)
    track, frame, points = (np.concatenate(of) for of in zip(*parts, strict=True))
    tracks = Tracks.from_arrays(track, frame, points, image_size=SIZE, frames=frames * len(lenses))
    return tracks, np.concatenate(focals)


def told(tracks, **options):
    """What is said of different lenses, and the fit."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fit = fit_motion(tracks, throw=False, **options)
    return [str(of.message) for of in caught if str(of.message).startswith(OTHER_LENS)], fit


def test_focal_lengths_that_jump_at_a_cut():
    """The second shot was begun with f of the first one's end, and found 8 times as long as it is."""
    parts, focals, count = [], [], 0
    for number, ends in enumerate([(2390, 2000), (810, 1000)]):
        focal, rotation = (
            np.linspace(*ends, FRAMES),
            pan_and_zoom(lens(), 72, pan=30, tilt=6, seed=2 + number)[1],
        )
        scene = motion_tracks(
            lens(), focal, rotation[48 * number :][:FRAMES], views=60, life=12, seed=2 + number, noise=0.1
        )
        track, frame, points = scene.tracks.views()
        parts.append((track + count, frame + FRAMES * number, points))
        count += track.max() + 1
        focals.append(focal)
    track, frame, points = (np.concatenate(of) for of in zip(*parts, strict=True))
    tracks = Tracks.from_arrays(track, frame, points, image_size=SIZE, frames=2 * FRAMES)
    said, fit = told(tracks)
    assert not said
    assert np.abs(np.log(np.asarray(fit.focal) / np.concatenate(focals))).max() < 0.02


@pytest.fixture(scope="module")
def two_lenses():
    return clip([lens(), lens(distortion=0.5)])


def test_a_shot_with_another_distortion_is_told_by_its_frames(two_lenses):
    tracks, focal = two_lenses
    said, fit = told(tracks)
    assert len(said) == 1
    off = np.median(np.asarray(fit.focal / focal)[FRAMES:]) - 1
    assert off > 0.01  # with a small standard deviation
    assert f"the shot of frames {FRAMES} to {2 * FRAMES - 1} has focal lengths" in said[0]
    assert "shorter, and a correction that moves the corners" in said[0]
    percent = float(said[0].partition("focal lengths ")[2].partition("%")[0]) / 100
    assert percent == pytest.approx(off, abs=0.015)
    assert "Fit the tracks of each by themselves" in said[0]


def test_shots_of_one_lens_are_not_told(monkeypatch):
    compared = []

    def seen(*given):
        compared.append(heterogeneity(*given))
        return compared[-1]

    monkeypatch.setattr(_motion_apart, "heterogeneity", seen)
    said, _ = told(clip([lens(), lens()])[0])
    assert said == []
    total, free, *_ = compared[0]
    assert free == 10  # six parameters of the lens, four of its centre
    assert chi2.sf(total, free) > 1e-3


def test_one_shot_is_not_compared(monkeypatch):
    monkeypatch.setattr(_motion_apart, "heterogeneity", lambda *_: pytest.fail("compared"))
    assert told(clip([lens()])[0])[0] == []


@pytest.mark.slow
def test_a_shot_with_another_focal_scale_is_told():
    tracks, focal = clip([lens(), lens(scale=2.0)])
    said, fit = told(tracks)
    assert len(said) == 1
    assert abs(np.median(np.asarray(fit.focal / focal)[FRAMES:]) - 1) > 0.1


@pytest.mark.slow
def test_two_cameras_in_turn_are_told():
    said, _ = told(clip([lens(), lens(scale=2.0)] * 2, frames=FRAMES // 2)[0])
    assert len(said) == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {"moving": 0.3},
        {"drift": 0.03},
        {"shutter": 0.4},
        {"pupil": 0.2, "first": {"distance": (15.0, 40.0)}},
        {"first": {"noise": 0.8}},
    ],
    ids=["moving things", "drift", "rolling shutter", "one shot near", "one shot blurred"],
)
def test_what_is_wrong_with_one_camera_is_not_taken_for_two(options):
    assert told(clip([lens(), lens()], **options)[0])[0] == []


@pytest.mark.slow
def test_lines_and_known_focal_lengths_of_one_camera_are_not_taken_for_two():
    tracks, focal = clip([lens(), lens()])
    lines = motion_lines(lens(), focal, noise=0.3)
    known = np.where(np.arange(len(focal)) % FRAMES == 3, focal, np.nan)
    assert told(tracks, lines=lines)[0] == []
    assert told(tracks, focal=known, focal_std=0.01 * float(focal.min()))[0] == []


@pytest.mark.slow
def test_lines_of_two_cameras_do_not_hide_them(two_lenses):
    tracks, focal = two_lenses
    assert (
        len(
            told(
                tracks, lines=motion_lines(lens(), focal[:FRAMES], noise=0.3), line_frames=np.arange(FRAMES)
            )[0]
        )
        == 1
    )


def test_a_shot_by_itself_is_fitted_by_the_programs_of_all(two_lenses, monkeypatch):
    used = []
    refitted, solved = _motion_apart.refitted, cast(Any, _motion_stages._solved)._cached

    def counted(*given):
        before = solved._cache_size()
        found = refitted(*given)
        used.append(solved._cache_size() - before)
        return found

    monkeypatch.setattr(_motion_apart, "refitted", counted)
    assert len(told(two_lenses[0])[0]) == 1
    assert used
    assert not any(used)


def pulls_of(rng, groups, *, tracks=300, apart=0.0, louder=1.0):
    """Of groups whose tracks tell of four parameters, and of a shutter and a scale of their own."""
    found = []
    for number in range(groups):
        by = rng.normal(size=(tracks, 6, 6)) / np.sqrt(6 * tracks)
        fisher = np.einsum("tri,trj->tij", by, by)
        noise = rng.normal(size=(tracks, 6)) * (louder if number == 0 else 1.0)
        score = np.einsum("tri,tr->ti", by, noise)
        if number == 0:
            score += fisher @ np.array([apart, 0, 0, 0, 0, 0])
        scatter = np.einsum("ti,tj->ij", score, score)
        found.append((score.sum(0), fisher.sum(0), fisher.sum(0), scatter))
    return Pulls(*(jnp.asarray(np.stack(of)) for of in zip(*found, strict=True)))


@pytest.mark.parametrize("louder", [1.0, 3.0])
def test_heterogeneity_is_chi_squared_where_there_is_none(rng, louder):
    chances = [chi2.sf(*heterogeneity(pulls_of(rng, 3, louder=louder), 3)[:2]) for _ in range(200)]
    assert heterogeneity(pulls_of(rng, 3), 3)[1] == 8
    assert np.mean(chances) == pytest.approx(0.5, abs=0.08)
    assert np.min(chances) > 1e-5


def test_heterogeneity_grows_with_what_a_group_is_apart(rng):
    total, free, squares, ranks = heterogeneity(pulls_of(rng, 3, apart=12.0), 3)
    assert chi2.sf(total, free) < 1e-8
    assert np.argmax(squares) == 0
    assert ranks.tolist() == [4, 4, 4]


def test_what_a_group_does_not_tell_is_not_compared(rng):
    blind = pulls_of(rng, 3)
    keep = np.diag([1.0, 1.0, 0.0, 0.0, 1.0, 1.0])
    first = [np.array(of) for of in blind]
    for place, of in enumerate(first):
        of[1] = keep @ of[1] if place == 0 else keep @ of[1] @ keep
    total, free, _, ranks = heterogeneity(Pulls(*map(jnp.asarray, first)), 3)
    assert ranks.tolist() == [4, 2, 4]
    assert free == 6
    assert chi2.sf(total, free) > 1e-5
