"""What of a lens gradient descent moves."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zoomjax as zj

from ..test_constructors import SIZE, ZOOMS, every_zoom, prepared

POINTS = jnp.array([[100.0, 80.0], [600.0, 40.0], [320.0, 470.0]])


def lens_with(zoom, **more):
    focus = jnp.array([0.0, 1.0]) if isinstance(zoom, zj.models.AbstractFocusZoom) else None
    return zj.ZoomLens(
        zoom, jnp.array([310.0, 236.0]), jnp.array([18.0, 200.0]), SIZE, focus_range=focus, **more
    )


def trained(thing, corrected, **options):
    """After ten steps of gradient descent towards points 1 % farther out."""
    parameters, rest = eqx.partition(thing, zj.models.trainable(thing, **options))

    def loss(parameters):
        return jnp.mean((corrected(eqx.combine(parameters, rest)) - 1.01 * POINTS) ** 2)

    step = jax.jit(jax.value_and_grad(loss))
    first, _ = step(parameters)
    for _ in range(10):
        _, gradient = step(parameters)
        parameters = eqx.apply_updates(parameters, jax.tree.map(lambda g: -1e-7 * g, gradient))
    assert step(parameters)[0] < first
    return eqx.combine(parameters, rest)


def moved(before, after):
    """The paths of the arrays that are not what they were, to the last bit."""
    pairs = zip(jax.tree_util.tree_leaves_with_path(before), jax.tree.leaves(after), strict=True)
    return {jax.tree_util.keystr(path) for (path, old), new in pairs if not np.array_equal(old, new)}


@every_zoom
def test_of_a_lens_only_the_parameters_move(model):
    lens = lens_with(prepared(model))
    f = (50.0, 0.5) if isinstance(model, zj.models.AbstractFocusZoom) else (50.0,)
    after = trained(lens, lambda lens: lens(*f).undistort(POINTS))
    assert moved(lens, after) == {".zoom.parameters"}


def test_the_centre_moves_if_asked():
    shift = zj.PolynomialZoom(1).prepare(jnp.array([18.0, 200.0]), 2)
    lens = lens_with(prepared(ZOOMS["polynomial"]), shift=shift)

    def corrected(lens):
        return lens(50.0).undistort(POINTS)

    lens = trained(lens, corrected)  # without distortion the centre has no effect
    assert moved(lens, trained(lens, corrected)) == {".zoom.parameters"}
    after = trained(lens, corrected, centre=True)
    assert moved(lens, after) == {".zoom.parameters", ".centre", ".shift.parameters"}


def test_of_a_distortion_only_the_coefficients_move():
    d = zj.Distortion(jnp.array([0.1]), jnp.array([310.0, 236.0]), jnp.asarray(400.0))
    assert moved(d, trained(d, lambda d: d.undistort(POINTS))) == {".coefficients"}
    after = trained(d, lambda d: d.undistort(POINTS), centre=True)
    assert moved(d, after) == {".coefficients", ".centre"}


def test_of_a_model_of_users_own_that_holds_one(fit):
    """Other arrays are not marked; the lens of a fit is one like any other."""
    tree = {"lens": fit.lens, "pose": jnp.zeros(6), "zooms": [fit.lens.zoom, ZOOMS["power"]]}
    marks = zj.models.trainable(tree)
    assert jax.tree.structure(marks) == jax.tree.structure(tree)
    marked = [path for path, mark in jax.tree_util.tree_leaves_with_path(marks) if mark]
    assert {jax.tree_util.keystr(path) for path in marked} == {
        "['lens'].zoom.parameters",
        "['zooms'][0].parameters",
    }


@pytest.mark.parametrize("centre", [False, True])
def test_nothing_but_booleans(centre, truth):
    assert {type(mark) for mark in jax.tree.leaves(zj.models.trainable(truth, centre=centre))} == {bool}
