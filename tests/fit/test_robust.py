"""Fits that crooked lines do not spoil."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import zoomjax as zj
from zoomjax import scenes
from zoomjax.fit.robust import reweighted, typical_rms

from .._reference import image_grid
from ..conftest import moved


@pytest.fixture(scope="module")
def board(truth):
    """The paper's board at six focal lengths with edge noise of 0.5 px."""
    return scenes.board_lines(truth, scenes.focal_sweep(6), spacing=20, noise=0.5, seed=3)


def with_arcs(lines, share, *, sagitta, outward, seed=1):
    """Some of the lines bent to arcs, and which."""
    rng = np.random.default_rng(seed)
    bent, which = [], rng.uniform(size=len(lines.frame)) < share
    for line, bend in zip(lines.to_ragged(), which, strict=True):
        chord = line[-1] - line[0]
        normal = np.array([-chord[1], chord[0]]) / np.hypot(*chord)
        away = np.sign(normal @ (line.mean(0) - np.asarray(lines.centre)))
        side = away if outward else rng.choice([-1, 1])
        t = np.linspace(-1, 1, len(line))[:, None]
        bent.append(line + bend * side * rng.uniform(*sagitta) * (1 - t**2) * normal)
    points = np.zeros(lines.points.shape)
    for row, line in zip(points, bent, strict=True):
        row[: len(line)] = line
    return moved(lines, jnp.asarray(points)), np.flatnonzero(which)


def displacement_rms(one, other, focal):
    """RMS difference, px, of two lenses' corrected positions over the image and the focal lengths."""
    grid = image_grid(one.image_size)
    squares = [
        np.sum(np.asarray(one(f).undistort(grid) - other(f).undistort(grid)) ** 2, -1) for f in focal
    ]
    return np.sqrt(np.mean(squares))


@pytest.mark.slow
@pytest.mark.parametrize("outward", [False, True])
@pytest.mark.parametrize("sagitta", [(5, 50), (20, 200)])
def test_arcs_instead_of_three_lines_in_ten_do_no_harm(board, sagitta, outward):
    spoiled, arcs = with_arcs(board, 0.3, sagitta=sagitta, outward=outward)
    small = zj.compress(spoiled)
    robust, clean = zj.fit_robust(small), zj.fit_zoom(zj.compress(board))
    focal = np.asarray(board.focal)
    assert displacement_rms(zj.fit_zoom(small).lens, clean.lens, focal) > 1
    assert displacement_rms(robust.fit.lens, clean.lens, focal) < 0.05
    good = np.isin(np.arange(len(board.frame)), arcs, invert=True)
    alone = zj.fit_zoom(zj.compress(board).weighted(good))
    assert displacement_rms(robust.fit.lens, alone.lens, focal) < 0.01
    assert set(robust.rejected) == set(arcs)
    rms = np.asarray(robust.line_rms)[robust.rejected]
    assert (np.diff(rms) <= 0).all()
    assert rms.min() > 2 * robust.scale


@pytest.mark.slow
def test_without_arcs_nothing_is_rejected_and_next_to_nothing_lost(truth, board):
    """The error over draws of noise is that of the plain fit, within 5 % of its variance."""
    focal = np.asarray(board.focal)
    rng = np.random.default_rng(0)
    clean = scenes.board_lines(truth, focal, spacing=40)
    errors = []
    for _ in range(12):
        noise = 0.5 * rng.standard_normal(clean.points.shape)
        noisy = zj.compress(moved(clean, clean.points + noise))
        robust = zj.fit_robust(noisy)
        assert robust.rejected.size == 0
        errors.append(
            [displacement_rms(fit.lens, truth, focal) ** 2 for fit in (robust.fit, zj.fit_zoom(noisy))]
        )
    ours, plain = np.mean(errors, axis=0)
    assert ours < 1.05 * plain


@pytest.mark.slow
def test_compressed_and_all_points_agree(board):
    spoiled, _ = with_arcs(board, 0.2, sagitta=(5, 50), outward=False)
    ours, full = zj.fit_robust(zj.compress(spoiled)), zj.fit_robust(spoiled)
    np.testing.assert_allclose(ours.fit.lens.zoom.parameters, full.fit.lens.zoom.parameters, atol=1e-9)
    np.testing.assert_allclose(ours.weight, full.weight, atol=1e-6)
    np.testing.assert_allclose(ours.line_rms, full.line_rms, rtol=1e-6)


@pytest.mark.slow
def test_float32_stays_float32(board):
    spoiled, arcs = with_arcs(board, 0.2, sagitta=(5, 50), outward=False)
    single = zj.compress(
        jax.tree.map(
            lambda a: a.astype(jnp.float32) if jnp.issubdtype(a.dtype, jnp.floating) else a, spoiled
        )
    )
    robust = zj.fit_robust(single)
    assert robust.weight.dtype == robust.fit.lens.zoom.parameters.dtype == jnp.float32
    assert set(robust.rejected) == set(arcs)


def test_a_scene_without_noise_keeps_its_lines(truth):
    clean = zj.compress(scenes.board_lines(truth, scenes.focal_sweep(4), spacing=60))
    robust = zj.fit_robust(clean)
    assert displacement_rms(robust.fit.lens, truth, [20.56, 60.0, 127.36]) < 1e-6


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("compressed", [False, True])
def test_rounding_rejects_no_line(truth, dtype, compressed):
    """A quarter of exact lines was called not straight in the scene."""
    exact = scenes.board_lines(truth, scenes.focal_sweep(4), spacing=20)
    bent, arcs = with_arcs(exact, 0.02, sagitta=(1, 2), outward=True)
    for given, wrong in ((exact, []), (bent, arcs)):
        lines = jax.tree.map(lambda leaf: leaf.astype(dtype) if leaf.dtype.kind == "f" else leaf, given)
        robust = zj.fit_robust(zj.compress(lines) if compressed else lines, throw=False)
        assert sorted(robust.rejected) == list(wrong)


def test_own_weights_are_kept_as_factors(board):
    own = np.where(np.arange(len(board.frame)) % 3 == 0, 0.5, 1.0)
    robust = zj.fit_robust(zj.compress(board).weighted(own))
    assert (np.asarray(robust.weight) <= own).all()
    assert np.median(np.asarray(robust.weight)[own == 0.5]) == pytest.approx(0.5, rel=0.1)


def test_lines_of_no_weight_do_not_tell_what_is_usual(truth):
    """Many, and crooked: as the median they would have all arcs that are left believed."""
    lines = scenes.board_lines(truth, scenes.focal_sweep(4), spacing=100, noise=0.5, seed=3)
    arcs, which = with_arcs(lines, 0.7, sagitta=(20, 60), outward=False)
    own = np.ones(len(lines.frame))
    own[which[: -len(which) // 10]] = 0
    robust = zj.fit_robust(zj.compress(arcs).weighted(own))
    alone = [line for line, there in zip(arcs.to_ragged(), own, strict=True) if there]
    expected = zj.fit_robust(
        zj.compress(
            zj.Lines.from_ragged(
                alone, np.asarray(lines.frame)[own > 0], lines.focal, image_size=lines.image_size
            )
        )
    )
    np.testing.assert_allclose(robust.scale, expected.scale, rtol=1e-6)
    np.testing.assert_allclose(np.asarray(robust.weight)[own > 0], expected.weight, atol=1e-6)
    assert (np.asarray(robust.weight)[which] == 0).all()


@pytest.mark.slow
def test_solver_and_steps_are_those_of_the_last_fit(small):
    robust = zj.fit_robust(small)
    gauss = zj.fit_robust(small, solver=optx.GaussNewton(rtol=1e-9, atol=1e-9))
    np.testing.assert_allclose(
        gauss.fit.lens.zoom.parameters, robust.fit.lens.zoom.parameters, rtol=0, atol=1e-9
    )
    with pytest.raises(RuntimeError, match="The fit failed"):
        zj.fit_robust(small, solver=optx.NonlinearCG(rtol=1e-12, atol=1e-12), max_steps=1)
    assert zj.fit_robust(small, max_steps=1, throw=False).fit.steps <= 1


@pytest.mark.slow
def test_a_frame_of_which_nothing_is_left_has_no_error(board):
    """Not the best of all errors, 0, nor a share in the mean."""
    wave = 60 * np.sin(np.linspace(0, 9, board.points.shape[1]))[None, :, None]
    bad = np.asarray(board.frame) == 2
    small = zj.compress(moved(board, board.points + jnp.asarray(np.where(bad[:, None, None], wave, 0))))
    robust = zj.fit_robust(small)
    assert (np.asarray(robust.weight)[bad] == 0).all()
    fit, others = robust.fit, np.arange(6) != 2
    assert np.isnan(fit.frame_rms[2])
    assert np.isfinite(fit.frame_rms[others]).all()
    assert float(fit.rms) == pytest.approx(
        np.sqrt(np.mean(np.asarray(fit.frame_rms)[others] ** 2)), rel=1e-9
    )
    each = zj.fit_frames(small.weighted(robust.weight), throw=False)
    np.testing.assert_array_equal(np.isnan(each.frame_rms), ~others)
    assert zj.RESULTS[fit.result] == ""
    assert "do not determine" in each.messages()[2]
    assert float(each.rms) == pytest.approx(float(fit.rms), rel=0.05)


def test_near_a_model_weights_are_those_that_it_gives(board):
    """Started anew, arcs in half of the lines move the model away; near the lens they are rejected."""
    spoiled, arcs = with_arcs(board, 0.45, sagitta=(20, 200), outward=True)
    lines, model = zj.compress(spoiled), zj.fit_zoom(zj.compress(board)).lens.model
    near, _ = reweighted(lines, model, near=True)
    assert set(np.flatnonzero(np.asarray(near.weight) == 0)) == set(arcs)
    far, found = reweighted(lines, model)
    assert set(np.flatnonzero(np.asarray(far.weight) == 0)) != set(arcs)
    assert typical_rms(lines, found) > 2 * typical_rms(lines, model)
