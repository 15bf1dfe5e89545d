"""mrcal's .cameramodel: LENSMODEL_OPENCV8, one focal length a file."""

import ast

import numpy as np

from ..models.registry import once
from ._pinhole import contents, formula, from_opencv, numbers, pinhole
from .base import Contents, Export, Import, Node, NodeFormat, one_size, read_text

_COEFFICIENTS = {
    "LENSMODEL_PINHOLE": 0,
    "LENSMODEL_OPENCV4": 4,
    "LENSMODEL_OPENCV5": 5,
    "LENSMODEL_OPENCV8": 8,
}


class Mrcal(NodeFormat):
    """mrcal's camera model with OpenCV's coefficients."""

    name, tools, suffixes = "mrcal", "mrcal", (".cameramodel",)

    def forms(self, lens):
        """Rational, three over three."""
        return (formula(lens, 3, 3),)

    def text(self, nodes: list[Node], job: Export) -> str:
        """One camera at the origin."""
        camera = pinhole(nodes[0], job)
        width, height = job.lens.image_size
        intrinsics = numbers([camera.f, camera.f, *camera.centre, *camera.coefficients])
        return "\n".join(
            [
                "{",
                "    'lensmodel':  'LENSMODEL_OPENCV8',",
                f"    'intrinsics': [ {intrinsics} ],",
                "    'extrinsics': [ 0., 0., 0., 0., 0., 0. ],",
                f"    'imagersize': [ {width}, {height} ]",
                "}",
                "",
            ]
        )

    def recognises(self, head: str) -> bool:
        """By the name of its model."""
        return "lensmodel" in head

    def read(self, job: Import) -> Contents:
        """Plain values of Python, and no code."""
        nodes, sizes = [], []
        for path in job.paths:
            table = _values(read_text(path))
            model = table["lensmodel"]
            if model not in _COEFFICIENTS:
                raise ValueError(f"its lens model {model!r} is not one of {', '.join(_COEFFICIENTS)}")
            width, height = table["imagersize"]
            size = job.size((width, height))
            fx, fy, cx, cy, *k = table["intrinsics"]
            if len(k) != _COEFFICIENTS[model]:
                raise ValueError(f"it has {len(k)} coefficients, and {model} has {_COEFFICIENTS[model]}")
            matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], float)
            nodes.append(from_opencv(None, matrix, k, size))
            sizes.append(size)
        return contents(nodes, one_size(sizes), job)


def _values(text: str) -> dict:
    """Plain values of Python, no name of which is given twice."""
    tree = ast.parse(text.strip(), mode="eval")
    for node in ast.walk(tree):
        if isinstance(node, ast.Dict):
            once([(str(key.value), None) for key in node.keys if isinstance(key, ast.Constant)])
    return ast.literal_eval(tree)
