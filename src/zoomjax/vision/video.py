"""Zooming video, corrected frame by frame at each frame's own focal length, with PyAV.

Decoding, warping (`planes`) and encoding overlap in three threads with a few frames between them, so that
memory stays flat. Frame times, frame rate, colour description, orientation and tags go over unchanged, and
audio packets as they are.
"""

import contextlib
import dataclasses
import functools
import itertools
import math
import os
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .._files import refuse_inputs, whole_file
from ..framing import Framing, check_keep, frame_output, framing_for_size
from ..io.focal_track import FocalTrack
from ..lens import ZoomLens
from ..sizes import at_focal, lens_for_size
from ._av import av
from .ahead import ahead
from .encoding import CONTAINER, FrameWriter, display_matrix
from .planes import FrameWarper
from .undistort import check_sampling, warn_of_fold

_MOST_ERRORS = 1000
"""Of one file: a demuxer may fail for ever."""


@contextlib.contextmanager
def decode_video(
    source: str | os.PathLike[str],
) -> Iterator[tuple[int, Iterator[tuple[int, float, Callable[[], np.ndarray]]]]]:
    """The number of frames by the file's own account, and for each number, time, s, and what decodes it.

    Numbers count damaged frames, too. The time is NaN where the file has none: the rate that FFmpeg then
    tells is a guess.

    Pixels are (height, width, 3) blue, green, red bytes, as stored: before any rotation for display.
    Damaged frames are passed over.

    Raises:
        FileNotFoundError: there is no such video.
        ValueError: the source is no video, or none of its frames decodes.
    """
    with _opened(source) as input_:
        video = input_.streams.best("video")
        report = _Report(video.frames)

        def frames() -> Iterator[tuple[int, float, Callable[[], np.ndarray]]]:
            for item, number, time in _numbered(_decoded(input_, video, report), report, source):
                if isinstance(item, av.VideoFrame):
                    yield number, time, functools.partial(item.to_ndarray, format="bgr24")

        yield video.frames or _counted(source), frames()


@dataclasses.dataclass(frozen=True)
class CorrectedVideo:
    """What `undistort_video` did.

    Attributes:
        frames: frames written.
        lost: frames that the file announces but that do not decode, or only with errors.
        scale: output pixels per corrected pixel, of all frames.
    """

    frames: int
    lost: int
    scale: float


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
) -> CorrectedVideo:
    """Correct a video, each frame at its own focal length, into a new file.

    Args:
        source: the video. Its frames are taken as they are stored, before any rotation for display.
        target: the file to write, all of it or none: .mp4, .mov, .m4v, .mkv, .webm, .avi, .ts.
        lens: the lens; for frames of another size of the same aspect ratio it is scaled.
        focal: one focal length for all frames, or a track, in the lens's unit.
        keep: "same", "all" or "valid", one framing for all focal lengths of the track; or a `Framing`,
            which for frames of another size is scaled as the lens is.
        interpolation, border: as for `undistort_image`; a constant border is black.
        encoder: FFmpeg's name of it; by default one for the source's own format, or for H.264.
        options: of the encoder; by default ones for a quality that shows no difference.
        progress: called after each frame with the number of frames done, and announced (0 if unknown).

    Raises:
        FileNotFoundError: there is no such video.
        OSError: the target cannot be written; nothing is left of it.
        ValueError: the source is no video, or none of its frames decodes; the track is shorter; the lens is
            for another aspect ratio; or the target is the source, or its suffix or the encoder is unknown,
            or not for these frames.

    Warns:
        UserWarning: frames do not decode, or are interlaced; focal lengths are outside of the fitted range;
            the lens was made for another size, or folds within the frames.
    """
    target = Path(target)
    if target.suffix.lower() not in CONTAINER:
        raise ValueError(
            f"Argument target must end in one of {', '.join(CONTAINER)}, but it is {target.name!r}."
        )
    check_sampling(interpolation, border)
    if not isinstance(keep, Framing):
        check_keep(keep)
    refuse_inputs([target], [source])
    with _opened(source) as input_, whole_file(target) as part:
        video = input_.streams.best("video")
        size = (video.codec_context.width, video.codec_context.height)
        lens = lens_for_size(lens, size)
        track = focal if isinstance(focal, FocalTrack) else _constant(float(focal))
        _check_length(track, video)
        lens.check_range(track.focal)
        if isinstance(keep, Framing):
            framing = framing_for_size(keep, size)
        else:
            framing = _common_framing(lens, track.focal, keep)
        warper = FrameWarper(lens, framing, interpolation=interpolation, border=border)
        report = _Report(video.frames)
        items = ahead(_warped(ahead(_decoded(input_, video, report)), warper, track, report, source))
        try:
            _write(items, part, target, input_, video, encoder, options, report, progress)
        finally:
            items.close()
    lost = max(report.corrupt, report.announced - report.written if report.announced else 0)
    if lost:
        warnings.warn(
            f"{lost} of {max(report.announced, report.written)} frames of {os.fspath(source)} do not "
            f"decode ({report.error or 'the file ends early'}): {report.written} were written.",
            stacklevel=2,
        )
    return CorrectedVideo(report.written, lost, float(framing.scale))


@dataclasses.dataclass
class _Report:
    """What happened on the way, in threads."""

    announced: int
    written: int = 0
    corrupt: int = 0
    failed: int = 0
    error: str = ""
    orientation: list[int] | None = None


def _opened(source: str | os.PathLike[str]) -> Any:
    path = Path(source)
    if not path.exists():
        raise FileNotFoundError(f"There is no video {path}.")
    if not path.is_file():
        raise ValueError(f"Cannot read a video from {path}: it is no ordinary file.")
    if path.stat().st_size == 0:
        raise ValueError(f"Cannot read a video from {path}: the file is empty.")
    try:
        container: Any = av.open(str(path), metadata_errors="surrogateescape")  # tags need not be UTF-8
    except av.error.FFmpegError as error:
        raise ValueError(
            f"Cannot read a video from {path}: {error.strerror}. The file is damaged, cut off, or no video."
        ) from error
    video = container.streams.best("video")
    context = video and video.codec_context  # none of a codec that FFmpeg does not know
    if not (context and context.width and context.height):
        container.close()
        why = "it has no video stream" if video is None else "none of its frames decodes"
        raise ValueError(f"Cannot read a video from {path}: {why}.")
    video.thread_type = "AUTO"
    return container


def _counted(source: str | os.PathLike[str]) -> int:
    """How many frames there are, where the file does not tell: by reading, without decoding."""
    with _opened(source) as input_, contextlib.suppress(av.error.FFmpegError):
        number = 0
        for packet in input_.demux(input_.streams.best("video")):
            number += packet.size > 0
        return number
    return 0


def _numbers(source: str | os.PathLike[str]) -> dict[int, int]:
    """The numbers of all frames by their time stamps, also of those that do not decode: by reading."""
    stamps = set()
    with _opened(source) as input_, contextlib.suppress(av.error.FFmpegError):
        for packet in input_.demux(input_.streams.best("video")):
            if packet.pts is not None and not packet.is_discard:
                stamps.add(packet.pts)
    return {stamp: number for number, stamp in enumerate(sorted(stamps))}


def _constant(focal: float) -> FocalTrack:
    return FocalTrack(np.zeros(1), np.array([focal]), hold=True)


def _check_length(track: FocalTrack, video: Any) -> None:
    """Refuse a track that ends well before the video's announced end: now, not after all the work."""
    rate = float(video.average_rate or 25)
    if track.by_time:
        length, slack = float((video.duration or 0) * video.time_base), 2 / rate  # durations are rounded
    else:
        length, slack = float(video.frames), 1.0
    end = float(track.position[-1])
    if not track.hold and end < length - slack:
        unit = "s" if track.by_time else "frames"
        raise ValueError(
            f"The focal track ends at {end:g} {unit}, and the video has {length:.6g} {unit}. "
            "Give a track as long as the video, or hold its ends (--hold)."
        )


def _common_framing(lens: ZoomLens, focal: np.ndarray, keep: str) -> Framing:
    """One framing for all focal lengths from the shortest to the longest."""
    inverse = np.linspace(1 / focal.min(), 1 / focal.max(), 65 if focal.min() < focal.max() else 1)
    distortions = [at_focal(lens, np.asarray(1 / u, np.asarray(lens.centre).dtype)) for u in inverse]
    for distortion in (distortions[0], distortions[-1]):
        if warn_of_fold(distortion, lens.image_size, stacklevel=4):
            break
    return frame_output(distortions, lens.image_size, keep=keep)


def _decoded(input_: Any, video: Any, report: _Report) -> Generator[Any, None, None]:
    """Frames and audio packets, in the file's order; what is damaged is counted and passed over."""
    packets = input_.demux([video, *input_.streams.audio])
    while report.corrupt < _MOST_ERRORS:
        try:
            packet = next(packets, None)
            if packet is None:
                return
            if packet.stream is not video:
                if packet.dts is not None:
                    yield packet
                continue
            frames = packet.decode()
        except av.error.FFmpegError as error:
            report.corrupt += 1
            report.failed += 1
            report.error = error.strerror or str(error)
            continue
        for frame in frames:
            report.corrupt += bool(frame.is_corrupt)
            yield frame


def _warped(
    items: Generator[Any, None, None],
    warper: FrameWarper,
    track: FocalTrack,
    report: _Report,
    source: str | os.PathLike[str],
) -> Generator[Any, None, None]:
    """Each frame corrected; packets of audio as they are."""
    try:
        for item, number, time in _numbered(items, report, source):
            if isinstance(item, av.VideoFrame):
                if report.orientation is None:
                    report.orientation = display_matrix(item)
                yield warper(item, track.at(number, time))
            else:
                yield item
    finally:
        items.close()


def _numbered(
    items: Iterable[Any], report: _Report, source: str | os.PathLike[str]
) -> Iterator[tuple[Any, int, float]]:
    """Each frame with its number and time since the first, s, NaN if unknown; other packets as they are.

    Frames are counted. Once some did not decode, time stamps tell the numbers of the others.
    """
    number, first, stamps = 0, None, None
    for item in items:
        if not isinstance(item, av.VideoFrame):
            yield item, -1, math.nan
            continue
        if first is None:
            first = item.time or 0.0
            _warn_of_fields(item)
        if report.failed and item.pts is not None:
            stamps = _numbers(source) if stamps is None else stamps
            number = stamps.get(item.pts, number)
        yield item, number, math.nan if item.time is None else item.time - first
        number += 1


def _warn_of_fields(frame: Any) -> None:
    if frame.interlaced_frame:
        warnings.warn(
            "The video is interlaced: each frame holds two moments in alternate rows, which are taken for "
            "one. Deinterlace it first.",
            stacklevel=2,
        )


def _write(
    items: Iterable[Any],
    part: Path,
    target: Path,
    input_: Any,
    video: Any,
    encoder: str | None,
    options: dict[str, str] | None,
    report: _Report,
    progress: Callable[[int, int], None],
) -> None:
    """Encode the frames and copy the packets as they come."""
    items = iter(items)
    early = []  # audio before the first frame, of which the encoder must know the size and orientation
    for item in items:
        early.append(item)
        if isinstance(item, av.VideoFrame):
            break
    else:
        raise ValueError(f"Cannot read a video from {input_.name}: none of its frames decodes.")
    with FrameWriter(
        part, target, input_, video, early[-1], encoder, options, report.orientation
    ) as writer:
        for item in itertools.chain(early, items):
            if not isinstance(item, av.VideoFrame):
                writer.copy(item)
                continue
            writer.encode(item)
            report.written += 1
            progress(report.written, report.announced)
