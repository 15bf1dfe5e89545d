"""Correction of zooming video with PyAV, each frame at its own focal length.

On an executor, segments of the video are corrected and encoded side by side (`_segments`).
Decoding, warping (`_planes`) and encoding overlap in three threads with a few frames between them, so that
memory use stays constant. Frame times, frame rate, colour description, orientation, tags, sound, and what
else the container holds are copied unchanged; the result says what was kept and what was not.
"""

import contextlib
import dataclasses
import itertools
import os
import warnings
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, NamedTuple, TypedDict, Unpack

import numpy as np

from .._core.checks import real_numbers
from .._core.files import refuse_inputs, whole_file
from ..io.focal_track import FocalTrack
from ..io.pyav import av
from ..io.video_reader import (
    decoded_items,
    frames_shown,
    numbered,
    opened_video,
    picture_stream,
    warn_of_pixels,
)
from ..io.video_report import Report, lost_frames
from ..io.video_streams import CONTAINER, Carried, carried
from ..io.video_writer import FrameWriter, Picture, first_frame
from ..models.lens import ZoomLens
from ..models.sizes import at_focal, lens_for_size
from ._planes import FrameWarper
from ._prefetch import ahead
from ._segments import Segment, Work, cut, encoded_segments, from_first, with_others
from .framing import Framing, check_keep, frame_output, framing_for_size
from .image import warn_of_fold
from .redistort import check_framed
from .sampler import check_sampling


@dataclasses.dataclass(frozen=True)
class CorrectedVideo:
    """Result of `undistort_video`.

    Attributes:
        frames: number of frames written.
        lost: number of frames that cannot be decoded, as no key frame comes before them, or only with
            errors.
        scale: output pixels per corrected pixel, the same for all frames.
        kept: names of what went over beside the pictures: sound, subtitles, chapters, metadata.
        not_kept: names of what did not.
    """

    frames: int
    lost: int
    scale: float
    kept: tuple[str, ...] = ()
    not_kept: tuple[str, ...] = ()


class _Others(TypedDict, total=False):
    """Other arguments of `undistort_video`, by name."""

    interpolation: str
    border: str
    encoder: str | None
    options: dict[str, str] | None
    progress: Callable[[int, int], None]
    executor: Executor | None


def undistort_video(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    lens: ZoomLens,
    focal: float | int | FocalTrack,
    keep: str | Framing = "same",
    interpolation: str = "linear",
    border: str = "constant",
    encoder: str | None = None,
    options: dict[str, str] | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    executor: Executor | None = None,
) -> CorrectedVideo:
    """Correct a video, each frame at its own focal length, and write it to a new file.

    Args:
        source: the video. Its frames are used as stored, before any rotation for display.
        target: the file to write, completely or not at all: .mp4, .mov, .m4v, .mkv, .webm, .avi, .ts,
            .mxf.
        lens: the lens; for frames of another size of the same aspect ratio it is scaled.
        focal: one focal length for all frames, or a track, in the lens's unit.
        keep: "same", "all", "valid" or "grow", one framing for all focal lengths of the track; or a
            `Framing`, which for frames of another size is scaled as the lens is.
        interpolation, border: as for `undistort_image`; a constant border is black.
        encoder: FFmpeg's name of the encoder; by default one for the source's own format, or for H.264.
        options: options of the encoder, texts by FFmpeg's names; by default for visually lossless quality.
            Those of the container (movflags) are none.
        progress: called after each frame with the number of frames done and announced (0 if unknown).
        executor: where segments of the video, from key frame to key frame, are corrected and encoded; None:
            here. Its workers read the video by the same path; packets come back. A video whose frames have
            no times, as in AVI files, is corrected here.

    Raises:
        FileNotFoundError: there is no such video.
        OSError: the target cannot be written; nothing is left of it.
        ValueError: the source is not a video, or none of its frames can be decoded; the track is shorter;
            the lens is for another aspect ratio; or the target is the source, or its suffix, the encoder
            or an option of it is unknown, or not suitable for these frames.

    Warns:
        UserWarning: frames cannot be decoded, or are interlaced; pixels are not square; the file has
            several streams of pictures, of which one is corrected; focal lengths are outside of the fitted
            range; the track goes on after the video's end; the lens is for another size, or folds within
            the frames.
    """
    how = _Work(lens, keep, interpolation, border, encoder, options, progress, executor)
    return _convert(source, target, focal, how)


def redistort_video(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    lens: ZoomLens,
    focal: float | int | FocalTrack,
    keep: str | Framing = "same",
    **others: Unpack[_Others],
) -> CorrectedVideo:
    """Apply distortion to a corrected video, as `redistort_image`, and write it to a new file.

    Arguments, result and errors are those of `undistort_video`; `keep` says how the video was corrected.
    """
    return _convert(source, target, focal, _Work(lens, keep, back=True, **others))


class _Work(NamedTuple):
    """What is done to a video, and where: arguments of `undistort_video`, and whether it is its inverse."""

    lens: ZoomLens
    keep: str | Framing
    interpolation: str = "linear"
    border: str = "constant"
    encoder: str | None = None
    options: dict[str, str] | None = None
    progress: Callable[[int, int], None] = lambda done, total: None
    executor: Executor | None = None
    back: bool = False


def _convert(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    focal: float | int | FocalTrack,
    how: _Work,
) -> CorrectedVideo:
    progress, executor = how.progress, how.executor
    target = Path(target)
    if target.suffix.lower() not in CONTAINER:
        raise ValueError(
            f"Argument target must end in one of {', '.join(CONTAINER)}, but it is {target.name!r}."
        )
    check_sampling(how.interpolation, how.border)
    if not isinstance(how.keep, Framing):
        check_keep(how.keep)
    _check_options(how.options)
    refuse_inputs([target], [source])
    track = focal if isinstance(focal, FocalTrack) else _constant(focal)
    with opened_video(source) as input_, whole_file(target) as part:
        video = picture_stream(input_)
        size = (video.codec_context.width, video.codec_context.height)
        report = Report(frames_shown(source, video))
        warn_of_pixels(video)
        _check_length(track, video, report.announced)
        lens, framing = _geometry(how.lens, track, how.keep, size, how.back)
        warper = FrameWarper(
            lens, framing, interpolation=how.interpolation, border=how.border, back=how.back
        )
        along = carried(input_, video, target)
        segments = [] if executor is None else _segments_of(source, target, video, along, report)
        if executor is not None and segments:
            there = Work(source, target.name, lens, framing, how.interpolation, how.border, how.back, track)
            there = dataclasses.replace(there, encoder=how.encoder, options=how.options)
            writer = _write_segments(
                executor, segments, there, warper, part, target, input_, video, along, report, progress
            )
        else:
            decoded = ahead(decoded_items(input_, video, report, along.streams))
            items = ahead(_warped(decoded, warper, track, report, source))
            with contextlib.closing(items):
                writer = _write(
                    items, part, target, input_, video, how.encoder, how.options, along, report, progress
                )
        lost, told = lost_frames(source, input_, video, report)
    if told:
        warnings.warn(told, stacklevel=3)
    if lost <= report.skipped:
        track.warn_if_longer(*report.last, stacklevel=3)
    return CorrectedVideo(
        report.written, lost, float(framing.scale), tuple(writer.kept), tuple(writer.not_kept)
    )


def _check_options(options: Any) -> None:
    """Refuse options of an encoder that are not texts, which FFmpeg does not take."""
    if options is None:
        return
    if not isinstance(options, Mapping) or not all(
        isinstance(part, str) for pair in options.items() for part in pair
    ):
        raise TypeError(
            f'Argument options must be texts by names, such as {{"crf": "20"}}, but it is {options!r}.'
        )


def _geometry(
    lens: ZoomLens, track: FocalTrack, keep: str | Framing, size: tuple[int, int], back: bool
) -> tuple[ZoomLens, Framing]:
    """The lens for the distorted frames, and the framing of the corrected ones, from the size of either."""
    if back and isinstance(keep, Framing):
        original = keep.image_size or size
    else:
        original = lens.image_size if back and keep == "grow" else size
    lens = lens_for_size(lens, original)
    lens.check_range(track.focal)
    if isinstance(keep, Framing):
        framing = keep if back else framing_for_size(keep, size)
    else:
        framing = _common_framing(lens, track.focal, keep)
    if back:
        check_framed(framing, size)
    return lens, framing


def _constant(focal: Any) -> FocalTrack:
    if (number := real_numbers(focal)) is None or number.ndim:
        raise TypeError(
            "Argument focal must be one focal length or a FocalTrack, but its type is "
            f"{type(focal).__name__}: read_focal_track(path) reads a file, and FocalTrack(np.arange(n), f, "
            "by_time=False) is of n frames."
        )
    return FocalTrack(np.zeros(1), number[None], hold=True)


def _check_length(track: FocalTrack, video: Any, frames: int) -> None:
    """Refuse a track that ends well before the video's announced end: now, not after all the work."""
    rate = float(video.average_rate or 25)
    if track.by_time:
        length, slack = float((video.duration or 0) * video.time_base), 2 / rate  # durations are rounded
    else:
        length, slack = float(frames), 1.0
    end = float(track.position[-1])
    if not track.hold and end < length - slack:
        unit = "s" if track.by_time else "frames"
        raise ValueError(
            f"The focal track ends at {end:g} {unit}, and the video has {length:.6g} {unit}. "
            "Give a track as long as the video, or hold its ends (argument hold)."
        )


def _common_framing(lens: ZoomLens, focal: np.ndarray, keep: str) -> Framing:
    """One framing for all focal lengths from the shortest to the longest."""
    inverse = np.linspace(1 / focal.min(), 1 / focal.max(), 65 if focal.min() < focal.max() else 1)
    distortions = [at_focal(lens, np.asarray(1 / u, np.asarray(lens.centre).dtype)) for u in inverse]
    for distortion in (distortions[0], distortions[-1]):
        if warn_of_fold(distortion, lens.image_size, stacklevel=4):
            break
    return frame_output(distortions, lens.image_size, keep=keep)


def _warped(
    items: Generator[Any, None, None],
    warper: FrameWarper,
    track: FocalTrack,
    report: Report,
    source: str | os.PathLike[str],
) -> Generator[Any, None, None]:
    """Each frame corrected; other packets as they are."""
    try:
        for item, number, time in numbered(items, report, source):
            if isinstance(item, av.VideoFrame):
                if report.first is None:
                    report.first = first_frame(item, report.side)
                report.last = (number, time)
                yield warper(item, track.at(number, time))
            else:
                yield item
    finally:
        items.close()


def _write(
    items: Iterable[Any],
    part: Path,
    target: Path,
    input_: Any,
    video: Any,
    encoder: str | None,
    options: dict[str, str] | None,
    along: Carried,
    report: Report,
    progress: Callable[[int, int], None],
) -> FrameWriter:
    """Encode the frames and copy the packets as they come; the writer, which is done."""
    items = iter(items)
    early = []  # packets before the first frame, of which the encoder must know the size and orientation
    for item in items:
        early.append(item)
        if isinstance(item, av.VideoFrame):
            break
    else:
        raise ValueError(f"Cannot read a video from {input_.name}: none of its frames can be decoded.")
    with FrameWriter(
        part, target, input_, video, early[-1], report.first, encoder, options, along
    ) as writer:
        for item in itertools.chain(early, items):
            if not isinstance(item, av.VideoFrame):
                writer.copy(item)
                continue
            writer.encode(item)
            report.written += 1
            progress(report.written, report.announced)
    return writer


def _segments_of(
    source: str | os.PathLike[str], target: Path, video: Any, along: Carried, report: Report
) -> list[Segment]:
    """The segments of a video; none if it cannot be cut, as one whose alpha VP9 keeps beside packets."""
    has_alpha = (video.codec_context.pix_fmt or "").startswith("yuva")
    if has_alpha and target.suffix.lower() in (".webm", ".mkv"):
        return []
    return cut(source, [stream.index for stream in along.streams], report)


def _write_segments(
    executor: Executor,
    segments: Sequence[Segment],
    work: Work,
    warper: FrameWarper,
    part: Path,
    target: Path,
    input_: Any,
    video: Any,
    along: Carried,
    report: Report,
    progress: Callable[[int, int], None],
) -> FrameWriter:
    """Copy packets as they come, and pictures from an executor's tasks; the writer, which is done."""
    own = Report(0)
    for frame, number, time in numbered(decoded_items(input_, video, own), own, work.source):  # noqa: B007
        break
    else:
        raise ValueError(f"Cannot read a video from {input_.name}: none of its frames can be decoded.")
    report.first, report.skipped = first_frame(frame, own.side), own.skipped
    segments = from_first(segments, frame.pts, own.skipped)
    work = dataclasses.replace(work, like=report.first, zero=frame.time or 0.0)
    made = warper(frame, work.track.at(number, time))

    def pictures() -> Generator[Picture, None, None]:
        for done in encoded_segments(executor, segments, work):
            report.written += done.report.written
            report.corrupt += done.report.corrupt
            report.error = report.error or done.report.error
            report.last = max(report.last, done.report.last)
            progress(report.written, report.announced)
            yield from done.pictures

    others = [stream.index for stream in along.streams]
    with (
        contextlib.closing(pictures()) as encoded,
        FrameWriter(
            part, target, input_, video, made, report.first, work.encoder, work.options, along
        ) as writer,
    ):
        for item in with_others(work.source, others, encoded):
            (writer.put if isinstance(item, Picture) else writer.copy)(item)
    return writer
