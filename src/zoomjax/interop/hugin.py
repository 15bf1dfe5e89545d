"""Hugin's projects: an image line with lens parameters for each focal length or frame.

    r_d = r (a r³ + b r² + c r + 1 - a - b - c)

from corrected radii r to distorted ones, in units of half the short side. The factor is 1 at r = 1, and the
corrected image is scaled for that: the field of view v is that of the scaled one, so that rays are right.
A lens that is read has the focal length by which its rays are those of the file, whatever slope the fit of
its formula has at the centre.
d and e are the centre, px from the middle of the image.
"""

import math
import re

import numpy as np

from ..models.registry import once
from ._pinhole import contents
from .base import Contents, Export, Import, Node, NodeFormat, one_size, read_text
from .lensfun import PtLens, of_unit_slope, radius_of_one

_FORM = PtLens()
_NONE = ("g", "t")
"""Shear, which zoomjax has no model of."""

_WORD = re.compile(r"([A-Za-z]+)(=?)(\"[^\"]*\"|[-+.\d]\S*|(?:nan|inf)\b)")
"""A name and its value, which may be none of a number, or = and the number of the image that has it."""


class Hugin(NodeFormat):
    """Image lines of a Hugin project."""

    name, tools, suffixes = "hugin", "Hugin, panotools", (".pto",)
    zoom = "list"
    note = "Apply the project to one with as many photos as a template, or copy v, a, b, c, d and e."

    def forms(self, lens):
        """ptlens, as in lensfun."""
        return (_FORM,)

    def text(self, nodes: list[Node], job: Export) -> str:
        """A project of an image for each focal length."""
        width, height = job.lens.image_size
        lines = [_line(node, stem, job) for node, stem in zip(nodes, job.stems, strict=True)]
        return "\n".join(["# hugin project file", f"p f0 w{width} h{height} v50", *lines, ""])

    def recognises(self, head: str) -> bool:
        """By a line of a panorama."""
        return re.search(r"^p f\d", head, re.MULTILINE) is not None

    def read(self, job: Import) -> Contents:
        """All images, of one size; focal lengths in px, by their fields of view."""
        lines = [line for line in read_text(job.paths[0]).splitlines() if line.startswith("i ")]
        images: list[dict[str, str]] = []
        for line in lines:
            words = _WORD.findall(line[2:])
            if not any(name == "n" for name, _, _ in words):
                raise ValueError("an image line has no name, n, as where the file was cut off")
            images.append(
                once([(name, images[int(value)][name] if same else value) for name, same, value in words])
            )
        sizes = [job.size((words["w"], words["h"])) for words in images]
        nodes = [_node(words, size) for words, size in zip(images, sizes, strict=True)]
        return contents(nodes, one_size(sizes), job)


def _line(node: Node, stem: str, job: Export) -> str:
    width, height = size = job.lens.image_size
    factors = node.form.rescaled(node.theta, min(size) / 2 / job.lens.scale)
    one = radius_of_one(factors)
    _, c, b, a = factors * one ** np.arange(1, 5)
    view = 2 * math.degrees(math.atan(width / 2 / (float(job.focal_px(node.focal)) / one)))
    d, e = node.centre - (np.array(size) - 1) / 2
    values = " ".join(
        f"{name}{float(value)!r}" for name, value in zip("vabcde", (view, a, b, c, d, e), strict=True)
    )
    return f'i w{width} h{height} f0 r0 p0 y0 {values} g0 t0 n"{stem}.jpg"'


def _node(words: dict[str, str], size: tuple[int, int]) -> Node:
    if int(words["f"]) != 0:
        raise ValueError(f"its projection is number {int(words['f'])}, and only 0, rectilinear, is read")
    if any(float(words.get(name, 0)) for name in _NONE):
        raise ValueError("it has shear (g or t), which zoomjax has no model of")
    view, a, b, c, d, e = (float(words.get(name, 0)) for name in "vabcde")
    if not 0 < view < 180:
        raise ValueError(f"its field of view must be between 0 and 180 degrees, but it is {view:g}")
    factors = np.array([1 - a - b - c, c, b, a])
    focal = size[0] / 2 / math.tan(math.radians(view) / 2) * factors[0]
    theta = _FORM.rescaled(of_unit_slope(factors), math.hypot(*size) / min(size))
    return Node(focal, _FORM, theta, (np.array(size) - 1) / 2 + [d, e], focal_px=focal)
