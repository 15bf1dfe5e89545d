"""Values as a structure and arrays."""

import enum
import functools
import os

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from hypothesis import given
from hypothesis import strategies as st

import zoomjax as zj
from zoomjax._core.structure import UnknownError, found, named, put_together, taken_apart, wrapped_name
from zoomjax.fit import RESULTS
from zoomjax.models import About, Model

from ._trees import equal

PLAIN = st.none() | st.booleans() | st.integers() | st.text() | st.floats(allow_nan=False)
NESTED = st.recursive(
    PLAIN | st.just("array"),
    lambda part: st.lists(part) | st.tuples(part, part) | st.dictionaries(st.text(), part),
)


@given(NESTED)
def test_what_is_taken_apart_is_put_together(value):
    value = jax.tree.map(lambda leaf: np.arange(3) if leaf == "array" else leaf, value)
    arrays = []
    structure = taken_apart(value, arrays)
    equal(put_together(structure, iter(arrays)), value)
    assert [id(of) for of in arrays] == [id(of) for of in jax.tree.leaves(value) if eqx.is_array(of)]


OBJECTS = [
    RESULTS.folded,
    optx.RESULTS.successful,
    RESULTS,
    zj.PolynomialZoom(degree=3),
    zj.PolynomialZoom(1, jnp.ones((2, 2)), jnp.array(20.0)),
    Model(zj.SmoothZoom(), 2),
    zj.Distortion(np.array([0.1]), np.zeros(2), np.array(1.0), zj.models.Division()),
    About({"camera": "a", "crop_factor": 1.5}),
    optx.max_norm,
    functools.partial(zj.fit_zoom, terms=1),
    jax.tree_util.Partial(optx.max_norm, jnp.ones(2)),
    np.dtype("float32"),
    float("inf"),
    -0.0,
]


@pytest.mark.parametrize("value", OBJECTS, ids=lambda value: type(value).__name__)
def test_objects_of_known_packages_have_names(value):
    arrays = []
    structure = taken_apart(value, arrays)
    found = put_together(structure, iter(arrays))
    again = []
    assert taken_apart(found, again) == structure
    equal(again, arrays)
    assert type(found) is type(value)


class Own(enum.Enum):
    ONE = 1


UNKNOWN = [Own.ONE, lambda x: x, os.system, zj.io, {1, 2}, 1j, {1: 2}, b"bytes"]
UNKNOWN += map(np.dtype, ["U3", ">f8", [("a", int)], jnp.bfloat16])


@pytest.mark.parametrize("value", UNKNOWN, ids=range(len(UNKNOWN)))
def test_what_has_no_name_is_said_to_have_none(value):
    with pytest.raises(UnknownError):
        taken_apart([value], [])


@pytest.mark.parametrize(
    "name", ["os:system", "zoomjax._core.files:os.system", "zoomjax:no_such", "zoomjax.fit.zoom:__doc__"]
)
def test_what_is_not_of_a_known_package_is_not_found(name):
    with pytest.raises(UnknownError):
        found(name)
    with pytest.raises(UnknownError):
        put_together(["named", name, [["plain", "true"]]], iter([]))


def test_structures_of_another_kind_are_refused():
    with pytest.raises(UnknownError):
        put_together(["something", 1], iter([]))


def test_functions_have_the_name_of_their_module_and_tell_decorators_apart():
    assert named(zj.fit_zoom) == "zoomjax.fit.zoom:fit_zoom"
    assert wrapped_name(zj.fit_zoom) == "zoomjax.fit.zoom:fit_zoom, 0"
    assert wrapped_name(zj.fit_zoom.__wrapped__) == "zoomjax.fit.zoom:fit_zoom, 1"
    with pytest.raises(UnknownError):
        wrapped_name(functools.wraps(zj.fit_zoom)(lambda *of: zj.fit_zoom(*of)))
