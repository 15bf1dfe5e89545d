"""Facts about a lens beside its numbers: what `ZoomLens.about` holds."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

USUAL = ("camera", "lens", "crop_factor", "digital_zoom", "source", "focal")
"""Names that zoomjax itself writes."""

WIDTH_OF_FOCALS = "width_of_focal_px"
"""Where focal lengths in px are of images of another size than the lens's, the width of those, px."""

_POSITIVE = ("crop_factor", "digital_zoom", WIDTH_OF_FOCALS)
"""Names of what is computed with: words there would not count."""

UNKNOWN = "not known"
"""What ``about["focal"]`` says of a lens of one focal length that nobody knows: its number is arbitrary."""

RELATIVE = "relative"
"""What it says of a zoom lens whose focal lengths have a common factor that is not known: they are right
beside one another, and with the track that they were found with."""


class About(Mapping[str, str | float]):
    """Words and numbers by name, which do not change: a mapping that can be hashed.

    Lenses with other facts are other trees for JAX, because the facts are static. To stack lenses, or to
    share what is compiled for one of them, leave the facts out: ``dataclasses.replace(lens, about={})``.

    Example:
        >>> about = About({"camera": "NIKON D300", "crop_factor": 1.5})
        >>> about["camera"], len(about), about == {"camera": "NIKON D300", "crop_factor": 1.5}
        ('NIKON D300', 2, True)
    """

    def __init__(self, entries: Mapping[str, str | float] = {}) -> None:
        self._entries = dict(entries)

    def __getitem__(self, name: str) -> str | float:
        return self._entries[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def __hash__(self) -> int:
        return hash(frozenset(self._entries.items()))

    def __repr__(self) -> str:
        return f"About({self._entries!r})"


def checked_about(value: Any) -> About:
    """Facts from a mapping of names to words and finite numbers."""
    plain = isinstance(value, Mapping) and all(map(_is_plain, value, value.values()))
    if not plain:
        raise ValueError(
            f"Argument about must be a dictionary of words and finite numbers by name, but it is {value!r}."
        )
    for name in _POSITIVE:
        number = value.get(name, 1)
        if isinstance(number, str) or number <= 0:
            raise ValueError(f"Argument about must hold a positive number as {name}, but it is {number!r}.")
    if value.get("focal", UNKNOWN) not in (UNKNOWN, RELATIVE):
        raise ValueError(
            f"Argument about must hold {UNKNOWN!r} or {RELATIVE!r} as focal, or no focal at all, but it is "
            f"{value['focal']!r}."
        )
    return About(value)


def checked_pitch(value: Any) -> float | None:
    """The width of a pixel, mm, or None where it is not known."""
    if value is None:
        return None
    try:
        pitch = math.nan if isinstance(value, bool | str) else float(value)
    except (TypeError, ValueError):
        pitch = math.nan
    if not 0 < pitch < math.inf:
        raise ValueError(
            "Argument pixel_pitch must be the width of a pixel on the sensor in mm, a positive number, or "
            f"None, but it is {value!r}."
        )
    return pitch


def _is_plain(name: Any, value: Any) -> bool:
    number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return isinstance(name, str) and (number or isinstance(value, str))
