"""What distortions are made of and act on: shapes, and values where they are known."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._core.arguments import check_kind
from .._core.checks import warn_caller
from .._core.fields import check_finite, check_positive, refuse_masked
from .._core.types import traced
from .distortion_model import AbstractDistortionModel

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
    if points.shape[-1:] != (size,):
        raise ValueError(f"Argument points must have shape {shape}, but its shape is {points.shape}.")
    real = jnp.issubdtype(points.dtype, jnp.integer) or jnp.issubdtype(points.dtype, jnp.floating)
    if not real or points.dtype.kind == "m":  # spans of time are integers to NumPy
        raise ValueError(f"Argument points must hold real numbers, but its dtype is {points.dtype}.")
    if jnp.issubdtype(points.dtype, jnp.integer):
        return points.astype(float)
    return points.astype(np.float32) if points.dtype.itemsize < 4 else points


def as_focal(focal: Any) -> Any:
    """Focal lengths as an array of floats.

    Raises:
        ValueError: they are not numbers.
    """
    if isinstance(focal, jax.Array):
        if not jnp.issubdtype(focal.dtype, jnp.integer) and not jnp.issubdtype(focal.dtype, jnp.floating):
            raise ValueError(f"Argument focal must hold real numbers, but its dtype is {focal.dtype}.")
        return focal
    refuse_masked("focal", focal, _NAN)
    try:
        array = np.asarray(focal)
        if array.dtype.kind in "iufO":
            return array.astype(float)
    except (TypeError, ValueError) as error:
        raise ValueError(f"Argument focal must be a number or an array, but it is {focal!r}.") from error
    raise ValueError(f"Argument focal must be a number or an array, but it is {focal!r}.")


def check_focus(focus: Any, fitted: Any) -> None:
    """Warn where a focus is outside of the range `fitted`, where both are known: in another unit, say.

    Raises:
        ValueError: it is not finite.
    """
    if focus is None or fitted is None or traced((focus, fitted)):
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


def check_broadcast(points: tuple[Any, ...], focal: tuple[Any, ...]) -> None:
    """Raise ValueError where there are neither as many focal lengths as points nor one for many."""
    try:
        jnp.broadcast_shapes(points, focal)
    except ValueError as error:
        raise ValueError(
            f"Argument focal must have a shape that broadcasts with that of the points, {points}, one for "
            f"all or one for each, but its shape is {focal}."
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
