"""Correction of files: what ``zoomjax undistort`` does. Arguments are checked before any work."""

import dataclasses
import functools
import mimetypes
import unicodedata
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from .._core.files import refuse_existing, refuse_inputs, whole_file
from ..correct.framing import Framing, check_keep, frame_output
from ..correct.image import check_sampling
from ..correct.photo import corrected_photo, photo_focal
from ..io.focal_table import read_focal_table
from ..io.focal_track import read_focal_track
from ..io.photo import FORMATS, SUFFIXES
from ..io.text_table import plain_number
from ..models.lens import ZoomLens, load_lens
from ..models.sizes import at_focal, lens_for_size


@dataclasses.dataclass(frozen=True)
class Job:
    """Settings of a correction.

    Attributes:
        lens: the lens, or its file.
        inputs: photos, or one video.
        output: file for a single input, else a folder.
        focal: a number, a CSV file, or None for the photos' EXIF data.
        keep, interpolation, border: as for `undistort_image`; one framing for all photos.
        hold: whether a track's first and last focal lengths are used beyond its ends.
        overwrite: whether existing files may be replaced; inputs never are.
    """

    lens: Path | ZoomLens
    inputs: tuple[Path, ...]
    output: Path
    focal: str | None = None
    keep: str = "same"
    interpolation: str = "linear"
    border: str = "constant"
    hold: bool = False
    overwrite: bool = False


@dataclasses.dataclass(frozen=True)
class Outcome:
    """The result of a correction.

    Attributes:
        sentence: a sentence on what was written.
        skipped: for each photo that was not corrected, by path, the reason.
    """

    sentence: str
    skipped: dict[str, str] = dataclasses.field(default_factory=dict)


def undistort_files(job: Job, progress: Callable[[int, int], None] = lambda done, total: None) -> Outcome:
    """Correct photos or a video. Of several photos, those that cannot be corrected are skipped.

    Raises:
        OSError, ValueError: the options, the lens, the table of focal lengths or the targets are wrong,
            checked before any work; or the errors of `undistort_video`, or of `undistort_photo` for a
            single photo. If a target cannot be written, the files before it are complete.
    """
    check_sampling(job.interpolation, job.border)
    check_keep(job.keep)
    lens = job.lens if isinstance(job.lens, ZoomLens) else load_lens(job.lens)
    photos = [path for path in job.inputs if path.suffix.lower() in SUFFIXES]
    if photos and len(photos) < len(job.inputs):
        raise ValueError("Give photos or a video, not both.")
    if photos:
        return _photos(job, lens, progress)
    if len(job.inputs) > 1:
        raise ValueError(f"Give one video at a time; there are {len(job.inputs)}.")
    return _video(job, lens, progress)


def _video(job: Job, lens: ZoomLens, progress: Callable[[int, int], None]) -> Outcome:
    from ..correct.video import undistort_video

    if job.focal is None:
        raise ValueError(
            "A video needs argument focal: one focal length, or a CSV file with time,focal or frame,focal."
        )
    number = _number(job.focal)
    if number is not None and job.hold:
        raise ValueError("Argument hold is for a track of focal lengths, and argument focal is one number.")
    focal = read_focal_track(job.focal, hold=job.hold) if number is None else number
    target = job.output / job.inputs[0].name if job.output.is_dir() else job.output
    _check_targets(job, [target])
    done = undistort_video(
        job.inputs[0],
        target,
        lens=lens,
        focal=focal,
        keep=job.keep,
        interpolation=job.interpolation,
        border=job.border,
        progress=progress,
    )
    return Outcome(f"{done.frames} frames corrected, scale {done.scale:.4f}: {target}")


def _photos(job: Job, lens: ZoomLens, progress: Callable[[int, int], None]) -> Outcome:
    if job.hold:
        raise ValueError(
            "Argument hold is for a video's track of focal lengths, and the inputs are photos."
        )
    targets = _photo_targets(job)
    _check_targets(job, targets)
    focal_of = _photo_focals(job, lens)
    skipped: dict[Path, Exception] = {}
    keep = _common_keep(job, lens, focal_of, skipped)
    for done, (source, target) in enumerate(zip(job.inputs, targets, strict=True), start=1):
        if source not in skipped:
            try:
                content = corrected_photo(
                    source,
                    target.suffix,
                    lens=lens,
                    focal=focal_of(source),
                    keep=keep,
                    interpolation=job.interpolation,
                    border=job.border,
                )
            except _BAD_PHOTO as error:
                skipped[source] = error
            else:
                target.parent.mkdir(parents=True, exist_ok=True)
                with whole_file(target) as part:
                    part.write_bytes(content)
        progress(done, len(targets))
    if len(job.inputs) == 1 and skipped:
        raise next(iter(skipped.values()))
    written, number = len(targets) - len(skipped), len(targets)
    count = f"{number} photo{'s' * (number > 1)}" if not skipped else f"{written} of {number} photos"
    return Outcome(f"{count} corrected: {job.output}", {str(p): str(e) for p, e in skipped.items()})


_BAD_PHOTO = (ValueError, OSError, MemoryError, cv2.error)
"""Errors of one photo that do not stop the others."""


def _photo_targets(job: Job) -> list[Path]:
    """The target of each photo."""
    folder = job.output.is_dir() or job.output.suffix.lower() not in FORMATS
    if not folder and len(job.inputs) > 1:
        raise ValueError(
            f"The output of {len(job.inputs)} photos must be a folder, but it is the file {job.output}."
        )
    if not folder:
        return [job.output]
    kind = mimetypes.guess_type(job.output.name)[0] or ""
    if not job.output.is_dir() and kind.startswith(("image/", "video/")):
        raise ValueError(f"The output must end in one of {', '.join(FORMATS)}, but it is {job.output}.")
    names: dict[str, Path] = {}
    for path in job.inputs:
        # Many file systems ignore case, and treat different encodings of an accent alike.
        other = names.setdefault(unicodedata.normalize("NFC", _target_name(path)).casefold(), path)
        if other is not path:
            raise ValueError(
                f"The photos {other} and {path} have the same name and would be written to the same file."
            )
    return [job.output / _target_name(path) for path in job.inputs]


def check_photo_targets(job: Job) -> None:
    """Refuse photos that would be written to one file, to an input, or in place of another file."""
    _check_targets(job, _photo_targets(job))


def _target_name(photo: Path) -> str:
    """The photo's name, with the suffix .png for formats that can only be read (HEIC)."""
    return photo.name if photo.suffix.lower() in FORMATS else f"{photo.stem}.png"


def _check_targets(job: Job, targets: Sequence[Path]) -> None:
    tables = [] if job.focal is None else [job.focal]
    lens = [job.lens] if isinstance(job.lens, Path) else []
    refuse_inputs(targets, [*job.inputs, *lens, *tables])
    refuse_existing(targets, overwrite=job.overwrite)


def _common_keep(
    job: Job, lens: ZoomLens, focal_of: Callable[[Path], float], skipped: dict[Path, Exception]
) -> Callable[[tuple[int, int]], str | Framing]:
    """The framing for each image size, common to all focal lengths of the photos.

    Photos without a focal length are added to `skipped`.
    """
    if job.keep == "same":
        return lambda size: job.keep
    focals = []
    for source in job.inputs:
        try:
            focals.append(focal_of(source))
        except _BAD_PHOTO as error:
            skipped[source] = error
    if not focals:
        return lambda size: job.keep
    low, high = min(focals), max(focals)
    dtype = np.asarray(lens.centre).dtype
    spread = (1 / np.linspace(1 / low, 1 / high, 65 if low < high else 1)).astype(dtype)

    @functools.cache
    def keep(size: tuple[int, int]) -> Framing:
        scaled = lens_for_size(lens, size)
        return frame_output([at_focal(scaled, f) for f in spread], size, keep=job.keep)

    return keep


def _photo_focals(job: Job, lens: ZoomLens) -> Callable[[Path], float]:
    """A function giving a photo's focal length: from the table, the number or its EXIF data."""
    if job.focal is None:
        return functools.cache(lambda path: photo_focal(path, lens))
    number = _number(job.focal)
    if number is not None:
        return lambda path: number
    return read_focal_table(job.focal).need


def _number(text: str) -> float | None:
    """The focal length, or None if the text names a file."""
    number = plain_number(text)
    if number is None and not Path(text).exists() and not text.lower().endswith(".csv"):
        raise ValueError(
            "Argument focal must be a positive number, with a decimal point, or a CSV file, "
            f"but it is {text!r}."
        )
    if number is not None and number <= 0:
        raise ValueError(f"Argument focal must be a positive number, but it is {text}.")
    return number
