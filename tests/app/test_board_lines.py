"""Lines of a flat board in the place of those of a bent one: which are taken, and how good the lens is."""

import jax.numpy as jnp
import numpy as np
import pytest

from tests._boards import COLUMNS, FOCAL, LABEL, ROWS, SIZE, bent, displaced, seen_through, true_lens
from zoomjax import fit_zoom
from zoomjax.app.board_bundle import bundle_of
from zoomjax.app.board_lines import _columns, coefficient_covariance
from zoomjax.app.calibration import calibrate
from zoomjax.app.focal_sources import Focals, lines_of
from zoomjax.app.model_choice import WantedModel
from zoomjax.app.plane_focals import FocalGroup
from zoomjax.detect import GridDetector
from zoomjax.detect.batch import Detection
from zoomjax.fit._board_shape import grid_places
from zoomjax.lines import compress_any_centre
from zoomjax.models import Division, RadialPolynomial
from zoomjax.trust import displacement_std

TRUE = [1000.0, 1600.0, 2600.0]


def photos(height):
    """Detections of a board, and their focal lengths as a folder's label tells them."""
    x, y = grid_places(ROWS, COLUMNS)[0].T
    board = bent(height) if height else np.stack([x, y, 0 * x], axis=1) * grid_places(ROWS, COLUMNS)[1]
    grids, _ = seen_through(true_lens(), board, FOCAL)
    grids = grids + 0.15 * np.random.default_rng(0).standard_normal(grids.shape)
    used = [
        Detection(f"{i}.png", f"{i}.png", SIZE, tuple(GridDetector.lines(grid)), None, grid)
        for i, grid in enumerate(grids)
    ]
    return used, Focals(dict(zip((d.name for d in used), LABEL.tolist(), strict=True)), "px", "", "")


@pytest.fixture(scope="module")
def of_bent():
    used, focals = photos(0.1)
    return used, focals, bundle_of(used, focals)


def lens_of(lines):
    return fit_zoom(compress_any_centre(lines), centre="fit")


def test_a_bent_board_s_lines_are_straightened_and_the_lens_is_right(of_bent):
    used, _, bundle = of_bent
    assert bundle.bent
    focal = np.asarray(bundle.fit.frame_focal)
    seen, flat = (lens_of(lines_of(some, focal, "px")) for some in (used, bundle.lines_used(used)))
    before, after = (displaced(true_lens(), of.lens, bundle.fit.focal, TRUE) for of in (seen, flat))
    assert after < 3 < 10 < before
    # The photos' own lines stay what is drawn, one for one.
    for own, other in zip(used, bundle.lines_used(used), strict=True):
        assert [len(line) for line in own.lines] == [len(line) for line in other.lines]


def test_bands_of_a_straightened_board_hold_the_truth_and_are_wider(of_bent):
    used, _, bundle = of_bent
    fit = lens_of(lines_of(bundle.lines_used(used), np.asarray(bundle.fit.frame_focal), "px"))
    corner = np.array([0.0, 0.0])
    wide = bundle.widened(fit)
    narrow, std = (np.asarray(displacement_std(of, corner, focal=bundle.fit.focal)) for of in (fit, wide))
    missed = [
        np.linalg.norm(wide.lens(float(own)).undistort(corner) - true_lens()(true).undistort(corner))
        for own, true in zip(np.asarray(bundle.fit.focal), TRUE, strict=True)
    ]
    assert (std > 1.1 * narrow).all()
    assert (np.array(missed) < 3 * std).all()


def test_a_flat_board_s_lines_stay_as_they_are_seen():
    used, focals = photos(0.0)
    bundle = bundle_of(used, focals)
    assert not bundle.bent
    assert bundle.lines_used(used) == used
    fit = lens_of(lines_of(used, FOCAL, "px"))
    assert bundle.widened(fit) is fit
    assert "as they are seen" in bundle.sentences()[1]


def test_calibration_has_the_board_s_uncertainty_in_bands_and_centre(of_bent):
    used, _, bundle = of_bent
    lines = lines_of(bundle.lines_used(used), np.asarray(bundle.fit.frame_focal), "px")
    model = WantedModel(model="polynomial", degree=2)
    plain, wide = (calibrate(lines, model=model, widened=w) for w in (lambda fit: fit, bundle.widened))
    for at, other in zip(plain.corner(), wide.corner(), strict=True):
        assert other[1] == pytest.approx(at[1])
        assert other[2] > at[2]
    assert (np.array(wide.centre.std) > plain.centre.std).all()
    assert f"{wide.centre.std[0]:.2g} and" in wide.centre.sentence
    assert wide.assessment.evidence.std > plain.assessment.evidence.std


def test_covariance_displaces_alike_in_another_distortion_model(of_bent):
    used, _, bundle = of_bent
    fit = lens_of(lines_of(used, np.asarray(bundle.fit.frame_focal), "px"))
    radii, k = jnp.linspace(0, 1, 16), fit.lens.zoom(1600.0)
    spread = []
    for family in (RadialPolynomial(), Division()):
        covariance = coefficient_covariance(bundle.fit, family, fit)
        columns = _columns(family, k, radii)
        spread.append(np.sqrt(np.einsum("rk,kl,rl->r", columns, covariance, columns)))
    assert spread[0][-1] > 1e-4
    np.testing.assert_allclose(spread[1][8:], spread[0][8:], rtol=0.3)


def test_photos_that_the_bend_made_disagree_are_explained(of_bent):
    """Homographies of a bent board disagree; one focal length and its bend explain them all."""
    used, focals, bundle = of_bent
    names = tuple(d.name for d in used)
    groups = tuple(
        FocalGroup(names[i : i + 6], f, 50.0, (0.7 * f, 1.1 * f), agree=False)
        for i, f in zip((0, 6, 12), TRUE, strict=True)
    )
    measured = bundle.measured(
        Focals(focals.focal, "px", "", "", deviation=dict.fromkeys(names, 50.0), groups=groups)
    )
    assert all(group.agree and group.std < 20 for group in measured.groups)
    assert max(measured.deviation.values()) < 20
