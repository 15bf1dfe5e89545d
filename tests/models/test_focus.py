"""Zoom and focus: the tensor product against its factors, and a lens that breathes."""

import json
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes

FOCAL = np.array([18.0, 24.0, 35.0, 70.0, 200.0])
FOCUS = np.array([0.0, 0.4, 1.0, 2.5])  # 1/m


@pytest.fixture(scope="module")
def model():
    focal, focus = (jnp.asarray(a.ravel()) for a in np.meshgrid(FOCAL, FOCUS))
    prepared = zj.models.FocusSplineZoom(4, 3).prepare(focal, 2, focus)
    random = np.random.default_rng(0).standard_normal(prepared.parameters.shape)
    return eqx.tree_at(lambda zoom: zoom.parameters, prepared, jnp.asarray(0.05 * random))


def breathing(focal, focus):
    """The paper's lens, its distortion a fifth larger when focused at a metre; quadratic in the focus."""
    lens = scenes.nikkor_18_200((640, 428))
    return lens.zoom(focal) * (1 + 0.15 * focus + 0.05 * focus**2)


@pytest.fixture(scope="module")
def seen():
    """Three focuses at each of five focal lengths, without noise, through the lens that breathes."""
    lens = scenes.nikkor_18_200((640, 428))
    focal, focus = (a.ravel() for a in np.meshgrid(scenes.focal_sweep(5), [0.0, 0.5, 1.0]))
    straight = scenes.board_lines(
        zj.ZoomLens(
            zj.PolynomialZoom(0, jnp.zeros((1, 2)), jnp.asarray(18.0)),
            lens.centre,
            lens.focal_range,
            lens.image_size,
        ),
        focal,
        spacing=40.0,
        noise=0,
    )
    k = jax.vmap(breathing)(jnp.asarray(focal), jnp.asarray(focus))[straight.frame]
    points = jax.vmap(
        lambda k, points: zj.Distortion(k, lens.centre, jnp.asarray(lens.scale)).distort(points)
    )(k, straight.points)
    lines = eqx.tree_at(lambda lines: lines.points, straight, points)
    return eqx.tree_at(lambda lines: lines.focus, lines, jnp.asarray(focus), is_leaf=lambda x: x is None)


def test_at_a_knot_of_the_focus_it_is_the_spline_of_its_row(model):
    for row, focus in enumerate(np.asarray(model.focus_knots)):
        table = model.parameters.reshape(4, 3, 2)[:, row]
        spline = zj.models.SplineZoom(4, table, model.knots, model.curvature)
        for f in (18.0, 30.0, 120.0):
            np.testing.assert_allclose(model(f, focus), spline(jnp.asarray(f)), rtol=1e-12)


def test_a_curvature_of_other_knots_is_refused(model, tmp_path):
    lens = zj.ZoomLens(model, [319.5, 239.5], [18.0, 200.0], (640, 480), focus_range=[0.0, 2.5])
    lens.save(tmp_path / "lens.json")
    content = json.loads((tmp_path / "lens.json").read_text())
    for name in ("knots", "focus_knots"):
        changed = json.loads(json.dumps(content))
        changed["zoom"][name][1] *= 1.02  # by hand
        (tmp_path / "lens.json").write_text(json.dumps(changed))
        with pytest.raises(ValueError, match="curvature must be that of the natural spline"):
            zj.load_lens(tmp_path / "lens.json")


def test_at_one_focus_it_is_a_spline_in_one_over_f(model):
    for focus in (-1.0, 0.0, 0.7, 9.0):
        for f in (15.0, 30.0, 250.0):
            np.testing.assert_allclose(model.at_focus(focus)(f), model(f, focus), rtol=1e-12)


def test_along_the_focus_it_is_the_natural_spline_of_scipy(model):
    from scipy.interpolate import CubicSpline

    knots = np.asarray(model.focus_knots)
    values = [model(30.0, d) for d in knots]
    spline = CubicSpline(knots, values, bc_type="natural")
    for focus in (0.1, 0.5, 1.7):
        np.testing.assert_allclose(model(30.0, focus), spline(focus), rtol=1e-10)


def test_beyond_the_ends_of_the_focus_it_is_constant(model):
    np.testing.assert_array_equal(model(30.0, -5.0), model(30.0, model.focus_knots[0]))
    np.testing.assert_array_equal(model(30.0, 99.0), model(30.0, model.focus_knots[-1]))


def test_pieces_bound_the_coefficients(model):
    pieces = model.pieces(jnp.array([18.0, 200.0]))
    f, d = np.meshgrid(1 / np.linspace(1 / 18, 1 / 200, 40), np.linspace(0, 2.5, 40))
    k = np.asarray(jax.vmap(model)(jnp.asarray(f.ravel()), jnp.asarray(d.ravel())))
    low, high = np.asarray(pieces.controls).min((0, 1)), np.asarray(pieces.controls).max((0, 1))
    assert (k >= low - 1e-12).all()
    assert (k <= high + 1e-12).all()
    assert (np.ptp(k, axis=0) > 0.8 * (high - low)).all()


@pytest.mark.slow
def test_a_lens_that_breathes_is_recovered(seen):
    small = zj.compress(seen)
    fit = zj.fit_zoom(small, zoom=zj.models.FocusSplineZoom(5, 3))
    blind = zj.fit_zoom(small)
    assert fit.rms < 0.002
    assert fit.rms < 0.05 * blind.rms
    assert bool(fit.certificate.certified)
    for f, d in ((20.6, 0.0), (40.0, 0.5), (127.0, 1.0)):
        lens = scenes.nikkor_18_200((640, 428))
        truth = zj.Distortion(breathing(f, d), lens.centre, jnp.asarray(lens.scale))
        found = fit.lens(f, d).undistort(np.zeros(2))
        np.testing.assert_allclose(found, truth.undistort(np.zeros(2)), atol=0.05)
        np.testing.assert_allclose(fit.lens.at_focus(d)(f).undistort(np.zeros(2)), found, atol=1e-9)
    np.testing.assert_allclose(zj.frame_rms(small, fit.lens), fit.frame_rms, atol=1e-9)


@pytest.mark.slow
def test_points_and_triangles_give_one_answer(seen):
    full, small = (
        zj.fit_zoom(lines, zoom=zj.models.FocusSplineZoom(2, 2)) for lines in (seen, zj.compress(seen))
    )
    np.testing.assert_allclose(full.lens.zoom.parameters, small.lens.zoom.parameters, atol=1e-8)


@pytest.mark.slow
def test_models_of_the_focal_length_alone_ignore_the_focus(seen):
    without = eqx.tree_at(lambda lines: lines.focus, seen, None)
    with_it, plain = (zj.fit_zoom(zj.compress(lines)) for lines in (seen, without))
    np.testing.assert_array_equal(with_it.lens.zoom.parameters, plain.lens.zoom.parameters)


@pytest.mark.slow
def test_robust_fits_and_frames_and_centres_keep_the_focus(seen):
    small = zj.compress(seen)
    noisy = zj.compress(scenes.with_noise(seen, jax.random.key(0), std=0.1))
    robust = zj.fit_robust(noisy, zoom=zj.models.FocusSplineZoom(5, 3))
    assert robust.rejected.size < 0.01 * len(seen.frame)
    assert zj.fit_frames(small).rms < 1e-6
    assert zj.lines.compress_any_centre(seen).about(seen.centre).focus is seen.focus
    assert zj.fit.in_image(small).focus is small.focus


@pytest.mark.slow
def test_files_keep_the_focus(seen, tmp_path):
    seen.save(tmp_path / "lines.npz")
    np.testing.assert_array_equal(zj.load_lines(tmp_path / "lines.npz").focus, seen.focus)
    lens = zj.fit_zoom(zj.compress(seen), zoom=zj.models.FocusSplineZoom(2, 2)).lens
    lens.save(tmp_path / "lens.json")
    loaded = zj.load_lens(tmp_path / "lens.json")
    for one, other in zip(jax.tree.leaves(loaded), jax.tree.leaves(lens), strict=True):
        np.testing.assert_array_equal(one, other)
    assert json.loads((tmp_path / "lens.json").read_text())["focus_range"] == [0.0, 1.0]


@pytest.mark.slow
def test_a_focus_beyond_those_fitted_is_told(model):
    """As a distance where lines had its inverse; so is a focal length beyond."""
    lens = zj.ZoomLens(
        model,
        np.array([319.5, 213.5]),
        np.array([18.0, 200.0]),
        (640, 428),
        focus_range=np.array([0.0, 2.5]),
    )
    points = np.full((3, 2), 100.0)
    told = "The focus 4 is not within the range on which the lens was fitted, 0 to 2.5"
    for call in (
        lambda focus: lens(35.0, focus).coefficients,
        lambda focus: lens([35.0, 50.0], [1.0, focus]).coefficients,
        lambda focus: lens.at_focus(focus)(35.0).coefficients,
        lambda focus: lens.undistort(points, 35.0, focus),
        lambda focus: lens.distort(points, 35.0, [0.0, 2.5, focus]),
    ):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert np.isfinite(call(2.5)).all()
        with pytest.warns(UserWarning, match=told) as caught:
            call(4.0)
        assert [warning.filename for warning in caught] == [__file__]
        with pytest.raises(ValueError, match="Argument focus must be finite"):
            call(np.nan)
    assert np.isfinite(jax.jit(lambda focus: lens(35.0, focus).coefficients)(4.0)).all()


def test_a_missing_focus_says_what_to_do(small, seen, model, truth):
    with pytest.raises(ValueError, match="needs the focus of each frame"):
        zj.fit_zoom(small, zoom=zj.models.FocusSplineZoom())
    with pytest.raises(ValueError, match=r"lens\.at_focus"):
        zj.fit_zoom(zj.compress(seen), zoom=zj.models.FocusSplineZoom(2, 2)).lens(30.0)
    with pytest.raises(ValueError, match="smaller focus_number"):
        zj.fit_zoom(seen, zoom=zj.models.FocusSplineZoom(3, 4))
    with pytest.raises(TypeError, match="does not depend on the focus"):
        truth.at_focus(1.0)
    row = np.stack([np.arange(9.0), np.full(9, 2.0)], axis=-1)
    for bad in ([1.0, 2.0], [np.nan]):
        with pytest.raises(ValueError, match="Argument focus"):
            zj.Lines.from_ragged([row], [0], [20], image_size=(10, 4), focus=bad)
    lines = zj.Lines.from_ragged([row], [0], [20], image_size=(10, 4), focus=[0.5])
    assert lines.focus.tolist() == [0.5]


@pytest.mark.parametrize("focus", [[0.2, 0.9], np.array([0.2, 0.9]), jnp.array([0.2])], ids=str)
def test_several_focuses_are_not_added_up(model, focus, unchecked):
    """The coefficients at all of them, summed, were given as those at one."""
    lens = zj.ZoomLens(model, jnp.zeros(2), jnp.array([18.0, 200.0]), (640, 428), focus_range=[0.0, 2.5])
    for ask in (
        model.at_focus,
        lens.at_focus,
        lambda focus: model(35.0, focus),
        lambda focus: model.basis(35.0, focus),
    ):
        with pytest.raises(ValueError, match="focus must be one number here"):
            ask(focus)
    each = jax.vmap(lambda focus: model(35.0, focus))(jnp.asarray(focus))
    np.testing.assert_allclose(each[0], model(35.0, 0.2))
    np.testing.assert_allclose(lens(35.0, focus).coefficients, each)


@pytest.mark.parametrize("focus", ["near", True, [0.2, None]], ids=str)
def test_a_focus_that_is_no_number_is_refused(model, focus, unchecked):
    lens = zj.ZoomLens(model, jnp.zeros(2), jnp.array([18.0, 200.0]), (640, 428), focus_range=[0.0, 2.5])
    with pytest.raises(ValueError, match="Argument focus must be"):
        lens(35.0, focus)


def test_focuses_are_as_many_as_focal_lengths_and_points(model):
    lens = zj.ZoomLens(model, jnp.zeros(2), jnp.array([18.0, 200.0]), (640, 428), focus_range=[0.0, 2.5])
    with pytest.raises(ValueError, match=r"Argument focus must have .* are \(2,\) and \(3,\)"):
        lens([20.0, 30.0, 40.0], [0.0, 1.0])
    with pytest.raises(ValueError, match=r"with that of focus is \(2,\)"):
        lens.undistort(np.zeros((3, 2)), 20.0, [0.0, 1.0])
    points = np.array([[1.0, 2.0], [300.0, 20.0]])
    found = lens.undistort(points, 20.0, [0.0, 1.0])
    for point, focus, one in zip(points, [0.0, 1.0], found, strict=True):
        np.testing.assert_allclose(one, lens.undistort(point, 20.0, focus))
