"""What of a lens to train, where it is part of a larger model that gradient descent fits.

A lens holds more arrays than its model's parameters: the reference of the focal lengths, the fitted range,
the image's centre, knots, priors. Their gradients are not zero, and an optimiser would move them.
"""

from typing import Any

import equinox as eqx
import jax
from jaxtyping import PyTree

from .distortion import Distortion
from .lens import ZoomLens
from .zoom import AbstractZoom, with_parameters


def trainable(tree: PyTree, *, centre: bool = False) -> PyTree:
    """Which arrays of a lens are parameters: a filter for `equinox.partition`.

    Of a zoom model, and of a lens with one, its `parameters`; of a `Distortion` its coefficients; and, if
    asked, the centre of distortion and the parameters of how it moves. Nothing else of them: not the
    reference or the range of focal lengths, knots, scale or prior.

    Args:
        tree: a `ZoomLens`, a `Distortion`, a zoom model, or any pytree that holds some. Whatever else it
            holds is not marked.
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
