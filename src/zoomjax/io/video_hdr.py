"""Metadata of high dynamic range: the display that a film was mastered on, and how bright it gets.

Read from the first frame, and given to the encoder, which writes them into the stream.
"""

import struct
from collections.abc import Mapping
from typing import Any

_MASTERING, _LIGHT = "MASTERING_DISPLAY_METADATA", "CONTENT_LIGHT_LEVEL"
_UNREAD = "UNREAD"

_OTHERS = {
    "DYNAMIC_HDR_PLUS": "HDR10+ metadata",
    "DYNAMIC_HDR_VIVID": "HDR Vivid metadata",
    "DOVI_METADATA": "Dolby Vision metadata",
    "DOVI_RPU_BUFFER": "Dolby Vision metadata",
    "A53_CC": "closed captions",
    "AMBIENT_VIEWING_ENVIRONMENT": "the ambient viewing environment",
    "ICC_PROFILE": "the colour profile",
    "SPHERICAL": "the spherical projection",
    "STEREO3D": "the stereoscopic arrangement",
    _UNREAD: "what its pictures hold beside the pixels",
}
"""What frames carry that an encoder gets no sight of, and how messages call it."""

_PARAMETERS = {"libx265": "x265-params", "libx264": "x264-params", "libsvtav1": "svtav1-params"}
"""Options of the encoders that write these metadata."""


def beside(frame: Any) -> Any:
    """What a frame tells beside the pixels; None if PyAV has no name for a part of it, and reads nothing.

    Raises:
        ValueError: so it is, and players turn the pictures.
    """
    try:
        return frame.side_data
    except ValueError as error:  # "31 is not a valid Type": EXIF data of TIFF pictures, in PyAV 18
        if getattr(frame, "rotation", 0) == 0:
            return None
        raise ValueError(
            "Players turn this video, and PyAV cannot read how: its pictures hold data that are new to it. "
            "Give them another format first: ffmpeg -noautorotate -i SOURCE -c:v ffv1 -c:a copy NEW.mkv."
        ) from error


def side_data(frame: Any, context: Any) -> dict[str, bytes]:
    """What a frame and its decoder tell beside the pixels, by FFmpeg's names."""
    found = {kind.name: bytes(value) for kind, value in getattr(context, "decoded_side_data", {}).items()}
    if (own := beside(frame)) is None:  # newer FFmpegs have told some things already
        return found | {_UNREAD: b""}
    return found | {item.type.name: bytes(item) for item in (own[index] for index in range(len(own)))}


def with_hdr(
    encoder: str, options: Mapping[str, str], side: Mapping[str, bytes]
) -> tuple[dict[str, str], list[str], list[str]]:
    """Options of an encoder that writes the metadata; names of what is kept, and of what is not."""
    parts, kept, lost = [], [], []
    for name, what, make in (
        (_MASTERING, "the mastering display", _mastering),
        (_LIGHT, "the content light level", _light),
    ):
        if name in side:
            parameter = make(encoder, side[name]) if encoder in _PARAMETERS else None
            parts += [parameter] if parameter else []
            (kept if parameter else lost).append(what)
    lost += dict.fromkeys(name for key, name in _OTHERS.items() if key in side)
    options = dict(options)
    if parts:
        own = options.get(_PARAMETERS[encoder])
        options[_PARAMETERS[encoder]] = ":".join([*([own] if own else []), *parts])
    return options, kept, lost


def _mastering(encoder: str, block: bytes) -> str | None:
    """A parameter with the primaries, the white point and the luminance of the display."""
    numbers = struct.unpack_from("<22i", block)
    if not all(numbers[20:]) or not all(numbers[1:20:2]):
        return None  # half of it is not told
    red, green, blue, white = (numbers[at : at + 4] for at in (0, 4, 8, 12))
    darkest, brightest = numbers[16:18], numbers[18:20]
    if encoder == "libsvtav1":

        def point(x: int, over_x: int, y: int, over_y: int) -> str:
            return f"({x / over_x:.5f},{y / over_y:.5f})"

        light = f"L({brightest[0] / brightest[1]:.4f},{darkest[0] / darkest[1]:.4f})"
        key = "mastering-display"
    else:  # in units of 0.00002, and 0.0001 cd/m²

        def point(x: int, over_x: int, y: int, over_y: int) -> str:
            return f"({round(50_000 * x / over_x)},{round(50_000 * y / over_y)})"

        units = [round(10_000 * value / over) for value, over in (brightest, darkest)]
        light = f"L({units[0]},{units[1]})"
        key = "master-display" if encoder == "libx265" else "mastering-display"
    return f"{key}=G{point(*green)}B{point(*blue)}R{point(*red)}WP{point(*white)}{light}"


def _light(encoder: str, block: bytes) -> str:
    brightest, average = struct.unpack_from("<2I", block)
    key = {"libx265": "max-cll", "libx264": "cll"}.get(encoder, "content-light")
    return f"{key}={brightest},{average}"
