"""The width of a pixel on the sensor, mm: a number in µm or m is a mistake that nothing else would show."""

import math
from typing import Any

from .arrays import as_array
from .fields import known

_LEAST, _MOST = 0.0001, 0.3
"""mm: below the pixels of phones, also in an image scaled up, and above those of sensors for heat and of
most images scaled down. A number of µm is above, one of m below."""

_MOST_IN_IMAGE = 1.0
"""mm, in an image whose size is known: above any of a few dozens of pixels across."""

_DIAGONALS = 0.1, 700.0
"""mm: below the smallest endoscope, and above the largest plates and sensors of telescopes."""


def pitch_problem(value: Any, size: tuple[int, int] | None = None) -> str | None:
    """Why values are no width of a pixel in mm; None where they are, or where they are not known.

    With the size of the image, by the sensor: in a small image a pixel may be wide.
    """
    values = known(as_array(value) if isinstance(value, int | float) else value)
    if values is None or not values.size:
        return None
    good = (values >= _LEAST) & (values <= (_MOST if size is None else _MOST_IN_IMAGE))
    if size is not None:
        diagonal = values * math.hypot(*size)
        good = good & (diagonal >= _DIAGONALS[0]) & (diagonal <= _DIAGONALS[1])
    if good.all():
        return None
    pitch = float(values[~good].flat[0])
    across = f" and a sensor of {pitch * math.hypot(*size):.3g} mm across" if size else ""
    return f"it means pixels of {pitch:.4g} mm{across}, which there are not (3.9 µm are 0.0039)"


def check_pitch(value: Any, size: tuple[int, int] | None = None) -> None:
    """Refuse values that are no width of a pixel in mm.

    Raises:
        ValueError: no sensor has such pixels, or an image of this size of them.
    """
    if (problem := pitch_problem(value, size)) is not None:
        raise ValueError(
            "Argument pixel_pitch must be the width of a pixel on the sensor in mm, which is the sensor's "
            f"width over that of the image in px, but {problem}."
        )
