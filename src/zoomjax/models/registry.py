"""The zoom models and distortion models that ``lens.json`` can hold, by name.

A file names the classes of its models, and holds their fields as plain numbers. It cannot import or run
code: only classes that are registered in this process are created from it. `register_model` adds
user-defined classes.
"""

import dataclasses
import difflib
import functools
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any, TypeVar, cast, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._core.arrays import mixes_booleans
from .._core.checks import warn_caller
from .._core.text import listed, plain
from .brown_conrady import BrownConrady
from .distortion_model import AbstractDistortionModel
from .division import Division
from .focus import FocusSplineZoom
from .polynomial import RadialPolynomial
from .power import PowerZoom
from .smooth import SmoothZoom
from .spline import SplineZoom
from .tables import TableZoom
from .two_region import TwoRegionZoom
from .zoom import AbstractFocusZoom, AbstractZoom, PolynomialZoom

SomeModel = TypeVar("SomeModel", bound=AbstractZoom | AbstractDistortionModel)

_ZOOMS: dict[str, type[AbstractZoom]] = {}
_DISTORTION_MODELS: dict[str, type[AbstractDistortionModel]] = {}

_RESERVED = {"model", "formula"}
"""Keys of a model in the file beside its fields."""

_LATER = {"mean"}
"""Fields that files of earlier versions do not have, and which are None there."""


@overload
def register_model(cls: type[SomeModel], *, name: str | None = None) -> type[SomeModel]: ...


@overload
def register_model(
    cls: None = None, *, name: str | None = None
) -> Callable[[type[SomeModel]], type[SomeModel]]: ...


def register_model(cls: Any = None, *, name: str | None = None) -> Any:
    """Register a zoom model or distortion model, so that lenses with it can be saved and loaded.

    The process that loads a lens must register the class, too: import the module that does so first. The
    file holds the model's name, its formula and its fields: arrays and numbers, and in static fields also
    booleans, words, None and tuples of these. Distortion models have no fields.

    Args:
        cls: a final class of `AbstractZoom` or `AbstractDistortionModel`, with a class attribute
            ``formula``: a description of its numbers for readers of the file.
        name: the model's name in files, by default the name of the class.

    Returns:
        The class itself, so that this can be used as a decorator.

    Raises:
        TypeError: it is not such a class, has no formula, or has a field with a name that the file uses.
        ValueError: another class has that name.

    Example:
        >>> from typing import ClassVar
        >>> import jax.numpy as jnp
        >>> from zoomjax.models import AbstractLinearZoom
        >>> @register_model
        ... class ConstantZoom(AbstractLinearZoom):
        ...     formula: ClassVar[str] = "k_i(f) = parameters[0][i-1]"
        ...     parameters: jnp.ndarray | None = None
        ...
        ...     def prepare(self, focal, terms):
        ...         return ConstantZoom(jnp.zeros((1, terms)))
        ...
        ...     def basis(self, focal):
        ...         return jnp.ones(1)
    """
    if cls is None:
        return functools.partial(register_model, name=name)
    kinds: dict[type, dict[str, Any]] = {AbstractZoom: _ZOOMS, AbstractDistortionModel: _DISTORTION_MODELS}
    table = next((kinds[k] for k in kinds if isinstance(cls, type) and issubclass(cls, k)), None)
    if table is None:
        raise TypeError(
            f"Argument cls must be a class of AbstractZoom or AbstractDistortionModel, but it is {cls!r}."
        )
    if not isinstance(getattr(cls, "formula", None), str):
        raise TypeError(
            f'{cls.__name__} needs a class attribute formula: ClassVar[str] = "...", which says in '
            "the file what its numbers mean."
        )
    fields = {field.name for field in dataclasses.fields(cls)}
    if table is _DISTORTION_MODELS and fields:
        raise TypeError(
            f"A distortion model has no fields, but {cls.__name__} has {', '.join(sorted(fields))}."
        )
    if clash := fields & _RESERVED:
        raise TypeError(f"{cls.__name__} must not have a field {clash.pop()}, a key of the file's own.")
    name = cast(str, cls.__name__) if name is None else name
    other = table.get(name)
    # The cell of a notebook, run again, makes the same class anew.
    if other is not None and (other.__module__, other.__qualname__) != (cls.__module__, cls.__qualname__):
        raise ValueError(
            f"Another class is registered as {name!r}, {other.__module__}.{other.__qualname__}: give this "
            'one another name by register_model(name="...").'
        )
    table[name] = cls
    return cls


for _model in (
    *(PolynomialZoom, TableZoom, SplineZoom, PowerZoom, TwoRegionZoom, SmoothZoom, FocusSplineZoom),
    *(RadialPolynomial, Division, BrownConrady),
):
    register_model(_model)


def distortion_model_name(distortion_model: AbstractDistortionModel) -> str:
    """What files call a distortion model; TypeError if it is not registered."""
    return _name_of(distortion_model, _DISTORTION_MODELS)


def distortion_model_from(content: dict[str, Any]) -> AbstractDistortionModel:
    """The distortion model of a file: of version 1 the polynomial; ValueError if it is unknown."""
    name = content.get("distortion_model", content.get("family"))  # up to version 2
    if name is None and content["version"] == 1:
        name = "RadialPolynomial"
    return _class_named(name, _DISTORTION_MODELS, "distortion model")()


def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON whose names are all different: readers differ in which of two they take."""
    found = dict(pairs)
    if len(found) < len(pairs):
        twice = next(name for name, count in Counter(name for name, _ in pairs).items() if count > 1)
        raise ValueError(f"it has {twice!r} twice")
    return found


def refuse_misspelled(content: dict[str, Any], known: Iterable[str], optional: Iterable[str]) -> None:
    """Raise ValueError for an entry whose name is nearly that of an optional one that is not there."""
    missing = {name for name in optional if name not in content}
    for name in content.keys() - {*known, *optional}:
        for meant in difflib.get_close_matches(name.lower(), missing, n=1, cutoff=0.75):
            raise ValueError(f"its {name!r} would not count: {meant!r} is what it is called")


def warn_of_unknown(content: dict[str, Any], known: Iterable[str], path: str) -> None:
    """Warn of entries of a lens file, and of its zoom models, that nothing reads."""
    found = [name for name in content if name not in known]
    for part in ("zoom", "shift"):
        if part in content:
            model = _class_named(content[part]["model"], _ZOOMS, "zoom model")
            fields = {*_RESERVED, *(field.name for field in dataclasses.fields(model))}
            found += [f"{part}.{name}" for name in content[part] if name not in fields]
    if found:
        warn_caller(
            f"{path} has entries that this zoomjax does not know: {plain(listed(found, 5))}. They do not "
            "count, and are gone when the lens is saved. Words and numbers by name stay in its 'about'."
        )


def described(model: AbstractZoom) -> dict[str, Any]:
    """A zoom model as JSON knows it; TypeError if it is not registered or JSON cannot hold its fields."""
    content: dict[str, Any] = {"model": _name_of(model, _ZOOMS), "formula": type(model).formula}
    for field in dataclasses.fields(model):
        value = getattr(model, field.name)
        try:
            content[field.name] = _plain(value) if field.metadata.get("static") else _listed(value)
        except TypeError as error:
            raise TypeError(
                f"A lens with a {type(model).__name__} cannot be saved: its field {field.name} {error}."
            ) from error
    return content


def zoom_from(content: Any, numbers: int | None = None) -> AbstractZoom:
    """The zoom model that is described so, of so many coefficients; ValueError where it is none."""
    model = _class_named(content["model"], _ZOOMS, "zoom model")
    fields = {}
    refuse_misspelled(content, [field.name for field in dataclasses.fields(model)], _LATER)
    for field in dataclasses.fields(model):
        value = content.get(field.name) if field.name in _LATER else content[field.name]
        if field.metadata.get("static"):
            fields[field.name] = _fixed(value)
        elif value is not None or field.default is not None:
            fields[field.name] = array_of(field.name, value)
    zoom = model(**fields)
    try:
        shape = coefficients_shape(zoom)
    except Exception as error:  # whatever a model of a user's own says of parameters of another shape
        raise ValueError("its parameters are not those of its model") from error
    if len(shape) != 1 or numbers not in (None, *shape):
        raise ValueError("its parameters are not those of its model")
    return zoom


def coefficients_shape(zoom: AbstractZoom) -> tuple[int, ...]:
    """The shape of a zoom model's coefficients, (N,) unless it is a batch of them."""
    settings = [jax.ShapeDtypeStruct((), jnp.result_type(float))] * (
        2 if isinstance(zoom, AbstractFocusZoom) else 1
    )
    return eqx.filter_eval_shape(zoom, *settings).shape


def _class_named(name: Any, table: dict[str, Any], kind: str) -> Any:
    if not isinstance(name, str) or name not in table:
        raise ValueError(
            f"its {kind}, {name!r}, is unknown: import the module that registers it by "
            "zoomjax.models.register_model, or update zoomjax"
        )
    return table[name]


def _name_of(model: AbstractZoom | AbstractDistortionModel, table: dict[str, Any]) -> str:
    for name, cls in table.items():
        if cls is type(model):
            return name
    raise TypeError(
        f"A lens with a {type(model).__name__} cannot be saved: register the class by "
        "zoomjax.models.register_model, before it is saved and before it is loaded."
    )


def _listed(value: Any) -> Any:
    """An array as nested lists; JSON keeps every digit of them."""
    if value is None or isinstance(value, bool | int | float):
        return value
    if not eqx.is_array(value) or np.asarray(value).dtype.kind not in "biuf":
        raise TypeError(f"is no array of real numbers, but a {type(value).__name__}")
    array = np.asarray(value)
    return (array.astype(np.float64) if array.dtype.kind == "f" else array).tolist()


def _plain(value: Any) -> Any:
    """A static field as JSON knows it."""
    if isinstance(value, tuple):
        return [_plain(entry) for entry in value]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"is static and no None, boolean, number, text or tuple of these, but {value!r}")


def _fixed(value: Any) -> Any:
    """A static field from what JSON makes of it."""
    if isinstance(value, list):
        return tuple(_fixed(entry) for entry in value)
    if isinstance(value, dict):
        raise ValueError("a static field of its model is a table")
    return value


def array_of(name: str, value: Any, shape: tuple[int, ...] | None = None) -> jax.Array:
    """The array of a file's entry, floats in JAX's own dtype for them; ValueError where it is none."""
    array = np.asarray(None if mixes_booleans(value) else value)
    if array.dtype.kind in "iuf" and (shape is None or array.shape == shape) and array.size:
        dtype = jnp.result_type(float if array.dtype.kind == "f" else int)
        largest = jnp.finfo(dtype).max if array.dtype.kind == "f" else jnp.iinfo(dtype).max
        if (abs(array) <= largest).all():
            return jnp.asarray(array, dtype)
    if array.dtype.kind == "b" and shape is None:
        return jnp.asarray(array)
    raise ValueError(f"the numbers of its {name!r} are incomplete or not finite")
