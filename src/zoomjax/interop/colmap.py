"""COLMAP's cameras.txt: a camera for each focal length or frame.

FULL_OPENCV, the rational model; for a division model of one term SIMPLE_DIVISION (COLMAP 4), which is ours.
Principal points count from the corner of the top-left pixel, half a pixel more than ours.
"""

import dataclasses

import numpy as np

from ..models.division import Division
from ..models.lens import ZoomLens
from ._documents import lines_of
from ._forms import Form
from ._pinhole import Pinhole, contents, focal_px, formula, node_of, pinhole
from .base import Contents, Export, Import, Node, NodeFormat, one_size

_ORDER = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "SIMPLE_DIVISION": "f cx cy k1",
    "DIVISION": "fx fy cx cy k1",
}
"""Of the parameters of COLMAP's camera models that are read."""


class COLMAP(NodeFormat):
    """COLMAP's list of cameras."""

    name, tools, suffixes = "colmap", "COLMAP, GLOMAP, gsplat", (".txt",)
    zoom = "list"
    exact_for = "division"

    def forms(self, lens: ZoomLens):
        """One term of division, which is ours, or rational, three over three."""
        one_term = isinstance(lens.distortion_model, Division) and len(_at_some(lens)) == 1
        return (Form(0, 1, corrects=True),) if one_term else (formula(lens, 3, 3),)

    def text(self, nodes: list[Node], job: Export) -> str:
        """A line for each camera, numbered from 1."""
        width, height = job.lens.image_size
        lines = [
            "# Camera list with one line of data per camera:",
            "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]",
        ]
        for number, node in enumerate(nodes, start=1):
            camera = pinhole(node, job)
            cx, cy = (camera.centre + 0.5).tolist()
            if node.form.corrects:
                model, values = "SIMPLE_DIVISION", [camera.f, cx, cy, float(camera.k[0])]
            else:
                model, values = "FULL_OPENCV", [camera.f, camera.f, cx, cy, *camera.coefficients]
            lines.append(" ".join(map(str, (number, model, width, height, *map(repr, values)))))
        return "\n".join([*lines, ""])

    def recognises(self, head: str) -> bool:
        """By the names of its models."""
        return any(f" {model} " in head for model in _ORDER)

    def read(self, job: Import) -> Contents:
        """All cameras, of one image size."""
        nodes, sizes = [], []
        lines, notes = lines_of(job.paths[0])
        for line in lines:
            if not line.strip() or line.lstrip().startswith("#"):
                continue
            _, model, width, height, *words = line.split()
            if model not in _ORDER:
                raise ValueError(f"its camera model {model} is not one of {', '.join(_ORDER)}")
            names = _ORDER[model].split()
            if len(words) != len(names):
                raise ValueError(
                    f"its camera model {model} has {len(names)} parameters, but a line has {len(words)}: "
                    "it may be cut off"
                )
            values = dict(zip(names, map(float, words), strict=True))
            size = job.size((width, height))
            nodes.append(_node(model, values, size))
            sizes.append(size)
        found = contents(nodes, one_size(sizes), job)
        return dataclasses.replace(found, notes=(*found.notes, *notes))


def _at_some(lens: ZoomLens) -> np.ndarray:
    return np.asarray(lens(float(np.asarray(lens.focal_range)[0])).coefficients)


def _node(model: str, values: dict[str, float], size: tuple[int, int]) -> Node:
    f, stretch = focal_px(values.get("fx", values.get("f")), values.get("fy", values.get("f")))
    centre = np.array([values["cx"], values["cy"]]) - 0.5
    k = np.array([values.get(f"k{i}", 0.0) for i in range(1, 7)])
    if not model.endswith("DIVISION"):
        p = np.array([values.get(name, 0.0) for name in ("p1", "p2")])
        return node_of(Pinhole(f, f, centre, k, p, stretch), size)
    form = Form(0, 1, corrects=True)
    return Node(f, form, form.rescaled(k[:1], np.hypot(*size) / 2 / f), centre, stretch=stretch)
