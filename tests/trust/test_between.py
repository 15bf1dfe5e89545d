"""What is said of the zoom between two or three focal lengths."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import zoomjax as zj
from zoomjax import scenes
from zoomjax.fit.distortion_models import compress_for
from zoomjax.trust.assessment import assess
from zoomjax.trust.between import deviation_between, zoom_places

SIZE = (1072, 712)
NOISE = 0.1


@pytest.fixture(scope="module")
def lens():
    return scenes.nikkor_18_200(SIZE)


def lines_at(lens, *focal):
    return scenes.board_lines(lens, np.array(focal), spacing=24.0, noise=NOISE)


def fitted(lines, zoom):
    return zj.fit_zoom(zj.compress(lines), zoom=zoom)


def said(lines, fit):
    return {finding.about: finding for finding in assess(lines, fit).findings}


@given(st.lists(st.floats(1.0, 1e4), min_size=1, max_size=20))
def test_places_are_a_twentieth_apart_and_every_focal_length_is_at_one(focal):
    places = zoom_places(np.array(focal))
    assert (places[1:] > 1.05 * places[:-1]).all()
    assert set(places) <= set(focal)
    assert all(((places <= f) & (f <= 1.05 * places)).any() for f in focal)


def test_photos_of_one_zoom_are_at_one_place():
    focal = np.array([24.0, 24.3, 23.8, 70.0, 71.0, 69.0])
    np.testing.assert_array_equal(zoom_places(focal), [23.8, 69.0])


@pytest.mark.slow
def test_a_line_of_inverse_focal_length_is_not_good_between_two(lens):
    """The lens is far from it there, by about as much as is said."""
    lines = lines_at(lens, 21.0, 120.0)
    fit = fitted(lines, zj.PolynomialZoom(degree=1))
    found = said(lines, fit)["few focal lengths"]
    assert found.verdict == "doubtful"
    assert "at 2 focal lengths only" in found.found
    deviation, focal = deviation_between(fit.lens, zoom_places(lines.focal))
    corner = np.zeros(2)
    off = np.linalg.norm(fit.lens(focal).undistort(corner) - lens(focal).undistort(corner))
    assert 21.0 < focal < 120.0
    assert deviation < off < 5 * deviation  # a corner moves by more than the RMS over the image


def test_what_is_said_does_not_depend_on_the_unit_of_focal_lengths(lens):
    lines = lines_at(lens, 21.0, 120.0)
    in_px = eqx.tree_at(lambda of: of.focal, lines, 150 * lines.focal)
    own, other = (
        deviation_between(fitted(of, zj.PolynomialZoom(degree=1)).lens, zoom_places(of.focal))
        for of in (lines, in_px)
    )
    assert other[0] == pytest.approx(own[0], rel=1e-6)
    assert other[1] == pytest.approx(150 * own[1], rel=1e-9)


@pytest.mark.slow
def test_bands_of_the_prior_are_told_in_its_place(lens):
    lines = lines_at(lens, 21.0, 120.0)
    found = said(lines, fitted(lines, zj.SmoothZoom()))
    assert "few focal lengths" not in found
    assert found["bands"].verdict != "good"
    assert "Between these 2 focal lengths" in found["bands"].advice


def test_halves_of_a_few_photos_are_as_far_apart_as_the_prior_expects(lens):
    """Each sees one or two focal lengths: that they differ between says nothing against the photos."""
    lines = lines_at(lens, 21.0, 60.0, 120.0)
    assert "halves by frames" not in said(lines, fitted(lines, zj.SmoothZoom()))


@pytest.mark.parametrize("focal", [(24.0, 25.0), (21.0, 35.0, 60.0, 120.0), (24.0,)])
def test_nothing_is_said_where_little_lies_between(lens, focal):
    """Two that are one place; four, of which some can be left out; one."""
    lines = lines_at(lens, *focal)
    degree = min(1, len(focal) - 1)
    assert "few focal lengths" not in said(lines, fitted(lines, zj.PolynomialZoom(degree=degree)))


def test_a_lens_as_the_prior_has_it_is_off_by_its_spread_alone(lens):
    """The deviation of a `SmoothZoom` fitted to the places is near its own standard deviation."""
    lines = lines_at(lens, 21.0, 120.0)
    fit = fitted(lines, zj.SmoothZoom())
    deviation, focal = deviation_between(fit.lens, zoom_places(lines.focal))
    sides = (np.linspace(0, side - 1, 9) for side in SIZE)
    points = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
    std = np.asarray(zj.trust.displacement_std(fit, jnp.asarray(points), focal=np.full(81, focal)))
    assert deviation == pytest.approx(np.sqrt(np.mean(std**2)), rel=0.3)


def test_other_distortion_models_are_judged_alike(lens):
    lines = lines_at(lens, 21.0, 120.0)
    by_distortion_model = [
        deviation_between(
            zj.fit_zoom(compress_for(lines, distortion_model, terms=terms), zoom=model).lens,
            zoom_places(lines.focal),
        )[0]
        for distortion_model, terms in ((zj.models.RadialPolynomial(), 2), (zj.models.Division(), 2))
        for model in [zj.models.Model(zj.PolynomialZoom(degree=1), terms, distortion_model)]
    ]
    assert by_distortion_model[1] == pytest.approx(by_distortion_model[0], rel=0.3)


@pytest.mark.slow
def test_a_prior_for_other_lenses_is_doubtful(lens):
    """That of the division model is that of the polynomial to first order."""
    lines = lines_at(lens, 21.0, 120.0)
    model = zj.models.Model(zj.SmoothZoom(), 2, zj.models.Division())
    fit = zj.fit_zoom(compress_for(lines, zj.models.Division(), terms=2), zoom=model)
    found = assess(lines, fit)
    assert {finding.about: finding.verdict for finding in found.findings}["few focal lengths"] == "doubtful"


def test_points_beyond_a_fold_do_not_count(lens):
    """A lens that folds within the image at its shortest focal length."""
    strong = eqx.tree_at(lambda lens: lens.zoom.parameters, lens, -20 * lens.zoom.parameters)
    assert np.isnan(np.asarray(strong(20.56).undistort(np.zeros(2)))).any()
    deviation, focal = deviation_between(strong, np.array([20.56, 120.0]))
    assert 0 < deviation < np.inf
    assert 20.56 <= focal <= 120.0
