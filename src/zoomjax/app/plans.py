"""What a command would do (``--dry-run``), and lines left out by hand (``--exclude``)."""

import contextlib
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .._core.text import listed, plain, span

if TYPE_CHECKING:
    from ..detect.sources import Source
    from ..lines.lines import Lines
    from .image_job import ImageJob
    from .model_choice import WantedCentre

_LISTED, _NAMED = 20, 6

_UNKNOWN = "all at one f, which is not known"


def check_centre(centre: "WantedCentre", sizes: Iterable[tuple[int, int]]) -> None:
    """Warn of a centre of distortion outside of the images, as a fit would.

    Args:
        centre: coordinates, px, or how it is found.
        sizes: width and height of the images, px.
    """
    if isinstance(centre, str):
        return
    from ..fit.zoom import given_centre

    for size in sorted(set(sizes)):
        given_centre(centre, size, stacklevel=2)


def photo_sizes(job: "ImageJob") -> Iterator[tuple[int, int]]:
    """Width and height of the photos that say them before they are decoded."""
    from ..io.photo import read_size

    for source in () if job.video is not None else job.sources()[0]:
        with contextlib.suppress(OSError, ValueError):  # said in the plan
            yield read_size(source.path or Path())


def lines_plan(lines: "Lines", exclude: Sequence[int], *, focal_known: bool = True) -> list[str]:
    """What would be fitted, in lines of text."""
    left, focal = len(lines.frame) - len(exclude), np.asarray(without(lines, exclude).focal)
    if not left:
        raise ValueError("No line is left: give fewer to be excluded.")
    zooms = (
        f"f = {span(float(focal.min()), float(focal.max()), lines.focal_unit)}" if focal_known else _UNKNOWN
    )
    frames = f"{len(focal)} frame{'s' * (len(focal) != 1)}"
    return [f"{left:,} of {len(lines.frame):,} lines in {frames}, {zooms}."]


def images_plan(job: "ImageJob") -> list[str]:
    """The photos that would be read, each with its focal length as far as it is known before, as text."""
    if job.video is not None:
        return [f"Up to {job.frames} frames of {plain(str(job.video))}, by the detector {job.detector}."]
    sources = list(job.sources()[0])
    photos = "1 photo" if len(sources) == 1 else f"{len(sources)} photos"
    told = [f"{photos}, by the detector {job.detector}:"]
    focal_of = _focal_lengths(job, [source.path or Path() for source in sources])
    for source in sources[:_LISTED]:
        try:
            told.append(f"  {plain(source.name)}: {focal_of(source.path or Path())}")
        except (OSError, ValueError) as error:
            told.append(f"  {plain(source.name)}: {plain(str(error))}")
    more = [f"  and {len(sources) - _LISTED} more"] if len(sources) > _LISTED else []
    return [*told, *more, *_zooms(job, sources)]


def _zooms(job: "ImageJob", photos: Sequence["Source"]) -> list[str]:
    """Which photos would share a focal length, as far as that is known before they are looked at."""
    if job.shared_focal is None:
        return []
    if job.shared_focal == "similarity":
        return ["Photos whose focal lengths agree would share one."]
    members: dict[str, list[str]] = {}
    for photo in photos:
        members.setdefault(_zoom(job.shared_focal, photo.path or Path()), []).append(plain(photo.name))
    shared = [
        f"  {zoom}: {listed(names, _NAMED)}" for zoom, names in members.items() if zoom and len(names) > 1
    ]
    return (
        ["Photos that would share a focal length:", *shared] if shared else ["No two photos share a zoom."]
    )


def _zoom(how: str, photo: Path) -> str:
    """What names the zoom of a photo; empty if it has a focal length of its own."""
    from ..io.photo import read_focal

    if how == "folder":
        return plain(str(photo.parent))
    try:
        focal = read_focal(photo)
    except (OSError, ValueError):  # said above
        return ""
    return "" if focal is None else f"{focal:g} mm in EXIF data"


def _focal_lengths(job: "ImageJob", photos: Sequence[Path]) -> Callable[[Path], str]:
    """What is known of a photo's focal length before it is looked at, by the source that is given."""
    from ..io.focal_table import read_focal_table
    from ..io.photo import read_focal
    from ..io.text_table import plain_number
    from .focal_sources import MEASURED

    if job.board is not None or job.focal in MEASURED:
        seen = {"plane": "grid", "pitch": "pitch"}.get(job.focal or "", "board")
        return lambda photo: f"f from the {seen} in it"
    if job.focal is None or job.focal == "exif":
        none = "no f in EXIF data" + (", f from a grid in it" if job.focal is None else "")
        return lambda photo: none if (focal := read_focal(photo)) is None else f"{focal:g} mm"
    if job.focal == "same":
        return lambda photo: "f not known"
    if (number := plain_number(job.focal)) is not None:
        return lambda photo: f"{number:g} {job.focal_unit}"
    table, name = read_focal_table(job.focal), plain(Path(job.focal).name)
    known = table.of([str(photo) for photo in photos])
    return lambda photo: (
        f"{known[str(photo)]:g} {job.focal_unit}"
        if str(photo) in known
        else f"not used, as {name} has no row for it"
    )


def files_plan(files: Sequence[str], earlier: int) -> str:
    """Which files would be written, each in a line of text, and how many are there from an earlier run."""
    more = [f"  and {len(files) - _LISTED} more"] if len(files) > _LISTED else []
    before = f", {earlier} are there" if earlier else ""
    head = f"{len(files)} file{'s' * (len(files) != 1)} would be written{before}. Nothing was written."
    return "\n".join([head, *files[:_LISTED], *more])


def tell_plan(told: Sequence[str], output: Path, *, as_json: bool) -> None:
    """Print a plan, as text or for scripts."""
    if as_json:
        print(json.dumps({"plan": [line.strip() for line in told], "output": str(output)}, indent=2))
        return
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
