"""Sources of images: photos, folders and patterns of names, and the frames of a video."""

import dataclasses
import glob
import hashlib
import os
import warnings
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from .._core.checks import check_above, checked_integer
from .._core.text import listed, plain
from ..io.focal_track import FocalTrack
from ..io.photo import SUFFIXES, metadata_focal, open_photo, read_photo
from ..io.raw import RAW_SUFFIXES

VIDEO_SUFFIXES = (
    *(".mp4", ".mov", ".mkv", ".avi", ".m4v", ".webm", ".mts", ".m2ts", ".mpg", ".mpeg", ".mxf", ".ts"),
    *(".3gp", ".flv", ".wmv", ".vob", ".ogv"),
)
"""Of files that count as videos."""

_NOT_READ = (".gif", ".jp2", ".j2k", ".jxl", ".psd", ".exr", ".hdr", ".tga")
"""Of pictures in formats that are not read."""

RESULTS = ("lines", "model.png", "before-after.jpg", "motion.png", "panorama.jpg")
"""What a calibration puts into its folder that might be taken for photographs."""

MARKS = ("lens.json", ".zoomjax.json")
"""What such a folder has: where photos determine no lens, the list of what was written alone."""


@dataclasses.dataclass(frozen=True)
class Source:
    """One image, not yet read if it is a file.

    Attributes:
        name: what it is called in reports: a file name, with folders where two files share one.
        path: the file, or None for a frame of a video.
        image: the frame's pixels, or None.
        focal: the focal length that a video's track gives.
        bend: how bent the image is, as `Edges.bend`, where other photos have shown it.
    """

    name: str
    path: Path | None = None
    image: UInt8[np.ndarray, "height width *channels"] | None = None
    focal: float | None = None
    bend: tuple[float, float, float, float] | None = None

    def __post_init__(self):
        """Check that there is one of both."""
        if (self.path is None) == (self.image is None):
            raise ValueError("Either argument path or image must be given, the file or its pixels.")
        if self.image is not None and not isinstance(self.image, np.ndarray):
            raise ValueError(f"Argument image must be an array, but it is {type(self.image).__name__}.")
        if self.focal is not None:
            check_above(0, focal=self.focal)

    @property
    def file(self) -> str:
        """The path, or the name of what has none."""
        return self.name if self.path is None else str(self.path)

    def digest(self) -> bytes:
        """Of what the image is made from, to tell it from others.

        Raises:
            OSError, ValueError: it cannot be read, as `open_photo` says.
        """
        if self.path is not None:
            with open_photo(self.path) as file:
                return hashlib.file_digest(file, "sha256").digest()
        image = np.ascontiguousarray(self.image)
        return hashlib.sha256(f"{image.shape} {image.dtype}".encode() + image.tobytes()).digest()

    def read(self) -> tuple[UInt8[np.ndarray, "height width *channels"], float | None]:
        """The pixels as stored, whatever the orientation tag says, in bytes; the focal length in EXIF data.

        Raises:
            OSError, ValueError: it cannot be read, as `read_photo` says.
        """
        if self.image is not None:
            return self.image, None
        assert self.path is not None
        image, metadata = read_photo(self.path)
        return as_bytes(image), metadata_focal(metadata)


def as_bytes(image: np.ndarray) -> UInt8[np.ndarray, "height width *channels"]:
    """An image of any depth and number of channels as grey or blue, green, red bytes.

    Other depths are scaled so that all but the brightest thousandth of the values fit in: 16-bit files
    often hold 12 bits, and a hot pixel. Alpha is dropped.
    """
    if image.ndim == 3:
        image = image[..., 0] if image.shape[2] < 3 else image[..., :3]
    if image.dtype != np.uint8:
        known = np.nan_to_num(image.astype(np.float32), posinf=0, neginf=0)
        brightest = float(np.quantile(known, 0.999, method="higher")) if known.size else 0.0
        image = np.clip(known * (255 / max(brightest, 1e-30)), 0, 255).astype(np.uint8)
    return np.ascontiguousarray(image)


def find_photos(inputs: Iterable[str | os.PathLike[str]]) -> list[Source]:
    """Find photos in files, folders (also nested ones) and patterns like ``shots/*.jpg``.

    Other files in a folder, and the results of a calibration, are ignored; of a pattern, only photos and
    folders are used.

    Raises:
        FileNotFoundError: an input does not exist, or no file fits a pattern.
        ValueError: an input is not a photo, or a folder has none.

    Warns:
        UserWarning: a photo is given twice, perhaps through a link; it is used once. A folder has videos,
            or pictures in formats that are not read; they are left out.
    """
    paths: list[Path] = []
    folders: list[Path] = []
    for given in inputs:
        paths += _expanded(os.fspath(given))
        folders += [Path(given)] * Path(given).is_dir()
    (paths, again), (folders, _) = once(paths), once(folders)
    for note in (*([twice(again)] if again else []), *filter(None, map(left_out, folders))):
        warnings.warn(note, stacklevel=2)
    return [Source(name, path) for name, path in zip(_names(paths), paths, strict=True)]


def once(paths: Sequence[Path]) -> tuple[list[Path], dict[Path, Path]]:
    """Each file once, and for those that are left out the file that they are or lead to."""
    first: dict[Path, Path] = {}
    real = {path: Path(os.path.realpath(path)) for path in paths}
    again = {path: same for path in paths if (same := first.setdefault(real[path], path)) is not path}
    return list(first.values()), again


def twice(again: dict[Path, Path]) -> str:
    """A sentence about files that were given twice."""
    path, same = next(iter(again.items()))
    what = "is given twice" if path == same else f"is the same file as {same}"
    more = f", and {len(again) - 1} more are like it" if len(again) > 1 else ""
    return f"{path} {what}{more}: it is used once."


def left_out(folder: Path, used: Sequence[str] = SUFFIXES) -> str:
    """Sentences about videos and pictures in a folder with other suffixes, developed RAW files, links to
    nowhere and to other folders, and folders that cannot be read.

    Empty if there are none.
    """
    suffixes = {*VIDEO_SUFFIXES, *SUFFIXES, *_NOT_READ}.difference(used)
    told, others = [], files_within(folder, sorted(suffixes))
    if others:
        videos = any(path.suffix.lower() in VIDEO_SUFFIXES for path in others)
        told.append(_left_out(folder, others, ".") + " Give videos by name." * videos)
    if raws := _developed(_all_within(folder, used)):
        told.append(_left_out(folder, sorted(raws), ", as a photo of that name counts for each."))
    if dead := [path for path in _shown(folder) if path.suffix.lower() in used and _is_nothing(path)]:
        told.append(_left_out(folder, dead, ", as links to nowhere, or no files."))
    if linked := [path for path in _shown(folder) if path.is_symlink() and _holds_more(path, folder, used)]:
        told.append(_left_out(folder, linked, ", as links to other folders. Give these, too."))
    if closed := [path for path in _shown(folder) if path.is_dir() and not _is_open(path)]:
        told.append(_left_out(folder, closed, ": what is in there cannot be read.", "folder"))
    return " ".join(told)


def _shown(folder: Path) -> list[Path]:
    """All that is in a folder and those within it, and not hidden."""
    found = sorted(folder.rglob("*"))
    return [path for path in found if not any(of.startswith(".") for of in path.relative_to(folder).parts)]


def _is_nothing(path: Path) -> bool:
    return not (path.is_file() or path.is_dir())


def _holds_more(link: Path, folder: Path, used: Sequence[str]) -> bool:
    """Whether a link leads to a folder of photos, or videos, that is not in this one, nor around it."""
    there, here = Path(os.path.realpath(link)), Path(os.path.realpath(folder))
    apart = there.is_dir() and not (there.is_relative_to(here) or here.is_relative_to(there))
    return apart and _is_open(there) and bool(files_within(there, used))


def _is_open(folder: Path) -> bool:
    """Whether what is in a folder can be listed."""
    try:
        with os.scandir(folder):
            return True
    except OSError:
        return False


def _left_out(folder: Path, files: Sequence[Path], why: str, kind: str = "file") -> str:
    names = listed((plain(str(path.relative_to(folder))) for path in files), 3)
    number = f"one {kind} is" if len(files) == 1 else f"{len(files)} {kind}s are"
    return f"In the folder {plain(str(folder))}, {number} left out: {names}{why}"


def _expanded(given: str) -> list[Path]:
    path = Path(given)
    named = path.suffix.lower() in SUFFIXES  # a folder or a dead link may be, too: reported when it is read
    if path.is_dir() and not (named and not files_within(path, SUFFIXES)):
        return _photos_within(path)
    if os.path.lexists(path):
        if path.suffix.lower() not in SUFFIXES:
            raise ValueError(f"{path} is not a photo: the file name must end in {', '.join(SUFFIXES)}.")
        return [path]
    found = [Path(name) for name in sorted(glob.glob(given, recursive=True))]
    photos = [p for p in found if p.suffix.lower() in SUFFIXES and p.is_file()]
    photos = photos or [inner for p in found if p.is_dir() for inner in _photos_within(p)]
    if not photos:
        what = "no photograph fits the pattern" if glob.has_magic(given) else "there is no file or folder"
        raise FileNotFoundError(f"Cannot find photographs: {what} {given}.")
    return photos


def _photos_within(folder: Path) -> list[Path]:
    found = files_within(folder, SUFFIXES)
    if not found:
        raise ValueError(f"There are no photographs in the folder {folder} ({', '.join(SUFFIXES)}).")
    return found


def files_within(folder: Path, suffixes: Sequence[str]) -> list[Path]:
    """Files with these suffixes in a folder and those within it, hidden ones and results left out.

    Of a RAW file beside a photo of the same name, the photo is meant: it was developed from it.
    """
    found = _all_within(folder, suffixes)
    developed = _developed(found)
    return [path for path in found if path not in developed]


def _all_within(folder: Path, suffixes: Sequence[str]) -> list[Path]:
    """As `files_within`, with RAW files that were developed.

    Raises:
        OSError: the folder itself cannot be read.
    """
    with os.scandir(folder):  # which patterns of names pass over
        pass
    results = {mark.with_name(name) for of in MARKS for mark in folder.rglob(of) for name in RESULTS}
    return sorted(
        path
        for path in folder.rglob("*")
        if path.suffix.lower() in suffixes
        and path.is_file()
        and not any(part.startswith(".") for part in path.relative_to(folder).parts)
        and not results.intersection((path, *path.parents))
    )


def _developed(found: Sequence[Path]) -> set[Path]:
    """RAW files beside a photo of the same name."""
    photos = {path.with_suffix("") for path in found if path.suffix.lower() not in RAW_SUFFIXES}
    raws = (path for path in found if path.suffix.lower() in RAW_SUFFIXES)
    return {path for path in raws if path.with_suffix("") in photos}


def _names(paths: list[Path]) -> list[str]:
    """File names, with as many folders as tell them all apart."""
    parts, depth = [path.absolute().parts for path in paths], 1
    while len({part[-depth:] for part in parts}) < len(parts):
        depth += 1
    return ["/".join(part[-depth:]) for part in parts]


def video_frames(
    path: str | os.PathLike[str], focal: FocalTrack | float | int, number: int
) -> Iterator[Source]:
    """Frames of a video, evenly spread over it, each with its focal length.

    Args:
        path: the video.
        focal: a track, or one focal length for all.
        number: how many frames, at most.

    Raises:
        FileNotFoundError: there is no such video.
        ValueError: it cannot be read, the track does not reach over it, or `number` or a focal length is
            not positive.

    Warns:
        UserWarning: the video ends early, being cut off or damaged; the frames before that are used. Frames
            on the way are damaged. Or the track goes on after the video's end.
    """
    from ..io.video_reader import decode_video

    number = checked_integer("number", number, 1)
    if not isinstance(focal, FocalTrack):
        check_above(0, focal=focal)
    stem = Path(path).stem
    with decode_video(path) as (announced, frames):
        # From the first to the last; where not even the length is known, the first ones.
        there = announced or number
        wanted = set(np.linspace(0, there - 1, min(number, there)).round().astype(int).tolist())
        last, time, some, decoded = -1, 0.0, False, 0
        for last, time, image in frames:
            decoded += 1
            if last not in wanted:
                continue
            at = focal.at(last, time) if isinstance(focal, FocalTrack) else float(focal)
            some = True
            yield Source(f"{stem}-{last:06d}.jpg", None, image(), at)
        if last < 0:
            raise ValueError(f"Cannot read {os.fspath(path)}: none of its frames can be decoded.")
        if not some:
            raise ValueError(
                f"Cannot read {os.fspath(path)}: of {announced} frames none of the {len(wanted)} wanted "
                "can be decoded. It is cut off or damaged."
            )
        if damaged := last + 1 - decoded:
            warnings.warn(
                f"{damaged} of {last + 1} frames of {os.fspath(path)} cannot be decoded, as their data are "
                "damaged. The others are used.",
                stacklevel=2,
            )
        if last + 1 < 0.98 * announced - 2:  # lengths are rounded
            warnings.warn(
                f"{os.fspath(path)} ends early, after {last + 1} of {announced} frames: it is cut off or "
                "damaged. The frames before that are used.",
                stacklevel=2,
            )
        elif isinstance(focal, FocalTrack):
            focal.warn_if_longer(last, time)


def shrunk(image: np.ndarray, longest: int) -> tuple[np.ndarray, float]:
    """The image, made smaller if a side is longer than so many px, and the scale."""
    scale = min(1.0, longest / max(image.shape[:2]))
    if scale == 1:
        return image, scale
    return cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), scale
