"""Files in, corrected files out: what ``zoomjax undistort`` does, checked before any work."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

from ..framing import frame_output
from ..io.focal_table import read_focal_table
from ..io.focal_track import read_focal_track
from ..lens import ZoomLens, load_lens
from .photos import SUFFIXES, photo_focal, undistort_photo
from .undistort import check_sampling


@dataclasses.dataclass(frozen=True)
class Job:
    """What to correct.

    Attributes:
        lens: file of the lens.
        inputs: photos, or one video.
        output: file for one input, else a folder.
        focal: a number, a CSV file, or None for the photos' own.
        keep, interpolation, border: as for `undistort_image`; one framing for all photos.
        hold: whether a track's ends hold.
    """

    lens: Path
    inputs: tuple[Path, ...]
    output: Path
    focal: str | None = None
    keep: str = "same"
    interpolation: str = "linear"
    border: str = "constant"
    hold: bool = False


def undistort_files(job: Job, progress: Callable[[int, int], None] = lambda done, total: None) -> str:
    """Do it, and say in a sentence what was done.

    Raises:
        OSError, ValueError: as `undistort_photo` and `undistort_video` do. Photos before the one with the
            error have been written, each whole.
    """
    check_sampling(job.interpolation, job.border)
    lens = load_lens(job.lens)
    photos = [path for path in job.inputs if path.suffix.lower() in SUFFIXES]
    if photos and len(photos) < len(job.inputs):
        raise ValueError("Give photos or a video, not both.")
    if photos:
        return _photos(job, lens, progress)
    if len(job.inputs) > 1:
        raise ValueError(f"Give one video at a time; there are {len(job.inputs)}.")
    return _video(job, lens, progress)


def _video(job: Job, lens: ZoomLens, progress: Callable[[int, int], None]) -> str:
    from .video import undistort_video  # PyAV is of the extra "app"

    if job.focal is None:
        raise ValueError(
            "A video needs --focal: one focal length, or a CSV file with time,focal or frame,focal."
        )
    number = _number(job.focal)
    focal = read_focal_track(job.focal, hold=job.hold) if number is None else number
    target = job.output / job.inputs[0].name if job.output.is_dir() else job.output
    if target.resolve() == job.inputs[0].resolve():
        raise ValueError(f"The output {target} is the input. Choose another file.")
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
    return f"{done.frames} frames corrected, scale {done.scale:.4f}: {target}"


def _photos(job: Job, lens: ZoomLens, progress: Callable[[int, int], None]) -> str:
    single = len(job.inputs) == 1 and job.output.suffix.lower() in SUFFIXES
    folder = job.output.parent if single else job.output
    targets = [job.output] if single else [folder / path.name for path in job.inputs]
    for source, target in zip(job.inputs, targets, strict=True):
        if source.resolve() == target.resolve():
            raise ValueError(f"The output {target} is the input. Choose another folder.")
    if len(set(targets)) < len(targets):
        raise ValueError("Two photos have the same name, and would be written to one file.")
    focals = [_photo_focal(job, lens, path) for path in job.inputs]
    folder.mkdir(parents=True, exist_ok=True)
    keep = job.keep
    if keep != "same" and len(set(focals)) > 1:
        low, high = min(focals), max(focals)
        spread = [1 / (1 / low + (1 / high - 1 / low) * i / 64) for i in range(65)]
        keep = frame_output([lens(f) for f in spread], lens.image_size, keep=keep)
    for number, (source, target, focal) in enumerate(
        zip(job.inputs, targets, focals, strict=True), start=1
    ):
        undistort_photo(source, target, lens=lens, focal=focal, keep=keep, interpolation=job.interpolation)
        progress(number, len(targets))
    return f"{len(targets)} photo{'s' * (len(targets) > 1)} corrected: {job.output}"


def _photo_focal(job: Job, lens: ZoomLens, path: Path) -> float:
    if job.focal is None:
        return photo_focal(path, lens)
    number = _number(job.focal)
    if number is not None:
        return number
    return read_focal_table(job.focal).need(path)


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
