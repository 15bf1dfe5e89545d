"""Kalibr's camera chain YAML: pinhole with radtan, k1 k2 p1 p2, one focal length a file."""

import dataclasses

import numpy as np

from .._core.text import plain
from ._documents import load_yaml
from ._pinhole import contents, formula, from_opencv, numbers, pinhole
from .base import Contents, Export, Import, Node, NodeFormat, one_size


class Kalibr(NodeFormat):
    """Kalibr's camchain: two radial coefficients and decentering."""

    name, tools, suffixes = "kalibr", "Kalibr, VINS, OpenVINS, Basalt", (".yaml", ".yml")

    def forms(self, lens):
        """Two terms."""
        return (formula(lens, 2),)

    def text(self, nodes: list[Node], job: Export) -> str:
        """One camera."""
        camera = pinhole(nodes[0], job)
        width, height = job.lens.image_size
        return "\n".join(
            [
                "cam0:",
                "  camera_model: pinhole",
                f"  intrinsics: [{numbers([camera.f, camera.f, *camera.centre])}]",
                "  distortion_model: radtan",
                f"  distortion_coeffs: [{numbers(camera.coefficients)}]",
                f"  resolution: [{width}, {height}]",
                "",
            ]
        )

    def recognises(self, head: str) -> bool:
        """By the name of its coefficients."""
        return "distortion_coeffs" in head and "intrinsics" in head

    def read(self, job: Import) -> Contents:
        """The first camera of each file."""
        nodes, sizes, others = [], [], set()
        for path in job.paths:
            chain = load_yaml(path)
            camera = chain["cam0"]
            others |= {plain(str(name)) for name in chain} - {"cam0"}
            if (camera["camera_model"], camera["distortion_model"]) != ("pinhole", "radtan"):
                raise ValueError("its first camera is not pinhole with radtan")
            width, height = camera["resolution"]
            fx, fy, cx, cy = camera["intrinsics"]
            size = job.size((width, height))
            matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], float)
            nodes.append(from_opencv(None, matrix, camera["distortion_coeffs"], size))
            sizes.append(size)
        found = contents(nodes, one_size(sizes), job)
        note = (f"cam0 is read, and {', '.join(sorted(others))} is not.",) * bool(others)
        return dataclasses.replace(found, notes=(*found.notes, *note))
