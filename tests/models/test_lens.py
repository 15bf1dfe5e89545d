import dataclasses
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj

from .._reference import largest_difference, undistorted


@pytest.fixture
def lens():
    zoom = zj.PolynomialZoom(1, jnp.array([[0.02, 0.01], [0.1, -0.03]]), jnp.array(20.0))
    return zj.ZoomLens(zoom, jnp.array([319.5, 239.5]), jnp.array([20.0, 80.0]), (640, 480), "px")


@pytest.fixture
def content(lens, tmp_path):
    """What is in the file of a lens."""
    lens.save(tmp_path / "lens.json")
    return json.loads((tmp_path / "lens.json").read_text())


def load(content, folder):
    path = folder / "lens.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return zj.load_lens(path)


def test_lens_at_a_focal_length_is_the_distortion_there(lens):
    d = lens(40.0)
    np.testing.assert_allclose(d.coefficients, [0.07, -0.005])
    np.testing.assert_array_equal(d.centre, [319.5, 239.5])
    assert d.scale == 400
    points = np.array([[0.0, 0.0], [600.0, 17.0]])
    expected = undistorted(points, [0.07, -0.005], [319.5, 239.5], 400)
    np.testing.assert_allclose(d.undistort(points), expected, rtol=1e-14)


def test_vmap_over_focal_lengths(lens):
    focal = jnp.array([20.0, 33.0, 80.0])
    batched = jax.vmap(lens)(focal).coefficients
    np.testing.assert_allclose(batched, np.stack([lens(f).coefficients for f in focal]), rtol=1e-14)


def test_lens_goes_through_transformations_whole(lens):
    def corner(lens, f):
        return lens(f).undistort(jnp.zeros(2))[0]

    value, gradient = eqx.filter_jit(eqx.filter_value_and_grad(corner))(lens, 30.0)
    np.testing.assert_allclose(value, corner(lens, 30.0), rtol=1e-14)
    assert (gradient.zoom.parameters != 0).all()


def test_outside_of_the_fitted_range_it_warns_and_works(lens):
    for focal in (15.0, 100.0):
        with pytest.warns(UserWarning, match=r"20 to 80 px.*extrapolated"):
            d = lens(focal)
        np.testing.assert_allclose(d.coefficients, lens.zoom(jnp.asarray(focal)))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_ends_of_the_range_are_within_it(lens, dtype):
    odd = eqx.tree_at(lambda lens: lens.focal_range, lens, jnp.array([20.56, 127.36], dtype))
    for end in (20.56, 127.36):
        odd(end)  # a warning would be an error


@pytest.mark.parametrize("focal", [0.0, -35.0, np.nan, np.inf])
def test_focal_length_that_is_none_raises(lens, focal):
    with pytest.raises(ValueError, match="focal must be a positive number"):
        lens(focal)


def test_file_keeps_the_lens(lens, content, tmp_path):
    loaded = load(content, tmp_path)
    assert loaded.image_size == (640, 480)
    assert loaded.focal_unit == "px"
    np.testing.assert_array_equal(loaded.focal_range, lens.focal_range)
    np.testing.assert_array_equal(loaded.centre, lens.centre)
    assert largest_difference(loaded, lens, np.array([20.0, 50.0, 80.0])) == 0


def test_float32_lens_is_kept_exactly(lens, tmp_path):
    single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), lens)
    single.save(tmp_path / "lens.json")
    loaded = zj.load_lens(tmp_path / "lens.json")
    np.testing.assert_array_equal(loaded.zoom.parameters, single.zoom.parameters)


def test_file_says_what_its_numbers_mean(content):
    assert content["format"] == "zoomjax.lens"
    assert content["scale"] == 400
    assert "k_i(f)" in content["zoom"]["formula"]


def without(key):
    return lambda content: {name: value for name, value in content.items() if name != key}


SPOILED = {
    "another version": (lambda c: c | {"version": 99}, "version is 99"),
    "another format": (lambda c: c | {"format": "csv"}, "no zoom lens"),
    "a list": (lambda c: [c], "no zoom lens"),
    "not JSON": (lambda c: "lens", "Cannot read a lens"),
    "truncated": (lambda c: json.dumps(c)[:100], "Cannot read a lens"),
    "empty": (lambda c: "", "Cannot read a lens"),
    "unknown model": (lambda c: c | {"zoom": c["zoom"] | {"model": "Magic"}}, "'Magic', is unknown"),
    "no version": (without("version"), "it has no 'version'"),
    "no centre": (without("centre"), "it has no 'centre'"),
    "short centre": (lambda c: c | {"centre": [1.0]}, "incomplete or not finite"),
    "NaN": (lambda c: c | {"focal_range": [np.nan, 3.0]}, "incomplete or not finite"),
    "words": (lambda c: c | {"image_size": ["a", "b"]}, "two positive integers"),
    "negative image size": (lambda c: c | {"image_size": [-5, 4]}, "two positive integers"),
    "image size with a fraction": (lambda c: c | {"image_size": [640.5, 480]}, "two positive integers"),
    "unit": (lambda c: c | {"focal_unit": "inch"}, 'must be "mm" or "px"'),
    "reversed range": (lambda c: c | {"focal_range": c["focal_range"][::-1]}, "focal_range .* in order"),
    "negative range": (
        lambda c: c | {"focal_range": [-1.0, 3.0]},
        "must be finite and positive",
    ),
    "range of no lens": (
        lambda c: c | {"focal_range": [1e-300, 3.0]},
        r"from 1e-30 to 1e\+30 mm or px, but focal_range\[0\] is 1e-300",
    ),
    "zero reference": (
        lambda c: c | {"zoom": c["zoom"] | {"focal_ref": 0.0}},
        "must be finite and positive",
    ),
    "no parameters": (
        lambda c: c | {"zoom": c["zoom"] | {"parameters": [[], [], []]}},
        "'parameters' are incomplete",
    ),
    "another scale": (lambda c: c | {"scale": 1.0}, "half the diagonal"),
    "version in words": (lambda c: c | {"version": "1"}, "version is '1'"),
    "ragged": (
        lambda c: c | {"zoom": c["zoom"] | {"parameters": [[1.0], [1.0, 2.0]]}},
        "Cannot read a lens",
    ),
}


@pytest.mark.parametrize("kind", [list, np.asarray, jnp.asarray])
def test_several_focal_lengths_give_several_distortions(truth, kind):
    focal = [24.0, 50.0, 100.0]
    several = truth(kind(focal))
    assert several.coefficients.shape == (3, 2)
    points = np.random.default_rng(0).uniform(0, 600, (3, 4, 5, 2))
    for method in ("undistort", "distort", "has_inverse"):
        ours = getattr(several, method)(points)
        loop = [getattr(truth(f), method)(p) for f, p in zip(focal, points, strict=True)]
        np.testing.assert_allclose(ours, loop, rtol=1e-13, atol=1e-11)
        one = getattr(several, method)(points[0, 0, 0])  # a single point is one for all
        np.testing.assert_allclose(
            one, [getattr(truth(f), method)(points[0, 0, 0]) for f in focal], rtol=1e-13
        )
    np.testing.assert_allclose(several.monotone_radius, [truth(f).monotone_radius for f in focal])
    assert several.pixel_coefficients.shape == (3, 2)


def test_several_distortions_need_a_set_of_points_each(truth):
    with pytest.raises(ValueError, match=r"must begin with the axes \(2,\)"):
        truth([24.0, 50.0]).undistort(np.zeros((3, 2)))


@pytest.mark.parametrize("kind", [np.asarray, jnp.asarray], ids=["NumPy", "JAX"])
@pytest.mark.parametrize("method", ["undistort", "distort"])
def test_a_focal_length_for_each_point(truth, method, kind, rng):
    points, focal = rng.uniform(0, 600, (4, 3, 2)), rng.uniform(21, 120, (4, 3))
    ours = getattr(truth, method)(kind(points), kind(focal))
    assert isinstance(ours, type(kind(points)))
    loop = [
        getattr(truth(f), method)(p) for p, f in zip(points.reshape(-1, 2), focal.reshape(-1), strict=True)
    ]
    np.testing.assert_allclose(ours.reshape(-1, 2), loop, rtol=1e-13, atol=1e-11)
    by_column = getattr(truth, method)(kind(points), kind(focal[0]))  # broadcast as in NumPy
    np.testing.assert_allclose(by_column[0], ours[0], rtol=1e-13, atol=1e-11)
    one = getattr(truth, method)(kind(points), 35.0)
    np.testing.assert_allclose(one, getattr(truth(35.0), method)(kind(points)), rtol=1e-13, atol=1e-11)


def test_a_moving_centre_follows_each_focal_length(truth, rng):
    shift = zj.PolynomialZoom(1, jnp.array([[0.0, 0.0], [0.03, -0.02]]), jnp.asarray(20.56))
    lens = dataclasses.replace(truth, shift=shift)
    points, focal = rng.uniform(0, 600, (5, 2)), rng.uniform(21, 120, 5)
    loop = [lens(f).undistort(p) for p, f in zip(points, focal, strict=True)]
    np.testing.assert_allclose(lens.undistort(points, focal), loop, rtol=1e-13, atol=1e-11)
    np.testing.assert_allclose(lens(focal).undistort(points), loop, rtol=1e-13, atol=1e-11)


def test_a_lens_may_be_closed_over(truth):
    points = jnp.array([[3.0, 4.0], [500.0, 40.0]])
    expected = truth(35.0).undistort(points)
    np.testing.assert_allclose(
        jax.jit(lambda p: truth(35.0).undistort(p))(points), expected, rtol=1e-13, atol=1e-11
    )
    np.testing.assert_allclose(
        jax.jit(lambda f: truth(f).undistort(points))(35.0), expected, rtol=1e-13, atol=1e-11
    )
    np.testing.assert_allclose(
        jax.jit(lambda p: truth.undistort(p, 35.0))(points), expected, rtol=1e-13, atol=1e-11
    )


def test_beyond_the_range_is_nan_where_nobody_can_be_warned(truth):
    low, high = truth.focal_range
    points = jnp.array([[3.0, 4.0], [500.0, 40.0]])
    inside = jnp.array([low, 50.0, high])
    outside = jnp.array([0.9 * low, 1.1 * high, -35.0, 0.0, jnp.nan, jnp.inf])
    many = jax.jit(jax.vmap(lambda f: truth(f).undistort(points)))
    assert jnp.isfinite(many(inside)).all()
    assert jnp.isnan(many(outside)).all()
    compiled = jax.jit(lambda points, focal: truth.undistort(points, focal))
    assert jnp.isfinite(compiled(points, jnp.array([low, high]))).all()
    assert jnp.isnan(compiled(points, jnp.array([1.1 * high, -low]))).all()
    wider = truth.extended(10.0, 200.0)
    assert jnp.isfinite(jax.jit(lambda f: wider(f).undistort(points))(0.9 * low)).all()
    with pytest.warns(UserWarning, match="extrapolated"):
        truth.undistort(points, 1.1 * high)
    with pytest.raises(ValueError, match="positive"):
        truth.undistort(points, -35.0)


@pytest.mark.parametrize("low", [0.0, -5.0, np.nan, np.inf])
def test_a_wider_range_is_of_focal_lengths(truth, low):
    with pytest.raises(ValueError, match="Argument low must be a finite number above 0"):
        truth.extended(low, 200.0)


def test_numpy_points_at_another_focal_length_compile_nothing(truth, compilations, rng):
    truth.undistort(rng.uniform(0, 600, (3, 2)), 35.0)
    compilations()
    for number in (5, 50, 500):
        truth.distort(rng.uniform(0, 600, (number, 2)), 30.0 + number / 10)
    assert compilations() == 0


def test_range_is_checked_of_many_focal_lengths(lens):
    low, high = lens.focal_range
    lens.check_range(np.array([low, high]))
    with pytest.warns(UserWarning, match=r"Focal lengths from 10 to 160 px are not all within"):
        lens.check_range(np.array([low / 2, low, high * 2]))
    with pytest.raises(ValueError, match=r"positive number, 1e-30 to 1e\+30 mm or px, but it is 1e\+300"):
        lens(1e300)
    with pytest.raises(ValueError, match="positive number, but it is -1"):
        lens.check_range(np.array([low, -1.0]))


def test_a_centre_outside_of_the_image_is_told(content, tmp_path):
    """As a fit tells it: a slip in the file moved all that the lens corrects, without a word."""
    (tmp_path / "lens.json").write_text(json.dumps(content | {"centre": [-600.0, 300.0]}))
    with pytest.warns(
        UserWarning, match=r"lens\.json: the centre of distortion, \(-600, 300\) px, is outside"
    ):
        zj.load_lens(tmp_path / "lens.json")


@pytest.mark.parametrize(("spoil", "message"), SPOILED.values(), ids=SPOILED)
def test_file_that_is_no_lens_raises_and_is_named(spoil, message, content, tmp_path):
    with pytest.raises(ValueError, match=message) as caught:
        load(spoil(content), tmp_path)
    assert str(tmp_path / "lens.json") in str(caught.value)


def test_missing_file_raises(tmp_path):
    with pytest.raises(FileNotFoundError):
        zj.load_lens(tmp_path / "lens.json")


class Nameless(zj.models.AbstractZoom):
    """A zoom model with no file format."""

    parameters: None = None

    def prepare(self, focal, terms):
        return self

    def __call__(self, focal):
        return jnp.zeros(2)


def test_zoom_model_without_a_format_raises_and_leaves_no_file(lens, tmp_path):
    nameless = eqx.tree_at(lambda lens: lens.zoom, lens, Nameless())
    with pytest.raises(TypeError, match="Nameless cannot be saved"):
        nameless.save(tmp_path / "lens.json")
    assert not list(tmp_path.iterdir())


def test_saving_into_a_folder_that_is_not_there_names_it(lens, tmp_path):
    with pytest.raises(OSError, match=r"cannot write in the folder .*absent"):
        lens.save(tmp_path / "absent" / "lens.json")
    assert not list(tmp_path.iterdir())


def test_saving_replaces_an_older_file(lens, tmp_path):
    path = tmp_path / "lens.json"
    path.write_text("old")
    lens.save(path)
    assert zj.load_lens(path).image_size == (640, 480)
    assert list(tmp_path.iterdir()) == [path]


def test_a_centre_that_moves(lens, tmp_path):
    shift = zj.PolynomialZoom(1, jnp.array([[0.01, 0.0], [-0.02, 0.005]]), jnp.array(20.0))
    moving = eqx.tree_at(lambda lens: lens.shift, lens, shift, is_leaf=lambda leaf: leaf is None)
    np.testing.assert_allclose(moving(40.0).centre, [319.5 + 400 * 0.0, 239.5 + 400 * 0.0025])
    np.testing.assert_allclose(moving(20.0).centre, [319.5 - 4, 239.5 + 2])
    moving.save(tmp_path / "lens.json")
    again = zj.load_lens(tmp_path / "lens.json")
    assert eqx.tree_equal(again, moving)
    batched = jax.vmap(again)(jnp.array([20.0, 40.0]))
    np.testing.assert_allclose(batched.centre[1], moving(40.0).centre)


@pytest.mark.parametrize(
    "focal",
    ["35", True, [True], None, [30.0, "35"], {}, b"35", 35 + 0j, jnp.array(35 + 3j), jnp.array(True)],
)
def test_a_focal_length_is_a_number(focal):
    lens = zj.scenes.nikkor_18_200()
    for call in (lens, lambda f: lens.undistort([0.0, 0.0], f)):
        with pytest.raises((ValueError, TypeError), match="focal"):
            call(focal)
        if isinstance(focal, jax.Array):
            with pytest.raises((ValueError, TypeError), match="focal"):
                jax.jit(lambda f, call=call: call(f))(focal)


def test_masks_are_refused_and_not_dropped():
    lens = zj.scenes.nikkor_18_200()
    points = np.ma.array([[1.0, 2.0], [3.0, 4.0]], mask=[[0, 0], [1, 1]])
    with pytest.raises(ValueError, match="points is a masked array"):
        lens(35.0).undistort(points)
    with pytest.raises(ValueError, match="points is a masked array"):
        lens.distort(points, 35.0)
    with pytest.raises(ValueError, match="focal is a masked array"):
        lens(np.ma.array([24.0, 50.0], mask=[0, 1]))


def test_a_name_that_stands_twice_in_a_file_is_refused(truth, tmp_path):
    truth.save(path := tmp_path / "lens.json")
    text = path.read_text()
    path.write_text(text.replace('"focal_unit": "mm"', '"focal_unit": "mm", "focal_unit": "px"'))
    with pytest.raises(ValueError, match="it has 'focal_unit' twice"):
        zj.load_lens(path)
    path.write_text(text, encoding="utf-8-sig")  # as some editors save it
    assert zj.load_lens(path).focal_unit == "mm"


@pytest.mark.parametrize(
    ("within", "wrong", "meant"),
    [
        ((), "shft", "shift"),
        ((), "Shift", "shift"),
        ((), "pixel_pich", "pixel_pitch"),
        ((), "focus-range", "focus_range"),
        ((), "distortionModel", "distortion_model"),
        (("zoom",), "Mean", "mean"),
    ],
)
def test_an_optional_entry_that_is_misspelled_is_refused(within, wrong, meant, content, tmp_path):
    table = content
    for name in within:
        table = table[name]
    with pytest.warns(UserWarning, match="does not know: comment, camera"):  # others may say what they like
        load(content | {"comment": "of 2012", "camera": "D90"}, tmp_path)
    table[wrong] = table.pop(meant, [1, 2])
    with pytest.raises(ValueError, match=f"its '{wrong}' would not count: '{meant}'"):
        load(content, tmp_path)


@pytest.mark.parametrize("name", ["centre", "focal_range"])
def test_numbers_of_a_file_are_no_words_and_no_booleans(name, content, tmp_path):
    for values in (["1", "2"], [True, True], [1, None], [True, 2.5]):
        with pytest.raises(ValueError, match=f"numbers of its '{name}'"):
            load(content | {name: values}, tmp_path)


@pytest.mark.parametrize("size", [["640", "480"], [True, True], "64"])
def test_an_image_size_is_two_numbers(size, content, tmp_path):
    with pytest.raises(ValueError, match="image_size must be two positive integers"):
        load(content | {"image_size": size}, tmp_path)


def test_where_a_centre_moves_to_is_asked_of_focal_lengths(lens, unchecked):
    """Its model went on beyond the range, and below 0, without a word."""
    moving = dataclasses.replace(
        lens, shift=zj.PolynomialZoom(1, jnp.array([[0.0, 0.0], [0.1, 0.0]]), 20.0)
    )
    with pytest.warns(UserWarning, match="not within the range"):
        moving.centre_at(5.0)
    for focal in (-5.0, [20.0, -40.0], np.nan):
        with pytest.raises(ValueError, match="positive number"):
            moving.centre_at(focal)
    with pytest.raises(ValueError, match="Argument focal must be a number"):
        moving.centre_at("40")
    np.testing.assert_allclose(moving.centre_at([20, 40]), [[359.5, 239.5], [339.5, 239.5]])
    np.testing.assert_allclose(moving.centre_at(40), moving(40.0).centre)
    camera = zj.Camera(moving)
    with pytest.warns(UserWarning, match="not within the range") as told:
        camera.rays(np.zeros((1, 2)), 90.0)
    assert len(told) == 1


def test_several_lenses_in_one_say_so(lens, tmp_path):
    """They were saved to a file that cannot be read, and called with a TypeError about lists."""
    other = eqx.tree_at(lambda lens: lens.zoom.parameters, lens, 2 * lens.zoom.parameters)
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), lens, other)
    for ask in (
        lambda: both(40.0),
        lambda: both.undistort(np.zeros((2, 2)), 40.0),
        lambda: both.distort(jnp.zeros((2, 2)), jnp.array([30.0, 40.0])),
        lambda: both.save(tmp_path / "both.json"),
    ):
        with pytest.raises(ValueError, match="2 lenses in one"):
            ask()
    assert not list(tmp_path.glob("both*"))
    found = jax.vmap(lambda lens: lens(40.0).coefficients)(both)
    np.testing.assert_allclose(found, [lens(40.0).coefficients, other(40.0).coefficients])
