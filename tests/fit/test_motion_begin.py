"""`fit_motion` from an earlier fit of the same clip, and tracks that go across cuts."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from zoomjax import PolynomialZoom
from zoomjax.fit import RESULTS, fit_motion, motion
from zoomjax.fit._motion_problem import Asked, Given, problem_of
from zoomjax.models import Division, RadialPolynomial
from zoomjax.scenes import motion_tracks, pan_and_zoom
from zoomjax.tracks import Tracks

from ._turning import FRAMES, SIZE, turning_lens


@pytest.fixture(scope="module")
def lens():
    return turning_lens()


@pytest.fixture(scope="module")
def tracks(lens):
    path = pan_and_zoom(lens, FRAMES, pan=25, tilt=6)
    return motion_tracks(lens, *path, views=50, life=12, noise=0.3, seed=3).tracks


@pytest.fixture(scope="module")
def fit(tracks):
    return fit_motion(tracks)


def made(track, frame, points):
    """Tracks of those that have two views or more."""
    track = np.unique(track, return_inverse=True)[1]
    twice = np.bincount(track)[track] > 1
    return Tracks.from_arrays(track[twice], frame[twice], points[twice], image_size=SIZE, frames=FRAMES)


def some(tracks, which):
    """The tracks with some of their views: a function of tracks and frames."""
    track, frame, points = tracks.views()
    kept = which(track, frame)
    return made(track[kept], frame[kept], points[kept])


@pytest.fixture(scope="module")
def earlier(tracks):
    """A fit of half of the tracks."""
    return fit_motion(some(tracks, lambda track, frame: track % 2 == 0))


def test_it_ends_where_one_from_nothing_does(tracks, fit, earlier, monkeypatch):
    monkeypatch.setattr(motion, "begun", None)
    found = fit_motion(tracks, begin=earlier)
    off = np.abs(np.asarray(found.focal - fit.focal)) / np.asarray(fit.focal_std)
    assert np.abs(np.asarray(earlier.focal - fit.focal) / np.asarray(fit.focal_std)).max() > 0.3
    assert off.max() < 0.05
    np.testing.assert_allclose(found.focal_std, fit.focal_std, rtol=0.01)
    np.testing.assert_allclose(found.noise, fit.noise, rtol=1e-3)
    np.testing.assert_allclose(found.rotation, fit.rotation, atol=2e-5)
    assert found.fit.result == fit.fit.result == RESULTS.successful


def test_frames_that_the_earlier_fit_did_not_see_are_of_the_shot_around_them(tracks, earlier):
    unseen = np.isin(np.arange(FRAMES), [9, 10, 15])
    begin = eqx.tree_at(
        lambda fit: (fit.shot, fit.scene),
        earlier,
        tuple(jnp.where(unseen, -1, of) for of in (earlier.shot, earlier.scene)),
    )
    asked = Asked(PolynomialZoom(2), RadialPolynomial(), 2, None, None)
    problem = problem_of(Given(tracks, None, None, None, None, begin), asked)
    np.testing.assert_array_equal(problem.shot, 0)


def test_an_earlier_fit_of_another_scale_is_no_start(tracks, fit, monkeypatch):
    """Its lens is another one, and the way from it to the known focal lengths is long."""
    other = eqx.tree_at(lambda fit: fit.focal, fit, 1.5 * fit.focal)
    known = {"focal": np.where(np.arange(FRAMES) == 3, fit.focal, np.nan), "focal_std": 1.0}
    found = fit_motion(tracks, begin=other, **known)
    np.testing.assert_allclose(found.focal, fit.focal, rtol=1e-3)
    monkeypatch.setattr(motion, "begun", None)
    near = fit_motion(tracks, begin=fit, **known)
    np.testing.assert_allclose(near.focal, found.focal, rtol=1e-4)


def test_shots_that_nothing_links_have_the_scales_of_their_own_known_focal_lengths(lens):
    """Both are still, and zoom."""
    _, rotation = pan_and_zoom(lens, FRAMES, pan=0, tilt=0)
    focal = np.concatenate([np.geomspace(800, 1200, 12), np.geomspace(2400, 1800, 12)])
    parts = []
    for number, (seed, rows) in enumerate([(3, slice(0, 12)), (4, slice(12, 24))]):
        of = motion_tracks(lens, focal[rows], rotation[rows], views=50, life=12, noise=0.1, seed=seed)
        track, frame, points = of.tracks.views()
        parts.append((track + 10_000 * number, frame + 12 * number, points))
    tracks = made(*(np.concatenate(of) for of in zip(*parts, strict=True)))
    known = np.full(FRAMES, np.nan)
    known[[2, 20]] = focal[[2, 20]]
    found = fit_motion(tracks, focal=known, focal_std=0.002 * focal, readout=0.0)
    assert found.shot.tolist() == [0] * 12 + [1] * 12
    np.testing.assert_allclose(found.focal, focal, rtol=0.02)


def test_an_earlier_fit_of_another_clip_is_refused(lens, tracks, fit):
    """As many frames of the same camera: a frame had no f, and in another clip all f were off."""
    for number, path in enumerate(({"pan": 25, "seed": 1}, {"pan": 60, "tilt": 20, "seed": 2})):
        other = motion_tracks(
            lens, *pan_and_zoom(lens, FRAMES, **path), views=50, life=12, noise=0.3, seed=number
        )
        with pytest.raises(ValueError, match=r"same clip, but by it most points would be \d+ px or more"):
            fit_motion(other.tracks, begin=fit)
    backwards = made(*(of(part) for of, part in zip(_BACKWARDS, tracks.views(), strict=True)))
    with pytest.raises(ValueError, match="same clip, but by it most points"):
        fit_motion(backwards, begin=fit)


_BACKWARDS = (np.array, lambda frame: FRAMES - 1 - frame, np.array)


@pytest.mark.slow
def test_what_tracks_do_not_determine_is_not_determined_by_the_earlier_fit(lens, fit):
    focal, rotation = pan_and_zoom(lens, FRAMES, pan=25, tilt=6)
    still = np.broadcast_to(rotation[0], rotation.shape)
    scene = motion_tracks(lens, focal, still, views=50, life=12, noise=0.3, seed=3)
    begin = eqx.tree_at(lambda fit: fit.rotation, fit, jnp.broadcast_to(jnp.eye(3), rotation.shape))
    assert fit_motion(scene.tracks, begin=begin).fit.result == RESULTS.undetermined


def test_a_fit_of_something_else_is_refused(tracks, fit):
    longer = Tracks.from_arrays(*tracks.views(), image_size=SIZE, frames=FRAMES + 1)
    with pytest.raises(ValueError, match="begin must be an earlier fit of the same clip"):
        fit_motion(longer, begin=fit)
    for models in ({"terms": 1}, {"shift": None}, {"zoom": PolynomialZoom(1)}):
        with pytest.raises(ValueError, match="begin must be an earlier fit of the same models"):
            fit_motion(tracks, begin=fit, **models)
    with pytest.raises(ValueError, match="begin must be an earlier fit of the same models"):
        fit_motion(tracks, begin=fit, distortion_model=Division())


@pytest.mark.slow
def test_derivatives_do_not_depend_on_where_it_begins(tracks, fit, earlier):
    """By the first of them, the earlier fit is a function of the points, too."""

    def mean_focal(points, begin):
        moved = eqx.tree_at(lambda tracks: tracks.points, tracks, points)
        if begin is None:
            begin = fit_motion(moved)
        return jnp.mean(fit_motion(moved, begin=begin).focal)

    points = jnp.asarray(tracks.points)
    there, both = (jax.grad(mean_focal)(points, begin) for begin in (earlier, None))
    mask = np.asarray(tracks.mask)
    np.testing.assert_allclose(there[mask], both[mask], atol=2e-3 * np.abs(there[mask]).max())


def grouped(tracks, begin=None):
    asked = Asked(PolynomialZoom(), RadialPolynomial(), 2, None, None)
    return problem_of(Given(tracks, None, None, None, None, begin), asked)


def cut_at(tracks, *cuts):
    """The tracks as if there were cuts before these frames."""
    track, frame, points = tracks.views()
    number = 10 * track + np.searchsorted(cuts, frame, side="right")
    return made(number, frame, points)


def found_again(tracks, views):
    """Tracks with more views: which track, in which frame."""
    track, frame, points = tracks.views()
    number = np.unique(track)
    more = np.array([[number[which], moment] for which, moment in views])
    return Tracks.from_arrays(
        np.concatenate([track, more[:, 0]]),
        np.concatenate([frame, more[:, 1]]),
        np.concatenate([points, np.full((len(more), 2), 300.0)]),
        image_size=SIZE,
        frames=FRAMES,
    )


def test_neighbours_of_a_rolling_shutter_are_in_one_shot_where_tracks_go_across_the_cut(tracks):
    cut = cut_at(tracks, 12)
    whole = grouped(cut)
    assert whole.shot.tolist() == whole.scene.tolist() == [0] * 12 + [1] * 12
    early = np.flatnonzero(np.asarray(cut.frame)[:, 0] == 0)
    crossed = grouped(found_again(cut, [(which, 17 + which % 2 * 5) for which in early]))
    assert (crossed.linked == 0).all()
    assert (crossed.scene == 0).all()
    assert crossed.shot.tolist() == [0] * 12 + [1] * 12
    before, after = np.asarray(crossed.data.neighbours)[:FRAMES].T
    assert (before[12], after[11]) == (12, 11)
    assert (before[1:12] == np.arange(11)).all()
    assert (after[12:-1] == np.arange(13, FRAMES)).all()
    np.testing.assert_array_equal(np.flatnonzero(np.asarray(crossed.data.fixed)[:FRAMES]), [0])


def test_dark_frames_are_no_cut(tracks):
    dark = some(tracks, lambda track, frame: (frame < 9) | (frame > 14))
    assert grouped(dark).shot.tolist() == [0] * 9 + [-1] * 6 + [0] * 9


def test_shots_and_scenes_are_those_of_the_earlier_fit(tracks, fit):
    shot = jnp.asarray([0] * 8 + [1] * 8 + [2] * 8)
    scene = jnp.asarray([0] * 8 + [1] * 8 + [0] * 8)
    begin = eqx.tree_at(lambda fit: (fit.shot, fit.scene), fit, (shot, scene))
    linked = found_again(cut_at(tracks, 8, 16), [(0, 15), (0, 17), (0, 18)])
    assert len(np.unique(grouped(linked).shot)) < 3  # of so dense ones it cannot be known
    problem = grouped(linked, begin)
    np.testing.assert_array_equal(problem.shot, shot)
    assert (problem.scene == 0).all()
    apart = grouped(cut_at(tracks, 8, 16), begin)
    np.testing.assert_array_equal(apart.scene, scene)
    np.testing.assert_array_equal(apart.linked, shot)
    assert np.flatnonzero(np.asarray(apart.data.fixed)[:FRAMES]).tolist() == [0, 8, 16]
