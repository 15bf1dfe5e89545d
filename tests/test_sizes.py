"""Lenses for images of another size."""

import numpy as np
import pytest

import zoomjax as zj
from zoomjax.sizes import at_focal


def test_same_size_is_the_same_lens(truth):
    assert zj.lens_for_size(truth, (4288, 2848)) is truth


def test_scaled_lens_corrects_the_scaled_image_alike(truth):
    with pytest.warns(
        UserWarning, match="4288 x 2848 px, and this one has 1072 x 712: its distortion is scaled"
    ):
        quarter = zj.lens_for_size(truth, (1072, 712))
    points = np.array([[0.0, 0.0], [3000.0, 500.0], [4287.0, 2847.0]])
    expected = (np.asarray(truth(30.0).undistort(points)) + 0.5) / 4 - 0.5
    np.testing.assert_allclose(quarter(30.0).undistort((points + 0.5) / 4 - 0.5), expected, atol=1e-9)


@pytest.mark.filterwarnings("ignore:The lens is for images")
def test_rounded_sizes_count_as_the_same_aspect(truth):
    assert zj.lens_for_size(truth, (1000, 664)).image_size == (1000, 664)


@pytest.mark.parametrize("size", [(1920, 1080), (2848, 4288), (4288, 2412)])
def test_other_aspect_explains(truth, size):
    with pytest.raises(ValueError, match="another aspect ratio: it was cropped, turned"):
        zj.lens_for_size(truth, size)


def test_distortion_compiled_is_the_lens_s(truth):
    np.testing.assert_allclose(
        at_focal(truth, np.asarray(30.0)).coefficients, truth(30.0).coefficients, rtol=1e-12
    )


@pytest.mark.filterwarnings("ignore:The lens is for images")
def test_a_centre_that_moves_does_so_in_the_scaled_image(truth):
    shift = zj.PolynomialZoom(0, np.array([[0.01, -0.005]]), np.array(20.0))
    moving = zj.ZoomLens(truth.zoom, truth.centre, truth.focal_range, truth.image_size, shift=shift)
    quarter = zj.lens_for_size(moving, (1072, 712))
    expected = (np.asarray(moving(30.0).centre) + 0.5) / 4 - 0.5
    np.testing.assert_allclose(quarter(30.0).centre, expected, atol=1e-9)
