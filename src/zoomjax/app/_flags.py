"""How the command line calls what messages of the library name: ``argument hold`` is ``--hold`` there."""

import re

FLAGS = {
    name: f"--{name.replace('_', '-')}"
    for name in (
        *("border", "degree", "detector", "focal", "focal_sigma", "focal_unit", "hold", "interpolation"),
        *("keep", "overwrite", "terms"),
    )
}
"""Options by the arguments of the library that they become."""

# A capital within a message is about what is in a file: "Cannot read a.npz: Argument focal ..."
_ARGUMENT = re.compile(rf"(?:\AA|\ba)rgument ({'|'.join(FLAGS)})\b")


def with_flags(message: str) -> str:
    """A message of the library in which arguments have the names that they have on the command line."""
    return _ARGUMENT.sub(lambda found: FLAGS[found[1]], message)
