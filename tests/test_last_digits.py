"""No result is decided by the last digits of what is given: mirrored lines, exact lines, ties.

A scene with symmetries has lines of the same length, error and pull at the fit. Which of two equal numbers
is the larger one is a matter of rounding then, and must not matter.
"""

import equinox as eqx
import jax
import numpy as np
import pytest

import zoomjax as zj
from zoomjax._core.arrays import widest
from zoomjax.models import Division

SIZE = (960, 640)
FOCAL = np.array([20.0, 30.0, 50.0, 80.0])


def mirrored(noise=0.0):
    """The same upright and level lines, some through the centre, at each focal length."""
    t, points, rng = np.linspace(0, 1, 21), [], np.random.default_rng(3)
    (w, h), middle = SIZE, (np.array(SIZE) - 1) / 2
    for f in FOCAL:
        k = np.array([-0.08, 0.01]) * FOCAL[0] / f
        bend = zj.Distortion(k, middle, np.hypot(*middle))
        upright = [np.stack([np.full(21, x), 40 + t * (h - 81)], -1) for x in np.linspace(80, w - 81, 9)]
        level = [np.stack([40 + t * (w - 81), np.full(21, y)], -1) for y in np.linspace(60, h - 61, 7)]
        points += [np.asarray(bend.distort(line)) for line in upright + level]
    points = [line + noise * rng.standard_normal(line.shape) for line in points]
    return zj.Lines.from_ragged(points, np.repeat(np.arange(4), 16), FOCAL, image_size=SIZE)


def upside_down():
    """Lines with noise, each but one also turned by half a turn about the centre: two for each error.

    The line of median error is one of two then, of which the better half of the lines has one.
    """
    points = np.round(1024 * np.asarray(mirrored(0.2).points).reshape(4, 16, 21, 2)) / 1024
    half = np.concatenate([points[:, :4], points[:, 9:12]], axis=1)
    both = np.concatenate([half, np.array(SIZE) - 1 - half], axis=1).reshape(-1, 21, 2)
    both, frame = (np.delete(of, 20, axis=0) for of in (both, np.repeat(np.arange(4), 14)))
    return zj.Lines.from_ragged(list(both), frame, FOCAL, image_size=SIZE)


def moved(lines, seed):
    """Lines whose points have other last digits."""
    digits = np.random.default_rng(seed).choice([-1, 0, 1], np.shape(lines.points))
    return eqx.tree_at(lambda lines: lines.points, lines, np.asarray(lines.points) * (1 + 2e-16 * digits))


def numbers(result):
    leaves = [np.asarray(leaf, float) for leaf in jax.tree.leaves(result) if eqx.is_array(leaf)]
    return np.concatenate([leaf.ravel() for leaf in leaves if leaf.ndim])


def chosen(selection):
    return [selection.chosen.name, selection.best.name]


WAYS = {
    "zoom": lambda lines: zj.fit_zoom(zj.compress(lines)),
    "smooth": lambda lines: zj.fit_zoom(zj.compress(lines), zoom=zj.SmoothZoom()).covariance,
    "division": lambda lines: zj.fit_zoom(lines, distortion_model=Division(), terms=1).covariance,
    "robust": lambda lines: zj.fit_robust(zj.compress(lines)),
    "frames": lambda lines: zj.fit_frames(zj.compress(lines)).coefficients,
    "held out": lambda lines: zj.trust.cross_validate_zoom(zj.compress(lines)),
}


@pytest.mark.parametrize("name", WAYS)
def test_mirrored_lines(name):
    lines = upside_down() if name == "robust" else mirrored()
    expected = numbers(WAYS[name](lines))
    for seed in range(3):
        np.testing.assert_allclose(numbers(WAYS[name](moved(lines, seed))), expected, rtol=1e-7, atol=1e-9)


def test_the_best_of_models_that_are_all_exact():
    expected = chosen(zj.select_model(zj.compress(mirrored(), 3)))
    assert expected[0] == expected[1]
    for seed in range(3):
        assert chosen(zj.select_model(zj.compress(moved(mirrored(), seed), 3))) == expected


def with_focal(lines, focal):
    return zj.Lines.from_ragged(lines.to_ragged(), lines.frame, focal, image_size=lines.image_size)


@pytest.mark.parametrize("near", [np.nextafter(30.0, 31), float(np.float32(4.3)) / 4.3 * 30])
@pytest.mark.parametrize("kind", [np.asarray, jax.numpy.asarray, list])
def test_focal_lengths_that_differ_by_rounding_are_one(near, kind):
    lines = mirrored(0.2)
    known = with_focal(lines, np.array([20.0, 30.0, 30.0, 80.0]))
    given = with_focal(lines, kind([20.0, 30.0, near, 80.0]))
    assert sorted(set(np.asarray(given.focal).tolist())) == [20.0, min(30.0, near), 80.0]
    with pytest.raises(ValueError, match="4 or more distinct focal lengths, but there are 3"):
        zj.fit_zoom(given, zoom=zj.PolynomialZoom(3))
    knots = [zj.fit_zoom(zj.compress(of), zoom=zj.models.TableZoom()).lens.zoom for of in (known, given)]
    assert knots[1].knots.shape == (3,)
    np.testing.assert_allclose(knots[1].parameters, knots[0].parameters, rtol=1e-6)
    folds = [zj.select_model(zj.compress(of)) for of in (known, given)]
    assert folds[0].hold_out == folds[1].hold_out
    assert folds[0].chosen.name == folds[1].chosen.name


def test_focal_lengths_that_are_others_stay():
    focal = np.array([20.0, 20.0 * (1 + 2e-6), 30.0, 80.0])
    assert np.asarray(with_focal(mirrored(), focal).focal).tolist() == focal.tolist()
    many = 20 * (1 + 5e-7 * np.arange(4))  # each is near the next one, but not all near the first
    assert np.asarray(with_focal(mirrored(), many).focal).tolist() == [many[0]] * 3 + [many[3]]


# float32 is enough, if what is squared is not


@pytest.fixture(scope="module")
def in_both():
    """Lines at 20 to 30 mm, which hardly tell a model of degree 2, in both dtypes, and their fits."""
    focal = np.array([20.56, 22.0, 24.0, 27.0, 30.0])
    lines = zj.scenes.board_lines(zj.scenes.nikkor_18_200((640, 424)), focal, spacing=12, noise=0.1)
    points = [np.asarray(line, np.float32) for line in lines.to_ragged()]
    single = zj.Lines.from_ragged(points, lines.frame, np.float32(focal), image_size=lines.image_size)
    return [(each, zj.fit_zoom(zj.compress(each))) for each in (lines, single)]


def test_uncertain_focal_lengths_in_single_precision(in_both):
    """Their error moves the model along what lines hardly tell, which float32 lost: 8 times in variance."""
    wider = [
        zj.fit.with_focal_sigma(fit, zj.compress(lines), focal_sigma=0.01 * np.asarray(lines.focal))
        for lines, fit in in_both
    ]
    assert wider[1].covariance.dtype == np.float32
    np.testing.assert_allclose(np.diag(wider[1].covariance), np.diag(wider[0].covariance), rtol=1e-3)


def test_uncertain_focal_lengths_without_x64(in_both):
    """Points of NumPy stay float64 then, and are computed with in float32."""
    (lines, fit), _ = in_both
    sigma = 0.01 * np.asarray(lines.focal)
    expected = zj.fit.with_focal_sigma(fit, zj.compress(lines), focal_sigma=sigma).covariance
    with widest(False):
        given = zj.Lines.from_ragged(
            lines.to_ragged(), lines.frame, np.asarray(lines.focal), image_size=lines.image_size
        )
        small = zj.compress(given)
        wider = zj.fit.with_focal_sigma(zj.fit_zoom(small), small, focal_sigma=sigma)
    assert wider.covariance.dtype == np.float32
    np.testing.assert_allclose(np.diag(wider.covariance), np.diag(expected), rtol=1e-3)


def test_halves_of_lines_in_single_precision(in_both):
    halves = [zj.trust.evidence(lines, fit).halves for lines, fit in in_both]
    assert [one.parting for one in halves[0]] == [one.parting for one in halves[1]]
    for one, other in zip(*halves, strict=True):
        assert other.apart == pytest.approx(one.apart, rel=5e-3)
        assert other.expected == pytest.approx(one.expected, rel=5e-3)
