"""Framings: what is kept, at which scale, alone and over a zoom range."""

import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.correct._inverse_polynomial import fold_radius

SIZE = (192, 108)


def bent(*k, centre=(95.5, 53.5)):
    return zj.Distortion(jnp.array(k), jnp.array(centre), jnp.array(np.hypot(*SIZE) / 2))


LENSES = [
    bent(0.2, 0.05),
    bent(-0.1, 0.02),
    bent(0.1, -0.15),
    bent(-0.15, centre=(80.0, 60.0)),
    bent(-0.32),
]


def border():
    x, y = np.meshgrid(np.linspace(0, 191, 800), np.linspace(0, 107, 500))
    edge = (x == 0) | (x == 191) | (y == 0) | (y == 107)
    return np.stack([x[edge], y[edge]], axis=-1)


@pytest.mark.parametrize("d", LENSES)
@pytest.mark.parametrize("size", [None, (100, 100)])
def test_all_shows_all_and_no_more(d, size):
    framing = zj.correct.frame_output(d, SIZE, keep="all", size=size)
    shown = (np.asarray(d.undistort(border())) - framing.origin) * framing.scale
    last = np.array(framing.size) - 1
    assert (shown >= -1e-3).all()
    assert (shown <= last + 1e-3).all()
    spare = np.concatenate([shown.min(0), last - shown.max(0)])
    assert np.sum(abs(spare) < 1e-3) >= 2  # it touches two opposite sides


@pytest.mark.parametrize("d", LENSES)
@pytest.mark.parametrize("size", [None, (60, 100)])
def test_valid_shows_the_image_only_and_as_much_as_it_can(d, size):
    framing = zj.correct.frame_output(d, SIZE, keep="valid", size=size)
    image = np.full(SIZE[::-1], 250, np.uint8)
    assert (zj.undistort_image(image, d, keep=framing) == 250).all()
    middle = np.asarray(framing.corrected((np.array(framing.size) - 1) / 2))
    wider = zj.Framing(
        np.asarray(framing.scale * 0.97), middle - (middle - framing.origin) / 0.97, framing.size
    )
    assert (zj.undistort_image(image, d, keep=wider) < 250).any()


def test_same_is_the_input_and_crops_about_the_middle():
    framing = zj.correct.frame_output(LENSES[0], SIZE)
    assert framing.scale == 1
    assert framing.size == SIZE
    np.testing.assert_array_equal(framing.origin, [0, 0])
    cropped = zj.correct.frame_output(LENSES[0], SIZE, size=(92, 58))
    np.testing.assert_array_equal(cropped.origin, [50, 25])


@pytest.mark.parametrize("keep", ["all", "valid"])
def test_one_framing_for_a_zoom_range_is_the_tightest_of_each(truth, keep):
    common = zj.correct.frame_output(truth, truth.image_size, keep=keep)
    focal = 1 / np.linspace(1 / 20.56, 1 / 127.36, 65)
    each = [
        zj.correct.frame_output(truth(f), truth.image_size, keep=keep).scale
        for f in np.clip(focal, 20.56, 127.36)
    ]
    worst = min(each) if keep == "all" else max(each)
    np.testing.assert_allclose(common.scale, worst, rtol=1e-9)
    assert max(each) - min(each) > 0.05
    listed = zj.correct.frame_output([truth(25.0), truth(100.0)], truth.image_size, keep=keep)
    assert common.scale <= listed.scale if keep == "all" else common.scale >= listed.scale


def test_fold_bounds_what_counts():
    d = bent(-0.6)
    framing = zj.correct.frame_output(d, SIZE, keep="valid")
    shown = np.stack(np.meshgrid(*map(np.arange, SIZE)), axis=-1)
    assert np.isfinite(np.asarray(d.distort(framing.corrected(shown)))).all()
    np.testing.assert_allclose(fold_radius(d), d.monotone_radius, rtol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((LENSES[0], (0, 10), "same"), "image_size must be two positive integers"),
        ((LENSES[0], SIZE, "some"), "keep must be"),
        (([], SIZE, "all"), "must hold at least one distortion"),
        ((bent(-8.0, centre=(0.0, 0.0)), SIZE, "valid"), "no common part"),
    ],
)
def test_bad_arguments(arguments, message):
    distortions, size, keep = arguments
    with pytest.raises(ValueError, match=message):
        zj.correct.frame_output(distortions, size, keep=keep)


@pytest.mark.parametrize("size", [(1, 64), (64, 1), (1, 1)])
def test_all_of_images_one_pixel_wide(size):
    """They have no width between the centres of their pixels."""
    d = zj.Distortion(jnp.array([0.05]), (jnp.array(size) - 1) / 2, jnp.array(40.0))
    framing = zj.correct.frame_output(d, size, keep="all")
    assert np.isfinite(framing.scale)
    assert np.isfinite(framing.origin).all()
    shown = zj.undistort_image(np.full(size[::-1], 9, np.uint8), d, keep="all")
    assert (shown[0] if isinstance(shown, tuple) else shown).shape == size[::-1]


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("scale", 0, "scale must be finite and positive"),
        ("scale", -1.0, "scale must be finite and positive"),
        ("scale", np.nan, "scale must be finite and positive"),
        ("scale", "1", "scale must hold real numbers"),
        ("scale", (1, 1), r"scale must have shape \(\)"),
        ("origin", 0, "origin must have shape"),
        ("origin", (1,), "origin must have shape"),
        ("origin", (0, 0, 0), "origin must have shape"),
        ("origin", (np.nan, 0), "origin must be finite"),
        ("origin", ("a", "b"), "origin must hold real numbers"),
        ("size", 64, "size must be two positive integers"),
        ("size", (0, 48), "size must be two positive integers"),
        ("size", ("64", "48"), "size must be two positive integers"),
        ("image_size", (64, -48), "image_size must be two positive integers"),
    ],
)
def test_what_is_no_window_is_refused(name, value, told):
    """A scale of 0 gave a black image, -1 one that is turned, an origin (1,) another part: no word."""
    given = {"scale": 1.0, "origin": [0, 1], "size": [64, 48]}
    assert zj.Framing(**given).size == (64, 48)
    with pytest.raises(ValueError, match=f"Argument {told}"):
        zj.Framing(**given | {name: value})


def test_an_image_beyond_all_memory_is_refused():
    """XLA ended the process."""
    distortion = zj.Distortion(np.array([0.1]), np.array([31.5, 23.5]), np.array(40.0))
    framing = zj.Framing(1.0, (0, 0), (10**9, 10**9))
    with pytest.raises(ValueError, match="Argument framing must show an image that fits into memory"):
        zj.warp_image(jnp.zeros((48, 64)), distortion, framing=framing)
