"""One value for zoom model, number of coefficients and distortion model, in every fit that takes one."""

import jax
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.models import BrownConrady, Division, Model

from ..conftest import LAST_BITS

ASKED = Model(zj.PolynomialZoom(degree=1), terms=1, distortion_model=Division())


@pytest.fixture(scope="module")
def lines():
    lens = zj.scenes.nikkor_18_200()
    return zj.scenes.board_lines(lens, zj.scenes.focal_sweep(4), spacing=200.0, noise=0.2)


def same(one, other):
    for first, second in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(np.asarray(first), np.asarray(second), rtol=LAST_BITS, atol=LAST_BITS)


@pytest.mark.parametrize(
    ("fit", "small"),
    [
        (zj.fit_zoom, zj.fit.compress_for),
        (zj.fit_robust, zj.fit.compress_for),
        (zj.fit.fit_centre, None),
        (zj.fit.reject_points, None),
    ],
    ids=["fit_zoom", "fit_robust", "fit_centre", "reject_points"],
)
def test_a_model_is_the_same_as_its_parts(lines, fit, small):
    data = lines if small is None else small(lines, ASKED.distortion_model)
    apart = fit(data, zoom=ASKED.zoom, terms=ASKED.terms, distortion_model=ASKED.distortion_model)
    same(fit(data, zoom=ASKED), apart)


def test_held_out_lines_of_a_model(lines):
    small = zj.compress(lines)
    whole = zj.trust.cross_validate_zoom(small, zoom=Model(zj.PolynomialZoom(degree=1), 1))
    np.testing.assert_array_equal(
        whole, zj.trust.cross_validate_zoom(small, zoom=zj.PolynomialZoom(1), terms=1)
    )


@pytest.mark.parametrize(
    "more", [{"terms": 1}, {"distortion_model": Division()}], ids=["terms", "distortion_model"]
)
@pytest.mark.parametrize("fit", [zj.fit_zoom, zj.fit_robust, zj.fit.fit_centre, zj.fit.reject_points])
def test_what_a_model_says_is_not_said_again(lines, fit, more):
    with pytest.raises(ValueError, match=r"Argument zoom is a Model, .*leave out"):
        fit(lines, zoom=ASKED, **more)


def test_the_model_of_a_lens_is_fitted_to_other_lines(lines):
    fit = zj.fit_zoom(zj.fit.compress_for(lines, Division()), zoom=ASKED)
    model = fit.lens.model
    assert (model.name, model.terms, model.num_coefficients) == (ASKED.name, 1, 1)
    again = zj.fit_zoom(lines, zoom=model.with_parameters(None))
    assert again.lens.distortion_model == Division()
    np.testing.assert_allclose(again.lens.zoom.parameters, fit.lens.zoom.parameters, rtol=1e-3)


def test_its_number_of_coefficients_is_that_of_parameters():
    fitted = zj.PolynomialZoom(degree=1, parameters=np.zeros((2, 5)), focal_ref=24.0)
    assert Model(fitted, distortion_model=BrownConrady()).terms == 3
    assert Model(zj.PolynomialZoom()).terms == 2
    with pytest.raises(ValueError, match="parameters of zoom are for 3"):
        Model(fitted, 2, BrownConrady())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((zj.PolynomialZoom,), "Argument zoom must be a zoom model"),
        ((zj.PolynomialZoom(), 2, Division), "Argument distortion_model must be"),
        ((2,), "Argument zoom must be a zoom model"),
    ],
    ids=["a class", "a class of a distortion model", "a number"],
)
def test_what_is_no_model_is_refused(arguments, message):
    with pytest.raises(TypeError, match=message):
        Model(*arguments)


def test_it_has_no_more_coefficients_than_the_distortion_model():
    with pytest.raises(ValueError, match="terms"):
        Model(zj.PolynomialZoom(), 9)
