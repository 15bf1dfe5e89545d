"""Writing a video like a given one: its times, colours, orientation, tags and sound, other pictures."""

import contextlib
from collections.abc import Generator
from pathlib import Path
from typing import Any

import numpy as np

from .pyav import av

CONTAINER = {
    ".mp4": "mp4",
    ".m4v": "mp4",
    ".mov": "mov",
    ".mkv": "matroska",
    ".webm": "webm",
    ".avi": "avi",
    ".ts": "mpegts",
}
"""Suffixes of files that can be written, and FFmpeg's names of their formats."""

_ENCODER = {
    "h264": "libx264",
    "hevc": "libx265",
    "vp9": "libvpx-vp9",
    "av1": "libsvtav1",
    "ffv1": "ffv1",
    "prores": "prores_ks",
}
"""Encoders of the formats that are kept; others (MPEG-2, Motion JPEG, ...) become H.264."""

_OPTIONS = {
    "libx264": {"crf": "18"},
    "libx265": {"crf": "20", "x265-params": "log-level=error"},
    "libvpx-vp9": {"crf": "24", "b": "0", "row-mt": "1"},
    "libsvtav1": {"crf": "25"},
}
"""Constant quality at which differences do not show."""

_OWN_TAGS = {"major_brand", "minor_version", "compatible_brands", "encoder", "duration"}
"""Tags that describe a file itself, not what it shows."""


class FrameWriter(contextlib.AbstractContextManager):
    """A video file that is being written; within ``with``, which finishes it.

    Args:
        path: where to write.
        named: the name that the file will have: its suffix tells the format.
        input_: the container to resemble, open for reading.
        video: its stream of pictures.
        first: the first frame that will be encoded.
        encoder: FFmpeg's name, or None for one of the source's format that the container takes.
        options: of the encoder, or None for those of `_OPTIONS`.
        orientation: how to turn the pictures for display (`display_matrix`), or None.

    Raises:
        ValueError: the container takes no such encoder or sound, or the encoder no such frames.
    """

    def __init__(
        self,
        path: Path,
        named: Path,
        input_: Any,
        video: Any,
        first: Any,
        encoder: str | None,
        options: dict[str, str] | None,
        orientation: list[int] | None,
    ):
        self._output = av.open(
            str(path), "w", format=CONTAINER[named.suffix.lower()], metadata_errors="surrogateescape"
        )
        try:
            self._output.metadata.update(
                {key: value for key, value in input_.metadata.items() if key not in _OWN_TAGS}
            )
            name = encoder or self._encoder(video.codec_context.name)
            self._stream = self._pictures(name, video, first, options)
            self._stream.set_display_matrix(orientation)
            with _blamed(name):
                self._stream.codec_context.open(strict=False)
            self._sound = {stream.index: self._copied(stream, named) for stream in input_.streams.audio}
        except BaseException:
            self._output.close()
            raise

    def encode(self, frame: Any) -> None:
        """Write a frame, at its own time."""
        self._output.mux(self._stream.encode(frame))

    def copy(self, packet: Any) -> None:
        """Write a packet of the source's sound as it is."""
        packet.stream = self._sound[packet.stream.index]
        self._output.mux(packet)

    def __exit__(self, kind, error, trace) -> None:
        """Finish the file; after an error, only let go of it."""
        try:
            if kind is None:
                self._output.mux(self._stream.encode(None))
        finally:
            with contextlib.nullcontext() if kind is None else contextlib.suppress(Exception):
                self._output.close()

    def _encoder(self, source: str) -> str:
        """The first of the source's own encoder, H.264 and VP9 that the container takes."""
        wanted = (_ENCODER.get(source, "libx264"), "libx264", "libvpx-vp9")
        return next(name for name in wanted if name in self._output.supported_codecs)

    def _pictures(self, name: str, source: Any, first: Any, options: dict[str, str] | None) -> Any:
        """The stream to encode into, with the times and colours of the source."""
        rate = source.average_rate or source.guessed_rate or 25
        with _blamed(name):
            stream: Any = self._output.add_stream(
                name, rate=rate, options=dict(_OPTIONS.get(name, {}) if options is None else options)
            )
        context, given = stream.codec_context, source.codec_context
        context.width, context.height = first.width, first.height
        context.pix_fmt = _encodable(context, first.format.name)
        context.time_base = source.time_base
        for what in ("color_range", "color_primaries", "color_trc", "colorspace"):
            setattr(context, what, getattr(given, what))
        if given.sample_aspect_ratio:
            context.sample_aspect_ratio = given.sample_aspect_ratio
        if name == "libx265" and self._output.format.name in ("mp4", "mov"):
            context.codec_tag = "hvc1"  # the tag that Apple's players ask for
        stream.metadata.update({k: v for k, v in source.metadata.items() if k.lower() not in _OWN_TAGS})
        return stream

    def _copied(self, source: Any, named: Path) -> Any:
        try:
            stream = self._output.add_stream_from_template(source)
        except ValueError as error:
            raise ValueError(
                f"Cannot keep the sound, {source.codec_context.name}, in a {named.suffix} file. Choose the "
                f"suffix of the source, or .mkv."
            ) from error
        stream.metadata.update(source.metadata)
        return stream


def display_matrix(frame: Any) -> list[int] | None:
    """How players turn and mirror this frame: FFmpeg's nine fixed-point numbers; None if they do not."""
    matrix = frame.side_data.get(av.sidedata.sidedata.Type.DISPLAYMATRIX)
    return None if matrix is None else np.frombuffer(matrix, "<i4").tolist()


def _encodable(context: Any, name: str) -> str:
    """The pixel format, or the one nearest to it that the encoder knows."""
    known = [each.name for each in context.codec.video_formats or ()]
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
