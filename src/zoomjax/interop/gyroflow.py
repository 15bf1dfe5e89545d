"""Gyroflow's lens profiles: OpenCV's eight coefficients, with entries that Gyroflow interpolates.

Keys of ``interpolations`` are focal lengths in the unit of the camera's metadata, mm. Between them Gyroflow
takes camera matrix and coefficients, which are for radii in focal lengths, as linear in f, also beyond both
ends.
"""

import dataclasses
import json
from collections.abc import Callable
from typing import Any

import numpy as np

from ._documents import load_json
from ._pinhole import (
    Pinholes,
    contents,
    formula,
    from_opencv,
    matrix_rows,
    pinhole,
    refuse_other_focals,
)
from .base import Contents, Export, Import, Node, one_size, read_text, refuse_others

_MOST = 8
"""Coefficients that are read."""

_SAME = 0.05
"""Share by which the focal length of an entry may differ from that of its name, which may be rounded."""

_NEUTRAL = {"input_horizontal_stretch": 1, "input_vertical_stretch": 1, "digital_lens": "none"}
"""What Gyroflow does besides to pictures, and where it does nothing; so it is with 0 and null."""


class Gyroflow(Pinholes):
    """Gyroflow's JSON with interpolations over the zoom."""

    name, tools, suffixes = "gyroflow", "Gyroflow", (".json",)
    note = (
        "Gyroflow goes by the focal length in the video's metadata, and extrapolates linearly beyond the "
        "first and last."
    )

    def forms(self, lens):
        """Rational, three over three."""
        return (formula(lens, 3, 3),)

    def text(self, nodes: list[Node], job: Export) -> str:
        """A profile whose base is the first focal length."""
        width, height = job.lens.image_size
        entries = {}
        for node in nodes:
            mm = float(job.focal_mm(node.focal))
            camera = pinhole(node, job)
            entries[f"{mm:.9g}"] = {
                "camera_matrix": matrix_rows(camera),
                "distortion_coeffs": camera.coefficients,
                "focal_length": mm,
            }
        first = next(iter(entries.values()))
        profile = {
            "name": "zoomjax",
            "note": "",
            "calibrated_by": "zoomjax",
            "camera_brand": "",
            "camera_model": str(job.lens.about.get("camera", "")),
            "lens_model": str(job.lens.about.get("lens", "zoomjax")),
            "calibrator_version": "zoomjax",
            "focal_length": first["focal_length"],
            "fisheye_params": {key: first[key] for key in ("camera_matrix", "distortion_coeffs")},
            "calib_dimension": {"w": width, "h": height},
            "orig_dimension": {"w": width, "h": height},
            "asymmetrical": True,
            "distortion_model": "opencv_standard",
            "interpolations": entries,
        }
        return json.dumps(profile, indent=1) + "\n"

    def recognises(self, head: str) -> bool:
        """By its keys."""
        return '"fisheye_params"' in head

    def read(self, job: Import) -> Contents:
        """The entries, or the base of a profile without them."""
        table = load_json(read_text(job.paths[0]))
        nodes, sizes, numbers = [], [], []
        entries = table.get("interpolations") or {}
        mm = bool(entries) or bool(table.get("focal_length"))
        for key, own in (entries or {table.get("focal_length"): {}}).items():
            entry = {**table, **own}
            _check(key, entry)
            size = job.size((entry["calib_dimension"]["w"], entry["calib_dimension"]["h"]))
            parameters = {**table["fisheye_params"], **own.get("fisheye_params", {}), **own}
            matrix = np.array(parameters["camera_matrix"], float)
            if not table.get("asymmetrical"):
                matrix[:2, 2] = np.array(size) / 2
            k = np.asarray(parameters["distortion_coeffs"], float).ravel()
            nodes.append(from_opencv(float(key) if mm else None, matrix, k, size))
            numbers.append(np.concatenate([matrix.ravel(), k[:_MOST], np.zeros(max(0, _MOST - len(k)))]))
            sizes.append(size)
        size = one_size(sizes)
        if mm:
            refuse_other_focals([node.focal for node in nodes], job)
        found = contents(nodes, size, job, px=[float(row[0]) for row in numbers], mm=mm)
        at = {node.focal: row for node, row in zip(found.nodes[::-1], numbers[::-1], strict=True)}
        return dataclasses.replace(found, between=_linear(at, size) if entries else None)


def _check(key: Any, entry: dict[str, Any]) -> None:
    """Refuse an entry of another model, or whose focal length is not that of its name."""
    model = entry.get("distortion_model", "opencv_fisheye")
    if model != "opencv_standard":
        raise ValueError(f"its distortion model {model!r} is not opencv_standard")
    refuse_others({name: entry[name] for name in _NEUTRAL if entry.get(name)}, _NEUTRAL)
    told = entry.get("focal_length")
    if key is not None and told and abs(float(told) / float(key) - 1) > _SAME:
        raise ValueError(f"its entry of {key} mm says that its focal length is {told}")


def _linear(numbers: dict[float, np.ndarray], size: tuple[int, int]) -> Callable[[int, float], Node]:
    """Gyroflow's own interpolation: camera matrix and coefficients are linear in f."""
    focal = sorted(numbers)

    def between(i: int, share: float) -> Node:
        low, high = focal[i : i + 2]
        values = (1 - share) * numbers[low] + share * numbers[high]
        return from_opencv((1 - share) * low + share * high, values[:9], values[9:], size)

    return between
