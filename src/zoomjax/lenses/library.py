"""Lenses of the database as zoom lenses: continuous, differentiable, and proved invertible.

The database maps corrected to distorted radii by polynomials with odd powers too; a `ZoomLens` maps
distorted to corrected radii by even powers. So the lens is fitted to the table: to what lensfun makes of it
at all focal lengths, not only at those measured. `SmoothZoom`, two coefficients, is a smooth curve and the
first choice. Where it is farther from the table than a pixel, the lens is a `TableZoom` of up to seven
coefficients, linear in 1/f between as many focal lengths as that takes.

Fits take no compilation. The proof that a lens is invertible is compiled once for each of the two models.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._core.checks import checked_size
from ..models.invertibility import certificate_of
from ..models.lens import ZoomLens
from ..models.smooth import SmoothZoom
from ..models.tables import TableZoom
from ..models.zoom import AbstractZoom
from ._minimax import RADII, Targets, fit, largest_distance, powers, targets
from .database import LensTable, one_named, version

MODELS = ("auto", "smooth", "table")

FILM = math.hypot(36, 24)
"""Diagonal of the film that crop factors refer to, mm."""

_CLOSE = 1.0
"""Distance from the table, px, up to which the smooth model is chosen."""

_BETWEEN = 0.1
"""What interpolation between the focal lengths of a `TableZoom` may add to that distance, px."""

_TERMS = (7, 6, 4, 2)
"""Coefficients of a `TableZoom`: the first of these with which the lens is invertible."""

_CELLS = 8
"""Parts of each interval between focal lengths of the table, where lensfun interpolates."""

_SPARE = 1.02
"""How far beyond the ends a focal length may be: those in the database and in EXIF data are rounded."""

_LARGER = 1.02
"""How much larger than the sensor of the table that of the image may be: crop factors are rounded, too."""

_BEYOND = 3
"""Focal lengths looked at beyond either end of the table."""

_KNOTS = 64
"""Certificates are compiled for multiples of so many."""


class _Samples(NamedTuple):
    """What lensfun makes of a table at many focal lengths.

    Attributes:
        x: 1/f, increasing: some beyond the last focal length of the table, then `_CELLS` for each interval
            between its focal lengths, and the end of the last, then some beyond the first.
        wanted: the radii there.
    """

    x: Float[np.ndarray, "focal"]
    wanted: Targets


class _Candidate(NamedTuple):
    """A zoom model, and its largest distance from the table, in half diagonals."""

    zoom: AbstractZoom
    error: float


def load(
    lens: str | LensTable,
    *,
    image_size: tuple[int, int],
    crop: float | int | None = None,
    model: str = "auto",
) -> ZoomLens:
    """Load a lens of the lensfun database as a `ZoomLens`.

    Its `about` has what it is of, and ``table_error_px``: how far it puts a point of the distorted image
    from where lensfun does, at most, over the whole image and all focal lengths, px. A magnification of
    each focal length is left out of that: it leaves lines straight, and lensfun's versions differ in it.

    The corrected image has the scale of the original in its centre.

    Args:
        lens: its name, or words of it that no other lens has (`find`); or one of its tables.
        image_size: (width, height) px of the images. They show the whole sensor, or the part of it that
            `crop` is for.
        crop: crop factor of the images, 43.27 mm over the diagonal of the sensor. By default that of the
            sensor on which the lens was calibrated.
        model: "smooth" for a `SmoothZoom`, "table" for a `TableZoom`, or "auto" for a zoom the first of
            these within a pixel of the table, and for a single focal length a `TableZoom` of it.

    Raises:
        ImportError: lensfunpy is not installed.
        ValueError: no lens has this name, or several have; its tables are for smaller sensors only; or
            the model asked for is not invertible.

    Example:
        >>> lens = load("nikkor 18-200mm f/3.5-5.6g if-ed ii", image_size=(4288, 2848))
        >>> lens(35.0).undistort([0.0, 0.0]).round().tolist()
        [95.0, 63.0]
    """
    size = checked_size(image_size)
    if model not in MODELS:
        raise ValueError(f"Argument model must be one of {', '.join(MODELS)}, but it is {model!r}.")
    if crop is not None and not (isinstance(crop, int | float) and 0 < crop < math.inf):
        raise ValueError(f"Argument crop must be a positive number, the crop factor, but it is {crop!r}.")
    table = table_for(one_named(lens), crop) if isinstance(lens, str) else table_for([lens], crop)
    crop = table.crop_factor if crop is None else float(crop)
    samples, scale = _sampled(table, crop), math.hypot(*size) / 2
    models = "table" if model == "auto" and not table.zooms else model
    for found in _candidates(samples, models, scale):
        if model == "auto" and isinstance(found.zoom, SmoothZoom) and found.error * scale > _CLOSE:
            continue
        made = _lens(table, found, size, crop)
        if _certified(made):
            return made
    raise ValueError(
        f'The lens "{table.name}" folds its images over as a {model} model: choose another model.'
        if model != "auto"
        else f'The table of the lens "{table.name}" folds its images over: it cannot be used.'
    )


def table_for(found: list[LensTable], crop: float | int | None) -> LensTable:
    """The table of a lens from the sensor that is nearest, and not smaller.

    Raises:
        ValueError: all are from smaller sensors.
    """
    if crop is None:
        return min(found, key=lambda table: table.crop_factor)
    covering = [table for table in found if table.crop_factor <= crop * _LARGER]
    if not covering:
        least = min(table.crop_factor for table in found)
        raise ValueError(
            f'The lens "{found[0].name}" was calibrated on a sensor of crop factor {least:g}, and images '
            f"of crop factor {crop:g} show more than that: the database does not tell how it draws there."
        )
    return max(covering, key=lambda table: table.crop_factor)


def _sampled(table: LensTable, crop: float) -> _Samples:
    ends = 1 / np.array(table.focal)[::-1]
    between = [np.linspace(a, b, _CELLS + 1)[:-1] for a, b in itertools.pairwise(ends)]
    low, high = _range(table)
    before = np.linspace(1 / high, ends[0], _BEYOND + 1)[:-1]
    after = np.linspace(ends[-1], 1 / low, _BEYOND + 1)[1:]
    x = np.concatenate([before, *between, ends[-1:], after])
    unit = math.hypot(table.aspect_ratio, 1) * table.crop_factor / crop
    return _Samples(x, targets(np.stack([table.polynomial(1 / place) for place in x]), unit))


def _range(table: LensTable) -> tuple[float, float]:
    """The focal lengths that a lens is for."""
    low, high = table.focal_range
    return low / _SPARE, high * _SPARE


def _candidates(samples: _Samples, model: str, scale: float) -> Iterator[_Candidate]:
    """Zoom models for a table, in the order of choice."""
    if model == "smooth" or (model == "auto" and _two_may_do(samples, _CLOSE / scale)):
        yield _smooth(samples)
    if model != "smooth":
        for terms in _TERMS:
            yield _table(samples, terms, _BETWEEN / scale)


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
        zoom, parameters=jnp.asarray(parameters), focal_ref=jnp.asarray(1 / samples.x[-1])
    )
    return _Candidate(zoom, largest_distance(basis @ parameters, samples.wanted).max())


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
    zoom = TableZoom(parameters=jnp.asarray(each[knots]), knots=jnp.asarray(x[knots]))
    there = _interpolated(samples.x, x[knots], each[knots])
    return _Candidate(zoom, largest_distance(there, samples.wanted).max())


def _interpolated(x, knots, values):
    return np.stack([np.interp(x, knots, column) for column in values.T], axis=-1)


def _certified(lens: ZoomLens) -> bool:
    """Whether it is proved invertible over the image."""
    zoom = _with_more_knots(lens.zoom) if isinstance(lens.zoom, TableZoom) else lens.zoom
    return bool(certificate_of(zoom, lens.centre, lens.focal_range, lens.image_size).certified)


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


def _lens(table: LensTable, found: _Candidate, size: tuple[int, int], crop: float) -> ZoomLens:
    scale = math.hypot(*size) / 2
    return ZoomLens(
        zoom=found.zoom,
        centre=jnp.asarray(_centre(table, size)),
        focal_range=jnp.asarray(_range(table)),
        image_size=size,
        pixel_pitch=FILM / (crop * 2 * scale),
        about={
            "lens": table.name,
            "maker": table.maker,
            "crop_factor": crop,
            "table_error_px": float(f"{found.error * scale:.3g}"),
            "source": f"lensfun database, CC BY-SA 3.0, of lensfunpy {version()}",
        },
    )


def _centre(table: LensTable, size: tuple[int, int]) -> Float[np.ndarray, "2"]:
    """The centre of distortion, px; lensfun has it in halves of the shorter side from the middle."""
    off = np.array([table.source.center_x, table.source.center_y], float)
    return (np.array(size) - 1) / 2 + off * (min(size) - 1) / 2
