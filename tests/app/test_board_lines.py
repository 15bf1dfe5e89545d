"""Lines of a flat board in the place of those of a bent one: which are taken, and how good the lens is."""

import dataclasses

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from tests._boards import COLUMNS, FOCAL, LABEL, ROWS, SIZE, bent, displaced, seen_through, true_lens
from zoomjax import fit_zoom
from zoomjax.app.board_bundle import bundle_of
from zoomjax.app.board_lines import _columns, coefficient_covariance
from zoomjax.app.calibrating import calibrate
from zoomjax.app.focal_sources import GRID, Focals, choose_focals, lines_of
from zoomjax.app.image_calibration import _calibrated
from zoomjax.app.image_job import ImageJob
from zoomjax.app.model_choice import WantedModel
from zoomjax.app.plane_focals import FocalGroup
from zoomjax.detect import GridDetector
from zoomjax.detect.batch import Detection
from zoomjax.fit import fit_centre
from zoomjax.fit._board_shape import grid_places
from zoomjax.lines import compress_any_centre
from zoomjax.models import Division, RadialPolynomial
from zoomjax.trust import displacement_std, std_of

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
    return used, focals, bundle_of(used, focals).bundle


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


def test_a_centre_that_moves_is_as_uncertain_as_one_by_the_shape_of_the_board(of_bent):
    used, _, bundle = of_bent
    lines = lines_of(bundle.lines_used(used), np.asarray(bundle.fit.frame_focal), "px")
    fit = fit_centre(lines, centre=zj.PolynomialZoom(degree=1)).fit
    more = float(fit.lens.scale) ** 2 * np.diag(bundle.fit.fit.joint)[-2:]
    for f in np.asarray(bundle.fit.focal)[[0, -1]]:
        narrow, wide = (
            np.asarray(std_of(of, lambda lens, f=f: lens.centre_at(f))) for of in (fit, bundle.widened(fit))
        )
        np.testing.assert_allclose(wide**2, narrow**2 + more, rtol=1e-6)


def test_boards_seen_on_their_side_are_the_same_board(of_bent):
    """A camera that is turned by a quarter gives a grid with rows for columns."""
    used, focals, bundle = of_bent
    aside = [
        dataclasses.replace(d, nodes=nodes, lines=tuple(GridDetector.lines(nodes))) if i % 4 == 1 else d
        for i, d in enumerate(used)
        for nodes in [np.rot90(d.nodes, -1)]
    ]
    again = bundle_of(aside, focals).bundle
    assert again.names == bundle.names
    np.testing.assert_allclose(again.fit.focal, bundle.fit.focal, rtol=1e-9)
    for own, flat in zip(aside, again.lines_used(aside), strict=True):
        for line, even in zip(own.lines, flat.lines, strict=True):
            assert np.abs(line - even).max() < 30  # the bend, and not the board turned


def test_a_flat_board_s_lines_stay_as_they_are_seen():
    used, focals = photos(0.0)
    bundle = bundle_of(used, focals).bundle
    assert not bundle.bent
    assert bundle.lines_used(used) == used
    fit = lens_of(lines_of(used, FOCAL, "px"))
    assert bundle.widened(fit) is fit
    assert "as they are seen" in bundle.sentences()[1]


@pytest.mark.slow
def test_calibration_has_the_board_s_uncertainty_in_bands_and_centre(of_bent):
    used, _, bundle = of_bent
    lines = lines_of(bundle.lines_used(used), np.asarray(bundle.fit.frame_focal), "px")
    model = WantedModel(model="polynomial", degree=2)
    plain, wide = (calibrate(lines, model=model, widened=w) for w in (lambda fit: fit, bundle.widened))
    for at, other in zip(plain.corner, wide.corner, strict=True):
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
    for distortion_model in (RadialPolynomial(), Division()):
        covariance = coefficient_covariance(bundle.fit, distortion_model, fit)
        columns = _columns(distortion_model, k, radii)
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


def each_apart(used, rng):
    """Focal lengths as homographies give them: each photo its own, short and wrong by some per cent."""
    wrong = FOCAL * (0.9 + 0.05 * rng.standard_normal(len(FOCAL)))
    return Focals(dict(zip((d.name for d in used), wrong.tolist(), strict=True)), "px", GRID, "")


@pytest.mark.slow
def test_photos_each_at_its_own_focal_length_tell_them_and_the_board_s_shape():
    used, _ = photos(0.1)
    focals = each_apart(used, np.random.default_rng(1))
    bundle, told, _ = bundle_of(used, focals, sharing=("folder",))
    assert bundle is not None
    assert bundle.bent
    assert told == ""  # all are of one folder, whose zooms differ
    measured = bundle.measured(focals)
    off, before = (np.array([of.focal[d.name] for d in used]) / FOCAL - 1 for of in (measured, focals))
    std = np.array([measured.deviation[d.name] for d in used]) / FOCAL
    assert np.abs(off).max() < 0.03 < 0.1 < np.abs(before).max()
    assert (np.abs(off) < 4 * std).all()
    folders = [dataclasses.replace(d, file=f"{f:g}/{d.name}") for d, f in zip(used, FOCAL, strict=True)]
    told = bundle_of(folders, focals, sharing=("folder",)).told
    assert told.startswith("Each photo has a focal length of its own: --focal plane --shared-focal folder,")


@pytest.mark.slow
def test_a_photo_that_tells_no_focal_length_is_left_out():
    """Most of its corners are elsewhere than the board has them."""
    used, _ = photos(0.1)
    focals = each_apart(used, np.random.default_rng(1))
    strange = used[4].nodes + np.random.default_rng(2).normal(0, 30, used[4].nodes.shape)
    used[4] = dataclasses.replace(used[4], nodes=strange, lines=tuple(GridDetector.lines(strange)))
    bundle = bundle_of(used, focals).bundle
    assert bundle is not None
    assert used[4].name not in bundle.names
    assert len(bundle.names) == len(used) - 1
    assert bundle.straightness is not None  # the rest is determined
    assert bundle.bent
    assert bundle.lost == (used[4].name,)
    measured = bundle.measured(focals)
    assert measured.focal.keys() == {d.name for d in used} - {used[4].name}
    assert "does not determine its focal length" in measured.absent


def test_photos_beside_groups_have_its_focal_lengths_and_those_it_does_not_see_are_named(
    of_bent,
):
    used, _, bundle = of_bent
    names = tuple(d.name for d in used)
    group = FocalGroup(names[:6], 900.0, 50.0, (800.0, 950.0))
    strange = Detection("other.png", "other.png", SIZE, (), None, used[0].nodes[:5])
    focal = dict(zip(names, LABEL.tolist(), strict=True)) | {strange.name: 700.0}
    by_hand = Focals(focal, "px", GRID, "", deviation=dict.fromkeys(focal, 40.0), groups=(group,))
    measured = bundle.measured(by_hand)
    true = dict(zip(names, FOCAL.tolist(), strict=True))
    assert all(measured.focal[name] == pytest.approx(f, rel=0.02) for name, f in true.items())
    assert (measured.focal[strange.name], measured.deviation[strange.name]) == (700.0, 40.0)
    assert [of.names for of in measured.groups] == [group.names]
    told = bundle_of([*used, strange], by_hand).told
    assert told.endswith("too few of its corners: other.png.")
    assert "1 photo keeps the focal length of homographies" in told


def test_a_zoom_whose_focal_length_is_not_determined_has_none(of_bent):
    _, focals, bundle = of_bent
    fit = dataclasses.replace(bundle.fit, focal_std=bundle.fit.focal * jnp.array([0.01, 0.3, 0.01]))
    measured = dataclasses.replace(bundle, fit=fit).measured(focals)
    assert sorted(set(measured.focal.values())) == pytest.approx([1000.0, 2600.0], rel=0.02)


@pytest.mark.slow
def test_given_deviations_hold_for_focal_lengths_of_the_bundle_adjustment_and_photos_without_are_told(
    tmp_path,
):
    used, _ = photos(0.1)
    strange = used[4].nodes + np.random.default_rng(2).normal(0, 8, used[4].nodes.shape)
    used[4] = dataclasses.replace(used[4], nodes=strange)
    for photo in used:
        cv2.imwrite(str(tmp_path / photo.name), np.zeros((8, 8), np.uint8))
    there = [dataclasses.replace(d, file=str(tmp_path / d.name)) for d in used]
    job = ImageJob((tmp_path,), detector="grid", focal="plane", focal_sigma="2%", centre="image")
    done = _calibrated(job, there, lambda _: None, lambda _: None)
    assert done.bundle is not None
    assert "does not determine its focal length" in done.unused["4.png"]
    assert [d.name for d in done.used] == [d.name for d in used if d.name != "4.png"]
    focal = [done.focals.focal[d.name] for d in done.used]  # homographies give others
    assert focal == pytest.approx(np.delete(FOCAL, 4).tolist(), rel=0.05)
    assert done.calibration.focal_sigma.tolist() == pytest.approx([0.02 * f for f in focal])


@pytest.mark.slow
def test_photos_of_one_zoom_that_nobody_knows_tell_the_board_s_shape():
    used, _ = photos(0.1)
    unknown = choose_focals(used[:6], "same")
    bundle = bundle_of(used[:6], unknown).bundle
    assert bundle is not None
    assert bundle.fit.focal.tolist() == pytest.approx([1000.0], rel=0.05)


@pytest.mark.parametrize("centre", ["image", (640.0, 350.0)])
def test_the_bundle_s_centre_is_the_one_asked_for(centre, of_bent):
    used, focals, free = of_bent
    bundle = bundle_of(used, focals, centre).bundle
    assert bundle is not None
    wanted = (639.5, 359.5) if centre == "image" else centre
    assert np.asarray(bundle.fit.lens.centre).tolist() == list(wanted)
    assert np.linalg.norm(np.asarray(free.fit.lens.centre) - wanted) > 2


@pytest.mark.slow
def test_a_board_is_named_after_the_one_focal_length_it_was_seen_at(of_bent):
    _, _, bundle = of_bent
    zooms = len(TRUE)

    def boards(number):
        shape = jnp.repeat(bundle.fit.shape[:1], number.max() + 1, axis=0)
        fit = eqx.tree_at(lambda fit: (fit.board, fit.shape), bundle.fit, (jnp.asarray(number), shape))
        return dataclasses.replace(bundle, fit=fit).of_boards()

    assert boards(zooms - 1 - bundle.number) == [f"f = {f:.0f} px" for f in bundle.fit.focal[::-1]]
    assert boards(0 * bundle.number) == []
    assert boards(np.minimum(bundle.number, zooms - 2)) == []
