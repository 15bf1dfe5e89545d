"""ROS camera_info YAML: rational_polynomial with eight coefficients, one focal length a file.

Written for ``camera_info_manager``. ROS's zoom manager reads files named by whole zoom levels, but swaps
the weights of its interpolation: write every level that is used, as ``focal=range(18, 201)``.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

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
)
from .base import Contents, Export, Import, Node, NodeFormat, one_size

_IDENTITY = [1, 0, 0, 0, 1, 0, 0, 0, 1]


class ROS(NodeFormat):
    """ROS camera_info: plumb_bob is read, rational_polynomial read and written."""

    name, tools, suffixes = "ros", "ROS, ROS 2", (".yaml", ".yml")
    note = "ROS's zoom manager swaps the weights of its interpolation: write every zoom level that is used."

    def forms(self, lens):
        """Rational, three over three."""
        return (formula(lens, 3, 3),)

    def text(self, nodes: list[Node], job: Export) -> str:
        """One camera."""
        camera = pinhole(nodes[0], job)
        width, height = job.lens.image_size
        rows = matrix_rows(camera)
        lines = [f"image_width: {width}", f"image_height: {height}", "camera_name: zoomjax"]
        lines += _matrix("camera_matrix", 3, 3, rows)
        lines += ["distortion_model: rational_polynomial"]
        lines += _matrix("distortion_coefficients", 1, 8, camera.coefficients)
        lines += _matrix("rectification_matrix", 3, 3, _IDENTITY)
        lines += _matrix("projection_matrix", 3, 4, [[*row, 0.0] for row in rows])
        return "\n".join([*lines, ""])

    def recognises(self, head: str) -> bool:
        """By the name of its model."""
        return "distortion_model" in head and "camera_matrix" in head

    def read(self, job: Import) -> Contents:
        """One file or several; focal lengths in px, unless others are given."""
        nodes, sizes, cut = [], [], False
        for path in job.paths:
            table = load_yaml(path)
            cut |= _is_cut(table)
            if table["distortion_model"] not in ("plumb_bob", "rational_polynomial"):
                raise ValueError(f"its distortion model {table['distortion_model']!r} is not supported")
            size = job.size((table["image_width"], table["image_height"]))
            matrix, coefficients = (
                data_of(table[name]) for name in ("camera_matrix", "distortion_coefficients")
            )
            if table["distortion_model"] == "plumb_bob" and np.any(np.ravel(coefficients)[5:]):
                raise ValueError("it has more coefficients than the five of its model, plumb_bob")
            nodes.append(from_opencv(None, matrix, coefficients, size))
            sizes.append(size)
        found = contents(nodes, one_size(sizes), job)
        note = ("Its images are cropped or binned: the lens is of whole ones, as its matrix is.",) * cut
        return dataclasses.replace(found, notes=(*found.notes, *note))


def _is_cut(table: Mapping[str, Any]) -> bool:
    """Whether images are a part of what the sensor sees, or have fewer pixels."""
    roi = table.get("roi") or {}
    binned = max(float(table.get(name) or 1) for name in ("binning_x", "binning_y")) > 1
    return binned or any(float(roi.get(name) or 0) for name in ("x_offset", "y_offset", "width", "height"))


def _matrix(name: str, rows: int, columns: int, values: object) -> list[str]:
    return [f"{name}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: [{numbers(values)}]"]
