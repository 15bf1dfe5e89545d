"""What a video file holds beside its pictures, and which of it another container can hold.

Sound, subtitles and data go over packet by packet; chapters, attachments and time codes as a whole.
"""

import dataclasses
import io
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from .._core.text import plain
from .pyav import av, open_container
from .video_reader import NEW_TIMES

CONTAINER = {
    ".mp4": "mp4",
    ".m4v": "mp4",
    ".mov": "mov",
    ".mkv": "matroska",
    ".webm": "webm",
    ".avi": "avi",
    ".ts": "mpegts",
    ".mxf": "mxf",
}
"""Suffixes of files that can be written, and FFmpeg's names of their formats."""

_DATA = {"mpegts": ("klv", "timed_id3", "scte_35"), "mov": ("klv",)}
"""Data tracks that FFmpeg writes into a container; others have no place in it."""

_TRANSPORT = ("dvbsub", "dvb_subtitle", "dvb_teletext", "libzvbi_teletextdec")
"""Subtitles of transport streams, of which FFmpeg takes any, and makes data of the others."""

_HEARD = ("aac", "aac_latm", "ac3", "dts", "eac3", "mp1", "mp2", "mp3", "opus", "s302m", "truehd")
"""Sound of transport streams, of which the same is true: nobody hears the others."""

_SEEN = ("h264", "hevc", "vvc", "mpeg1video", "mpeg2video", "mpeg4", "mjpeg", "dnxhd", "jpeg2000")
"""Their pictures, of which nobody sees others."""

_SECONDS, _OFF = 10.0, 0.05
"""s of sound that are looked at for its times, and by how much the length of these may be off."""

_AT_ONCE = 0.1
"""s after time 0, at which players of AVI begin the sound, by which it may begin late."""

_APPLES = "com.apple.quicktime."
"""How keys begin by which phones tell place and camera."""

_ANEW = "give the sound another format first: ffmpeg -i SOURCE -c:v copy -c:a aac NEW.mkv."

_CHAPTERS = ("mp4", "mov", "matroska", "webm")
_TIME_CODES = ("mp4", "mov", "mxf")
_ATTACHMENTS = ("matroska",)


@dataclasses.dataclass(frozen=True)
class Carried:
    """What goes over to another container.

    Attributes:
        streams: streams whose packets are copied.
        chapters: the chapters, empty if the container holds none.
        attachments: files such as fonts, as streams.
        kept: names of all this, for the user.
        not_kept: names of what is left behind.
    """

    streams: tuple[Any, ...]
    chapters: tuple[Any, ...]
    attachments: tuple[Any, ...]
    kept: tuple[str, ...]
    not_kept: tuple[str, ...]


def carried(input_: Any, video: Any, named: Path) -> Carried:
    """What of an open file, beside one stream of pictures, goes over to a file of a name."""
    container = CONTAINER[named.suffix.lower()]
    streams, attachments, kept, lost = [], [], [], []
    chapters = input_.chapters()
    for stream in input_.streams:
        if stream is video or _is_of_chapters(stream, input_, len(chapters)):
            continue
        if stream.type == "audio" or _holds(container, stream):
            streams.append(stream)
            kept.append(_name(stream))
        elif stream.type == "attachment" and container in _ATTACHMENTS:
            attachments.append(stream)
            kept.append(_name(stream))
        elif stream.type == "data" and stream.metadata.get("timecode") and container in _TIME_CODES:
            kept.append(f"the time code {stream.metadata['timecode']}")  # written from the tag
        else:
            lost.append(_name(stream))
    if chapters:
        (kept if container in _CHAPTERS else lost).append(f"chapters ({len(chapters)})")
    held = tuple(chapters) if container in _CHAPTERS else ()
    return Carried(tuple(streams), held, tuple(attachments), tuple(kept), tuple(lost))


def _is_of_chapters(stream: Any, input_: Any, number: int) -> bool:
    """Whether a stream holds the titles of the chapters, as QuickTime has them: a text for each."""
    quicktime = input_.format.name.startswith("mov,")
    return quicktime and stream.type == "data" and stream.name == "bin_data" and 0 < stream.frames == number


def _holds(container: str, stream: Any) -> bool:
    """Whether a container takes the packets of a stream of subtitles or data."""
    if stream.type == "data":
        return stream.name in _DATA.get(container, ())
    if stream.type != "subtitle":
        return False
    if container in ("mpegts", "mxf"):
        return container == "mpegts" and stream.codec_context.name in _TRANSPORT
    return _takes(container, stream)


def _takes(container: str, stream: Any) -> bool:
    """Whether a container has a name for the codec of a stream."""
    with av.open(io.BytesIO(), "w", format=container) as scratch:
        try:
            scratch.add_stream_from_template(stream)
        except ValueError:
            return False
    return True


def _first_seconds(container: str, source: Any, template: Any) -> tuple[io.BytesIO, list[float]] | None:
    """Packets of sound in a container, in a stream like the template, and their times; None if refused."""
    scratch, times = io.BytesIO(), list[float]()
    with open_container(source.container.name) as again, av.open(scratch, "w", format=container) as made:
        stream = made.add_stream_from_template(template)
        for packet in again.demux(again.streams[source.index]):
            if packet.pts is None or packet.dts is None:
                continue
            times.append(float(packet.pts * packet.time_base))
            packet.stream = stream
            try:
                made.mux(packet)
            except av.error.ArgumentError:  # two packets of one time
                return None
            if times[-1] - times[0] > _SECONDS:
                break
    scratch.seek(0)
    return scratch, times


def _keeps_times(container: str, source: Any, template: Any) -> bool:
    """Whether sound keeps its times in a container, in a stream like the template, as far as is looked at.

    AVI holds no times, but how long a packet or a byte lasts, which FFmpeg writes wrong for some codecs.
    """
    if (found := _first_seconds(container, source, template)) is None:
        return False
    scratch, before = found
    if len(before) < 2:
        return True
    with av.open(scratch, "r") as back:
        after = [float(p.pts * p.time_base) for p in back.demux(audio=0) if p.pts is not None]
    longest = max(later - earlier for earlier, later in itertools.pairwise(before))
    return abs((after[-1] - after[0]) - (before[-1] - before[0])) < _OFF + longest


def _for_avi(source: Any, named: Path) -> Any:
    """A stream by which AVI keeps the times of sound: its own, or that of an AVI file as Matroska has it.

    Raises:
        ValueError: there is none.
    """
    if _keeps_times("avi", source, source):
        return source
    matroska = _takes("matroska", source)
    found = None
    if matroska and source.container.format.name == "avi":
        found = _first_seconds("matroska", source, source)
    if found is not None and _keeps_times("avi", source, like := av.open(found[0], "r").streams.audio[0]):
        return like
    raise ValueError(
        f"Cannot keep the {_name(source)} in a {named.suffix} file: FFmpeg writes its lengths wrong there, "
        "so that it would be faster or slower than the pictures. "
        + (f"Choose .mkv, or {_ANEW}" if matroska else f"{_ANEW[0].upper()}{_ANEW[1:]}")
    )


_KINDS = {"audio": "sound", "subtitle": "subtitles", "data": "data", "video": "a further picture"}


_NAMES = {"subrip": "srt"}
"""Codecs that people know by another name than FFmpeg's."""


def _name(stream: Any) -> str:
    """What messages call a stream: its kind, its codec and its language."""
    if stream.type == "attachment":
        return f"the attachment {stream.metadata.get('filename', stream.index)}"
    context = getattr(stream, "codec_context", None)
    codec = getattr(stream, "name", None) if context is None else context.codec.canonical_name
    language = stream.metadata.get("language")
    about = [_NAMES.get(codec or "", codec) or "of no known kind", None if language == "und" else language]
    return f"{_KINDS.get(stream.type, stream.type)} ({', '.join(filter(None, about))})"


def put(output: Any, what: Carried, named: Path) -> dict[int, Any]:
    """Add all this to a container before its first packet; the new streams by the numbers of the old.

    Raises:
        ValueError: the container does not take the sound.
    """
    if what.chapters:
        output.set_chapters(list(what.chapters))
    for stream in what.attachments:
        name = stream.metadata.get("filename", f"attachment-{stream.index}")
        output.add_attachment(name, stream.mimetype or "application/octet-stream", bytes(stream.data))
    return {stream.index: _copied(output, stream, named) for stream in what.streams}


def _copied(output: Any, source: Any, named: Path) -> Any:
    late = float((source.start_time or 0) * source.time_base) if source.type == "audio" else 0.0
    if output.format.name == "avi" and late > _AT_ONCE:
        raise ValueError(
            f"The {_name(source)} begins at {late:.2f} s, which a {named.suffix} file does not hold: it "
            "would be ahead of the pictures. Choose .mkv."
        )
    avi = output.format.name == "avi" and source.type == "audio" and _takes("avi", source)
    like = _for_avi(source, named) if avi else source
    try:
        _check_heard(source, named)
        stream = output.add_stream_from_template(like)
    except ValueError as error:
        raise ValueError(
            f"Cannot keep the {_name(source)} in a {named.suffix} file. Choose the suffix of the source, "
            f"{'.mkv, ' * (named.suffix.lower() != '.mkv')}or {_ANEW}"
        ) from error
    stream.metadata.update(source.metadata)
    if source.type != "data":
        stream.disposition = source.disposition
    return stream


def _check_heard(source: Any, named: Path) -> None:
    """Raise ValueError for sound that FFmpeg would write to a container as data of no known kind."""
    if source.type == "audio" and CONTAINER[named.suffix.lower()] == "mpegts":
        codec = source.codec_context.codec.canonical_name
        if codec not in _HEARD:
            raise ValueError(f"a transport stream has no number for {codec}")


def mux(output: Any, named: Path, packets: Any) -> None:
    """Write packets to a container.

    Raises:
        ValueError: it does not take them, such as sound whose packets it wants in another order.
        OSError: they cannot be written.
    """
    try:
        output.mux(packets)
    except av.error.ArgumentError as error:  # and no full disk
        raise ValueError(
            f"A {named.suffix} file does not take these pictures or this sound ({error.strerror}). Where "
            f"recordings were joined and times begin again, give them new ones first: {NEW_TIMES}. Else "
            f"choose .mkv, or {_ANEW}"
        ) from error


def tag_options(container: str, tags: Mapping[str, str]) -> dict[str, str]:
    """Options of a container with which it holds such tags; by default MP4 has those of music players."""
    apples = container in ("mp4", "mov") and any(name.startswith(_APPLES) for name in tags)
    return {"movflags": "use_metadata_tags"} if apples else {}


def lost_tags(path: Path, tags: Mapping[str, str]) -> list[str]:
    """The names of tags that a finished file does not have, as one entry."""
    with open_container(path) as made:
        there = {name.lower() for name in made.metadata}
    lost = [name for name in tags if name.lower() not in there]
    return [f"the tag{'s' * (len(lost) > 1)} {', '.join(map(plain, lost))}"] if lost else []


def lost_of_tracks(path: Path, sources: Sequence[Any]) -> list[str]:
    """What sound and subtitles of a finished file no longer tell of themselves, an entry for each."""
    lost = []
    with open_container(path) as made:
        for kind in ("audio", "subtitle"):
            before = [stream for stream in sources if stream.type == kind]
            after = [stream for stream in made.streams if stream.type == kind]
            for old, new in zip(before, after, strict=False):
                names = [
                    name for name in ("language", "title") if _tells(old, name) and not _tells(new, name)
                ]
                marks = [
                    mark.name
                    for mark in av.stream.Disposition
                    if old.disposition & mark and not new.disposition & mark
                ]
                if len(before) == 1 and "default" in marks:  # with or without it is the one that is played
                    marks.remove("default")
                names += [f"mark {name}" for name in marks if name]
                lost += [f"the {' and the '.join(names)} of the {_name(old)}"] if names else []
    return lost


def _tells(stream: Any, name: str) -> bool:
    return stream.metadata.get(name, "und") not in ("", "und")


def starts(output: Any, named: Path, copied: Sequence[Any]) -> None:
    """Write the head of a container.

    Raises:
        ValueError: the container does not take these streams.
    """
    pictures = output.streams.video[0].codec_context.codec.canonical_name
    if output.format.name == "mpegts" and pictures not in _SEEN:
        raise ValueError(
            f"Cannot write {pictures} to a {named.suffix} file, in which no player finds these pictures: "
            "leave out argument encoder, or choose .mkv."
        )
    try:
        output.start_encoding()
    except (ValueError, av.error.FFmpegError) as error:
        names = ", ".join(_name(stream) for stream in copied) or "these pictures"
        raise ValueError(
            f"Cannot write {names} to a {named.suffix} file: {getattr(error, 'strerror', None) or error}. "
            "Choose .mov or .mkv."
        ) from error
