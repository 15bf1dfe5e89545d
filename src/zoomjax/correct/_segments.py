"""A video cut at key frames into segments, each corrected and encoded by a task of its own.

A segment begins with a key frame, which decodes without what is before it. Frames that are shown before a
key frame and stored after it (of an open group of pictures) belong to the segment before, which therefore
decodes on until a frame of the next one appears. Encoders begin each segment anew, so that packets of one
segment after the other are a stream.

Once: a pass over the packets of the source, none decoded. A task: its frames, and those of the next segment
that are decoded until its first is shown.
"""

import bisect
import contextlib
import dataclasses
import heapq
import os
import tempfile
from collections.abc import Generator, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, NamedTuple

import cv2

from .._core.executors import arrived, checked_executor, in_order, is_away, sent
from ..io.focal_track import FocalTrack
from ..io.pyav import av
from ..io.video_reader import opened_video, picture_stream, warn_of_loss
from ..io.video_report import Report
from ..io.video_streams import Carried
from ..io.video_writer import FirstFrame, FrameWriter, Picture
from ..models.lens import ZoomLens
from ._planes import FrameWarper
from .framing import Framing

_LEAST = 100
"""Frames of a segment, with which the cost of beginning a decoder and an encoder is small."""


class Segment(NamedTuple):
    """Frames from one key frame until before another one.

    Attributes:
        stamps: the time of each frame, increasing, in units of the stream.
        number: number of the first frame among all.
        whole: whether they are decoded from the beginning of the file.
        until: time of the first frame that is no part of it, or None at the end of the video.
        size: bytes of its packets.
    """

    stamps: tuple[int, ...]
    number: int
    whole: bool
    until: int | None
    size: int


@dataclasses.dataclass(frozen=True)
class Work:
    """What a task needs beside its segment: arguments of `undistort_video`, and of its first frame."""

    source: str | os.PathLike[str]
    name: str
    lens: ZoomLens
    framing: Framing
    interpolation: str
    border: str
    back: bool
    track: FocalTrack
    encoder: str | None = None
    options: dict[str, str] | None = None
    like: FirstFrame = FirstFrame(None, {})  # noqa: RUF009, it is frozen
    zero: float = 0.0


class Encoded(NamedTuple):
    """What a task gives back."""

    pictures: list[Picture]
    report: Report


def cut(source: str | os.PathLike[str], others: Sequence[int], report: Report) -> list[Segment]:
    """The segments of a video; none if it cannot be cut. The report learns where packets end.

    A video can be cut if every packet has a time of its own, and those of key frames increase.
    """
    stamps: list[int] = []
    keys: list[int] = []
    sizes: list[tuple[int, int]] = []
    report.streams = 1 + len(others)
    with opened_video(source) as input_:
        video = picture_stream(input_)
        if input_.format.name == "avi":  # which has times of decoding alone
            return []
        packets = input_.demux([video, *(input_.streams[index] for index in others)])
        with contextlib.suppress(av.error.FFmpegError):
            for packet in packets:
                if packet.pts is None:
                    if packet.stream is video and packet.size:
                        return []
                    continue
                report.note(packet, pictures=packet.stream is video)
                if packet.stream is not video:
                    continue
                if packet.is_discard:
                    continue
                warn_of_loss(packet, report)
                stamps.append(packet.pts)
                sizes.append((packet.pts, packet.size))
                if packet.is_keyframe:
                    keys.append(packet.pts)
    stamps.sort()
    if len(set(stamps)) < len(stamps) or sorted(set(keys)) != keys:
        return []
    return _segments(stamps, keys, sizes)


def _segments(stamps: list[int], keys: list[int], sizes: list[tuple[int, int]]) -> list[Segment]:
    starts = [0]
    for place in (bisect.bisect_left(stamps, key) for key in keys):
        if place - starts[-1] >= _LEAST and len(stamps) - place >= _LEAST:
            starts.append(place)
    taken = [0] * len(starts)
    for stamp, size in sizes:
        taken[max(bisect.bisect_right([stamps[place] for place in starts], stamp) - 1, 0)] += size
    ends = [*starts[1:], len(stamps)]
    return [
        Segment(
            tuple(stamps[first:last]), first, first == 0, stamps[last] if last < len(stamps) else None, size
        )
        for first, last, size in zip(starts, ends, taken, strict=True)
    ]


def from_first(segments: Sequence[Segment], stamp: int | None, skipped: int) -> list[Segment]:
    """The segments without frames before the first that can be decoded, from which others are counted.

    Args:
        segments: of the whole video.
        stamp: time of the first frame that can be decoded.
        skipped: how many are before it, for want of a key frame.
    """
    if stamp is None or not skipped:
        return list(segments)
    left = []
    for segment in segments:
        place = bisect.bisect_left(segment.stamps, stamp)
        if place < len(segment.stamps):
            number = max(segment.number + place - skipped, 0)
            left.append(segment._replace(stamps=segment.stamps[place:], number=number))
    return left


def encoded_segments(
    executor: Executor, segments: Sequence[Segment], work: Work
) -> Generator[Encoded, None, None]:
    """The segments, corrected and encoded by an executor's tasks, in order."""
    lens, framing = sent((work.lens, work.framing))
    source = Path(work.source).absolute()  # workers are in other folders
    task = _Task(dataclasses.replace(work, source=source, lens=lens, framing=framing))
    with contextlib.closing(
        in_order(
            checked_executor(executor), task, segments, size=lambda one: one.size, file=lambda _: source
        )
    ) as done:
        for one in done:
            if isinstance(one.error, ValueError | OSError):
                raise one.error
            if one.error is not None:  # the executor's own, such as that of a task that ends its workers
                raise ValueError(
                    f"Cannot correct {os.fspath(work.source)}: the task of a segment failed: {one.told()}."
                ) from one.error
            assert one.result is not None
            yield one.result


@dataclasses.dataclass(frozen=True)
class _Task:
    """What a worker does with a segment."""

    work: Work

    def __call__(self, segment: Segment) -> Encoded:
        if is_away():
            cv2.setNumThreads(1)  # workers share a machine's cores
        done = _encode(self.work, segment)
        if done.report.written < len(segment.stamps) or done.report.corrupt:
            # Not every key frame that a container tells can be decoded from; and a damaged one cannot.
            done = _encode(self.work, segment._replace(whole=True))
        return done


def _encode(work: Work, segment: Segment) -> Encoded:
    report, pictures = Report(0), []
    lens, framing = arrived((work.lens, work.framing))
    warper = FrameWarper(
        lens, framing, interpolation=work.interpolation, border=work.border, back=work.back
    )
    with opened_video(work.source) as input_, contextlib.ExitStack() as stack:
        video = picture_stream(input_)
        writer: FrameWriter | None = None
        for frame in _frames(input_, video, segment, report):
            number = segment.number + bisect.bisect_left(segment.stamps, frame.pts)
            time = float(frame.time) - work.zero
            made = warper(frame, work.track.at(number, time))
            report.last = (number, time)
            if writer is None:
                writer = stack.enter_context(_encoder(work, input_, video, made))
            pictures += map(Picture.of, writer.encoded(made))
            report.written += 1
        if writer is not None:
            pictures += map(Picture.of, writer.encoded(None))
    return Encoded(pictures, report)


@contextlib.contextmanager
def _encoder(work: Work, input_: Any, video: Any, first: Any) -> Iterator[FrameWriter]:
    """A writer of a file that nobody reads: an encoder is made for its head."""
    nothing = Carried((), (), (), (), ())
    with tempfile.TemporaryDirectory(prefix="zoomjax-segment-") as folder:
        part, named = Path(folder, work.name), Path(work.name)
        writer = FrameWriter(
            part, named, input_, video, first, work.like, work.encoder, work.options, nothing
        )
        try:
            yield writer
        finally:
            writer.drop()


def _frames(input_: Any, video: Any, segment: Segment, report: Report) -> Iterator[Any]:
    """The frames of a segment, in the order in which they are shown."""
    first, until = segment.stamps[0], segment.until
    for packet in _packets(input_, video, segment):
        try:
            frames = packet.decode()
        except av.error.FFmpegError as error:
            if packet.pts is not None and first <= packet.pts and (until is None or packet.pts < until):
                report.corrupt += 1
                report.failed += 1
                report.error = error.strerror or str(error)
            continue
        for frame in frames:
            if frame.pts is None or frame.pts < first:
                continue
            if until is not None and frame.pts >= until:
                return
            report.corrupt += bool(frame.is_corrupt)
            yield frame


def _packets(input_: Any, video: Any, segment: Segment) -> Iterator[Any]:
    """Packets from the segment's key frame on; a container may not find it at once."""
    if segment.whole:
        yield from _demuxed(input_, video)
        return
    first = segment.stamps[0]
    for again in (False, True):
        input_.seek(0 if again else first, stream=video, backward=True)
        begun = False
        for packet in _demuxed(input_, video):
            begun = begun or (packet.pts == first and packet.is_keyframe)
            if begun:
                yield packet
        if begun:
            return


def _demuxed(input_: Any, video: Any) -> Iterator[Any]:
    packets = input_.demux(video)
    with contextlib.suppress(StopIteration, av.error.FFmpegError):
        while True:
            yield next(packets)


def with_others(
    source: str | os.PathLike[str], others: Sequence[int], pictures: Iterable[Picture]
) -> Iterator[Any]:
    """Pictures, and packets of the source's other streams, in the order of their times."""

    def copied() -> Iterator[Any]:
        with opened_video(source) as input_:
            packets = input_.demux([input_.streams[index] for index in others]) if others else iter(())
            with contextlib.suppress(av.error.FFmpegError):
                yield from (packet for packet in packets if packet.dts is not None)

    def time(item: Any) -> float:
        return float((item.pts if item.dts is None else item.dts) * item.time_base)

    return heapq.merge(copied(), pictures, key=time)
