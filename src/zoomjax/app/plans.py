"""What a calibration would do (``--dry-run``), and lines left out by hand (``--exclude``)."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .._core.text import plain

if TYPE_CHECKING:
    from ..lines.lines import Lines
    from .image_calibration import ImageJob

_LISTED = 20


def lines_plan(lines: "Lines", exclude: Sequence[int]) -> list[str]:
    """What would be fitted, in lines of text."""
    left, focal = len(lines.frame) - len(exclude), np.asarray(without(lines, exclude).focal)
    return [
        f"{left:,} of {len(lines.frame):,} lines in {len(focal)} frames, "
        f"f = {focal.min():g} to {focal.max():g} {lines.focal_unit}."
    ]


def images_plan(job: "ImageJob") -> list[str]:
    """The photos that would be read, each with the focal length in its EXIF data, in lines of text."""
    from ..io.photo import read_focal

    if job.video is not None:
        return [f"Up to {job.frames} frames of {plain(str(job.video))}, by the detector {job.detector}."]
    sources = list(job.sources()[0])
    told = [f"{len(sources)} photos, by the detector {job.detector}:"]
    for source in sources[:_LISTED]:
        try:
            focal = read_focal(source.path or Path())
        except (OSError, ValueError) as error:
            told.append(f"  {plain(source.name)}: {plain(str(error))}")
        else:
            told.append(
                f"  {plain(source.name)}: {'no f in EXIF data' if focal is None else f'{focal:g} mm'}"
            )
    return [*told, *([f"  and {len(sources) - _LISTED} more"] if len(sources) > _LISTED else [])]


def tell_plan(told: Sequence[str], output: Path) -> None:
    """Print a plan."""
    print("\n".join(told))
    print(f"Results would be written to {plain(str(output))}. Nothing was written.")


def without(lines: "Lines", exclude: Sequence[int]) -> "Lines":
    """The lines with a weight of 0 for those excluded.

    Raises:
        ValueError: there is no such line.
    """
    if not exclude:
        return lines
    number = len(lines.frame)
    missing = [line for line in exclude if line >= number]
    if missing:
        raise ValueError(f"There is no line {missing[0]}: the lines are 0 to {number - 1}.")
    weight = np.ones(number) if lines.weight is None else np.array(lines.weight)
    weight[list(exclude)] = 0
    return lines.weighted(weight)
