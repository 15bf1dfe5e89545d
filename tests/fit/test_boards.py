"""Lens, focal lengths, poses and the shape of a bent board, from photos of it, beside the truth."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from tests._boards import COLUMNS, FOCAL, LABEL, ROWS, SIZE, bent, displaced, seen_through, true_lens
from zoomjax import PolynomialZoom
from zoomjax.fit import RESULTS, fit_boards
from zoomjax.fit import _board_rows as rows_module
from zoomjax.fit import boards as boards_module
from zoomjax.fit._board_problem import checked_grids, data_of
from zoomjax.fit._board_rows import Stage, rows_of, units_of
from zoomjax.fit._board_schur import PoseSchur, Structure, Unknowns
from zoomjax.fit._board_shape import grid_places, shape_basis
from zoomjax.models import Division


@pytest.fixture(scope="module")
def lens():
    return true_lens()


@pytest.fixture(scope="module")
def exact(lens):
    grids, poses = seen_through(lens, bent(), FOCAL)
    return fit_boards(grids, LABEL, image_size=SIZE), grids, poses


def test_exact_corners_give_lens_focal_lengths_poses_and_shape(lens, exact):
    fit, _, poses = exact
    assert fit.fit.result == RESULTS.successful
    np.testing.assert_allclose(fit.focal, [1000, 1600, 2600], rtol=1e-6)
    assert displaced(lens, fit.lens, fit.focal, [1000, 1600, 2600]) < 1e-3
    np.testing.assert_allclose(fit.lens.centre, lens.centre, atol=1e-3)
    assert fit.fit.rms < 1e-4
    np.testing.assert_allclose(fit.shape[0].reshape(-1, 3), bent(), atol=1e-3)
    np.testing.assert_allclose(fit.bend, np.ptp(bent()[:, 2]), atol=1e-3)
    for found, at, (rotation, position) in zip(
        np.asarray(fit.poses.rotation), np.asarray(fit.poses.position), poses, strict=True
    ):
        np.testing.assert_allclose(found, rotation, atol=1e-5)
        np.testing.assert_allclose(at, position, rtol=1e-4, atol=1e-3)


def test_flat_boards_are_worse_and_say_other_focal_lengths(lens, exact):
    fit, grids, _ = exact
    flat = fit_boards(grids, LABEL, image_size=SIZE, flat=True, throw=False)
    assert flat.fit.rms > 20 * fit.fit.rms
    assert flat.bend[0] < 1e-6
    assert abs(np.asarray(flat.focal) / [1000, 1600, 2600] - 1).max() > 2e-3


def test_labels_that_differ_by_rounding_are_of_one_zoom(exact):
    label = np.asarray(LABEL, float)
    label[::2] *= 1 + 1e-7
    fit, grids, _ = exact
    other = fit_boards(grids, label, image_size=SIZE)
    np.testing.assert_allclose(other.label, fit.label)
    np.testing.assert_allclose(other.focal, fit.focal, rtol=1e-9)


@pytest.mark.slow
def test_the_same_photos_are_located_as_they_were_fitted(exact):
    fit, grids, _ = exact
    poses = fit.locate(grids[:5], LABEL[:5])
    near = fit.locate(grids[:5], np.asarray(LABEL[:5]) * (1 - 1e-7))
    np.testing.assert_allclose(near.rotation, poses.rotation)
    np.testing.assert_allclose(poses.rotation, fit.poses.rotation[:5], atol=1e-4)
    np.testing.assert_allclose(poses.position, fit.poses.position[:5], rtol=1e-3, atol=1e-3)
    assert np.asarray(poses.residual).max() < 0.1
    with pytest.raises(ValueError, match="labels fitted"):
        fit.locate(grids[:1], [1.5])
    with pytest.raises(ValueError, match="boards fitted"):
        fit.locate(grids[:2], LABEL[:2], board=[0, 1])


def test_a_board_that_bends_from_photo_to_photo(lens):
    """Each photo has its own bend, which a rigid board has not; and so have photos that are located."""
    rng = np.random.default_rng(5)
    x, y = grid_places(ROWS, COLUMNS)[0].T
    unit = grid_places(ROWS, COLUMNS)[1]
    bends = (
        0.01
        * unit
        * (rng.standard_normal((len(FOCAL), 1)) * x**2 + rng.standard_normal((len(FOCAL), 1)) * x * y)
    )
    boards = bent() + np.stack([0 * bends, 0 * bends, bends], axis=-1)
    grids, _ = seen_through(lens, boards, FOCAL)
    grids = grids + 0.05 * rng.standard_normal((len(FOCAL), ROWS, COLUMNS, 2))
    fit = fit_boards(grids, LABEL, image_size=SIZE)
    assert 0.05 < fit.fit.rms < 0.09
    assert 0.002 < fit.bend_std < 0.02
    out_of_plane = bends - bends.mean(axis=0)
    found = np.asarray(fit.poses.bend).reshape(len(FOCAL), -1)
    plane = np.stack([np.ones_like(x), x, y], axis=1)
    for one, true in zip(found, out_of_plane, strict=True):  # but for what poses can do
        missed = one - true
        missed = missed - plane @ np.linalg.lstsq(plane, missed, rcond=None)[0]
        assert np.sqrt(np.mean(missed**2)) < 0.3 * np.sqrt(np.mean(out_of_plane**2))
    there = fit.locate(grids[:4], LABEL[:4])
    np.testing.assert_allclose(there.bend, fit.poses.bend[:4], atol=0.01)
    rigid = eqx.tree_at(lambda f: f.bend_std, fit, jnp.asarray(1e-9)).locate(grids[:4], LABEL[:4])
    assert np.square(rigid.residual).mean() > 4 * np.square(there.residual).mean()


def test_flattened_corners_are_seen_where_a_flat_board_has_them(lens, exact):
    """Rows and columns are straight; plane, place and scale of the board are a matter of convention."""
    fit, grids, _ = exact
    moved = fit.flattening()
    assert np.abs(moved).max() > 3
    for grid, more, focal in zip(grids, moved, FOCAL.tolist(), strict=True):
        for corners, most in ((grid + more, 0.01), (grid, np.inf)):
            straight = np.asarray(lens(focal).undistort(corners))
            lines = [*straight, *straight.swapaxes(0, 1)]
            off = [np.linalg.svd(line - line.mean(axis=0))[1][1] for line in lines]
            assert max(off) < most
    assert max(off) > 1


def test_a_rigid_board_is_found_to_be_rigid(exact):
    grids = exact[1] + 0.1 * np.random.default_rng(6).standard_normal(exact[1].shape)
    fit = fit_boards(grids, LABEL, image_size=SIZE)
    assert fit.bend_std < 1.5e-3
    assert np.sqrt(np.mean(np.square(fit.poses.bend))) < 0.01  # steps of the grid


@pytest.mark.slow
def test_outliers_and_missing_corners_do_little(exact):
    _, grids, _ = exact
    rng = np.random.default_rng(1)
    noisy = grids + 0.2 * rng.standard_normal(grids.shape)
    noisy[rng.random(grids.shape[:3]) < 0.15] = np.nan
    noisy[3, :, :2], noisy[8, 0] = np.nan, np.nan
    wrong = rng.random(grids.shape[:3]) < 0.03
    noisy[wrong] += 30 * rng.standard_normal((wrong.sum(), 2))
    fit = fit_boards(noisy, LABEL, image_size=SIZE)
    without = fit_boards(np.where(wrong[..., None], np.nan, noisy), LABEL, image_size=SIZE)
    missed = np.asarray(fit.poses.residual)
    assert abs(np.asarray(fit.focal) / [1000, 1600, 2600] - 1).max() < 0.01
    assert (abs(np.asarray(fit.focal - without.focal)) < np.asarray(without.focal_std)).all()
    assert (abs(np.asarray(fit.shape - without.shape)) < 4 * np.asarray(without.shape_std)).all()
    assert (np.isnan(missed) == np.isnan(noisy[..., 0])).all()
    assert np.nanmedian(missed[wrong]) > 10
    assert 0.15 < fit.noise < 0.3


def test_padding_changes_nothing(exact, monkeypatch):
    """Seven photos more and corners that are not seen, in the programs of the first fit."""
    fit, grids, _ = exact
    more = np.concatenate([grids, grids[:7]])
    more[18:] = np.nan
    more[18:, :3, :4] = grids[:7, :3, :4]
    with monkeypatch.context() as patch:  # what is traced again has other residuals
        patch.setattr(rows_module, "view_residual", None)
        other = fit_boards(more, np.append(LABEL, LABEL[:7]), image_size=SIZE)
    np.testing.assert_allclose(other.focal, fit.focal, rtol=2e-4)
    assert len(other.fit.frame_rms) == len(other.frame_focal) == 25


def problem(grids, boards=2):
    """Two boards of other shapes, in a distortion model that is not linear."""
    given = checked_grids(grids, LABEL, np.arange(len(grids)) % boards, SIZE)
    number = np.unique(LABEL, return_inverse=True)[1]
    data = data_of(given, number, 3, np.array([639.5, 359.5]), 0.05)
    focal = np.array([1000.0, 1600.0, 2600.0])
    zoom = PolynomialZoom(1).prepare(focal, 2)
    matrices, *_ = boards_module._homographies(data, jnp.zeros((3, 2)), Division())
    model = boards_module._model(data, matrices, focal, zoom, Division(), boards)
    shape = 0.3 * jnp.asarray(np.random.default_rng(2).standard_normal(model.shape.shape))
    stage = Stage(jnp.asarray(2.0), jnp.asarray(1.0), jnp.asarray(0.01), jnp.asarray(1.0), 0.1, 1e-3)
    return data, eqx.tree_at(lambda model: model.shape, model, shape), stage


@pytest.mark.slow
def test_steps_solve_the_least_squares_of_the_dense_jacobian(exact):
    problem_of_two = problem(exact[1])
    data, model, stage = problem_of_two
    units = units_of(data, model, jnp.asarray(stage.noise))
    zeros = jax.tree.map(jnp.zeros_like, units)
    rows, linear = jax.linearize(lambda x: rows_of(x, problem_of_two), zeros)
    bend = units.poses[:, None, 6:] * data.basis.own[None]
    structure = Structure(data.basis.scaled(units.shape[0, 0]), bend, data.board, data.members)
    step = PoseSchur(structure).step(zeros, linear, rows, jnp.asarray(1e-2))
    unknown, unravel = ravel_pytree((zeros.poses, zeros.shape, zeros.lens))

    def rows_at(unknown):
        poses, shape, lens = unravel(unknown)
        return ravel_pytree(linear(Unknowns(poses, zeros.points, shape, lens)))[0]

    dense = jax.vmap(rows_at)(jnp.eye(len(unknown))).T
    matrix = dense.T @ dense + 1e-2 * jnp.eye(len(unknown))
    expected = jnp.linalg.solve(matrix, dense.T @ ravel_pytree(rows)[0])
    found = ravel_pytree((step.poses, step.shape, step.lens))[0]
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6 * abs(expected).max())


@pytest.mark.slow
def test_derivatives_are_those_of_finite_differences(exact):
    data, model, stage = problem(exact[1])
    zeros = jax.tree.map(jnp.zeros_like, units_of(data, model, jnp.asarray(stage.noise)))
    rng = np.random.default_rng(3)
    along = jax.tree.map(lambda leaf: jnp.asarray(rng.standard_normal(leaf.shape)), zeros)
    along = along._replace(points=zeros.points)

    def moved_by(size):
        return rows_of(jax.tree.map(lambda leaf: size * leaf, along), (data, model, stage))

    _, slope = jax.jvp(moved_by, (0.0,), (1.0,))
    step = 1e-4
    for part, up, down in zip(slope, moved_by(step), moved_by(-step), strict=True):
        np.testing.assert_allclose(part, (up - down) / (2 * step), rtol=1e-5, atol=1e-5)


def test_shapes_leave_to_poses_what_poses_can_do():
    places, _ = grid_places(ROWS, COLUMNS)
    basis = shape_basis(places)
    of = np.asarray(basis.moved(jnp.eye(basis.size)))
    x, y = places.T
    none = 0 * x
    poses = [
        *np.eye(3)[:, None, :] + np.zeros((3, len(x), 3)),
        np.stack([none, none, x], 1),
        np.stack([none, none, y], 1),
        np.stack([-y, x, none], 1),
        np.stack([x, y, none], 1),
    ]
    wide = np.concatenate([np.stack(poses, 2).reshape(-1, 7), of.reshape(3 * len(x), -1)], axis=1)
    assert np.linalg.matrix_rank(wide) == wide.shape[1] <= 3 * len(x) + 7


def test_smooth_focal_lengths_are_drawn_to_a_parabola_alone(exact):
    label = np.array([1.0, 2.0, 4.0, 7.0, 9.0])
    number = np.arange(5)
    given = checked_grids(exact[1][:5], label, None, SIZE)
    data = data_of(given, number, 5, np.array([639.5, 359.5]), 0.05, 0.01, label)
    curve = np.pad(np.polyval([0.05, 0.8, 6.0], np.log(label)), (0, len(data.smooth) - 5))
    np.testing.assert_allclose(np.asarray(data.smooth) @ curve, 0, atol=1e-9)
    off = curve + 0.02 * (np.arange(len(curve)) == 2)
    assert 0.5 < np.linalg.norm(np.asarray(data.smooth) @ off) < 2.0  # of 2 deviations, some is a parabola
    free = data_of(given, number, 5, np.array([639.5, 359.5]), 0.05)
    assert not np.asarray(free.smooth).any()


@pytest.mark.slow
def test_standard_deviations_are_the_scatter_of_fits_to_noise(exact):
    """Within a factor: 8 draws tell a standard deviation to 25 %, and focal lengths are correlated."""
    _, grids, _ = exact
    rng = np.random.default_rng(4)
    fits = [
        fit_boards(grids + 0.3 * rng.standard_normal(grids.shape), LABEL, image_size=SIZE) for _ in range(8)
    ]
    focal = np.array([fit.focal for fit in fits])
    said = np.sqrt(np.mean([np.square(fit.focal_std) for fit in fits], axis=0))
    off = np.sqrt(np.mean((focal - [1000, 1600, 2600]) ** 2, axis=0))
    assert abs(np.log(off / said)).max() < np.log(2)
    centres = np.array([fit.lens.centre for fit in fits])
    scale = np.hypot(*SIZE) / 2
    of_centre = scale * np.sqrt([np.diag(fit.covariance)[-2:] for fit in fits]).mean(axis=0)
    off = np.sqrt(np.mean((centres - [646, 355]) ** 2, axis=0))
    assert abs(np.log(off / of_centre)).max() < np.log(2.5)
    shapes = np.array([fit.shape[0] for fit in fits])
    said = np.sqrt(np.mean([np.square(fit.shape_std[0]) for fit in fits]))
    assert 0.5 < np.sqrt(np.mean(np.var(shapes, axis=0, ddof=1))) / said < 2


@pytest.mark.slow
def test_standard_deviations_hold_for_a_focal_length_a_photo(exact):
    """A photo that alone tells its focal length leaves no score in it, which is not certainty."""
    _, grids, _ = exact
    rng = np.random.default_rng(7)
    label = FOCAL * (1 + 1e-3 * np.arange(len(FOCAL)))  # none the same, and in the order of time
    missed = []
    for _ in range(4):
        fit = fit_boards(
            grids + 0.3 * rng.standard_normal(grids.shape), label, image_size=SIZE, throw=False
        )
        in_order = np.argsort(np.argsort(label))
        missed.append((np.asarray(fit.focal)[in_order] - FOCAL) / np.asarray(fit.focal_std)[in_order])
    missed = np.abs(missed)
    assert 0.4 < np.median(missed) < 0.95  # 0.67, and what photos have in common
    assert np.mean(missed < 1.96) > 0.85


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda g: {"grids": []}, "empty"),
        (lambda g: {"grids": [g[0], g[1, :5]], "focal": [1, 2]}, "of one board"),
        (lambda g: {"grids": [g[0].reshape(-1, 2)], "focal": [1]}, r"\(row, column, 2\)"),
        (lambda g: {"grids": g[:2, :2], "focal": [1, 2]}, "3 rows"),
        (lambda g: {"focal": [1.0]}, "positive label"),
        (lambda g: {"focal": np.zeros(len(g))}, "positive label"),
        (lambda g: {"grids": np.where(np.arange(8)[:, None] < 1, g, np.nan)}, "leave it out"),
        (lambda g: {"board": [0]}, "first board"),
        (lambda g: {"board": np.full(len(g), -1)}, "first board"),
    ],
)
def test_bad_input_is_refused_by_a_sentence(exact, change, words):
    grids = exact[1]
    given = {"grids": grids, "focal": LABEL, "image_size": SIZE} | change(grids)
    with pytest.raises(ValueError, match=words):
        fit_boards(given.pop("grids"), given.pop("focal"), **given)


def test_what_it_is_not_is_said(exact):
    with pytest.raises(TypeError, match="not a lens"):
        exact[0](1000.0)
