"""Zoom models for radial tables, as lensfun has them: one way for the library of lenses and for files.

A table maps corrected to distorted radii by polynomials with odd powers too; a zoom lens maps distorted to
corrected radii by even powers. So the zoom model is fitted to the table: to what the tool makes of it at
all focal lengths, not only at those measured. `SmoothZoom`, two coefficients, is a smooth curve and the
first choice. Where it is farther from the table than a pixel, the model is a `TableZoom` of up to seven
coefficients, linear in 1/f between as many focal lengths as that takes.

Fits take no compilation. The proof that a lens is invertible is compiled once for each of the two models.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._core.pixels import pitch_problem
from ..io.equipment import FILM
from ..models.invertibility import certificate_of
from ..models.smooth import SmoothZoom
from ..models.tables import TableZoom
from ..models.zoom import AbstractZoom
from ._minimax import RADII, Targets, fit, largest_distance, powers, targets

MODELS = ("auto", "smooth", "table")

LARGER = 1.02
"""How much larger than the sensor of a table that of the image may be: crop factors are rounded, too."""

SPARE = 1.02
"""How far beyond the ends a focal length may be: those in databases and in EXIF data are rounded."""

_CLOSE = 1.0
"""Distance from the table, px, up to which the smooth model is chosen."""

_BETWEEN = 0.1
"""What interpolation between the focal lengths of a `TableZoom` may add to that distance, px."""

_TERMS = (7, 6, 4, 2)
"""Coefficients of a `TableZoom`: the first of these with which the lens is invertible."""

_CELLS = 8
"""Parts of each interval between focal lengths of the table, where the tool interpolates."""

_BEYOND = 3
"""Focal lengths looked at beyond either end of the table."""

_KNOTS = 64
"""Certificates are compiled for multiples of so many."""


def pitch_by_crop(crop: float, size: tuple[int, int]) -> float:
    """mm from one pixel to the next in images of a crop factor; ValueError where no camera has them."""
    pitch = FILM / (crop * math.hypot(*size))
    if (problem := pitch_problem(pitch, size)) is not None:
        width, height = size
        raise ValueError(f"No images of {width} x {height} px have a crop factor of {crop:g}: {problem}.")
    return pitch


@dataclasses.dataclass(frozen=True)
class RadialTable:
    """A tool's table of polynomials, with the tool's own interpolation.

    Attributes:
        focal: focal lengths of the table, increasing.
        focal_range: the shortest and longest focal length that a model is to be for.
        polynomial: distorted over corrected radius at a focal length, by powers of the corrected radius.
        unit: half of the image's diagonal in the unit of these radii.
        scaled: whether the tool scales the corrected image as it likes. Then a magnification of each focal
            length is left out of all distances: it leaves lines straight.
    """

    focal: tuple[float, ...]
    focal_range: tuple[float, float]
    polynomial: Callable[[float], Float[np.ndarray, "power"]]
    unit: float
    scaled: bool = True


class TableFit(NamedTuple):
    """A zoom model for a table.

    Attributes:
        zoom: the model, invertible over the image.
        at_nodes: largest distance from the table at its focal lengths, px of the distorted image, up to the
            corner that is farthest from the centre.
        between: the same between them, and up to the ends of the range.
        short: focal lengths of the table at which it folds over within the image.
    """

    zoom: AbstractZoom
    at_nodes: float
    between: float
    short: tuple[float, ...]

    @property
    def error(self) -> float:
        """The largest distance anywhere, px of the distorted image."""
        return max(self.at_nodes, self.between)


def zoom_of_table(
    table: RadialTable, *, centre: Any, image_size: tuple[int, int], model: str = "auto"
) -> TableFit | None:
    """The first zoom model for a table that is near it and proved invertible; None if there is none.

    Args:
        table: the table.
        centre: centre of distortion, px.
        image_size: (width, height) px.
        model: "smooth" for a `SmoothZoom`, "table" for a `TableZoom`, or "auto" for the first of these
            within a pixel of the table, and a `TableZoom` for a single focal length.
    """
    scale = math.hypot(*image_size) / 2
    away = abs(np.asarray(centre, float) - (np.array(image_size) - 1) / 2)
    farthest = float(np.hypot(*(away + np.array(image_size) / 2)))
    samples = _sampled(table, farthest / scale)
    if samples is None:
        return None
    models = "table" if model == "auto" and len(table.focal) == 1 else model
    for found in _candidates(samples, models, scale):
        far = found.errors.max() * farthest > _CLOSE
        if model == "auto" and isinstance(found.zoom, SmoothZoom) and far:
            continue
        if _certified(found.zoom, centre, table.focal_range, image_size):
            at_nodes = np.zeros(samples.x.size, bool)
            at_nodes[_BEYOND : samples.x.size - _BEYOND : _CELLS] = True
            seen = np.all(samples.wanted.seen, axis=1, keepdims=True)[at_nodes, 0][::-1]
            return TableFit(
                found.zoom,
                float(found.errors[at_nodes].max() * farthest),
                float(found.errors[~at_nodes].max() * farthest),
                tuple(f for f, whole in zip(table.focal, seen.tolist(), strict=True) if not whole),
            )
    return None


class _Samples(NamedTuple):
    """What the tool makes of a table at many focal lengths.

    Attributes:
        x: 1/f, increasing: some beyond the last focal length of the table, then `_CELLS` for each interval
            between its focal lengths, and the end of the last, then some beyond the first.
        wanted: the radii there, the farthest corner of the image from the centre being 1.
        reach: how far that corner is, in half diagonals.
    """

    x: Float[np.ndarray, "focal"]
    wanted: Targets
    reach: float

    def in_half_diagonals(self, coefficients: Float[np.ndarray, "... terms"]) -> np.ndarray:
        """Coefficients k1, k2, ... for radii in half diagonals."""
        return coefficients / self.reach ** (2 * np.arange(1, coefficients.shape[-1] + 1))


class _Candidate(NamedTuple):
    """A zoom model, and its largest distance from the table at each focal length, the corner being 1."""

    zoom: AbstractZoom
    errors: Float[np.ndarray, "focal"]


def _sampled(table: RadialTable, reach: float) -> _Samples | None:
    """What it is looked at; None where the tool has no map at all."""
    ends = 1 / np.array(table.focal)[::-1]
    between = [np.linspace(a, b, _CELLS + 1)[:-1] for a, b in itertools.pairwise(ends)]
    low, high = table.focal_range
    before = np.linspace(1 / high, ends[0], _BEYOND + 1)[:-1]
    after = np.linspace(ends[-1], 1 / low, _BEYOND + 1)[1:]
    x = np.concatenate([before, *between, ends[-1:], after])
    polynomials = np.stack([table.polynomial(1 / place) for place in x])
    if not (polynomials[:, 0] > 0).all():
        return None
    wanted = targets(polynomials, table.unit * reach, scaled=table.scaled)
    return _Samples(x, wanted, reach) if wanted.seen.any(axis=1).all() else None


def _candidates(samples: _Samples, model: str, scale: float) -> Iterator[_Candidate]:
    """Zoom models for a table, in the order of choice."""
    if model == "smooth" or (model == "auto" and _two_may_do(samples, _CLOSE / (scale * samples.reach))):
        yield _smooth(samples)
    if model != "smooth":
        for terms in _TERMS:
            yield _table(samples, terms, _BETWEEN / (scale * samples.reach))


@functools.cache
def _prior(dtype: np.dtype) -> SmoothZoom:
    """The model without parameters, in JAX's own dtype for floats."""
    return jax.tree.map(lambda leaf: leaf.astype(dtype), SmoothZoom())


def _two_may_do(samples: _Samples, close: float) -> bool:
    """Whether two coefficients are close to the table at each of its focal lengths by itself."""
    wanted = samples.wanted.at(slice(_BEYOND, samples.x.size - _BEYOND, _CELLS))
    columns = np.broadcast_to(powers(2), (len(wanted.slope), 1, RADII.size, 2))
    each = fit(columns, wanted.at((slice(None), None)))
    return bool(largest_distance(each, wanted).max() <= close)


def _smooth(samples: _Samples) -> _Candidate:
    """The polynomials of `SmoothZoom` that are nearest to the table."""
    zoom = _prior(jnp.result_type(float))
    columns = powers(zoom.beyond.shape[0])
    basis = np.polynomial.legendre.legvander(2 * samples.x / samples.x[-1] - 1, zoom.degree)
    design = basis[:, None, :, None] * columns[None, :, None]
    design = design.reshape(1, *design.shape[:2], -1)
    parameters = fit(design, samples.wanted.at(None))[0].reshape(basis.shape[1], -1)
    zoom = dataclasses.replace(
        zoom,
        parameters=jnp.asarray(samples.in_half_diagonals(parameters)),
        focal_ref=jnp.asarray(1 / samples.x[-1]),
    )
    return _Candidate(zoom, largest_distance(basis @ parameters, samples.wanted))


def _table(samples: _Samples, terms: int, between: float) -> _Candidate:
    """Coefficients nearest to the table at some focal lengths, and linear in 1/f between them."""
    inner = slice(_BEYOND, samples.x.size - _BEYOND)
    x, wanted = samples.x[inner], samples.wanted.at(inner)
    columns = np.broadcast_to(powers(terms), (x.size, 1, RADII.size, terms))
    each = fit(columns, wanted.at((slice(None), None)))
    own = largest_distance(each, wanted)
    knots = np.zeros(x.size, bool)
    knots[::_CELLS] = True
    for stride in (_CELLS, _CELLS // 2, _CELLS // 4):  # halve where lines are not near enough
        error = largest_distance(_interpolated(x, x[knots], each[knots]), wanted)
        far = np.flatnonzero(error > own.max() + between)
        knots[np.unique(far // stride) * stride + stride // 2] = True
    own = samples.in_half_diagonals(each[knots])
    zoom = TableZoom(parameters=jnp.asarray(own), knots=jnp.asarray(x[knots]))
    there = _interpolated(samples.x, x[knots], each[knots])
    return _Candidate(zoom, largest_distance(there, samples.wanted))


def _interpolated(x, knots, values):
    return np.stack([np.interp(x, knots, column) for column in values.T], axis=-1)


def _certified(
    zoom: AbstractZoom, centre: Any, focal_range: tuple[float, float], size: tuple[int, int]
) -> bool:
    """Whether it is proved invertible over the image."""
    zoom = _with_more_knots(zoom) if isinstance(zoom, TableZoom) else zoom
    return bool(certificate_of(zoom, jnp.asarray(centre), jnp.asarray(focal_range), size).certified)


def _with_more_knots(zoom: TableZoom) -> TableZoom:
    """The same function, with more knots on its lines: one of few shapes to compile for."""
    assert zoom.knots is not None
    assert zoom.parameters is not None
    knots, values = np.asarray(zoom.knots), np.asarray(zoom.parameters)
    if knots.size == 1:
        return zoom
    more = -(-knots.size // _KNOTS) * _KNOTS - knots.size
    widest = int(np.argmax(np.diff(knots)))
    extra = np.linspace(knots[widest], knots[widest + 1], more + 2, dtype=knots.dtype)[1:-1]
    x = np.sort(np.concatenate([knots, extra]))
    return TableZoom(
        parameters=jnp.asarray(_interpolated(x, knots, values), values.dtype), knots=jnp.asarray(x)
    )
