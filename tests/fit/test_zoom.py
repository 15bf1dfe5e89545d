import os
import subprocess
import sys
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import scipy.optimize

import zoomjax as zj
from zoomjax import RESULTS
from zoomjax.fit.zoom import about_centre

from .._reference import assert_derivatives_agree, frame_energies, image_grid, largest_difference
from ..conftest import NOISE, moved

SIZE = (640, 480)
CENTRE, SCALE = np.array([319.5, 239.5]), 400.0


def parameters(fit):
    return np.asarray(fit.lens.zoom.parameters)


def distorted_lines(lens, focal, *, offset=0.0, noise=0.0, seed=0, number=12, points=25, reach=0.95):
    """Straight lines of random place and direction, as a lens shows them, `offset` px from its centre."""
    rng = np.random.default_rng(seed)
    lines, frame = [], []
    for index, f in enumerate(focal):
        for angle in np.pi * (np.arange(number) + rng.uniform()) / number:
            along, across = (
                np.array([np.cos(angle), np.sin(angle)]),
                np.array([-np.sin(angle), np.cos(angle)]),
            )
            t = reach * SCALE * np.linspace(-1, 1, points)[:, None]
            straight = CENTRE + t * along + offset * rng.uniform(-1, 1) * across
            seen = np.asarray(lens(jnp.asarray(f)).distort(straight)) if lens is not None else straight
            lines.append(seen + noise * rng.standard_normal(seen.shape))
            frame.append(index)
    with warnings.catch_warnings():  # a round image, larger than the sensor
        warnings.filterwarnings("ignore", "[0-9,]+ of [0-9,]+ points lie outside")
        return zj.Lines.from_ragged(lines, frame, focal, image_size=SIZE)


@pytest.fixture(scope="module")
def lens():
    """A small camera's zoom lens, barrel at its short end and pincushion at its long end."""
    zoom = zj.PolynomialZoom(1, jnp.array([[0.05, -0.01], [-0.15, 0.03]]), jnp.asarray(20.0))
    return zj.ZoomLens(zoom, jnp.asarray(CENTRE), jnp.array([20.0, 80.0]), SIZE)


FOCAL = np.array([20.0, 40.0, 80.0])

# Exact and noisy scenes


@pytest.mark.slow
def test_scene_without_noise_comes_back_from_all_points(clean, truth):
    fit = zj.fit_zoom(clean)
    assert largest_difference(fit.lens, truth, clean.focal) <= 1e-8
    assert fit.rms <= 1e-8
    assert fit.result == RESULTS.successful


def test_scene_without_noise_comes_back_through_the_compression(clean, truth):
    fit = zj.fit_zoom(zj.compress(clean))
    assert largest_difference(fit.lens, truth, clean.focal) <= 1e-4
    assert fit.rms <= 1e-4


def test_frames_without_noise_come_back_one_by_one(clean, truth):
    fits = zj.fit_frames(zj.compress(clean))
    grid = image_grid(clean.image_size)
    for index, f in enumerate(clean.focal):
        np.testing.assert_allclose(
            fits.distortion(index).undistort(grid), truth(f).undistort(grid), rtol=0, atol=1e-4
        )


def test_compressed_and_all_points_give_the_same_lens(fit, full_fit):
    np.testing.assert_allclose(parameters(fit), parameters(full_fit), rtol=0, atol=1e-9)
    np.testing.assert_allclose(fit.covariance, full_fit.covariance, rtol=1e-6)
    np.testing.assert_allclose(fit.frame_rms, full_fit.frame_rms, rtol=1e-9)


def test_compressed_and_all_points_give_the_same_frames(noisy, frame_fits):
    full = zj.fit_frames(noisy)
    np.testing.assert_allclose(frame_fits.coefficients, full.coefficients, rtol=0, atol=1e-9)
    np.testing.assert_allclose(frame_fits.covariance, full.covariance, rtol=1e-6)


def test_rms_is_that_of_equations_3_and_13(noisy, fit):
    coefficients = np.stack([fit.lens(f).coefficients for f in noisy.focal])
    energies = frame_energies(noisy, coefficients)
    np.testing.assert_allclose(fit.frame_rms, np.sqrt(energies), rtol=1e-9)
    np.testing.assert_allclose(fit.rms, np.sqrt(energies.mean()), rtol=1e-9)


def test_rms_is_the_noise(fit, frame_fits):
    assert fit.rms == pytest.approx(NOISE, rel=0.05)
    assert frame_fits.rms == pytest.approx(NOISE, rel=0.05)
    assert frame_fits.rms < fit.rms


def test_fitted_lens_carries_the_geometry_of_the_lines(noisy, fit):
    assert fit.lens.image_size == noisy.image_size
    assert fit.lens.focal_unit == noisy.focal_unit
    np.testing.assert_array_equal(fit.lens.centre, noisy.centre)
    np.testing.assert_array_equal(fit.lens.focal_range, [noisy.focal.min(), noisy.focal.max()])


# Starts, solvers, and relations between fits


def test_from_zero_the_minimum_is_the_same(small, fit):
    zero = zj.PolynomialZoom(2).prepare(small.focal, 2)
    np.testing.assert_allclose(
        parameters(zj.fit_zoom(small, zoom=zero)), parameters(fit), rtol=0, atol=1e-8
    )


SOLVERS = {
    "Gauss-Newton": optx.GaussNewton(1e-9, 1e-9),
    "dogleg": optx.Dogleg(1e-9, 1e-9),
    "plain Levenberg-Marquardt": optx.LevenbergMarquardt(1e-9, 1e-9),
}


@pytest.mark.parametrize("solver", SOLVERS.values(), ids=SOLVERS)
def test_other_solvers_find_the_same_minimum(solver, small, fit):
    other = zj.fit_zoom(small, solver=solver)
    np.testing.assert_allclose(parameters(other), parameters(fit), rtol=0, atol=1e-8)


def test_scipy_finds_the_same_minimum(noisy, fit):
    @jax.jit
    def residuals(flat):
        zoom = eqx.tree_at(lambda zoom: zoom.parameters, fit.lens.zoom, flat.reshape(3, 2))
        return zj.fit.residuals(noisy, jax.vmap(zoom)(noisy.focal)).ravel()

    found = scipy.optimize.least_squares(
        residuals, np.zeros(6), jac=jax.jit(jax.jacfwd(residuals)), xtol=1e-12, ftol=1e-14, gtol=1e-14
    )
    np.testing.assert_allclose(found.x.reshape(3, 2), parameters(fit), rtol=0, atol=1e-6)
    assert float(fit.rms) ** 2 <= 2 * found.cost * (1 + 1e-9)


def test_frames_are_fitted_as_zoom_lenses_of_degree_0(small, frame_fits):
    chosen, present = small.by_frame()
    for index in range(len(small.focal)):
        alone = small.take(jnp.asarray(chosen[index]), jnp.asarray(present[index]))
        single = zj.fit_zoom(alone, zoom=zj.PolynomialZoom(0))
        np.testing.assert_allclose(frame_fits.coefficients[index], parameters(single)[0], rtol=0, atol=1e-9)
        np.testing.assert_allclose(frame_fits.frame_rms[index], single.rms, rtol=1e-9)
        np.testing.assert_allclose(frame_fits.covariance[index], single.covariance, rtol=1e-6)


class LogarithmicZoom(zj.models.AbstractLinearZoom):
    """``k(f) = a + b log(f)``: a model made outside of the package."""

    parameters: jax.Array | None = None

    def prepare(self, focal, terms):
        return LogarithmicZoom(jnp.zeros((2, terms), focal.dtype))

    def basis(self, focal):
        return jnp.stack([jnp.ones_like(focal), jnp.log(focal)])


def test_zoom_model_from_outside_goes_through_the_same_fit(lens):
    logarithmic = LogarithmicZoom(jnp.array([[-0.2, 0.03], [0.05, -0.01]]))
    lines = distorted_lines(eqx.tree_at(lambda lens: lens.zoom, lens, logarithmic), FOCAL, offset=150.0)
    fit = zj.fit_zoom(zj.compress(lines), zoom=LogarithmicZoom())
    np.testing.assert_allclose(parameters(fit), logarithmic.parameters, rtol=0, atol=1e-8)


def test_frame_rms_of_a_lens_of_coefficients_and_of_nothing(noisy, small, fit):
    coefficients = jax.vmap(fit.lens.zoom)(noisy.focal)
    for lines in (noisy, small):
        np.testing.assert_allclose(zj.frame_rms(lines, fit.lens), fit.frame_rms, rtol=1e-9)
        np.testing.assert_allclose(zj.frame_rms(lines, coefficients), fit.frame_rms, rtol=1e-9)
        none = np.sqrt(frame_energies(noisy, np.zeros((4, 1))))
        np.testing.assert_allclose(zj.frame_rms(lines, None), none, rtol=1e-9)


def test_a_lens_brings_its_own_centre(noisy, small, fit):
    aside = eqx.tree_at(lambda lens: lens.centre, fit.lens, fit.lens.centre + 40)
    lines = eqx.tree_at(lambda lines: lines.centre, noisy, aside.centre)
    expected = np.sqrt(frame_energies(lines, jax.vmap(aside.zoom)(noisy.focal)))
    np.testing.assert_allclose(zj.frame_rms(noisy, aside), expected, rtol=1e-9)
    with pytest.raises(ValueError, match="another centre of distortion"):
        zj.frame_rms(small, aside)


def test_a_lens_for_other_images_raises(noisy, lens):
    with pytest.raises(ValueError, match="images of size"):
        zj.frame_rms(noisy, lens)


# Derivatives


@pytest.fixture(scope="module")
def tiny():
    """Two bent lines, one exactly vertical and one exactly horizontal, in each of two frames."""
    t = np.linspace(-1, 1, 5)
    points = []
    for bend in (6.0, -3.0):
        points += [
            np.stack([60 + bend * t**2, 240 + 200 * t], axis=-1),
            np.stack([320 + 250 * t, 420 - bend * t**2 + t], axis=-1),
            np.stack([np.full(5, 560.0), 240 + 200 * t], axis=-1),
            np.stack([320 + 250 * t, np.full(5, 50.0)], axis=-1),
        ]
    frame = np.repeat([0, 1], 4)
    return zj.Lines.from_ragged(points, frame, np.array([20.0, 60.0]), image_size=SIZE)


@pytest.mark.slow
@pytest.mark.parametrize("compressed", [False, True])
def test_fit_is_differentiable_with_respect_to_the_points(compressed, tiny):
    def fitted(points):
        lines = moved(tiny, points)
        lines = zj.compress(lines, 1) if compressed else lines
        lens = zj.fit_zoom(lines, zoom=zj.PolynomialZoom(1), terms=1).lens
        corner = lens(30.0).undistort(jnp.zeros(2))
        return jnp.concatenate([100 * lens.zoom.parameters.ravel(), corner])

    assert_derivatives_agree(fitted, tiny.points, step=1e-3, rtol=1e-6)


@pytest.mark.slow
def test_frame_fits_are_differentiable_with_respect_to_the_points(tiny):
    def fitted(points):
        return zj.fit_frames(zj.compress(moved(tiny, points), 1), terms=1).coefficients

    assert_derivatives_agree(fitted, tiny.points, step=1e-3, rtol=1e-6)


# float32


@pytest.fixture(scope="module")
def single(noisy):
    """The noisy scene, points rounded to float32."""
    points = [line.astype(np.float32) for line in noisy.to_ragged()]
    return zj.Lines.from_ragged(points, noisy.frame, noisy.focal, image_size=noisy.image_size)


@pytest.mark.parametrize("compressed", [False, True])
def test_float32_stays_float32_and_agrees_at_the_corner(compressed, single, full_fit):
    fit = zj.fit_zoom(zj.compress(single) if compressed else single)
    for leaf in jax.tree.leaves((fit.lens, fit.rms, fit.frame_rms, fit.covariance)):
        assert leaf.dtype == jnp.float32
    corner = jnp.zeros(2)
    for f in single.focal:
        exact = full_fit.lens(jnp.asarray(f, jnp.float64)).undistort(corner)
        assert jnp.linalg.norm(fit.lens(f).undistort(corner) - exact) <= 0.02


WITHOUT_X64 = """
import sys, numpy as np, zoomjax as zj
stored = zj.load_lines(sys.argv[1])
lines = zj.Lines.from_ragged(stored.to_ragged(), stored.frame, stored.focal, image_size=stored.image_size)
assert isinstance(lines.points, np.ndarray) and lines.points.dtype == np.float64, type(lines.points)
lines.save(sys.argv[2])
corners = []
for data in (lines, zj.compress(lines)):
    lens = zj.fit_zoom(data).lens
    assert lens.zoom.parameters.dtype == np.float32
    corners.append([lens(f).undistort(np.zeros(2, np.float32)) for f in lines.focal])
np.save(sys.argv[3], corners)
"""


@pytest.mark.slow
def test_without_x64_float64_input_is_kept_and_fitted_in_float32(noisy, full_fit, tmp_path):
    before, after, result = tmp_path / "before.npz", tmp_path / "after.npz", tmp_path / "corners.npy"
    noisy.save(before)
    environment = {name: value for name, value in os.environ.items() if name != "JAX_ENABLE_X64"}
    command = [sys.executable, "-W", "error", "-c", WITHOUT_X64, before, after, result]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    np.testing.assert_array_equal(zj.load_lines(after).points, noisy.points)
    exact = np.stack([full_fit.lens(f).undistort(jnp.zeros(2)) for f in noisy.focal])
    for corners in np.load(result):
        assert np.linalg.norm(corners - exact, axis=-1).max() <= 0.02


# Compilations


def test_second_fit_of_the_same_shapes_compiles_nothing(clean, noisy, compilations):
    def everything(lines):
        small = zj.compress(lines)
        return zj.fit_zoom(lines), zj.fit_zoom(small), zj.fit_frames(small), zj.frame_rms(lines, None)

    everything(clean)
    compilations()
    everything(noisy)
    assert compilations() == 0


# Covariance


def repeated(lens, focal):
    """A hundred fits of one scene, each with its own noise, and the noise."""
    clean = distorted_lines(lens, focal, offset=180.0)
    rng = np.random.default_rng(1)
    noise = 0.1
    fits = [
        zj.fit_zoom(
            zj.compress(moved(clean, clean.points + noise * rng.standard_normal(clean.points.shape))),
            zoom=zj.PolynomialZoom(1),
        )
        for _ in range(100)
    ]
    return fits, noise


@pytest.fixture(scope="module")
def draws(lens):
    return repeated(lens, FOCAL)


def test_covariance_is_that_of_repeated_measurements(lens):
    """With 24 photos: with three, how much those differ by chance is in it, too."""
    fits, _ = repeated(lens, np.repeat(FOCAL, 8))
    estimates = np.stack([parameters(fit).ravel() for fit in fits])
    covariance = np.mean([fit.covariance for fit in fits], axis=0)
    # Standard deviations over 100 draws are known to 7 %: three of those.
    np.testing.assert_allclose(estimates.std(axis=0, ddof=1), np.sqrt(np.diag(covariance)), rtol=0.22)
    error = estimates - np.asarray(lens.zoom.parameters).ravel()
    squared = np.einsum("di,ij,dj->d", error, np.linalg.inv(covariance), error)
    # Chi squared of 4 unknowns; variances are 1.1 times as large, as photos also differ by chance.
    assert squared.mean() == pytest.approx(4 / 1.1, abs=3 * np.sqrt(2 * 4 / 100))


def test_bands_hold_as_often_as_they_say_with_few_photos(draws, lens):
    """Three photos: in 95 % of the draws, within three points and their error by chance."""
    fits, _ = draws
    truth = np.asarray(lens.zoom.parameters)
    off = [abs(parameters(fit) - truth).ravel() / np.sqrt(np.diag(fit.covariance)) for fit in fits]
    within = (np.stack(off) < 1.96).mean()
    assert within == pytest.approx(0.95, abs=0.03 + 2 * np.sqrt(0.95 * 0.05 / 100))


def test_rms_is_the_noise_of_the_image(draws):
    """Less what the fitted lines and lens take up, 2 of 25 points a line; times L, near 1 here."""
    fits, noise = draws
    assert np.mean([fit.rms for fit in fits]) == pytest.approx(noise * np.sqrt(23 / 25), rel=0.06)


def test_covariance_does_not_depend_on_the_unit_of_focal_lengths(lens):
    lines = distorted_lines(lens, FOCAL, offset=180.0, noise=0.1)
    metres = eqx.tree_at(lambda lines: lines.focal, lines, lines.focal / 1000)
    fit, other = (zj.fit_zoom(zj.compress(one), zoom=zj.PolynomialZoom(1)) for one in (lines, metres))
    np.testing.assert_allclose(fit.covariance, other.covariance, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("degree", "terms"), [(2, 2), (3, 3)])
def test_covariance_in_float32_is_that_in_float64(degree, terms, noisy):
    """The higher ones have condition numbers whose square float32 cannot hold."""
    single = jax.tree.map(
        lambda a: a.astype(jnp.float32) if jnp.issubdtype(a.dtype, jnp.floating) else a, noisy
    )
    ours, true = (
        zj.fit_zoom(zj.compress(lines, terms), zoom=zj.PolynomialZoom(degree), terms=terms)
        for lines in (single, noisy)
    )
    assert ours.covariance.dtype == jnp.float32
    assert ours.result == true.result == RESULTS.successful
    np.testing.assert_allclose(np.diag(ours.covariance), np.diag(true.covariance), rtol=0.01)


# Outcomes that the user must hear of


@pytest.mark.parametrize("noise", [0.0, 0.3])
@pytest.mark.parametrize("compressed", [False, True])
def test_lines_through_the_centre_determine_nothing(noise, compressed, lens):
    lines = distorted_lines(lens, FOCAL, noise=noise)
    fit = zj.fit_zoom(zj.compress(lines) if compressed else lines, zoom=zj.PolynomialZoom(1))
    assert fit.result == RESULTS.undetermined
    assert np.isinf(np.diag(fit.covariance)).all()
    assert "do not determine" in RESULTS[fit.result]


@pytest.mark.slow
def test_frames_whose_lines_determine_nothing_say_so(lens):
    """In the first frame all lines pass through the centre; in the others they do not."""
    through, past = (
        distorted_lines(lens, FOCAL, noise=0.1),
        distorted_lines(lens, FOCAL, offset=180.0, noise=0.1),
    )
    first = (past.frame == 0)[:, None, None]
    mixed = moved(past, jnp.where(first, through.points, past.points))
    fits = zj.fit_frames(zj.compress(mixed))
    np.testing.assert_array_equal(fits.result == RESULTS.undetermined, [True, False, False])
    np.testing.assert_array_equal(np.isinf(fits.covariance[:, 0, 0]), [True, False, False])
    assert [message[:23] for message in fits.messages()] == ["The points do not deter", "", ""]


def test_good_fits_are_successful(fit, full_fit, frame_fits):
    assert fit.result == full_fit.result == RESULTS.successful
    assert (frame_fits.result == RESULTS.successful).all()
    assert np.isfinite(fit.covariance).all()


def test_lens_that_folds_within_the_image_is_said_to(lens):
    """Lines of the middle only, of a barrel that folds at 0.87 of the way to the corner."""
    folding = zj.PolynomialZoom(0, jnp.array([[-0.44]]), jnp.asarray(20.0))
    lines = distorted_lines(
        eqx.tree_at(lambda lens: lens.zoom, lens, folding), FOCAL, offset=100.0, reach=0.4
    )
    fit = zj.fit_zoom(zj.compress(lines), zoom=zj.PolynomialZoom(0), terms=1, invertible=False)
    np.testing.assert_allclose(parameters(fit), [[-0.44]], atol=1e-6)
    assert fit.result == RESULTS.folded
    assert not fit.certificate.certified
    assert "not invertible" in RESULTS[fit.result]


def test_too_few_focal_lengths_raise(tiny):
    with pytest.raises(ValueError, match="needs 3 or more distinct focal lengths, but there are 2"):
        zj.fit_zoom(tiny)


def test_lines_compressed_for_fewer_terms_raise(small):
    for fit in (zj.fit_zoom, zj.fit_frames):
        with pytest.raises(ValueError, match="compressed for 2 terms, but 3 are requested"):
            fit(small, terms=3)


def test_too_few_steps_raise_unless_asked_not_to(small):
    fit = zj.fit_zoom(small, max_steps=1, throw=False)
    assert fit.result == RESULTS.nonlinear_max_steps_reached
    with pytest.raises(RuntimeError, match="maximum number of steps"):
        zj.fit_zoom(small, max_steps=1)


# The paper's rivals


def test_a_table_at_every_focal_length_is_frame_by_frame(small, frame_fits):
    fit = zj.fit_zoom(small, zoom=zj.models.TableZoom())
    np.testing.assert_allclose(parameters(fit)[::-1], frame_fits.coefficients, atol=1e-7)
    np.testing.assert_allclose(fit.frame_rms, frame_fits.frame_rms, rtol=1e-9)


RIVALS = {
    "table": (zj.models.TableZoom(number=2, inverse=False), [[0.05], [-0.1]]),
    "spline": (zj.models.SplineZoom(number=3), [[0.05], [0.02], [-0.1]]),
    "power law": (zj.models.PowerZoom(), [[0.02], [-0.1], [-1.3]]),
    "two regions": (zj.models.TwoRegionZoom(35.0), [[-0.3], [0.5], [-0.3], [0.08], [-0.1], [0.05]]),
}


@pytest.mark.slow
@pytest.mark.parametrize(("model", "truth"), RIVALS.values(), ids=RIVALS)
def test_a_lens_of_a_rivals_kind_comes_back(model, truth, lens):
    focal = np.array([20.0, 25.0, 30.0, 40.0, 55.0, 80.0])
    zoom = eqx.tree_at(
        lambda zoom: zoom.parameters,
        model.prepare(focal, 1),
        jnp.asarray(truth),
        is_leaf=lambda x: x is None,
    )
    lines = distorted_lines(eqx.tree_at(lambda lens: lens.zoom, lens, zoom), focal, offset=180.0)
    fit = zj.fit_zoom(zj.compress(lines), zoom=model, terms=1)
    np.testing.assert_allclose(parameters(fit), truth, atol=1e-6)
    assert fit.rms < 1e-6


# Plain mistakes


MISTAKES = {
    "terms of zero": ({"terms": 0}, ValueError, "terms must be an integer of at least 1, but it is 0"),
    "terms beyond those of a lens": ({"terms": 5}, ValueError, "terms must be at most 4, but it is 5"),
    "terms with a fraction": ({"terms": 2.0}, ValueError, "but it is 2.0"),
    "terms in words": ({"terms": "2"}, ValueError, "but it is '2'"),
    "a degree for a model": (
        {"zoom": 2},
        TypeError,
        r"such as PolynomialZoom\(degree=2\), but its type is int",
    ),
    "a class for a model": ({"zoom": zj.PolynomialZoom}, TypeError, "such as PolynomialZoom"),
}


@pytest.mark.parametrize(("arguments", "error", "message"), MISTAKES.values(), ids=MISTAKES)
def test_a_plain_mistake_is_told(arguments, error, message, small, unchecked):
    with pytest.raises(error, match=message):
        zj.fit_zoom(small, **arguments)


def test_things_that_are_not_lines_are_refused(noisy, unchecked):
    for function in (zj.fit_zoom, zj.fit_frames, lambda lines: zj.frame_rms(lines, None)):
        with pytest.raises(TypeError, match="lines must be Lines"):
            function(noisy.to_ragged())


def test_the_fit_is_not_taken_for_its_lens(small, fit, unchecked):
    with pytest.raises(TypeError, match=r"fit\.lens, not the fit"):
        zj.frame_rms(small, fit)


def test_terms_that_contradict_the_start_raise(small, fit):
    with pytest.raises(ValueError, match="the parameters of zoom are for 2"):
        zj.fit_zoom(small, zoom=fit.lens.zoom, terms=1)


def test_a_start_does_not_excuse_too_few_focal_lengths(tiny, fit):
    with pytest.raises(ValueError, match="3 or more distinct focal lengths"):
        zj.fit_zoom(tiny, zoom=fit.lens.zoom)


def test_numpy_integers_are_integers(small, fit, unchecked):
    again = zj.fit_zoom(small, zoom=zj.PolynomialZoom(np.int64(2)), terms=np.int64(2))
    np.testing.assert_array_equal(parameters(again), parameters(fit))


def test_a_float32_model_starts_a_float64_fit(small, fit):
    start = jax.tree.map(lambda a: a.astype(jnp.float32), fit.lens.zoom)
    again = zj.fit_zoom(small, zoom=start)
    assert again.lens.zoom.parameters.dtype == jnp.float64
    np.testing.assert_allclose(parameters(again), parameters(fit), atol=1e-9)


def test_frames_that_are_not_there_raise(frame_fits):
    np.testing.assert_array_equal(frame_fits.distortion(-1).coefficients, frame_fits.coefficients[3])
    with pytest.raises(IndexError, match="no frame 4: the frames fitted are 0 to 3"):
        frame_fits.distortion(4)


def test_messages_of_good_frames_are_empty(frame_fits):
    assert frame_fits.messages() == [""] * 4


def test_frame_rms_tells_of_frames_outside_of_the_range(noisy, fit):
    narrow = eqx.tree_at(lambda lens: lens.focal_range, fit.lens, fit.lens.focal_range[:1].repeat(2))
    with pytest.warns(UserWarning, match="Focal lengths from 20.56 to 127.36 mm are not all within"):
        zj.frame_rms(noisy, narrow)


@pytest.mark.parametrize("centre", [(1e9, 1e9), (-5000.0, 1e4), (95955.0, 539.0)])
def test_a_centre_outside_of_the_image_is_said(small, noisy, centre):
    """About which lines are the straighter the farther it is: a slip of the keyboard would look good."""
    with pytest.warns(UserWarning, match="is outside of the image of 4288 x 2848 px"):
        about_centre(noisy, centre)
    inside = np.asarray(noisy.centre)
    assert about_centre(small, inside) is small
