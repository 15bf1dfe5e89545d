"""The next photo: what is suggested is what helps most when it is really added."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes
from zoomjax.trust.next_photo import candidate_lines

SIZE = (640, 424)
RANGE = (20.56, 127.36)
NOISE = 0.1


@pytest.fixture(scope="module")
def lens():
    return scenes.nikkor_18_200(SIZE)


def noisy(points, seed):
    return points + NOISE * np.random.default_rng(seed).standard_normal(points.shape)


def fitted(lines):
    small = zj.compress(lines)
    return zj.fit_zoom(small), small


@pytest.fixture(scope="module")
def wide(lens):
    """A board that fills photos, all at the wide end but one small corner of the zoom."""
    return scenes.board_lines(lens, np.array([20.56, 22.0, 24.0, 27.0, 30.0]), spacing=12, noise=NOISE)


@pytest.fixture(scope="module")
def central(lens):
    """At focal lengths over the whole range, lines in the middle of the image only."""
    lines, frame = [], []
    focal = scenes.focal_sweep(5)
    t = np.linspace(-110, 110, 40)
    for index, f in enumerate(focal):
        for offset in (-110.0, -60.0, 60.0, 110.0):
            for straight in ((t, np.full(40, offset)), (np.full(40, offset), t)):
                seen = lens(f).distort(np.stack(straight, -1) + np.asarray(lens.centre))
                lines.append(noisy(np.asarray(seen), len(lines)))
                frame.append(index)
    return zj.Lines.from_ragged(lines, frame, focal, image_size=SIZE)


@pytest.mark.slow
def test_photos_at_the_wide_end_want_one_at_the_long_end(wide):
    suggestion = zj.suggest_next(*fitted(wide), focal_range=RANGE)
    assert suggestion.focal == pytest.approx(RANGE[1])
    assert suggestion.after < 0.5 * suggestion.before
    assert "f = 127.4 mm" in suggestion.sentence


@pytest.mark.slow
def test_lines_in_the_middle_want_some_at_the_border(central):
    """Upright lines along the left or right edge, or through the corners, which is nearly as good."""
    suggestion = zj.suggest_next(*fitted(central))
    assert suggestion.region in ("the left or right edge", "the corners")
    assert suggestion.table.shape == (5, 9, 2)
    in_part = dict(zip(suggestion.regions, suggestion.table.min(axis=(0, 2)), strict=True))
    assert suggestion.after < 0.7 * in_part["the middle"]
    for name, std in in_part.items():
        assert std < 1.1 * suggestion.after if "corner" in name else std > 0.99 * suggestion.after


def mean_std(fit, focals):
    """The geometric mean over image and range."""
    x, y = (np.linspace(0, side - 1, 6) for side in SIZE)
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 1, 2)
    return float(jnp.exp(jnp.mean(jnp.log(zj.displacement_std(fit, points, focal=focals)))))


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["wide", "central"])
def test_adding_what_is_suggested_helps_more_than_adding_others(scene, lens, request):
    """Photos really added and refitted: the bands are the predicted ones, and so is their order."""
    lines = request.getfixturevalue(scene)
    fit, small = fitted(lines)
    suggestion = zj.suggest_next(fit, small, focal_range=RANGE)
    number = int(np.median(np.bincount(np.asarray(lines.frame))))
    zero = jnp.zeros((lines.focal.shape[0], 1))
    extent = jnp.sum(small.corrected(zero) ** 2, axis=(1, 2)) / small.counts
    length = jnp.sqrt(12 * jnp.median(extent))
    points = int(np.median(small.counts))
    before, found = lines.to_ragged(), {}
    best = np.unravel_index(np.argmin(suggestion.table), suggestion.table.shape)
    candidates = candidate_lines(SIZE, float(length))
    for at in {(0, 4, 0), (0, 8, 1), (2, 1, 0), (3, 6, 1), (4, 4, 1), (4, 8, 0), tuple(map(int, best))}:
        f = float(suggestion.focals[at[0]])
        three = [photographed(line, lens(f), points) for line in candidates[at[1:]]]
        added = [three[i % 3] for i in range(number)]
        more = [noisy(line, 1000 + i) for i, line in enumerate(added)]
        both = zj.Lines.from_ragged(
            [*before, *more],
            [*np.asarray(lines.frame), *[len(lines.focal)] * number],
            [*np.asarray(lines.focal), suggestion.focals[at[0]]],
            image_size=SIZE,
        )
        found[at] = (mean_std(fitted(both)[0], suggestion.focals), float(suggestion.table[at]))
    real, predicted = np.array(list(found.values())).T
    assert np.argmin(real) == np.argmin(predicted)
    np.testing.assert_allclose(real, predicted, rtol=0.3)  # the noise of each is estimated anew


def photographed(line, distortion, number):
    """A straight line of the scene through the ends of a line of the image, as the image shows it."""
    start, end = np.asarray(distortion.undistort(line[[0, -1]]))
    return np.asarray(distortion.distort(start + np.linspace(0, 1, number)[:, None] * (end - start)))


@pytest.mark.parametrize("which", ["wide", "central"])
def test_float32_is_enough(which, request):
    """Its squares are not: in them weak directions are lost, and others seem the weak ones."""
    lines = request.getfixturevalue(which)
    single = [np.asarray(line, np.float32) for line in lines.to_ragged()]
    short = zj.Lines.from_ragged(single, lines.frame, np.asarray(lines.focal, np.float32), image_size=SIZE)
    given, rounded = (zj.suggest_next(*fitted(each)) for each in (lines, short))
    np.testing.assert_allclose(rounded.table / rounded.before, given.table / given.before, rtol=2e-3)
    assert rounded.focal == pytest.approx(given.focal, rel=1e-6)
    assert (rounded.region, rounded.direction) == (given.region, given.direction)


@pytest.mark.slow
def test_compressed_or_not_is_the_same(central):
    fit, small = fitted(central)
    np.testing.assert_allclose(
        zj.suggest_next(fit, central).table, zj.suggest_next(fit, small).table, rtol=1e-6
    )


@pytest.mark.slow
def test_where_nothing_is_determined_something_is_suggested_all_the_same(lens):
    t = np.linspace(-200, 200, 50)
    radial = [np.stack([319.5 + t * c, 211.5 + t * s], -1) for c, s in ((1, 0), (0, 1), (0.6, 0.8))]
    lines = zj.Lines.from_ragged(radial * 3, np.repeat([0, 1, 2], 3), [20, 40, 80], image_size=SIZE)
    suggestion = zj.suggest_next(*fitted(lines))
    assert suggestion.before == suggestion.after == np.inf
    assert np.isfinite(suggestion.table).all()
    assert suggestion.sentence.endswith("would determine the lens best.")


@pytest.mark.parametrize("bad", [(0.0, 50.0), (50.0, 20.0), (20.0, np.inf), (20.0,), "20,30"])
@pytest.mark.usefixtures("unchecked")
def test_a_range_that_is_none_raises(bad, central):
    with pytest.raises(ValueError, match="focal_range must be two positive numbers"):
        zj.suggest_next(*fitted(central), focal_range=bad)


@pytest.mark.slow
def test_a_single_focal_length_is_a_range_too(central):
    one = zj.compress(central).take(jnp.arange(8), jnp.ones(8, bool))
    fit = zj.fit_zoom(one, zoom=zj.PolynomialZoom(degree=0))
    suggestion = zj.suggest_next(fit, one)
    assert suggestion.table.shape == (1, 9, 2)
    json.dumps([suggestion.focal, suggestion.before, suggestion.after, suggestion.sentence])


def test_candidates_are_in_their_part_of_the_image():
    lines = candidate_lines(SIZE, 100.0)
    assert lines.shape == (9, 2, 3, 25, 2)
    assert (lines >= 0).all()
    assert (lines <= np.array(SIZE) - 1).all()
    middles = lines.mean(axis=(2, 3)) + 0.5
    np.testing.assert_allclose(middles[4], np.array([SIZE, SIZE]) / 2)
    assert (middles[0] < np.array(SIZE) / 3).all()
    np.testing.assert_allclose(np.linalg.norm(lines[..., -1, :] - lines[..., 0, :], axis=-1), 100)
    longest = candidate_lines(SIZE, 1e4)
    np.testing.assert_allclose(longest[1, 0, 1, [0, -1], 0], [0, SIZE[0] - 1])


def test_without_lines_that_count_nothing_is_suggested(fit, small):
    with pytest.raises(ValueError, match="must have a usable line"):
        zj.suggest_next(fit, small.weighted(np.zeros(len(small.frame))))


def test_lines_that_say_nothing_at_all_want_any_photo():
    t = np.linspace(-200, 200, 40)
    cross = [320 + np.stack([t * along, t * (1 - along)], axis=-1) for along in (0, 1)]
    lines = zj.Lines.from_ragged(2 * cross, [0, 0, 1, 1], [24, 50], image_size=(641, 641))
    fit = zj.fit_zoom(lines, zoom=zj.PolynomialZoom(1), throw=False)
    suggestion = zj.suggest_next(fit, lines)
    assert np.isinf(suggestion.before)
    assert np.isfinite(suggestion.table).all()
    assert "would determine the lens best" in suggestion.sentence
