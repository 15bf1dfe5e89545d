"""Type checks of arguments, with error messages that say what to pass.

`kinds_checked` reads a function's annotations of our own classes, of solvers, of paths and of `bool`, and
checks its arguments before anything else, of which none may be a masked array: one place for all functions.
"""

import functools
import inspect
import os
import types
import typing
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import numpy as np

from .fields import refuse_masked

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

_WANTED = {
    "AbstractLines": "Lines (see Lines.from_ragged) or compress(lines)",
    "Lines": "Lines (see Lines.from_ragged)",
    "CompressedLines": "compressed lines, compress(lines)",
    "AbstractZoom": "a zoom model such as PolynomialZoom(degree=2)",
    "AbstractLinearZoom": "a zoom model that is linear in its parameters, such as PolynomialZoom(degree=2)",
    "AbstractDistortionModel": "a distortion model such as Division()",
    "ZoomLens": "a ZoomLens, such as fit.lens or load_lens(path)",
    "Distortion": "a Distortion, such as lens(35.0)",
    "ZoomFit": "a ZoomFit, what fit_zoom returns",
    "FrameFits": "what fit_frames returns",
    "AbstractLeastSquaresSolver": "an optimistix solver such as optimistix.LevenbergMarquardt(1e-9, 1e-9)",
    "str": "a path",
}
"""What to ask for, by the first of the classes that an argument may be of."""

_INSTEAD = {
    ("ZoomLens", "ZoomFit"): "pass its lens, fit.lens",
    ("ZoomLens", "CentreFit"): "pass its lens, found.fit.lens",
    ("ZoomLens", "RobustFit"): "pass its lens, robust.fit.lens",
    ("ZoomLens", "FocalFit"): "pass its lens, found.fit.lens",
    ("ZoomLens", "Distortion"): "that is one focal length's; pass the lens that it came from",
    ("ZoomLens", "str"): "load_lens(path) reads a file",
    ("ZoomLens", "PosixPath"): "load_lens(path) reads a file",
    ("Distortion", "ZoomLens"): "pass the distortion at one focal length, lens(35.0)",
    ("Distortion", "ZoomFit"): "pass the distortion at one focal length, fit.lens(35.0)",
    ("ZoomFit", "ZoomLens"): "a lens alone has no covariance; pass the fit that it came from",
    ("ZoomFit", "CentreFit"): "pass its fit, found.fit",
    ("ZoomFit", "RobustFit"): "pass its fit, robust.fit",
    ("ZoomFit", "FocalFit"): "pass its fit, found.fit",
    ("ZoomFit", "FrameFits"): "that is a separate fit of each frame; fit_zoom(lines) fits all together",
    ("FrameFits", "ZoomFit"): "fit_frames(lines) fits each frame separately",
    ("FrameFits", "FrameCentres"): "pass its fits, found.each",
    ("AbstractLines", "str"): "load_lines(path) reads a file",
    ("AbstractLines", "PosixPath"): "load_lines(path) reads a file",
    ("AbstractLines", "ndarray"): "Lines.from_ragged(points, frame, focal, image_size=(w, h)) makes them",
    ("AbstractLines", "list"): "Lines.from_ragged(points, frame, focal, image_size=(w, h)) makes them",
    ("Lines", "str"): "load_lines(path) reads a file",
    ("Lines", "PosixPath"): "load_lines(path) reads a file",
    ("Lines", "CompressedLines"): "these are compressed already; pass the Lines that they came from",
    ("Lines", "AnyCentreLines"): "these are compressed already; pass the Lines that they came from",
    ("CompressedLines", "Lines"): "pass compress(lines)",
    ("AbstractZoom", "ZoomLens"): "pass its zoom model, lens.zoom",
    ("AbstractZoom", "ZoomFit"): "pass its zoom model, fit.lens.zoom",
    ("AbstractZoom", "int"): "PolynomialZoom(degree=...) is one of that degree",
    ("str", "ZoomLens"): "it is loaded already",
    ("str", "Lines"): "they are loaded already",
    ("Tracks", "str"): "load_tracks(path) reads a file",
    ("Tracks", "PosixPath"): "load_tracks(path) reads a file",
    ("str", "Tracks"): "they are loaded already",
}
"""What to pass instead of something that is near to what is wanted."""


_OF_ONE_AXIS = {
    **dict.fromkeys(("AbstractLines", "Lines", "CompressedLines"), "focal"),
    "ZoomLens": "focal_range",
    **dict.fromkeys(("ZoomFit", "FrameFits"), "frame_rms"),
}
"""An array of one axis, by the first of the classes: with more it is of several objects in one."""


def check_kind(name: str, value: Any, kinds: tuple[type, ...]) -> None:
    """Raise TypeError where a value is of none of these kinds.

    And ValueError where it is of several in one, as `jax.vmap` and ``jax.tree.map(jnp.stack)`` make.
    """
    if isinstance(value, kinds):
        array: Any = getattr(value, _axis(kinds), None)
        if getattr(array, "ndim", 0) > 1:
            raise ValueError(
                f"Argument {name} holds {np.shape(array)[0]} of its kind in one: call the function by "
                f"jax.vmap, or for each, of which jax.tree.map(lambda leaf: leaf[0], {name}) is the first."
            )
        return
    first = kinds[0].__name__
    wanted = _WANTED.get(first) or " or ".join(kind.__name__ for kind in kinds)
    if isinstance(value, type):
        what = f"it is the class {value.__name__}"
        instead = f"pass an instance, {value.__name__}(...)" if issubclass(value, kinds) else None
    else:
        what = f"its type is {type(value).__name__}"
        instead = _INSTEAD.get((first, type(value).__name__))
    raise TypeError(f"Argument {name} must be {wanted}, but {what}{f': {instead}' if instead else ''}.")


def check_flag(name: str, value: Any) -> None:
    """Raise TypeError where a value is neither true nor false: any word is true, "no" too."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"Argument {name} must be True or False, but it is {value!r}.")


def kinds_checked(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """The function, which looks at the kinds of its arguments first, and refuses masked arrays."""
    parameters = inspect.signature(function).parameters
    wanted = {
        name: (place, kinds, parameter.default)
        for place, (name, parameter) in enumerate(parameters.items())
        if (kinds := _kinds(parameter.annotation))
    }
    flags = {
        name: place
        for place, (name, parameter) in enumerate(parameters.items())
        if parameter.annotation is bool
    }
    assert wanted or flags, f"{function} takes nothing to check"

    @functools.wraps(function)
    def checked(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        for name, place in flags.items():
            if place < len(args) or name in kwargs:
                check_flag(name, args[place] if place < len(args) else kwargs[name])
        for name, (place, kinds, default) in wanted.items():
            value = args[place] if place < len(args) else kwargs.get(name, default)
            if value is not inspect.Parameter.empty:
                check_kind(name, value, kinds)
        for name, value in (*zip(parameters, args, strict=False), *kwargs.items()):
            refuse_masked(name, value)
        return function(*args, **kwargs)

    return checked


@functools.cache
def _axis(kinds: tuple[type, ...]) -> str:
    """The array of one axis of objects of these classes; empty if there is none."""
    return next((_OF_ONE_AXIS[kind.__name__] for kind in kinds if kind.__name__ in _OF_ONE_AXIS), "")


def _kinds(annotation: Any) -> tuple[type, ...]:
    """The classes that an annotation names, if all are modules, None, or what paths are; else none."""
    union = isinstance(annotation, types.UnionType) or typing.get_origin(annotation) is typing.Union
    members: tuple[Any, ...] = typing.get_args(annotation) if union else (annotation,)
    kinds = tuple(typing.get_origin(member) or member for member in members)
    if not all(isinstance(kind, type) for kind in kinds):
        return ()
    telling = {kind for kind in kinds if kind is os.PathLike or issubclass(kind, eqx.Module)}
    return kinds if telling and set(kinds) - telling <= {str, type(None)} else ()
