"""PFTrack's .pfb (PFBarrel): two coefficients in keys over the frames of a track.

``x_u = x (1 + C3 r² + C5 r⁴)`` with the diagonal over the square root of 2 for radius 1. The centre is a
fraction of the image's size, y up, counted from pixel centres. Without a track the focal lengths are frames
1, 2, ....
"""

import numpy as np

from ._documents import lines_of
from ._forms import Form
from .base import IN_PX, Contents, Export, Import, Node, NodeFormat, refuse_others

_FORM = Form(2, corrects=True)
_UNIT = np.sqrt(2)
"""Half diagonals that are radius 1."""

_HEADER = "#PFBarrel 2011 v2"


class PFTrack(NodeFormat):
    """PFTrack's lens distortion with keys."""

    name, tools, suffixes = "pftrack", "PFTrack, Natron", (".pfb",)
    exact, zoom = True, "list"

    def forms(self, lens):
        """Two terms from distorted to corrected points."""
        return (_FORM,)

    def text(self, nodes: list[Node], job: Export) -> str:
        """One value a line."""
        width, height = job.lens.image_size
        lines = [_HEADER, width, height, 1, width, height, "High Order", 1, len(nodes)]
        for number, node in enumerate(nodes, start=1):
            keys = _FORM.rescaled(node.theta, _UNIT).tolist()
            x, up = float(node.centre[0]) / width, float(height - 1 - node.centre[1]) / height
            lines += [number if node.frame is None else node.frame, *map(repr, [*keys, x, up])]
        return "\n".join(map(str, [*lines, ""]))

    def recognises(self, head: str) -> bool:
        """By its first line."""
        return head.startswith("#PFBarrel")

    def read(self, job: Import) -> Contents:
        """All keys; focal lengths are those of argument focal, one for each."""
        told, notes = lines_of(job.paths[0])
        lines = [line.strip() for line in told if line.strip() and not line.startswith("#")]
        width, height, aspect = int(lines[0]), int(lines[1]), float(lines[2])
        told = {"pixel aspect": aspect, "model": lines[5], "squeeze": float(lines[6])}
        refuse_others(told, {"pixel aspect": 1, "model": "High Order", "squeeze": 1})
        number = int(lines[7])
        if job.focal is None or len(job.focal) != number:
            raise ValueError(f"it holds no focal lengths: give argument focal, {number} of them{IN_PX}")
        if (more := len(lines) - 8) != 5 * number:
            raise ValueError(f"its {number} keys have five lines each, but there are {more} lines of keys")
        values = np.array(lines[8:], float).reshape(number, 5)
        size = job.size((width, height))
        nodes = [
            Node(
                focal,
                _FORM,
                _FORM.rescaled(row[1:3], 1 / _UNIT),
                np.array([row[3] * width, height - 1 - row[4] * height]),
            )
            for focal, row in zip(job.focal, values, strict=True)
        ]
        return Contents(tuple(nodes), size, job.focal_unit, notes)
