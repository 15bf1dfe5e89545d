"""OpenCV's files of ``cv2.FileStorage``, YAML, XML or JSON by their names: one focal length each.

The rational model with eight coefficients, which follows an inverse polynomial best. `cv2.projectPoints`
and `cv2.initUndistortRectifyMap` then do as the lens; `cv2.undistortPoints` stops after five iterations.
"""

import re

import numpy as np

from ._documents import load_opencv
from ._pinhole import contents, data_of, formula, from_opencv, matrix_rows, pinhole, refuse_other_focals
from .base import Contents, Export, Import, Node, NodeFormat, one_size, refuse_others


class OpenCV(NodeFormat):
    """OpenCV's calibration: camera_matrix and distortion_coefficients."""

    name, tools, suffixes = "opencv", "OpenCV", (".yaml", ".yml", ".xml", ".json")

    def forms(self, lens):
        """Rational, three over three."""
        return (formula(lens, 3, 3),)

    def text(self, nodes: list[Node], job: Export) -> str:
        """One camera."""
        import cv2

        camera = pinhole(nodes[0], job)
        width, height = job.lens.image_size
        suffix = job.suffix if job.suffix in self.suffixes else self.suffixes[0]
        file = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
        file.write("image_width", width)
        file.write("image_height", height)
        file.write("focal_length", camera.focal)
        file.write("focal_unit", job.lens.focal_unit)
        file.write("camera_matrix", np.array(matrix_rows(camera)))
        file.write("distortion_coefficients", np.array([camera.coefficients]))
        # Until its version 5 OpenCV wrote YAML with this first line, and all versions read it.
        return re.sub(r"\A%YAML 1\.\d", "%YAML:1.0", file.releaseAndGetString())

    def recognises(self, head: str) -> bool:
        """By the type of its matrices."""
        return "opencv-matrix" in head

    def read(self, job: Import) -> Contents:
        """One file or several; focal lengths in px, or in the unit that zoomjax wrote beside them."""
        nodes, sizes, px, units = [], [], [], set()
        for path in job.paths:
            table = load_opencv(path)
            refuse_others(table, {"fisheye_model": 0})
            size = job.size(
                (table["image_width"], table["image_height"]) if "image_width" in table else None
            )
            mm = table.get("focal_unit") == "mm"
            coefficients = table.get("distortion_coefficients", table.get("dist_coeffs"))
            focal = float(table["focal_length"]) if mm else None
            matrix = data_of(table["camera_matrix"])
            nodes.append(from_opencv(focal, matrix, data_of(coefficients), size))
            px.append(float(np.ravel(matrix)[0]))
            sizes.append(size)
            units.add("mm" if mm else "px")
        if len(units) > 1 and job.focal is None:
            raise ValueError("some of its focal lengths are in mm and some in px: give argument focal")
        if units == {"mm"}:
            refuse_other_focals([node.focal for node in nodes], job)
        return contents(nodes, one_size(sizes), job, px=px, mm=units == {"mm"})
