"""Programs that XLA compiles quickly, where they run as fast, or where nobody would notice.

The time of a first fit is that of the compiler. On processors two of its settings matter. The emitters of
fusions by MLIR take half of the time, and what they emit for our programs is no faster: all but those that
correct points and images are compiled without, where XLA has others (newer versions have not). Optimisation
by LLVM takes two thirds of the rest, and makes a program some three times as fast: where the work is that
of going over the arguments once or twice, and these are small, that saves a millisecond for a second. In a
process that does each thing once or twice, as a command does, it pays for larger ones, too (`use_once`).
"""

import dataclasses
import functools
import math
import os
from collections.abc import Callable, Hashable
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.core
import jax.extend.core
from jax.core import eval_context

from .beside import compile_beside, wait_for
from .kept import can_keep, context, kept, store
from .products import exact_products
from .types import traced

_PLAINLY = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_backend_optimization_level": 1,
    "xla_cpu_prefer_vector_width": 128,  # which for our few columns are as fast, or faster
    "xla_cpu_parallel_codegen_split_count": 4,  # parts that are compiled side by side; each costs
}
_UNOPTIMISED = {**_PLAINLY, "xla_backend_optimization_level": 0, "xla_cpu_parallel_codegen_split_count": 1}
_WITHOUT_EMITTERS = {"xla_cpu_use_fusion_emitters": False}  # a tenth slower steps, in half of the time

_ROWS, _NUMBERS = 1024, 3 * 2**19
"""Of the arguments of a light program, up to which it is not optimised: the longest, and all in all."""

_LARGER = 4
"""How many times as large they may be where programs run once or twice."""


@dataclasses.dataclass
class _Use:
    """What programs of this process are for."""

    once: bool = False


_USE = _Use()

# It moved from `jax.core` to where it is now.
_trace_state: Any = getattr(jax.extend.core, "get_opaque_trace_state", None) or getattr(
    jax.core, "get_opaque_trace_state", None
)

_Given = ParamSpec("_Given")
_Result = TypeVar("_Result")


def program(
    function: Callable[_Given, _Result],
    *,
    light: bool = False,
    optimised: bool = False,
    in_steps: bool = False,
    rare: bool = False,
) -> Callable[_Given, _Result]:
    """As ``equinox.filter_jit``, with settings of the compiler that save its time.

    Inside of ``jit``, ``vmap`` and ``grad`` the function is a part of another program, with the settings of
    that one. XLA's own hold on a GPU, and where ``XLA_FLAGS`` or the version of JAX says otherwise.
    Products of float32 matrices have all digits everywhere.

    Args:
        function: what to compile.
        light: whether its work is small for small arguments.
        optimised: whether its work is so much that XLA's own settings pay.
        in_steps: whether it is many small steps, for which emitters do not pay in a process that runs once.
        rare: whether such a process runs it once, and it is `light` there.
    """
    plain = eqx.filter_jit(function)

    def settings_for(args: Any, kwargs: Any) -> tuple[tuple[str, Any], ...]:
        small = (light or (rare and _USE.once)) and are_few((args, kwargs))
        return _settings(_kind(optimised, in_steps, small))

    @functools.wraps(function)
    @exact_products
    def call(*args: _Given.args, **kwargs: _Given.kwargs) -> _Result:
        if not _at_once():
            return plain(*args, **kwargs)
        settings = settings_for(args, kwargs)
        try:
            if (run := kept(function, settings, args, kwargs)) is not None:
                return run()
            wait_for(function)
            return (_with_settings(function, settings) if settings else plain)(*args, **kwargs)
        except jax.errors.JaxRuntimeError as error:
            unknown = {name for name, _ in settings if f"No such compile option: '{name}'" in str(error)}
            if not unknown:
                raise
            _UNKNOWN.update(unknown)
            _settings.cache_clear()
            return call(*args, **kwargs)

    @exact_products
    def lower(*args: Any) -> Any:
        settings = settings_for(args, {})
        jitted: Any = _with_settings(function, settings) if settings else plain
        return jitted.lower(*args)

    _LOWERED[call] = function, lower
    return call


_LOWERED: dict[Any, tuple[Any, Any]] = {}
"""Of programs, what they are made of, and what lowers them."""


def begin(*programs: tuple[Callable[..., Any], tuple[Any, ...]]) -> None:
    """Compile programs in threads that this one will soon call, the first time that it does.

    It does nothing inside of ``jit``, where there is one core, and where programs are kept on disk.

    Args:
        programs: each with its arguments, or with others of the same shapes and types.
    """
    leaves, tree = jax.tree.flatten(programs)
    if traced(leaves) or not (_at_once() and can_keep()) or store().folder or os.cpu_count() == 1:
        return
    settings = context()
    given = (tree, settings, *((of.shape, of.dtype) if eqx.is_array(of) else of for of in leaves))
    try:
        if given in _GIVEN:
            return
    except TypeError:  # something cannot be hashed, and the call will say so
        return
    if len(_GIVEN) >= _MOST_GIVEN:
        _GIVEN.clear()
    _GIVEN.add(given)

    def lowering(call, args):
        def lower():  # which has settings of its own thread
            return _LOWERED[call][1](*args) if context() == settings else None

        return _LOWERED[call][0], lower

    compile_beside([lowering(*each) for each in programs])


_GIVEN: set[Hashable] = set()
"""What `begin` was given before, but for the numbers."""

_MOST_GIVEN = 1000


def use_once(once: bool = True) -> None:
    """Set that programs of this process run once or twice: it is quicker to compile less than to run fast.

    Data sets then share programs with others of more sizes, too: see `zoomjax.lines.buckets`.
    """
    _USE.once = once


def used_once() -> bool:
    """Whether programs of this process run once or twice."""
    return _USE.once


def optimised_program(function: Callable[_Given, _Result]) -> Callable[_Given, _Result]:
    """`program` of a function with much work."""
    return program(function, optimised=True)


def program_of_steps(function: Callable[_Given, _Result]) -> Callable[_Given, _Result]:
    """`program` of a function with much work, in many small steps."""
    return program(function, optimised=True, in_steps=True)


def light_program(function: Callable[_Given, _Result]) -> Callable[_Given, _Result]:
    """`program` of a function whose work is small for small arguments."""
    return program(function, light=True)


def rare_program(function: Callable[_Given, _Result]) -> Callable[_Given, _Result]:
    """`program` of a function that a process which does each thing once or twice runs once."""
    return program(function, rare=True)


_UNKNOWN: set[str] = set()  # settings that this version of XLA does not have


def _kind(optimised: bool, in_steps: bool, small: bool) -> str:
    """Which of `_KINDS` a program is of."""
    if optimised:
        return "in steps" if in_steps and _USE.once else "optimised"
    return "small" if small else "plain"


_KINDS: dict[str, dict[str, Any]] = {
    "optimised": {},
    "plain": _PLAINLY,
    "small": _UNOPTIMISED,
    "in steps": _WITHOUT_EMITTERS,
}


@functools.cache
def _settings(kind: str) -> tuple[tuple[str, Any], ...]:
    """The compiler's settings that are not given by the environment; none but on a processor."""
    if jax.default_backend() != "cpu":
        return ()
    given, wanted = os.environ.get("XLA_FLAGS", ""), _KINDS[kind]
    return tuple(of for of in wanted.items() if of[0] not in given and of[0] not in _UNKNOWN)


def all_settings() -> tuple[tuple[tuple[str, Any], ...], ...]:
    """The settings of all kinds of programs of this process."""
    return tuple(map(_settings, _KINDS))


@functools.cache
def _with_settings(function, settings):
    given: Any = {"compiler_options": dict(settings)}  # for `jax.jit`
    return eqx.filter_jit(function, **given)


def are_few(arguments: Any) -> bool:
    """Whether arrays are short, and hold few numbers in all: compiling takes longer than computing."""
    shapes = [leaf.shape for leaf in jax.tree.leaves(arguments) if eqx.is_array(leaf)]
    longest = max((shape[0] for shape in shapes if shape), default=0)
    times = _LARGER if _USE.once else 1
    return longest <= times * _ROWS and sum(map(math.prod, shapes)) <= times * _NUMBERS


def _at_once() -> bool:
    """Whether a program runs now, and is not made a part of another."""
    with eval_context():
        now = _trace_state(convention="flax")
    return _trace_state(convention="flax") == now
