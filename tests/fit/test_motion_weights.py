"""Weights of views in `fit_motion`: what they change, and what they leave alone."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from zoomjax import PolynomialZoom
from zoomjax.fit import fit_motion
from zoomjax.fit._motion_gradient import sensitive
from zoomjax.fit._motion_problem import Asked, Given, problem_of, relative, thinned
from zoomjax.fit.motion import _fitted
from zoomjax.models import RadialPolynomial
from zoomjax.scenes import motion_tracks, pan_and_zoom
from zoomjax.tracks import Tracks

from ._turning import FRAMES, SIZE, turning_lens


@pytest.fixture(scope="module")
def lens():
    return turning_lens()


@pytest.fixture(scope="module")
def path(lens):
    return pan_and_zoom(lens, FRAMES, pan=25, tilt=6)


@pytest.fixture(scope="module")
def exact(lens, path):
    return motion_tracks(lens, *path, views=50, life=40, seed=3).tracks


@pytest.fixture(scope="module")
def tracks(exact):
    return weighted(exact, points=exact.views()[2] + errors(exact, 3))


def errors(tracks, seed):
    """Noise of 0.3 px."""
    return 0.3 * np.random.default_rng(seed).normal(size=tracks.views()[2].shape)


@pytest.fixture(scope="module")
def fit(tracks):
    return fit_motion(tracks)


@pytest.fixture(scope="module")
def weight(tracks):
    """At random, from 0.2 to 2."""
    return np.random.default_rng(0).uniform(0.2, 2, len(tracks.views()[0]))


@pytest.fixture(scope="module")
def uneven(tracks, weight):
    return fit_motion(weighted(tracks, weight))


def weighted(tracks, weight=None, kept=slice(None), points=None):
    """The tracks with weights, other points, or some of the views."""
    number, frame, seen = tracks.views()
    return Tracks.from_arrays(
        number[kept],
        frame[kept],
        (seen if points is None else points)[kept],
        image_size=SIZE,
        frames=FRAMES,
        weight=None if weight is None else weight[kept],
    )


def assert_same(one, other, rtol=1e-9, without=()):
    """All numbers of two fits, each beside the largest of its kind."""
    for name in set(vars(one)) - set(without):
        for a, b in zip(*(jax.tree.leaves(getattr(of, name)) for of in (one, other)), strict=True):
            a, b = np.asarray(a, float), np.asarray(b, float)
            size = np.max(np.abs(b), initial=0, where=np.isfinite(b))
            np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol * size, err_msg=name)


def test_weights_of_1_are_as_none(tracks, fit):
    assert_same(fit_motion(weighted(tracks, np.ones(len(tracks.views()[0])))), fit)


@pytest.mark.parametrize("factor", [7e4, 1e307, 1e-305])
def test_a_common_factor_changes_nothing_but_the_noise(tracks, fit, weight, uneven, factor):
    larger = fit_motion(weighted(tracks, factor * weight))
    assert_same(larger, uneven, rtol=1e-7, without=["noise"])
    np.testing.assert_allclose(larger.noise, np.sqrt(factor) * uneven.noise, rtol=1e-7)
    assert abs(np.asarray(uneven.focal) / np.asarray(fit.focal) - 1).max() > 1e-5


@pytest.fixture(scope="module")
def out(tracks):
    """Some of the views: of one track all of them, of another all but one."""
    number, _, _ = tracks.views()
    out = (np.random.default_rng(0).uniform(size=len(number)) < 0.2) | (number == number[40])
    out[np.flatnonzero(number == number[100])[1:]] = True
    return out


@pytest.fixture(scope="module")
def left_out(tracks, out):
    with pytest.warns(UserWarning, match="they have one view"):
        return fit_motion(weighted(tracks, kept=~out))


def test_views_of_weight_0_are_as_if_they_were_not_there(tracks, out, left_out):
    number, _, points = tracks.views()
    left = np.bincount(number, ~out)[number]
    spoiled = points + out[:, None] * np.random.default_rng(0).normal(0, 300, points.shape)
    with pytest.warns(UserWarning, match="lie outside of the image"):
        given = weighted(tracks, np.where(out, 0, 3.0), points=spoiled)
    found = fit_motion(given)
    assert_same(found, left_out, rtol=1e-7, without=["noise", "rays", "residual", "lever"])
    np.testing.assert_allclose(found.noise, np.sqrt(3) * left_out.noise, rtol=1e-7)
    counts = ~out & (left > 1)
    assert np.isfinite(np.asarray(found.residual)[np.asarray(given.mask)]).tolist() == counts.tolist()
    without_ray = np.unique(number[left < 2]).tolist()
    assert number[40] in without_ray
    assert number[100] in without_ray
    assert given.number[np.isnan(np.asarray(found.rays)).all(axis=1)].tolist() == without_ray


def test_what_hardly_weighs_hardly_counts(tracks, out, left_out):
    """Wrong points of almost no weight have hardly an influence, on the noise neither."""
    points = tracks.views()[2] + 3 * out[:, None] * np.random.default_rng(1).normal(size=2)
    found = fit_motion(weighted(tracks, np.where(out, 1e-8, 1.0), points=points))
    np.testing.assert_allclose(found.noise, left_out.noise, rtol=0.02)
    off = np.abs(np.asarray(found.focal) - np.asarray(left_out.focal))
    assert (off < 0.05 * np.asarray(left_out.focal_std)).all()
    np.testing.assert_allclose(found.focal_std, left_out.focal_std, rtol=0.05)


@pytest.mark.filterwarnings("ignore:.*lie outside of the image")
def test_noisy_tracks_that_weigh_less_do_less_harm_and_bands_hold(exact, path):
    """Half of the tracks have five times the noise."""
    noisy = exact.views()[0] % 2 == 1
    off, std, noise = [], [], []
    for seed in range(16):
        points = exact.views()[2] + np.where(noisy, 5, 1)[:, None] * errors(exact, seed)
        for weight in (np.where(noisy, 1 / 25, 1.0), None):
            found = fit_motion(weighted(exact, weight, points=points))
            off.append(np.mean(np.log(np.asarray(found.focal) / path[0])))
            std.append(np.sqrt(found.covariance[-1, -1]))
            noise.append(found.noise)
    (off, plain), (std, of_plain) = (np.reshape(of, (-1, 2)).T for of in (off, std))
    assert np.sqrt(np.mean(off**2)) < 0.9 * np.sqrt(np.mean(plain**2))
    assert (std < of_plain).all()
    assert 0.6 < np.sqrt(np.mean((off / std) ** 2)) < 1.6
    np.testing.assert_allclose(np.mean(noise[::2]), 0.3, rtol=0.1)


@pytest.mark.filterwarnings("ignore:.*lie outside of the image")
def test_views_that_outweigh_the_others_of_their_track_do_not_hide_the_noise(exact):
    """Their rays go through them, and what is left of them is small."""
    noisy = np.random.default_rng([0, 1]).uniform(size=len(exact.views()[0])) < 0.8
    points = exact.views()[2] + np.where(noisy, 5, 1)[:, None] * errors(exact, 0)
    found = fit_motion(weighted(exact, np.where(noisy, 1 / 25, 1.0), points=points))
    assert 0.18 < found.noise < 0.33
    assert np.isfinite(found.focal_std).all()


def test_a_view_of_half_the_weight_tells_half_as_much(tracks, fit):
    """Of all tracks every second one: between all of them and half of them."""
    second = tracks.views()[0] % 2 == 1
    fits = [fit_motion(weighted(tracks, np.where(second, share, 1.0))) for share in (0.5, 1e-8)]
    none, half, whole = (
        (float(of.noise) / np.mean(np.asarray(of.focal_std))) ** 2 for of in (fits[1], fits[0], fit)
    )
    assert none < 0.7 * whole
    assert (half - none) / (whole - none) == pytest.approx(0.5, abs=0.1)


@pytest.fixture(scope="module")
def asked():
    return Asked(PolynomialZoom(), RadialPolynomial(), 2, PolynomialZoom(degree=1), None)


@pytest.mark.slow
def test_derivatives_are_those_of_the_minimum(tracks, weight, asked):
    """Newton's method from the fit gives the minimum for other points and weights, with the noise held."""
    given = relative(Given(weighted(tracks, weight), None, None, None, None))
    _, model, noise = _fitted(given, asked, True)
    data = problem_of(given, asked).data
    rng = np.random.default_rng(0)
    there = np.asarray(data.there)
    along = rng.normal(size=data.points.shape) * there[:, None], 0.3 * rng.normal(size=there.shape) * there

    def moved(points, weight):
        return eqx.tree_at(lambda data: (data.points, data.root), data, (points, jnp.sqrt(weight)))

    def minimum(data, found):
        for _ in range(5):
            found = sensitive(data, found, noise)
        return found

    def changed(h):
        return minimum(moved(data.points + h * along[0], data.root**2 + h * along[1]), model)

    best = minimum(data, model)
    _, tangent = jax.jvp(
        lambda *of: sensitive(moved(*of), best, noise).path.log_focal,
        (data.points, data.root**2),
        tuple(jnp.asarray(of) for of in along),
    )
    finite = (changed(1e-3).path.log_focal - changed(-1e-3).path.log_focal) / 2e-3
    np.testing.assert_allclose(tangent, finite, rtol=2e-3, atol=2e-3 * abs(finite).max())


@pytest.mark.slow
def test_a_fit_is_differentiable_by_points_and_weights(tracks, weight):
    given = weighted(tracks, np.where(np.arange(len(weight)) == 77, 0, weight))

    def focal(tracks):
        return jnp.mean(jnp.log(fit_motion(tracks).focal))

    slopes = eqx.filter_grad(focal)(given)
    seen = np.asarray(given.mask) & (np.asarray(given.weight) > 0)
    for slope in (slopes.points, slopes.weight):
        assert np.isfinite(slope).all()
        assert (np.asarray(slope)[~seen] == 0).all()
    assert (np.asarray(slopes.weight)[seen] != 0).mean() > 0.9
    share = np.asarray(slopes.weight * given.weight)  # a common factor changes nothing
    assert abs(share.sum()) < 1e-6 * abs(share).sum()


def test_a_later_fit_begins_in_units_of_its_own_weights(tracks, weight, uneven):
    """The noise of the earlier one is that of weight 1, whatever the weights are in the mean."""
    found = fit_motion(weighted(tracks, weight), begin=uneven)
    off = np.abs(np.asarray(found.focal) - np.asarray(uneven.focal))
    assert (off < 0.02 * np.asarray(uneven.focal_std)).all()
    np.testing.assert_allclose(found.noise, uneven.noise, rtol=1e-3)


def test_a_clip_thinned_keeps_the_weights_of_its_tracks(tracks, weight, asked, monkeypatch):
    monkeypatch.setattr("zoomjax.fit._motion_problem._MANY_VIEWS", 100)
    monkeypatch.setattr("zoomjax.fit._motion_problem._ENOUGH", 15)
    given = relative(Given(weighted(tracks, weight), None, None, None, None))
    few = thinned(given)
    assert few is not None
    rows = np.searchsorted(np.asarray(given.tracks.number), np.asarray(few.tracks.number))
    np.testing.assert_array_equal(few.tracks.weight, given.tracks.weight[rows])
    data = problem_of(few, asked).data
    views = int(np.sum(np.asarray(few.tracks.mask)))
    np.testing.assert_allclose(np.asarray(data.root)[:views] ** 2, few.tracks.view_weights())
    plain = Given(tracks, None, None, None, None)
    assert relative(plain) is plain
    assert problem_of(plain, asked).data.root is None


def test_weights_without_a_track_are_told(tracks):
    number, frame, _ = tracks.views()
    first = np.append(True, np.diff(number) != 0)
    with pytest.raises(ValueError, match="no track with two views of a weight above 0"):
        fit_motion(weighted(tracks, 1.0 * first))
    with pytest.raises(ValueError, match="must have known values"):
        jax.jit(lambda w: fit_motion(eqx.tree_at(lambda t: t.weight, given, w)).focal)(
            (given := weighted(tracks, 1.0 + frame)).weight
        )
