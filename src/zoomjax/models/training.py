"""Selection of the trainable arrays of a lens, for gradient descent on a larger model.

A lens holds more arrays than its model's parameters: the reference focal length, the fitted range, the
image's centre, knots, priors. Their gradients are not zero, so an optimiser would change them.
"""

from typing import Any

import equinox as eqx
import jax
from jaxtyping import PyTree

from .._core.arguments import kinds_checked
from .distortion import Distortion
from .lens import ZoomLens
from .zoom import AbstractZoom, with_parameters


@kinds_checked
def trainable(tree: PyTree, *, centre: bool = False) -> PyTree:
    """Mark the trainable arrays of a lens: a filter for `equinox.partition`.

    Trainable are the `parameters` of a zoom model or of the zoom model of a lens, and the coefficients of a
    `Distortion`; with `centre` also the centre of distortion and the parameters of its movement. Not
    trainable are the reference and range of focal lengths, knots, scale and prior.

    Args:
        tree: a `ZoomLens`, a `Distortion`, a zoom model, or any pytree that holds some. Other arrays in it
            are not marked.
        centre: whether the centre of distortion is a parameter, too.

    Returns:
        A pytree of the same structure with True where an array is to be trained, and else False.

    Example:
        >>> import equinox as eqx, jax, jax.numpy as jnp
        >>> from zoomjax import scenes
        >>> lens, point = scenes.nikkor_18_200(), jnp.array([100.0, 100.0])
        >>> parameters, rest = eqx.partition(lens, trainable(lens))
        >>> def loss(parameters):
        ...     return jnp.sum((eqx.combine(parameters, rest)(50.0).undistort(point) - 99) ** 2)
        >>> before = loss(parameters)
        >>> for _ in range(3):  # or optax: updates, state = optimiser.update(gradient, state, parameters)
        ...     gradient = jax.grad(loss)(parameters)
        ...     updates = jax.tree.map(lambda g: -1e-9 * g, gradient)
        ...     parameters = eqx.apply_updates(parameters, updates)
        >>> trained = eqx.combine(parameters, rest)
        >>> bool(loss(parameters) < before), bool(trained.zoom.focal_ref == lens.zoom.focal_ref)
        (True, True)
    """

    def is_ours(node: Any) -> bool:
        return isinstance(node, ZoomLens | Distortion | AbstractZoom)

    def mark(node: Any) -> Any:
        nothing = jax.tree.map(lambda _: False, node)
        if isinstance(node, ZoomLens):
            marked = [(lambda lens: lens.zoom, mark(node.zoom))]
            if centre:
                marked.append((lambda lens: lens.centre, True))
                if node.shift is not None:
                    marked.append((lambda lens: lens.shift, mark(node.shift)))
        elif isinstance(node, Distortion):
            marked = [(lambda d: d.coefficients, True)]
            if centre:
                marked.append((lambda d: d.centre, True))
        elif isinstance(node, AbstractZoom) and node.parameters is not None:
            return with_parameters(nothing, jax.tree.map(eqx.is_inexact_array, node.parameters))
        else:
            return nothing
        for where, what in marked:
            nothing = eqx.tree_at(where, nothing, what)
        return nothing

    return jax.tree.map(mark, tree, is_leaf=is_ours)
