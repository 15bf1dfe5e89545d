"""Values as a structure that JSON can hold and, apart from it, their arrays.

Classes and functions stand there by their names, if they are from packages that are known. So a value can
be put together again in another process, without anything that reads code.
"""

import dataclasses
import enum
import functools
import importlib
import sys
from collections.abc import Iterator, Mapping
from typing import Any

import equinox as eqx
import jax
import numpy as np

KNOWN = ("zoomjax", "equinox", "optimistix", "lineax", "jax", "numpy")
"""Packages whose classes and functions are known by their names."""


class UnknownError(TypeError):
    """Something has no name by which another process would find it."""


def taken_apart(value: Any, arrays: list) -> Any:
    """The structure of a value; its arrays are added to a list, in the order in which JAX has them.

    Raises:
        UnknownError: something in it has no name.
    """
    if eqx.is_array(value):
        arrays.append(value)
        return ["array"]
    if isinstance(value, eqx.Module):
        names = [field.name for field in dataclasses.fields(value)]  # pyright: ignore[reportArgumentType]
        own = value.__dict__
        parts = [[name, taken_apart(own[name], arrays)] for name in names if name in own]
        return ["module", named(type(value)), parts]
    if isinstance(value, functools.partial) and type(value) in (functools.partial, jax.tree_util.Partial):
        parts = (value.func, value.args, value.keywords)
        return [type(value).__name__, [taken_apart(part, arrays) for part in parts]]
    if isinstance(value, enum.Enum):
        return ["enum", named(type(value)), value.name]
    kind: type = type(value)
    if isinstance(value, list | tuple) and (kind in (list, tuple) or hasattr(value, "_fields")):
        parts = [taken_apart(part, arrays) for part in value]
        return [kind.__name__, parts] if kind in (list, tuple) else ["named", named(kind), parts]
    if isinstance(value, dict) and kind is dict and all(isinstance(name, str) for name in value):
        return ["dict", [[name, taken_apart(value[name], arrays)] for name in sorted(value)]]
    if isinstance(value, float) and kind is float:
        return ["float", value.hex()]
    if value is None or kind in (bool, int, str):
        return ["plain", value]
    if isinstance(value, Mapping):
        return ["mapping", named(kind), taken_apart(dict(value), arrays)]
    if isinstance(value, np.dtype) and value.kind in "biufc" and value.isnative:
        return ["dtype", value.name]
    return ["object", named(value)]


def put_together(structure: Any, arrays: Iterator) -> Any:
    """The value with this structure and these arrays.

    Raises:
        UnknownError: it is none that `taken_apart` gives.
    """
    kind, *rest = structure
    match kind:
        case "array":
            return next(arrays)
        case "plain":
            return rest[0]
        case "float":
            return float.fromhex(rest[0])
        case "dtype":
            return np.dtype(rest[0])
        case "list" | "tuple":
            parts = [put_together(part, arrays) for part in rest[0]]
            return parts if kind == "list" else tuple(parts)
        case "dict":
            return {name: put_together(part, arrays) for name, part in rest[0]}
        case "object":
            return found(rest[0])
        case "mapping":
            return found(rest[0])(put_together(rest[1], arrays))
        case "enum":
            return found(rest[0])[rest[1]]
        case "named":
            return found(rest[0])(*(put_together(part, arrays) for part in rest[1]))
        case "partial" | "Partial":
            function, args, kwargs = (put_together(part, arrays) for part in rest[0])
            made = functools.partial if kind == "partial" else jax.tree_util.Partial
            return made(function, *args, **kwargs)
        case "module":
            module = object.__new__(found(rest[0]))
            for name, part in rest[1]:  # as Equinox does it: these are fields of one that was checked
                object.__setattr__(module, name, put_together(part, arrays))
            return module
    raise UnknownError(repr(kind))


def named(value: Any) -> str:
    """Where a class or a function of a known package is found.

    Raises:
        UnknownError: it is not found there.
    """
    name = f"{getattr(value, '__module__', None)}:{getattr(value, '__qualname__', None)}"
    if found(name) is not value:
        raise UnknownError(repr(value))
    return name


def wrapped_name(function: Any) -> str:
    """The same of a function that decorators have wrapped, and by how many of them."""
    name, depth = f"{function.__module__}:{function.__qualname__}", 0
    wrapper = found(name)
    while wrapper is not None and wrapper is not function:
        wrapper, depth = getattr(wrapper, "__wrapped__", None), depth + 1
    if wrapper is None:
        raise UnknownError(repr(function))
    return f"{name}, {depth}"


def found(name: str) -> Any:
    """The class or function of a known package with this name, and no other thing that is found there."""
    module, _, inside = name.partition(":")
    if module.split(".")[0] not in KNOWN:
        raise UnknownError(name)
    value: Any = sys.modules.get(module) or importlib.import_module(module)
    for part in inside.split("."):
        value = getattr(value, part, None)
    if (getattr(value, "__module__", None), getattr(value, "__qualname__", None)) != (module, inside):
        raise UnknownError(name)
    return value
