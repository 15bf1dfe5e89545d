"""What distortions are made of and act on: shapes, and values where they are known."""

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._core.arguments import check_kind
from .._core.checks import warn_caller
from .._core.fields import FOCALS, check_finite, check_positive, refuse_masked
from .._core.types import traced
from .distortion_model import AbstractDistortionModel

SLACK = 5e-4
"""Share of a focal length by which it may be beyond the range: the end itself, written with four digits."""

_NAN = "give an array with NaN in place of what is masked, .filled(np.nan)"


def as_points(points: Any, size: int = 2) -> Any:
    """Points as an array (..., size) of float32 or float64.

    Raises:
        ValueError: they are not real numbers, or of another shape.
    """
    shape = f"(..., {size})"
    if not isinstance(points, jax.Array):
        refuse_masked("points", points, _NAN)
        try:
            points = np.asarray(points)
        except (TypeError, ValueError) as error:
            raise ValueError(f"Argument points must be an array of shape {shape}: {error}.") from error
        if points.shape == (0,):  # an empty list, as of a frame in which nothing was found
            points = points.reshape(0, size)
    if points.shape[-1:] != (size,):
        raise ValueError(f"Argument points must have shape {shape}, but its shape is {points.shape}.")
    real = jnp.issubdtype(points.dtype, jnp.integer) or jnp.issubdtype(points.dtype, jnp.floating)
    if not real or points.dtype.kind == "m":  # spans of time are integers to NumPy
        raise ValueError(f"Argument points must hold real numbers, but its dtype is {points.dtype}.")
    if jnp.issubdtype(points.dtype, jnp.integer):
        return points.astype(float)
    return points.astype(np.float32) if points.dtype.itemsize < 4 else points


def as_focal(focal: Any, name: str = "focal") -> Any:
    """Focal lengths, or what else there is of them, as an array of floats.

    Raises:
        ValueError: they are not numbers.
    """
    if isinstance(focal, jax.Array):
        if not jnp.issubdtype(focal.dtype, jnp.integer) and not jnp.issubdtype(focal.dtype, jnp.floating):
            raise ValueError(f"Argument {name} must hold real numbers, but its dtype is {focal.dtype}.")
        return focal
    refuse_masked(name, focal, _NAN)
    try:
        array = np.asarray(focal)
        if array.dtype.kind in "iufO":
            return array.astype(float)
    except (TypeError, ValueError) as error:
        raise ValueError(f"Argument {name} must be a number or an array, but it is {focal!r}.") from error
    raise ValueError(f"Argument {name} must be a number or an array, but it is {focal!r}.")


def check_focus(focus: Any, fitted: Any) -> None:
    """Warn where a focus is outside of the range `fitted`, where both are known: in another unit, say.

    Raises:
        ValueError: it is not finite, or no number.
    """
    if focus is None or traced(focus):
        return
    focus = as_focal(focus, "focus")
    if fitted is None or traced(fitted):
        return
    values, (low, high) = np.ravel(np.asarray(focus, float)), np.asarray(fitted, float).tolist()
    if not np.isfinite(values).all():
        raise ValueError(f"Argument focus must be finite, but it is {values[~np.isfinite(values)][0]}.")
    slack = 1e-6 * max(abs(low), abs(high))
    if outside := values[(values < low - slack) | (values > high + slack)].tolist():
        warn_caller(
            f"The focus {outside[0]:g} is not within the range on which the lens was fitted, {low:g} to "
            f"{high:g}, in the unit of its lines: beyond it the distortion of its end is taken."
        )


def check_range_of(focal: Any, focal_range: Any, unit: str, *, stacklevel: int) -> None:
    """Warn of known focal lengths outside of a range, and refuse those that are none.

    By NumPy alone: under ``jit`` even an operation of JAX on known arrays is traced.
    """
    low, high = np.asarray(focal_range, np.float64).tolist()
    values = np.ravel(np.asarray(focal))
    if not values.size:
        return
    least, most = float(values.min()), float(values.max())  # NaN if one is: two passes are quick
    if not (least >= FOCALS[0] and most <= FOCALS[1]):
        bad = values[~((values >= FOCALS[0]) & (values <= FOCALS[1]))][0]
        told = f", {FOCALS[0]:g} to {FOCALS[1]:g} mm or px" if 0 < bad < np.inf else ""
        raise ValueError(f"Argument focal must be a positive number{told}, but it is {bad}.")
    if least < low - SLACK * least or most > high + SLACK * most:
        outside = f"The focal length {least:g} {unit} is not"
        if values.size > 1:
            outside = f"Focal lengths from {least:g} to {most:g} {unit} are not all"
        warnings.warn(
            f"{outside} within the range on which the lens was fitted, {low:g} to {high:g} "
            f"{unit}: beyond it the distortion is extrapolated.",
            stacklevel=stacklevel + 1,
        )


def check_one_lens(centre: Any) -> None:
    """Raise ValueError for several lenses in one, as `jax.vmap` and ``jax.tree.map(jnp.stack)`` make."""
    if np.ndim(centre) > 1:
        raise ValueError(
            f"These are {np.shape(centre)[0]} lenses in one: call them by jax.vmap(lambda lens: lens(f))"
            "(lenses), and save each by itself, jax.tree.map(lambda leaf: leaf[0], lenses) the first."
        )


def check_settings(points: tuple[Any, ...], focal: Any, focus: Any) -> None:
    """Raise ValueError where there are neither as many of each as of the others nor one for many.

    Args:
        points: the leading shape of the points.
        focal: focal lengths.
        focus: focuses, of which there is a pair with a focal length for each distortion; or None.
    """
    shapes = np.shape(focal), np.shape(focus)
    try:
        both = jnp.broadcast_shapes(*shapes)
    except ValueError as error:
        raise ValueError(
            "Argument focus must have a shape that broadcasts with that of focal, one for all or one for "
            f"each, but their shapes are {shapes[1]} and {shapes[0]}."
        ) from error
    try:
        jnp.broadcast_shapes(points, both)
    except ValueError as error:
        raise ValueError(
            f"Argument focal must have a shape that broadcasts with that of the points, {points}, one for "
            f"all or one for each, but its shape{' with that of focus' * bool(shapes[1])} is {both}."
        ) from error


def check_distortion(coefficients, centre, scale, distortion_model):
    """What a `Distortion` is made of: shapes, and values where they are known."""
    if isinstance(distortion_model, bool) or type(distortion_model) is object:
        return  # stands for one in filters and trees
    check_kind("distortion_model", distortion_model, (AbstractDistortionModel,))
    parts = {"coefficients": coefficients, "centre": centre, "scale": scale}
    if not all(hasattr(part, "shape") and hasattr(part, "dtype") for part in parts.values()):
        if any(isinstance(part, np.ndarray | jax.Array) for part in parts.values()):
            missing = next(name for name, part in parts.items() if not hasattr(part, "dtype"))
            raise ValueError(f"Argument {missing} must hold real numbers, but it is {parts[missing]!r}.")
        return  # a stand-in, of a pytree's structure
    check_terms("coefficients", coefficients.shape[-1] if coefficients.ndim else 0, distortion_model)
    if centre.shape[-1:] != (2,):
        raise ValueError(f"Argument centre must be (x, y), but its shape is {centre.shape}.")
    batch = coefficients.shape[:-1]
    for name, shape in (("centre", centre.shape[:-1]), ("scale", scale.shape)):
        if shape not in ((), batch):
            raise ValueError(
                f"Argument {name} must be one for all distortions or one for each of {batch}, but its "
                f"shape is {parts[name].shape}."
            )
    check_finite("coefficients", coefficients)
    check_finite("centre", centre)
    check_positive("scale", scale)


def check_terms(name: str, size: int, distortion_model: AbstractDistortionModel) -> None:
    """Raise ValueError where a distortion model has no such number of coefficients."""
    sizes = [
        distortion_model.num_coefficients(terms) for terms in range(1, distortion_model.most_terms + 1)
    ]
    more = [distortion_model.num_coefficients(terms) for terms in distortion_model.more_terms]
    if size in (*sizes, *more):
        return
    opencv = ": OpenCV's (k1, k2, p1, p2, k3, ...) are of another model" * (size in (5, 8, 12, 14))
    raise ValueError(
        f"Argument {name} must give from {min(sizes)} to {max(sizes)} coefficients"
        f"{''.join(f', or {number}' for number in more)}, for a {type(distortion_model).__name__}, but it "
        f"gives {size}{opencv}."
    )
