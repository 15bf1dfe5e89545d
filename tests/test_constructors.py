"""Constructors refuse what `Lines.from_ragged` and the files' readers refuse, and take what JAX puts in."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj
from zoomjax._core import fields as _fields

FOCAL = np.array([18.0, 24.0, 35.0, 50.0, 70.0, 120.0, 200.0])
FOCUS = np.array([0.0, 1.0, 0.5, 0.0, 1.0, 0.5, 0.2])
SIZE = (640, 480)

ZOOMS = {
    "polynomial": zj.PolynomialZoom(),
    "table": zj.models.TableZoom(),
    "table of three": zj.models.TableZoom(3, inverse=False),
    "spline": zj.models.SplineZoom(4),
    "power": zj.models.PowerZoom(),
    "two regions": zj.models.TwoRegionZoom(40.0),
    "smooth": zj.SmoothZoom(),
    "focus": zj.models.FocusSplineZoom(3, 2),
}
every_zoom = pytest.mark.parametrize("model", ZOOMS.values(), ids=ZOOMS)


def prepared(model, terms=2):
    more = (FOCUS,) if isinstance(model, zj.models.AbstractFocusZoom) else ()
    return model.prepare(FOCAL, terms, *more)


def lens_fields():
    return {
        "zoom": zj.PolynomialZoom(1, [[0.0, 0.0], [0.1, 0.0]], 20.0),
        "centre": [319.5, 239.5],
        "focal_range": [20.0, 80.0],
        "image_size": [640, 480],
    }


def lines_fields():
    t = np.arange(5.0)
    return {
        "points": np.stack([np.stack([t, t], -1), np.stack([t, 2 * t], -1)]),
        "mask": np.ones((2, 5), bool),
        "frame": [0, 1],
        "focal": [24.0, 70.0],
        "centre": [319.5, 239.5],
        "image_size": SIZE,
    }


def compressed_fields():
    return {
        "triangle": np.tile(np.eye(7), (2, 1, 1)),
        "frame": [0, 1],
        "focal": [24.0, 70.0],
        "centre": [319.5, 239.5],
        "image_size": SIZE,
        "focal_unit": "mm",
    }


LINES_ALIKE = {  # of both kinds of lines
    "negative focal": (
        {"focal": [24.0, -70.0]},
        r"finite and positive, but focal\[1\] is -70",
    ),
    "absurd focal": ({"focal": [24.0, 1e-300]}, r"from 1e-30 to 1e\+30 mm or px, but focal\[1\] is 1e-300"),
    "zero focal": ({"focal": np.array([0.0, 70.0])}, r"focal\[0\] is 0"),
    "NaN focal": ({"focal": [24.0, np.nan]}, r"focal\[1\] is nan"),
    "one number for focal": ({"focal": 24.0}, r"focal must have shape \(frame,\), but its shape is \(\)"),
    "a boolean among focals": ({"focal": [24.0, True]}, "focal must hold real numbers"),
    "focal in words": ({"focal": ["a", "b"]}, "focal must hold real numbers"),
    "complex focal": (
        {"focal": np.array([1j, 2])},
        "real numbers, but its dtype is complex",
    ),
    "frame out of range": ({"frame": [0, 2]}, r"from 0 to 1, one focal length each, but frame\[1\] is 2"),
    "negative frame": ({"frame": [-1, 0]}, r"frame\[0\] is -1"),
    "frame of floats": ({"frame": [0.0, 1.0]}, "frame must hold integers, but its dtype is float"),
    "frames too many": ({"frame": [0, 1, 1]}, r"frame must have shape \(line,\) = \(2,\).*is \(3,\)"),
    "centre in three": ({"centre": [1.0, 2.0, 3.0]}, r"centre must have shape \(2,\)"),
    "NaN centre": ({"centre": [np.nan, 2.0]}, r"centre must be finite, but centre\[0\] is nan"),
    "image size of one": ({"image_size": (640,)}, "image_size must be two positive integers"),
    "negative image size": ({"image_size": (640, -480)}, "image_size must be two positive integers"),
    "unit": ({"focal_unit": "inch"}, 'focal_unit must be "mm" or "px"'),
    "negative weight": ({"weight": [1.0, -1.0]}, r"weight must be finite and at least 0, but weight\[1\]"),
    "weights too few": ({"weight": [1.0]}, r"weight must have shape \(line,\) = \(2,\)"),
    "NaN focus": ({"focus": [0.0, np.nan]}, r"focus must be finite, but focus\[1\]"),
    "focuses too many": ({"focus": [0.0] * 3}, r"focus must have shape \(frame,\) = \(2,\)"),
    "numbers too many": ({"number": [0, 1, 2]}, r"number must have shape \(line,\) = \(2,\)"),
}
LINES = LINES_ALIKE | {
    "mask of another shape": (
        {"mask": np.ones((2, 4), bool)},
        r"\(line, point\) = \(2, 5\)",
    ),
    "mask of integers": ({"mask": np.ones((2, 5), int)}, "mask must hold booleans, but its dtype is int"),
    "points flat": ({"points": np.zeros((2, 10))}, r"points must have shape \(line, point, 2\)"),
    "points in three": ({"points": np.zeros((2, 5, 3))}, r"points must have shape \(line, point, 2\)"),
    "ragged points": ({"points": [[[1.0, 2.0]], [[1.0]]]}, "points must hold real numbers"),
    "NaN points": ({"points": np.full((2, 5, 2), np.nan)}, r"points must be finite where mask is set"),
}
COMPRESSED = LINES_ALIKE | {
    "even rows": ({"triangle": np.zeros((2, 6, 6))}, r"2 N \+ 3 rows for N terms"),
    "not square": ({"triangle": np.zeros((2, 7, 5))}, r"triangle must have shape \(line, rows, rows\)"),
    "too small": ({"triangle": np.zeros((2, 3, 3))}, r"2 N \+ 3 rows for N terms"),
}
LENS = {
    "range reversed": ({"focal_range": [80.0, 20.0]}, "two numbers in order, the least first"),
    "range negative": ({"focal_range": [-20.0, 80.0]}, r"finite and positive, but focal_range\[0\] is -20"),
    "range NaN": ({"focal_range": [20.0, np.nan]}, r"focal_range\[1\] is nan"),
    "range of three": ({"focal_range": [20.0, 30.0, 80.0]}, r"focal_range must have shape \(2,\)"),
    "focus reversed": ({"focus_range": [1.0, 0.0]}, "focus_range must be two numbers in order"),
    "centre": ({"centre": [1.0]}, r"centre must have shape \(2,\)"),
    "centre infinite": ({"centre": [np.inf, 0.0]}, r"centre\[0\] is inf"),
    "image size": ({"image_size": 640}, "image_size must be two positive integers"),
    "unit": ({"focal_unit": "cm"}, 'must be "mm" or "px"'),
    "no model": ({"zoom": 2}, r"zoom must be a zoom model .* its type is int: PolynomialZoom\(degree"),
    "class of a model": ({"zoom": zj.PolynomialZoom}, r"it is the class PolynomialZoom: pass an instance"),
    "model not fitted": ({"zoom": zj.PolynomialZoom()}, "specified but not fitted"),
    "class of a distortion model": (
        {"distortion_model": zj.models.Division},
        "it is the class Division: pass an instance",
    ),
    "two for Brown and Conrady": (
        {"distortion_model": zj.models.BrownConrady()},
        "zoom must give from 3 to 6 coefficients, for a BrownConrady, but it gives 2",
    ),
    "a shift of three": (
        {"shift": zj.PolynomialZoom(0, [[0.0, 0.0, 0.0]], 20.0)},
        "shift must give two numbers, the offset of the centre, but it gives 3",
    ),
}


def refused(make, fields, change, message):
    with pytest.raises((ValueError, TypeError), match=message):
        make(**fields | change)


@pytest.mark.parametrize(("change", "message"), LINES.values(), ids=LINES)
def test_lines(change, message, unchecked):
    refused(zj.Lines, lines_fields(), change, message)


@pytest.mark.parametrize(("change", "message"), COMPRESSED.values(), ids=COMPRESSED)
def test_compressed_lines(change, message, unchecked):
    refused(zj.lines.CompressedLines, compressed_fields(), change, message)


@pytest.mark.parametrize("rows", [7, 20, 22, 3])
def test_lines_for_any_centre(rows, unchecked):
    fields = compressed_fields() | {"triangle": np.tile(np.eye(rows), (2, 1, 1))}
    with pytest.raises(ValueError, match=r"\(2 N \+ 2\)\(2 N \+ 3\) / 2 rows"):
        zj.lines.AnyCentreLines(**fields)
    zj.lines.AnyCentreLines(**fields | {"triangle": np.tile(np.eye(21), (2, 1, 1))})


@pytest.mark.parametrize(("change", "message"), LENS.values(), ids=LENS)
def test_lens(change, message, unchecked):
    refused(zj.ZoomLens, lens_fields(), change, message)


def test_what_is_in_order_passes(unchecked):
    """The fields that the cases above spoil are sound."""
    assert zj.Lines(**lines_fields()).points.shape == (2, 5, 2)
    assert zj.lines.CompressedLines(**compressed_fields()).terms == 2
    lens = zj.ZoomLens(**lens_fields())
    assert lens.image_size == (640, 480)
    assert hash(lens.image_size) == hash((640, 480))
    assert lens(40.0).undistort(np.zeros(2)).shape == (2,)


def test_points_that_are_padding_may_be_anything(unchecked):
    fields = lines_fields()
    fields["points"][0, 4], fields["mask"][0, 4] = np.nan, False
    zj.Lines(**fields)


@every_zoom
def test_a_row_too_many(model, unchecked):
    ready = prepared(model)
    more = jnp.concatenate([ready.parameters, ready.parameters[:1]])
    with pytest.raises(ValueError, match=r"must have shape .*, but its shape is "):
        dataclasses.replace(ready, parameters=more)
    with pytest.raises(ValueError, match="parameters must have shape"):
        dataclasses.replace(ready, parameters=ready.parameters[:, 0])
    with pytest.raises(ValueError, match="parameters must hold real numbers"):
        dataclasses.replace(ready, parameters=[["a"]])


@every_zoom
@pytest.mark.parametrize("value", [0.0, -20.0, np.nan, np.inf])
def test_lengths_that_are_none(model, value, unchecked):
    ready = prepared(model)
    for name in ("focal_ref", "crossover"):
        if hasattr(ready, name):
            with pytest.raises(ValueError, match=f"{name} must be finite and positive, but it is {value}"):
                dataclasses.replace(ready, **{name: value})
            with pytest.raises(ValueError, match=rf"{name} must have shape \(\), but its shape is \(2,\)"):
                dataclasses.replace(ready, **{name: [20.0, 30.0]})
    if hasattr(ready, "knots"):
        with pytest.raises(ValueError, match=r"knots must be finite and positive, but knots\[0\]"):
            dataclasses.replace(ready, knots=np.r_[value, ready.knots[1:]])


@every_zoom
def test_knots_that_do_not_increase_or_are_too_few(model, unchecked):
    ready = prepared(model)
    for name in ("knots", "focus_knots"):
        if hasattr(ready, name):
            knots = np.asarray(getattr(ready, name))
            with pytest.raises(ValueError, match=f"{name} must increase from entry to entry"):
                dataclasses.replace(ready, **{name: knots[::-1]})
            with pytest.raises(ValueError, match="must have shape"):
                dataclasses.replace(ready, **{name: knots[1:]})
    if hasattr(ready, "curvature"):
        with pytest.raises(ValueError, match="curvature must have shape"):
            dataclasses.replace(ready, curvature=np.asarray(ready.curvature)[1:])


def test_a_prior_that_is_none(unchecked):
    with pytest.raises(ValueError, match="error must be finite and at least 0, but it is -1"):
        zj.SmoothZoom(error=-1.0)
    with pytest.raises(ValueError, match=r"beyond must be finite, but beyond\[0, 0\] is nan"):
        zj.SmoothZoom(beyond=np.full((2, 2), np.nan))
    with pytest.raises(TypeError, match="inverse must be True or False"):
        zj.models.TableZoom(inverse="f")


def test_lists_and_integers_are_taken(unchecked):
    zoom = zj.PolynomialZoom(1, [[0, 0], [1, 2]], 20)
    assert zoom.parameters.dtype == jnp.result_type(float)
    np.testing.assert_array_equal(zoom(40.0), [0.5, 1.0])
    assert zj.models.TableZoom(parameters=[[0.1], [0.2]], knots=[0.02, 0.04])(40.0).shape == (1,)
    assert jnp.issubdtype(zj.Lines(**lines_fields()).frame.dtype, jnp.integer)


# What is no mistake: everything that JAX and equinox put into fields


@every_zoom
def test_under_jit_and_vmap_values_are_not_looked_at(model):
    ready = prepared(model)
    arrays, rest = eqx.partition(ready, eqx.is_array)

    @jax.jit
    def rebuilt(arrays):
        zoom = eqx.combine(arrays, rest)
        return dataclasses.replace(zoom, parameters=zoom.parameters + 1)

    assert eqx.tree_equal(rebuilt(arrays).parameters, ready.parameters + 1)
    batch = jax.vmap(lambda shift: dataclasses.replace(ready, parameters=ready.parameters + shift))(
        jnp.arange(3.0)
    )
    assert batch.parameters.shape == (3, *ready.parameters.shape)


@every_zoom
def test_a_batch_passes_and_its_values_are_checked(model, unchecked):
    batch = jax.vmap(lambda f: jax.tree.map(lambda leaf: f * leaf, prepared(model)))(jnp.array([1.0, 2.0]))
    assert eqx.tree_equal(dataclasses.replace(batch, parameters=batch.parameters + 0), batch)
    if hasattr(batch, "focal_ref"):
        with pytest.raises(ValueError, match=r"focal_ref\[1\] is -1"):
            dataclasses.replace(batch, focal_ref=np.array([20.0, -1.0]))


def test_stand_ins_pass(clean, unchecked):
    lens = zj.ZoomLens(**lens_fields())
    shapes = eqx.filter_eval_shape(lambda lens: lens, lens)
    for stand_in in (None, True, object(), shapes.centre):
        assert dataclasses.replace(lens, centre=stand_in).centre is stand_in
    for stand_in in (True, object()):
        assert dataclasses.replace(lens, zoom=stand_in).zoom is stand_in
    rebuilt = zj.ZoomLens(**vars(shapes))
    assert rebuilt.focal_range.shape == (2,)
    lines = eqx.filter_eval_shape(lambda lines: lines, clean)
    assert zj.Lines(**vars(lines)).points.shape == clean.points.shape
    with pytest.raises(ValueError, match="mask must have shape"):
        dataclasses.replace(lines, mask=jax.ShapeDtypeStruct((3, 4), bool))


def test_a_batch_of_lenses_passes(unchecked):
    def one(f):
        return zj.ZoomLens(
            zj.models.PowerZoom(jnp.ones((3, 2)) * f, f), jnp.zeros(2), jnp.stack([f, 2 * f]), SIZE
        )

    lenses = jax.vmap(one)(jnp.array([20.0, 30.0]))
    assert lenses.focal_range.shape == (2, 2)
    again = zj.ZoomLens(**vars(lenses))
    assert again.image_size == SIZE


def test_a_model_that_cannot_be_traced_passes(unchecked):
    class Stepped(zj.models.AbstractZoom):
        parameters: jax.Array

        def prepare(self, focal, terms):
            return self

        def __call__(self, focal):
            return self.parameters if focal < 30 else 2 * self.parameters

    lens = zj.ZoomLens(**lens_fields() | {"zoom": Stepped(jnp.zeros(2))})
    assert lens(25.0).coefficients.shape == (2,)


def test_many_values_of_jax_are_not_waited_for():
    assert _fields.known(jnp.zeros(_fields._FEW + 1)) is None
    assert _fields.known(jnp.zeros(3)) is not None
    assert _fields.known(np.zeros(_fields._FEW + 1)) is not None
    gone = jnp.zeros(3)
    gone.delete()
    assert _fields.known(gone) is None


def _masked(*shape):
    """Of which something is masked: whoever looks at the numbers alone takes it for the rest."""
    values = np.ma.masked_array(np.arange(1.0, 1 + np.prod(shape)).reshape(shape))
    values[..., -1] = np.ma.masked
    return values


def _line():
    return np.stack([np.arange(5.0), np.arange(5.0)], axis=-1)


TAKERS = {
    "points of lines": lambda: zj.Lines.from_ragged([_masked(5, 2)], [0], [24.0], image_size=SIZE),
    "frames of lines": lambda: zj.Lines.from_ragged([_line()] * 2, _masked(2), [24.0], image_size=SIZE),
    "focal lengths of lines": lambda: zj.Lines.from_ragged([_line()], [0], _masked(1), image_size=SIZE),
    "a centre": lambda: zj.Lines.from_ragged([_line()], [0], [24.0], image_size=SIZE, centre=_masked(2)),
    "focus": lambda: zj.Lines.from_ragged([_line()], [0], [24.0], image_size=SIZE, focus=_masked(1)),
    "fields of lines": lambda: zj.Lines(**lines_fields() | {"points": _masked(2, 5, 2)}),
    "weights": lambda: zj.Lines(**lines_fields()).weighted(_masked(2)),
    "deviations": lambda: zj.fit.fit_focal(zj.Lines(**lines_fields()), _masked(2)),
    "tracks": lambda: zj.tracks.Tracks.from_arrays([0, 0], [0, 1], _masked(2, 2), image_size=SIZE),
    "weights of views": lambda: zj.tracks.Tracks.from_arrays(
        [0, 0], [0, 1], np.arange(4.0).reshape(2, 2), image_size=SIZE, weight=_masked(2)
    ),
    "focal tracks": lambda: zj.io.FocalTrack(_masked(2), [20.0, 60.0]),
    "zoom models": lambda: zj.PolynomialZoom(1, _masked(2, 2), 20.0),
    "lenses": lambda: zj.ZoomLens(**lens_fields() | {"centre": _masked(2)}),
    "distortions": lambda: zj.Distortion(_masked(2), np.zeros(2), np.array(1.0)),
}


@pytest.mark.parametrize("take", TAKERS.values(), ids=TAKERS)
@pytest.mark.usefixtures("unchecked")
def test_masks_of_arrays_are_not_lost(take):
    with pytest.raises(ValueError, match="mask"):
        take()
