"""How far a correction may bend what is straight: against the errors of fits to new noise."""

import cv2
import equinox as eqx
import numpy as np
import pytest

import zoomjax as zj
from zoomjax import scenes
from zoomjax.models.brown_conrady import BrownConrady
from zoomjax.models.division import Division
from zoomjax.models.polynomial import RadialPolynomial
from zoomjax.trust._rival import apart_from_division
from zoomjax.trust.assessment import assess
from zoomjax.trust.evidence import evidence

SIZE = (960, 640)
ONE = zj.PolynomialZoom(degree=0)
CENTRE = (np.array(SIZE) - 1) / 2


def photo(k, centre, *, lines=12, noise=0.3, seed=0):
    """Straight lines of one photo through the division model."""
    rng = np.random.default_rng((seed, 1))
    scale = np.hypot(*SIZE) / 2
    ends = np.random.default_rng(7).uniform((0, 0), SIZE, (200, 2, 2))
    ends = ends[np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) > 450][:lines]
    lens = zj.Distortion(np.array([k]), np.asarray(centre), np.array(scale), Division())
    ends = np.asarray(lens.undistort(ends))
    t = np.linspace(0, 1, 60)[:, None]
    straight = ends[:, :1] * (1 - t) + ends[:, 1:] * t
    points = np.asarray(lens.distort(straight))
    points = points + noise * rng.standard_normal(points.shape)
    return lens, zj.Lines.from_ragged(list(points), [0] * len(points), [1.0], image_size=SIZE)


def apart(one, other):
    """px RMS of the image between two corrections, up to a homography, by OpenCV."""
    x, y = np.meshgrid(*(np.linspace(0.02, 0.98, 12) * (side - 1) for side in SIZE))
    points = np.stack([x, y], axis=-1).reshape(-1, 2)
    first, second = (np.asarray(of.undistort(points)) for of in (one, other))
    mapped = cv2.perspectiveTransform(first[:, None], cv2.findHomography(first, second, 0)[0])[:, 0]
    back = np.asarray(other.distort(mapped))
    return float(np.sqrt(np.nanmean(np.sum((back - points) ** 2, axis=-1))))


@pytest.mark.slow
def test_it_is_the_error_that_noise_makes():
    """Of new noise, the fits scatter about the true lens as far as is said; with the centre fitted."""
    errors, said = [], []
    for seed in range(8):
        lens, lines = photo(-0.3, CENTRE + np.array([9, -6]), seed=seed)
        fit = zj.fit.fit_centre(lines, zoom=ONE, distortion_model=Division(), terms=1).fit
        errors.append(apart(fit.lens(1.0), lens))
        said.append(evidence(lines, fit).bent_std)
    true = np.sqrt(np.mean(np.square(errors)))
    assert 0.6 * true < np.median(said) < 1.7 * true


@pytest.fixture(scope="module")
def told():
    """Lines that tell a weak lens nearly exactly, and a fit to them whose covariance is 0."""
    _, lines = photo(-0.02, CENTRE, noise=1e-4)
    fit = zj.fit.fit_centre(lines, zoom=ONE, terms=2).fit
    nothing = np.zeros((2, 2)), np.zeros((4, 4))
    return lines, eqx.tree_at(lambda fit: (fit.covariance, fit.joint), fit, nothing)


@pytest.mark.parametrize(
    ("name", "by"),
    [
        ("misfit", [0.004, -0.003]),
        ("misfit", [0.004, -0.003, 0.005]),
        ("off_centre", [0.0, 0.0, 0.0, 0.02, -0.03]),
        ("off_centre", [0.004, 0.0, 0.002, 0.02, 0.01]),
        ("joint", [0.004, -0.003, 0.02, 0.01]),
    ],
)
def test_what_the_bands_include_counts(told, name, by):
    """If the lens may be off in one direction, by as much as that bends beyond a homography."""
    lines, fit = told
    assert evidence(lines, fit).bent_std < 0.02
    covariance = np.outer(by, by)
    wider = eqx.tree_at(lambda f: getattr(f, name), fit, covariance, is_leaf=lambda leaf: leaf is None)
    more = np.array(by if name == "misfit" else by[:-2])
    k = np.pad(np.ravel(fit.lens.zoom.parameters), (0, max(len(more) - 2, 0)))
    k[: len(more)] += more
    moved = np.zeros(2) if name == "misfit" else fit.lens.scale * np.array(by[-2:])
    other = zj.Distortion(k, fit.lens.centre + moved, fit.lens.scale)
    expected = apart(other, fit.lens(1.0))
    assert expected > 0.06
    assert evidence(lines, wider).bent_std == pytest.approx(expected, rel=0.1)


@pytest.mark.slow
def test_a_centre_that_may_move_along_the_zoom_counts():
    """By all the numbers that say where it is."""
    lens, focal = scenes.nikkor_18_200(), scenes.focal_sweep(4)
    lines = scenes.board_lines(lens, focal, spacing=99, noise=1e-3)
    fit = zj.fit.fit_centre(lines, terms=2, centre=zj.PolynomialZoom(degree=1)).fit

    def bent_std(centre):
        joint = np.zeros(fit.joint.shape)
        joint[-4:, -4:] = np.outer(centre, centre)
        wider = eqx.tree_at(lambda fit: (fit.covariance, fit.joint), fit, (joint[:6, :6], joint))
        return evidence(lines, wider).bent_std

    still, moves = bent_std([0.05, 0.03, 0.0, 0.0]), bent_std([0.0, 0.0, 0.05, 0.03])
    assert still > 4 * bent_std(np.zeros(4))
    assert moves == pytest.approx(still, rel=1e-3)  # at the shortest f, where u is 1


@pytest.mark.slow
def test_what_is_moved_is_no_homography():
    lens, lines = photo(-0.3, CENTRE, noise=0.01)
    found = evidence(lines, zj.fit_zoom(lines, zoom=ONE, distortion_model=Division(), terms=1))
    same = zj.Distortion(np.zeros(1), CENTRE, lens.scale, Division())
    assert found.bent == pytest.approx(apart(lens, same), rel=0.4)  # to first order in what is straightened
    assert found.bent < 0.3 * found.displacement


def test_a_centre_that_lines_do_not_tell_counts():
    """Lines that are straight about a wrong centre, too: the verdict does not trust it."""
    _, lines = photo(-0.35, CENTRE + np.array([25, 20]), lines=3, noise=0.05)
    fit = zj.fit_zoom(lines, zoom=ONE, distortion_model=Division(), terms=1)
    found = evidence(lines, fit)
    assert found.rms < 0.5
    assert found.bent_std > 0.4
    _, lines = photo(-0.35, CENTRE, lines=12, noise=0.05)
    assert (
        evidence(lines, zj.fit_zoom(lines, zoom=ONE, distortion_model=Division(), terms=1)).bent_std < 0.2
    )


@pytest.mark.parametrize("distortion_model", [RadialPolynomial(), BrownConrady()], ids=str)
def test_a_centre_about_which_lines_are_straighter_counts(truth, distortion_model):
    """What noise alone makes uncertain about a given centre was a tenth of the error."""
    elsewhere = eqx.tree_at(lambda lens: lens.centre, truth, truth.centre + 200.0)
    found = []
    for lens in (truth, elsewhere):
        lines = scenes.board_lines(lens, np.array([24.0]), spacing=99, noise=0.3)
        fit = zj.fit_zoom(lines, zoom=ONE, distortion_model=distortion_model)
        x, y = np.meshgrid(*(np.linspace(0, side - 1, 12) for side in lens.image_size))
        points = np.stack([x, y], axis=-1).reshape(-1, 2)
        first, second = (np.asarray(one(24.0).undistort(points)) for one in (fit.lens, lens))
        mapped = cv2.perspectiveTransform(first[:, None], cv2.findHomography(first, second, 0)[0])[:, 0]
        error = np.asarray(lens(24.0).distort(mapped)) - points
        found.append((assess(lines, fit), np.sqrt(np.mean(np.sum(error**2, axis=-1)))))
    (right, _), (found, error) = found
    assert right.verdict == "good"
    assert right.evidence.to_centre == 0
    assert error > 3
    assert 0.5 * error < found.evidence.bent_std < 1.2 * error
    assert found.evidence.to_centre == pytest.approx(200 * np.sqrt(2), rel=0.6)
    assert found.verdict != "good"
    assert "centre of distortion" in found.sentence


def test_a_strong_lens_that_is_uncertain_in_px_is_doubtful():
    """Though its bands are a small part of the displacement."""
    _, lines = photo(-0.45, CENTRE, lines=6, noise=3.0)
    found = assess(lines, zj.fit_zoom(lines, zoom=ONE, distortion_model=Division(), terms=1))
    assert found.evidence.std < 0.1 * found.evidence.displacement
    assert {of.about: of.verdict for of in found.findings}["bending"] == "doubtful"
    assert "the correction straightens what is bent by" in found.sentence


def test_of_one_photo_a_homography_is_no_harm():
    """A small part of a weak lens's displacement may be uncertain, if it bends nothing."""
    _, lines = photo(-0.02, CENTRE, lines=12, noise=0.5)
    found = assess(lines, zj.fit_zoom(lines, zoom=ONE, terms=2))
    assert found.evidence.bent_std < 0.4
    assert found.verdict == "good"


@pytest.mark.slow
def test_frames_and_a_moving_centre_are_each_at_their_own_place():
    """A zoom whose centre moves: as uncertain as the same lines about the true centres."""
    lens = scenes.nikkor_18_200((1072, 712))
    lines = scenes.board_lines(lens, scenes.focal_sweep(4), spacing=99.0, noise=0.5)
    fit = zj.fit_zoom(lines)
    shift = zj.PolynomialZoom(degree=1).prepare(lines.focal, 2)
    moved = eqx.tree_at(lambda of: of.lens.shift, fit, shift, is_leaf=lambda leaf: leaf is None)
    one, other = (evidence(lines, of) for of in (fit, moved))
    assert other.bent_std == pytest.approx(one.bent_std, rel=1e-3)
    assert 0 < one.bent_std < 0.4


@pytest.mark.parametrize("k", [-4.0, 30.0])
@pytest.mark.parametrize("distortion_model", [None, Division()])
def test_a_lens_with_a_fold_or_a_pole_is_not_known(k, distortion_model):
    """No error, and no number that would pass for a good one."""
    _, lines = photo(-0.3, CENTRE)
    fit = zj.fit_zoom(lines, zoom=ONE, distortion_model=distortion_model, terms=1)
    wrong = eqx.tree_at(lambda of: of.lens.zoom.parameters, fit, np.full((1, 1), k))
    found = evidence(lines, wrong)
    assert not found.bent_std <= 0.4


def test_of_a_strong_lens_another_model_counts():
    """Two terms of the polynomial follow the few lines of a division model, and correct otherwise."""
    lens, lines = photo(-0.48, CENTRE, lines=4, noise=0.2, seed=3)
    fit = zj.fit_zoom(lines, zoom=ONE, terms=2)
    rest = np.linalg.norm(np.asarray(fit.lens.centre) - CENTRE)
    assert rest < 1e-6
    z = (np.asarray(lines.points) - CENTRE) / lens.scale
    k = np.asarray(fit.lens(1.0).coefficients)
    other = apart_from_division(z, k, CENTRE, SIZE)
    assert other > 0.4
    assert evidence(lines, fit).bent_std >= other
    flat, still = photo(0.0, CENTRE, lines=4, noise=0.2)
    assert apart_from_division((np.asarray(still.points) - CENTRE) / flat.scale, 0 * k, CENTRE, SIZE) < 0.4
