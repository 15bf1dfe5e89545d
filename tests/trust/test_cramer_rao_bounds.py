"""The Cramer-Rao bound: against the whole Fisher information, nuisances and all, and against fits."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import zoomjax as zj
from zoomjax import scenes
from zoomjax.fit.energy import line_weights, linearised
from zoomjax.models.zoom import with_parameters

from ..conftest import moved


@pytest.fixture(scope="module")
def lens():
    return scenes.nikkor_18_200((640, 480))


@pytest.fixture(scope="module")
def scene(lens):
    """Lines of different lengths at three focal lengths, of up to 21 points."""
    board = scenes.StripedBoard(stripes=(8, 5), pixel_pitch=scenes.StripedBoard.before(lens).pixel_pitch)
    return scenes.board_lines(lens, scenes.focal_sweep(3), board=board, spacing=31)


def with_zoom(lens, parameters):
    return eqx.tree_at(lambda lens: lens.zoom, lens, with_parameters(lens.zoom, parameters))


def whole_information(lens, lines, std):
    """Of the parameters, and of each line's angle and offset and each point's place on it, all at once."""
    flat, unravel = ravel_pytree(lens.zoom.parameters)
    blocks = []
    for index, points in enumerate(lines.to_ragged()):
        focal = jnp.asarray(lines.focal)[lines.frame[index]]
        corrected = np.asarray(lens(float(focal)).undistort(points)) - np.asarray(lens.centre)
        normal = np.linalg.svd(corrected - corrected.mean(0))[2][1]
        along = np.array([-normal[1], normal[0]])
        own = np.array([np.arctan2(normal[1], normal[0]), normal @ corrected.mean(0), *corrected @ along])

        def seen(both, focal=focal):
            parameters, angle, offset, place = (
                both[: flat.size],
                *both[flat.size :][:2],
                both[flat.size + 2 :],
            )
            normal = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
            along = jnp.stack([-normal[1], normal[0]])
            straight = (lens.centre + offset * normal)[None] + jnp.outer(place, along)
            return with_zoom(lens, unravel(parameters))(focal).distort(straight).reshape(-1)

        at = jnp.concatenate([flat, own])
        np.testing.assert_allclose(seen(at).reshape(-1, 2), points, atol=1e-8)
        blocks.append(np.asarray(jax.jacfwd(seen)(at)) / std[index])
    parameters = flat.size
    rows, columns = np.sum([block.shape for block in blocks], axis=0)
    design, row, column = np.zeros((rows, columns - parameters * (len(blocks) - 1))), 0, parameters
    for block in blocks:
        here = slice(row, row + block.shape[0])
        design[here, :parameters] = block[:, :parameters]
        design[here, column : column + block.shape[1] - parameters] = block[:, parameters:]
        row, column = row + block.shape[0], column + block.shape[1] - parameters
    return design


@pytest.mark.exhaustive
def test_bound_is_that_of_the_whole_information(lens, scene, rng):
    std = rng.uniform(0.2, 1, len(scene.frame))
    design = whole_information(lens, scene, std)
    # By way of QR, for lines are many thousand times better known than the distortion.
    inverse = np.linalg.inv(np.linalg.qr(design / np.linalg.norm(design, axis=0), mode="r"))
    inverse = inverse / np.linalg.norm(design, axis=0)[:, None]
    expected = (inverse @ inverse.T)[:6, :6]
    np.testing.assert_allclose(zj.trust.cramer_rao(lens, scene, std=std), expected, rtol=1e-6)


def test_bound_grows_with_the_noise(lens, scene):
    one, three = (float(zj.trust.displacement_bound(lens, scene, std=std)) for std in (1, 3.0))
    assert three == pytest.approx(3 * one, rel=1e-8)
    alike = zj.trust.displacement_bound(lens, scene, std=np.full(len(scene.frame), 3.0))
    assert float(alike) == pytest.approx(three, rel=1e-8)


def test_padding_and_weights_change_nothing(lens, scene):
    padded = moved(scene, jnp.where(scene.mask[..., None], scene.points, jnp.nan))
    weighted = padded.weighted(np.linspace(0, 1, len(scene.frame)))
    np.testing.assert_array_equal(
        zj.trust.cramer_rao(lens, weighted, std=1.0), zj.trust.cramer_rao(lens, scene, std=1.0)
    )


def test_bound_of_displacements_is_that_of_the_parameters(lens, scene):
    """In the mean over draws from the covariance, the error of the field is the bound."""
    flat, unravel = ravel_pytree(lens.zoom.parameters)
    covariance = zj.trust.cramer_rao(lens, scene, std=0.1)
    root = jnp.linalg.cholesky(covariance)
    # Directions instead of draws: the six columns of the root have the covariance's sum of squares.
    squares = [
        zj.trust.displacement_rms(lens, with_zoom(lens, unravel(flat + step))) ** 2 for step in root.T
    ]
    bound = zj.trust.displacement_bound(lens, scene, std=0.1)
    assert float(jnp.sqrt(sum(squares))) == pytest.approx(float(bound), rel=1e-9)


def test_displacement_rms_is_that_of_a_dense_grid(lens):
    other = with_zoom(lens, lens.zoom.parameters + 0.01 * jnp.array([[1.0, -2], [0, 1], [2, 0.5]]))
    width, height = lens.image_size
    grid = np.stack(np.meshgrid(np.arange(0.0, width, 4) + 1.5, np.arange(0.0, height, 4) + 1.5), -1)
    low, high = 1 / lens.focal_range[::-1]
    focal = 1 / (low + (high - low) * (np.arange(40) + 0.5) / 40)
    apart = [np.asarray(lens(f).undistort(grid) - other(f).undistort(grid)) for f in focal]
    expected = np.sqrt(np.mean(np.sum(np.square(apart), axis=-1)))
    assert float(zj.trust.displacement_rms(lens, other)) == pytest.approx(expected, rel=1e-3)


def test_lines_through_the_centre_bound_nothing(lens):
    t = np.linspace(0, 200, 20)[:, None]
    points = [np.asarray(lens.centre) + t * np.array([np.cos(a), np.sin(a)]) for a in (0.3, 1.1, 2.0)]
    lines = zj.Lines.from_ragged(points, [0, 1, 2], [25, 50, 100], image_size=lens.image_size)
    covariance = np.asarray(zj.trust.cramer_rao(lens, lines, std=1.0))
    assert np.isinf(covariance.diagonal()).all()
    assert np.isinf(zj.trust.displacement_bound(lens, lines, std=1.0))


@pytest.mark.slow
def test_fits_come_near_the_bound(lens, scene):
    """By their own sandwich: no weights beat the bound, and eq. 13's cost less than a tenth."""
    small = zj.compress(scene)
    bound = zj.trust.cramer_rao(lens, scene, std=1.0)
    least = zj.trust.displacement_bound(lens, scene, std=1.0)
    flat, unravel = ravel_pytree(lens.zoom.parameters)
    for alike in (jnp.ones_like(small.counts), small.counts):  # lines, or points, of a frame
        lines = zj.fit.in_image(small.weighted(alike))
        weights = line_weights(lines)
        _, jacobian, *_ = eqx.filter_jit(linearised)(lines, lens.zoom)
        inverse = jnp.linalg.inv(jnp.einsum("lri,lrj->ij", jacobian, jacobian))
        covariance = inverse @ jnp.einsum("l,lri,lrj->ij", weights, jacobian, jacobian) @ inverse
        ratio = jnp.linalg.eigvals(jnp.linalg.solve(bound, covariance)).real
        assert (ratio > 0.99).all()  # the sandwich takes the stretch to be the same along a line
        root = jnp.linalg.cholesky(covariance)
        squares = [
            zj.trust.displacement_rms(lens, with_zoom(lens, unravel(flat + step))) ** 2 for step in root.T
        ]
        assert jnp.sqrt(sum(squares)) < 1.1 * least


def test_float32_stays_float32(lens, scene):
    single = jax.tree.map(lambda a: a.astype(jnp.float32) if eqx.is_inexact_array(a) else a, (lens, scene))
    bound = zj.trust.displacement_bound(*single, std=0.5)
    assert bound.dtype == jnp.float32
    assert float(bound) == pytest.approx(float(zj.trust.displacement_bound(lens, scene, std=0.5)), rel=1e-2)


@pytest.mark.parametrize("std", [0.0, -0.5, np.nan, np.inf, "one is 0", "one is negative", "too few"])
@pytest.mark.parametrize("bound", [zj.trust.cramer_rao, zj.trust.displacement_bound])
def test_errors_of_points_that_are_none_are_refused(bound, std, clean, truth, unchecked):
    """A negative one was taken for a positive, and 0 said that the lines determine nothing."""
    each = np.full(len(clean.frame), 0.5)
    stds = {
        "one is 0": np.where(np.arange(each.size) == 3, 0, each),
        "one is negative": np.where(np.arange(each.size) == 3, -0.5, each),
        "too few": each[1:],
    }
    with pytest.raises(ValueError, match="Argument std must hold"):
        bound(truth, clean, std=stds.get(std, std))


def test_lenses_for_different_images_are_not_compared():
    lens = scenes.nikkor_18_200()
    with pytest.raises(ValueError, match=r"must have the image_size of the first lens, \(4288, 2848\)"):
        zj.trust.displacement_rms(lens, scenes.nikkor_18_200((640, 427)))
    with pytest.raises(ValueError, match="must have the focal_unit of the first lens, mm"):
        zj.trust.displacement_rms(lens, dataclasses.replace(lens, focal_unit="px"))


def test_lines_beyond_the_range_of_the_lens_are_told_and_count(lens, scene):
    """The bound was infinite, as if they determined nothing, without a word."""
    narrow = lens.extended(30.0, 100.0)
    for bound in (zj.trust.cramer_rao, zj.trust.displacement_bound):
        with pytest.warns(UserWarning, match="not all within the range"):
            found = bound(narrow, scene, std=0.5)
        assert np.isfinite(found).all()
    np.testing.assert_allclose(
        np.diag(zj.trust.cramer_rao(lens, scene, std=0.5)),
        np.diag(zj.trust.cramer_rao(lens.extended(1.0, 900.0), scene, std=0.5)),
        rtol=1e-9,
    )
