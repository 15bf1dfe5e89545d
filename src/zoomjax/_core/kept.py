"""Programs that an earlier process traced.

With what XLA made of a program read from a cache on disk, most of the time that a fit takes in a new
process is that of tracing and lowering it. So, where `keep_programs` names a folder, a program is written
there as it was traced (`jax.export`), with the structure of its result, and later processes read it.

The name of a file is a digest of all that a program depends on: the function, the structure of its
arguments with all that is not an array, the arrays' shapes and types, JAX's settings, the versions of
packages, and the text of this one. What has no such name is traced as ever: functions and classes from
elsewhere, arrays on other devices, programs that call Python, and results of a weak type.
"""

import contextlib
import dataclasses
import enum
import functools
import hashlib
import importlib
import inspect
import json
import os
import sys
import zlib
from collections.abc import Callable, Hashable, Mapping
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.export
import jaxlib
import lineax
import numpy as np
import optimistix

from .files import whole_file

_ENDING = ".traced"
_MOST = 50_000_000
"""Bytes of all files, beyond which the oldest are removed; one calibration has some two million."""

_KNOWN = ("zoomjax", "equinox", "optimistix", "lineax", "jax", "numpy")
"""Packages whose classes and functions are known by their names."""

_SETTINGS = (
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_numpy_dtype_promotion",
    "jax_numpy_rank_promotion",
    "jax_default_device",
    "jax_default_prng_impl",
    "jax_debug_nans",
    "jax_debug_infs",
    "jax_disable_jit",
)
"""JAX's, with which a program is traced."""

Call = Callable[..., Any]


@dataclasses.dataclass
class _Store:
    """Where programs are kept, and those of this process."""

    folder: Path | None = None
    calls: dict[Hashable, Call | None] = dataclasses.field(default_factory=dict)


_STORE = _Store()


def keep_programs(folder: Path | None) -> None:
    """Keep programs in a folder from now on; None: no longer."""
    _STORE.folder = folder
    _STORE.calls.clear()
    if folder is not None:
        _remove_oldest(folder)


def kept(function: Call, settings: tuple, args: tuple, kwargs: dict) -> Call | None:
    """A function of the same arguments that does what a program does; None where it is not kept."""
    if _STORE.folder is None or jax.default_backend() != "cpu":
        return None
    leaves, tree = jax.tree.flatten((args, kwargs))
    arrays = [leaf for leaf in leaves if eqx.is_array(leaf)]
    if not all(map(_is_here, arrays)):
        return None
    try:
        key = (function, settings, tree, tuple(map(_kind, leaves)), _context())
        if key not in _STORE.calls:
            _STORE.calls[key] = _looked_up(_STORE.folder, function, settings, (args, kwargs), arrays)
    except TypeError:  # something cannot be hashed
        return None
    call = _STORE.calls[key]
    return None if call is None else functools.partial(call, *arrays)


def _looked_up(folder, function, settings, given, arrays):
    """The program as an earlier process kept it, or else traced now, and kept."""
    try:
        file = folder / f"{_name(function, settings, given, arrays)}{_ENDING}"
    except _UnknownError:
        return None
    found = _read(file)
    if found is None:
        found = _traced(function, given, arrays)
        _write(file, found)
    structure, exported = found
    if exported is None:
        return None
    compiled = jax.jit(exported.call, compiler_options=dict(settings) or None)
    return lambda *arrays: put_together(structure, iter(compiled(*arrays)))


def _traced(function, given, arrays):
    """The structure of a function's result and its program; None and None if it cannot be written."""
    leaves, tree = jax.tree.flatten(given)
    structure: Any = None

    def flat(*arrays):
        nonlocal structure
        rest, result = iter(arrays), []
        args, kwargs = jax.tree.unflatten(tree, [next(rest) if eqx.is_array(of) else of for of in leaves])
        structure = taken_apart(function(*args, **kwargs), result)
        return result

    flat.__name__ = function.__name__
    jitted = jax.jit(flat)
    try:
        traced = jitted.trace(*arrays)  # what is wrong with the arguments is raised from here
    except _UnknownError:
        return None, None
    if any(of.weak_type for of in traced.jaxpr.out_avals):
        return None, None  # which a program that was written does not tell
    try:
        return structure, jax.export.export(jitted)(*arrays)
    except (NotImplementedError, ValueError):  # it calls Python
        return None, None


class _UnknownError(TypeError):
    """Something has no name by which a later process would find it."""


def taken_apart(value: Any, arrays: list) -> Any:
    """The structure of a value in terms of JSON; its arrays are added to a list, in the order of JAX's."""
    if eqx.is_array(value):
        arrays.append(value)
        return ["array"]
    if isinstance(value, eqx.Module):
        fields = [field.name for field in dataclasses.fields(value)]  # pyright: ignore[reportArgumentType]
        parts = [
            [name, taken_apart(value.__dict__[name], arrays)] for name in fields if name in value.__dict__
        ]
        return ["module", _named(type(value)), parts]
    if isinstance(value, functools.partial) and type(value) in (functools.partial, jax.tree_util.Partial):
        parts = (value.func, value.args, value.keywords)
        return [type(value).__name__, [taken_apart(part, arrays) for part in parts]]
    if isinstance(value, enum.Enum):
        return ["enum", _named(type(value)), value.name]
    kind: type = type(value)
    if isinstance(value, list | tuple) and (kind in (list, tuple) or hasattr(value, "_fields")):
        parts = [taken_apart(part, arrays) for part in value]
        return [kind.__name__, parts] if kind in (list, tuple) else ["named", _named(kind), parts]
    if isinstance(value, dict) and kind is dict and all(isinstance(name, str) for name in value):
        return ["dict", [[name, taken_apart(value[name], arrays)] for name in sorted(value)]]
    if isinstance(value, float) and kind is float:
        return ["float", value.hex()]
    if value is None or kind in (bool, int, str):
        return ["plain", value]
    if isinstance(value, Mapping):
        return ["mapping", _named(kind), taken_apart(dict(value), arrays)]
    if isinstance(value, np.dtype):
        return ["dtype", value.str]
    return ["object", _named(value)]


def put_together(structure: Any, arrays: Any) -> Any:
    """The value with this structure and, from an iterator, these arrays."""
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
            return _object(rest[0])
        case "mapping":
            return _object(rest[0])(put_together(rest[1], arrays))
        case "enum":
            return _object(rest[0])[rest[1]]
        case "named":
            return _object(rest[0])(*(put_together(part, arrays) for part in rest[1]))
        case "partial" | "Partial":
            function, args, kwargs = (put_together(part, arrays) for part in rest[0])
            return (functools if kind == "partial" else jax.tree_util).__dict__[kind](
                function, *args, **kwargs
            )
        case "module":
            module = object.__new__(_object(rest[0]))
            for name, part in rest[1]:  # as Equinox does it: these are fields of one that was checked
                object.__setattr__(module, name, put_together(part, arrays))
            return module
    raise _UnknownError(kind)


def _named(value: Any) -> str:
    """Where a class or a function of a known package is found."""
    module, name = getattr(value, "__module__", None), getattr(value, "__qualname__", None)
    if not isinstance(module, str) or not isinstance(name, str) or module.split(".")[0] not in _KNOWN:
        raise _UnknownError(repr(value))
    found = f"{module}:{name}"
    if _object(found) is not value:
        raise _UnknownError(found)
    return found


def _object(named: str) -> Any:
    module, _, name = named.partition(":")
    if module.split(".")[0] not in _KNOWN:
        raise _UnknownError(named)
    found: Any = sys.modules.get(module) or importlib.import_module(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    return found


def _is_here(array: Any) -> bool:
    """Whether an array is NumPy's, or on the device on which programs run by default."""
    return not isinstance(array, jax.Array) or array.devices() == {jax.local_devices()[0]}


def _kind(leaf: Any) -> tuple[Hashable, ...]:
    if not eqx.is_array(leaf):
        return type(leaf), leaf.hex() if isinstance(leaf, float) else leaf
    return leaf.shape, leaf.dtype, isinstance(leaf, jax.Array) and leaf.weak_type


def _context() -> tuple:
    return tuple(getattr(jax.config, name, None) for name in _SETTINGS)


def _name(function, settings, given, arrays) -> str:
    """The digest of all that the program depends on."""
    apart: list = []
    structure = taken_apart(given, apart)
    if len(apart) != len(arrays) or any(a is not b for a, b in zip(apart, arrays, strict=True)):
        raise _UnknownError("the order of arrays is another")
    kinds = [[*map(str, _kind(array))] for array in arrays]
    about = [_signed(function), settings, structure, kinds, [*map(str, _context())], _versions()]
    return hashlib.sha256(json.dumps(about).encode()).hexdigest()


def _signed(function: Call) -> list:
    """What tells a program's function, which may be a lambda, from all others of this package."""
    function = inspect.unwrap(function)
    code = getattr(function, "__code__", None)
    package = function.__module__.split(".")[0]
    if code is None or function.__closure__ or package not in _KNOWN or "<locals>" in function.__qualname__:
        raise _UnknownError(repr(function))
    return [
        function.__module__,
        function.__qualname__,
        code.co_firstlineno,
        code.co_code.hex(),
        code.co_names,
    ]


@functools.cache
def _versions() -> str:
    """Those of all packages that take part, and the text of this one."""
    text = hashlib.sha256()
    package = Path(__file__).parents[1]
    for path in sorted(package.rglob("*.py")):
        text.update(f"{path.relative_to(package)}\0".encode() + path.read_bytes())
    others = [of.__version__ for of in (jax, jaxlib, eqx, optimistix, lineax, np)]
    return " ".join([sys.version, *others, text.hexdigest()])


def _read(file: Path) -> Any:
    """What is kept in a file; None where there is none, or none that can be read, which is removed."""
    if not file.exists():
        return None
    try:
        head, _, program = zlib.decompress(file.read_bytes()).partition(b"\n")
        os.utime(file)  # it is in use
        return json.loads(head), jax.export.deserialize(bytearray(program)) if program else None
    except Exception:  # whatever the bytes of a file that somebody else wrote make of the readers
        with contextlib.suppress(OSError):
            file.unlink()
        return None


def _write(file: Path, found: Any) -> None:
    structure, exported = found
    program = b"" if exported is None else bytes(exported.serialize())
    with contextlib.suppress(OSError), whole_file(file) as part:
        part.write_bytes(zlib.compress(json.dumps(structure).encode() + b"\n" + program, 1))


def _remove_oldest(folder: Path) -> None:
    """Remove those not used for the longest time, if all take too much."""
    with contextlib.suppress(OSError):
        files = [(of.stat().st_mtime, of.stat().st_size, of) for of in folder.glob(f"*{_ENDING}")]
        left = sum(size for _, size, _ in files)
        for _, size, file in sorted(files):
            if left <= _MOST:
                break
            file.unlink()
            left -= size
