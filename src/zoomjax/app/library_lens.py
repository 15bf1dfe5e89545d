"""Lenses of the library on the command line: ``zoomjax lens``, and ``zoomjax undistort --lens``."""

import dataclasses
from collections.abc import Callable
from concurrent.futures import Executor
from pathlib import Path
from typing import NamedTuple

from .._core.files import refuse_existing, refuse_inputs
from .._core.text import plain
from ..correct.framing import check_keep
from ..correct.sampler import check_sampling
from ..interop.database import LensTable, find_lenses, one_named
from ..interop.library import library_lens, table_for
from ..interop.matching import match_lens
from ..io.equipment import read_equipment
from ..io.focal_table import read_focal_table
from ..io.photo import read_size
from ..models.lens import ZoomLens
from .results_folder import OF_A_LENS, results_folder
from .undistort_files import (
    Job,
    Outcome,
    photos_or_videos,
    to_do,
    undistort_photos,
    with_refused,
)
from .undistort_inputs import focal_number, targets_of

AUTO = "auto"

_FILE = "lens.json"
"""The lens in a folder."""

_MOST_SHOWN = 60
"""Lenses listed with their errors."""

_LONG = 6000
"""Longer side, px, of the images that a lens is made for where nothing else is said."""


@dataclasses.dataclass(frozen=True)
class Row:
    """A line of the table of ``zoomjax lens``.

    Attributes:
        name: of the lens.
        crop: crop factor of the sensor that it was calibrated on.
        focal: its focal lengths, mm.
        model: the zoom model that it becomes, or why it becomes none.
        error: greatest distance from the table, px; empty if there is no model.
    """

    name: str
    crop: str
    focal: str
    model: str
    error: str


def rows(search: str, size: tuple[int, int] | None = None) -> tuple[list[Row], int]:
    """The lenses that a search finds, each as it is loaded, and how many more there are.

    Raises:
        ImportError: lensfunpy is not installed.
        ValueError: none is found.
    """
    found = find_lenses(search) or one_named(search)  # which says that there is none
    return [_row(table, size) for table in found[:_MOST_SHOWN]], len(found) - _MOST_SHOWN


def _row(table: LensTable, size: tuple[int, int] | None) -> Row:
    low, high = table.focal_range
    focal = f"{low:g}" if low == high else f"{low:.4g}-{high:.4g}"
    try:
        lens = library_lens(table, image_size=size or _size_of(table))
    except ValueError:
        return Row(table.name, f"{table.crop_factor:g}", focal, "folds over", "")
    model = f"{type(lens.zoom).__name__}, {lens.zoom.parameters.size} numbers"
    return Row(table.name, f"{table.crop_factor:g}", focal, model, f"{lens.about['table_error_px']:.2f}")


def write_lens(
    name: str, output: Path, *, size: tuple[int, int] | None, crop: float | None, overwrite: bool
) -> ZoomLens:
    """Write a lens of the library to a file, or as ``lens.json`` into a folder of results.

    In a folder, what an earlier run wrote about its lens is removed.

    Raises:
        OSError: the file exists, or cannot be written.
        ValueError: no lens has this name, or several have; or as `library_lens`.
    """
    target = output if output.suffix.lower() == ".json" else output / _FILE
    refuse_existing([target], overwrite=overwrite)
    table = table_for(one_named(name), crop)
    lens = library_lens(table, image_size=size or _size_of(table), crop=crop)
    if target == output:
        target.parent.mkdir(parents=True, exist_ok=True)
        lens.save(target)
    else:
        with results_folder(output, [_FILE], clears=OF_A_LENS, overwrite=overwrite) as folder:
            lens.save(folder / _FILE)
    return lens


def _size_of(table: LensTable) -> tuple[int, int]:
    """Image size of the sensor that a lens was calibrated on."""
    return _LONG, round(_LONG / table.aspect_ratio)


def undistort_by_library(
    job: Job,
    name: str,
    progress: Callable[[int, int], None] = lambda done, total: None,
    executor: Executor | None = None,
) -> Outcome:
    """Correct photos by lenses of the library; `Job.lens` is None.

    Args:
        job: as for `undistort_files`.
        name: name of the lens, or "auto" for that of each photo's EXIF data.
        progress: called after each photo.
        executor: where photos are corrected, as for `undistort_files`.

    Raises:
        ValueError: as `undistort_files`; or no lens fits a single photo, or several do; or the inputs are
            videos; or the name is that of a file or folder.
    """
    if name != AUTO and (name.lower().endswith(".json") or Path(name).exists()):
        raise ValueError(
            f"--lens is for a lens of the library, by its name, but {name} names a file or folder: give it "
            "first, as in zoomjax undistort lens.json photo.jpg -o corrected."
        )
    check_sampling(job.interpolation, job.border)
    check_keep(job.keep)
    found = photos_or_videos(job)
    if found.videos:
        raise ValueError(
            "Lenses of the library are found for photos. For a video, write the lens to a file first, and "
            "give that file."
        )
    photos = [path for path, _ in found.photos]
    targets = targets_of(found.photos, job.output, job.inputs)
    refuse_inputs(targets, photos)  # of all groups: one's target may be an input of another
    if job.focal is not None and focal_number(job.focal) is None:
        read_focal_table(job.focal).of(map(str, photos))  # and one's row that of another
    if not job.resume:
        to_do(job, photos, targets)  # complains of targets that exist before any work
    groups, skipped = _by_lens(photos, None if name == AUTO else name)
    if not groups and len(photos) == 1:
        raise ValueError(skipped[str(photos[0])])
    sentences, notes, files, written, done = [], [], [], 0, len(skipped)
    for lens, paths in groups:
        own = [target for path, target in zip(photos, targets, strict=True) if path in paths]

        def count(number: int, _: int, before: int = done) -> None:
            progress(before + number, len(photos))

        try:
            outcome = undistort_photos(job, lens, paths, own, count, executor)
        except (ValueError, OSError) as error:  # of a group of one photo
            if len(paths) > 1 or len(photos) == 1:
                raise
            outcome = Outcome("", {str(paths[0]): str(error)})
        else:
            sentences.append(plain(f"{_taken(lens)}: {outcome.sentence}"))
        skipped |= outcome.skipped
        notes += outcome.notes
        files += outcome.files
        written, done = written + outcome.written, done + len(paths)
    outcome = Outcome("\n".join(sentences), skipped, written, tuple(notes), tuple(files))
    return with_refused(outcome, found, targets)


def _by_lens(photos: list[Path], name: str | None) -> tuple[list["_Group"], dict[str, str]]:
    """The photos of each lens, and why others have none."""
    groups: dict[tuple[str, float, tuple[int, int]], _Group] = {}
    skipped: dict[str, str] = {}
    for photo in photos:
        try:
            size = read_size(photo)
            found = match_lens(read_equipment(photo), size, lens=name)
            key = (found.table.name, found.crop, size)
            if key not in groups:
                groups[key] = _Group(library_lens(found.table, image_size=size, crop=found.crop), [])
        except (ValueError, OSError) as error:
            skipped[str(photo)] = str(error)
        else:
            groups[key].photos.append(photo)
    return list(groups.values()), skipped


class _Group(NamedTuple):
    """A lens, and the photos taken with it."""

    lens: ZoomLens
    photos: list[Path]


def _taken(lens: ZoomLens) -> str:
    """Which lens it is."""
    about = lens.about
    return (
        f"{about['lens']}, crop factor {about['crop_factor']:g}, within {about['table_error_px']:.2g} px "
        "of its table"
    )
