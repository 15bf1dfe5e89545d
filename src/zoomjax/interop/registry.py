"""All formats, and writing and reading by their names."""

import dataclasses
import math
import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .._core.arguments import kinds_checked
from .._core.checks import checked_size
from .._core.files import refuse_existing, whole_file, whole_folder
from .._core.pixels import check_pitch
from ..io.focal_track import FocalTrack
from ..models.about import UNKNOWN
from ..models.distortion_model import AbstractDistortionModel
from ..models.lens import ZoomLens
from ..models.requirements import check
from ..models.zoom import AbstractLinearZoom
from ._lens import UnsuitedError, lens_of
from ._options import (
    check_model,
    check_name,
    check_options,
    check_order,
    focal_lengths,
    labelled,
    pitch_of,
    positive,
    positives,
    warn_of_relative,
)
from ._seen import check_near
from ._solve import Solution, error_written, solve
from .base import (
    CONVENTION,
    TOLERANCE,
    Export,
    FolderFormat,
    Format,
    Import,
    Node,
    NodeFormat,
    Report,
    off_middle,
    possible,
)
from .colmap import COLMAP
from .discorpy import Discorpy
from .gyroflow import Gyroflow
from .hugin import Hugin
from .kalibr import Kalibr
from .lcp import LCP
from .lensfun import Lensfun
from .mrcal import Mrcal
from .nerfstudio import Nerfstudio
from .nuke import Nuke
from .opencv import OpenCV
from .opentrackio import OpenTrackIO
from .pftrack import PFTrack
from .ros import ROS
from .stmap import STMap
from .unreal import Unreal

FORMATS: tuple[Format, ...] = (
    *(STMap(), Nuke(), OpenTrackIO(), PFTrack()),
    *(Lensfun(), Hugin(), Gyroflow(), Unreal()),
    *(OpenCV(), ROS(), Kalibr(), Mrcal(), COLMAP(), Nerfstudio(), Discorpy(), LCP()),
)
"""In the order of `formats` and of the documentation."""

_BIGGEST = 256 * 2**20
"""Bytes of a text file that is read."""


@dataclasses.dataclass(frozen=True)
class Reading:
    """A lens from another tool's file.

    Attributes:
        lens: the lens.
        report: the format, the focal lengths in the file, and how far the lens is from the file there.
    """

    lens: ZoomLens
    report: Report


def formats() -> tuple[Format, ...]:
    """The formats of other tools that zoomjax writes and reads.

    Example:
        >>> [format.name for format in formats() if format.exact][:1]
        ['stmap']
    """
    return FORMATS


@kinds_checked
def write(
    lens: ZoomLens,
    path: str | os.PathLike[str],
    *,
    format: str | None = None,
    focal: float | int | Sequence[float | int] | np.ndarray | None = None,
    track: FocalTrack | None = None,
    pixel_pitch: float | int | None = None,
    tolerance: float | int | None = None,
    convention: str | None = None,
    overwrite: bool = False,
) -> Report:
    """Write a lens in another tool's format.

    Args:
        lens: any lens that depends on the focal length alone.
        path: the file; for several focal lengths in a format of one a file, and for STMaps, a folder.
        format: name of the format, one of `formats`; by default that of the path's suffix, where only one
            has it.
        focal: focal lengths in the lens's unit, for entries in this order; formats that interpolate have
            them sorted, and choose them if it is left out.
        track: focal lengths by frame instead, one entry or file for each frame.
        pixel_pitch: mm from one pixel to the next: the sensor's width over that of the image in px; by
            default the lens's own. Formats with focal lengths in px need it for lenses in mm, those with a
            sensor's size always.
        tolerance: for formats that interpolate: focal lengths are added until the error between them is
            below this, px, or exceeds what the tool's formula leaves at each by no more, or more of them
            gain nothing; 0.1 by default.
        convention: for STMaps: "centres" (Nuke, the default), "gyroflow" or "alicevision".
        overwrite: whether files that exist may be replaced.

    Returns:
        How far what was written is from the lens.

    Warns:
        UserWarning: `pixel_pitch` contradicts the lens's own.

    Raises:
        OSError: the file cannot be written; nothing is left of it.
        ValueError: an argument is missing, wrong or without effect on the format, or the lens folds over
            within the image.

    Example:
        >>> import pathlib, tempfile, zoomjax as zj
        >>> folder = pathlib.Path(tempfile.mkdtemp())
        >>> lens = zj.scenes.nikkor_18_200()
        >>> report = write(lens, folder / "lens.xml", format="lensfun", pixel_pitch=0.0055)
        >>> zj.interop.read(folder / "lens.xml", image_size=lens.image_size).lens.focal_unit
        'mm'
    """
    path = Path(path)
    fmt = _format_to_write(format, path)
    check_options(fmt, {"tolerance": tolerance, "convention": convention})
    check("interop.write", zoom=lens.zoom)
    if lens.about.get("focal") == UNKNOWN:
        lens = labelled(lens, focal)
    warn_of_relative(lens)
    job = Export(
        lens,
        *focal_lengths(fmt, lens, focal, track),
        pixel_pitch=pitch_of(lens, pixel_pitch),
        tolerance=TOLERANCE if tolerance is None else positive("tolerance", tolerance),
        convention=convention or CONVENTION,
        suffix=path.suffix.lower(),
    )
    check_pitch(job.pixel_pitch, lens.image_size)
    several = isinstance(fmt, FolderFormat) or (fmt.zoom == "one" and len(job.focal or ()) > 1)
    check_name(fmt, path, several=several, known=_suffixes())
    files = tuple(path / name for name in fmt.file_names(job)) if several else (path,)
    refuse_existing(list(files), overwrite=overwrite)
    others = _others(path, files) if several else ()
    if isinstance(fmt, FolderFormat):
        with whole_folder(path) as part:
            worst, notes = fmt.write_all(job, part)
        return Report(fmt.name, job.focal or (), worst, None, (*notes, *others), files)
    assert isinstance(fmt, NodeFormat)
    found = solve(fmt, job)
    if several:
        with whole_folder(path) as part:
            parts = [part / file.name for file in files]
            written = _write_nodes(fmt, found.nodes, job, parts)
    else:
        with whole_file(path) as part:
            written = _write_nodes(fmt, found.nodes, job, [part])
    return Report(
        fmt.name,
        tuple(node.focal for node in found.nodes),
        max(found.at_nodes, written),
        found.between,
        (*fmt.notes(found.nodes, job), *_shortfall(fmt, found, job), *others),
        files,
    )


def _write_nodes(fmt: NodeFormat, nodes: list[Node], job: Export, files: list[Path]) -> float:
    """Write one file, or one for each node; return the greatest error of what they then hold, px."""
    for file, part in zip(files, [nodes] if len(files) == 1 else [[n] for n in nodes], strict=True):
        file.write_text(fmt.text(part, job), encoding="utf-8")
    return error_written(fmt, nodes, job, files)


@kinds_checked
def read(
    path: str | os.PathLike[str],
    *,
    format: str | None = None,
    image_size: tuple[int, int] | None = None,
    focal: float | int | Sequence[float | int] | np.ndarray | None = None,
    focal_unit: str | None = None,
    crop: float | int | None = None,
    name: str | None = None,
    direction: str | None = None,
    convention: str | None = None,
    zoom: AbstractLinearZoom | None = None,
    terms: int | None = None,
    distortion_model: AbstractDistortionModel | None = None,
) -> Reading:
    """Read a lens that another tool measured or wrote.

    Distortion that maps corrected to distorted points is fitted by ours, which maps the other way; focal
    lengths between those of the file are a zoom model's. The report says how far the lens is from the file.

    Args:
        path: the file; or a folder of files of one format, one a focal length.
        format: name of the format, one of `formats`; by default it is recognised.
        image_size: (width, height) px, for files that do not say it; it must not contradict those that do.
        focal: focal lengths of the files of a folder in the order of their names, numbers in them by value
            (9 before 18); or those of the entries of a file. By default those that are in them.
        focal_unit: unit of `focal`: "mm" or "px"; by default mm.
        crop: for lensfun: crop factor of the camera; by default that of the calibration.
        name: of the lens, for files of several; a part of it will do.
        direction: for STMaps: "undistort" or "redistort"; by default the file or its name says it.
        convention: for STMaps: "centres" (Nuke), "gyroflow" or "alicevision"; by default that which zoomjax
            wrote into the file, else "centres".
        zoom: the zoom model, linear in its parameters. By default `SmoothZoom`; `TableZoom` for tangential
            distortion and the division model, and to keep what the file says at its focal lengths.
        terms: number of radial coefficients; by default 2 for `SmoothZoom`, else those of a file with our
            own formula, or 4.
        distortion_model: `RadialPolynomial`, `Division` or `BrownConrady`. By default that
            which holds the file's coefficients, or is nearest to its maps.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is damaged, of no known format, or does not say what an argument must then say; or an
            argument is wrong, contradicts the file, or has no effect on the format.
    """
    size = None if image_size is None else checked_size(image_size)
    told = None if focal is None else positives("focal", focal)
    check_model(terms, distortion_model)
    path = Path(path)
    paths = _files(path)
    fmt = _format_to_read(format, paths[0])
    if focal_unit is not None and focal is None:
        raise ValueError("Argument focal_unit is that of argument focal, which is not given: leave it out.")
    given = {"focal": focal, "focal_unit": focal_unit, "crop": crop, "name": name}
    given |= {"direction": direction, "convention": convention}
    check_options(fmt, given)
    check_order(paths, told)
    job = Import(
        path,
        tuple(paths),
        size,
        told,
        focal_unit or "mm",
        None if crop is None else positive("crop", crop),
        name,
        direction,
        convention,
    )
    try:
        contents = fmt.read(job)
        if not contents.nodes:
            raise ValueError("it holds no distortion")
        for node in contents.nodes:
            if not (math.isfinite(node.focal) and node.focal > 0):
                raise ValueError(f"its focal length {node.focal} is not a positive number")
            if isinstance(node, Node) and not np.isfinite([*node.theta, *node.centre]).all():
                raise ValueError(f"its coefficients or centre at {node.focal:g} are not finite numbers")
        made = lens_of(possible(contents), zoom, terms, distortion_model)
        check_near(made.at_nodes, contents)
    except (FileNotFoundError, UnsuitedError):
        raise
    except _DAMAGED as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else str(error).rstrip(".")
        raise ValueError(f"Cannot read a {fmt.name} lens from {path}: {reason}.") from error
    notes = (*made.notes, *off_middle(contents.nodes, contents.image_size))
    report = Report(fmt.name, made.focal, made.at_nodes, made.between, notes, tuple(paths))
    return Reading(made.lens, report)


_DAMAGED = (
    *(ValueError, TypeError, KeyError, IndexError, AttributeError, ArithmeticError, RecursionError),
    *(OSError, SyntaxError, RuntimeError),
)
"""What reading a damaged file may raise; errors of XML are syntax errors."""


def named(name: str) -> Format:
    """The format of this name; ValueError if there is none."""
    for fmt in FORMATS:
        if fmt.name == name:
            return fmt
    raise ValueError(f"Argument format must be one of {_names(FORMATS)}, but it is {name!r}.")


def _suffixes() -> set[str]:
    return {suffix for fmt in FORMATS for suffix in fmt.suffixes}


def _names(formats: Iterable[Format]) -> str:
    return ", ".join(fmt.name for fmt in formats)


def _format_to_write(name: str | None, path: Path) -> Format:
    if name is not None:
        if not (fmt := named(name)).writes:
            raise ValueError(f"The format {name} can be read only.")
        return fmt
    found = [fmt for fmt in FORMATS if fmt.writes and fmt.suffixes[0] == path.suffix.lower()]
    if len(found) != 1:
        raise ValueError(
            f"Argument format must be given, one of {_names(found or FORMATS)}: the name {path.name} does "
            "not tell it."
        )
    return found[0]


def _format_to_read(name: str | None, path: Path) -> Format:
    if name is not None:
        return named(name)
    if path.stat().st_size > _BIGGEST:
        raise ValueError(f"{path} is larger than {_BIGGEST >> 20} MiB: no lens file is.")
    with open(path, "rb") as file:
        head = file.read(20000).decode("utf-8-sig", "replace")
    for fmt in FORMATS:
        if path.suffix.lower() in fmt.suffixes and fmt.recognises(head):
            return fmt
    raise ValueError(f"{path} is of no format that is known: {_names(FORMATS)} are.")


def _files(path: Path) -> list[Path]:
    """The file itself, or the files of a folder that have a suffix of some format."""
    if not path.is_dir():
        if not path.is_file():
            raise FileNotFoundError(2, "No such file", str(path))
        return [path]
    known = _suffixes()
    found = [file for file in path.iterdir() if file.is_file() and file.suffix.lower() in known]
    if len({file.suffix.lower() for file in found}) != 1:
        raise ValueError(
            f"The folder {path} must hold files of one format, but it holds "
            f"{', '.join(sorted({file.suffix for file in found})) or 'none'}: give one file."
        )
    return sorted(found, key=_by_value)


def _others(folder: Path, files: Iterable[Path]) -> tuple[str, ...]:
    """That a folder keeps files that look like those written, as those of an earlier and longer track."""
    if not folder.is_dir():
        return ()
    names, suffixes = {file.name for file in files}, {file.suffix.lower() for file in files}
    found = sorted(
        name for name in os.listdir(folder) if name not in names and Path(name).suffix.lower() in suffixes
    )
    if not found:
        return ()
    more = f" and {len(found) - 1} more" if len(found) > 1 else ""
    return (
        f"The folder {folder} holds other files of this kind, {found[0]}{more}, of an earlier export, say: "
        "remove them, or programs that read all of them take another lens there.",
    )


def _by_value(path: Path) -> list[Any]:
    """Words and numbers of a name in turn, so that 9 is before 18, and the frame -1 before 0."""
    parts = re.split(r"((?:(?<![^.])-)?\d+(?:\.\d+)?)", path.stem)
    return [float(part) if index % 2 else part for index, part in enumerate(parts)]


def _shortfall(fmt: Format, found: Solution, job: Export) -> tuple[str, ...]:
    """What is said where the tolerance is missed."""
    notes, floor = [], 0.0
    if found.at_nodes > job.tolerance:
        floor = found.at_nodes
        notes.append(
            f"The formula of {fmt.name} cannot follow this lens within {job.tolerance:g} px, however many "
            "focal lengths are written."
        )
    if (found.between or 0.0) > floor + job.tolerance:
        way = (
            f", and more than {len(found.nodes)} are not written."
            if job.focal is None
            else ": give more of them, or none to have them chosen."
        )
        notes.append(
            f"Between the focal lengths the error exceeds the tolerance of {job.tolerance:g} px{way}"
        )
    return tuple(notes)
