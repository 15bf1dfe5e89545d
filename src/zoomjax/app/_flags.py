"""Translation of the library's messages for the command line: ``argument hold`` becomes ``--hold``."""

import re
from collections.abc import Collection, Sequence
from typing import Any

from .._core.copies import by_url

FLAGS = {
    name: f"--{name.replace('_', '-')}"
    for name in (
        *(
            "again",
            "border",
            "centre",
            "cluster",
            "convention",
            "crop",
            "degree",
            "detector",
            "distortion_model",
            "direction",
            "focal",
            "focal_sigma",
        ),
        *("focal_unit", "hold", "image_size", "interpolation", "keep", "lens", "model", "name"),
        *("overwrite", "pixel_pitch", "shared_focal", "terms", "tolerance"),
    )
} | {"format": "--to", "track": "--focal", "target": "--output"}
"""Options of the command line by the names of the library's arguments."""

# Within a message, a capital letter marks the content of a file: "Cannot read a.npz: Argument focal ..."
_ARGUMENT = re.compile(rf"(?:\AA|\ba)rgument ({'|'.join(FLAGS)})\b")


_OTHER_WAY = re.compile(rf",? or [^.,;:()]*\(argument ({'|'.join(FLAGS)})\)")
"""As in: Give a longer track, or hold its ends (argument hold)."""


def with_flags(message: str, options: Collection[str] | None = None) -> str:
    """A message of the library with the command line's names for arguments, and URLs for copies of files.

    Of the command's `options`, where they are known, for which it leaves out other ways by options that the
    command does not have.
    """
    if options is not None:
        message = _OTHER_WAY.sub(lambda way: way[0] if FLAGS[way[1]] in options else "", message)
    return by_url(_ARGUMENT.sub(lambda found: FLAGS[found[1]], message))


def options_of(command: Any, words: Sequence[str]) -> set[str] | None:
    """The options of the command that the words name, such as ``["calibrate", "photos"]``; None if none."""
    named = next((word for word in words if word in command.commands), None)
    if named is None:
        return None
    return {option for parameter in command.commands[named].params for option in parameter.opts}
