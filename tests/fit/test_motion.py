"""Focal lengths, rotations and the lens from tracks alone, beside the truth."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from zoomjax import Lines, PolynomialZoom, ZoomLens
from zoomjax.fit import RESULTS, _motion_problem, fit_motion, motion
from zoomjax.fit._motion_gradient import sensitive
from zoomjax.fit._motion_levers import guessed_levers
from zoomjax.fit._motion_parallax import Spread
from zoomjax.fit._motion_problem import Asked, Given, problem_of, thinned
from zoomjax.fit._motion_start import rotation_vector, shrunk_ray, turned
from zoomjax.fit.motion import _fitted, thrown_motion
from zoomjax.lines import compress_any_centre
from zoomjax.models import BrownConrady, RadialPolynomial
from zoomjax.scenes import motion_lines, motion_tracks, pan_and_zoom
from zoomjax.tracks import Tracks

from ._turning import FRAMES, SIZE, turning_lens


@pytest.fixture(scope="module")
def lens():
    return turning_lens()


@pytest.fixture(scope="module")
def path(lens):
    return pan_and_zoom(lens, FRAMES, pan=25, tilt=6)


def tracked(lens, path, *, views=50, life=12, **options):
    return motion_tracks(lens, *path, views=views, life=life, seed=3, **options)


@pytest.fixture(scope="module")
def noisy(lens, path):
    return tracked(lens, path, noise=0.3)


@pytest.fixture(scope="module")
def fit(noisy):
    return fit_motion(noisy.tracks)


def displaced(lens, fit, focal):
    """RMS distance over the image of points corrected by the fitted lens and by the true one, px."""
    grid = np.stack(np.meshgrid(*(np.linspace(0, n - 1, 9) for n in SIZE)), -1).reshape(-1, 2)
    missed = [
        np.asarray(fit.lens(float(own)).undistort(grid)) - np.asarray(lens(float(true)).undistort(grid))
        for own, true in zip(np.asarray(fit.focal), focal, strict=True)
    ]
    # Where the centre of the corrected image is put is free: a shift of it turns the camera.
    missed = np.array(missed) - np.mean(missed, axis=1, keepdims=True)
    return float(np.sqrt(np.mean(np.sum(missed**2, axis=-1))))


def test_the_scene_is_seen_where_it_is(lens, path):
    focal, rotation = path
    scene = tracked(lens, path)
    tracks = scene.tracks
    for track in (0, 7, -1):
        for view in np.flatnonzero(np.asarray(tracks.mask)[track]):
            frame = int(tracks.frame[track, view])
            ahead = rotation[frame] @ scene.points[track]
            straight = np.asarray(lens.centre) + focal[frame] * ahead[:2] / ahead[2]
            corrected = lens(float(focal[frame])).undistort(np.asarray(tracks.points[track, view]))
            np.testing.assert_allclose(corrected, straight, atol=1e-8)


def test_tracks_give_focal_lengths_and_lens(lens, path, noisy, fit):
    focal, rotation = path
    assert fit.fit.result == RESULTS.successful
    assert abs(np.asarray(fit.focal) / focal - 1).max() < 0.01
    assert displaced(lens, fit, focal) < 0.6
    assert 0.25 < fit.noise < 0.35
    turned_back = np.asarray(fit.rotation) @ np.asarray(fit.rotation[0]).T
    true = rotation @ rotation[0].T
    angle = [
        np.linalg.norm(rotation_vector(jnp.asarray(a @ b.T)))
        for a, b in zip(turned_back, true, strict=True)
    ]
    assert max(angle) < 0.01


def test_the_standard_deviation_is_that_of_the_common_factor(path, fit):
    error = np.mean(np.asarray(fit.focal) / path[0] - 1)
    std = np.mean(np.asarray(fit.focal_std) / path[0])
    assert np.sqrt(fit.covariance[-1, -1]) == pytest.approx(std, rel=0.1)
    assert 1e-4 < std < 0.02
    assert abs(error) < 4 * std


def long_focal(seed, low, pan, tilt):
    """A random lens of long focal lengths on a random path, and its tracks."""
    k = np.random.default_rng(seed).normal(size=(3, 2)) * [[0.02, 0.005], [0.05, 0.01], [0.1, 0.03]]
    zoom, reach = PolynomialZoom(2, jnp.asarray(k), jnp.array(low)), jnp.array([low, 3 * low])
    lens = ZoomLens(zoom, jnp.array([645.0, 356.0]), reach, SIZE, "px")
    path = pan_and_zoom(lens, FRAMES, pan=pan, tilt=tilt, seed=seed)
    return motion_tracks(lens, *path, views=60, life=12, noise=0.3, seed=seed)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "low", "pan", "tilt"),
    # In the first ones the best chain has a wrong scale: with this one alone, seed 2 is off by a factor of
    # 2. In the others the scale is hardly told, and the way to the minimum is long.
    [*((seed, 1600.0, 10, 2) for seed in (1, 2, 7)), *((seed, 6000.0, 3, 1) for seed in (3, 4, 5))],
)
def test_long_focal_lengths_are_found_within_their_deviation(seed, low, pan, tilt):
    scene = long_focal(seed, low, pan, tilt)
    found = fit_motion(scene.tracks, throw=False)
    off = np.mean(np.log(np.asarray(found.focal) / scene.focal))
    assert abs(off) < 2.5 * np.sqrt(found.covariance[-1, -1])


@pytest.mark.slow
@pytest.mark.parametrize("moving", [0.2, 0.6])
def test_things_that_move_do_little_harm(lens, path, moving):
    scene = motion_tracks(lens, *path, views=120, life=12, seed=3, noise=0.3, moving=moving)
    fit = fit_motion(scene.tracks)
    assert abs(np.asarray(fit.focal) / path[0] - 1).max() < 0.02
    assert displaced(lens, fit, path[0]) < 0.6
    assert fit.noise == pytest.approx(0.3, rel=0.1)


def with_a_thing(tracks, focal, share, seed):
    """Tracks, and those of one thing that the camera follows, which has a share of all."""
    rng = np.random.default_rng(seed)
    track, view = np.nonzero(np.asarray(tracks.mask))
    frame, points = (np.asarray(of)[track, view] for of in (tracks.frame, tracks.points))
    time = np.arange(FRAMES)
    sway = [120 * np.sin(2 * np.pi * time / 40 + seed), 20 * np.sin(2 * np.pi * time / 25)]
    middle = np.array(SIZE) / 2 + np.column_stack(sway)
    parts = [(track, frame, points)]
    number = round(share / (1 - share) * len(track) / FRAMES)
    for name, begin in enumerate(np.repeat([-6, 6, 18], number), track.max() + 1):
        seen = np.arange(max(begin, 0), min(begin + 12, FRAMES))
        place = rng.uniform([-230, -230], [230, 230]) * (focal[seen] / np.mean(focal))[:, None]
        place = middle[seen] + place + rng.normal(0, 0.3, place.shape)
        inside = ((place > 0) & (place < np.array(SIZE) - 1)).all(axis=1)
        parts.append((np.full(inside.sum(), name), seen[inside], place[inside]))
    track, frame, points = (np.concatenate(column) for column in zip(*parts, strict=True))
    twice = (np.bincount(track) > 1)[track]
    return Tracks.from_arrays(track[twice], frame[twice], points[twice], image_size=SIZE, frames=FRAMES)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_thing_that_the_camera_follows_is_not_taken_for_the_scene(lens, seed):
    path = pan_and_zoom(lens, FRAMES, pan=25, tilt=6, seed=seed)
    scene = motion_tracks(lens, *path, views=84, life=12, noise=0.3, seed=seed)
    fit = fit_motion(with_a_thing(scene.tracks, path[0], 0.3, seed), throw=False)
    assert fit.fit.result == RESULTS.successful
    assert abs(np.asarray(fit.focal) / path[0] - 1).max() < 0.02
    assert displaced(lens, fit, path[0]) < 0.8


@pytest.mark.parametrize("throw", [True, False])
@pytest.mark.parametrize(
    ("models", "frames", "wanted"),
    [
        ({}, 2, "degree 2 in 1/f needs 3 or more distinct focal lengths, but there are 2"),
        ({"zoom": PolynomialZoom(1)}, 1, "degree 1 in 1/f needs 2 or more"),
        ({"zoom": PolynomialZoom(0), "shift": PolynomialZoom(3)}, 3, "degree 3 in 1/f needs 4 or more"),
    ],
)
def test_fewer_frames_than_a_model_needs_are_told(noisy, models, frames, wanted, throw):
    few = eqx.tree_at(lambda t: t.mask, noisy.tracks, noisy.tracks.mask & (noisy.tracks.frame < frames))
    with pytest.raises(ValueError, match=f"tracks has views in {frames} frames: A polynomial of {wanted}"):
        fit_motion(few, throw=throw, **models)


@pytest.mark.slow
def test_a_camera_that_does_not_turn_has_no_scale(lens, path):
    focal, rotation = path
    still = (focal, np.broadcast_to(rotation[0], rotation.shape))
    fit = fit_motion(tracked(lens, still, noise=0.3).tracks, throw=False)
    assert fit.fit.result != RESULTS.successful
    assert (np.asarray(fit.focal_std) / np.asarray(fit.focal)).min() > 0.02


def test_known_focal_lengths_give_the_scale(lens, path):
    focal, rotation = path
    still = (focal, np.broadcast_to(rotation[0], rotation.shape))
    known = np.where(np.arange(FRAMES) == 3, focal, np.nan)
    fit = fit_motion(
        tracked(lens, still, noise=0.3).tracks, focal=known, focal_std=1e-3 * focal, throw=False
    )
    assert fit.fit.result == RESULTS.successful
    off, std = np.asarray(fit.focal) / focal - 1, np.asarray(fit.focal_std) / focal
    assert abs(off).max() < 0.01
    assert std[3] == pytest.approx(1e-3, rel=0.2)
    assert (abs(off) < 4 * std).all()


@pytest.mark.slow
def test_the_scale_is_as_uncertain_as_the_best_f_where_all_are_known(lens, path):
    focal, rotation = path
    still = (focal, np.broadcast_to(rotation[0], rotation.shape))
    tracks = tracked(lens, still, noise=0.3).tracks
    but_one = np.where(np.arange(FRAMES) == 3, np.nan, focal)
    found = [fit_motion(tracks, focal=known, focal_std=0.01 * focal) for known in (focal, but_one)]
    std = [np.sqrt(np.diag(np.asarray(fit.covariance))) for fit in found]
    assert std[0][-1] == pytest.approx(np.min(np.asarray(found[0].focal_std / found[0].focal)))
    assert 0.01 / np.sqrt(FRAMES) < std[0][-1] < 0.01
    np.testing.assert_allclose(std[0], std[1], rtol=0.2)
    joint = [np.asarray(fit.covariance)[0, -1] for fit in found]
    assert joint[0] == pytest.approx(joint[1], rel=0.3, abs=0.05 * std[0][0] * std[0][-1])


def test_a_frame_without_views_does_not_tell_the_scale(lens, path):
    """However well its f is known."""
    focal, rotation = path
    still = (focal, np.broadcast_to(rotation[0], rotation.shape))
    tracks = tracked(lens, still, noise=0.3).tracks
    tracks = eqx.tree_at(lambda tracks: tracks.mask, tracks, tracks.mask & (tracks.frame != 5))
    relative = np.where(np.arange(FRAMES) == 5, 1e-6, 0.01)
    fit = fit_motion(tracks, focal=focal, focal_std=relative * focal)
    assert np.isnan(fit.focal[5])
    assert 0.01 / np.sqrt(FRAMES) < np.sqrt(np.asarray(fit.covariance)[-1, -1]) < 0.01


def test_a_known_focal_length_that_contradicts_the_tracks_is_told(path, noisy):
    """One is 1.3 times too long: the scale of all is between it and that of the tracks."""
    focal = np.full(FRAMES, np.nan)
    focal[5] = 1.3 * path[0][5]
    with pytest.warns(UserWarning, match=r"1 of 1 known focal lengths contradict the tracks: of frame 5 "):
        fit_motion(noisy.tracks, focal=focal, focal_std=0.01 * focal[5])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*known focal lengths contradict")  # which some of them do, too
@pytest.mark.parametrize("factor", [0.3, 0.5, 2.0, 10.0])
def test_known_focal_lengths_of_another_scale_are_told(path, noisy, factor):
    """In mm for px, of another sensor, or of a lens with an extender: the fit follows them all."""
    focal = factor * path[0]
    with pytest.warns(UserWarning, match="have another scale than the tracks: points are followed within"):
        fit_motion(noisy.tracks, focal=focal, focal_std=0.01 * focal, throw=False)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.01, 4.0])
def test_one_known_focal_length_of_another_scale_is_told(path, noisy, factor):
    focal = np.where(np.arange(FRAMES) == 0, factor * path[0], np.nan)
    with pytest.warns(UserWarning, match="focal lengths (have another scale|contradict the tracks)"):
        fit_motion(noisy.tracks, focal=focal, focal_std=0.01 * focal[0], throw=False)


@pytest.mark.parametrize("bad", [0, 12])
def test_a_frame_whose_tracks_are_all_wrong_is_as_one_without(path, noisy, fit, bad):
    tracks = noisy.tracks
    points = np.array(tracks.points)
    of_it = np.asarray(tracks.mask) & (np.asarray(tracks.frame) == bad)
    points[of_it, 1] = 300 + 0.2 * points[of_it, 0]  # some of them are near where they should be
    found = fit_motion(eqx.tree_at(lambda t: t.points, tracks, jnp.asarray(points)))
    focal = np.asarray(found.focal)
    assert np.flatnonzero(np.isnan(focal)).tolist() == [bad]
    assert np.flatnonzero(np.isnan(np.asarray(found.focal_std))).tolist() == [bad]
    others = np.arange(FRAMES) != bad
    assert abs(focal / np.asarray(fit.focal) - 1)[others].max() < 0.004
    assert found.fit.result == RESULTS.successful


@pytest.mark.slow
def test_frames_without_tracks_do_not_matter(noisy, fit):
    tracks, dark = noisy.tracks, [6, 10, 11, 17]
    track, view = np.nonzero(np.asarray(tracks.mask))
    frame = np.asarray(tracks.frame)[track, view]
    seen = np.isin(np.arange(FRAMES), dark, invert=True)
    with pytest.warns(UserWarning, match="have one view"):
        fewer = Tracks.from_arrays(
            track[seen[frame]],
            frame[seen[frame]],
            np.asarray(tracks.points)[track, view][seen[frame]],
            image_size=SIZE,
            frames=FRAMES,
        )
    asked = Asked(PolynomialZoom(), RadialPolynomial(), 2, None, None)
    fixed = problem_of(Given(fewer, None, None, None, None), asked).data.fixed
    assert np.flatnonzero(fixed).tolist() == [0, *dark]  # no frame after one of them: its rotation is free
    other = fit_motion(fewer)
    missed = (np.asarray(other.focal) - np.asarray(fit.focal))[seen]
    assert (abs(missed) < np.asarray(fit.focal_std)[seen]).all()
    np.testing.assert_allclose(other.noise, fit.noise, rtol=0.03)
    assert np.isfinite(other.focal).tolist() == seen.tolist()


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"focal": np.array([1.0, 2.0]), "focal_std": 1.0}, "a number for each"),
        ({"focal": np.full(FRAMES, 900.0), "focal_std": np.ones(3)}, "a number for each|focal_std"),
        ({"focal": np.full(FRAMES, -5.0), "focal_std": 1.0}, "must be positive"),
        ({"focal": np.full(FRAMES, np.inf), "focal_std": 1.0}, "focal finite or NaN"),
        ({"focal": np.full(FRAMES, 900.0), "focal_std": np.nan}, "must be positive"),
        ({"focal": np.full(FRAMES, 900.0)}, "give both, or neither"),
        ({"focal_std": 1.0}, "give both, or neither"),
        ({"readout": -3.0}, "from -1 to 1"),
        ({"readout": np.nan}, "from -1 to 1"),
        ({"readout": "x"}, "from -1 to 1|readout"),
        ({"readout": np.zeros(2)}, "from -1 to 1|readout"),
        ({"tracks": "clip.mp4"}, "tracks"),
    ],
)
def test_mistakes_are_told(noisy, changed, message):
    with pytest.raises((ValueError, TypeError), match=message):
        fit_motion(**({"tracks": noisy.tracks} | changed))


@pytest.fixture(scope="module")
def lines(lens, path):
    return motion_lines(lens, path[0], noise=0.2, seed=1)


@pytest.fixture(scope="module")
def with_lines(noisy, lines):
    return fit_motion(noisy.tracks, lines=lines)


@pytest.mark.slow
def test_lines_of_no_weight_are_as_if_they_were_not_there(lens, noisy, lines, with_lines):
    other = eqx.tree_at(lambda lens: lens.zoom.parameters, lens, -3 * lens.zoom.parameters)
    wrong = motion_lines(other, np.asarray(lines.focal), noise=0.2, seed=2)
    number = len(lines.frame)
    points = [line for some in (lines, wrong) for line in some.to_ragged()]
    both = Lines.from_ragged(
        points,
        np.concatenate([lines.frame, wrong.frame]),
        lines.focal,
        image_size=lines.image_size,
        focal_unit="px",
    )
    weight = np.where(np.arange(len(points)) < number, 7.0, 0.0)
    fit = fit_motion(noisy.tracks, lines=both.weighted(weight))
    np.testing.assert_allclose(fit.focal, with_lines.focal, rtol=1e-6)
    assert float(fit.line_noise) == pytest.approx(float(with_lines.line_noise), rel=1e-6)
    ignored = fit_motion(noisy.tracks, lines=both, throw=False)
    assert abs(np.asarray(ignored.focal) / np.asarray(with_lines.focal) - 1).max() > 1e-3


def test_lines_of_the_same_frames_make_the_lens_better(lens, path, fit, with_lines):
    assert with_lines.fit.result == RESULTS.successful
    assert displaced(lens, with_lines, path[0]) < 0.8 * displaced(lens, fit, path[0])
    std = np.asarray(with_lines.focal_std)
    assert (std < 0.5 * np.asarray(fit.focal_std)).all()
    assert (abs(np.asarray(with_lines.focal) - path[0]) < 4 * std).all()
    assert np.sqrt(with_lines.covariance[0, 0]) < 0.7 * np.sqrt(fit.covariance[0, 0])
    # Distances across a line have the noise of one coordinate.
    assert float(with_lines.line_noise) == pytest.approx(0.2, rel=0.1)
    assert np.isnan(fit.line_noise)


@pytest.mark.slow
def test_lines_with_the_same_errors_in_every_frame_count_as_few():
    lens = ZoomLens(
        PolynomialZoom(0, jnp.array([[-0.05, 0.01]]), jnp.array(1800.0)),
        jnp.array([645.0, 356.0]),
        jnp.array([1800.0, 2000.0]),
        SIZE,
        "px",
    )
    path = pan_and_zoom(lens, FRAMES, pan=5, tilt=2)
    scene = motion_tracks(lens, *path, views=60, life=12, noise=0.2, seed=1)
    off, std = [], []
    for bend in (0.0, 1.0):
        lines = marked(lens, path, bend)
        found = fit_motion(scene.tracks, lines=lines, throw=False)
        off.append(np.mean(np.log(np.asarray(found.focal) / path[0])))
        std.append(np.sqrt(found.covariance[-1, -1]))
    assert (np.abs(off) < 2.5 * np.array(std)).all()
    assert std[1] > 2 * std[0]


def marked(lens, path, bend):
    """Eight markings of a scene in every frame, each bent by so many px, seen with little noise."""
    rng, points, frame = np.random.default_rng(0), [], []
    ends = np.column_stack([rng.uniform(-0.3, 0.3, (16, 1)), rng.uniform(-0.15, 0.15, (16, 1))])
    along = np.linspace(0, 1, 200)[:, None]
    bends = bend / 1800 * rng.choice([-1, 1], 8)
    for number, (f, turn) in enumerate(zip(*path, strict=True)):
        for first, last, bent in zip(ends[::2], ends[1::2], bends, strict=True):
            across = np.array([first[1] - last[1], last[0] - first[0]]) / np.linalg.norm(last - first)
            scene = first + along * (last - first) + 4 * bent * along * (1 - along) * across
            ahead = np.column_stack([scene, np.ones(len(scene))]) @ turn.T
            straight = np.asarray(lens.centre) + f * ahead[:, :2] / ahead[:, 2:]
            seen = np.asarray(lens(float(f)).distort(straight)) + rng.normal(0, 0.1, straight.shape)
            inside = ((seen >= 0) & (seen <= np.array(SIZE) - 1)).all(axis=1)
            if inside.sum() > 20:
                points.append(seen[inside])
                frame.append(number)
    return Lines.from_ragged(points, frame, path[0], image_size=SIZE, focal_unit="px")


def test_lines_may_be_compressed_and_have_any_focal_length(noisy, lines, with_lines):
    middle = (np.array(SIZE) - 1) / 2
    small = compress_any_centre(lines.about(middle))
    small = eqx.tree_at(lambda lines: lines.focal, small, jnp.ones(FRAMES))
    other = fit_motion(noisy.tracks, lines=small)
    np.testing.assert_allclose(other.focal, with_lines.focal, rtol=1e-5)


def test_lines_of_some_frames_alone_count_there(noisy, lines, with_lines, fit):
    some = np.flatnonzero(np.arange(FRAMES) % 3 == 0)
    here = np.isin(lines.frame, some)
    few = Lines.from_ragged(
        [np.asarray(p)[np.asarray(m)] for p, m in zip(lines.points[here], lines.mask[here], strict=True)],
        np.searchsorted(some, np.asarray(lines.frame)[here]),
        np.ones(len(some)),
        image_size=SIZE,
    )
    found = fit_motion(noisy.tracks, lines=few, line_frames=some)
    std, most, least = (np.sqrt(f.covariance[-1, -1]) for f in (found, fit, with_lines))
    assert 1.1 * least < std < 0.9 * most
    assert float(found.line_noise) == pytest.approx(0.2, rel=0.15)


def test_a_wrong_line_does_little_harm(lens, path, noisy, lines, with_lines):
    t = np.linspace(100, 600, 60)
    bent = np.stack([t + 100, 300 + 0.0004 * (t - 350) ** 2], axis=1)  # by 25 px
    each = [np.asarray(p)[np.asarray(m)] for p, m in zip(lines.points, lines.mask, strict=True)]
    frame = [*np.asarray(lines.frame), 2, 5]
    more = Lines.from_ragged([*each, bent, bent], frame, path[0], image_size=SIZE, focal_unit="px")
    other = fit_motion(noisy.tracks, lines=more)
    assert displaced(lens, other, path[0]) < displaced(lens, with_lines, path[0]) + 0.1


def test_lines_of_something_else_are_refused(noisy, lines, path):
    few = Lines.from_ragged([np.asarray(lines.points[0])[:3]], [0], path[0][:1], image_size=SIZE)
    with pytest.raises(ValueError, match="which of the 24 frames"):
        fit_motion(noisy.tracks, lines=few)
    with pytest.raises(ValueError, match="centre of the image"):
        fit_motion(noisy.tracks, lines=compress_any_centre(lines.about(np.array([100.0, 100.0]))))
    with pytest.raises(ValueError, match="compressed for 2 terms, but 3"):
        fit_motion(noisy.tracks, lines=compress_any_centre(lines.about((np.array(SIZE) - 1) / 2)), terms=3)
    for wrong in (np.array([0.5]), np.array([0, 1]), np.array([FRAMES]), np.array([-1])):
        with pytest.raises((ValueError, TypeError), match="line_frames"):
            fit_motion(noisy.tracks, lines=few, line_frames=wrong)
    two = Lines.from_ragged(lines.to_ragged()[:2], [0, 1], path[0][:2], image_size=SIZE)
    with pytest.raises(ValueError, match="each frame of the tracks once, but 3 is there 2 times"):
        fit_motion(noisy.tracks, lines=two, line_frames=np.array([3, 3]))
    with pytest.raises(ValueError, match="line_frames is for argument lines"):
        fit_motion(noisy.tracks, line_frames=np.arange(FRAMES))
    with pytest.raises(ValueError, match="given a BrownConrady"):
        fit_motion(noisy.tracks, lines=lines, distortion_model=BrownConrady())


@pytest.fixture(scope="module")
def rolling(lens, path):
    # As many tracks as those of a camera that does not turn, or nearly: the programs are the same.
    return tracked(lens, slow(lens), noise=0.3, shutter=0.6, views=53, life=11)


def slow(lens):
    """A quarter of the way there and back: 24 frames of a real clip turn by some degrees, not by dozens."""
    return tuple(leaf[:FRAMES] for leaf in pan_and_zoom(lens, 4 * FRAMES, pan=40, tilt=10))


def test_a_rolling_shutter_is_measured(lens, rolling, fit):
    found = fit_motion(rolling.tracks)
    assert found.fit.result == RESULTS.successful
    assert abs(found.readout - 0.6) < 0.03
    assert found.readout_std < 0.01
    assert displaced(lens, found, slow(lens)[0]) < 0.6
    # A global shutter is one that takes no time.
    assert abs(fit.readout) < 4 * fit.readout_std < 0.06


def test_a_shutter_that_is_told_is_taken(lens, rolling):
    told, denied = (fit_motion(rolling.tracks, readout=value, throw=False) for value in (0.6, 0))
    assert abs(told.readout - 0.6) < 1e-3
    focal = slow(lens)[0]
    assert displaced(lens, told, focal) < 0.6
    assert displaced(lens, denied, focal) > 2 * displaced(lens, told, focal)


def test_a_camera_that_stands_still_tells_nothing_of_its_shutter(lens, path):
    focal, rotation = path[0][:1].repeat(8), path[1][:1].repeat(8, axis=0)
    fit = fit_motion(tracked(lens, (focal, rotation), noise=0.3).tracks, throw=False)
    assert fit.readout_std > 0.4


@pytest.fixture(scope="module")
def off_axis(lens, path):
    return tracked(lens, path, noise=0.3, pupil=0.3)


@pytest.fixture(scope="module")
def with_levers(off_axis):
    return fit_motion(off_axis.tracks)


def test_a_pupil_off_the_axis_is_seen_and_drift_is_none(lens, path, fit, off_axis, with_levers):
    true = np.std(0.3 / np.linalg.norm(off_axis.points, axis=1))
    assert with_levers.parallax_score > 3
    assert with_levers.parallax == pytest.approx(true, rel=0.4)
    assert fit.parallax_score < 3
    assert fit_motion(tracked(lens, path, noise=0.3, drift=0.1).tracks).parallax_score < 3


def test_near_points_that_move_otherwise_are_allowed_for(fit, off_axis, with_levers, monkeypatch):
    true = 0.3 / np.linalg.norm(off_axis.points, axis=1)
    assert with_levers.lever_std == pytest.approx(np.std(true), rel=0.3)
    assert np.corrcoef(with_levers.lever, true)[0, 1] > 0.5
    monkeypatch.setattr("zoomjax.fit._motion_stages.is_seen", lambda *_: False)
    without = fit_motion(off_axis.tracks)
    assert with_levers.noise == pytest.approx(float(fit.noise), rel=0.05)
    assert without.noise > 1.08 * with_levers.noise
    assert not without.lever.any()
    assert without.lever_std == 0


def test_levers_are_guessed_on_the_side_that_the_tracks_tell():
    for side in (-1, 0, 0.6, 1):
        levers = guessed_levers(Spread(jnp.array(1e-3), jnp.array(side)), 3)
        np.testing.assert_allclose(levers.value, levers.mean)
        assert levers.mean == pytest.approx(2.5e-3 * side)
        # Of an even chance for 1.25 to 3.75 deviations, on both sides as likely as they are.
        assert levers.mean**2 + levers.mean_std**2 == pytest.approx(1e-6 * (2.5**2 + 1.25**2))


@pytest.mark.slow
@pytest.mark.parametrize("pupil", [0.5, -0.5])
def test_what_levers_have_in_common_is_on_the_side_of_the_near_points(lens, path, pupil, monkeypatch):
    scene = motion_tracks(lens, *path, views=200, life=24, noise=0.3, seed=3, pupil=pupil)
    fit = fit_motion(scene.tracks)
    true = pupil / np.linalg.norm(scene.points, axis=1)
    assert 0.5 < fit.lever_mean / np.mean(true) < 1.2
    monkeypatch.setattr("zoomjax.fit._motion_levers.COMMON", 0.0)
    without = fit_motion(scene.tracks)
    # Seen by all alike it looks like a longer lens: by that share, whatever the frame.
    share = np.asarray(without.focal) / np.asarray(fit.focal) - 1
    np.testing.assert_allclose(share, fit.lever_mean, rtol=0.2)
    assert without.lever_mean == 0


def test_what_all_levers_have_in_common_is_in_the_bands(path, fit, with_levers):
    # Seen by all alike it looks like a longer lens: by that share, whatever the frame.
    least, most = (float(with_levers.lever_std) * times for times in (1.25, np.hypot(1.25, 2.5)))
    common = np.sqrt(most**2 - float(with_levers.lever_mean) ** 2)
    assert least < 1.001 * common
    std = np.asarray(with_levers.focal_std) / np.asarray(with_levers.focal)
    alone = np.sqrt(std**2 - common**2)
    assert np.isfinite(alone).all()
    assert np.sqrt(with_levers.covariance[-1, -1]) == pytest.approx(np.mean(std), rel=0.1)
    assert abs(np.mean(np.asarray(with_levers.focal) / path[0] - 1)) < 3 * np.mean(std)
    assert fit.lever_std == fit.lever_mean == 0


@pytest.mark.parametrize("shared", [{"pupil": 0.3}, {"drift": 0.2}])
def test_errors_that_views_of_a_track_share_widen_the_bands(lens, path, fit, shared):
    found = fit_motion(tracked(lens, path, noise=0.3, **shared).tracks)
    std = np.sqrt(found.covariance[-1, -1])
    assert std / found.noise > 1.15 * np.sqrt(fit.covariance[-1, -1]) / fit.noise
    assert abs(np.mean(np.asarray(found.focal) / path[0] - 1)) < 3 * std


def test_few_tracks_tell_no_parallax(lens, path):
    few = motion_tracks(lens, *path, views=5, life=60, noise=0.3)
    assert np.isnan(fit_motion(few.tracks, throw=False).parallax)


def test_points_are_carried_to_where_other_frames_show_them(lens, path, noisy, fit):
    track, view = np.nonzero(np.asarray(noisy.tracks.mask))
    frame, points = (np.asarray(of)[track, view] for of in (noisy.tracks.frame, noisy.tracks.points))
    first = np.searchsorted(track, track)
    there = frame == 9
    carried = fit.carried(frame[first][there], points[first][there], 9)
    missed = np.linalg.norm(carried - points[there], axis=1)
    assert len(missed) > 30
    assert np.median(missed) < 1.0
    behind = fit.carried(np.array([0]), np.array([[-1e6, 0.0]]), FRAMES - 1)
    assert behind.shape == (1, 2)


def test_nothing_is_carried_from_one_scene_to_another(fit):
    cut = eqx.tree_at(lambda fit: fit.scene, fit, (jnp.arange(FRAMES) > 11).astype(jnp.int32))
    assert np.isnan(cut.carried(np.array([3]), np.array([[640.0, 360.0]]), 12)).all()
    assert np.isfinite(cut.carried(np.array([3]), np.array([[640.0, 360.0]]), 4)).all()


@pytest.mark.parametrize(("frames", "life", "whole"), [(60, 60, True), (60, 20, False), (300, 100, False)])
def test_tracks_of_short_clips_stay_whole_and_of_long_ones_do_not(frames, life, whole):
    track, frame = np.repeat([0, 1, 2], life), np.tile(np.arange(life), 3)
    frame[-life:] += frames - life
    points = np.random.default_rng(0).uniform(0, 700, (3 * life, 2))
    tracks = Tracks.from_arrays(track, frame, points, image_size=SIZE, frames=frames)
    asked = Asked(PolynomialZoom(), RadialPolynomial(), 2, None, None)
    problem = problem_of(Given(tracks, None, None, None, None), asked)
    assert (problem.data.structure.blocks == 1) == whole
    assert len(np.unique(problem.piece)) == (3 if life <= 48 or whole else 9)


def test_some_tracks_of_a_long_clip_are_drawn_and_enough_in_each_frame(noisy, monkeypatch):
    given = Given(noisy.tracks, None, None, None, None)
    assert thinned(given) is None  # a short one
    monkeypatch.setattr(_motion_problem, "_MANY_VIEWS", 100)
    assert thinned(given) is None  # it has fewer than twice what is enough
    monkeypatch.setattr(_motion_problem, "_ENOUGH", 15)
    some, all_ = thinned(given).tracks, noisy.tracks
    counts = [np.bincount(t.frame[t.mask], minlength=FRAMES) for t in (some, all_)]
    assert (counts[0] >= np.minimum(15, counts[1])).all()
    assert counts[0].sum() < counts[1].sum() / 2
    place = np.searchsorted(all_.number, some.number)
    np.testing.assert_array_equal(some.points, np.asarray(all_.points)[place])
    assert (some.frames, some.image_size) == (all_.frames, all_.image_size)


def test_going_the_way_with_some_tracks_ends_at_the_same_fit(noisy, fit, monkeypatch):
    views = []
    begun = motion.begun

    def watched(data, *rest):
        views.append(int(data.there.sum()))
        return begun(data, *rest)

    monkeypatch.setattr(motion, "begun", watched)
    monkeypatch.setattr(_motion_problem, "_MANY_VIEWS", 100)
    monkeypatch.setattr(_motion_problem, "_ENOUGH", 20)
    other = fit_motion(noisy.tracks)
    assert views[0] < noisy.tracks.mask.sum() / 2
    tenth = 0.1 * np.asarray(fit.focal_std)
    np.testing.assert_array_less(np.abs(other.focal - fit.focal), tenth)
    np.testing.assert_allclose(other.focal_std, fit.focal_std, rtol=0.01)
    np.testing.assert_allclose(other.noise, fit.noise, rtol=1e-3)
    off = np.abs(np.asarray(other.residual) - np.asarray(fit.residual))[np.asarray(noisy.tracks.mask)]
    assert (off > 0.02).mean() < 0.01  # rays of views that disagree are not where the loss is least


def test_tracks_that_alone_link_two_parts_of_a_shot_are_not_left_out(monkeypatch):
    """One of 41 goes from frame 9 to frame 10, and drawing leaves it out."""
    track = np.repeat(np.arange(41), 10)
    frame = np.concatenate([np.tile(np.arange(10), 20), np.tile(np.arange(10, 20), 20), np.arange(5, 15)])
    points = np.random.default_rng(0).uniform(0, 700, (len(track), 2))
    tracks = Tracks.from_arrays(track, frame, points, image_size=SIZE, frames=20)
    views = []
    monkeypatch.setattr(_motion_problem, "_MANY_VIEWS", 100)
    monkeypatch.setattr(_motion_problem, "_ENOUGH", 1)

    def stop(data, *_):
        views.append(int(data.there.sum()))
        raise RuntimeError

    monkeypatch.setattr(motion, "begun", stop)
    assert 40 not in thinned(Given(tracks, None, None, None, None)).tracks.number
    with pytest.raises(RuntimeError):
        fit_motion(tracks)
    assert views == [410]


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["noisy", "off_axis"])
def test_derivatives_are_those_of_the_minimum(scene, lines, request):
    """Newton's method from the fit gives the minimum for other points, with the noise held."""
    noisy = request.getfixturevalue(scene)
    asked = Asked(PolynomialZoom(), RadialPolynomial(), 2, PolynomialZoom(degree=1), None)
    given = Given(noisy.tracks, lines, None, None, None)
    _, model, noise = _fitted(given, asked, True)
    data = problem_of(given, asked).data
    rng = np.random.default_rng(0)
    along = jnp.asarray(rng.normal(size=data.points.shape)) * data.there[:, None]

    def minimum(h):
        moved, found = eqx.tree_at(lambda data: data.points, data, data.points + h * along), model
        for _ in range(5):
            found = sensitive(moved, found, noise)
        return values(found)

    def values(found):
        return jnp.concatenate([found.path.log_focal[:FRAMES], found.zoom.parameters.ravel()])

    best = model
    for _ in range(5):
        best = sensitive(data, best, noise)
    _, tangent = jax.jvp(
        lambda points: values(sensitive(eqx.tree_at(lambda d: d.points, data, points), best, noise)),
        (data.points,),
        (along,),
    )
    finite = (minimum(1e-3) - minimum(-1e-3)) / 2e-3
    np.testing.assert_allclose(tangent, finite, rtol=2e-3, atol=2e-3 * abs(finite).max())


@pytest.mark.slow
def test_a_fit_is_differentiable_outside_of_jit(noisy, lines):
    points = jnp.asarray(noisy.tracks.points)

    def corner(points):
        tracks = eqx.tree_at(lambda tracks: tracks.points, noisy.tracks, points)
        found = fit_motion(tracks, lines=lines)
        return jnp.log(found.focal[5]) + found.lens.zoom.parameters[0, 0] + found.rays[3, 0]

    slope = jax.grad(corner)(points)
    assert np.isfinite(slope).all()
    seen = np.asarray(noisy.tracks.mask)
    assert (np.abs(slope[seen]).max(axis=1) > 0).mean() > 0.99
    assert (slope[~seen] == 0).all()


def test_a_fit_that_does_not_settle_says_what_to_do(fit):
    result = RESULTS.promote(optx.RESULTS.nonlinear_max_steps_reached)
    unsettled = eqx.tree_at(lambda fit: fit.fit.result, fit, result)
    with pytest.raises(RuntimeError, match=r"turn and zoom farther.*did not settle") as told:
        thrown_motion(unsettled)
    assert "max_steps" not in str(told.value)


def test_rotations_there_and_back(rng):
    for size in (0.0, 1e-9, 1e-3, 1.0, 3.0):
        vector = size * np.array([0.6, -0.48, 0.64])
        matrix = jax.vmap(turned, (1, None), 1)(jnp.eye(3), jnp.asarray(vector))
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-14)
        np.testing.assert_allclose(rotation_vector(matrix), vector, atol=1e-9)


def test_rays_shrink_to_the_axis():
    ray = jnp.array([np.sin(0.4), 0.0, np.cos(0.4)])
    np.testing.assert_allclose(shrunk_ray(ray, jnp.array(0.5)), [np.sin(0.2), 0, np.cos(0.2)], atol=1e-15)
    axis = jnp.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(shrunk_ray(axis, jnp.array(0.5)), axis, atol=1e-15)
    assert np.isfinite(jax.jacfwd(shrunk_ray)(axis, jnp.array(0.5))).all()
