"""Arguments of another kind, near to what is wanted: a sentence says what to pass."""

import inspect

import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import zoomjax as zj
from zoomjax._core.arguments import _kinds

from .._public import FUNCTIONS, PUBLIC

pytestmark = pytest.mark.usefixtures("unchecked")

INSTANCE = "pass an instance"


@pytest.fixture(scope="module")
def things(noisy, small, fit, frame_fits, truth):
    return {"lines": noisy, "small": small, "fit": fit, "each": frame_fits, "lens": truth, "d": truth(35.0)}


MISTAKES = {
    "the class of a distortion model": (
        "fit_zoom(small, distortion_model=zj.models.Division)",
        f"distortion_model .* Division: {INSTANCE}",
    ),
    "in fit_frames": (
        "fit_frames(small, distortion_model=zj.models.Division)",
        f"class Division: {INSTANCE}",
    ),
    "in fit_robust": (
        "fit_robust(small, distortion_model=zj.models.Division)",
        f"class Division: {INSTANCE}",
    ),
    "in with_distortion_model": (
        "with_distortion_model(small, zj.models.Division)",
        f"class Division: {INSTANCE}",
    ),
    "in compress_for": ("compress_for(lines, zj.models.Division)", f"class Division: {INSTANCE}"),
    "in cross_validate_zoom": (
        "cross_validate_zoom(small, zoom=zj.models.TableZoom)",
        f"class TableZoom: {INSTANCE}",
    ),
    "the class of a model": (
        "fit_zoom(small, zoom=zj.PolynomialZoom)",
        f"class Poly.*: {INSTANCE}",
    ),
    "a degree for a model": ("fit_zoom(small, zoom=2)", r"type is int: PolynomialZoom\(degree=...\)"),
    "a lens for a model": (
        "fit_zoom(small, zoom=lens)",
        r"pass its zoom model, lens\.zoom",
    ),
    "a fit for a model": ("fit_robust(small, zoom=fit)", r"type is ZoomFit: .*fit\.lens\.zoom"),
    "algebraic": (
        "algebraic_zoom(small, zoom=zj.models.PowerZoom())",
        "linear in its .* is PowerZoom",
    ),
    "the class of a solver": (
        "fit_zoom(small, solver=optx.LevenbergMarquardt)",
        f"solver must be an optimistix solver .* class LevenbergMarquardt: {INSTANCE}",
    ),
    "a solver by name": ("fit_frames(small, solver='LM')", "solver must be an optimistix solver"),
    "arrays for lines": ("fit_zoom([np.zeros((3, 2))])", r"type is list: Lines\.from_ragged"),
    "a path for lines": ("fit_zoom('lines.npz')", r"type is str: load_lines\(path\) reads a file"),
    "the class of lines": ("fit_zoom(zj.Lines)", "it is the class Lines"),
    "a lens for lines": ("frame_rms(lens, None)", "lines must be Lines .* type is ZoomLens"),
    "a path for a lens": ("certify('lens.json')", r"load_lens\(path\) reads a file"),
    "a fit for a lens": ("certify(fit)", r"type is ZoomFit: pass its lens, fit\.lens"),
    "a distortion for a lens": ("certify(d)", "one focal length's; pass the lens that it came from"),
    "a fit to be scaled": ("lens_for_size(fit, (640, 480))", r"pass its lens, fit\.lens"),
    "two fits": ("displacement_rms(fit, fit)", r"pass its lens, fit\.lens"),
    "a lens for a path": ("load_lens(lens)", "path must be a path.*it is loaded already"),
    "a number for a path": ("load_lens(3)", "path must be a path, but its type is int"),
    "lines for a path": ("load_lines(lines)", "they are loaded already"),
    "no path to save to": ("ZoomLens.save(lens, None)", "path must be a path"),
    "nor for lines": ("Lines.save(lines, 3)", "path must be a path"),
    "a lens for a fit, std": (
        "displacement_std(lens, [0.0, 0.0], focal=35.0)",
        "a lens alone has no covariance",
    ),
    "a lens for a fit, band": ("displacement_band(lens, [0.0, 0.0], focal=35.0)", "no covariance"),
    "for a fit, covariance": (
        "displacement_covariance(lens, [0.0, 0.0], focal=3.0)",
        "no covariance",
    ),
    "a lens for a fit, k": ("coefficient_std(lens, 35.0)", "no covariance"),
    "a lens for a fit, any": ("std_of(lens, lambda lens: lens(35.0))", "no covariance"),
    "frames for a fit": ("coefficient_std(each, 35.0)", r"fit_zoom\(lines\) fits all together"),
    "compressed again": ("compress(small)", "compressed already; pass the Lines"),
    "compressed for centres": ("compress_any_centre(small)", "compressed already; pass the Lines"),
    "uncompressed to merge": ("merge(lines, lines)", r"pass compress\(lines\)"),
    "in_image of a lens": ("in_image(lens)", "lines must be Lines"),
    "a lens to choose": ("select_model(lens)", "lines must be Lines"),
    "focal lengths of a lens": ("fit_focal(lens, focal_sigma=0.1)", "lines must be Lines"),
    "sigma of a lens": ("with_focal_sigma(lens, small, focal_sigma=0.1)", "no covariance"),
    "energy of a lens": ("global_energy(lens, np.zeros((4, 2)))", "lines must be Lines"),
    "a fit called": ("ZoomFit.__call__(fit, 35.0)", r"A ZoomFit is not a lens: use fit\.lens"),
    "fits called": ("FrameFits.__call__(each, 35.0)", r"each\.distortion\(frame\)"),
    "lines in bulk": ("concatenate(lines)", r"parts must be a list of lines, \[first, second\]"),
}


@pytest.mark.slow
@pytest.mark.parametrize(("call", "message"), MISTAKES.values(), ids=MISTAKES)
def test_a_sentence_says_what_to_pass(call, message, things):
    with pytest.raises(TypeError, match=message):
        eval(call, FUNCTIONS | {"zj": zj, "np": np, "optx": optx} | things)


MASKED = {
    "points, as many as JAX would not look at": "displacement_std(fit, big, focal=35.0)",
    "points": "displacement_band(fit, hidden, focal=35.0)",
    "focal lengths": "coefficient_std(fit, hidden)",
    "coefficients": "frame_energy(small, hidden)",
    "of each frame": "frame_rms(small, hidden)",
    "of all": "global_energy(small, hidden)",
    "sigma": "with_focal_sigma(fit, small, focal_sigma=hidden)",
    "shared": "with_focal_sigma(fit, small, focal_sigma=0.3, shared=hidden)",
    "sigma of a fit": "fit_focal(small, hidden)",
    "std": "cramer_rao(lens, lines, std=hidden)",
    "errors": "assess(lines, fit, rms_held_out=hidden, rms_frames_held_out=hidden)",
    "a centre": "fit_zoom(lines, centre=hidden)",
    "focal lengths to write": "write(lens, 'never.jsonl', format='opentrackio', focal=hidden)",
}


@pytest.mark.slow
@pytest.mark.parametrize("call", MASKED.values(), ids=MASKED)
def test_a_mask_is_not_lost(call, things):
    hidden = np.ma.masked_array([20.0, 30.0], [False, True])
    big = np.ma.masked_array(np.zeros((9, 2)), True)
    with pytest.raises(ValueError, match="is a masked array, and masks are not kept"):
        eval(call, FUNCTIONS | {"np": np, "hidden": hidden, "big": big} | things)


def test_all_fits_that_are_called_name_their_lens(small, noisy):
    robust = zj.fit_robust(small)
    with pytest.raises(TypeError, match=r"robust\.fit\.lens\(35\.0\)"):
        robust(35.0)
    with pytest.raises(TypeError, match=r"type is RobustFit: pass its fit, robust\.fit"):
        zj.trust.coefficient_std(robust, 35.0)
    for kind in (zj.fit.CentreFit, zj.fit.FocalFit, zj.fit.FrameCentres):
        with pytest.raises(TypeError, match="not a lens: use found"):
            kind.__call__(None, 35.0)


def test_public_functions_that_take_our_things_look_at_them():
    """Those of images, which take arrays besides, look for themselves."""
    others = {"warp_image", "undistort_image", "undistort_photo", "undistort_video", "frame_output"}
    for name, function in FUNCTIONS.items():
        if name in others:
            continue
        if inspect.isclass(function) or not callable(function):
            continue
        wanted = [p.name for p in inspect.signature(function).parameters.values() if _kinds(p.annotation)]
        inner = getattr(function, "__wrapped__", None)
        if wanted and name not in {"read_focal_track", "read_lines_csv", "read_focal_csv"}:
            assert inner is not None, f"{name} takes {wanted} and is not kinds_checked"


def test_lists_are_points_and_focal_lengths(fit):
    expected = zj.displacement_std(fit, jnp.array([0.0, 0.0]), focal=jnp.array([30.0, 50.0]))
    np.testing.assert_allclose(
        zj.displacement_std(fit, [0.0, 0.0], focal=[30.0, 50.0]), expected, rtol=1e-12
    )


def _flags():
    """Public functions and methods with truth values among their arguments, and the names of these."""
    for name, thing in PUBLIC.items():
        of_class = inspect.getmembers(thing, callable) if inspect.isclass(thing) else ()
        # What writes into folders is looked at by `results_folder`.
        members = [
            (f"{name}.{own}", method) for own, method in of_class if own[0] != "_" and own != "write"
        ]
        for label, function in members if inspect.isclass(thing) else [(name, thing)]:
            if not getattr(function, "__module__", "").startswith("zoomjax"):
                continue
            for flag, parameter in inspect.signature(function).parameters.items():
                if parameter.annotation is bool or isinstance(parameter.default, bool):
                    yield pytest.param(function, flag, id=f"{label} {flag}")


@pytest.mark.parametrize(("function", "flag"), [*_flags()])
@pytest.mark.parametrize("value", ["no", None, 0])
def test_truth_values_are_no_words(function, flag, value):
    """Any word is true: overwrite="no" replaced files."""
    with pytest.raises(TypeError, match=f"Argument {flag} must be True or False, but it is {value!r}"):
        function(**{flag: value})


def test_flags_are_found():
    assert len([*_flags()]) > 20


def test_truth_values_of_numpy_are_true_or_false(small):
    assert zj.fit_zoom(small, invertible=np.True_, throw=np.bool_(False)).result is not None
