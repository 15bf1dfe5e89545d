"""Programs that an earlier process traced.

With what XLA made of a program read from a cache on disk, most of the time that a fit takes in a new
process is that of tracing and lowering it. So, where `keep_programs` names a folder, a program is written
there as it was traced (`jax.export`), with the structure of its result, and later processes read it.

The name of a file is a digest of what a program depends on: the function, the structure of its arguments
with all that is not an array, the arrays' shapes and types, JAX's settings, the versions of packages, and
the text of this one. It does not tell of constants of this package that somebody else sets. What has no
such name is traced as ever: functions and classes from elsewhere, programs that call Python, results of a
weak type, and all in a process with several devices, or where JAX is to find errors.
"""

import contextlib
import dataclasses
import functools
import hashlib
import json
import os
import sys
import time
import zlib
from collections.abc import Callable, Hashable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.extend.core
import jaxlib
import numpy as np
from jax.interpreters import mlir

from .files import whole_file
from .products import exact_products
from .structure import UnknownError, put_together, taken_apart, wrapped_name

_BEGAN = time.time()

_ENDING = ".traced"
_MOST = 50_000_000
"""Bytes of all files when a process begins, beyond which the oldest go; one calibration has two million."""

_CALLS = 1000
"""Programs of a process that are at hand."""

_SETTINGS = (
    "jax_enable_x64",
    "jax_explicit_x64_dtypes",
    "jax_default_matmul_precision",
    "jax_numpy_dtype_promotion",
    "jax_numpy_rank_promotion",
    "jax_default_device",
    "jax_default_prng_impl",
    "jax_threefry_partitionable",
    "jax_random_seed_offset",
    "jax_softmax_custom_jvp",
)
"""JAX's, with which a program is traced."""

_FINDING_ERRORS = ("jax_disable_jit", "jax_debug_nans", "jax_debug_infs")

Call = Callable[..., Any]
Key = tuple[str, tuple]
"""The name of a program, and the settings of the compiler."""


@dataclasses.dataclass
class _Store:
    """Where programs are kept, and those of this process."""

    folder: Path | None = None
    calls: dict[Hashable, Call | None] = dataclasses.field(default_factory=dict)
    ahead: dict[Key, Future] = dataclasses.field(default_factory=dict)  # of `opened`
    used: dict[Key, None] = dataclasses.field(default_factory=dict)


_STORE = _Store()


def store() -> _Store:
    """Where programs are kept, those that are opened ahead, and those used so far, in order."""
    return _STORE


def keep_programs(folder: Path | None) -> None:
    """Keep programs in a folder from now on, where JAX can write them; None: no longer."""
    _STORE.folder = folder if _can_export() else None
    _STORE.calls.clear()
    if _STORE.folder is not None:
        _remove_oldest(_STORE.folder)


def kept(function: Call, settings: tuple, args: tuple, kwargs: dict) -> Call | None:
    """A function without arguments that does what a program does with these; None where it is not kept."""
    folder, calls = _STORE.folder, _STORE.calls
    if folder is None or not can_keep():
        return None
    leaves, tree = jax.tree.flatten((args, kwargs))
    arrays = [leaf for leaf in leaves if eqx.is_array(leaf)]
    key = (function, settings, tree, tuple(map(_kind, leaves)), context())
    try:
        call = calls.get(key, _looked_up)
    except TypeError:  # something cannot be hashed
        return None
    if call is _looked_up:
        call = _looked_up(folder, function, settings, (args, kwargs), arrays)
        calls[key] = call
        if len(calls) > _CALLS:
            calls.pop(next(iter(calls)), None)
    return None if call is None else functools.partial(call, *arrays)


def _can_export() -> bool:
    """Whether there is what JAX writes programs with, and what older versions of it import to do so."""
    try:
        import flatbuffers  # noqa: F401
        import jax.export  # noqa: F401
    except ImportError:
        return False
    return True


def can_keep() -> bool:
    """Whether a program of this process is that of another: on one processor, with nothing between."""
    mesh = getattr(jax.sharding, "get_abstract_mesh", None)
    return (
        jax.default_backend() == "cpu"
        and jax.device_count() == 1
        and not any(getattr(jax.config, name, False) for name in _FINDING_ERRORS)
        and (mesh is None or mesh().empty)
    )


def _looked_up(folder, function, settings, given, arrays):
    """The program as an earlier process kept it, or else traced now, and kept."""
    try:
        name = _name(function, given, arrays)
    except UnknownError:
        return None
    _STORE.used[name, settings] = None
    begun = _STORE.ahead.pop((name, settings), None)
    content = opened(name, settings) if begun is None or begun.cancel() else begun.result()
    if content is None:
        structure, program = _traced(function, given, arrays)
        _write(folder / f"{name}{_ENDING}", structure, program)
        content = structure, _jitted(_exported(program), settings)
    structure, compiled = content
    return compiled and (lambda *arrays: put_together(structure, iter(compiled(*arrays))))


def opened(name: str, settings: tuple, *, ahead: bool = False) -> tuple[Any, Call | None] | None:
    """The structure of a program's result, and the program; None if no process has kept it.

    It is ready to run if that is done `ahead`, else when it first runs.
    """
    content = None if _STORE.folder is None else _read(_STORE.folder / f"{name}{_ENDING}")
    if content is None:
        return None
    structure, exported = content
    compiled = _jitted(exported, settings)
    if ahead and compiled is not None:
        shapes = (jax.ShapeDtypeStruct(of.shape, of.dtype) for of in exported.in_avals)
        exact_products(compiled.lower)(*shapes).compile()  # in the context of `program`, else anew there
    return structure, compiled


def _jitted(exported, settings) -> Any:
    run = functools.partial(_program.bind, of=_Exported(exported))
    return exported and jax.jit(run, compiler_options=dict(settings) or None)


class _Exported:
    """A program, which is itself alone."""

    def __init__(self, program: Any):
        self.program = program


# JAX takes results of `Exported.call` for committed to a device, and compiles what takes them anew, beside
# what it compiled for results of other programs. It does not look into this.
_program = jax.extend.core.Primitive("kept")
_program.multiple_results = True
_program.def_abstract_eval(lambda *_, of: list(of.program.out_avals))
mlir.register_lowering(
    _program, mlir.lower_fun(lambda *arrays, of: of.program.call(*arrays), multiple_results=True)
)


def _traced(function, given, arrays):
    """The structure of a function's result and its program: none if it cannot be written."""
    from jax import export

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
        traced = jitted.trace(*arrays)  # whose other errors are those of the arguments
        if any(of.weak_type for of in traced.jaxpr.out_avals):
            return None, b""  # which a program that was written does not tell
    except UnknownError:
        return None, b""
    try:
        return structure, bytes(export.export(jitted)(*arrays).serialize())
    except (NotImplementedError, ValueError):  # it calls Python
        return None, b""


def _kind(leaf: Any) -> tuple[Hashable, ...]:
    if not eqx.is_array(leaf):
        return type(leaf), leaf.hex() if isinstance(leaf, float) else leaf
    return leaf.shape, leaf.dtype, getattr(leaf, "weak_type", False)


def context() -> tuple:
    """What else tells how programs are traced."""
    settings = (getattr(jax.config, name, None) for name in _SETTINGS)
    return *settings, os.environ.get("EQX_ON_ERROR")


def _name(function, given, arrays) -> str:
    """The digest of what the program depends on."""
    apart: list = []
    structure = taken_apart(given, apart)
    if len(apart) != len(arrays) or any(a is not b for a, b in zip(apart, arrays, strict=True)):
        raise UnknownError("there are arrays that are no arguments")
    if not all(isinstance(array, jax.Array) or array.dtype.isnative for array in arrays):
        raise UnknownError("the bytes of an array have another order")
    if (versions := _versions()) is None:
        raise UnknownError("the text of the package")
    kinds = [[*map(str, _kind(array))] for array in arrays]
    about = [wrapped_name(function), structure, kinds, [*map(str, context())], versions]
    return hashlib.sha256(json.dumps(about).encode()).hexdigest()


@functools.cache
def _versions() -> str | None:
    """Those of all packages that take part, and the text of this one; None if it has changed since."""
    import lineax  # neither needed nor quick to be read where no program is kept
    import optimistix

    text, package = hashlib.sha256(), Path(__file__).parents[1]
    try:
        for path in sorted(package.rglob("*.py")):
            about = path.stat()
            if max(about.st_mtime, about.st_ctime) > _BEGAN:
                return None
            text.update(f"{path.relative_to(package)}\0".encode() + path.read_bytes())
        Path(__file__).stat()  # in an archive nothing is found
    except OSError:
        return None
    others = [of.__version__ for of in (jax, jaxlib, eqx, optimistix, lineax, np)]
    return " ".join([sys.version, *others, text.hexdigest()])


def _exported(program: bytes) -> Any:
    """The program in these bytes; None if there are none, as it cannot be written."""
    from jax import export

    return export.deserialize(bytearray(program)) if program else None


def _read(file: Path) -> tuple[Any, Any] | None:
    """The structure and the program in a file; None if there is no file, or none that can be read.

    Every program says its name, lest one is run for another, as after files were renamed or copied.
    """
    try:
        packed = file.read_bytes()
    except OSError:
        return None
    with contextlib.suppress(OSError):
        os.utime(file)  # it is in use
    try:
        head, _, program = zlib.decompress(packed).partition(b"\n")
        name, structure = json.loads(head)
        if name != file.stem:
            raise ValueError("the file was renamed: it is another program")
        return structure, _exported(program)
    except Exception:  # whatever the bytes of a file that somebody else wrote make of the readers
        with contextlib.suppress(OSError):
            file.unlink()
        return None


def _write(file: Path, structure: Any, program: bytes) -> None:
    with contextlib.suppress(OSError), whole_file(file) as part:
        head = json.dumps([file.stem, structure]).encode()
        part.write_bytes(zlib.compress(head + b"\n" + program, 1))


def _remove_oldest(folder: Path) -> None:
    """Remove those not used for the longest time, if all take too much."""
    files = []
    for file in folder.glob(f"*{_ENDING}"):
        with contextlib.suppress(OSError):
            files.append((file.stat().st_mtime, file.stat().st_size, file))
    left = sum(size for _, size, _ in files)
    for _, size, file in sorted(files):
        if left <= _MOST:
            break
        with contextlib.suppress(OSError):
            file.unlink()
        left -= size
