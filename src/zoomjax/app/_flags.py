"""Translation of the library's messages for the command line: ``argument hold`` becomes ``--hold``."""

import re

FLAGS = {
    name: f"--{name.replace('_', '-')}"
    for name in (
        *(
            "again",
            "border",
            "centre",
            "convention",
            "crop",
            "degree",
            "detector",
            "family",
            "direction",
            "focal",
            "focal_sigma",
        ),
        *("focal_unit", "hold", "image_size", "interpolation", "keep", "lens", "model", "name"),
        *("overwrite", "pixel_pitch", "shared_focal", "terms", "tolerance"),
    )
} | {"format": "--to", "track": "--focal"}
"""Options of the command line by the names of the library's arguments."""

# Within a message, a capital letter marks the content of a file: "Cannot read a.npz: Argument focal ..."
_ARGUMENT = re.compile(rf"(?:\AA|\ba)rgument ({'|'.join(FLAGS)})\b")


def with_flags(message: str) -> str:
    """A message of the library with the command line's names for arguments."""
    return _ARGUMENT.sub(lambda found: FLAGS[found[1]], message)
