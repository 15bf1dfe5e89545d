"""What ``zoomjax undistort`` is given: files, folders and patterns of names, and where each result goes."""

import contextlib
import dataclasses
import glob
import mimetypes
import os
import unicodedata
from collections.abc import Mapping, Sequence
from pathlib import Path

from ..detect.sources import VIDEO_SUFFIXES, files_within, left_out, once, twice
from ..io.headers import announced_format, unknown
from ..io.heic import HEIC_SUFFIXES
from ..io.photo import FORMATS, SUFFIXES, open_photo
from ..io.raw import RAW_SUFFIXES
from ..io.text_table import plain_number

_TARGETS = {
    **dict.fromkeys(HEIC_SUFFIXES, ".png"),
    **dict.fromkeys(RAW_SUFFIXES, ".tif"),
    **dict.fromkeys((".mts", ".m2ts", ".mpg", ".mpeg"), ".ts"),
    **dict.fromkeys((".flv", ".wmv", ".vob", ".ogv"), ".mkv"),
    ".3gp": ".mp4",
}
"""Suffixes of the results of files whose format can only be read."""

_OF_CALIBRATION = ("exif", "board", "plane", "pitch", "same", "motion")
"""Sources of focal lengths that ``zoomjax calibrate`` knows by name, and a correction does not."""


@dataclasses.dataclass(frozen=True)
class Found:
    """What the inputs lead to.

    Attributes:
        photos, videos: the files, and for each the name of its result within the output folder.
        refused: for each input that is neither, the reason.
        notes: sentences about what was left out.
    """

    photos: tuple[tuple[Path, Path], ...]
    videos: tuple[tuple[Path, Path], ...]
    refused: dict[Path, str]
    notes: tuple[str, ...]


def find_inputs(inputs: Sequence[Path], output: Path) -> Found:
    """Find photos and videos in files, folders (also nested ones) and patterns.

    A folder stands for its photos, or for its videos if it has none; what else it has of them is said.
    Folders within it are kept in the names of the results, and what lies in `output` is left out.

    Raises:
        FileNotFoundError: no file fits a pattern, or there is no file or folder of a name.
        ValueError: a folder has neither photos nor videos.
    """
    given = [pair for path in inputs for pair in _expanded(path, output)]
    files, again = once([path for path, _ in given])
    names = dict(reversed(given))
    refused = {path: why for path in files if (why := _why_not(path))}
    photos = [path for path in files if path not in refused and path.suffix.lower() in SUFFIXES]
    videos = [path for path in files if path not in refused and path.suffix.lower() not in SUFFIXES]
    named = _distinct([(path, names[path]) for path in [*photos, *videos]])
    notes = [twice(again)] if again else []
    used = SUFFIXES if photos else VIDEO_SUFFIXES
    folders, _ = once([path for path in inputs if path.is_dir()])
    notes += filter(None, (left_out(folder, used) for folder in folders))
    return Found(named[: len(photos)], named[len(photos) :], refused, tuple(notes))


def _expanded(given: Path, output: Path) -> list[tuple[Path, Path]]:
    """Files, each with its name below the folder or the fixed part of the pattern."""
    named = given.suffix.lower() in (*SUFFIXES, *VIDEO_SUFFIXES)
    if given.is_dir() and not (named and not any(given.iterdir())):  # which is reported with the others
        return [(path, path.relative_to(given)) for path in _within(given, output)]
    if not os.path.lexists(given) and not named and not glob.has_magic(str(given)):
        raise FileNotFoundError(f"There is no file or folder {given}.")
    if os.path.lexists(given) or not glob.has_magic(str(given)):
        return [(given, Path(given.name))]
    found = [Path(name) for name in sorted(glob.glob(str(given), recursive=True))]
    files = [
        path for path in found if path.is_file() and path.suffix.lower() in (*SUFFIXES, *VIDEO_SUFFIXES)
    ]
    files = files or [inner for path in found if path.is_dir() for inner in _within(path, output)]
    if not files:
        raise FileNotFoundError(f"No photo or video fits the pattern {given}.")
    fixed = Path(*_until_magic(given.parts))
    return [(path, _without_dots(path.relative_to(fixed))) for path in files]


def _without_dots(name: Path) -> Path:
    """A name that leads nowhere else: ``a/../../b/x`` is ``b/x``."""
    return Path(*(part for part in Path(os.path.normpath(name)).parts if part != ".."))


def _until_magic(parts: Sequence[str]) -> list[str]:
    first = next(index for index, part in enumerate(parts) if glob.has_magic(part))
    return list(parts[:first])


def _within(folder: Path, output: Path) -> list[Path]:
    mine, own = output.resolve(), 0
    for suffixes in (SUFFIXES, VIDEO_SUFFIXES):
        found = files_within(folder, suffixes)
        if outside := [path for path in found if mine not in path.resolve().parents]:
            return outside
        own += len(found)
    if own:
        raise ValueError(
            f"All photos and videos of {folder} are in the output folder {output}, which is left out: "
            "give another folder with --output."
        )
    raise ValueError(f"There are no photos and no videos in the folder {folder}.")


def _why_not(path: Path) -> str | None:
    """Why a file is neither a photo nor a video, by its name and beginning; None if it may be."""
    if path.suffix.lower() in (*SUFFIXES, *VIDEO_SUFFIXES):
        return None
    begins = b""
    with contextlib.suppress(OSError, ValueError), open_photo(path) as file:
        begins = file.read(64)
    with contextlib.suppress(ValueError):
        kind = announced_format(begins)
        return f"it is a {kind} photo whose name does not say so: give it the suffix of one"
    if (why := unknown(begins)).startswith("it is a") and "video" not in why:
        return why
    if path.suffix.lower() == ".json":
        return "it is not a photo or video: a lens of your own comes first, without argument lens"
    kind = mimetypes.guess_type(path.name)[0] or ""
    if kind.startswith(("image/", "text/", "audio/")):
        return f"it is not a photo: names of photos end in {', '.join(SUFFIXES)}"
    return None


def _distinct(named: Sequence[tuple[Path, Path]]) -> tuple[tuple[Path, Path], ...]:
    """Names of the results, with folders up to the one that all files share where two names are the same.

    Of two that differ in their suffixes alone, and become one format, the one whose suffix changes keeps it
    as well: ``a.heic.png`` beside ``a.png``.

    Raises:
        ValueError: they are the same even so.
    """
    kept = {_folded(name) for _, name in named if _target(name) == name}
    named = [(path, _beside(name) if _folded(_target(name)) in kept else name) for path, name in named]
    targets = [(path, _target(name)) for path, name in named]
    if len({_folded(name) for _, name in targets}) < len(targets):
        absolute = [Path(os.path.normpath(path.absolute())) for path, _ in named]
        shared = os.path.commonpath([path.parent for path in absolute])
        targets = [
            (path, _target(whole.relative_to(shared)))
            for (path, _), whole in zip(named, absolute, strict=True)
        ]
    first: dict[str, Path] = {}
    for path, name in targets:
        if (other := first.setdefault(_folded(name), path)) is not path:
            raise ValueError(
                f"{other} and {path} have the same name, {name}, and would be written to the same file."
            )
    return tuple(targets)


def _target(name: Path) -> Path:
    return name.with_suffix(_TARGETS[name.suffix.lower()]) if name.suffix.lower() in _TARGETS else name


def _beside(name: Path) -> Path:
    """The name of a result beside that of another file: all of its own, and the new suffix."""
    target = _target(name)
    return name if target == name else name.with_name(name.name + target.suffix)


def _folded(name: Path) -> str:
    """Many file systems ignore case, and treat different encodings of an accent alike."""
    return unicodedata.normalize("NFC", str(name)).casefold()


def targets_of(found: Sequence[tuple[Path, Path]], output: Path, inputs: Sequence[Path]) -> list[Path]:
    """Where each result goes: into the folder `output`, or for a single input to the file of that name.

    Raises:
        ValueError: a file is given for several results, its suffix is unknown, or it is another file.
    """
    is_photo = found[0][0].suffix.lower() in SUFFIXES
    known = tuple(FORMATS) if is_photo else VIDEO_SUFFIXES
    single = len(found) == 1 and not any(path.is_dir() for path in inputs)
    if output.is_dir() or (output.suffix.lower() not in known and not _is_media(output)):
        if output.is_file():
            raise ValueError(f"The output must be a folder, a photo or a video, but {output} is a file.")
        return [output / name for _, name in found]
    if not single:
        raise ValueError(
            f"The output of {len(found)} {'photos' if is_photo else 'videos'} must be a folder, but it is "
            f"the file {output}."
        )
    if is_photo and output.suffix.lower() not in FORMATS:
        raise ValueError(f"The output must end in one of {', '.join(FORMATS)}, but it is {output}.")
    return [output]


def told_of_earlier(
    skipped: Mapping[str, str], sources: Sequence[Path], targets: Sequence[Path]
) -> dict[str, str]:
    """Why files are skipped, by path, and where a result of an earlier run is in the place of theirs."""
    there = {str(source): path for source, path in zip(sources, targets, strict=True) if path.exists()}
    return {
        source: f"{why.rstrip('.')}. What is in {there[source]} is of an earlier run."
        if source in there
        else why
        for source, why in skipped.items()
    }


def _is_media(path: Path) -> bool:
    kind = mimetypes.guess_type(path.name)[0] or ""
    return kind.startswith(("image/", "video/")) or path.suffix.lower() in (*SUFFIXES, *VIDEO_SUFFIXES)


def focal_number(text: str) -> float | None:
    """The focal length, or None if the text names a file or folder.

    Raises:
        ValueError: it is neither.
    """
    number = plain_number(text)
    there = text.strip() and Path(text).exists()  # an empty path is the present folder
    if text in _OF_CALIBRATION and not there:
        raise ValueError(
            f"Argument focal must be a positive number or a CSV file, but it is {text!r}, by which a "
            "calibration finds focal lengths. Leave it out for those in the EXIF data of photos, and for a "
            "lens of one zoom whose focal length is not known."
        )
    if number is None and not there and not text.lower().endswith(".csv"):
        raise ValueError(
            "Argument focal must be a positive number, with a decimal point, or a CSV file, "
            f"but it is {text!r}."
        )
    if number is not None and number <= 0:
        raise ValueError(f"Argument focal must be a positive number, but it is {text}.")
    return number
