"""Things that do not belong together are refused, not combined into nonsense."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes


@pytest.mark.parametrize("field", ["focal", "centre"])
def test_triangles_of_other_scenes_do_not_merge(small, field):
    other = eqx.tree_at(lambda lines: getattr(lines, field), small, getattr(small, field) + 1)
    with pytest.raises(ValueError, match="same lines"):
        zj.lines.merge(small, other)


def test_coefficients_must_be_those_of_all_frames(small):
    with pytest.raises(ValueError, match="a row for each of the 4 frames"):
        zj.frame_rms(small, jnp.zeros((3, 2)))


def test_a_lens_in_millimetres_is_not_asked_for_pixels(noisy, fit):
    pixels = zj.Lines.from_ragged(
        noisy.to_ragged(),
        noisy.frame,
        np.asarray(noisy.focal) * 180,
        image_size=noisy.image_size,
        focal_unit="px",
    )
    with pytest.raises(ValueError, match="in mm"):
        zj.frame_rms(pixels, fit.lens)


USES = {
    "residuals": lambda fit, lines: np.sum(np.asarray(zj.fit.residuals(lines, _by(fit, lines))) ** 2),
    "frame_energy": lambda fit, lines: zj.fit.frame_energy(lines, _by(fit, lines)),
    "global_energy": lambda fit, lines: zj.fit.global_energy(lines, _by(fit, lines)),
    "frame_rms": lambda fit, lines: zj.frame_rms(lines, fit.lens),
    "algebraic_zoom": lambda fit, lines: zj.fit.algebraic_zoom(lines).zoom.parameters,
    "algebraic_frames": lambda fit, lines: zj.fit.algebraic_frames(lines),
    "fit_zoom": lambda fit, lines: zj.fit_zoom(lines).lens.zoom.parameters,
    "in_image": lambda fit, lines: zj.fit_zoom(zj.fit.in_image(lines)).lens.zoom.parameters,
    "fit_frames": lambda fit, lines: zj.fit_frames(lines).coefficients,
    "fit_robust": lambda fit, lines: zj.fit_robust(lines).line_rms,
    "fit_robust, from a model": lambda fit, lines: zj.fit_robust(lines, zoom=fit.lens.zoom).line_rms,
    "fit_focal": lambda fit, lines: zj.fit.fit_focal(lines, 0.3).focal,
    "with_focal_sigma": lambda fit, lines: _std(zj.fit.with_focal_sigma(fit, lines, focal_sigma=0.3)),
    "with_misfit": lambda fit, lines: zj.trust.with_misfit(fit, lines).misfit,
    "suggest_next": lambda fit, lines: zj.suggest_next(fit, lines).table,
    "cross_validate_zoom": lambda fit, lines: zj.trust.cross_validate_zoom(lines),
    "cross_validate_frames": lambda fit, lines: zj.trust.cross_validate_frames(lines),
    "select_model": lambda fit, lines: zj.select_model(lines, [zj.PolynomialZoom()]).fit.rms,
}
"""What takes lines in any form."""


def _by(fit, lines):
    return jax.vmap(fit.lens.zoom)(jnp.asarray(lines.focal))


def _std(fit):
    return zj.displacement_std(fit, np.zeros(2), focal=50.0)


@pytest.fixture(scope="module")
def photos(truth):
    """Nine photos with noise, and their fit."""
    lines = scenes.board_lines(truth, scenes.focal_sweep(9), spacing=260.0, noise=0.3, seed=1)
    return lines, zj.fit_zoom(zj.compress(lines))


@pytest.mark.parametrize("use", USES.values(), ids=USES.keys())
def test_lines_for_any_centre_are_those_about_their_own(use, photos):
    lines, fit = photos
    expected, found = use(fit, zj.compress(lines)), use(fit, zj.lines.compress_any_centre(lines))
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-9)


def _other(lines, other):
    """The lines as those of another camera, or fewer frames of them."""
    points, frame, focal = lines.to_ragged(), np.asarray(lines.frame), np.asarray(lines.focal)
    size, unit = lines.image_size, "mm"
    if other == "frames":
        points, focal = [line for line, m in zip(points, frame, strict=True) if m < 8], focal[:8]
        frame = frame[frame < 8]
    elif other == "size":
        size = (size[0] + 800, size[1] + 600)
    else:
        unit = "px"
    return zj.Lines.from_ragged(points, frame, focal, image_size=size, focal_unit=unit)


OF_A_FIT = {
    "with_focal_sigma": lambda fit, lines: zj.fit.with_focal_sigma(fit, lines, focal_sigma=0.3),
    "with_misfit": zj.trust.with_misfit,
    "suggest_next": zj.suggest_next,
    "evidence": lambda fit, lines: zj.trust.evidence(lines, fit),
    "assess": lambda fit, lines: zj.trust.assess(lines, fit),
}
OF_A_LENS = {
    "frame_rms": lambda fit, lines: zj.frame_rms(lines, fit.lens),
    "cramer_rao": lambda fit, lines: zj.trust.cramer_rao(fit.lens, lines, std=0.3),
    "displacement_bound": lambda fit, lines: zj.trust.displacement_bound(fit.lens, lines, std=0.3),
}


@pytest.mark.parametrize(
    ("other", "message"), [("size", "size"), ("unit", "in mm"), ("frames", "9 frames.*are of 8")]
)
@pytest.mark.parametrize("use", [*OF_A_FIT, *OF_A_LENS])
def test_lines_of_another_camera_are_refused(use, other, message, photos):
    lines, fit = photos
    if use in OF_A_LENS and other == "frames":
        return  # a lens is for any lines
    with pytest.raises(ValueError, match=message):
        (OF_A_FIT | OF_A_LENS)[use](fit, _other(lines, other))


def test_evidence_takes_the_same_lines_compressed_however_and_no_others(photos):
    lines, fit = photos
    expected = zj.trust.evidence(lines, fit)
    found = zj.trust.evidence(lines, fit, compressed=zj.lines.compress_any_centre(lines))
    assert [half.parting for half in found.halves] == [half.parting for half in expected.halves]
    for half, other in zip(found.halves, expected.halves, strict=True):
        np.testing.assert_allclose(half.apart, other.apart, rtol=1e-4)
    for other in ("size", "frames"):
        with pytest.raises(ValueError, match="compressed must be the same lines"):
            zj.trust.evidence(lines, fit, compressed=zj.compress(_other(lines, other)))


def test_evidence_refuses_lines_compressed_with_other_weights_or_for_another_fit(photos):
    """Halves, rejected lines and the RMS without correction came from these, and all else from the fit."""
    lines, fit = photos
    weight = np.linspace(0, 1, len(lines.frame))
    weighted = lines.weighted(weight)
    centre = np.asarray(lines.centre)
    others = {
        "numbers of points or weights": (lines, zj.compress(weighted)),
        "points or weights": (weighted, zj.compress(lines)),
        "about the centre of distortion of the fit": (lines, zj.compress(lines.about(centre + 5))),
        "for the distortion model of the fit, RadialPolynomial, but they are for Division": (
            lines,
            zj.fit.compress_for(lines, zj.models.Division()),
        ),
    }
    for message, (given, compressed) in others.items():
        with pytest.raises(ValueError, match=message):
            zj.trust.evidence(given, fit, compressed=compressed)
    own, twice = (zj.trust.evidence(weighted, fit, compressed=of) for of in (None, zj.compress(weighted)))
    assert own.rejected == twice.rejected == 1


def test_lenses_scaled_to_other_images_are_not_asked_for_the_pixels_of_those():
    """Focal lengths in px stay those of the lens's first images: twice as long ones found another zoom."""
    zoom = zj.PolynomialZoom(1, jnp.array([[0.0], [0.05]]), jnp.array(400.0))
    lens = zj.ZoomLens(zoom, jnp.array([159.5, 119.5]), jnp.array([400.0, 1600.0]), (320, 240), "px")
    whole = zj.ZoomLens(zoom, jnp.array([319.5, 239.5]), jnp.array([400.0, 1600.0]), (640, 480), "px")
    with pytest.warns(UserWarning, match="distortion is scaled"):
        double = zj.models.lens_for_size(lens, (640, 480))
    lines = scenes.motion_lines(whole, np.array([500.0, 900.0]))
    calls = {
        "frame_rms": lambda: zj.frame_rms(lines, double),
        "cramer_rao": lambda: zj.trust.cramer_rao(double, lines, std=0.3),
        "displacement_bound": lambda: zj.trust.displacement_bound(double, lines, std=0.3),
        "vanishing_points": lambda: zj.trust.vanishing_points(lines, double),
    }
    for call in calls.values():
        with pytest.raises(ValueError, match=r"scaled by lens_for_size.* 320 px wide"):
            call()
    with pytest.raises(ValueError, match="px of the same images"):
        zj.trust.displacement_rms(whole, double)
    assert zj.trust.displacement_rms(double, double) == 0


@pytest.mark.parametrize("given", [(np.ones(3), np.ones(9)), (np.ones(9), None), (None, np.ones(9))])
def test_held_out_errors_are_one_a_frame_and_both(given, photos, unchecked):
    held_out, each = given
    with pytest.raises(ValueError, match="held_out"):
        zj.trust.assess(*photos, rms_held_out=held_out, rms_frames_held_out=each)


@pytest.mark.slow
def test_a_model_with_parameters_tells_the_number_of_coefficients(photos):
    lines, _ = photos
    small = zj.compress(lines, terms=3)
    model = zj.fit_zoom(small, terms=3).lens.zoom
    expected = zj.trust.cross_validate_zoom(small, terms=3)
    np.testing.assert_array_equal(zj.trust.cross_validate_zoom(small, zoom=model), expected)
    assert zj.fit.algebraic_zoom(small, zoom=model).zoom.parameters.shape == (3, 3)
    assert zj.fit.fit_centre(lines, zoom=model).fit.lens.zoom.parameters.shape == (3, 3)
    assert zj.select_model(small, [model]).chosen.terms == 3
    uses = (
        lambda: zj.trust.cross_validate_zoom(small, zoom=model, terms=2),
        lambda: zj.fit.algebraic_zoom(small, zoom=model, terms=2),
        lambda: zj.fit.fit_centre(lines, zoom=model, terms=2),
        lambda: zj.models.Model(model, 2),
    )
    for use in uses:
        with pytest.raises(ValueError, match="the parameters of zoom are for 3"):
            use()


# Several in one, as `jax.vmap` and ``jax.tree.map(jnp.stack)`` make


def two(one):
    return jax.tree.map(lambda leaf: jnp.stack([jnp.asarray(leaf)] * 2), one)


OF_TWO = {
    "compress": lambda lines, _: zj.compress(two(lines)),
    "fit_zoom": lambda lines, _: zj.fit_zoom(two(lines)),
    "fit_frames": lambda lines, _: zj.fit_frames(two(zj.compress(lines))),
    "select_model": lambda lines, _: zj.select_model(two(lines)),
    "many": lambda lines, _: zj.fit.many([lines, two(lines)]),
    "concatenate": lambda lines, _: zj.fit.concatenate([two(zj.compress(lines))]),
    "frame_rms": lambda lines, fit: zj.frame_rms(lines, two(fit.lens)),
    "certify": lambda _, fit: zj.models.certify(two(fit.lens)),
    "displacement_rms": lambda _, fit: zj.trust.displacement_rms(fit.lens, two(fit.lens)),
    "displacement_std": lambda _, fit: zj.displacement_std(two(fit), np.zeros((1, 2)), focal=30.0),
    "assess": lambda lines, fit: zj.trust.assess(lines, two(fit)),
    "vanishing_points": lambda lines, fit: zj.trust.vanishing_points(lines, two(fit.lens)),
    "write": lambda _, fit: zj.interop.write(two(fit.lens), "a.pfb", focal=30),
    "to_ragged": lambda lines, _: two(lines).to_ragged(),
}


@pytest.mark.parametrize("name", OF_TWO)
def test_several_in_one_are_refused_by_name(name, noisy, fit, unchecked, tmp_path, monkeypatch):
    """`to_ragged` took two sets of lines for two lines; others raised what JAX says of shapes."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=r"holds 2 of its kind in one: call the function by jax\.vmap"):
        OF_TWO[name](noisy, fit)


def test_several_in_one_under_vmap(small, fit):
    each = jax.vmap(lambda lines: zj.fit_zoom(lines, throw=False).rms)(two(small))
    np.testing.assert_allclose(each, np.repeat(np.asarray(zj.fit_zoom(small).rms), 2), rtol=1e-6)
    least = jax.vmap(lambda lens: zj.models.certify(lens).least)(two(fit.lens))
    np.testing.assert_allclose(least, np.repeat(np.asarray(fit.certificate.least), 2), rtol=1e-5)
