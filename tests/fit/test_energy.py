import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.fit.energy import line_weights
from zoomjax.lines.best_line import line_normal, line_residuals

from .._reference import assert_derivatives_agree, frame_energies, squared_distances
from ..conftest import RAGGED_COUNTS, RAGGED_FRAMES, moved

COEFFICIENTS = jnp.array([[0.1, -0.03], [-0.05, 0.02], [0.0, 0.0]])


def close(actual, expected, rtol=1e-12):
    np.testing.assert_allclose(actual, expected, rtol=rtol)


def line_at(angle, number=7):
    """Points of a straight line through the origin, about their mean."""
    along = np.linspace(-60, 60, number)[:, None]
    return along * np.array([np.cos(angle), np.sin(angle)])


def test_frame_energy_is_equation_3(ragged):
    close(zj.fit.frame_energy(ragged, COEFFICIENTS), frame_energies(ragged, COEFFICIENTS))


def test_global_energy_is_equation_13(ragged):
    close(zj.fit.global_energy(ragged, COEFFICIENTS), frame_energies(ragged, COEFFICIENTS).mean())


def test_weights_are_one_over_frames_lines_and_points(ragged):
    lines_of_frame = np.bincount(RAGGED_FRAMES)
    expected = 1 / (3 * lines_of_frame[RAGGED_FRAMES] * np.array(RAGGED_COUNTS))
    close(line_weights(ragged), expected, rtol=1e-15)


@pytest.mark.slow
def test_residuals_are_weighted_distances(ragged):
    residuals = eqx.filter_jit(zj.fit.residuals)(ragged, jnp.zeros((3, 1)))
    weights = line_weights(ragged)
    for row, weight, line in zip(residuals, weights, ragged.to_ragged(), strict=True):
        close(row[: len(line)] ** 2, weight * squared_distances(line), rtol=1e-9)
        assert (row[len(line) :] == 0).all()


def test_no_distortion_needs_no_particular_number_of_terms(ragged):
    for terms in (1, 2, 5):
        close(
            zj.fit.frame_energy(ragged, jnp.zeros((3, terms))),
            zj.fit.frame_energy(ragged, jnp.zeros((3, 1))),
        )


def with_garbage(lines, garbage):
    """The same lines, padded three points further with whatever is in memory."""
    points = np.pad(lines.points, ((0, 0), (0, 3), (0, 0)))
    mask = np.pad(lines.mask, ((0, 0), (0, 3)))
    points[~mask] = garbage
    return eqx.tree_at(
        lambda data: (data.points, data.mask), lines, (jnp.asarray(points), jnp.asarray(mask))
    )


@pytest.mark.parametrize("compressed", [False, True])
def test_padding_changes_neither_energies_nor_gradients(compressed, ragged):
    def energy(points, k, lines):
        lines = moved(lines, points)
        return zj.fit.global_energy(zj.compress(lines) if compressed else lines, k)

    gradients = eqx.filter_jit(jax.value_and_grad(energy, (0, 1)))
    clean_value, (clean_by_point, clean_by_coefficient) = gradients(ragged.points, COEFFICIENTS, ragged)
    for garbage in (np.nan, np.inf, 1e30):
        padded = with_garbage(ragged, garbage)
        value, (by_point, by_coefficient) = gradients(padded.points, COEFFICIENTS, padded)
        close(value, clean_value)
        close(by_coefficient, clean_by_coefficient, rtol=1e-10)
        assert (by_point[~padded.mask] == 0).all()
        np.testing.assert_allclose(
            by_point[padded.mask], clean_by_point[ragged.mask], rtol=1e-9, atol=1e-12
        )


def test_order_of_lines_does_not_matter(ragged, rng):
    order = rng.permutation(len(ragged.frame))
    shuffled = eqx.tree_at(
        lambda data: (data.points, data.mask, data.frame),
        ragged,
        (ragged.points[order], ragged.mask[order], ragged.frame[order]),
    )
    close(zj.fit.frame_energy(shuffled, COEFFICIENTS), zj.fit.frame_energy(ragged, COEFFICIENTS))


def test_order_of_points_does_not_matter(ragged, rng):
    order = rng.permutation(ragged.points.shape[1])  # mixes points and padding
    shuffled = eqx.tree_at(
        lambda data: (data.points, data.mask), ragged, (ragged.points[:, order], ragged.mask[:, order])
    )
    close(zj.fit.frame_energy(shuffled, COEFFICIENTS), zj.fit.frame_energy(ragged, COEFFICIENTS))


def test_order_of_frames_does_not_matter(ragged):
    order = np.array([2, 0, 1])
    shuffled = eqx.tree_at(
        lambda data: (data.frame, data.focal),
        ragged,
        (jnp.asarray(np.argsort(order))[ragged.frame], ragged.focal[order]),
    )
    energies = zj.fit.frame_energy(shuffled, COEFFICIENTS[order])
    close(energies, zj.fit.frame_energy(ragged, COEFFICIENTS)[order])


def test_energy_scales_with_the_square_of_the_pixels(ragged):
    width, height = ragged.image_size
    doubled = zj.Lines(
        points=2 * ragged.points,
        mask=ragged.mask,
        frame=ragged.frame,
        focal=ragged.focal,
        centre=2 * ragged.centre,
        image_size=(2 * width, 2 * height),
    )
    close(zj.fit.frame_energy(doubled, COEFFICIENTS), 4 * zj.fit.frame_energy(ragged, COEFFICIENTS))


def test_energies_under_vmap(ragged):
    many = jnp.stack([COEFFICIENTS, 2 * COEFFICIENTS])
    batched = jax.vmap(lambda k: zj.fit.global_energy(ragged, k))(many)
    close(batched, [zj.fit.global_energy(ragged, k) for k in many])


def test_energy_gradient_with_respect_to_coefficients(ragged):
    assert_derivatives_agree(lambda k: zj.fit.frame_energy(ragged, k), COEFFICIENTS, step=1e-5, rtol=1e-7)


def test_normal_is_perpendicular_in_all_directions():
    lines = jnp.stack([line_at(angle) for angle in np.linspace(0, np.pi, 181)])
    close(jnp.sum(jax.jit(jax.vmap(line_normal))(lines) ** 2, axis=1), 1)
    np.testing.assert_allclose(jax.jit(jax.vmap(line_residuals))(lines), 0, atol=1e-12)


def test_normal_is_that_of_least_variance(rng):
    for angle in rng.uniform(0, np.pi, 20):
        points = line_at(angle) + 5 * rng.standard_normal((7, 2))
        centred = points - points.mean(axis=0)
        close(line_residuals(jnp.asarray(centred)) ** 2, squared_distances(points), rtol=1e-9)


@pytest.mark.parametrize("function", [line_normal, line_residuals])
def test_derivatives_on_exactly_straight_lines(function):
    lines = np.stack([line_at(np.deg2rad(angle)) for angle in (0, 45, 90, 135, 180, -90)]).round(12)
    assert_derivatives_agree(jax.vmap(function), lines, step=1e-3, rtol=1e-7)


WITHOUT_DIRECTION = {
    "one point": np.zeros((1, 2)),
    "no points": np.zeros((0, 2)),
    "all masked": np.zeros((4, 2)),
    "square": np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]]),
}


@pytest.mark.parametrize("points", WITHOUT_DIRECTION.values(), ids=WITHOUT_DIRECTION)
def test_points_without_a_direction_have_a_fixed_normal(points):
    points = jnp.asarray(points)
    close(jnp.sum(line_normal(points) ** 2), 1)
    assert (jax.jit(jax.jacrev(line_normal))(points) == 0).all()
    assert (jax.jit(jax.jacfwd(line_normal))(points) == 0).all()
    assert jnp.isfinite(jax.jit(jax.jacrev(line_residuals))(points)).all()


@pytest.mark.parametrize("count", [0, 1, 2])
def test_lines_that_hold_next_to_nothing_have_finite_gradients(count, ragged):
    """Such lines are not made by `from_ragged`, but masks may empty a line later on."""
    mask = ragged.mask.at[0].set(jnp.arange(ragged.mask.shape[1]) < count)
    thinned = eqx.tree_at(lambda data: data.mask, ragged, mask)
    gradient = jax.grad(lambda points: zj.fit.global_energy(moved(thinned, points), COEFFICIENTS))(
        ragged.points
    )
    assert jnp.isfinite(gradient).all()
    assert (gradient[0] == 0).all() or count == 2


def test_one_or_two_points_are_no_line(ragged):
    """They are straight whatever the lens, and must not dilute the mean over their frame's lines."""
    short = eqx.tree_at(lambda lines: lines.mask, ragged, ragged.mask.at[0, 2:].set(False))
    absent = eqx.tree_at(lambda lines: lines.mask, ragged, ragged.mask.at[0].set(False))
    k = jnp.full((3, 2), 0.1)
    np.testing.assert_array_equal(zj.fit.frame_energy(short, k), zj.fit.frame_energy(absent, k))


def test_lines_of_weight_zero_are_not_there(ragged):
    absent = eqx.tree_at(lambda lines: lines.mask, ragged, ragged.mask.at[0].set(False))
    k = jnp.full((3, 2), 0.1)
    for lines in (ragged, zj.compress(ragged)):
        weighted = lines.weighted(np.arange(9) > 0)
        np.testing.assert_allclose(
            zj.fit.frame_energy(weighted, k), zj.fit.frame_energy(absent, k), rtol=1e-12
        )


def test_equal_weights_change_nothing_and_whole_ones_repeat_lines(ragged):
    k = jnp.full((3, 2), 0.1)
    plain = zj.fit.frame_energy(ragged, k)
    np.testing.assert_allclose(zj.fit.frame_energy(ragged.weighted(np.full(9, 0.3)), k), plain, rtol=1e-12)
    points = ragged.to_ragged()
    repeated = zj.Lines.from_ragged(
        [*points, points[0]],
        [*np.asarray(ragged.frame), int(ragged.frame[0])],
        np.asarray(ragged.focal),
        image_size=ragged.image_size,
    )
    twice = ragged.weighted(np.where(np.arange(9) == 0, 2, 1))
    np.testing.assert_allclose(zj.fit.frame_energy(twice, k), zj.fit.frame_energy(repeated, k), rtol=1e-12)


@pytest.mark.parametrize("weight", [np.ones(8), -np.ones(9), np.full(9, np.nan)])
def test_weights_that_are_none_raise(weight, ragged):
    with pytest.raises(ValueError, match="Argument weight"):
        ragged.weighted(weight)


WITHOUT_A_FRAME = pytest.mark.parametrize(
    ("weight", "left"),
    [
        (np.array(RAGGED_FRAMES != 1, float), [0, 2]),
        (np.array(RAGGED_FRAMES == 1, float), [1]),
        (np.zeros(9), []),
        (np.full(9, 1e300), [0, 1, 2]),
        (np.full(9, 1e-300), [0, 1, 2]),
    ],
    ids=["one without weight", "one with weight", "no weight at all", "huge weights", "tiny weights"],
)


@pytest.mark.parametrize("compressed", [False, True])
@WITHOUT_A_FRAME
def test_frames_without_weight_do_not_dilute_the_energy(weight, left, compressed, ragged):
    """Their own error is not known, and the mean is that of the others."""
    lines = (zj.compress(ragged) if compressed else ragged).weighted(weight)
    frames = frame_energies(ragged, COEFFICIENTS)
    expected = np.where(np.isin(np.arange(3), left), frames, np.nan)
    close(zj.fit.frame_energy(lines, COEFFICIENTS), expected, rtol=1e-9)
    close(zj.frame_rms(lines, COEFFICIENTS) ** 2, expected, rtol=1e-9)
    close(zj.fit.global_energy(lines, COEFFICIENTS), frames[left].mean() if left else 0, rtol=1e-9)


@WITHOUT_A_FRAME
def test_gradients_past_frames_without_weight_are_finite(weight, left, ragged):
    lines = ragged.weighted(weight)

    def known(points):
        return jnp.nansum(jnp.sqrt(zj.fit.frame_energy(moved(lines, points), COEFFICIENTS)))

    gradient = np.asarray(jax.grad(known)(lines.points))
    assert np.isfinite(gradient).all()
    assert (gradient[~np.isin(RAGGED_FRAMES, left)] == 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("weighted", [False, True])
def test_energies_of_float32_lines_are_float32(weighted, ragged):
    points = [line.astype(np.float32) for line in ragged.to_ragged()]
    lines = zj.Lines.from_ragged(points, ragged.frame, ragged.focal, image_size=ragged.image_size)
    lines = lines.weighted(np.ones(9)) if weighted else lines
    k = COEFFICIENTS.astype(jnp.float32)
    for measured in (lines, zj.compress(lines)):
        for values in (
            line_weights(measured),
            zj.fit.residuals(measured, k),
            zj.fit.frame_energy(measured, k),
            zj.fit.global_energy(measured, k),
            zj.frame_rms(measured, None),
        ):
            assert values.dtype == jnp.float32
