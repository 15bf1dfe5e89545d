import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj

from .._own_models import Halved
from .._reference import largest_difference
from ..conftest import RAGGED_FRAMES


def reference(lines, frame, terms):
    """The estimate for one frame as it is defined: from the areas spanned by all pairs of its points."""
    rows, targets = [], []
    for line, index in zip(lines.to_ragged(), lines.frame, strict=True):
        if index != frame:
            continue
        z = (line - np.asarray(lines.centre)) / lines.scale
        r2 = np.sum(z**2, axis=1, keepdims=True)
        orders = [z * r2**j - (z * r2**j).mean(axis=0) for j in range(terms + 1)]
        p, q = np.triu_indices(len(z), 1)

        def areas(first, second, p=p, q=q):
            return first[p, 0] * second[q, 1] - first[q, 0] * second[p, 1]

        weight = 1 / np.sqrt(len(z) * np.sum(orders[0] ** 2))
        targets.append(-weight * areas(orders[0], orders[0]))
        rows.append(
            weight
            * np.stack([areas(orders[0], order) + areas(order, orders[0]) for order in orders[1:]], axis=1)
        )
    return np.linalg.lstsq(np.concatenate(rows), np.concatenate(targets))[0]


@pytest.mark.parametrize("terms", [1, 2, 3])
def test_estimate_is_the_one_from_all_pairs_of_points(terms, ragged):
    expected = [reference(ragged, frame, terms) for frame in range(3)]
    np.testing.assert_allclose(zj.fit.algebraic_frames(ragged, terms=terms), expected, rtol=1e-6)


def test_estimate_is_close_to_the_truth(clean, truth):
    lens = zj.fit.algebraic_zoom(clean)
    nothing = eqx.tree_at(lambda lens: lens.zoom.parameters, truth, jnp.zeros((3, 2)))
    distortion = largest_difference(nothing, truth, clean.focal)
    assert largest_difference(lens, truth, clean.focal) < 0.05 * distortion


def test_points_and_compressed_lines_give_the_same(noisy, small):
    np.testing.assert_allclose(
        zj.fit.algebraic_zoom(noisy).zoom.parameters,
        zj.fit.algebraic_zoom(small).zoom.parameters,
        rtol=1e-9,
    )


def test_frames_are_zoom_estimates_of_degree_0(ragged):
    frames = zj.fit.algebraic_frames(ragged)
    lines = ragged.to_ragged()
    own = [line for line, frame in zip(lines, RAGGED_FRAMES, strict=True) if frame == 2]
    alone = zj.Lines.from_ragged(own, [0] * len(own), [50.0], image_size=ragged.image_size)
    lens = zj.fit.algebraic_zoom(alone, zoom=zj.PolynomialZoom(0))
    np.testing.assert_allclose(lens.zoom.parameters[0], frames[2], rtol=1e-8)


def test_lens_carries_the_geometry_of_the_lines(noisy):
    lens = zj.fit.algebraic_zoom(noisy)
    assert lens.image_size == noisy.image_size
    np.testing.assert_array_equal(lens.focal_range, [noisy.focal.min(), noisy.focal.max()])


def test_lines_through_the_centre_give_no_distortion():
    t = np.linspace(-200, 200, 20)[:, None]
    points = [np.array([319.5, 239.5]) + t * [np.cos(a), np.sin(a)] for a in np.linspace(0, 3, 8)]
    lines = zj.Lines.from_ragged(points, [0] * 8, [50.0], image_size=(640, 480))
    np.testing.assert_allclose(zj.fit.algebraic_frames(lines), 0, atol=1e-9)


def test_too_few_focal_lengths_raise(ragged):
    with pytest.raises(ValueError, match="distinct focal lengths"):
        zj.fit.algebraic_zoom(ragged, zoom=zj.PolynomialZoom(3))


@pytest.mark.parametrize("distortion_model", [zj.models.BrownConrady(), Halved()])
def test_other_distortion_models_are_estimated_too(distortion_model, clean, truth):
    """Both hold the polynomial: the estimate is its own, of half the coefficients, or next to it."""
    small = zj.fit.compress_for(clean, distortion_model)
    found = np.asarray(zj.fit.algebraic_zoom(small).zoom.parameters)
    radial = np.asarray(zj.fit.algebraic_zoom(clean).zoom.parameters)
    if distortion_model == Halved():
        np.testing.assert_allclose(found / 2, radial, rtol=1e-6)
        frames = zj.fit.algebraic_frames(small) / 2
        np.testing.assert_allclose(frames, zj.fit.algebraic_frames(clean), rtol=1e-6)
    else:
        lens = zj.fit.algebraic_zoom(small)
        assert largest_difference(lens, truth, clean.focal) < 0.05 * largest_difference(
            eqx.tree_at(lambda lens: lens.zoom.parameters, truth, jnp.zeros((3, 2))), truth, clean.focal
        )
        assert (np.abs(found[:, 2:]) < 1e-3).all()


def test_of_the_division_model_to_first_order(clean):
    """Its k1 is minus the polynomial's, where distortion is weak."""
    weak = zj.Distortion(jnp.array([1e-4]), clean.centre, jnp.asarray(clean.scale))
    straight = np.linspace([200.0, 300.0], [3500.0, 700.0], 50)
    seen = [weak.distort(straight + np.array([0, step])) for step in range(0, 2000, 300)]
    lines = zj.Lines.from_ragged(seen, [0] * len(seen), [50.0], image_size=clean.image_size)
    small = zj.fit.compress_for(lines, zj.models.Division(), terms=1)
    np.testing.assert_allclose(zj.fit.algebraic_frames(small, terms=1), [[-1e-4]], rtol=1e-3)
