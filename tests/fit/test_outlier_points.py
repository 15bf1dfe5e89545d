"""Single points off good lines: dropped, and the lens is as without them."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes

from ..conftest import moved
from .test_robust import displacement_rms, with_arcs

NOISE = 0.3


@pytest.fixture(scope="module")
def clean(truth):
    return scenes.board_lines(truth, scenes.focal_sweep(4), spacing=60.0)


@pytest.fixture(scope="module")
def good(clean):
    noise = NOISE * np.random.default_rng(0).standard_normal(clean.points.shape)
    return moved(clean, clean.points + noise)


def across(lines):
    """A unit normal of each line."""
    last = np.asarray(lines.mask).sum(1) - 1
    points = np.asarray(lines.points)
    along = points[np.arange(len(points)), last] - points[:, 0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return np.stack([-along[:, 1], along[:, 0]], axis=1)


def with_blunders(lines, share, *, run=1, seed=1):
    """Some points displaced across their lines by 3 to 20 px, in runs of neighbours, and which."""
    rng = np.random.default_rng(seed)
    mask = np.asarray(lines.mask)
    begins = rng.uniform(size=mask.shape) < share / run
    which = np.zeros_like(begins)
    for step in range(run):
        which[:, step:] |= begins[:, : begins.shape[1] - step]
    which &= mask
    size = rng.uniform(3, 20, mask.shape) * rng.choice([-1, 1], mask.shape)
    if run > 1:  # a whole run to one side
        size = np.abs(size) * np.where(rng.uniform(size=(len(mask), 1)) < 0.5, -1, 1)
    offset = (which * size)[..., None] * across(lines)[:, None]
    return moved(lines, lines.points + offset), which


@pytest.fixture(scope="module")
def spoiled(good):
    return with_blunders(good, 0.05)


@pytest.fixture(scope="module")
def found(spoiled):
    return zj.fit.reject_points(spoiled[0])


@pytest.mark.slow
def test_the_lens_is_that_without_blunders(good, spoiled, found):
    focal = np.asarray(good.focal)
    plain = zj.fit_zoom(zj.compress(good)).lens
    assert displacement_rms(zj.fit_robust(zj.compress(spoiled[0])).fit.lens, plain, focal) > 0.1
    assert displacement_rms(found.fit.fit.lens, plain, focal) < 0.05
    alone = eqx.tree_at(lambda lines: lines.mask, good, good.mask & jnp.asarray(~spoiled[1]))
    assert displacement_rms(found.fit.fit.lens, zj.fit_robust(zj.compress(alone)).fit.lens, focal) < 0.01


def test_what_is_rejected_are_the_blunders(spoiled, found):
    lines, which = spoiled
    assert found.rejected.shape == lines.mask.shape
    assert (found.rejected & ~which).sum() <= 1e-3 * lines.mask.sum()
    assert (which & ~found.rejected).sum() <= 0.01 * which.sum()
    np.testing.assert_array_equal(found.lines.mask, lines.mask & ~found.rejected)
    np.testing.assert_array_equal(found.lines.points, lines.points)
    assert found.fit.rejected.size == 0
    assert np.median(found.spread) == pytest.approx(NOISE, rel=0.1)


def test_runs_of_blunders_to_one_side_are_rejected(good):
    """What a detector does that follows something else for a while."""
    lines, which = with_blunders(good, 0.08, run=4)
    found = zj.fit.reject_points(lines)
    focal, plain = np.asarray(good.focal), zj.fit_zoom(zj.compress(good)).lens
    assert displacement_rms(found.fit.fit.lens, plain, focal) < 0.05
    assert (which & ~found.rejected).sum() <= 0.05 * which.sum()


def test_crooked_lines_keep_their_points_and_are_rejected_whole(good):
    """Also where blunders are on the other lines."""
    bent, arcs = with_arcs(with_blunders(good, 0.05)[0], 0.1, sagitta=(15, 60), outward=False)
    found = zj.fit.reject_points(bent)
    assert set(arcs) <= set(found.fit.rejected)
    assert displacement_rms(found.fit.fit.lens, zj.fit_zoom(zj.compress(good)).lens, good.focal) < 0.1


def test_without_blunders_next_to_nothing_is_lost(truth, clean):
    """The squared error over draws of noise is that of the plain fit, within 5 %."""
    rng, focal = np.random.default_rng(2), np.asarray(clean.focal)
    errors = []
    for _ in range(6):
        noisy = moved(clean, clean.points + NOISE * rng.standard_normal(clean.points.shape))
        found = zj.fit.reject_points(noisy)
        assert found.rejected.sum() <= 1e-3 * noisy.mask.sum()
        fits = (zj.fit_zoom(zj.compress(found.lines)), zj.fit_zoom(zj.compress(noisy)))
        errors.append([displacement_rms(fit.lens, truth, focal) ** 2 for fit in fits])
    ours, plain = np.mean(errors, axis=0)
    assert ours < 1.05 * plain


def test_points_without_noise_all_stay(clean):
    assert not zj.fit.reject_points(clean).rejected.any()


@pytest.mark.slow
def test_lines_of_few_points_keep_them():
    rng = np.random.default_rng(3)
    t = np.linspace(10.0, 470.0, 4)
    points = [np.stack([x + 0.1 * rng.standard_normal(4), t], -1) for x in range(20, 620, 20)]
    points[3][1, 0] += 5
    lines = zj.Lines.from_ragged(points, [0] * 30, [50], image_size=(640, 480))
    found = zj.fit.reject_points(lines, zoom=zj.PolynomialZoom(degree=0), terms=1)
    assert not found.rejected.any()
    assert found.fit.rejected.tolist() == [3]


def test_compressed_lines_raise_and_say_what_to_do(small, unchecked):
    with pytest.raises(TypeError, match="compressed already; pass the Lines"):
        zj.fit.reject_points(small)


@pytest.mark.slow
def test_under_another_distortion_model_the_same_points_go(good):
    bad, which = with_blunders(good, 0.01)
    own, other = (zj.fit.reject_points(bad, distortion_model=of) for of in (None, zj.models.BrownConrady()))
    assert other.fit.fit.lens.distortion_model == zj.models.BrownConrady()
    assert (own.rejected != other.rejected).sum() <= 0.05 * own.rejected.sum()
    assert other.rejected[which].mean() >= own.rejected[which].mean() - 0.02 > 0.5
