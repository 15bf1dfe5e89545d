"""Every distortion model through one table of tests, and what is particular to each."""

import json
import math

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.correct._inverse_polynomial import fit_inverse
from zoomjax.correct.warp import sample_positions

from .._reference import finite_jacobian, image_grid

SIZE = (320, 240)
CENTRE, SCALE = np.array([159.5, 119.5]), 200.0
TABLE = {  # coefficients well within the domain, and some whose domain ends inside the image
    "polynomial": (zj.models.RadialPolynomial(), [-0.12, 0.03], [-0.5, 0.02]),
    "division 1": (zj.models.Division(), [-0.2], [1.4]),
    "division 2": (zj.models.Division(), [-0.15, -0.03], [0.5, 0.4]),
    "division at a pole": (zj.models.Division(), [-0.3, 0.02], [-1.5]),
    "decentred": (zj.models.BrownConrady(), [-0.1, 0.02, 0.004, -0.003], [-0.4, 0.02, 0.01, 0.02]),
}
DISTORTION_MODELS = {name: TABLE[name] for name in ("polynomial", "division 1", "decentred")}
RANGE = np.array([20.0, 80.0])

every = pytest.mark.parametrize(("distortion_model", "k", "tight"), TABLE.values(), ids=TABLE)


def distortion(distortion_model, k, dtype=np.float64):
    return zj.Distortion(*(jnp.asarray(leaf, dtype) for leaf in (k, CENTRE, SCALE)), distortion_model)


def lens_of(distortion_model, k, change=0.5):
    """A lens whose coefficients grow from k to (1 + change) k at the shortest focal length."""
    parameters = jnp.stack([jnp.asarray(k), change * jnp.asarray(k)])
    zoom = zj.PolynomialZoom(1, parameters, jnp.asarray(RANGE[0]))
    return zj.ZoomLens(
        zoom, jnp.asarray(CENTRE), jnp.asarray(RANGE), SIZE, distortion_model=distortion_model
    )


@pytest.mark.slow
@every
def test_there_and_back(distortion_model, k, tight):
    grid = jnp.asarray(image_grid(SIZE, 9))
    for d in (distortion(distortion_model, k), distortion(distortion_model, tight)):
        corrected = d.undistort(grid)
        inside = np.linalg.norm(np.asarray(grid) - CENTRE, axis=1) < float(d.monotone_radius)
        np.testing.assert_array_equal(np.isfinite(corrected).all(axis=1), inside)
        np.testing.assert_allclose(d.distort(corrected)[inside], grid[inside], rtol=0, atol=1e-8)
        assert d.has_inverse(corrected)[inside].all()
    assert not inside.all()


@every
def test_where_there_is_no_inverse_is_nan(distortion_model, k, tight):
    del k
    d = distortion(distortion_model, tight)
    radius = float(d.monotone_radius)
    angle = np.linspace(0, 2 * np.pi, 8)
    border = CENTRE + (1 - 1e-6) * radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    beyond = jnp.asarray(CENTRE + 1.3 * (np.asarray(d.undistort(border)) - CENTRE))
    end = jnp.asarray((radius / SCALE) ** 2)
    pole = (
        isinstance(distortion_model, zj.models.Division)
        and not distortion_model.factor(end, jnp.asarray(tight)) < 1e6
    )
    assert d.has_inverse(beyond).all() == pole
    np.testing.assert_array_equal(np.isnan(d.distort(beyond)), not pole)
    assert np.isnan(d.distort(jnp.array([jnp.nan, 3.0]))).all()


@pytest.mark.slow
@every
def test_derivatives(distortion_model, k, tight):
    del tight
    points = CENTRE + np.array([(0, 0), (30, -50), (-140, 100)])

    def both(k, points):
        d = distortion(distortion_model, k)
        return jnp.stack([d.undistort(points), d.distort(points)])

    for place, x in enumerate((np.array(k), points)):
        arguments = [jnp.asarray(k), jnp.asarray(points)]

        def function(x, place=place, arguments=arguments):
            return both(*arguments[:place], x, *arguments[place + 1 :])

        finite = finite_jacobian(jax.jit(function), x, 1e-5 if place == 0 else 1e-2)
        scale = np.abs(finite).max()
        for derivative in (jax.jacfwd, jax.jacrev):
            np.testing.assert_allclose(derivative(function)(jnp.asarray(x)), finite, atol=1e-6 * scale)


@every
def test_pixel_coefficients(distortion_model, k, tight):
    del tight
    d = distortion(distortion_model, k)
    pixels = zj.Distortion(d.pixel_coefficients, d.centre, jnp.asarray(1.0), distortion_model)
    grid = jnp.asarray(image_grid(SIZE, 5))
    np.testing.assert_allclose(pixels.undistort(grid), d.undistort(grid), rtol=1e-12)


@every
def test_float32(distortion_model, k, tight):
    del tight
    d, exact = distortion(distortion_model, k, np.float32), distortion(distortion_model, k)
    grid = jnp.asarray(image_grid(SIZE, 5), jnp.float32)
    assert d.distort(grid).dtype == jnp.float32
    np.testing.assert_allclose(d.distort(grid), exact.distort(grid.astype(float)), rtol=0, atol=2e-3)


def least_slope(distortion_model, zoom):
    """The least eigenvalue of the Jacobian, and of the divisor, sampled."""
    corner = np.array(SIZE) / 2  # pixels have an area
    z = jnp.asarray((image_grid(SIZE, 21) - CENTRE) * corner / (corner - 0.5) / SCALE)

    def least(f):
        k = zoom(f)
        jacobian = jax.vmap(
            jax.jacfwd(lambda z: jnp.stack(distortion_model.correct((z[0], z[1]), z @ z, k)))
        )(z)
        values = jnp.linalg.eigvalsh((jacobian + jacobian.mT) / 2)
        if isinstance(distortion_model, zj.models.Division):  # its slope's numerator, and the divisor
            factor = distortion_model.factor(jnp.sum(z**2, axis=1), k)
            return jnp.minimum(jnp.min(values[:, 0] / factor**2), jnp.min(1 / factor))
        return jnp.min(values)

    return float(jnp.min(jax.vmap(least)(jnp.geomspace(*RANGE, 41))))


@every
def test_certificate_against_sampling(distortion_model, k, tight):
    certify = eqx.filter_jit(zj.models.certify)
    outcomes = []
    for factor, base in ((0.5, k), (1.0, k), (0.2, tight), (0.6, tight), (1.0, tight)):
        lens = lens_of(distortion_model, factor * np.array(base))
        ours = certify(lens)
        sampled = least_slope(distortion_model, lens.zoom)
        assert ours.least <= sampled + 1e-9
        assert ours.certified == (ours.least > 0)
        if sampled > 0.1:
            assert ours.certified
        if ours.certified:
            grid = jnp.asarray(image_grid(SIZE, 5))
            d = lens(float(RANGE[0]))
            np.testing.assert_allclose(d.distort(d.undistort(grid)), grid, rtol=0, atol=1e-8)
        outcomes.append(bool(ours.certified))
    assert outcomes[0]
    assert not outcomes[-1]


@every
def test_file(distortion_model, k, tight, tmp_path):
    del tight
    lens = lens_of(distortion_model, k)
    lens.save(tmp_path / "lens.json")
    again = zj.load_lens(tmp_path / "lens.json")
    assert again.distortion_model == distortion_model
    point = jnp.array([3.0, 7.0])
    np.testing.assert_array_equal(again(30.0).undistort(point), lens(30.0).undistort(point))


def test_files_up_to_version_2_call_it_family(tmp_path):
    lens = lens_of(zj.models.Division(), [-0.1])
    lens.save(tmp_path / "lens.json")
    content = json.loads((tmp_path / "lens.json").read_text())
    assert (content["version"], content["distortion_model"]) == (3, "Division")
    content |= {"version": 2, "family": content.pop("distortion_model")}
    (tmp_path / "older.json").write_text(json.dumps(content))
    assert zj.load_lens(tmp_path / "older.json").distortion_model == zj.models.Division()
    del content["family"]  # and are not of the polynomial
    (tmp_path / "older.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match="distortion model, None, is unknown"):
        zj.load_lens(tmp_path / "older.json")


def test_files_of_unknown_models_and_too_few_coefficients_are_refused(tmp_path):
    lens_of(zj.models.Division(), [-0.1]).save(tmp_path / "lens.json")
    text = (tmp_path / "lens.json").read_text()
    for distortion_model, message in (("Fisheye", "unknown"), ("BrownConrady", "it gives 1")):
        (tmp_path / "other.json").write_text(text.replace('"Division"', f'"{distortion_model}"'))
        with pytest.raises(ValueError, match=message):
            zj.load_lens(tmp_path / "other.json")


def lines_of(lens, bend=0.0, noise=0.0):
    """Lines across the whole image, seen through a lens at three focal lengths."""
    focal = np.array([20.0, 32.0, 80.0])
    along = np.linspace(-0.15, 1.15, 60)
    rng = np.random.default_rng(5)
    points, frame = [], []
    for m, f in enumerate(focal):
        d = lens(float(f))
        for axis in (0, 1):
            for at in (0.12, 0.3, 0.5, 0.7, 0.88):
                line = np.empty((60, 2))
                line[:, axis] = along * (SIZE[axis] - 1)
                line[:, 1 - axis] = (
                    at * (SIZE[1 - axis] - 1) + 6 * (along - 0.5) + bend * (along - 0.5) ** 2
                )
                seen = np.asarray(d.distort(line)) + noise * rng.standard_normal((60, 2))
                seen = seen[((seen >= 0) & (seen <= np.array(SIZE) - 1)).all(axis=1)]
                points.append(seen)
                frame.append(m)
    return zj.Lines.from_ragged(points, frame, focal, image_size=SIZE)


@pytest.fixture(scope="module", params=DISTORTION_MODELS.values(), ids=DISTORTION_MODELS)
def fitted(request):
    """A distortion model, its true lens, noisy lines, and the fit to them compressed."""
    distortion_model, k, _ = request.param
    lens = lens_of(distortion_model, k)
    lines = lines_of(lens, noise=0.05)
    terms = len(k) - distortion_model.num_coefficients(0)
    small = zj.fit.compress_for(lines, distortion_model, terms=terms)
    return lens, lines, small, terms, zj.fit_zoom(small, zoom=zj.PolynomialZoom(degree=1), terms=terms)


@pytest.mark.slow
def test_fit_recovers_the_lens(fitted):
    lens, _, _, terms, fit = fitted
    assert fit.lens.distortion_model == lens.distortion_model
    assert fit.certificate.certified
    assert fit.result == zj.RESULTS.successful
    grid = jnp.asarray(image_grid(SIZE, 7))
    std = zj.displacement_std(fit, grid, focal=32.0)
    error = np.linalg.norm(fit.lens(32.0).undistort(grid) - lens(32.0).undistort(grid), axis=1)
    # Decentering is a shift of the picture, too, which bends nothing.
    assert np.all(error < 5 * np.asarray(std) + 0.02)
    assert float(jnp.max(std)) < 1
    zoom = zj.PolynomialZoom(degree=1)
    exact = zj.fit_zoom(
        zj.fit.compress_for(lines_of(lens), lens.distortion_model, terms=terms), zoom=zoom, terms=terms
    )
    np.testing.assert_allclose(exact.lens.zoom.parameters, lens.zoom.parameters, rtol=0, atol=2e-7)


def test_points_and_their_compression_give_one_fit(fitted):
    lens, lines, small, terms, fit = fitted
    k = jax.vmap(lens.zoom)(jnp.asarray(lines.focal))
    full = zj.fit.with_distortion_model(lines, lens.distortion_model)
    np.testing.assert_allclose(zj.fit.frame_energy(small, k), zj.fit.frame_energy(full, k), rtol=1e-6)
    ours = zj.fit_zoom(
        lines, distortion_model=lens.distortion_model, zoom=zj.PolynomialZoom(degree=1), terms=terms
    )
    np.testing.assert_allclose(ours.lens.zoom.parameters, fit.lens.zoom.parameters, rtol=0, atol=1e-6)
    np.testing.assert_allclose(ours.covariance, fit.covariance, rtol=1e-3, atol=1e-12)
    for same in (lines, small):
        np.testing.assert_allclose(zj.frame_rms(same, fit.lens), fit.frame_rms, rtol=1e-6)


@pytest.mark.slow
def test_frames_by_themselves(fitted):
    lens, _, small, terms, _ = fitted
    fits = zj.fit_frames(small, terms=terms)
    d = fits.distortion(1)
    assert d.distortion_model == lens.distortion_model
    np.testing.assert_allclose(d.coefficients, lens(32.0).coefficients, rtol=0, atol=0.02)


def test_crooked_lines_are_rejected(fitted):
    lens, lines, _, terms, _ = fitted
    points = lines.to_ragged()
    middle = points[7][:, :1] * 0 + np.linspace(-1, 1, len(points[7]))[:, None] ** 2
    points[7] = points[7] + middle * np.array([12.0, 0.0])  # upright, in the middle
    crooked = zj.Lines.from_ragged(
        points, np.asarray(lines.frame), np.asarray(lines.focal), image_size=SIZE
    )
    small = zj.fit.compress_for(crooked, lens.distortion_model, terms=terms)
    robust = zj.fit_robust(small, zoom=zj.PolynomialZoom(degree=1), terms=terms)
    assert 7 in robust.rejected
    assert robust.fit.lens.distortion_model == lens.distortion_model


@pytest.mark.parametrize(
    ("distortion_model", "terms", "message"),
    [
        (zj.models.Division(), 1, r"compress\(lines, terms=8\)"),
        (zj.models.BrownConrady(), 2, r"compress_any_centre\(lines, terms=2\)"),
    ],
)
def test_lines_compressed_for_another_model_are_refused(distortion_model, terms, message, ragged):
    with pytest.raises(ValueError, match=message):
        zj.fit_zoom(
            zj.compress(ragged),
            distortion_model=distortion_model,
            zoom=zj.PolynomialZoom(degree=1),
            terms=terms,
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("distortion_model", "k", "tight"),
    list(DISTORTION_MODELS.values())[1:],
    ids=list(DISTORTION_MODELS)[1:],
)
def test_a_fit_is_made_invertible(distortion_model, k, tight):
    """Lines of a lens that does not fold, corrected by one that would."""
    del k
    terms = len(tight) - distortion_model.num_coefficients(0)
    bent = lines_of(lens_of(zj.models.RadialPolynomial(), [0.0]), bend=-90.0 if tight[0] < 0 else 90.0)
    small = zj.fit.compress_for(bent, distortion_model, terms=terms)
    zoom = zj.PolynomialZoom(degree=0)
    free = zj.fit_zoom(small, zoom=zoom, terms=terms, invertible=False, throw=False)
    ours = zj.fit_zoom(small, zoom=zoom, terms=terms)
    assert ours.certificate.certified
    assert ours.rms >= free.rms * (1 - 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("distortion_model", "k", "tight"), DISTORTION_MODELS.values(), ids=DISTORTION_MODELS
)
def test_images_are_corrected_by_the_exact_inverse(distortion_model, k, tight):
    del tight
    d = distortion(distortion_model, k)
    framing = zj.correct.frame_output(d, SIZE, keep="valid")
    pixels = np.stack(np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1])), axis=-1)
    exact = np.asarray(d.distort(framing.corrected(pixels)))
    assert ((exact >= 0) & (exact <= np.array(SIZE) - 1)).all()
    # An image that is its own coordinates shows where each pixel comes from.
    image = pixels.astype(np.float32)
    shown = zj.undistort_image(image, d, keep=framing)
    np.testing.assert_allclose(shown, exact, rtol=0, atol=0.01)
    warped = zj.warp_image(jnp.asarray(image), d, framing=framing)
    np.testing.assert_allclose(warped, exact, rtol=0, atol=0.01)
    assert (fit_inverse(d, 250.0) is None) == isinstance(distortion_model, zj.models.BrownConrady)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("distortion_model", "k", "tight"), DISTORTION_MODELS.values(), ids=DISTORTION_MODELS
)
def test_positions_are_differentiable(distortion_model, k, tight):
    del tight
    framing = zj.Framing(np.array(1.0), np.array([5.0, 9.0]), (3, 2))

    def positions(k):
        return jnp.stack(sample_positions(distortion(distortion_model, k), framing, jnp.float64))

    finite = finite_jacobian(jax.jit(positions), np.array(k), 1e-5)
    np.testing.assert_allclose(jax.jacrev(positions)(jnp.array(k)), finite, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", ["polynomial", "division 1", "decentred"])
def test_distances_in_the_image(name):
    distortion_model, k, _ = TABLE[name]
    lens = lens_of(distortion_model, k)
    lines = lines_of(lens, noise=0.05)
    small = zj.fit.compress_for(
        lines, distortion_model, terms=len(k) - distortion_model.num_coefficients(0)
    )
    coefficients = jax.vmap(lens.zoom)(jnp.asarray(lines.focal))
    energy = zj.fit.global_energy(zj.fit.in_image(small), coefficients)
    full = zj.fit.in_image(zj.fit.with_distortion_model(lines, distortion_model))
    np.testing.assert_allclose(energy, zj.fit.global_energy(full, coefficients), rtol=1e-6)
    assert math.sqrt(energy) == pytest.approx(0.05, rel=0.15)


def test_division_is_its_formula():
    d = distortion(zj.models.Division(), [-0.2, 0.03])
    z = np.array([0.6, -0.3])
    expected = CENTRE + SCALE * z / (1 - 0.2 * 0.45 + 0.03 * 0.45**2)
    np.testing.assert_allclose(d.undistort(CENTRE + SCALE * z), expected, rtol=1e-14)


def test_decentering_is_opencvs():
    """Whose formula goes from corrected to distorted: it distorts by what corrects here."""
    k = [-0.1, 0.02, 0.004, -0.003]
    grid = image_grid(SIZE, 7)
    z = np.concatenate([(grid - CENTRE) / SCALE, np.ones((49, 1))], axis=1)
    none = np.zeros(3)
    theirs, _ = cv2.projectPoints(z, none, none, np.eye(3), np.array(k))
    ours = distortion(zj.models.BrownConrady(), k)
    np.testing.assert_allclose(ours.undistort(grid), CENTRE + SCALE * theirs[:, 0], rtol=0, atol=1e-9)


def test_without_decentering_it_is_the_polynomial():
    grid = jnp.asarray(image_grid(SIZE, 7))
    ours = distortion(zj.models.BrownConrady(), [-0.1, 0.02, 0.0, 0.0])
    plain = distortion(zj.models.RadialPolynomial(), [-0.1, 0.02])
    np.testing.assert_allclose(ours.undistort(grid), plain.undistort(grid), rtol=1e-14)
    np.testing.assert_allclose(ours.monotone_radius, plain.monotone_radius, rtol=1e-9)


def test_decentering_and_a_shift_of_the_centre_are_nearly_the_same():
    """About a centre off by d, ``z L`` of k1 is, to first order, that with (p2, p1) = -k1 d, see docs."""
    k1, shift = -0.1, np.array([2.0, -1.0])
    d = shift / SCALE
    moved = zj.Distortion(jnp.array([k1]), jnp.asarray(CENTRE + shift), jnp.asarray(SCALE))
    ours = distortion(zj.models.BrownConrady(), [k1, -k1 * d[1], -k1 * d[0]])
    grid = jnp.asarray(image_grid(SIZE, 9))
    apart = np.asarray(moved.undistort(grid) - ours.undistort(grid))
    both = np.asarray(
        moved.undistort(grid) - distortion(zj.models.RadialPolynomial(), [k1]).undistort(grid)
    )
    assert np.abs(both).max() > 0.4
    assert np.abs(apart).max() < 0.01
