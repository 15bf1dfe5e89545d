"""What `fit_boards` is given that means nothing, and a photo that is of something else."""

import numpy as np
import pytest

from tests._boards import LABEL, SIZE, bent, seen_through, true_lens
from zoomjax.fit import RESULTS, fit_boards
from zoomjax.fit._board_start import ordered

pytestmark = pytest.mark.usefixtures("unchecked")


@pytest.fixture(scope="module")
def grids():
    return seen_through(true_lens(), bent(), np.repeat([1000.0, 1600.0, 2600.0], 6))[0]


def masked(grid):
    return np.ma.masked_array(grid, grid > 300)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"centre": "imgae"}, 'centre must be "fit", "image" or two'),
        ({"centre": None}, 'centre must be "fit", "image" or two'),
        ({"centre": True}, 'centre must be "fit", "image" or two'),
        ({"centre": (600.0,)}, 'centre must be "fit", "image" or two'),
        ({"centre": (np.nan, 3.0)}, 'centre must be "fit", "image" or two'),
        ({"centre": ("a", "b")}, 'centre must be "fit", "image" or two'),
        ({"smooth": 0}, "smooth must be a finite number above 0"),
        ({"smooth": -0.01}, "smooth must be a finite number above 0"),
        ({"smooth": np.nan}, "smooth must be a finite number above 0"),
        ({"smooth": "0.1"}, "smooth must be a finite number above 0"),
        ({"board": np.where(LABEL == 1, 0, 2)}, "with none left out"),
        ({"board": np.ones(18, int)}, "with none left out"),
        ({"grids": masked}, "grids is a masked array"),
        ({"grids": lambda grids: [masked(grid) for grid in grids]}, "grids is a masked array"),
    ],
)
def test_what_means_nothing_is_refused(grids, options, words):
    change = options.get("grids", lambda grids: grids)
    rest = {name: value for name, value in options.items() if name != "grids"}
    with pytest.raises(ValueError, match=words):
        fit_boards(change(grids), LABEL, image_size=SIZE, **rest)


def test_a_centre_outside_of_the_image_is_said(grids):
    outside = pytest.warns(UserWarning, match="is outside of the image")
    with outside, pytest.raises(ValueError, match="smooth"):
        fit_boards(grids, LABEL, image_size=SIZE, centre=(5000.0, 3.0), smooth=-1)


def scrambled(grids, seed):
    """The corners of one photo are those of others."""
    rng = np.random.default_rng(seed)
    noisy = grids + rng.normal(0, 0.1, grids.shape)
    noisy[3] = noisy[3].reshape(-1, 2)[rng.permutation(48)].reshape(noisy[3].shape)
    return noisy


@pytest.mark.slow
def test_a_photo_of_something_else_does_not_look_the_best(grids):
    """Its few corners that lie near the model by chance had the least RMS of all photos."""
    fit = fit_boards(scrambled(grids, 3), LABEL, image_size=SIZE)
    assert RESULTS[fit.fit.result] == ""
    assert np.flatnonzero(np.isnan(fit.fit.frame_rms)).tolist() == [3]
    assert np.isnan(np.asarray(fit.poses.residual)[3]).all()
    assert np.isnan(np.asarray(fit.poses.rotation)[3]).all()
    assert np.isfinite(np.asarray(fit.poses.rotation)[4]).all()
    assert np.isfinite(fit.fit.rms)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_a_photo_of_something_else_does_little(grids, seed):
    """It spoilt the start of its zoom: 87 ± 2 px for 1000, with all of its corners outliers."""
    fit = fit_boards(scrambled(grids, seed), LABEL, image_size=SIZE)
    assert fit.fit.result != RESULTS.undetermined
    np.testing.assert_allclose(fit.focal, [1000, 1600, 2600], rtol=0.01)


@pytest.mark.slow
def test_a_zoom_of_which_nothing_fits_has_no_focal_length(grids):
    """Where all of its photos show something else."""
    noisy = grids.copy()
    for photo in range(6):
        noisy[photo] = scrambled(grids[photo : photo + 1].repeat(4, 0), photo)[3]
    fit = fit_boards(noisy, LABEL, image_size=SIZE)
    assert np.isposinf(np.asarray(fit.focal_std)[0])
    assert RESULTS[fit.fit.result] == RESULTS[RESULTS.undetermined]


def test_photos_that_show_a_grid(grids):
    some = scrambled(grids, 0)[:6]
    some[4, 2:] = np.nan
    assert ordered(some).tolist() == [True, True, True, False, True, True]
    assert ordered(some[3:4]).tolist() == [True]  # there is nothing better
