"""Shots joined by points of their frames that look alike: exact truth, and what must not join them."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from zoomjax import PolynomialZoom, ZoomLens
from zoomjax.fit import fit_motion, shot_turns
from zoomjax.fit.joining import Matches, Turn, frames_apart, join_shots, turn_between
from zoomjax.scenes import motion_tracks
from zoomjax.tracks import Tracks

SIZE, FRAMES, CUT = (640, 360), 20, 12
TURN = Rotation.from_euler("yx", [25, 4], degrees=True).as_matrix()


def lens():
    zoom = PolynomialZoom(2, jnp.array([[0.02, 0.0], [-0.05, 0.01], [-0.1, 0.03]]), jnp.array(500.0))
    return ZoomLens(zoom, jnp.array([322.0, 178.0]), jnp.array([500.0, 1200.0]), SIZE, "px")


def truth():
    """Focal lengths and rotations: it pans to the right, and begins again 25 degrees farther there."""
    focal = np.geomspace(520, 900, FRAMES)
    pans = Rotation.from_euler("y", -np.linspace(0, 30, CUT)[:, None], degrees=True).as_matrix()
    second = Rotation.from_euler("y", np.linspace(0, 15, FRAMES - CUT)[:, None], degrees=True).as_matrix()
    return focal, np.concatenate([pans, second @ TURN.T])


@pytest.fixture(scope="module")
def tracks():
    """Tracks that end at the cut."""
    track, frame, points = motion_tracks(lens(), *truth(), views=60, life=12, noise=0.1).tracks.views()
    number = 2 * track + (frame >= CUT)
    twice = np.bincount(number)[number] > 1
    return Tracks.from_arrays(number[twice], frame[twice], points[twice], image_size=SIZE, frames=FRAMES)


@pytest.fixture(scope="module")
def real(tracks):
    return fit_motion(tracks)


def fitted(real, factor=0.0, std=1e-3):
    """A fit with a cut, and f of the second shot off by a factor, whose logarithm is given."""
    focal, rotation = truth()
    shot = np.arange(FRAMES) >= CUT
    vectors = Rotation.from_matrix(rotation[shot] @ rotation[CUT].T).as_rotvec()
    rotation[shot] = Rotation.from_rotvec(vectors * np.exp(-factor)).as_matrix()
    focal[shot] *= np.exp(factor)
    values = lens(), focal, np.where(shot, std, 1e-3) * focal, rotation
    assert (np.asarray(real.shot) == shot).all()
    return eqx.tree_at(
        lambda fit: (fit.fit.lens, fit.focal, fit.focal_std, fit.rotation),
        real,
        (values[0], *map(jnp.asarray, values[1:])),
    )


def seen(frame, rays):
    """Where a frame shows rays, px; NaN where it does not."""
    focal, rotation = (of[frame] for of in truth())
    ahead = rays @ rotation.T
    straight = np.asarray(lens().centre) + focal * ahead[:, :2] / ahead[:, 2:]
    points = np.asarray(lens()(float(focal)).distort(straight))
    return np.where(
        (ahead[:, 2:] > 0) & (points > 0).all(1)[:, None] & (points < SIZE).all(1)[:, None], points, np.nan
    )


def scene(number=4000, seed=0):
    rays = np.random.default_rng(seed).normal(size=(number, 3)) * [0.4, 0.2, 0] + [0.3, 0, 1]
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def matched(one, other, *, rays=None, wrong=0.3, noise=0.5, seed=0):
    """What two frames show in common, with a share of mistakes."""
    rng = np.random.default_rng(seed)
    rays = scene() if rays is None else rays
    both = seen(one, rays), seen(other, rays)
    there = np.flatnonzero(np.isfinite(both[0] + both[1]).all(axis=1))[:150]
    points = [of[there] + noise * rng.normal(size=(len(there), 2)) for of in both]
    mistakes = rng.uniform(size=len(there)) < wrong
    points[1][mistakes] = rng.uniform(0, SIZE, (mistakes.sum(), 2))
    return Matches((one, other), (points[0], points[1]))


LEFT, RIGHT, AHEAD = (np.array(shift) for shift in ([100, 150], [400, 60], [200, 0]))
FAR_APART = ((5, 12), (8, 12), (5, 16), (11, 16), (11, 19))


def off(found):
    """Of the second shot, in degrees, how far its frames are turned from where they are."""
    rotation, true = np.asarray(found.rotation)[CUT:], truth()[1][CUT:]
    return np.degrees(Rotation.from_matrix(rotation @ np.swapaxes(true, 1, 2)).magnitude())


def test_a_shot_is_turned_to_where_it_looks(tracks, real):
    fit = fitted(real)
    turn = turn_between(fit, [matched(*pair) for pair in FAR_APART], 36)
    assert turn is not None
    assert turn.shots == (0, 1)
    assert turn.agree > 60
    found = join_shots(fit, [turn], tracks=tracks)
    assert off(found).max() < 0.03
    np.testing.assert_array_equal(found.scene, 0)
    np.testing.assert_array_equal(found.shot, fit.shot)
    np.testing.assert_allclose(found.rotation[:CUT], fit.rotation[:CUT], atol=1e-12)
    late = np.asarray(tracks.frame)[:, 0] >= CUT
    np.testing.assert_allclose(found.rays[~late], fit.rays[~late], atol=1e-12)
    np.testing.assert_allclose(found.rays[late], fit.rays[late] @ TURN.T, atol=1e-3)
    np.testing.assert_array_equal(found.focal, fit.focal)


@pytest.mark.parametrize("factor", [-0.04, 0.04])
def test_a_shot_whose_f_is_off_is_joined_and_its_f_made_to_agree(tracks, real, factor):
    fit = fitted(real, factor, std=0.03)
    turn = turn_between(fit, [matched(*pair) for pair in FAR_APART], 36)
    assert turn is not None
    assert turn.factor == pytest.approx(-factor, abs=0.004)
    start = join_shots(fit, [turn], tracks=tracks, scaled=True)
    np.testing.assert_allclose(start.focal, truth()[0], rtol=0.004)
    assert off(start).max() < 0.1
    np.testing.assert_array_equal(join_shots(fit, [turn], tracks=tracks).focal, fit.focal)


def test_shots_are_joined_by_way_of_others(tracks, real):
    fit = fitted(real)
    turn = turn_between(fit, [matched(*pair) for pair in FAR_APART], 36)
    back = turn._replace(shots=(1, 0), rotation=turn.rotation.T, factor=-turn.factor)
    for turns in ([turn], [back], [back, turn._replace(agree=1, rotation=np.eye(3))]):
        found = join_shots(fit, turns, tracks=tracks)
        assert off(found).max() < 0.03
        np.testing.assert_allclose(found.rotation[0], np.eye(3), atol=1e-12)


MIDDLE = 16


def in_three_shots(tracks, real, factor):
    """A fit with another cut, from where directions and, by a factor, f are unknown; and its tracks."""
    fit = fitted(real, factor, std=0.03)
    shot = np.digitize(np.arange(FRAMES), [CUT, MIDDLE])
    rotation = np.array(fit.rotation)
    rotation[MIDDLE:] = rotation[MIDDLE:] @ rotation[MIDDLE].T
    number, frame, points = tracks.views()
    number = 3 * number + (frame >= MIDDLE)
    twice = np.unique(number, return_inverse=True, return_counts=True)
    kept = twice[2][twice[1]] > 1
    parted = Tracks.from_arrays(number[kept], frame[kept], points[kept], image_size=SIZE, frames=FRAMES)
    values = jnp.asarray(rotation), jnp.asarray(shot), jnp.asarray(shot), jnp.ones((len(parted.mask), 3))
    values += (jnp.where(parted.mask, 0.0, jnp.nan),)
    of = lambda fit: (fit.rotation, fit.shot, fit.scene, fit.rays, fit.residual)  # noqa: E731
    return eqx.tree_at(of, fit, values), parted


@pytest.mark.parametrize("factor", [0.0, 0.03])
@pytest.mark.parametrize("order", [1, -1])
def test_three_shots_are_joined_one_after_the_other(tracks, real, factor, order):
    fit, parted = in_three_shots(tracks, real, factor)
    pairs = [FAR_APART[:2], ((13, 17), (15, 16), (14, 18))]
    turns = [turn_between(fit, [matched(*pair) for pair in some], 36) for some in pairs]
    assert [turn.shots for turn in turns] == [(0, 1), (1, 2)]
    found = join_shots(fit, turns[::order], tracks=parted, scaled=True)
    np.testing.assert_array_equal(found.scene, 0)
    assert off(found).max() < 0.15
    np.testing.assert_allclose(found.focal, truth()[0], rtol=0.006)
    alone = join_shots(fit, turns[1:], tracks=parted)
    np.testing.assert_array_equal(alone.scene, fit.shot > 0)


def test_a_turn_of_another_fit_is_refused(tracks, real):
    turn = turn_between(fitted(real), [matched(*pair) for pair in FAR_APART], 36)
    with pytest.raises(ValueError, match="give what shot_turns finds for this fit"):
        join_shots(fitted(real), [turn._replace(shots=(0, 2))], tracks=tracks)


@pytest.mark.parametrize(
    "wrong",
    [
        {"rotation": np.full((3, 3), np.nan)},
        {"rotation": np.diag([1.0, 1.0, -1.0])},
        {"rotation": 2 * np.eye(3)},
        {"factor": np.inf},
    ],
)
def test_a_turn_by_what_is_no_rotation_is_refused(tracks, real, wrong):
    turn = Turn((0, 1), (0, CUT), 30, np.eye(3), 0.0)
    with pytest.raises(ValueError, match="from shot 0 to 1 no rotation and factor of f"):
        join_shots(fitted(real), [turn._replace(**wrong)], tracks=tracks)


def still(number=120):
    """A caption, a logo and another one."""
    rng = np.random.default_rng(2)
    boxes = [(20, 300, 600, 350), (20, 10, 120, 60), (520, 10, 620, 60)]
    return np.concatenate([rng.uniform(box[:2], box[2:], (number // 3, 2)) for box in boxes])


@pytest.mark.parametrize("kind", ["chance", "caption", "board", "text", "few"])
def test_what_says_nothing_joins_nothing(real, kind):
    rng = np.random.default_rng(1)
    matches = [matched(*pair, wrong=1.0) for pair in FAR_APART]
    if kind == "caption":
        points = [still() + 0.3 * rng.normal(size=(120, 2)) for _ in range(2)]
        matches = [Matches(pair, (points[0], points[1])) for pair in FAR_APART]
    if kind == "board":  # that stands in both, at another place
        board = rng.uniform(0, [40, 30], (60, 2))
        matches = [Matches(pair, (board + LEFT, board + RIGHT)) for pair in FAR_APART]
    if kind == "text":  # that runs along the lower border
        text = rng.uniform([0, 330], [400, 350], (100, 2))
        matches = [Matches(pair, (text, text + AHEAD)) for pair in FAR_APART]
    if kind == "few":
        rays = scene()
        there = np.isfinite(seen(8, rays) + seen(12, rays)).all(axis=1)
        matches = [matched(8, 12, rays=rays[there][:9])]
    assert turn_between(fitted(real), matches, 36) is None


def test_frames_that_are_compared_are_far_apart(real):
    fit = fitted(real)
    frames = frames_apart(fit, 0, 4)
    assert len(frames) == 4
    assert {0, 11} <= set(frames)
    assert np.diff(frames).min() > 1
    assert set(frames_apart(fit, 1, 100)) == set(range(CUT, FRAMES))


def test_tracks_of_another_clip_are_refused(tracks, real):
    """They gave the rays of one shot to tracks of the other, without a word."""
    turn = Turn((0, 1), (0, CUT), 30, TURN, 0.0)
    track, frame, points = tracks.views()
    fewer = track[frame < CUT], frame[frame < CUT], points[frame < CUT]
    renamed = track.max() - track, frame, points
    others = [
        Tracks.from_arrays(*of, image_size=SIZE, frames=frames)
        for of, frames in ((fewer, FRAMES), (renamed, FRAMES), (tracks.views(), 50))
    ]
    others.append(Tracks.from_arrays(*tracks.views(), image_size=(SIZE[0] + 20, SIZE[1]), frames=FRAMES))
    for other in others:
        with pytest.raises(ValueError, match="tracks must be those of the fit"):
            join_shots(real, [turn], tracks=other)
        with pytest.raises(ValueError, match="tracks must be those of the fit"):
            shot_turns(real, other, look=lambda frames: pytest.fail("looked"))
    assert np.unique(join_shots(real, [turn], tracks=tracks).scene).tolist() == [0]
