"""What fields of modules must be: converters that take lists, and checks of shapes and values.

Constructors run under every transformation, and with stand-ins for arrays: tracers, `ShapeDtypeStruct`,
None, booleans (of filters), bare objects. Shapes are checked wherever there is one, values only where they
are known and looking costs nothing: those of NumPy arrays, and of JAX arrays that are small. A module that
`vmap` made has one more axis in front of all of its arrays, and passes.
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from .arrays import mixes_booleans, numeric

_FEW = 2**16
"""Elements of a JAX array up to which its values are looked at: more would be waited for."""

Axes = tuple[str | int, ...]

_KINDS = {"real numbers": jnp.floating, "integers": jnp.integer, "booleans": jnp.bool_}


def refuse_masked(name: str, values: Any, instead: str = "leave out what is masked") -> None:
    """Raise ValueError for an array of NumPy that has a mask, which would be lost."""
    if isinstance(values, np.ma.MaskedArray):
        raise ValueError(f"Argument {name} is a masked array, and masks are not kept: {instead}.")


def refuse_masked_image(name: str, image: Any) -> None:
    """Raise ValueError for an image with a mask, as `refuse_masked`."""
    refuse_masked(name, image, "give its .data, or .filled(0), with black where it is masked")


def numbers(name: str) -> Callable[[Any], Any]:
    """A converter for a field of real numbers: lists and integers become arrays of floats."""
    return _converter(name, "real numbers")


def real_argument(name: str, value: Any) -> Any:
    """Real numbers that a function is given, as an array: no words, booleans, None or masked array.

    Raises:
        ValueError: they are something else.
    """
    if value is None or isinstance(value, bool):
        raise ValueError(f"Argument {name} must hold real numbers, but it is {value}.")
    return numbers(name)(value)


def settings(name: str) -> Callable[[Any], Any]:
    """As `numbers`, of what a lens is set to in each frame: settings that differ by rounding are one.

    Models, folds and covariances count distinct settings. A third that was computed is no other one than a
    third that was read, nor is a number that was float32 once.
    """
    convert = numbers(name)

    def one(value: Any) -> Any:
        array = convert(value)
        own = known(array)
        if own is None or own.ndim != 1 or (same := without_rounding(own)) is own:
            return array
        return same if isinstance(array, np.ndarray) else jnp.asarray(same)

    return one


def without_rounding(values: np.ndarray) -> np.ndarray:
    """The least of those that differ by rounding in place of each; the array itself if none do."""
    order = np.argsort(values, kind="stable")
    ordered = values[order]
    with np.errstate(invalid="ignore"):
        gap, most = np.diff(ordered), _SAME * abs(ordered[:-1])
    if not np.any((gap > 0) & (gap <= most)):
        return values
    for place in range(1, len(ordered)):
        if ordered[place] - ordered[place - 1] <= _SAME * abs(ordered[place - 1]):
            ordered[place] = ordered[place - 1]
    return ordered[np.argsort(order, kind="stable")]


_SAME = 1e-6
"""Part by which settings differ that are one: some last digits of float32, which cameras keep them in."""


def host_numbers(name: str) -> Callable[[Any], Any]:
    """As `numbers`, but lists become NumPy arrays: what is computed from them needs no compilation."""
    return _converter(name, "real numbers", np.array)


def integers(name: str) -> Callable[[Any], Any]:
    """A converter for a field of integers: lists become arrays."""
    return _converter(name, "integers")


def booleans(name: str) -> Callable[[Any], Any]:
    """A converter for a field of booleans: lists become arrays."""
    return _converter(name, "booleans")


def _converter(name: str, kind: str, make: Callable[[Any], Any] = jnp.array) -> Callable[[Any], Any]:
    def convert(value: Any) -> Any:
        if value is None or isinstance(value, bool) or type(value) is object:
            return value
        refuse_masked(name, value)
        array = value
        if not hasattr(value, "dtype"):
            array = _array(value, make) if isinstance(value, int | float | list | tuple) else None
            if array is None:
                raise ValueError(f"Argument {name} must hold {kind}, but it is {_shown(value)}.")
        elif isinstance(value, np.generic) or _is_foreign(value):
            array = np.asarray(value)
        array = numeric(array) if isinstance(array, np.ndarray) else array
        if array.dtype.kind == "m":  # spans of time, which are integers to NumPy
            raise ValueError(f"Argument {name} must hold {kind}, but its dtype is {array.dtype}.")
        if jnp.issubdtype(array.dtype, _KINDS[kind]):
            return array
        if kind == "real numbers" and jnp.issubdtype(array.dtype, jnp.integer) and hasattr(array, "astype"):
            return array.astype(float if isinstance(array, np.ndarray) else jnp.result_type(float))
        raise ValueError(f"Argument {name} must hold {kind}, but its dtype is {array.dtype}.")

    return convert


def _is_foreign(value: Any) -> bool:
    """Whether it is an array of another library, such as a column of pandas, that NumPy can read."""
    return hasattr(value, "__array__") and not isinstance(value, np.ndarray | jax.Array)


def _array(value: Any, make: Callable[[Any], Any]) -> Any:
    """An array of numbers and lists of them; None of anything else."""
    leaves = jax.tree.leaves(value)
    if not all(isinstance(leaf, int | float | complex) or hasattr(leaf, "dtype") for leaf in leaves):
        return None
    if mixes_booleans(value):
        return None
    try:
        return make(value)
    except (TypeError, ValueError, OverflowError):  # rows of different lengths
        return None


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:80]}..., of type {type(value).__name__}"


def check_shapes(fields: Mapping[str, tuple[Any, Axes]]) -> None:
    """Raise ValueError where shapes are not those of the axes: numbers, or names that stand for one each.

    What has no shape is passed over.
    """
    shapes = {name: value.shape for name, (value, _) in fields.items() if hasattr(value, "shape")}
    more = {shape[: max(len(shape) - len(fields[name][1]), 0)] for name, shape in shapes.items()}
    batch = more.pop() if len(shapes) > 1 and len(more) == 1 else ()
    sizes: dict[str, int] = {}
    for name, shape in shapes.items():
        axes = fields[name][1]
        own = shape[len(batch) :]
        fits = len(own) == len(axes)
        if fits:
            both = zip(axes, own, strict=True)
            fits = all(
                have == (axis if isinstance(axis, int) else sizes.setdefault(axis, have))
                for axis, have in both
            )
        if not fits:
            wanted = [axis if isinstance(axis, int) else sizes.get(axis, axis) for axis in axes]
            which = f" = {_tuple(wanted)}" if wanted != list(axes) else ""
            raise ValueError(
                f"Argument {name} must have shape {_tuple(axes)}{which}, but its shape is {_tuple(shape)}."
            )


def _tuple(entries: Any) -> str:
    inner = ", ".join(map(str, entries))
    return f"({inner},)" if len(entries) == 1 else f"({inner})"


def known(value: Any) -> np.ndarray | None:
    """The values of an array, if they are known and few enough to look at."""
    if isinstance(value, np.ndarray):
        return value
    if isinstance(value, Tracer) or not isinstance(value, jax.Array) or value.size > _FEW:
        return None
    return None if value.is_deleted() or not value.is_fully_addressable else np.asarray(value)


def check_present(fields: Mapping[str, Any]) -> None:
    """Raise ValueError where one of the fields is None and others are arrays: all None are a stand-in."""
    missing = [name for name, value in fields.items() if value is None]
    if missing and any(isinstance(value, np.ndarray | jax.Array) for value in fields.values()):
        raise ValueError(f"Argument {missing[0]} must be given, but it is None.")


def check_finite(name: str, value: Any) -> None:
    """Raise ValueError where values are NaN or infinite."""
    if (values := known(value)) is not None:
        _check_each(name, values, np.isfinite(values), "finite")


def check_positive(name: str, value: Any) -> None:
    """Raise ValueError where values are not finite and above zero."""
    if (values := known(value)) is not None:
        _check_each(name, values, np.isfinite(values) & (values > 0), "finite and positive")


FOCALS = (1e-30, 1e30)
"""Focal lengths of any lens in any unit: powers of others are beyond all numbers."""


def check_focal(name: str, value: Any) -> None:
    """Raise ValueError where values are no focal lengths."""
    if (values := known(value)) is not None:
        check_positive(name, values)
        low, high = FOCALS
        _check_each(name, values, (values >= low) & (values <= high), f"from {low:g} to {high:g} mm or px")


def check_not_negative(name: str, value: Any) -> None:
    """Raise ValueError where values are not finite or below zero."""
    if (values := known(value)) is not None:
        _check_each(name, values, np.isfinite(values) & (values >= 0), "finite and at least 0")


def check_increasing(name: str, value: Any) -> None:
    """Raise ValueError where values are not finite, each above the one before."""
    check_finite(name, value)
    if (values := known(value)) is not None and not (np.diff(values, axis=-1) > 0).all():
        raise ValueError(f"Argument {name} must increase from entry to entry, but it does not.")


def check_range(name: str, value: Any) -> None:
    """Raise ValueError where two values are not finite and in order."""
    check_finite(name, value)
    if (values := known(value)) is not None and (values[..., 0] > values[..., 1]).any():
        raise ValueError(
            f"Argument {name} must be two numbers in order, the least first, but it is {values.tolist()}."
        )


def check_indices(name: str, value: Any, number: int, of: str) -> None:
    """Raise ValueError where indices are not from 0 to `number` - 1."""
    values = known(value)
    if values is None or ((values >= 0) & (values < number)).all():
        return
    place = int(np.argmax((values < 0) | (values >= number)))
    raise ValueError(
        f"Argument {name} must hold indices from 0 to {number - 1}, {of}, but {name}[{place}] is "
        f"{values.ravel()[place]}."
    )


def _check_each(name: str, values: np.ndarray, good: Any, wanted: str) -> None:
    good = np.asarray(good)
    if good.all():
        return
    place = np.unravel_index(int(np.argmin(good)), good.shape)
    where = f"{name}[{', '.join(map(str, place))}]" if place else "it"
    raise ValueError(f"Argument {name} must be {wanted}, but {where} is {values[place]}.")
