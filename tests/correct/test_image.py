"""Corrected images against exact maps, OpenCV's own camera, and lines that must come out straight."""

import warnings

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax.correct._inverse_polynomial import TOLERANCE, fit_inverse
from zoomjax.correct.image import position_map
from zoomjax.correct.maps import OUTSIDE, Plane

SIZE = (192, 108)


def bent(*k, size=SIZE, centre=None):
    centre = (np.array(size) - 1) / 2 if centre is None else np.array(centre, float)
    return zj.Distortion(jnp.array(k), jnp.array(centre), jnp.array(np.hypot(*size) / 2))


BARREL, PINCUSHION, TINY = bent(0.2, 0.05), bent(-0.1, 0.02), bent(0.3, -0.1, size=(6, 4), centre=(3, 1))


def exact_map(distortion, framing):
    pixels = np.stack(np.meshgrid(*map(np.arange, framing.size)), axis=-1).astype(float)
    return np.asarray(distortion.distort(framing.corrected(pixels)))


def smooth(rng, shape, dtype=np.uint8):
    """A random image, blurred so that it can be interpolated."""
    values = cv2.GaussianBlur(rng.uniform(size=shape).astype(np.float32), (0, 0), 2).reshape(shape)
    values = (values - values.min()) / np.ptp(values)
    top = 1 if np.dtype(dtype).kind == "f" else np.iinfo(dtype).max
    return (values.astype(np.float64) * top).astype(dtype)


def bilinear(image, where):
    """The textbook's formula in float64; zero outside."""
    padded = np.pad(image, ((1, 2), (1, 2), (0, 0)))
    x, y = (np.clip(where[..., i], -1, image.shape[1 - i]) + 1 for i in (0, 1))
    i, j = x.astype(int), y.astype(int)
    fx, fy = (x - i)[..., None], (y - j)[..., None]
    above = padded[j, i] * (1 - fx) + padded[j, i + 1] * fx
    below = padded[j + 1, i] * (1 - fx) + padded[j + 1, i + 1] * fx
    return above * (1 - fy) + below * fy


@pytest.mark.parametrize("keep", ["same", "all", "valid"])
@pytest.mark.parametrize("size", [None, (7, 3)])
def test_half_pixel_convention_on_asymmetric_image(rng, keep, size):
    image = rng.integers(0, 255, (4, 6)).astype(np.float32)
    framing = zj.correct.frame_output(TINY, (6, 4), keep=keep, size=size)
    expected = cv2.remap(
        image, exact_map(TINY, framing).astype(np.float32), None, cv2.INTER_LINEAR, borderValue=9
    )
    result = zj.undistort_image(image, TINY, keep=keep, size=size, border_value=9)
    np.testing.assert_allclose(result, expected, atol=0.05)


def test_one_bright_pixel_goes_where_undistort_sends_it():
    d = bent(0.3, size=(61, 41), centre=(20, 25))
    image = np.zeros((41, 61), np.float32)
    image[10, 50] = 1
    result = zj.undistort_image(image, d)
    y, x = np.mgrid[:41, :61]
    centroid = [(result * x).sum() / result.sum(), (result * y).sum() / result.sum()]
    np.testing.assert_allclose(centroid, d.undistort(jnp.array([50.0, 10.0])), atol=0.1)


def test_no_distortion_changes_nothing(rng):
    image = rng.integers(0, 255, (108, 192, 3)).astype(np.uint8)
    np.testing.assert_array_equal(zj.undistort_image(image, bent(0.0, 0.0)), image)


@pytest.mark.parametrize("channels", [(), (1,), (2,), (3,), (4,), (7,)])
@pytest.mark.parametrize(
    "dtype", [np.uint8, np.uint16, np.int16, np.float32, np.float64, np.int8, np.int32, np.float16]
)
def test_depths_and_channels(rng, dtype, channels):
    shape = (108, 192, *channels)
    image = np.stack([smooth(rng, shape[:2], dtype) for _ in range(int(np.prod(channels)))], axis=-1)
    image = image.reshape(shape)
    framing = zj.correct.frame_output(BARREL, SIZE)
    where = exact_map(BARREL, framing)
    expected = bilinear(image.reshape(108, 192, -1).astype(np.float64), where).reshape(shape)
    result = zj.undistort_image(image, BARREL)
    assert result.dtype == dtype
    assert result.shape == shape
    full = 1 if np.dtype(dtype).kind == "f" else float(np.iinfo(dtype).max)
    # OpenCV rounds positions to 1/32 px for float64, in which those of 32 bits are computed, too.
    slack = 1e-2 if dtype in (np.float64, np.int32) else 1e-3
    slack = slack * full + (0 if np.dtype(dtype).kind == "f" else 1)
    assert np.abs(result.astype(np.float64) - expected).max() <= slack


def test_boolean_masks_and_strided_views(rng):
    mask = smooth(rng, (108, 192)) > 128
    expected = zj.undistort_image(mask.astype(np.float32), BARREL) >= 0.5
    result = zj.undistort_image(mask, BARREL)
    assert result.dtype == bool
    assert (result != expected).mean() < 1e-3
    image = smooth(rng, (216, 192, 3))
    np.testing.assert_array_equal(
        zj.undistort_image(image[::2, :, ::-1], BARREL),
        zj.undistort_image(image[::2].copy(), BARREL)[..., ::-1],
    )


@pytest.mark.parametrize(
    "value", [True, np.True_, [True, False, True], [1, True, 0], "9", "white", None, 1j]
)
@pytest.mark.parametrize("function", ["undistort_image", "redistort_image"])
@pytest.mark.usefixtures("unchecked")
def test_a_border_value_that_is_no_number_is_refused(function, value):
    """True counted as 1, and "9" as 9."""
    image = np.zeros((4, 6, 3), np.uint8)
    with pytest.raises(
        ValueError, match="Argument border_value must be one number, or one for each of the 3"
    ):
        getattr(zj if function == "undistort_image" else zj.correct, function)(
            image, TINY, border_value=value
        )


@pytest.mark.parametrize("focal", [1e-30, 1e-6])
@pytest.mark.parametrize("function", ["undistort_image", "redistort_image"])
def test_coefficients_that_overflow_are_refused(function, focal):
    """As of focal lengths next to zero: the error was LAPACK's, or the image was black."""
    lens = zj.scenes.nikkor_18_200(SIZE).extended(1e-30, 100.0)
    lens = eqx.tree_at(lambda of: of.zoom.parameters, lens, 1e300 * np.asarray(lens.zoom.parameters))
    call = getattr(zj if function == "undistort_image" else zj.correct, function)
    with pytest.raises(ValueError, match="No image can be corrected with coefficients of"):
        call(np.full((108, 192), 9, np.uint8), lens, focal=focal)


def test_a_border_value_of_a_mask_may_be_a_truth():
    result = zj.undistort_image(np.zeros((108, 192), bool), BARREL, keep="all", border_value=True)
    assert result.any()


def test_against_an_opencv_camera(rng):
    """OpenCV's forward model is the polynomial of our `undistort`, its iterated inverse our `distort`."""
    k1, k2 = 0.12, -0.05
    d = bent(k1, k2, size=(960, 540), centre=(500.0, 250.0))
    s = float(d.scale)
    camera = np.array([[s, 0, 500.0], [0, s, 250.0], [0, 0, 1]])
    pixels = np.stack(np.meshgrid(np.arange(960.0), np.arange(540.0)), axis=-1).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    camera_and_lens = (pixels, camera, np.array([k1, k2, 0, 0]))
    where = cv2.undistortPoints(*camera_and_lens, P=camera, criteria=criteria).reshape(540, 960, 2)
    x, y = position_map(d, zj.correct.frame_output(d, (960, 540)), (960, 540))
    seen = (where >= 0).all(-1) & (where[..., 0] <= 959) & (where[..., 1] <= 539)
    assert seen.mean() > 0.8
    assert np.hypot(x - where[..., 0], y - where[..., 1])[seen].max() <= TOLERANCE
    image = smooth(rng, (540, 960, 3))
    expected = cv2.remap(image, where.astype(np.float32), None, cv2.INTER_LINEAR)
    difference = cv2.absdiff(zj.undistort_image(image, d), expected)
    assert difference.max() <= 1


@pytest.mark.parametrize("rows", [1, 25, 50])  # of 100: the last band of 108 overlaps that before it
@pytest.mark.parametrize("border", ["constant", "replicate"])
@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
@pytest.mark.parametrize(
    ("dtype", "channels"), [("float64", (3,)), ("uint8", (3,)), ("float16", (2,)), ("int16", ())]
)
def test_bands_of_rows_are_parts_of_one_image(
    rng, monkeypatch, rows, border, interpolation, dtype, channels
):
    image = smooth(rng, (*SIZE[::-1], *channels), dtype)
    how = {"keep": "all", "size": (100, 108), "interpolation": interpolation, "border": border}
    whole = zj.undistort_image(image, PINCUSHION, **how)
    monkeypatch.setattr("zoomjax.correct.image._WHOLE", 0)
    monkeypatch.setattr("zoomjax.correct.image._BAND", 100 * rows)
    parts = zj.undistort_image(image, PINCUSHION, **how)
    assert parts.dtype == dtype
    assert parts.shape == (108, 100, *channels)
    unit = 1 if np.dtype(dtype).kind == "f" else np.iinfo(dtype).max
    difference = np.abs(parts.astype(float) - whole.astype(float)) / unit
    assert difference.max() <= 0.005  # 1/32 px, where a rounding of a position decides
    assert (difference > 1e-5).mean() < 0.02


@pytest.mark.parametrize("d", [bent(0.15, -0.05, size=(960, 540)), bent(-0.08, 0.01, size=(960, 540))])
def test_lines_come_out_straight(d):
    width, height = 960, 540
    pixels = np.stack(np.meshgrid(np.arange(960.0), np.arange(540.0)), axis=-1)
    seen = np.asarray(d.undistort(pixels)) - np.asarray(d.centre)
    slope, edge = 0.2, np.arange(-400, 401, 160)
    across = seen[..., 0] - slope * seen[..., 1]
    profile = sum((-1) ** i * np.tanh(across - e) for i, e in enumerate(edge)) - 1
    image = np.rint(127 + 110 * profile).astype(np.uint8)
    result = zj.undistort_image(image, d).astype(float)

    def worst(picture):
        """The farthest that the edges of a picture lie from their own straight lines, px."""
        middle, farthest = 127.0, 0.0
        for e in edge[1:-1]:
            points = []
            for row in range(60, 480, 4):
                about = 479.5 + e + slope * (row - 269.5)
                columns = np.arange(int(about) - 40, int(about) + 41)
                columns = columns[(columns >= 0) & (columns < width - 1)]
                step = picture[row, columns] - middle
                crossing = np.flatnonzero(step[:-1] * step[1:] < 0)
                if len(crossing):
                    i = crossing[np.argmin(abs(columns[crossing] - about))]
                    points.append([row, columns[i] + step[i] / (step[i] - step[i + 1])])
            rows, found = np.array(points).T
            assert len(rows) > 90
            fitted = np.polyfit(rows, found, 1)
            farthest = max(farthest, np.abs(np.polyval(fitted, rows) - found).max())
        return farthest

    assert worst(image.astype(float)) > 1.5
    assert worst(result) <= 0.1
    assert height == result.shape[0]


@pytest.mark.parametrize("d", [BARREL, PINCUSHION, bent(0.3, 0.1, centre=(70, 60)), bent(-0.3, size=SIZE)])
@pytest.mark.parametrize("plane", [None, Plane((96, 54), (2.0, 2.0), (0.0, 0.5))])
def test_map_within_a_hundredth_of_a_pixel(d, plane):
    framing = zj.correct.frame_output(d, SIZE, size=(200, 120))
    size, step, offset = (
        ((200, 120), (1, 1), (0, 0)) if plane is None else (plane.size, plane.step, plane.offset)
    )
    pixels = np.stack(np.meshgrid(*map(np.arange, size)), axis=-1) * np.array(step) + np.array(offset)
    exact = (np.asarray(d.distort(framing.corrected(pixels))) - offset) / np.array(step)
    x, y = position_map(d, framing, SIZE, plane=plane)
    reachable = np.array(SIZE) / step
    seen = ((exact > -1) & (exact < reachable)).all(-1)
    assert seen.mean() > 0.5
    assert np.hypot(x - exact[..., 0], y - exact[..., 1])[seen].max() <= TOLERANCE
    off = (x < -1) | (x > reachable[0]) | (y < -1) | (y > reachable[1])
    assert (seen | off).all()


def test_exact_inverse_where_no_polynomial_will_do():
    """k1 = -1/3: the fold lies on the farthest corner."""
    d = bent(-1 / 3 - 1e-3)
    assert fit_inverse(d, 400.0) is None
    framing = zj.correct.frame_output(d, SIZE)
    x, y = position_map(d, framing, SIZE, extend=True)
    exact = exact_map(d, framing)
    gone = np.isnan(exact[..., 0])
    assert gone.any()
    assert (x[gone] == OUTSIDE).all()
    np.testing.assert_allclose(np.stack([x, y], -1)[~gone], exact[~gone], atol=1e-4)


def test_error_of_the_fit_is_what_it_says():
    d = bent(0.3, 0.1, size=(1920, 1080))
    inverse = fit_inverse(d, 1100.0)
    assert inverse is not None
    framing = zj.correct.frame_output(d, (1920, 1080))
    x, y = position_map(d, framing, (1920, 1080), extend=True)
    exact = exact_map(d, framing)
    error = np.hypot(x - exact[..., 0], y - exact[..., 1]).max()
    assert inverse.error / 10 < error < inverse.error + 1e-3  # and float32's 2**-14 px at 1000 px
    assert fit_inverse(d, 1100.0, tolerance=1e-12) is None


@pytest.mark.parametrize("border", ["constant", "replicate"])
def test_fold_gives_border_value_and_says_so(rng, border):
    d = bent(-0.6)
    image = np.full((108, 192), 200, np.uint8)
    with pytest.warns(UserWarning, match="not invertible on this image.* folds 8. px from the centre"):
        result = zj.undistort_image(image, d, border=border, border_value=7)
    exact = exact_map(d, zj.correct.frame_output(d, SIZE))
    gone = np.isnan(exact[..., 0])
    assert 0.2 < gone.mean() < 0.9
    assert (result[gone] == 7).all()
    seen = ((exact >= 0) & (exact <= np.array(SIZE) - 1)).all(-1)
    assert seen.mean() > 0.2
    assert (result[seen] == 200).all()


def test_no_warning_where_only_the_outside_folds():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        zj.undistort_image(np.zeros((108, 192), np.uint8), bent(-0.3))


def test_borders(rng):
    d = PINCUSHION
    image = smooth(rng, (108, 192, 3))
    image[:] = 100
    for border in ("replicate", "reflect"):
        assert (zj.undistort_image(image, d, border=border) == 100).all()
    corner = zj.undistort_image(image, d, border_value=[1, 2, 3])[0, 0]
    np.testing.assert_array_equal(corner, [1, 2, 3])


@pytest.mark.parametrize(("name", "flag"), [("nearest", 0), ("cubic", 2), ("lanczos", 4)])
def test_interpolations(rng, name, flag):
    image = smooth(rng, (108, 192, 3))
    where = exact_map(BARREL, zj.correct.frame_output(BARREL, SIZE)).astype(np.float32)
    expected = cv2.remap(image, where, None, flag, borderMode=cv2.BORDER_REPLICATE)  # all is within
    difference = cv2.absdiff(zj.undistort_image(image, BARREL, interpolation=name), expected)
    assert (difference > 1).mean() < 2e-3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"interpolation": "best"}, "interpolation must be one of nearest"),
        ({"border": "wrap"}, "border must be one of constant"),
        ({"border_value": [1, 2]}, "one number, or one for each of the 3 channels"),
        ({"border_value": 300}, "border_value must be a value of uint8"),
        ({"keep": "most"}, 'keep must be "same", "all", "valid" or "grow"'),
        ({"size": (0, 3)}, "size must be two positive integers"),
        ({"size": (40000, 3)}, "at most 32766 px a side"),
        ({"keep": zj.correct.frame_output(BARREL, SIZE), "size": (3, 3)}, "size must be left out"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        zj.undistort_image(np.zeros((108, 192, 3), np.uint8), BARREL, **arguments)


@pytest.mark.parametrize(
    "image", [np.zeros((0, 4)), np.zeros(4), np.zeros((4, 4), complex), np.zeros((4, 4), np.int64)]
)
def test_bad_images(image):
    with pytest.raises((ValueError, TypeError), match=r"Argument image must|parameter 'image'"):
        zj.undistort_image(image, BARREL)


def test_huge_images_are_refused_not_misread():
    with pytest.raises(ValueError, match="at most 32766 px a side"):
        zj.undistort_image(np.zeros((1, 33000), np.uint8), BARREL)


def test_float32_lens_serves_as_well(rng):
    image = smooth(rng, (108, 192))
    single = eqx.tree_at(
        lambda d: (d.coefficients, d.centre, d.scale),
        BARREL,
        tuple(leaf.astype(jnp.float32) for leaf in (BARREL.coefficients, BARREL.centre, BARREL.scale)),
    )
    difference = cv2.absdiff(zj.undistort_image(image, BARREL), zj.undistort_image(image, single))
    assert difference.max() <= 1


def test_masks_are_refused_and_not_dropped():
    image = np.ma.array(np.zeros((40, 60), np.uint8), mask=True)
    with pytest.raises(ValueError, match="image is a masked array"):
        zj.undistort_image(image, zj.scenes.nikkor_18_200((60, 40))(35.0))
