"""Zoom models that are linear in their parameters, made ready for the frames that cross-validation leaves.

The values of a model's basis at the frames are all that a fit in NumPy needs of it. What models are made
ready alike, of whatever frames, is looked at once.
"""

import collections
import functools
from collections.abc import Hashable
from typing import Any, NamedTuple

import jax
import numpy as np

from .._core.programs import light_program
from ..fit.energy import prior_jacobian, prior_residuals, settings
from ..lines.base import AbstractLines
from ..lines.buckets import bucketed_jit, padded_frames, padded_to
from ..models.model import Model
from ..models.zoom import AbstractPriorZoom, AbstractZoom, with_parameters


class Design(NamedTuple):
    """A prepared linear model on the frames: ``k_m = basis_m @ parameters``."""

    basis: np.ndarray  # (frame, basis)
    precision: np.ndarray  # (parameter, parameter): of the prior, in the unit of eq. 13
    mean: np.ndarray  # (parameter,): of the prior


class Designs:
    """Zoom models made ready for the frames that are left: for each row of `left`."""

    def __init__(self, lines: AbstractLines, left: np.ndarray):
        self._lines, self._left = lines, left
        self._known: dict[Hashable, tuple[list[Hashable], dict[Hashable, Any]]] = {}

    def of(self, model: Model) -> tuple[list[Design | None], str]:
        """The designs, None where it cannot be made ready, and why the first of these cannot.

        Where a model is made ready alike, its design is the same object.
        """
        keys, ready = self._ready(model.zoom, model.terms)
        made = {
            key: None if isinstance(of, str) else _design(self._lines, model.terms, *of)
            for key, of in ready.items()
        }
        problems = (of for key in keys if isinstance(of := ready[key], str))
        return [made[key] for key in keys], next(problems, "")

    def _ready(self, zoom: Any, terms: int) -> tuple[list[Hashable], dict[Hashable, Any]]:
        """A key of each row, and of each key the model and the values of its basis; or why there are none.

        Models without a prior have the same for any number of terms.
        """
        leaves, structure = jax.tree.flatten(zoom)
        own = terms if isinstance(zoom, AbstractPriorZoom) else None
        place = (structure, own, *((np.shape(leaf), np.asarray(leaf).tobytes()) for leaf in leaves))
        if place not in self._known:
            try:
                given = [np.asarray(values) for values in settings(zoom, self._lines)]
            except ValueError as error:
                return [None] * len(self._left), {None: str(error)}
            parts = [[values[left] for values in given] for left in self._left]
            # A class that is made ready otherwise than its parent has no key from there.
            own = zoom if _of_one_class(zoom, "prepare", "prepared_by") else None
            key_of = functools.partial(AbstractZoom.prepared_by, zoom) if own is None else own.prepared_by
            keys = [key_of(*of) for of in parts]
            models: dict[Hashable, Any] = {}
            for key, of in zip(keys, parts, strict=True):
                if key not in models:
                    models[key] = _prepared(zoom, terms, of)
            ready = {key: each for key, each in models.items() if not isinstance(each, str)}
            values = _values([*ready.values()], given)
            models |= {key: (ready[key], own) for key, own in zip(ready, values, strict=True)}
            self._known[place] = keys, models
        return self._known[place]


def _prepared(zoom, terms, settings):
    """The zoom model made ready for frames of these settings, or why it cannot be."""
    try:
        focal, *focus = settings
        return zoom.prepare(focal, terms, *focus)
    except ValueError as error:
        return str(error)


def _design(lines, terms, zoom, values):
    """Of a model made ready, from the values of its basis at all frames."""
    size = values.shape[1]
    precision, mean = np.zeros((size * terms, size * terms)), np.zeros(size * terms)
    if isinstance(zoom, AbstractPriorZoom):
        whitener, of_zero = (np.asarray(part, float) for part in _whitener(lines, zoom))
        precision = whitener.T @ whitener
        mean = np.linalg.lstsq(whitener, -of_zero, rcond=None)[0]
    return Design(values, precision, mean)


def _values(zooms, given):
    """The values of each model's basis at all frames: (frame, basis)."""
    if zooms and zooms[0].elementwise and _of_one_class(zooms[0], "basis", "elementwise"):
        focal, *more = (values.astype(float) for values in given)
        return [jax.tree.map(_in_double, zoom).basis(focal, *more).T for zoom in zooms]
    return _compiled_values([with_parameters(zoom, None) for zoom in zooms], given)


def _in_double(leaf):
    return np.asarray(leaf, float if np.issubdtype(leaf.dtype, np.floating) else None)


def _of_one_class(model, *names):
    """Whether a class defines all of these itself, and none of them is of another of its ancestors."""
    return len({next(cls for cls in type(model).__mro__ if name in vars(cls)) for name in names}) == 1


def _compiled_values(zooms, given):
    """The same by a program; of models that differ in numbers alone, at once."""
    every, alike = [*map(padded_frames, given)], collections.defaultdict(list)
    for place, zoom in enumerate(zooms):
        leaves, structure = jax.tree.flatten(zoom)
        alike[structure, *((np.shape(leaf), np.asarray(leaf).dtype) for leaf in leaves)].append(place)
    found: list[Any] = [None] * len(zooms)
    for places in alike.values():
        number = 1 << max(_FEWEST, (len(places) - 1).bit_length())
        several = [zooms[place] for place in places]
        stack = jax.tree.map(lambda *leaves, to=number: padded_to(np.stack(leaves), to), *several)
        values = np.asarray(_bases(stack, every, number), float)[:, : len(given[0])]
        for place, own in zip(places, values, strict=False):
            found[place] = own
    return found


_FEWEST = 5
"""Models at once, as a power of two: one compiled program for any number up to it."""


@light_program
def _bases(models, settings, number):
    """Of models without their parameters: one compiled program for any number of terms."""
    return jax.vmap(lambda model: jax.vmap(model.basis)(*settings), axis_size=number)(models)


@bucketed_jit()
def _whitener(lines, model):
    """What makes of the flattened parameters what their prior adds to the residuals, px; and of zeros."""
    return prior_jacobian(lines, model), prior_residuals(lines, model)
