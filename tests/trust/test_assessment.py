"""The verdict on fits: lines that must be good, and lines that must not.

All have the shapes of one board, so that what they need is compiled once.
"""

import dataclasses
import json

import equinox as eqx
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes
from zoomjax.trust.assessment import VERDICTS, Finding, assess
from zoomjax.trust.cross_validation import cross_validate_frames, cross_validate_zoom
from zoomjax.trust.evidence import evidence

from ..conftest import moved

SIZE = (1072, 712)
NOISE = 0.1


@pytest.fixture(scope="module")
def lens():
    return scenes.nikkor_18_200(SIZE)


@pytest.fixture(scope="module")
def lines(lens):
    """The paper's board in six frames, with a noise of 0.1 px."""
    return scenes.board_lines(lens, scenes.focal_sweep(6), spacing=24.0, noise=NOISE)


def assessed(lines):
    small = zj.compress(lines)
    fit = zj.fit_zoom(small, throw=False)
    left_out = {
        "rms_held_out": cross_validate_zoom(small),
        "rms_frames_held_out": cross_validate_frames(small),
    }
    return assess(lines, fit, compressed=small, **left_out)


def about(assessment):
    return {finding.about: finding.verdict for finding in assessment.findings}


def through(lens, lines, bend):
    """The lines with points on the board moved by `bend`, in half diagonals from the centre."""
    points = np.array(lines.points)
    for frame, focal in enumerate(lines.focal):
        own = np.asarray(lines.frame) == frame
        distortion = lens(float(focal))
        board = (np.asarray(distortion.undistort(points[own])) - np.asarray(lens.centre)) / lens.scale
        bent = distortion.distort(bend(board) * lens.scale + np.asarray(lens.centre))
        points[own] = np.where(np.isfinite(bent), bent, points[own])
    return moved(lines, points)


@pytest.mark.slow
def test_a_flat_board_is_good(lines):
    found = assessed(lines)
    assert (found.verdict, found.findings) == ("good", ())
    assert found.sentence.startswith("Good: the correction moves points by 17 px")
    assert found.evidence.noise == pytest.approx(NOISE, rel=0.05)
    assert [halves.parting for halves in found.evidence.halves] == ["lines", "frames", "directions"]
    assert all(halves.excess < 4 for halves in found.evidence.halves)


def test_the_displacement_is_the_mean_over_all_pixels(lines):
    fit = zj.fit_zoom(zj.compress(lines))
    found = evidence(lines, fit)
    x, y = np.meshgrid(*map(np.arange, SIZE))
    points = np.stack([x, y], axis=-1)[::4, ::4].reshape(-1, 2) + 1.5
    low, high = (float(f) for f in fit.lens.focal_range)
    moved, std = [], []
    for f in (low, 2 / (1 / low + 1 / high), high):
        moved.append(np.sum((np.asarray(fit.lens(f).undistort(points)) - points) ** 2, axis=-1))
        std.append(np.asarray(zj.displacement_std(fit, points, focal=f)) ** 2)
    assert found.displacement == pytest.approx(np.sqrt(np.mean(moved, axis=1).max()), rel=0.01)
    assert found.std == pytest.approx(np.sqrt(np.mean(std, axis=1).max()), rel=0.03)
    assert found.raster_displacement > 1.1 * found.displacement  # which the border dominates
    assert found.raster_std > found.std


@pytest.mark.slow
def test_halves_are_as_far_apart_as_fits_of_their_lines(lines):
    """Against two fits of their own, of steep and of flat lines of a bent board."""
    steep = np.array([np.ptp(p[:, 1]) > np.ptp(p[:, 0]) for p in lines.to_ragged()])
    small = zj.compress(lines)
    fit = zj.fit_zoom(small)
    pair = [zj.fit_zoom(small.weighted(half.astype(float))).lens for half in (steep, ~steep)]
    [halves] = [of for of in evidence(lines, fit).halves if of.parting == "directions"]
    x, y = np.meshgrid(*(np.linspace(0, side - 1, 9) for side in SIZE))
    points = np.stack([x, y], axis=-1)
    low, high = (float(f) for f in fit.lens.focal_range)
    apart = []
    for f in (low, 2 / (1 / low + 1 / high), high):
        one, other = (np.asarray(half(f).undistort(points)) for half in pair)
        apart.append(np.sqrt(np.mean(np.sum((one - other) ** 2, axis=-1))))
    assert halves.apart == pytest.approx(max(apart), rel=0.1)


@pytest.mark.slow
def test_a_bent_board_is_not_good(lens, lines):
    """A cylinder: the middle of the board is nearer to the camera, or farther, by 2 % of its distance."""
    found = assessed(through(lens, lines, lambda z: z / (1 - 0.03 * z[..., :1] ** 2)))
    assert found.verdict != "good"
    assert "halves by directions" in about(found)
    assert "flat" in found.findings[0].advice


def test_two_lenses_are_not_good(lens, lines):
    """Every other frame by a lens of the opposite distortion."""
    other = eqx.tree_at(lambda lens: lens.zoom.parameters, lens, -lens.zoom.parameters)
    turned = through(lens, lines, lambda z: z)
    points = np.array(turned.points)
    for frame in (1, 3, 5):
        own, focal = np.asarray(lines.frame) == frame, float(lines.focal[frame])
        points[own] = other(focal).distort(lens(focal).undistort(points[own]))
    found = assessed(moved(lines, np.where(np.isfinite(points), points, 0)))
    assert found.verdict != "good"
    assert "photos left out" in about(found)


def test_curved_things_are_not_good(lines, rng):
    """Arcs, each of its own radius, as of cups and saucers."""
    points = np.array(lines.points)
    for line, mask in enumerate(np.asarray(lines.mask)):
        own = points[line, mask]
        chord = own[-1] - own[0]
        t = np.linspace(-1, 1, len(own))[:, None]
        normal = np.array([-chord[1], chord[0]])
        points[line, mask] = own + rng.uniform(-0.15, 0.15) * normal * (1 - t**2)
    found = assessed(moved(lines, points))
    assert found.verdict != "good"
    assert "crooked lines" in about(found)


@pytest.mark.slow
@pytest.mark.parametrize("curved", [True, False])
def test_a_photo_of_curved_things_alone_determines_no_lens(lens, rng, curved):
    """Half a dozen arcs, which no lens straightens together: lines left out gain nothing."""
    board = scenes.board_lines(lens, np.array([50.0]), spacing=24.0, noise=NOISE)
    chosen = np.linspace(0, len(board.frame) - 1, 6).astype(int)
    points = [board.to_ragged()[line] for line in chosen]
    if curved:
        points = [
            line + side * np.linspace(-1, 1, len(line))[:, None] ** 2 * [3.0, -3.0]
            for line, side in zip(points, rng.permutation([-1, 1, -1, 1, -1, 1]), strict=True)
        ]
    lines = zj.Lines.from_ragged(points, [0] * 6, [50.0], image_size=SIZE)
    small = zj.compress(lines)
    fit = zj.fit_zoom(small, zoom=zj.PolynomialZoom(degree=0))
    left_out = {"rms_held_out": np.full(1, np.nan), "rms_frames_held_out": cross_validate_frames(small)}
    found = assess(lines, fit, compressed=small, **left_out)
    assert (found.verdict == "not determined") == curved
    assert ("lines left out" in about(found)) == curved


def test_lines_without_noise_are_not_crooked(lens, lines):
    """Rounding leaves 1e-13 px, many times the noise, which is less still."""
    exact = scenes.board_lines(lens, scenes.focal_sweep(6), spacing=24.0, noise=0)
    fit = zj.fit_zoom(zj.compress(exact))
    found = evidence(exact, fit)
    assert found.rms < 1e-6
    assert not found.crooked
    assert dataclasses.replace(found, rms=0.02).crooked  # by which noise of a micropixel is exceeded
    assert "crooked lines" not in about(assessed(exact))


@pytest.mark.parametrize(("bend", "astray"), [(0.1, False), (3.0, True)])
def test_rejected_lines_count_where_they_are_off_straight(lines, bend, astray):
    """Half of the lines have a weight of 0 and are bent, by less than can be seen or by more."""
    weight = np.arange(len(lines.frame)) % 2
    points = np.array(lines.points)
    for line in np.flatnonzero(weight == 0):
        own = np.asarray(lines.mask)[line]
        points[line, own] += bend * np.linspace(-1, 1, own.sum())[:, None] ** 2 * np.array([1.0, -1.0])
    found = assessed(moved(lines, points).weighted(weight.astype(float)))
    assert found.evidence.rejected == (weight == 0).sum()
    assert (found.evidence.astray > 0.9 * found.evidence.rejected) == astray
    assert ("rejected lines" in about(found)) == astray


def test_few_lines_are_not_good(lines):
    weight = np.zeros(len(lines.frame))
    for frame in range(6):
        weight[np.flatnonzero(np.asarray(lines.frame) == frame)[:2]] = 1
    found = assessed(lines.weighted(weight))
    assert found.verdict != "good"
    assert "few lines" in about(found)
    assert found.evidence.lines == 12


@pytest.mark.slow
def test_lines_through_the_centre_determine_nothing(lens, lines):
    points = np.array(lines.points)
    centre = (np.array(SIZE) - 1) / 2
    for line, mask in enumerate(np.asarray(lines.mask)):
        own = points[line, mask]
        direction = (own[-1] - own[0]) / np.hypot(*(own[-1] - own[0]))
        points[line, mask] = centre + (own - own.mean(axis=0)) @ direction[:, None] * direction
    found = assessed(moved(lines, points))
    assert found.verdict == "not determined"
    assert about(found)["bands"] == "not determined"
    assert found.sentence == "Not determined: the lines do not determine the correction."


def test_a_covariance_that_is_not_known_is_not_one_of_zero(lines):
    small = zj.compress(lines)
    fit = zj.fit_zoom(small)
    unknown = eqx.tree_at(lambda fit: fit.covariance, fit, np.full_like(fit.covariance, np.nan))
    found = assess(lines, unknown, compressed=small)
    assert found.evidence.std == np.inf
    assert about(found)["bands"] == "not determined"
    failed = eqx.tree_at(lambda fit: fit.lens.zoom.parameters, fit, replace_fn=lambda p: p * np.nan)
    with pytest.raises(ValueError, match="parameters must be finite"):
        assess(lines, failed, compressed=small)


def test_the_summary_is_plain(lines):
    found = assessed(lines)
    infinite = dataclasses.replace(found, evidence=dataclasses.replace(found.evidence, std=np.inf))
    plain = json.loads(json.dumps(infinite.summary(), allow_nan=False))
    assert plain["verdict"] == "good"
    assert plain["evidence"]["std"] is None
    assert plain["evidence"]["halves"][0]["parting"] == "lines"


def test_the_worst_finding_comes_first(lines):
    found = assessed(lines)
    findings = [Finding("a", verdict, f"{verdict}.", "Do.") for verdict in VERDICTS]
    joined = found.joined_by(findings)
    assert [of.verdict for of in joined.findings] == list(VERDICTS)[::-1]
    assert joined.sentence == "Not determined: not determined."


def test_a_cause_comes_before_its_consequences(lines):
    cause = Finding("c", "doubtful", "two lenses.", "Part them.", cause=True)
    worse = Finding("w", "not determined", "uncertain.", "Add photos.")
    for findings in ([cause, worse], [worse, cause]):
        joined = assessed(lines).joined_by(findings)
        assert joined.findings[:2] == (cause, worse)
        assert joined.sentence == "Not determined: two lenses."


@pytest.mark.slow
def test_the_real_zoom_camera_is_doubtful(data):
    """Its board is paper that is not flat: zooms differ by more than lines explain, which bands include."""
    from benchmarks.real.zoomcam import read_zoomcam

    found = assessed(read_zoomcam(data / "zoomcam"))
    assert found.verdict == "doubtful"
    assert about(found) == {"bands": "doubtful", "halves by directions": "good"}


@pytest.mark.parametrize("weighted", [True, False])
def test_points_outside_of_the_image_are_not_good(lines, weighted):
    """As of a table of lines whose columns x and y are exchanged: the centre is another one then."""
    small = zj.compress(lines)
    fit = zj.fit_zoom(small)
    points = np.where(np.asarray(lines.frame)[:, None, None] == 0, lines.points + 1e3, lines.points)
    weight = np.where(np.asarray(lines.frame) == 0, float(weighted), 1.0)
    off = dataclasses.replace(lines, points=points, weight=weight)
    found = assess(off, fit, compressed=small.weighted(weight))
    outside = [finding for finding in found.findings if finding.cause]
    assert [finding.about for finding in outside] == ["points outside"] * weighted
    assert all("of the points lie outside of the image of 1072 x 712 px" in f.found for f in outside)
