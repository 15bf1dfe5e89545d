"""OpenCV's YAML files, as ``cv2.FileStorage`` writes them: one focal length each.

The rational model with eight coefficients, which follows an inverse polynomial best. `cv2.projectPoints`
and `cv2.initUndistortRectifyMap` then do as the lens; `cv2.undistortPoints` stops after five iterations.
"""

import numpy as np

from ._documents import load_yaml
from ._pinhole import (
    contents,
    data_of,
    formula,
    from_opencv,
    matrix_rows,
    numbers,
    pinhole,
    refuse_other_focals,
)
from .base import Contents, Export, Import, Node, NodeFormat, one_size, refuse_others


class OpenCV(NodeFormat):
    """OpenCV's calibration as YAML: camera_matrix and distortion_coefficients."""

    name, tools, suffixes = "opencv", "OpenCV", (".yaml", ".yml")

    def forms(self, lens):
        """Rational, three over three."""
        return (formula(lens, 3, 3),)

    def text(self, nodes: list[Node], job: Export) -> str:
        """One camera."""
        camera = pinhole(nodes[0], job)
        width, height = job.lens.image_size
        return "\n".join(
            [
                "%YAML:1.0",
                "---",
                f"image_width: {width}",
                f"image_height: {height}",
                f"focal_length: {camera.focal!r}",
                f"focal_unit: {job.lens.focal_unit}",
                *_matrix("camera_matrix", 3, 3, matrix_rows(camera)),
                *_matrix("distortion_coefficients", 1, 8, camera.coefficients),
                "",
            ]
        )

    def recognises(self, head: str) -> bool:
        """By the type of its matrices."""
        return "opencv-matrix" in head

    def read(self, job: Import) -> Contents:
        """One file or several; focal lengths in px, or in the unit that zoomjax wrote beside them."""
        nodes, sizes, px, units = [], [], [], set()
        for path in job.paths:
            table = load_yaml(path)
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


def _matrix(name: str, rows: int, columns: int, values: object) -> list[str]:
    return [
        f"{name}: !!opencv-matrix",
        f"   rows: {rows}",
        f"   cols: {columns}",
        "   dt: d",
        f"   data: [ {numbers(values)} ]",
    ]
