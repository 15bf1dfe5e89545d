"""What happened while a video was read, and what should have: files that were cut off lack frames."""

import dataclasses
import math
import os
import struct
from typing import Any

from .pyav import av

_NOT_A_FIELD = 0.75
"""Steps after the last frame at which there was another one: fields of a frame are half a step apart."""

_SURE = 0.02
"""Share of a length by which what a file tells may be wrong, beside one frame."""

_TELL_A_LENGTH = ("matroska,webm", "flv", "asf")
"""Formats whose headers tell that of all streams, which FFmpeg guesses of others."""


@dataclasses.dataclass
class Report:
    """What happened on the way, in threads.

    Attributes:
        announced: frames that the file announces; 0 if it does not.
        written: those that were.
        skipped: those before the first that can be decoded alone.
        corrupt: those that are damaged; and of these
        failed: those that did not decode.
        left: those with a step in an AVI file and no picture.
        torn: whether packets were lost.
        error: what the decoder said.
        side: what the first frame carries.
        first: the first frame.
        last: number and time of the last one, s.
        streams: how many streams were read.
        end: where their packets end, s.
        reached: where those of pictures end, s.
        last_packet: when the last of these is shown, s.
        last_frame: when the last frame that was decoded is, s.
    """

    announced: int
    written: int = 0
    skipped: int = 0
    corrupt: int = 0
    failed: int = 0
    left: int = 0
    torn: bool = False
    error: str = ""
    side: dict[str, bytes] | None = None
    first: Any = None
    last: tuple[int, float] = (-1, math.nan)
    streams: int = 1
    end: float = 0.0
    reached: float = 0.0
    last_packet: float = -math.inf
    last_frame: float = -math.inf

    def note(self, packet: Any, *, pictures: bool) -> None:
        """Learn where a packet ends, one of pictures or of another stream."""
        if packet.pts is None:
            return
        end = float((packet.pts + (packet.duration or 0)) * packet.time_base)
        self.end = max(self.end, end)
        if pictures:
            self.reached = max(self.reached, end)
            if not packet.is_discard:
                self.last_packet = max(self.last_packet, float(packet.pts * packet.time_base))


def is_avi(input_: Any) -> bool:
    """Whether a container is an AVI file."""
    return input_.format.name == "avi"


def frames_reached(report: Report) -> int:
    """How many frames there are up to the last that was decoded, with those that were not."""
    return report.last[0] + 1 + report.skipped


def frames_expected(source: str | os.PathLike[str], input_: Any, video: Any, report: Report) -> int:
    """How many frames a file that was read to its end should hold, as far as it tells.

    AVI also counts chunks without content, which show the last frame again; an index of fewer frames than
    there are is damaged. Other files tell a length in seconds, or only that their parts were longer.
    """
    rate = float(video.average_rate or video.guessed_rate or 25)
    seen = max(report.written, frames_reached(report)) + report.left
    if report.announced:
        announced = video.frames if is_avi(input_) and report.announced < seen else report.announced
        whole = is_avi(input_) and round(report.reached * rate) >= announced
        return seen if whole else announced
    after = (report.last_packet - report.last_frame) * rate
    if after > _NOT_A_FIELD and math.isfinite(after):
        seen += round(after)
    missing = _seconds_missing(input_, video, report) * rate
    sure = 0.5 if is_cut_off(source, input_.format.name) else 1 + _SURE * report.reached * rate
    return seen + round(missing) if missing > sure else seen


def lost_frames(source: str | os.PathLike[str], input_: Any, video: Any, report: Report) -> tuple[int, str]:
    """How many frames of a file that was read to its end are lost, and what to say of it; else empty."""
    report.announced, name = frames_expected(source, input_, video, report), os.fspath(source)
    lost = max(report.corrupt + report.skipped, report.announced - report.written)
    if lost > report.skipped:
        at_end = frames_reached(report) < report.announced and not report.left
        why = "the file ends early, or is damaged at its end" if at_end else "their data are damaged"
        later = ", and those after them count as earlier ones" if report.left else ""
        return lost, (
            f"{lost} of {max(report.announced, report.written)} frames of {name} cannot be decoded "
            f"({report.error or why}): {report.written} were written{later}."
        )
    cut_off = (
        f"{name} is cut off at its end: {report.written} frames were written, and sound or further frames "
        "may be missing."
    )
    return lost, cut_off * is_cut_off(source, input_.format.name)


def _seconds_missing(input_: Any, video: Any, report: Report) -> float:
    """How much shorter what was read is than the file tells; 0 where it does not.

    The length of all is that of the longest stream: what was read of all tells how much of that is missing.
    """
    kind, told = input_.format.name, video.metadata.get("DURATION")
    try:
        hours, minutes, seconds = (float(part) for part in told.split(":"))
        return 3600 * hours + 60 * minutes + seconds - report.reached
    except (AttributeError, ValueError):
        pass
    if kind == "mxf" and video.duration:
        return float(video.duration * video.time_base) - report.reached
    if kind in _TELL_A_LENGTH and report.streams == len(input_.streams):
        return (input_.duration or 0) / av.time_base - report.end
    return 0.0


def is_cut_off(source: str | os.PathLike[str], kind: str) -> bool:
    """Whether the last part of a file of FFmpeg's format, as their sizes tell, ends beyond the file."""
    length, place = os.path.getsize(source), 0
    with open(source, "rb") as file:
        while place + 8 <= length:
            file.seek(place)
            if (size := _SIZES.get(kind, _unknown)(file.read(16))) is None:
                break
            place += size
    return place > length + 1 or (kind == "avi" and place == 0)


def _unknown(head: bytes) -> int | None:
    return None


def _of_chunk(head: bytes) -> int | None:
    """Bytes of a part of a RIFF file, from its first ones; None where they tell none."""
    name, size = struct.unpack("<4sI", head[:8])
    return 8 + size + size % 2 if name == b"RIFF" else None


def _of_box(head: bytes) -> int | None:
    """Bytes of a box of MP4, also where it says that they are in 64 bits; None if it goes to the end."""
    size, name = struct.unpack(">I4s", head[:8])
    if size == 1 and len(head) == 16:
        size = int.from_bytes(head[8:])
    return size if size >= 8 and name.isalnum() else None


def _of_element(head: bytes) -> int | None:
    """Bytes of an element of Matroska; None if they were not known when it was written."""
    if head[:4] not in (b"\x1a\x45\xdf\xa3", b"\x18\x53\x80\x67"):  # of the head and of all the rest
        return None
    number = 9 - head[4].bit_length()  # bytes of the size
    size = int.from_bytes(head[4 : 4 + number]) & ((1 << 7 * number) - 1)
    return None if number > 8 or size == (1 << 7 * number) - 1 else 4 + number + size


_SIZES = {
    "avi": _of_chunk,
    "mov,mp4,m4a,3gp,3g2,mj2": _of_box,
    "matroska,webm": _of_element,
}
"""How sizes of parts are read."""
