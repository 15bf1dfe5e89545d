"""Calibrations as a whole: their figures, their folder, and the real zoom camera."""

import dataclasses
import json
import warnings
from types import SimpleNamespace

import equinox as eqx
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes
from zoomjax.app.calibrating import calibrate
from zoomjax.app.calibration import Calibration, rms_over_frames
from zoomjax.app.coverage import _residuals
from zoomjax.app.focal_sources import focal_sigmas
from zoomjax.app.model_choice import WantedModel
from zoomjax.app.report import report
from zoomjax.fit.image_metric import in_corrected, in_image

_TRUTH = scenes.nikkor_18_200()
UNDISTORTED = eqx.tree_at(
    lambda lens: lens.zoom.parameters, _TRUTH, 1e-9 * np.asarray(_TRUTH.zoom.parameters)
)
GIVEN = {"model": WantedModel("polynomial"), "centre": None}  # degree 2 about the centre of the lines


@pytest.fixture(scope="module")
def calibration():
    lines = scenes.board_lines(scenes.nikkor_18_200(), scenes.focal_sweep(5), spacing=60, noise=0.4)
    return calibrate(lines, **GIVEN)


def test_what_weights_of_lines_do_to_the_rms_is_said(calibration):
    assert calibration.weighting == ""
    summary, rms = calibration.summary(), float(calibration.fit.rms)
    assert summary["rms_zoom_equal_weights"] == pytest.approx(rms, rel=1e-6)
    weight = np.ones(len(calibration.lines.frame))
    weight[::3], weight[1] = 0.05, 0  # as of lines that a robust fit trusts little, and of one rejected
    lines = calibration.lines.weighted(weight)
    points = np.array(lines.points)
    points[::3] += np.random.default_rng(0).normal(0, 3, points[::3].shape)
    found = calibrate(dataclasses.replace(lines, points=points), **GIVEN)
    squares = [
        np.mean(found.line_rms[(np.asarray(lines.frame) == frame) & (weight > 0)] ** 2)
        for frame in range(5)
    ]
    equal = float(np.sqrt(np.mean(squares)))
    assert equal > 1.5 * float(found.fit.rms)
    assert found.summary()["rms_zoom_equal_weights"] == pytest.approx(equal)
    told = f"weighed the same, that of the zoom polynomial would be {equal:.4f} px."
    assert found.weighting.endswith(told)
    assert told in report(found)


@pytest.mark.slow
def test_stages_are_told(calibration):
    told = []
    calibrate(calibration.lines, **GIVEN, stage=told.append)
    assert len(told) == 4


@pytest.mark.slow
@pytest.mark.parametrize("metric", [in_image, in_corrected])
def test_distances_are_measured_where_the_metric_says(calibration, metric):
    """By default in the distorted image; both are the fits that the library makes."""
    found = calibration if metric is in_image else calibrate(calibration.lines, **GIVEN, metric=metric)
    expected = zj.fit_zoom(metric(zj.compress(calibration.lines)))
    np.testing.assert_allclose(found.fit.frame_rms, expected.frame_rms, rtol=1e-9)
    focal = np.asarray(calibration.lines.focal)
    k, truly = (
        np.stack([np.asarray(fit.lens(f).coefficients) for f in focal]) for fit in (found.fit, expected)
    )
    np.testing.assert_allclose(k, truly, rtol=1e-6)
    assert found.summary()["distances"] == f"{'distorted' if metric is in_image else 'corrected'} image"
    assert f"px of the {found.summary()['distances']}." in report(found)


def test_residuals_over_the_radius_are_those_of_the_fit(calibration):
    """The plot's residuals are divided by the stretch of each point, the fit's by that of each line."""
    radius, residual = _residuals(
        calibration.lines, calibration.fit.lens, np.arange(len(calibration.lines.frame))
    )
    frame = np.broadcast_to(np.asarray(calibration.lines.frame)[:, None], calibration.lines.mask.shape)
    frame = frame[np.asarray(calibration.lines.mask)]
    squares = np.bincount(frame, residual**2) / np.bincount(frame)
    np.testing.assert_allclose(np.sqrt(squares), calibration.fit.frame_rms, rtol=0.02)
    corrected = zj.frame_rms(calibration.lines, calibration.fit.lens)
    assert abs(corrected[0] / calibration.fit.frame_rms[0] - 1) > 0.04
    assert radius.shape == residual.shape


def test_pixel_polynomials_give_the_coefficients_of_the_lens(calibration):
    polynomials = calibration.pixel_polynomials()
    for f in (20.56, 50.0, 127.0):
        expected = calibration.fit.lens(f).pixel_coefficients
        np.testing.assert_allclose(f ** -np.arange(3.0) @ polynomials, expected, rtol=1e-9)


def test_summary_is_json_and_agrees_with_the_fits(calibration):
    summary = json.loads(json.dumps(calibration.summary(), allow_nan=False))
    assert summary["rms_zoom"] == float(calibration.fit.rms)
    assert summary["certificate"]["certified"] is True
    assert summary["rms_none"] == pytest.approx(rms_over_frames(zj.frame_rms(calibration.lines, None)))
    assert [row["frame"] for row in summary["per_frame"]] == list(range(5))
    assert summary["rms_zoom"] < summary["rms_held_out"] < 1.1 * summary["rms_zoom"]
    assert summary["rms_frames"] < summary["rms_frames_held_out"]
    held_out = [row["rms_held_out"] for row in summary["per_frame"]]
    assert rms_over_frames(np.array(held_out)) == summary["rms_held_out"]
    assert "selection" not in summary


@pytest.mark.slow
def test_by_default_model_and_centre_are_chosen():
    """Seen through degree 2, about a centre beside the image's."""
    truth = scenes.nikkor_18_200()
    middle = np.asarray(truth.centre)
    aside = eqx.tree_at(lambda lens: lens.centre, truth, truth.centre + np.array([20.0, -12.0]))
    lines = scenes.board_lines(aside, scenes.focal_sweep(8), spacing=90, noise=0.3)
    lines = eqx.tree_at(lambda lines: lines.centre, lines, middle)
    found = calibrate(lines)
    summary = json.loads(json.dumps(found.summary(), allow_nan=False))
    assert summary["centre"]["how"] == "fitted"
    centre, std = np.array([summary["centre"][axis] for axis in "xy"]), np.array(summary["centre"]["std"])
    assert (abs(centre - np.asarray(aside.centre)) < 4 * std).all()
    assert (std < 10).all()
    np.testing.assert_allclose(np.asarray(found.fit.lens.centre), centre)
    chosen = summary["selection"]["chosen"]
    by_name = {row["candidate"]: row for row in summary["selection"]["candidates"]}
    assert by_name[chosen]["held_out"] <= 1.0005 * min(
        row["held_out"] for row in by_name.values() if not row["problem"]
    )
    fewer = [row for row in by_name.values() if row["parameters"] < by_name[chosen]["parameters"]]
    assert all(row["problem"] or row["held_out"] > 1.0005 * by_name[chosen]["held_out"] for row in fewer)
    assert found.fit.joint is not None
    page = report(found)
    assert "The centre of distortion was fitted: " in page
    assert found.own_centres is not None
    off = np.nanmedian(found.own_centres.centre, axis=0) - centre
    assert (abs(off) < 10).all()
    assert "Centre of distortion of single frames, and of the lens" in page
    assert all(f">{name}<" in page for name in by_name)
    own = np.asarray(zj.trust.displacement_std(found.fit, middle, focal=50.0))
    alone = eqx.tree_at(lambda fit: fit.joint, found.fit, None)
    assert own > 2 * np.asarray(zj.trust.displacement_std(alone, middle, focal=50.0))


@pytest.mark.slow
@pytest.mark.parametrize("centre", ["image", (300.0, 200.0), None])
def test_a_centre_that_is_given_is_taken(centre, calibration):
    lines = calibration.lines.about(np.array([1000.0, 700.0]))
    found = calibrate(lines, model=WantedModel(degree=1), centre=centre)
    expected = {"image": calibration.lines.centre, None: lines.centre}.get(centre, centre)
    np.testing.assert_allclose(found.fit.lens.centre, expected)
    np.testing.assert_allclose(found.lines.centre, expected)
    assert found.centre.how == ("image" if centre == "image" else "given")
    assert found.fit.joint is None


@pytest.mark.slow
def test_bands_about_a_given_centre_say_that_another_is_better():
    aside = eqx.tree_at(lambda lens: lens.centre, _TRUTH, _TRUTH.centre + np.array([60.0, -40.0]))
    focal = scenes.focal_sweep(8)
    seen = scenes.board_lines(aside, focal, spacing=200, noise=0.3)
    found = calibrate(seen, model=WantedModel(degree=2), centre="image").fit
    off = np.asarray(found.lens(focal[0]).undistort(np.zeros(2)) - aside(focal[0]).undistort(np.zeros(2)))
    std = float(zj.displacement_std(found, np.zeros(2), focal=focal[0]))
    alone = eqx.tree_at(lambda fit: fit.off_centre, found, None)
    before = float(zj.displacement_std(alone, np.zeros(2), focal=focal[0]))
    assert 3 * before < np.linalg.norm(off) < 2 * std


@pytest.mark.slow
def test_the_centre_stays_where_lines_do_not_determine_it():
    """Nothing is distorted, and lines left out by hand stay so."""
    lines = scenes.board_lines(UNDISTORTED, scenes.focal_sweep(4), spacing=150, noise=0.3)
    lines = lines.weighted((np.arange(len(lines.frame)) > 1).astype(float))
    found = calibrate(lines, model=WantedModel(degree=0, terms=1))
    assert found.centre.how == "image"
    assert "was kept at the middle of the image" in found.centre.sentence
    np.testing.assert_array_equal(found.fit.lens.centre, lines.centre)
    assert np.flatnonzero(found.rejected).tolist() == [0, 1]


@pytest.mark.slow
def test_one_photo_works_out_of_the_box():
    lines = scenes.board_lines(scenes.nikkor_18_200(), scenes.focal_sweep(2)[:1], spacing=60, noise=0.3)
    found = calibrate(lines)
    assert found.fit.lens.zoom.degree == 0
    assert found.fit.rms < 0.35
    assert ">nan<" not in report(found)
    assert "Centre of distortion of single frames" not in report(found)


@pytest.mark.slow
def test_lines_that_determine_nothing_are_reported(calibration):
    t = np.linspace(-200, 200, 50)
    radial = [np.stack([319.5 + t * c, 239.5 + t * s], -1) for c, s in ((1, 0), (0, 1), (0.6, 0.8))]
    lines = zj.Lines.from_ragged(radial * 3, np.repeat([0, 1, 2], 3), [20, 40, 80], image_size=(640, 480))
    summary = json.loads(json.dumps(calibrate(lines, **GIVEN).summary(), allow_nan=False))
    assert "do not determine" in summary["result"]
    assert summary["frames_without_a_model"] == 3
    assert summary["rms_held_out"] is None  # two focal lengths do not make a quadratic
    assert None in summary["parameter_sigma"]
    assert summary["warnings"][0] == summary["result"]
    assert summary["warnings"][1].startswith("3 of 3 frames have no good separate fit (frames 0, 1, 2)")


def test_results_are_written_together_or_not_at_all(calibration, tmp_path, monkeypatch):
    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr("zoomjax.app.plot.plot_model", fail)  # the last of the four files
    with pytest.raises(OSError, match="disk full"):
        calibration.write(tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_zoomcam_gives_the_reference_figures(data):
    from benchmarks.real.zoomcam import read_zoomcam

    lines = read_zoomcam(data / "zoomcam")
    assert len(lines.focal) == 5
    assert len(lines.frame) == 116 * (15 + 22)
    paper = {"centre": None, "metric": in_corrected}
    by_degree = {d: calibrate(lines, model=WantedModel(degree=d), **paper) for d in (0, 1, 2)}
    assert float(by_degree[2].frames.rms) == pytest.approx(0.8796, abs=5e-4)
    for degree, rms in {0: 0.9969, 1: 0.8855, 2: 0.8809}.items():
        assert float(by_degree[degree].fit.rms) == pytest.approx(rms, abs=5e-4)
    first, last = by_degree[2].frames.coefficients[0], by_degree[2].frames.coefficients[-1]
    np.testing.assert_allclose(first, [0.0815, -0.0303], atol=1e-4)
    np.testing.assert_allclose(last, [-0.0491, -0.0057], atol=1e-4)


@pytest.mark.slow
def test_known_errors_of_focal_lengths_are_no_misfit():
    """Of twelve frames whose focal lengths are off by 1 %: told so, bands are narrower than without."""
    focal = scenes.focal_sweep(12)
    seen = scenes.board_lines(scenes.nikkor_18_200(), focal, spacing=200.0, noise=0.3)
    wrong = np.asarray(focal) * np.exp(0.01 * np.random.default_rng(0).standard_normal(12))
    lines = dataclasses.replace(seen, focal=wrong)
    without, told = (calibrate(lines, **GIVEN, focal_sigma=sigma * wrong) for sigma in (0.0, 0.01))
    assert np.trace(told.fit.misfit) < 0.5 * np.trace(without.fit.misfit)


@pytest.mark.slow
def test_bands_allow_for_uncertain_focal_lengths(calibration):
    sigma = 0.01 * np.asarray(calibration.lines.focal)
    allowed = calibrate(calibration.lines, **GIVEN, focal_sigma=focal_sigmas("1%", calibration.lines.focal))
    small = in_image(zj.compress(calibration.lines))
    expected = zj.fit.with_focal_sigma(calibration.fit, small, focal_sigma=sigma)
    np.testing.assert_allclose(allowed.fit.covariance, expected.covariance, rtol=1e-6)
    assert all(a[2] > b[2] for a, b in zip(allowed.corner, calibration.corner, strict=True))
    told = [row["focal_sigma"] for row in allowed.summary()["per_frame"]]
    np.testing.assert_allclose(told, sigma)
    assert allowed.next_photo.sentence == calibration.next_photo.sentence


@pytest.mark.slow
def test_frames_of_one_focal_length_err_together():
    """As photos at one step of the zoom, rounded in EXIF data: its error does not average out."""
    settings = np.array([22.0, 28.0, 50.0, 105.0])
    focal = np.repeat(settings, 3)
    lines = scenes.board_lines(scenes.nikkor_18_200(), focal, spacing=199, noise=0.5)
    allowed = calibrate(lines, **GIVEN, focal_sigma=0.01 * focal)
    small, fit = in_image(zj.compress(lines)), calibrate(lines, **GIVEN).fit
    for shared, same in ((np.repeat(np.arange(4), 3), True), (None, False)):
        expected = zj.fit.with_focal_sigma(fit, small, focal_sigma=0.01 * focal, shared=shared)
        assert np.allclose(allowed.fit.covariance, expected.covariance, rtol=1e-6) == same


def test_deviations_are_numbers_or_per_cent():
    np.testing.assert_allclose(focal_sigmas("0.3", np.array([20.0, 50.0])), [0.3, 0.3])
    np.testing.assert_allclose(focal_sigmas(" 2 %", np.array([20.0, 50.0])), [0.4, 1.0])
    for text in ("", "%", "-1", "nan", "1%%", "inf", "a bit"):
        with pytest.raises(ValueError, match=r"Argument focal_sigma must be a number such as 0.3, or 1%"):
            focal_sigmas(text, np.ones(2))


@pytest.mark.slow
def test_a_frame_whose_lines_are_all_rejected_has_no_figures():
    """In `summary.json`, which is JSON without NaN, and in the tables."""
    lines = scenes.board_lines(scenes.nikkor_18_200(), scenes.focal_sweep(5), spacing=60, noise=0.4)
    wave = 80 * np.sin(np.linspace(0, 9, lines.points.shape[1]))[None, :, None]
    bad = np.asarray(lines.frame) == 1
    lines = eqx.tree_at(
        lambda data: data.points, lines, lines.points + np.where(bad[:, None, None], wave, 0)
    )
    spoiled = calibrate(lines, **GIVEN, robust=True)
    assert spoiled.rejected[bad].all()
    summary = json.loads(json.dumps(spoiled.summary(), allow_nan=False))
    for key in ("rms_none", "rms_frames", "rms_zoom"):
        per_frame = [row[key] for row in summary["per_frame"]]
        assert per_frame[1] is None
        known = np.array([value for value in per_frame if value is not None])
        assert len(known) == 4
        assert summary[key] == pytest.approx(rms_over_frames(known), rel=1e-9)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert ">nan<" not in report(spoiled)


@pytest.mark.parametrize(("number", "told"), [(7, True), (8, False)])
def test_what_few_photos_cannot_tell_is_said(truth, number, told):
    lines = scenes.board_lines(truth, scenes.focal_sweep(number), spacing=200)
    known = SimpleNamespace(lines=lines, focal_sigma=np.zeros(number))
    assert ("errors of the model" in Calibration.allowed_for(known)) is told
    known = SimpleNamespace(lines=lines, focal_sigma=0.01 * np.asarray(lines.focal))
    assert "include those of the focal lengths, 1.00%" in Calibration.allowed_for(known)
