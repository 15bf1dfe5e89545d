"""The lenses of the lensfun database: their names, and the tables that people measured.

The database comes with the package `lensfunpy` (extra ``lensfun``) under the licence CC BY-SA. It is
read where it is installed, and nothing of it is stored here. Lenses are those that draw straight lines
straight but for distortion; fisheyes are left out. The same lens may be in it several times, calibrated on
sensors of different sizes.

A table has for some focal lengths a polynomial from the corrected to the distorted radius, in halves of the
shorter side of a sensor of the table's own crop factor and aspect ratio:
``rd = ru (a ru^3 + b ru^2 + c ru + 1 - a - b - c)`` (ptlens), ``ru (k ru^2 + 1 - k)`` (poly3) or
``ru (1 + k1 ru^2 + k2 ru^4)`` (poly5). Between focal lengths lensfun's own code interpolates.
"""

import dataclasses
import functools
import importlib.metadata
import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Float

from .._core.arguments import kinds_checked

_ASPECTS = (3 / 2, 4 / 3, 16 / 9, 1.0, 5 / 4)
"""Of sensors that lenses were calibrated on; the first where nothing tells."""

_KINDS = ("PTLENS", "POLY3", "POLY5")

_MOST_NAMED = 8
"""Lenses named in an error."""


@dataclasses.dataclass(frozen=True)
class LensTable:
    """A lens of the database, calibrated on one size of sensor.

    Attributes:
        name, maker: of the lens.
        mounts: cameras that it fits.
        crop_factor: of the sensor it was calibrated on.
        focal: the focal lengths calibrated, mm, increasing.
        focal_range: the shortest and longest focal length of the lens, mm.
        source: lensfunpy's own object.
    """

    name: str
    maker: str
    mounts: tuple[str, ...]
    crop_factor: float
    focal: tuple[float, ...]
    focal_range: tuple[float, float]
    source: Any = dataclasses.field(repr=False, compare=False)

    @property
    def zooms(self) -> bool:
        """Whether it is calibrated at several focal lengths."""
        return len(self.focal) > 1

    @property
    def kind(self) -> str:
        """Of its polynomials: "PTLENS", "POLY3" or "POLY5"."""
        return self.source.calib_distortion[0].model.name

    @functools.cached_property
    def aspect_ratio(self) -> float:
        """Of the sensor it was calibrated on: the one with which lensfun's corrections come out.

        The database holds it, and lensfunpy does not tell.
        """
        strongest = max(self.focal, key=lambda f: abs(float(self.polynomial(f)[1:].sum())))
        stretch = _corner_stretch(self, strongest)
        polynomial = self.polynomial(strongest)[::-1]
        return min(
            _ASPECTS, key=lambda aspect: abs(np.polyval(polynomial, math.hypot(aspect, 1)) - stretch)
        )

    def polynomial(self, focal: float) -> Float[np.ndarray, "power"]:
        """Distorted over corrected radius, by powers 0 to 4 of the corrected radius, in the table's unit.

        Between focal lengths of the table, and beyond, as lensfun reads it.
        """
        found = self.source.interpolate_distortion(float(focal))
        terms = [float(term) for term in found.terms]
        if found.model.name == "PTLENS":
            a, b, c = terms[:3]
            return np.array([1 - a - b - c, c, b, a, 0.0])
        if found.model.name == "POLY3":
            return np.array([1 - terms[0], 0.0, terms[0], 0.0, 0.0])
        return np.array([1.0, 0.0, terms[0], 0.0, terms[1]])


def lens_names() -> list[str]:
    """The names of all lenses, in order, each once.

    Raises:
        ImportError: lensfunpy is not installed.
    """
    return sorted({table.name for table in tables()}, key=str.casefold)


@kinds_checked
def find_lenses(search: str = "", *, zooms: bool = False) -> list[LensTable]:
    """Find lenses by words of their names.

    Args:
        search: words such as "nikkor 18-200", each of which must be in the name or the maker's; case does
            not matter. Empty for all lenses.
        zooms: whether to leave out lenses calibrated at a single focal length.

    Returns:
        Their tables by name, those of larger sensors first; empty where there is none.

    Raises:
        ImportError: lensfunpy is not installed.

    Example:
        >>> [table.focal_range for table in find_lenses("nikkor 18-200")]
        [(18.0, 200.0), (18.0, 200.0)]
    """
    if not isinstance(search, str):
        raise ValueError(f"Argument search must be words of a lens's name, but it is {search!r}.")
    wanted = search.casefold().split()
    found = [
        table
        for table in tables()
        if (table.zooms or not zooms)
        and all(word in f"{table.maker} {table.name}".casefold() for word in wanted)
    ]
    return sorted(found, key=lambda table: (table.name.casefold(), table.crop_factor))


def one_named(name: str) -> list[LensTable]:
    """The tables of the one lens of this name, or with these words in its name.

    Raises:
        ValueError: there is none, or there are several.
    """
    found = find_lenses(name)
    exact = [table for table in found if table.name.casefold() == name.casefold().strip()]
    found = exact or found
    different = list(dict.fromkeys(table.name for table in found))
    if not different:
        raise ValueError(
            f"The lensfun database has no lens {name!r}: search it by fewer words of its name, such as its "
            "focal lengths."
        )
    if len(different) > 1:
        raise ValueError(f"{len(different)} lenses fit {name!r}: choose {listed(different)}.")
    return found


def listed(found: Iterable[str]) -> str:
    """Some names in one sentence."""
    quoted = [f'"{name}"' for name in found]
    if len(quoted) > _MOST_NAMED:
        return f"{', '.join(quoted[:_MOST_NAMED])} or one of {len(quoted) - _MOST_NAMED} more"
    return " or ".join([", ".join(quoted[:-1]), quoted[-1]] if len(quoted) > 1 else quoted)


@functools.cache
def database() -> Any:
    """The database, read once.

    Raises:
        ImportError: lensfunpy is not installed.
    """
    return lensfunpy().Database()


def lensfunpy() -> Any:
    """The package lensfunpy; ImportError where it is not installed."""
    try:
        import lensfunpy
    except ModuleNotFoundError as error:
        raise ImportError(
            'The library of lenses needs the extra "lensfun": pip install "zoomjax[lensfun]"'
        ) from error
    return lensfunpy


@functools.cache
def version() -> str:
    """Of lensfunpy, and so of the database."""
    return importlib.metadata.version("lensfunpy")


@functools.cache
def tables() -> tuple[LensTable, ...]:
    """All tables."""
    return tuple(filter(None, map(table_of, database().lenses)))


def table_of(lens: Any) -> LensTable | None:
    """The table of one of lensfunpy's lenses; None of a fisheye, and without a calibration of one kind."""
    entries = lens.calib_distortion or ()
    focal = sorted({float(entry.focal) for entry in entries})
    kinds = {entry.model.name for entry in entries}  # of several, lensfun reads the first alone
    if lens.type.name != "RECTILINEAR" or len(kinds) != 1 or not kinds <= set(_KINDS):
        return None
    ends = [end for end in (lens.min_focal, lens.max_focal) if end > 0]
    return LensTable(
        name=" ".join(lens.model.split()),
        maker=lens.maker,
        mounts=tuple(lens.mounts),
        crop_factor=round(float(lens.crop_factor), 3),
        focal=tuple(focal),
        focal_range=(min([*ends, focal[0]]), max([*ends, focal[-1]])),
        source=lens,
    )


def _corner_stretch(table: LensTable, focal: float) -> float:
    """Distorted over corrected radius in the corner of the table's own sensor, by lensfun's code."""
    package, (width, height) = lensfunpy(), (3001, 2001)
    modifier = package.Modifier(table.source, table.source.crop_factor, width, height)
    modifier.initialize(focal, 4.0, 1000.0, scale=1.0, flags=package.ModifyFlags.DISTORTION)
    x, y = np.ravel(modifier.apply_geometry_distortion(0.0, 0.0, 1, 1)).tolist()
    middle = ((width - 1) / 2, (height - 1) / 2)
    return math.hypot(x - middle[0], y - middle[1]) / math.hypot(*middle)
