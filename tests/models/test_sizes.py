"""Lenses for images of another size."""

import copy
import dataclasses
import gc

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import zoomjax as zj
from zoomjax.correct.framing import framing_for_size
from zoomjax.models._known_sizes import _KNOWN, known_size
from zoomjax.models.sizes import at_focal, check_image_size


def test_same_size_is_the_same_lens(truth):
    assert zj.models.lens_for_size(truth, (4288, 2848)) is truth


def test_scaled_lens_corrects_the_scaled_image_alike(truth):
    with pytest.warns(
        UserWarning, match="4288 x 2848 px, and this one has 1072 x 712: its distortion is scaled"
    ):
        quarter = zj.models.lens_for_size(truth, (1072, 712))
    points = np.array([[0.0, 0.0], [3000.0, 500.0], [4287.0, 2847.0]])
    expected = (np.asarray(truth(30.0).undistort(points)) + 0.5) / 4 - 0.5
    np.testing.assert_allclose(quarter(30.0).undistort((points + 0.5) / 4 - 0.5), expected, atol=1e-9)


def test_the_warning_is_about_the_line_that_calls(truth):
    """Whichever function of the package it calls."""
    image, size = np.zeros((712, 1072), np.float32), (1072, 712)
    for call in (
        lambda: zj.models.lens_for_size(truth, size),
        lambda: zj.undistort_image(image, truth, focal=30.0),
        lambda: zj.correct.frame_output(truth, size),
    ):
        with pytest.warns(UserWarning, match="its distortion is scaled") as caught:
            call()
        assert {warning.filename for warning in caught} == {__file__}


@pytest.mark.filterwarnings("ignore:The lens is for images")
def test_rounded_sizes_count_as_the_same_aspect(truth):
    assert zj.models.lens_for_size(truth, (1000, 664)).image_size == (1000, 664)


@pytest.mark.parametrize("size", [(1920, 1080), (2848, 4288), (4288, 2412)])
def test_other_aspect_explains(truth, size):
    with pytest.raises(ValueError, match="another aspect ratio: it was cropped, turned"):
        zj.models.lens_for_size(truth, size)


def test_distortion_compiled_is_the_lens_s(truth):
    np.testing.assert_allclose(
        at_focal(truth, np.asarray(30.0)).coefficients, truth(30.0).coefficients, rtol=1e-12
    )


@pytest.mark.filterwarnings("ignore:The lens is for images")
def test_a_centre_that_moves_does_so_in_the_scaled_image(truth):
    shift = zj.PolynomialZoom(0, np.array([[0.01, -0.005]]), np.array(20.0))
    moving = zj.ZoomLens(truth.zoom, truth.centre, truth.focal_range, truth.image_size, shift=shift)
    quarter = zj.models.lens_for_size(moving, (1072, 712))
    expected = (np.asarray(moving(30.0).centre) + 0.5) / 4 - 0.5
    np.testing.assert_allclose(quarter(30.0).centre, expected, atol=1e-9)


def of_size(*size, scale=None, off=(0.0, 0.0)):
    """A distortion like that of a lens for a size, perhaps with another centre or scale."""
    middle = (np.array(size) - 1) / 2 + np.array(off)
    return zj.Distortion(np.array([0.1]), middle, np.array(scale or np.hypot(*size) / 2))


MADE_FOR_OTHERS = {
    "twice as large": of_size(1280, 960),
    "half as large": of_size(320, 240),
    "a little larger": of_size(670, 502),
    "turned": of_size(480, 640),
    "cut above and below": of_size(640, 800),
    "another aspect": of_size(1920, 1080),
    "twice as large, centre fitted": of_size(1280, 960, off=(21, -35)),
    "half as large, centre fitted": of_size(320, 240, off=(-12, 9)),
    "turned, centre fitted": of_size(480, 640, off=(8, 6)),
}


@pytest.mark.parametrize("case", MADE_FOR_OTHERS)
def test_a_distortion_of_images_of_another_size_is_refused(case):
    """Wherever an image or its size meets a distortion; and nothing is computed."""
    d = MADE_FOR_OTHERS[case]
    calls = [
        lambda: zj.correct.frame_output(d, (640, 480)),
        lambda: zj.correct.frame_output([of_size(640, 480), d], (640, 480), keep="all"),
        lambda: zj.undistort_image(np.zeros((480, 640, 3), np.uint8), d),
        lambda: zj.warp_image(jnp.zeros((480, 640)), d),
    ]
    for call in calls:
        with pytest.raises(
            ValueError, match=r"images of another size: its centre .* but this image of 640 x 480 px"
        ):
            call()


def lens_of(size):
    zoom = zj.PolynomialZoom(1, jnp.array([[0.1], [0.05]]), jnp.array(20.0))
    middle = jnp.array([(size[0] - 1) / 2 + 3, (size[1] - 1) / 2 - 2])
    return zj.ZoomLens(zoom, middle, jnp.array([20.0, 80.0]), size)


TRACED = {
    "lens": lambda call, lens: jax.jit(lambda lens: call(lens(24.0)))(lens),
    "focal length": lambda call, lens: jax.jit(lambda f: call(lens(f)))(24.0),
    "gradient": lambda call, lens: jax.grad(lambda lens: call(lens(24.0)).sum())(lens),
    "vmap": lambda call, lens: jax.vmap(lambda f: call(lens(f)))(jnp.array([24.0, 50.0])),
    "scan": lambda call, lens: jax.lax.scan(
        lambda lens, f: (lens, call(lens(f))), lens, jnp.array([24.0, 50.0])
    ),
    "lens of another size": lambda call, lens: jax.jit(
        lambda lens: call(zj.models.lens_for_size(lens, (320, 240))(24.0))
    )(lens_of((640, 480))),
}


@pytest.mark.filterwarnings("ignore:The lens is for images")
@pytest.mark.parametrize("case", TRACED)
def test_the_lens_of_traced_values_refuses_images_of_another_size(case):
    """Its size is known nevertheless; its own images, and framings made by hand, are taken."""
    lens, trace = lens_of((320, 240)), TRACED[case]
    own, other, turned = jnp.zeros((240, 320)), jnp.zeros((120, 160)), jnp.zeros((320, 240))
    trace(lambda d: zj.warp_image(own, d), lens)
    for image in (other, turned):
        with pytest.raises(ValueError, match="is for images of another size"):
            trace(lambda d, image=image: zj.warp_image(image, d), lens)
    framing = zj.Framing(jnp.ones(()), jnp.zeros(2), (160, 120))
    trace(lambda d: zj.warp_image(other, d, framing=framing), lens)


def test_a_distortion_changed_by_hand_is_taken_for_any_size():
    """As for crops: only what a lens returned, as it is, is known to be for a size."""
    corner, d = jnp.array([100.0, 60.0]), lens_of((320, 240))(24.0)
    assert known_size(d) == (320, 240)
    assert known_size(copy.deepcopy(d)) is None

    @jax.jit
    def cropped(lens, crop):
        d = lens(24.0)
        d = zj.Distortion(d.coefficients, d.centre - corner, d.scale)
        assert known_size(d) is None
        return zj.warp_image(crop, d)

    assert cropped(lens_of((320, 240)), jnp.zeros((120, 160))).shape == (120, 160)


def test_sizes_are_known_as_long_as_what_they_are_of():
    gc.collect()
    before, d = len(_KNOWN), [lens_of((320, 240))(f) for f in (24.0, 50.0)]
    assert len(_KNOWN) == before + 2
    del d
    gc.collect()
    assert len(_KNOWN) == before


def test_distortions_of_lenses_go_with_others():
    lens, by_hand = lens_of((320, 240)), zj.Distortion(jnp.zeros(1), jnp.zeros(2), jnp.array(200.0))
    mixed = jax.tree.map(lambda a, b: a + b, lens(24.0), by_hand)
    assert known_size(mixed) is None
    assert float(mixed.scale) == 400.0
    chosen = jax.jit(lambda lens, first: jax.lax.cond(first, lambda: lens(24.0), lambda: by_hand))
    np.testing.assert_allclose(chosen(lens, True).coefficients, lens(24.0).coefficients)
    assert (
        float(jax.lax.scan(lambda d, f: (lens(f), d.scale), by_hand, jnp.array([24.0, 50.0]))[0].scale)
        == 200
    )


OWN = {
    "in the middle": of_size(640, 480),
    "rounded": of_size(640, 480, scale=401.0),
    "centre fitted": of_size(640, 480, off=(40, -30)),
    "centre far off": of_size(640, 480, off=(150, 0)),
    "scale of a focal length": of_size(640, 480, scale=1500.0, off=(9, -14)),
    "scale of one pixel": of_size(640, 480, scale=1.0, off=(9, -14)),
    "middle of a larger image": of_size(640, 480, scale=800.0),
}


@pytest.mark.parametrize("case", OWN)
def test_a_distortion_that_may_be_of_the_image_is_taken(case):
    check_image_size(OWN[case], (640, 480))


@given(
    width=st.integers(16, 8000),
    aspect=st.floats(0.4, 2.5),
    ratio=st.floats(0.05, 20).filter(lambda r: abs(r - 1) > 0.1),
    off=st.tuples(st.floats(-0.02, 0.02), st.floats(-0.02, 0.02)),
)
def test_photographic_lenses_are_told_apart_by_size(width, aspect, ratio, off):
    """The centre within 2 % of the half diagonal of the middle: its own size is taken, others are not."""
    size = (width, max(8, round(width * aspect)))
    half = np.hypot(*size) / 2
    d = of_size(*size, off=np.array(off) * half)
    check_image_size(d, size)
    with pytest.raises(ValueError, match="is for images of another size"):
        check_image_size(d, (max(1, round(ratio * size[0])), max(1, round(ratio * size[1]))))


def test_a_crop_is_taken_with_a_framing_of_your_own():
    """The upper left quarter of an image, with the whole's distortion: it looks like another size's."""
    d, image = of_size(64, 48), np.arange(48 * 64, dtype=np.float32).reshape(48, 64)
    quarter = zj.Framing(np.array(1.0), np.zeros(2), (32, 24))
    whole = zj.undistort_image(image, d)
    np.testing.assert_allclose(
        zj.undistort_image(image[:24, :32], d, keep=quarter)[4:20, 4:20], whole[4:20, 4:20], rtol=1e-5
    )
    warped = zj.warp_image(jnp.asarray(image[:24, :32]), d, framing=quarter)
    np.testing.assert_allclose(warped[4:20, 4:20], whole[4:20, 4:20], rtol=1e-2)


def test_a_framing_for_another_size_is_refused_and_scaled_for_photos():
    d, image = of_size(64, 48), np.zeros((48, 64), np.float32)
    other = zj.correct.frame_output(of_size(128, 96), (128, 96), keep="all")
    for call in (
        lambda: zj.undistort_image(image, d, keep=other),
        lambda: zj.warp_image(jnp.asarray(image), d, framing=other),
    ):
        with pytest.raises(ValueError, match=r"a framing for images of 64 x 48 px, .* made for 128 x 96"):
            call()
    scaled = framing_for_size(other, (64, 48))
    assert (scaled.size, scaled.image_size, float(scaled.scale)) == ((64, 48), (64, 48), float(other.scale))
    shown = np.asarray(other.corrected(np.array([[-0.5, -0.5], [127.5, 95.5]])))
    corners = np.asarray(scaled.corrected(np.array([[-0.5, -0.5], [63.5, 47.5]])))
    np.testing.assert_allclose((corners + 0.5) * 2 - 0.5, shown, atol=1e-9)
    with pytest.raises(ValueError, match="another aspect ratio"):
        framing_for_size(other, (64, 64))


def small_lens():
    zoom = zj.PolynomialZoom(1, jnp.array([[0.02], [0.1]]), jnp.array(20.0))
    return zj.ZoomLens(zoom, jnp.array([63.5, 47.5]), jnp.array([20.0, 80.0]), (128, 96))


def test_focal_lengths_in_px_stay_those_of_the_lens_and_this_is_said():
    whole = dataclasses.replace(small_lens(), focal_unit="px")
    with pytest.warns(UserWarning, match=r"is scaled to them\. Its focal lengths stay .* 128.* px wide"):
        half = zj.models.lens_for_size(whole, (64, 48))
    with pytest.warns(UserWarning, match=r"is scaled to them\. Its focal lengths stay .* 128.* px wide"):
        zj.models.lens_for_size(half, (32, 24))
    with pytest.warns(UserWarning, match=r"is scaled to them\.$"):
        zj.models.lens_for_size(small_lens(), (64, 48))


def test_a_lens_takes_its_size_along():
    truth, size = small_lens(), (64, 48)
    image = np.zeros((48, 64), np.float32)
    with pytest.warns(UserWarning, match="its distortion is scaled"):
        quarter = zj.models.lens_for_size(truth, size)
    with pytest.warns(UserWarning, match="its distortion is scaled"):
        framing = zj.correct.frame_output(truth, size, keep="valid")
    assert float(framing.scale) == float(zj.correct.frame_output(quarter, size, keep="valid").scale)
    image[::8] = 1
    with pytest.warns(UserWarning, match="its distortion is scaled"):
        corrected = zj.undistort_image(image, truth, focal=30.0)
    np.testing.assert_array_equal(corrected, zj.undistort_image(image, quarter(30.0)))
    for call in (
        lambda: zj.undistort_image(np.zeros((64, 64)), truth, focal=30.0),
        lambda: zj.correct.frame_output(truth, (64, 64)),
    ):
        with pytest.raises(ValueError, match="another aspect ratio"):
            call()


@pytest.mark.parametrize("shape", [(3, 48, 64), (1, 48, 64), (4, 48, 64)])
def test_channels_first_are_refused(shape):
    d = of_size(64, 48)
    for call in (
        lambda: zj.undistort_image(np.zeros(shape, np.uint8), d),
        lambda: zj.warp_image(jnp.zeros(shape), d),
        lambda: jax.jit(zj.warp_image)(jnp.zeros(shape), d),
        lambda: jax.vmap(lambda image: zj.warp_image(image, d))(jnp.zeros((2, *shape))),
    ):
        with pytest.raises(ValueError, match=r"channels last, .* Move the axis: jnp\.moveaxis"):
            call()
    assert zj.undistort_image(np.zeros((4, 64, 3), np.uint8), of_size(64, 4)).shape == (4, 64, 3)


@pytest.mark.usefixtures("unchecked")
def test_something_else_for_a_distortion_says_what_to_call():
    truth, image = small_lens(), np.zeros((96, 128), np.uint8)
    with pytest.raises(ValueError, match="focal must be given with a ZoomLens"):
        zj.undistort_image(image, truth)
    with pytest.raises(ValueError, match="focal must be left out unless"):
        zj.undistort_image(image, truth(30.0), focal=30.0)
    with pytest.raises(ValueError, match=r"must be a Distortion, but it is a ZoomLens: give lens\(focal\)"):
        zj.warp_image(jnp.asarray(image), truth)
    several = jax.vmap(truth)(jnp.array([30.0, 40.0]))
    for call, name in (
        (lambda d: zj.undistort_image(image, d), "distortion"),
        (lambda d: zj.warp_image(jnp.asarray(image), d), "distortion"),
        (lambda d: zj.correct.frame_output(d, (128, 96)), "distortions"),
        (lambda d: zj.correct.frame_output([d], (128, 96)), "distortions"),
    ):
        with pytest.raises(
            ValueError, match=rf"{name} must be .* it is a PolynomialZoom: .* fit\.lens\(focal\)"
        ):
            call(truth.zoom)
        with pytest.raises(ValueError, match=f"{name} must be a Distortion, but it is several at once"):
            call(several)
