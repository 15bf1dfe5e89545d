"""Writing a video like a given one: its times, colours, orientation and tags, and all that goes along."""

import contextlib
import dataclasses
import functools
import re
import threading
from collections.abc import Generator, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .pyav import av, open_container
from .video_hdr import beside, with_hdr
from .video_streams import CONTAINER, Carried, lost_of_tracks, lost_tags, mux, put, starts, tag_options

_ENCODER = {
    "h264": "libx264",
    "hevc": "libx265",
    "vp9": "libvpx-vp9",
    "av1": "libsvtav1",
    "ffv1": "ffv1",
    "prores": "prores_ks",
}
"""Encoders of the formats that are kept; others (MPEG-2, Motion JPEG, ...) become H.264."""

_FORMATS = {"libx264": "H.264", "libvpx-vp9": "VP9"}

_OPTIONS = {
    "libx264": {"crf": "18"},
    "libx265": {"crf": "20", "x265-params": "log-level=error"},
    "libvpx-vp9": {"crf": "24", "b": "0", "row-mt": "1"},
    "libsvtav1": {"crf": "25"},
}
"""Constant quality at which differences do not show."""

_OWN_TAGS = {"major_brand", "minor_version", "compatible_brands", "encoder", "duration"}
"""Tags that describe a file itself, not what it shows."""


_ALPHA_TAG = "alpha_mode"
"""Of Matroska's, which its own writer makes where there is transparency."""

_RGB, _MATRIX, _LIMITED, _FULL = 0, 1, 1, 2
"""FFmpeg's numbers for: no matrix, as of red, green and blue; that of BT.709; both ranges of values."""

_REORDER = ("libx264", "libx265")
"""Encoders whose packets are not in the order in which frames are shown."""

_TELL_RANGE = ("264", "265", "hevc", "vp9", "av1", "mjpeg")
"""Parts of the names of encoders whose pictures themselves tell the range of values."""

_PROFILES = {"Proxy": "0", "LT": "1", "Standard": "2", "HQ": "3", "4444": "4", "XQ": "5"}
"""Of ProRes: FFmpeg's names, and the encoder's numbers."""

_TAKES = {
    "mov": {"libx264", "libx265", "prores_ks"},
    "mpegts": {"libx264", "libx265"},
    "mxf": {"libx264", "prores_ks"},
}
"""Encoders for containers that do not tell FFmpeg which they take, or tell it wrong (VP9 in .mov)."""

_SUBSAMPLED = re.compile(r"yuvj?4(?:20|22|11|10)p(\d+le)?")


@dataclasses.dataclass(frozen=True)
class FirstFrame:
    """What the source's first frame tells of all.

    Attributes:
        orientation: how players turn and mirror the pictures: FFmpeg's nine fixed-point numbers, or None.
        side: what the frame carries besides, by FFmpeg's names.
    """

    orientation: list[int] | None
    side: dict[str, bytes]


class Picture(NamedTuple):
    """An encoded packet, with times in units of `time_base`."""

    content: bytes
    pts: int | None
    dts: int | None
    duration: int
    time_base: Fraction
    key: bool

    @classmethod
    def of(cls, packet: Any) -> "Picture":
        """A packet of an encoder's."""
        unit = Fraction(packet.time_base.numerator, packet.time_base.denominator)
        times = (packet.pts, packet.dts, packet.duration or 0, unit)
        return cls(bytes(packet), *times, bool(packet.is_keyframe))


class FrameWriter(contextlib.AbstractContextManager):
    """A video file that is being written; within ``with``, which finishes it.

    Args:
        path: where to write.
        named: the name that the file will have: its suffix tells the format.
        input_: the container to resemble, open for reading.
        video: its stream of pictures.
        first: the first frame that will be encoded.
        like: what the source's first frame tells.
        encoder: FFmpeg's name, or None for one of the source's format that the container takes.
        options: of the encoder, or None for those of `_OPTIONS`.
        along: what is copied besides.

    Attributes:
        kept, not_kept: names of what went over beside the pictures, and of what did not.

    Raises:
        ValueError: the container takes no such encoder or sound, or the encoder no such frames or options.
    """

    def __init__(
        self,
        path: Path,
        named: Path,
        input_: Any,
        video: Any,
        first: Any,
        like: FirstFrame,
        encoder: str | None,
        options: dict[str, str] | None,
        along: Carried,
    ):
        self.kept, self.not_kept = list(along.kept), list(along.not_kept)
        self._last: int | None = None
        self._moved = 0
        self._encodes = self._limits = False
        self._path, self._like, self._along = path, like, along.streams
        self._tags = {key: value for key, value in input_.metadata.items() if key.lower() not in _OWN_TAGS}
        container = CONTAINER[named.suffix.lower()]
        self._output = open_container(
            path, "w", format=container, container_options=tag_options(container, self._tags)
        )
        self._mux = functools.partial(mux, self._output, named)
        try:
            self._output.metadata.update(self._tags)
            name = encoder or self._encoder(video.codec_context.codec.canonical_name, named)
            self._stream = self._pictures(name, video, first, like, options, free=encoder is None)
            self._stream.set_display_matrix(like.orientation)
            with _blamed(name), _warnings() if options else contextlib.nullcontext([]) as warned:
                self._stream.codec_context.open(strict=False)
            if options:
                _refuse_unknown(name, options, self._stream.codec_context.options, warned)
            self._copies = put(self._output, along, named)
            starts(self._output, named, along.streams)
        except BaseException:
            with contextlib.suppress(Exception):
                self._output.close()
            raise

    def encode(self, frame: Any) -> None:
        """Write a frame, at its own time, or just after one that has the same time."""
        self._mux(self.encoded(frame))

    def encoded(self, frame: Any) -> list[Any]:
        """Packets that are ready once the encoder has a frame as well, or None at the end; not written."""
        self._encodes = frame is not None
        if frame is None:
            return self._stream.encode(None)
        frame = self._in_its_pixels(frame)
        if frame.pts is not None:
            if self._last is not None and frame.pts <= self._last:
                frame.pts = self._last + 1
                self._moved += 1
            self._last = frame.pts
        return self._stream.encode(frame)

    def _in_its_pixels(self, frame: Any) -> Any:
        """A frame in the encoder's pixel format, and red, green and blue by the matrix that is written."""
        wanted = self._stream.codec_context.pix_fmt
        if self._limits:
            return frame.reformat(format=wanted, src_color_range=_FULL, dst_color_range=_LIMITED)
        if frame.format.name == wanted:
            return frame
        if frame.format.is_rgb and not av.VideoFormat(wanted, 16, 16).is_rgb:
            return frame.reformat(format=wanted, dst_colorspace=_MATRIX, dst_color_range=_LIMITED)
        return frame.reformat(format=wanted)

    def put(self, picture: "Picture") -> None:
        """Write what another writer, with the same arguments, has encoded, after all before it."""
        packet = av.Packet(picture.content)
        packet.pts, packet.duration, packet.time_base = picture.pts, picture.duration, picture.time_base
        packet.dts = picture.dts
        if picture.dts is not None and self._last is not None and picture.dts <= self._last:
            packet.dts = self._last + 1  # before a cut an encoder looks less far back than after it
        self._last = packet.dts
        packet.is_keyframe, packet.stream = picture.key, self._stream
        self._mux(packet)

    def copy(self, packet: Any) -> None:
        """Write a packet of another of the source's streams as it is."""
        packet.stream = self._copies[packet.stream.index]
        self._mux(packet)

    def drop(self) -> None:
        """Let go of the file, which nobody reads."""
        with contextlib.suppress(Exception):
            self._output.close()

    def __exit__(self, kind, error, trace) -> None:
        """Finish the file; after an error, only let go of it."""
        if self._moved:
            self.not_kept.append(f"times of {self._moved} frames, which others had before them")
        try:
            if kind is None and self._encodes:
                self._mux(self.encoded(None))
        finally:
            with contextlib.nullcontext() if kind is None else contextlib.suppress(Exception):
                self._output.close()
        if kind is None:
            self.not_kept += [*lost_tags(self._path, self._tags), *lost_of_tracks(self._path, self._along)]
            if self._like.orientation is not None and _is_upright(self._path):
                self.not_kept.append("the orientation: players show it as it is stored")

    def _encoder(self, source: str, named: Path) -> str:
        """The first of the source's own encoder, H.264 and VP9 that the container takes."""
        takes = _TAKES.get(self._output.format.name) or self._output.supported_codecs
        name = next(
            name for name in (_ENCODER.get(source, "libx264"), "libx264", "libvpx-vp9") if name in takes
        )
        if name != _ENCODER.get(source):
            self.not_kept.append(
                f"the format {source}, which became {_FORMATS[name]} in a {named.suffix} file"
            )
        return name

    def _pictures(
        self,
        name: str,
        source: Any,
        first: Any,
        like: FirstFrame,
        options: dict[str, str] | None,
        *,
        free: bool,
    ) -> Any:
        """The stream to encode into, with the times and colours of the source."""
        rate = source.average_rate or source.guessed_rate or 25
        given = source.codec_context
        chosen = _options(name, given) if options is None else options
        if options is None and self._output.format.name in ("avi", "mxf") and name in _REORDER:
            chosen["bf"] = "0"  # they tell times in the order of packets
        chosen, kept, lost = with_hdr(name, chosen, like.side)
        self.kept += kept
        self.not_kept += lost
        with _blamed(name):
            stream: Any = self._output.add_stream(name, rate=rate, options=dict(chosen))
        context = stream.codec_context
        context.width, context.height = first.width, first.height
        wanted = first.format.name
        if free and name in ("libx264", "libx265") and (first.width % 2 or first.height % 2):
            wanted = _SUBSAMPLED.sub(r"yuv444p\1", wanted)
        context.pix_fmt = _encodable(context, wanted)
        if context.pix_fmt != first.format.name:
            self.not_kept.append(f"the pixel format {first.format.name}, which became {context.pix_fmt}")
        context.time_base = source.time_base
        for what in ("color_range", "color_primaries", "color_trc", "colorspace"):
            setattr(context, what, getattr(given, what))
        made = av.VideoFormat(context.pix_fmt, 16, 16)
        if made.is_rgb:
            context.colorspace, context.color_range = _RGB, _FULL
        elif first.format.is_rgb or given.colorspace == _RGB:
            context.colorspace = _MATRIX
            context.color_range = _LIMITED if first.format.is_rgb else given.color_range
        elif _is_grey(first.format) and not given.color_range:
            context.color_range = _FULL if _is_grey(made) else _LIMITED
        elif _is_full(first.format, given) and not _is_grey(made) and not self._tells_range(name):
            context.color_range, self._limits = _LIMITED, True
            self.not_kept.append("the full range of values, which became the limited one")
        if (_has_alpha(first.format) or _hides_alpha(source)) and not _has_alpha(made):
            self.not_kept.append("transparency")
        if source.sample_aspect_ratio:  # of the container or of the stream in it
            context.sample_aspect_ratio = source.sample_aspect_ratio
        if name == "libx265" and self._output.format.name in ("mp4", "mov"):
            context.codec_tag = "hvc1"  # the tag that Apple's players ask for
        tags = {k: v for k, v in source.metadata.items() if k.lower() not in (*_OWN_TAGS, _ALPHA_TAG)}
        stream.metadata.update(tags)
        stream.disposition = source.disposition
        return stream

    def _tells_range(self, encoder: str) -> bool:
        """Whether a file tells that its values have the full range: players take others for limited."""
        told = any(part in encoder for part in _TELL_RANGE)
        return told or (encoder == "ffv1" and self._output.format.name == "matroska")


def _refuse_unknown(
    encoder: str, options: dict[str, str], left: Mapping[str, str], warned: list[tuple[int, str, str]]
) -> None:
    """Refuse options that an open encoder has left, as FFmpeg passes over those that it does not know.

    What is within one option, as in ``x264-params``, the encoder reads itself; it warns, and goes on.
    """
    unused = ", ".join(repr(name) for name in options if name in left)
    within = [text.strip().rstrip(".") for _, _, text in warned if "option" in text.lower()]
    if unused or within:
        problem = f"which does not know {unused}" if unused else f"which says: {within[0]}"
        raise ValueError(
            f"Argument options must be those of the encoder {encoder}, {problem}: leave it out."
        )


_LEVEL = threading.Lock()
"""Held while FFmpeg's level of logging is another."""


@contextlib.contextmanager
def _warnings() -> Generator[list[tuple[int, str, str]], None, None]:
    """What FFmpeg warns of in this thread.

    One thread at a time: another would take the level that this one has set for the one to go back to. Then
    FFmpeg's threads would speak to Python for ever after, and wait for a thread that, while it closes a
    decoder, waits for them.
    """
    with _LEVEL:
        level = av.logging.get_level()
        av.logging.set_level(av.logging.WARNING)
        try:
            with av.logging.Capture() as warned:
                yield warned
        finally:
            av.logging.set_level(level)


def _options(name: str, source: Any) -> dict[str, str]:
    """Options of an encoder for a source, by default for quality at which differences do not show."""
    if name == "prores_ks" and source.name == "prores" and source.profile in _PROFILES:
        return {"profile": _PROFILES[source.profile]}
    return dict(_OPTIONS.get(name, {}))


def _has_alpha(pixels: Any) -> bool:
    """Whether a pixel format has transparency."""
    return any(component.is_alpha for component in pixels.components)


def _is_full(pixels: Any, source: Any) -> bool:
    """Whether values of YUV have the full range, as in JPEG."""
    return source.color_range == _FULL or pixels.name.startswith("yuvj")


def _is_grey(pixels: Any) -> bool:
    """Whether a pixel format is of grey alone, for which FFmpeg takes all values where no range is said."""
    return pixels.name.startswith("gray")


def _hides_alpha(source: Any) -> bool:
    """Whether a stream has transparency beside its packets, as VP9, which FFmpeg does not decode."""
    return {key.lower(): value for key, value in source.metadata.items()}.get(_ALPHA_TAG) == "1"


def first_frame(frame: Any, side: dict[str, bytes] | None) -> FirstFrame:
    """What a source's first frame tells of all."""
    return FirstFrame(display_matrix(frame), side or {})


def display_matrix(frame: Any) -> list[int] | None:
    """How players turn and mirror this frame: FFmpeg's nine fixed-point numbers; None if they do not."""
    matrix = (beside(frame) or {}).get(av.sidedata.sidedata.Type.DISPLAYMATRIX)
    return None if matrix is None else np.frombuffer(matrix, "<i4").tolist()


def _is_upright(path: Path) -> bool:
    """Whether a finished file has no orientation, where its source has."""
    with open_container(path) as made:
        frame = next(made.decode(video=0), None)
        return frame is not None and display_matrix(frame) is None


def _encodable(context: Any, name: str) -> str:
    """The pixel format, or the one nearest to it that the encoder knows."""
    known = [each.name for each in context.codec.video_formats or ()]
    if context.name == "libvpx-vp9":  # which FFmpeg says to know more formats with transparency
        known = [
            each for each in known if each == "yuva420p" or not _has_alpha(av.VideoFormat(each, 16, 16))
        ]
    if name in known or not known:
        return name
    has_alpha = name.startswith(("yuva", "gbra"))
    nearest, _ = av.codec.codec.find_best_pix_fmt_of_list(known, name, has_alpha=has_alpha)
    return nearest.name if nearest else "yuv420p"


@contextlib.contextmanager
def _blamed(encoder: str) -> Generator[None, None, None]:
    """Errors of an encoder that cannot be used, in a sentence."""
    try:
        yield
    except (ValueError, av.error.FFmpegError) as error:
        raise ValueError(
            f"Cannot encode with {encoder!r}: {error}. Choose another encoder, container, or even size."
        ) from error
