"""Laws that hold for every lens, frame and line: what is drawn here is of all kinds, ugly ones included."""

import itertools

import equinox as eqx
import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj

pytestmark = pytest.mark.filterwarnings(
    "ignore:.*outside of the image:UserWarning"
)  # lines may reach there

few = hypothesis.settings(max_examples=20)
SIZE = (640, 480)
CENTRE, SCALE = np.array([319.5, 239.5]), 400.0
FRAMES, LINES, POINTS = 4, 5, 12  # one shape: compiled once
KINDS = ("usual", "through the centre", "short", "all the same", "one after the other", "far outside")


@st.composite
def scenes(draw, kinds=("usual",)):
    """Points of lines, (line, point, 2) px, seen through a random lens with noise, and focal lengths."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    bend = draw(st.floats(-0.25, 0.25))
    noise = draw(st.sampled_from([0.0, 1e-9, 0.1, 2.0]))
    kind = draw(st.sampled_from(kinds))
    focal = np.sort(rng.uniform(18, 200, FRAMES)) + np.arange(FRAMES)
    number = FRAMES * LINES
    angle = rng.uniform(0, np.pi, number)
    along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    foot = rng.uniform([40, 40], [600, 440], (number, 2))
    reach = rng.uniform(60, 400, number)
    if kind == "through the centre":
        foot[:] = CENTRE
    elif kind == "short":
        reach[:] = 1e-3
    elif kind == "all the same":
        foot[:], along[:], reach[:] = foot[0], along[0], reach[0]
    t = np.linspace(-1, 1, POINTS)
    points = foot[:, None] + (reach[:, None] * t)[..., None] * along[:, None]
    points = np.clip(points, -50, 700)
    z = (points - CENTRE) / SCALE
    share = (18 / np.repeat(focal, LINES))[:, None, None]
    points = points - SCALE * z * bend * share * np.sum(z**2, axis=-1, keepdims=True)
    points = points + noise * rng.standard_normal(points.shape)
    if kind == "one after the other":
        points[:] = points[:, :1]
        points[:, 1:] += np.arange(1, POINTS)[None, :, None]
    elif kind == "far outside":
        points *= 1e4
    return points, focal


def lines_of(points, focal, order=None, frames=None, size=SIZE):
    frame = np.repeat(np.arange(FRAMES), LINES) if frames is None else frames
    order = np.arange(len(points)) if order is None else order
    return zj.Lines.from_ragged(list(points[order]), frame[order], focal, image_size=size)


def fitted(lines, **options):
    return zj.fit_zoom(zj.compress(lines), throw=False, **options)


def corner(lens, focal, scale=1.0):
    return np.asarray(lens(float(focal)).undistort(np.array([5.0, 5.0]) * scale)) / scale


def same(first, second, focal):
    """The two fits, where the lines determine one."""
    np.testing.assert_allclose(first.rms, second.rms, rtol=1e-6, atol=1e-7)
    if zj.RESULTS[first.result] == zj.RESULTS[second.result] == "":
        for f in focal:
            np.testing.assert_allclose(corner(first.lens, f), corner(second.lens, f), atol=1e-3)


@pytest.mark.slow
@few
@hypothesis.given(scenes(), st.randoms(use_true_random=False))
def test_the_order_of_lines_and_frames_does_not_matter(scene, random):
    points, focal = scene
    order, place = list(range(len(points))), list(range(FRAMES))
    random.shuffle(order)
    random.shuffle(place)
    frames = np.asarray(place)[np.repeat(np.arange(FRAMES), LINES)]
    moved = lines_of(points, focal[np.argsort(place)], np.asarray(order), frames)
    same(fitted(lines_of(points, focal)), fitted(moved), focal)


@pytest.mark.slow
@few
@hypothesis.given(scenes())
def test_padding_does_not_matter(scene):
    points, focal = scene
    lines = lines_of(points, focal)
    wider = zj.Lines(
        points=jnp.pad(lines.points, ((0, 0), (0, 3), (0, 0)), constant_values=1e3),
        mask=jnp.pad(lines.mask, ((0, 0), (0, 3))),
        frame=lines.frame,
        focal=lines.focal,
        centre=lines.centre,
        image_size=SIZE,
    )
    same(fitted(lines), fitted(wider), focal)


@pytest.mark.slow
@few
@hypothesis.given(scenes())
def test_the_size_of_a_pixel_does_not_matter(scene):
    points, focal = scene
    first = fitted(lines_of(points, focal))
    second = fitted(lines_of(2 * points + 0.5, focal, size=(1280, 960)))
    np.testing.assert_allclose(second.rms, 2 * first.rms, rtol=1e-6, atol=1e-7)
    if zj.RESULTS[first.result] == zj.RESULTS[second.result] == "":
        for f in focal:
            far = np.asarray(second.lens(float(f)).undistort(np.array([10.5, 10.5])))
            np.testing.assert_allclose((far - 0.5) / 2, corner(first.lens, f), atol=1e-3)


@few
@pytest.mark.parametrize("invertible", [False, True], ids=["free", "invertible"])
@hypothesis.given(scene=scenes())
def test_a_higher_degree_is_never_worse_in_sample(scene, invertible):
    lines = lines_of(*scene)
    fits = [
        fitted(lines, zoom=zj.PolynomialZoom(degree=degree), invertible=invertible) for degree in (0, 1, 2)
    ]
    for lower, higher in itertools.pairwise(fits):
        if _good(lower) and _good(higher):
            assert higher.rms <= lower.rms * (1 + 1e-6) + 1e-9


def _good(fit):
    return zj.RESULTS[fit.result] == "" or fit.result in (zj.RESULTS.undetermined, zj.RESULTS.constrained)


@pytest.mark.slow
@hypothesis.given(scenes(KINDS))
def test_finite_input_never_gives_nan(scene):
    points, focal = scene
    lines = lines_of(points, focal)
    small = zj.compress(lines)
    each = zj.fit_frames(small, throw=False)
    robust = zj.fit_robust(small, throw=False)
    seen = np.bincount(np.asarray(lines.frame), np.asarray(robust.weight), FRAMES) > 0
    assert (np.isnan(np.asarray(robust.fit.frame_rms)) == ~seen).all()  # of frames that are left out
    robust = eqx.tree_at(lambda r: r.fit.frame_rms, robust, np.asarray(robust.fit.frame_rms)[seen])
    tree = (
        fitted(lines), each, robust, zj.fit.algebraic_zoom(small), zj.frame_rms(small, None),
        zj.trust.coefficient_std(robust.fit, focal),
        zj.displacement_std(robust.fit, np.ones(2), focal=focal[seen][0]),  # others are beyond its range
    )  # fmt: skip
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        assert not np.isnan(np.asarray(leaf, float)).any(), jax.tree_util.keystr(path)


@hypothesis.given(
    st.lists(st.floats(-0.6, 0.6), min_size=2, max_size=2),
    st.floats(0, 639), st.floats(0, 479), st.floats(20, 80),
)  # fmt: skip
def test_round_trip_inside_the_certificate(k, x, y, focal):
    zoom = zj.PolynomialZoom(1, jnp.asarray([[k[0], k[1]], [-k[1], k[0]]]), jnp.asarray(20.0))
    lens = zj.ZoomLens(zoom, jnp.asarray(CENTRE), jnp.asarray([20.0, 80.0]), SIZE)
    certificate = zj.models.certify(lens)
    distortion, point = lens(focal), np.array([x, y])
    corrected = distortion.undistort(point)
    back = distortion.distort(corrected)
    if certificate.certified:
        assert distortion.has_inverse(corrected)
        # The inverse magnifies rounding by the slope's reciprocal.
        np.testing.assert_allclose(back, point, atol=1e-9 / max(float(certificate.least), 1e-6))
    else:  # never a folded point, silently
        given = ~np.isnan(np.asarray(back)).any()
        if given:
            np.testing.assert_allclose(distortion.undistort(back), corrected, atol=1e-6)
