"""Correction of several videos one after the other, each with its own focal lengths."""

import contextlib
import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path

from ..correct.video import CorrectedVideo, redistort_video, undistort_video
from ..io.focal_track import FocalTrack, read_focal_track
from ..models.lens import ZoomLens
from .undistort_inputs import focal_number

Focal = float | FocalTrack


def tracks_of(focal: str | None, names: Mapping[Path, Path], *, hold: bool) -> dict[Path, Focal]:
    """The focal lengths of each video.

    Args:
        focal: a number, a CSV file for one video, or a folder of CSV files named as the videos are, with or
            without the folders of the names.
        names: for each video the name of its result within the output folder.
        hold: whether a track's first and last focal lengths are used beyond its ends.

    Raises:
        OSError, ValueError: a track is missing or wrong, or that of two videos; or the options do not fit
            each other.
    """
    videos = list(names)
    if focal is None:
        raise ValueError(
            "A video needs argument focal: one focal length, a CSV file with time,focal or frame,focal, or "
            "for several videos a folder of such files with their names."
        )
    number = focal_number(focal)
    if number is not None:
        if hold:
            raise ValueError(
                "Argument hold is for a track of focal lengths, and argument focal is one number."
            )
        return dict.fromkeys(videos, number)
    if not Path(focal).is_dir():
        if len(videos) > 1:
            raise ValueError(
                f"The track {focal} is for one video, and there are {len(videos)}: give argument focal a "
                f"folder with a track for each, such as {videos[0].stem}.csv."
            )
        return dict.fromkeys(videos, read_focal_track(focal, hold=hold))
    files = {video: _track_file(Path(focal), video, name) for video, name in names.items()}
    first: dict[Path, Path] = {}
    for video, file in files.items():
        if not os.path.lexists(file):
            raise FileNotFoundError(
                f"The folder {focal} has no {file.name}, the track of {video}: name it so, or give "
                "argument focal the file of one video."
            )
        if (other := first.setdefault(file, video)) is not video:
            own = Path(focal) / names[video].with_suffix(".csv")
            raise ValueError(
                f"The track {file} is for one video, and {other} and {video} both have its name: "
                + (f"give each its own, such as {own}." if own != file else "correct one after the other.")
            )
    return {video: read_focal_track(file, hold=hold) for video, file in files.items()}


def _track_file(folder: Path, video: Path, name: Path) -> Path:
    """The track of a video: named with its folders, if there is such a file, else without."""
    whole = folder / name.with_suffix(".csv")
    return whole if whole.is_file() else folder / f"{video.stem}.csv"


def undistort_videos(
    work: Sequence[tuple[Path, Path, Focal]],
    *,
    lens: ZoomLens,
    keep: str,
    interpolation: str,
    border: str,
    back: bool,
    progress: Callable[[int, int], None],
    executor: Executor | None = None,
) -> tuple[dict[Path, CorrectedVideo], dict[Path, Exception]]:
    """Correct each source into its target; the results by target, and the errors of sources by source.

    Progress is counted in frames of one video, and in videos of several, whose warnings name them.
    """
    os.environ.setdefault("SVT_LOG", "1")  # the encoder of AV1 tells its settings without it
    done, skipped = {}, {}
    correct = redistort_video if back else undistort_video
    several = len(work) > 1
    for number, (source, target, focal) in enumerate(work):

        def told(frames: int, total: int, number: int = number) -> None:
            progress(*((number, len(work)) if several else (frames, total)))

        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            with _warnings_named(source) if several else contextlib.nullcontext():
                done[target] = correct(
                    source,
                    target,
                    lens=lens,
                    focal=focal,
                    keep=keep,
                    interpolation=interpolation,
                    border=border,
                    progress=told,
                    executor=executor,
                )
        except (ValueError, OSError) as error:
            skipped[source] = error
    return done, skipped


@contextlib.contextmanager
def _warnings_named(source: Path) -> Iterator[None]:
    """Warnings within begin with the name of the file that they are about."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield
    for message in dict.fromkeys(str(one.message) for one in caught):
        warnings.warn(f"{source}: {message}", stacklevel=3)
