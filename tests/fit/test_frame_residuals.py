"""Residuals reduced frame by frame: sums of squares, and what solvers and derivatives make of them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.fit.energy import coefficients_by, linearised, weighted_distances
from zoomjax.fit.frame_residuals import frame_residuals, triangles_by_frame
from zoomjax.models.zoom import with_parameters

from ..conftest import moved

K = jnp.array([[0.1, -0.05], [0.02, 0.03], [-0.1, 0.01]])
OFFSET = jnp.array([[0.03, -0.02], [-0.01, 0.0], [0.0, 0.02]])
TANGENTIAL = jnp.array([[0.01, -0.02], [0.0, 0.01], [0.02, 0.0]])


def cases(ragged):
    """Lines of all kinds, and coefficients of their frames."""
    any_centre = zj.lines.compress_any_centre(ragged)
    conrady = zj.fit.with_distortion_model(ragged, zj.models.BrownConrady())
    return {
        "points": (ragged, K),
        "compressed": (zj.compress(ragged), K),
        "any centre": (any_centre, jnp.concatenate([K, OFFSET], axis=1)),
        "in the image": (zj.fit.in_image(any_centre), jnp.concatenate([K, OFFSET], axis=1)),
        "Brown-Conrady": (conrady, jnp.concatenate([K, TANGENTIAL], axis=1)),
        "weighted": (zj.compress(ragged).weighted(np.arange(9.0)), K),
    }


@pytest.fixture(scope="module", params=["points", "compressed", "any centre", "in the image"])
def case(request, ragged):
    return cases(ragged)[request.param]


@pytest.fixture(scope="module", params=["Brown-Conrady", "weighted"])
def other_case(request, ragged):
    return cases(ragged)[request.param]


def close(found, expected, rtol=1e-11):
    size = np.max(np.abs(expected))
    np.testing.assert_allclose(found, expected, rtol=rtol, atol=rtol * size)


@eqx.filter_jit
def normal_equations(residuals, lines, k):
    """The sum of squares, half its gradient, and the Gauss-Newton matrix."""
    r, jacobian = residuals(lines, k), jax.jacfwd(residuals, 1)(lines, k)
    r, jacobian = r.reshape(-1), jacobian.reshape(-1, k.size)
    return r @ r, jacobian.T @ r, jacobian.T @ jacobian


def assert_solvers_see_the_same(lines, k):
    found = normal_equations(frame_residuals, lines, k)
    expected = normal_equations(weighted_distances, lines, k)
    jax.tree.map(close, found, expected)


def test_solvers_see_the_sum_gradient_and_matrix_of_all_residuals(case):
    lines, k = case
    assert frame_residuals(lines, k).shape == (3, k.shape[1] + 1)
    assert_solvers_see_the_same(lines, k)


def test_so_they_do_under_other_models_and_weights(other_case):
    assert_solvers_see_the_same(*other_case)


def energy_of(residuals):
    return lambda lines, k: jnp.sum(residuals(lines, k) ** 2)


@pytest.mark.parametrize("name", ["compressed", "any centre"])
def test_second_derivatives_are_those_of_all_residuals(name, ragged):
    """The implicit function theorem needs them, beside those by the lines."""
    lines, k = cases(ragged)[name]

    @eqx.filter_jit
    def derivatives(residuals):
        def slope(triangle, k):
            of = eqx.tree_at(lambda lines: lines.triangle, lines, triangle)
            return jax.grad(energy_of(residuals), 1)(of, k)

        change = jnp.asarray(lines.triangle) * jnp.linspace(-1, 1, 9)[:, None, None]
        by_lines = jax.jvp(lambda triangle: slope(triangle, k), (lines.triangle,), (change,))[1]
        return jax.jacfwd(slope, 1)(lines.triangle, k), by_lines

    jax.tree.map(close, derivatives(frame_residuals), derivatives(weighted_distances))


def test_derivatives_by_the_points_are_those_of_all_residuals(ragged):
    def gradient(residuals):
        return jax.grad(lambda points: energy_of(residuals)(moved(ragged, points), K))

    close(*(eqx.filter_jit(gradient(of))(ragged.points) for of in (frame_residuals, weighted_distances)))


def test_third_derivatives_are_those_of_all_residuals(ragged):
    """By the points and the coefficients: the second ones of a fit."""

    def bend(residuals):
        def of(share):
            points = ragged.points + 0.1 * jnp.sin(ragged.points + share)
            return energy_of(residuals)(moved(ragged, points), K * (1 + share))

        slopes = [of]
        for derivative in (jax.grad, jax.jacfwd, jax.jacrev):
            slopes.append(derivative(slopes[-1]))
        return eqx.filter_jit(lambda share: [slope(share) for slope in slopes])(0.1)

    close(bend(frame_residuals), bend(weighted_distances))


def test_straight_lines_have_the_derivatives_of_small_residuals():
    """Of no residuals there is no direction; the Gauss-Newton matrix and the Hessian are there."""
    t = np.linspace(0, 1, 20)[:, None]
    ends = [[(9, 0), (9, 400)], [(0, 50), (600, 80)], [(600, 9), (609, 409)]]
    straight = [(1 - t) * np.array(a) + t * np.array(b) for a, b in ends]
    lines = zj.Lines.from_ragged(straight, [0, 0, 0], [24.0], image_size=(640, 480))
    zero = jnp.zeros((1, 2))
    assert_solvers_see_the_same(lines, zero)
    found, expected = (
        eqx.filter_jit(jax.hessian(energy_of(of), 1))(lines, zero)
        for of in (frame_residuals, weighted_distances)
    )
    close(found, expected, rtol=1e-9)


def test_frames_without_lines_have_zeros(ragged):
    few = eqx.tree_at(lambda lines: lines.frame, ragged, jnp.zeros(9, int))
    residuals, change = jax.jvp(lambda k: frame_residuals(few, k), (K,), (jnp.ones_like(K),))
    for values in (residuals, change):
        np.testing.assert_array_equal(values[1:], 0)
        assert np.isfinite(values).all()


def test_triangles_are_those_of_each_frame_s_rows(rng):
    table, frame = rng.normal(size=(7, 4, 3)), np.array([2, 0, 0, 2, 2, 0, 3])
    found = triangles_by_frame(jnp.asarray(table), jnp.asarray(frame), 4)
    for of, triangle in enumerate(np.asarray(found)):
        rows = table[frame == of].reshape(-1, 3)
        np.testing.assert_allclose(triangle.T @ triangle, rows.T @ rows, rtol=1e-12, atol=1e-12)
        np.testing.assert_array_equal(np.tril(triangle, -1), 0)


def test_linearised_rows_stand_for_all_derivatives_by_the_parameters(case):
    lines, k = case
    zoom = zj.PolynomialZoom(degree=1).prepare(lines.focal, k.shape[1])
    zoom = with_parameters(zoom, jnp.stack([k[0], k[1]]))

    def residuals(lines, parameters):
        return weighted_distances(lines, coefficients_by(with_parameters(zoom, parameters), lines))

    energy, gradient, matrix = normal_equations(residuals, lines, zoom.parameters)
    rows, jacobian, *_ = eqx.filter_jit(linearised)(lines, zoom)
    assert rows.shape[1] == k.shape[1] + 1
    close(jnp.sum(rows**2), energy)
    close(jnp.einsum("lr,lrp->p", rows, jacobian), gradient)
    close(jnp.einsum("lrp,lrq->pq", jacobian, jacobian), matrix)
