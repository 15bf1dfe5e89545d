"""Focal lengths known with errors: bands that allow for them, and focal lengths that the lines mend."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes
from zoomjax.fit import focal_fit
from zoomjax.fit.covariance import parameter_covariance
from zoomjax.fit.energy import linearised
from zoomjax.fit.focal_lengths import _response, checked_sigma, of_equal_focal
from zoomjax.lines import compress_any_centre
from zoomjax.models.zoom import with_parameters

ROUNDED = 1 / np.sqrt(12)


def at_focal(lines, focal):
    return eqx.tree_at(lambda lines: lines.focal, lines, jnp.asarray(focal))


@pytest.fixture(scope="module")
def sweep(truth):
    """Ten focal lengths, few points."""
    return zj.compress(scenes.board_lines(truth, scenes.focal_sweep(10), spacing=150.0, noise=0.1, seed=1))


@pytest.fixture(scope="module")
def rounded(sweep):
    return at_focal(sweep, np.round(sweep.focal))


@pytest.fixture(scope="module")
def refined(rounded):
    return zj.fit.fit_focal(rounded, ROUNDED)


# What errors do to the parameters


@pytest.mark.slow
@pytest.mark.parametrize("zoom", [None, pytest.param(zj.SmoothZoom(), marks=pytest.mark.slow)])
def test_response_is_that_of_fits_at_other_focal_lengths(sweep, zoom):
    model = zj.fit_zoom(sweep, zoom=zoom).lens.zoom
    response = eqx.filter_jit(_response)(sweep, model)
    for frame in (0, 7):

        def refit(t, frame=frame):
            moved = at_focal(sweep, sweep.focal.at[frame].multiply(np.exp(t)))
            return zj.fit_zoom(moved, zoom=model).lens.zoom.parameters.ravel()

        expected = (refit(1e-4) - refit(-1e-4)) / 2e-4
        np.testing.assert_allclose(response[:, frame], expected, atol=1e-4 * np.max(np.abs(expected)))


def test_a_sigma_beyond_all_numbers_makes_no_band_narrow(sweep):
    """Its square overflowed, and bands were NaN, which the verdict of the command took for 0."""
    fit, points = zj.fit_zoom(sweep), np.array([[0.0, 0.0], [700.0, 500.0]])
    wide = zj.fit.with_focal_sigma(fit, sweep, focal_sigma=1e30)
    for sigma in (1e155, 1e300):
        wider = zj.fit.with_focal_sigma(fit, sweep, focal_sigma=sigma)
        std = zj.displacement_std(wider, points, focal=30.0)
        assert (std > zj.displacement_std(wide, points, focal=30.0)).all()


def test_a_sigma_of_single_precision_is_read_beside_focal_lengths_of_double(sweep):
    """The bound for double precision overflowed where single held it, with NumPy's warning."""
    given = np.linspace(0.1, 0.9, 10, dtype=np.float32)
    sigma = checked_sigma(given, np.asarray(sweep.focal, np.float64))
    np.testing.assert_array_equal(sigma, given)


@pytest.mark.slow
def test_covariance_grows_by_the_response(sweep):
    fit = zj.fit_zoom(sweep)
    sigma = np.linspace(0.0, 0.9, 10)
    wide = zj.fit.with_focal_sigma(fit, sweep, focal_sigma=sigma)
    response = np.asarray(_response(sweep, fit.lens.zoom)) * (sigma / np.asarray(sweep.focal))
    more, whole = np.asarray(wide.covariance - fit.covariance), response @ response.T
    size = np.sqrt(np.diag(whole))  # what photos share already is not added again
    for matrix in (more, whole - more):
        assert np.linalg.eigvalsh(matrix / size / size[:, None]).min() > -1e-6
    assert np.trace(more / size / size[:, None]) > 0.9 * len(size)
    same = zj.fit.with_focal_sigma(fit, sweep, focal_sigma=0)
    np.testing.assert_allclose(same.covariance, fit.covariance, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("centre", ["image", "fit"])
def test_what_photos_err_by_is_counted_once(truth, centre):
    """The fit sees how photos scatter, and allows for it, but for all that it is told of only once."""
    focal = scenes.focal_sweep(12)
    scene = scenes.board_lines(truth, focal, spacing=150.0, noise=0.1, seed=1)
    off = np.random.default_rng(1).uniform(-0.5, 0.5, 12)
    lines = at_focal(zj.lines.compress_any_centre(scene), scene.focal + off)
    fit = zj.fit_zoom(lines, centre=centre)
    wide = zj.fit.with_focal_sigma(fit, lines, focal_sigma=ROUNDED)
    placed = lines.about(fit.lens.centre)
    alone, _ = parameter_covariance(placed, fit.lens.zoom, linearised(placed, fit.lens.zoom), photos=False)
    response = np.asarray(_response(placed, fit.lens.zoom)) * (ROUNDED / np.asarray(lines.focal))
    corner, at = np.zeros(2), np.array([21.0, 50.0, 120.0])

    def std(covariance):
        whole = eqx.tree_at(lambda fit: fit.covariance, fit, jnp.asarray(covariance))
        whole = eqx.tree_at(lambda fit: fit.joint, whole, None, is_leaf=lambda leaf: leaf is None)
        return np.asarray(zj.displacement_std(whole, corner, focal=at))

    expected = std(alone + response @ response.T)
    np.testing.assert_allclose(std(wide.covariance), expected, rtol=0.1 if centre == "image" else 0.4)
    twice = std(fit.covariance + response @ response.T)
    assert (std(wide.covariance) < 0.95 * twice).all()
    if wide.joint is not None:
        np.testing.assert_array_equal(wide.joint[:6, :6], wide.covariance)
        size = np.sqrt(np.diag(wide.joint))
        assert np.linalg.eigvalsh(np.asarray(wide.joint) / size / size[:, None]).min() > -1e-9


@pytest.mark.parametrize(
    ("focal", "shared", "expected"),
    [
        ([24.0, 35.0, 24.0, 50.0], None, [0, 1, 0, 3]),
        ([24.0, 35.0, 24.0, 50.0], [0, 1, 2, 1], [0, 1, 0, 1]),
        ([24.0, 35.0, 24.000001, 50.0], [5, 1, 5, 2], [0, 1, 0, 3]),
        ([24.0, 35.0, 24.0, 35.0, 50.0], [0, 1, 2, 2, 4], [0, 0, 0, 0, 4]),  # by way of others
        ([50.0, 35.0, 24.0], None, [0, 1, 2]),
    ],
)
def test_frames_of_one_focal_length_share_its_error(focal, shared, expected):
    found = of_equal_focal(np.array(focal), None if shared is None else np.array(shared))
    assert found.tolist() == expected


@pytest.mark.slow
def test_frames_that_share_an_error_add_up(sweep):
    fit = zj.fit_zoom(sweep)

    def more(**shared):
        wide = zj.fit.with_focal_sigma(fit, sweep, focal_sigma=0.3, **shared)
        return np.asarray(wide.covariance - fit.covariance)

    own = more()
    np.testing.assert_allclose(more(shared=np.arange(10)), own, rtol=1e-6, atol=1e-9 * own.max())
    response = np.asarray(_response(sweep, fit.lens.zoom)) * (0.3 / np.asarray(sweep.focal))
    one = response.sum(axis=1)  # all errors in step
    size = np.sqrt(np.diag(response @ response.T))
    excess = (
        np.outer(one, one) / size / size[:, None] - more(shared=np.zeros(10, int)) / size / size[:, None]
    )
    assert np.linalg.eigvalsh(excess).min() > -1e-6
    assert np.trace(excess) < 0.2 * np.sum((one / size) ** 2)
    with pytest.raises(ValueError, match="shared must hold a number for each of the 10 frames"):
        more(shared=np.arange(3))


@pytest.mark.parametrize("shared", [np.full(10, np.nan), np.ones(10, bool), np.full(10, "a"), ["a"] * 10])
def test_what_is_no_number_is_not_shared(sweep, shared, unchecked):
    """NaN is like nothing, itself included: such frames would be taken as exact."""
    with pytest.raises(ValueError, match="Argument shared must hold integers"):
        zj.fit.with_focal_sigma(zj.fit_zoom(sweep), sweep, focal_sigma=0.3, shared=shared)


def test_undetermined_stays_infinite(sweep):
    fit = zj.fit_zoom(sweep)
    own = fit.covariance[0, 0]
    unknown = eqx.tree_at(lambda fit: fit.covariance, fit, jnp.diag(jnp.full(6, jnp.inf).at[0].set(own)))
    wide = zj.fit.with_focal_sigma(unknown, sweep, focal_sigma=0.3).covariance
    assert np.isposinf(np.diag(wide)[1:]).all()
    assert wide[0, 0] > 1.01 * own
    assert (np.asarray(wide)[~np.eye(6, dtype=bool)] == 0).all()


# Focal lengths that are refined


@pytest.mark.slow
def test_refined_focal_lengths_are_nearer_to_the_truth(truth, sweep, rounded, refined):
    given, found = (np.asarray(f - sweep.focal) for f in (rounded.focal, refined.focal))
    assert np.sqrt(np.mean(found**2)) < 0.8 * np.sqrt(np.mean(given**2))
    assert (abs(found) < 3 * np.asarray(refined.std)).all()
    assert (refined.std < 1.01 * ROUNDED).all()
    assert refined.std.min() < 0.5 * ROUNDED
    corner = np.zeros(2)
    plain = zj.fit_zoom(rounded)
    for f in (30.0, 60.0, 110.0):
        errors = [
            np.linalg.norm(fit.lens(f).undistort(corner) - truth(f).undistort(corner))
            for fit in (refined.fit, plain)
        ]
        assert errors[0] < 0.7 * errors[1]
    assert refined.fit.rms < plain.rms


@pytest.mark.slow
def test_the_joint_minimum_is_one(rounded, refined):
    """No single focal length, moved either way, lowers the joint energy, with the model fitted again."""
    from zoomjax.fit.focal_refinement import _prior_weights

    at = at_focal(rounded, refined.focal)
    tau = np.asarray(_prior_weights(at, refined.fit.lens.zoom))

    def energy(focal):
        rms = zj.fit_zoom(at_focal(rounded, focal), zoom=refined.fit.lens.zoom).rms
        t = np.log(np.asarray(focal) / np.asarray(rounded.focal)) * np.asarray(rounded.focal) / ROUNDED
        return float(rms**2) + tau @ t**2

    least = energy(refined.focal)
    for frame in range(10):
        for moved in (-0.2, 0.2):
            assert energy(refined.focal.at[frame].add(moved * refined.std[frame])) > least


@pytest.mark.slow
def test_known_focal_lengths_stay(rounded):
    sigma = np.where(np.arange(10) % 3 == 0, 0.0, 0.3)
    found = zj.fit.fit_focal(rounded, sigma)
    np.testing.assert_array_equal(found.focal[::3], rounded.focal[::3])
    assert (found.std[::3] == 0).all()
    assert (found.focal != rounded.focal)[1::3].all()
    exact = zj.fit.fit_focal(rounded, 0.0)
    np.testing.assert_allclose(
        exact.fit.lens.zoom.parameters, zj.fit_zoom(rounded).lens.zoom.parameters, atol=1e-8
    )


def test_a_focal_length_that_nobody_knows_is_found(sweep):
    """Given 30 % too long, with the others known."""
    spoiled = at_focal(sweep, sweep.focal.at[2].multiply(1.3))
    found = zj.fit.fit_focal(spoiled, np.where(np.arange(10) == 2, np.inf, 0.0))
    assert abs(found.focal[2] - sweep.focal[2]) < 3 * found.std[2] < 1.0


def test_without_noise_rounding_is_undone_but_for_scale_and_shift(truth):
    """Of 1/f, which no line can tell apart; what is left of the errors is a straight line in 1/f."""
    clean = zj.compress(scenes.board_lines(truth, scenes.focal_sweep(10), spacing=150.0))
    found = zj.fit.fit_focal(at_focal(clean, np.round(clean.focal)), ROUNDED)
    u, off = 1 / np.asarray(clean.focal), np.asarray(1 / found.focal - 1 / clean.focal)
    left = off - np.polyval(np.polyfit(u, off, 1), u)
    given = 1 / np.round(np.asarray(clean.focal)) - u
    assert np.abs(left[:5]).max() < 0.02 * np.abs(given[:5]).max()


@pytest.mark.slow
def test_float32_bands_agree_and_refining_wants_float64(sweep):
    single = jax.tree.map(
        lambda a: a.astype(jnp.float32) if jnp.issubdtype(a.dtype, jnp.floating) else a, sweep
    )
    wide = zj.fit.with_focal_sigma(zj.fit_zoom(single), single, focal_sigma=0.3)
    assert wide.covariance.dtype == jnp.float32
    focal, corner = np.array([25.0, 60.0]), np.zeros(2)
    double = zj.fit.with_focal_sigma(zj.fit_zoom(sweep), sweep, focal_sigma=0.3)
    std = [zj.displacement_std(fit, corner, focal=focal) for fit in (wide, double)]
    np.testing.assert_allclose(std[0], std[1], rtol=0.02)
    with pytest.raises(ValueError, match=r"float64 only.*jax_enable_x64"):
        zj.fit.fit_focal(single, ROUNDED)


# Coverage


@pytest.mark.exhaustive
def test_bands_with_rounded_focal_lengths_hold_the_truth_as_often_as_they_say():
    """Taken as exact they hold it too rarely; the refined lens is better and its bands are true."""
    from benchmarks.trust import rounded_focal

    table = rounded_focal(100).data
    covered = {
        name: [float(cell.split(" ± ")[0]) for cell in row["covered"]] for name, row in table.items()
    }
    assert covered["rounded, taken as exact"][1] < 92 < covered["exact focal lengths"][1]
    assert covered["rounded, `fit_focal`"] == pytest.approx([68.3, 95], abs=10)
    assert covered["rounded, `with_focal_sigma`"] == pytest.approx([68.3, 95], abs=9)
    plain, refined = (np.array(table[name]["rms"]) for name in list(table)[1:4:2])
    assert (refined < 0.7 * plain).all()
    assert table["rounded, `fit_focal`"]["focal_rms"] < 0.8 * table["rounded, taken as exact"]["focal_rms"]


# What nothing determines


def weighing(lines, frames):
    return lines.weighted(np.isin(np.asarray(lines.frame), frames).astype(float))


def few(truth, number):
    return zj.compress(scenes.board_lines(truth, scenes.focal_sweep(number), spacing=300.0, noise=0.3))


@pytest.mark.parametrize(("sigma", "std"), [(0.3, 0.3), (0.0, 0.0), (np.inf, np.inf)])
def test_a_frame_whose_lines_weigh_nothing_keeps_its_focal_length_and_sigma(sweep, sigma, std):
    found = zj.fit.fit_focal(
        weighing(sweep, [0, 1, 2, 4, 5, 6, 7, 8, 9]), np.where(np.arange(10) == 3, sigma, 0.3)
    )
    assert found.std[3] == pytest.approx(std)
    assert found.focal[3] == pytest.approx(sweep.focal[3])
    assert (np.delete(np.asarray(found.std), 3) > 0.05).all()
    assert zj.RESULTS[found.fit.result] == ""


@pytest.mark.slow
def test_a_focal_length_of_no_effect_is_not_determined(sweep):
    sigma = np.where(np.arange(10) == 3, np.inf, 0.3)
    found = zj.fit.fit_focal(sweep, sigma, zoom=zj.PolynomialZoom(degree=0))
    np.testing.assert_allclose(found.std, sigma, rtol=1e-6)
    assert np.isfinite(found.fit.covariance).all()  # the lens is the same for all


@pytest.mark.slow
@pytest.mark.parametrize("number", [3, 4])
def test_a_focal_length_that_goes_with_any_lens_is_not_determined(truth, number):
    """With a model through every frame each focal length that is not known makes lines as straight."""
    lines = few(truth, number)
    sigma = np.where(np.arange(number) == 1, np.inf, 0.3)
    found = zj.fit.fit_focal(lines, sigma, zoom=zj.PolynomialZoom(degree=number - 1))
    assert np.isposinf(found.std).tolist() == (sigma == np.inf).tolist()
    assert zj.RESULTS[found.fit.result] == zj.RESULTS[zj.RESULTS.undetermined]
    assert np.isposinf(zj.displacement_std(found.fit, np.zeros(2), focal=float(lines.focal[1])))


def test_known_focal_lengths_of_frames_that_weigh_nothing_do_not_set_the_scale(sweep):
    sigma = np.where(np.isin(np.arange(10), [0, 5]), 0.3, np.inf)
    with pytest.raises(ValueError, match="lines that weigh something"):
        zj.fit.fit_focal(weighing(sweep, [0, 1, 2, 3]), sigma)


def test_focal_lengths_that_do_not_converge_are_said(rounded, refined, monkeypatch):
    whole = focal_fit.refined
    monkeypatch.setattr(
        focal_fit, "refined", lambda *given: (*whole(*given)[:3], jnp.asarray(False), whole(*given)[4])
    )
    with pytest.raises(RuntimeError, match="did not converge"):
        zj.fit.fit_focal(rounded, ROUNDED)
    found = zj.fit.fit_focal(rounded, ROUNDED, throw=False)
    np.testing.assert_allclose(found.focal, refined.focal)
    assert zj.RESULTS[found.fit.result] == zj.RESULTS[zj.RESULTS.nonlinear_max_steps_reached]


@pytest.mark.slow
def test_the_order_of_frames_and_the_unit_do_not_matter(rounded, refined):
    order = np.random.default_rng(0).permutation(10)
    place = np.argsort(order)
    turned = eqx.tree_at(
        lambda lines: (lines.focal, lines.frame),
        rounded,
        (10 * jnp.asarray(rounded.focal)[order], jnp.asarray(place[np.asarray(rounded.frame)])),
    )
    found = zj.fit.fit_focal(turned, 10 * ROUNDED)
    np.testing.assert_allclose(found.focal[place] / 10, refined.focal, rtol=1e-6)
    np.testing.assert_allclose(found.std[place] / 10, refined.std, rtol=1e-5)


# Errors


@pytest.mark.parametrize("sigma", [None, np.inf, np.nan, np.where(np.arange(10) == 3, 0.1, np.inf)])
def test_focal_lengths_that_nobody_knows_raise_and_say_why(rounded, sigma, unchecked):
    with pytest.raises(
        ValueError,
        match=r"(?s)focal_sigma.*Straight lines alone do not determine focal lengths.*EXIF.*board",
    ):
        zj.fit.fit_focal(rounded, sigma)
    with pytest.raises(
        ValueError, match=r"focal_sigma.*Straight lines alone do not determine focal lengths"
    ):
        zj.fit.with_focal_sigma(zj.fit_zoom(rounded), rounded, focal_sigma=sigma)


@pytest.mark.parametrize(
    ("sigma", "message"),
    [
        (-0.1, "at least 0"),
        (np.ones(3), "each of the 10 frames"),
        ("0.3", "real numbers"),
        (True, "real numbers"),
        (np.ones(10, bool), "real numbers"),
    ],
)
def test_sigma_that_is_none_raises(rounded, sigma, message, unchecked):
    with pytest.raises(ValueError, match=message):
        zj.fit.fit_focal(rounded, sigma)


@pytest.mark.slow
@pytest.mark.parametrize("moves", [0.0, 40.0])
def test_errors_of_f_are_those_of_a_lens_whose_centre_moves(moves):
    """Fits to focal lengths that are wrong scatter as is said, wherever the centre goes."""
    focal, size = scenes.focal_sweep(6), (1072, 712)
    lens = scenes.nikkor_18_200(size)
    way = np.array([[0.02, -0.01], [moves / float(lens.scale), 0.0]])
    shift = with_parameters(zj.PolynomialZoom(degree=1).prepare(focal, 2), way)
    lens = zj.ZoomLens(**vars(lens) | {"shift": shift})
    held = compress_any_centre(scenes.board_lines(lens, focal, spacing=12, noise=0.001).about(lens.centre))
    along, sigma = zj.PolynomialZoom(degree=1), 0.02 * focal
    exact = zj.fit.fit_centre(held, centre=along).fit
    wide = zj.fit.with_focal_sigma(exact, held, focal_sigma=sigma)
    points, at = np.array([[0.0, 0.0], [1071.0, 0.0], [1071.0, 711.0], [0.0, 711.0]]), (25.0, 40.0)
    told = np.stack([np.asarray(zj.displacement_std(wide, points, focal=f)) for f in at])
    rng, off = np.random.default_rng(0), []
    for _ in range(40):
        wrong = eqx.tree_at(lambda lines: lines.focal, held, rng.normal(focal, sigma))
        other = zj.fit.fit_centre(wrong, centre=along).fit.lens
        off.append([np.asarray(other(f).undistort(points) - exact.lens(f).undistort(points)) for f in at])
    scatter = np.sqrt((np.array(off) ** 2).sum(axis=-1).mean(axis=0))
    assert np.mean(scatter / told) == pytest.approx(1.08, abs=0.2)


# Focal lengths that are kept


def test_focal_lengths_that_do_not_help_others_are_kept(truth):
    """As uncertain as they differ, hardly anything holds them: they and the lens would go astray."""
    rng = np.random.default_rng(0)
    exact = np.linspace(50.0, 55.0, 20)
    lines = zj.compress(scenes.board_lines(truth, exact, spacing=150.0, noise=0.5))
    given = exact * np.exp(0.03 * rng.standard_normal(20))
    spoiled = at_focal(lines, given)
    found = zj.fit.fit_focal(spoiled, 0.03 * given)
    plain = zj.fit_zoom(spoiled)
    assert found.kept
    np.testing.assert_allclose(found.focal, given, rtol=1e-12)
    np.testing.assert_allclose(found.std, 0.03 * given)
    np.testing.assert_allclose(found.fit.lens.zoom.parameters, plain.lens.zoom.parameters, rtol=1e-4)
    corner = np.zeros(2)
    assert zj.displacement_std(found.fit, corner, focal=52.0) > zj.displacement_std(
        plain, corner, focal=52.0
    )


def test_focal_lengths_that_help_are_refined(rounded, refined):
    assert not refined.kept
    assert (refined.focal != rounded.focal).all()


def test_rounding_does_not_keep_focal_lengths(truth):
    """Without one of three frames the model goes through the other two, wherever their f is."""
    for seed in range(8):
        lines = zj.compress(
            scenes.board_lines(truth, scenes.focal_sweep(3), spacing=150.0, noise=0.1, seed=seed)
        )
        assert not zj.fit.fit_focal(lines, 0.5, zoom=zj.PolynomialZoom(1), terms=1, throw=False).kept


def test_one_that_nobody_knows_is_found_where_others_are_kept(truth):
    exact = np.linspace(50.0, 55.0, 20)
    lines = zj.compress(scenes.board_lines(truth, exact, spacing=150.0, noise=0.5))
    given = exact * np.exp(0.03 * np.random.default_rng(0).standard_normal(20))
    sigma = np.where(np.arange(20) == 4, np.inf, 0.03 * given)
    found = zj.fit.fit_focal(at_focal(lines, given), sigma, throw=False)
    assert found.kept
    others = np.arange(20) != 4
    np.testing.assert_allclose(found.focal[others], given[others], rtol=1e-12)
    assert found.focal[4] != given[4]
