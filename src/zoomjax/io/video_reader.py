"""Video decoded frame by frame, with PyAV."""

import contextlib
import functools
import heapq
import itertools
import math
import os
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from .pyav import av, open_container
from .video_crop import shown_size
from .video_hdr import side_data
from .video_report import Report, is_avi, is_cut_off

_MOST_ERRORS = 1000
"""Of one file: a demuxer may fail for ever."""

_HOLE = 1.5
"""Steps between frames, in units of the one before, from which some may be missing."""

INTERLACED = (
    "The video is interlaced: each frame holds two moments in alternate rows, which are taken for one. "
    "Deinterlace it first."
)
"""What is wrong with a video of fields, and what to do."""

NEW_TIMES = "ffmpeg -fflags +genpts -i SOURCE -c copy NEW.mkv"
"""What gives joined recordings times that go on, also where packets of pictures have none."""


@contextlib.contextmanager
def decode_video(
    source: str | os.PathLike[str],
) -> Iterator[tuple[int, Iterator[tuple[int, float, Callable[[], np.ndarray]]]]]:
    """The announced number of frames, and for each frame its number, time, s, and a function that decodes
    it.

    Numbers count damaged frames, too. The time is NaN where the file has none: the frame rate from FFmpeg
    is then a guess.

    Pixels are (height, width, 3) blue, green, red bytes, as stored: before any rotation for display.
    Damaged frames are skipped.

    Raises:
        FileNotFoundError: there is no such video.
        ValueError: the source is no video, or none of its frames decodes.
    """
    with opened_video(source) as input_:
        video = picture_stream(input_)
        report = Report(frames_shown(source, video))
        warn_of_pixels(video)
        items = numbered(decoded_items(input_, video, report), report, source)
        first = list(itertools.islice(items, 1))  # before which some may be left out

        def frames() -> Iterator[tuple[int, float, Callable[[], np.ndarray]]]:
            for item, number, time in itertools.chain(first, items):
                yield number, time, functools.partial(item.to_ndarray, format="bgr24")

        yield (report.announced or _counted(source)) - report.skipped, frames()


def opened_video(source: str | os.PathLike[str]) -> Any:
    """The file as a container of PyAV's; raises as `decode_video`."""
    path = Path(source)
    if not path.exists():
        raise FileNotFoundError(f"There is no video {path}.")
    if not path.is_file():
        raise ValueError(f"Cannot read a video from {path}: it is not a regular file.")
    if path.stat().st_size == 0:
        raise ValueError(f"Cannot read a video from {path}: the file is empty.")
    try:
        container = open_container(path)
    except av.error.FFmpegError as error:
        raise ValueError(
            f"Cannot read a video from {path}: {error.strerror}. The file is damaged, cut off, or no video."
        ) from error
    video = picture_stream(container)
    context = video and video.codec_context  # none of a codec that FFmpeg does not know
    if not (context and context.width and context.height):
        container.close()
        why = "it has no video stream" if video is None else "none of its frames can be decoded"
        raise ValueError(f"Cannot read a video from {path}: {why}.")
    video.thread_type = "AUTO"
    return container


def picture_stream(container: Any) -> Any:
    """The stream of pictures that is used: the one that FFmpeg takes for the best, but no cover.

    None if there is none.
    """
    moving, best = moving_streams(container), container.streams.best("video")
    return best if best in moving else next(iter(moving), None)


def moving_streams(container: Any) -> list[Any]:
    """The streams of pictures that are no covers."""
    cover = av.stream.Disposition.attached_pic
    return [stream for stream in container.streams.video if not stream.disposition & cover]


def _counted(source: str | os.PathLike[str]) -> int:
    """How many frames there are, where the file does not tell: by reading, without decoding."""
    with opened_video(source) as input_, contextlib.suppress(av.error.FFmpegError):
        number = 0
        for packet in input_.demux(picture_stream(input_)):
            number += packet.size > 0 and not packet.is_discard
        return number
    return 0


def frames_shown(source: str | os.PathLike[str], video: Any) -> int:
    """How many frames a file announces; 0 if it does not.

    Of a clip that was cut without encoding it anew, an edit list leaves out frames that are still there.
    AVI also counts chunks without content, which the index leaves out; a file that is cut off has none.
    """
    if is_avi(video.container):
        whole = not is_cut_off(source, "avi")
        indexed = sum(entry.size > 0 for entry in video.index_entries) if whole else 0
        return indexed or video.frames
    if not (video.frames and video.duration and video.average_rate):
        return video.frames
    hidden = video.frames / video.average_rate - video.duration * video.time_base
    return _counted(source) if hidden * video.average_rate > 1 else video.frames


def _frame_numbers(source: str | os.PathLike[str]) -> dict[int, int]:
    """The numbers of all frames by their time stamps, also of those that do not decode: by reading."""
    stamps = set()
    with opened_video(source) as input_, contextlib.suppress(av.error.FFmpegError):
        avi = is_avi(input_)
        for packet in input_.demux(picture_stream(input_)):
            stamp = packet.dts if avi else packet.pts
            if stamp is not None and not packet.is_discard:
                stamps.add(stamp)
    return {stamp: number for number, stamp in enumerate(sorted(stamps))}


def decoded_items(
    input_: Any, video: Any, report: Report, others: Sequence[Any] = ()
) -> Generator[Any, None, None]:
    """Frames and packets of other streams, in the file's order; damaged ones are counted and left out.

    AVI files tell the order of decoding alone, a packet a step, and so do MXF files of H.264 that have no
    index of the order in which frames are shown. Decoded frames come in that order, so the times of
    packets, the earliest first, are those of frames.
    """
    packets, avi, steps = input_.demux([video, *others]), is_avi(input_), list[int]()
    report.streams = 1 + len(others)
    early, begun, shape = list[int](), False, None
    ordered = avi or input_.format.name == "mxf"
    while report.corrupt < _MOST_ERRORS:
        step, before = None, False
        try:
            packet = next(packets, None)
            if packet is None:
                report.left = len(steps)
                return
            report.note(packet, pictures=packet.stream is video)
            if packet.stream is not video:
                if packet.dts is not None:
                    yield packet
                continue
            warn_of_loss(packet, report)
            step = (packet.dts if avi else packet.pts) if ordered else None
            if step is not None:
                heapq.heappush(steps, step)
            begun = begun or packet.is_keyframe
            if not begun and packet.pts is not None and not packet.is_discard:
                early.append(packet.pts)
                before = True
            frames = packet.decode()
        except av.error.FFmpegError as error:
            if before:  # there is no key frame yet
                continue
            report.corrupt += 1
            report.failed += 1
            report.error = error.strerror or str(error)
            if step in steps:
                steps.remove(step)
                heapq.heapify(steps)
            continue
        for frame in frames:
            if report.side is None:
                report.side = side_data(frame, video.codec_context)  # here, where the decoder is at rest
            if early and frame.pts is not None and not ordered:
                report.skipped = sum(stamp < frame.pts for stamp in early)
                early.clear()
            if steps:
                frame.pts = heapq.heappop(steps)
            report.corrupt += bool(frame.is_corrupt)
            if frame.time is not None:
                report.last_frame = max(report.last_frame, frame.time)
            now = video.codec_context.sample_aspect_ratio or shape
            if shape and now != shape:
                _warn_of_shape(frame, shape, now)
            shape = now
            yield frame


def _warn_of_shape(frame: Any, shape: Any, now: Any) -> None:
    """Warn that pixels change their shape, as of broadcasts: a file that is written has the first one."""
    (a, b), (c, d) = (Fraction(of).as_integer_ratio() for of in (shape, now))
    warnings.warn(
        f"Pixels of the video change their shape at {frame.time or 0:.3f} s, from {a}:{b} to {c}:{d}: "
        "split the video there. All are taken as square, and results have the first shape.",
        stacklevel=3,
    )


def warn_of_loss(packet: Any, report: Report) -> None:
    """Warn, once, of a transport stream whose count of packets jumps before this one."""
    stream = packet.stream
    if report.torn or not packet.is_corrupt or stream.container.format.name != "mpegts":
        return
    report.torn, stamp = True, packet.pts or packet.dts or 0
    time = float((stamp - (stream.start_time or 0)) * stream.time_base)
    warnings.warn(
        f"Packets of the video were lost after {time:.3f} s, and perhaps later, unless recordings were "
        "joined there: frames are missing or damaged, and those after them count as earlier ones. Give "
        "focal lengths by time, which stay right where times go on, and not by frame.",
        stacklevel=3,
    )


def numbered(
    items: Iterable[Any], report: Report, source: str | os.PathLike[str]
) -> Iterator[tuple[Any, int, float]]:
    """Each frame with its number and time since the first, s, NaN if unknown; other packets as they are.

    Frames are counted from the first that can be decoded, where a clip begins between key frames. Once
    others did not decode, time stamps tell the numbers; and after a hole, as decoders leave out frames of
    damaged data without a word. It is said where times jump back.
    """
    number, first, stamps, fields, back = 0, None, None, False, False
    before, usual = None, math.inf  # time stamp, and the step to it
    for item in items:
        if not isinstance(item, av.VideoFrame):
            yield item, -1, math.nan
            continue
        if first is None:
            first = item.time or 0.0
            _warn_of_skipped(report.skipped)
        if item.interlaced_frame and not fields:
            fields = True
            warnings.warn(INTERLACED, stacklevel=2)
        step = math.nan if item.pts is None or before is None else item.pts - before
        if item.pts is not None and (report.failed or step > _HOLE * usual):
            stamps = _frame_numbers(source) if stamps is None else stamps
            number = max(number, stamps.get(item.pts, number + report.skipped) - report.skipped)
        elif step > 0:
            usual = step
        elif -step > _HOLE * usual and not back:
            back = True
            time = (item.time or 0.0) - first
            _warn_of_jump(number, time - float(step * (item.time_base or 1)), time)
        before = item.pts
        yield item, number, math.nan if item.time is None else item.time - first
        number += 1


def _warn_of_jump(number: int, before: float, time: float) -> None:
    warnings.warn(
        f"Times of the video jump back from {before:.3f} s to {time:.3f} s, at frame {number}, as "
        "where recordings were joined: a focal track by time is wrong from there on, and a corrected video "
        f"shows the frames after it too early. Give it new times first: {NEW_TIMES}",
        stacklevel=3,
    )


def _warn_of_skipped(number: int) -> None:
    if number:
        warnings.warn(
            f"The first {number} frames of the video cannot be decoded, as no key frame comes before them: "
            "the video was cut there. Frames and times of a track count from the first that can.",
            stacklevel=3,
        )


def says_interlaced(source: str | os.PathLike[str]) -> bool:
    """Whether any frame says so, of a video that was read before."""
    with opened_video(source) as input_:
        items = decoded_items(input_, video := picture_stream(input_), Report(video.frames))
        return any(item.interlaced_frame for item in items)


def warn_of_pixels(video: Any) -> None:
    """Warn of a video whose pixels are not square, of which its file says to show a part, or that is one of
    several in its file."""
    size = (video.codec_context.width, video.codec_context.height)
    if (number := len(moving_streams(video.container))) > 1:
        warnings.warn(
            f"The file has {number} streams of pictures: the one of {size[0]} x {size[1]} px, number "
            f"{video.index}, is taken. Give a file with the other one alone if that is meant.",
            stacklevel=2,
        )
    if shown := shown_size(Path(video.container.name), size):
        warnings.warn(
            f"The video says to show {shown[0]} x {shown[1]} of its {size[0]} x {size[1]} px. All of them "
            "are taken, as stored, and a result shows all. Pictures that other programs make of it may "
            "have another size and centre than the lens: crop it first if you need these.",
            stacklevel=2,
        )
    if (aspect := video.sample_aspect_ratio) not in (None, 0, 1):
        warnings.warn(
            f"The video has pixels of {aspect.numerator}:{aspect.denominator}, which are not square, but "
            "the model assumes the same distortion in all directions of the stored image. Scale it to "
            "square pixels first.",
            stacklevel=2,
        )
