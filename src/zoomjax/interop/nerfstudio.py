"""nerfstudio's transforms.json: intrinsics for each frame, three radial terms and decentering.

Files written hold no poses: copy the entries of each frame into your own. Keys at the top level overrule
those of all frames there. Principal points count from the corner of the top-left pixel.
"""

import dataclasses
import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ._documents import load_json
from ._pinhole import Pinhole, contents, focal_px, formula, node_of, pinhole, refuse_other_focals
from .base import Contents, Export, Import, Node, NodeFormat, one_size, read_text, refuse_others

_MODELS = ("OPENCV", "RADIAL", "SIMPLE_RADIAL", "PINHOLE", "SIMPLE_PINHOLE")
"""That nerfstudio takes for one and the same, coefficients that are not there for 0."""

_ALIKE = 0.01
"""Relative difference up to which two focal lengths are one, with other digits."""

_KEYS = ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "p1", "p2")


class Nerfstudio(NodeFormat):
    """Intrinsics of nerfstudio's frames."""

    name, tools, suffixes = "nerfstudio", "nerfstudio, instant-ngp", (".json",)
    zoom = "list"
    note = "The file has no poses: copy the entries of each frame into those of your transforms.json."

    def forms(self, lens):
        """Three terms."""
        return (formula(lens, 3),)

    def text(self, nodes: list[Node], job: Export) -> str:
        """A frame for each focal length."""
        frames = []
        for node in nodes:
            camera = pinhole(node, job)
            k1, k2, p1, p2, k3 = camera.coefficients
            cx, cy = (camera.centre + 0.5).tolist()
            values = (camera.f, camera.f, cx, cy, *job.lens.image_size, k1, k2, k3, p1, p2)
            about = {"focal": node.focal, "focal_unit": job.lens.focal_unit}
            if node.frame is not None:
                about["frame"] = node.frame
            frames.append({**about, **dict(zip(_KEYS, values, strict=True))})
        return json.dumps({"camera_model": "OPENCV", "frames": frames}, indent=1) + "\n"

    def recognises(self, head: str) -> bool:
        """By its keys."""
        return '"fl_x"' in head

    def read(self, job: Import) -> Contents:
        """All frames, or the one camera of all."""
        table = load_json(read_text(job.paths[0]))
        common = {key: table[key] for key in (*_KEYS, "k4") if key in table}
        nodes, sizes, px, units, overruled = [], [], [], set(), dict[str, None]()
        for frame in table["frames"] or [{}]:
            for told in (table, frame):
                if (model := told.get("camera_model", "OPENCV")) not in _MODELS:
                    raise ValueError(f"its camera model {model!r} is not one of {', '.join(_MODELS)}")
                refuse_others(told, {"is_fisheye": False})
            overruled |= {key: None for key in common if frame.get(key, common[key]) != common[key]}
            values = {**frame, **common}
            size = job.size((values["w"], values["h"]))
            f, stretch = focal_px(values["fl_x"], values.get("fl_y", values["fl_x"]))
            _check_angle({**frame, **table}, f, size)
            if values.get("k4"):
                raise ValueError("it has a fourth radial coefficient, which is not supported")
            k = np.array([values.get(key, 0.0) for key in ("k1", "k2", "k3")], float)
            p = np.array([values.get(key, 0.0) for key in ("p1", "p2")], float)
            mm = values.get("focal_unit") == "mm"
            focal = float(values["focal"]) if mm else f
            centre = np.array([values["cx"], values["cy"]]) - 0.5
            nodes.append(node_of(Pinhole(focal, f, centre, k, p, stretch), size))
            sizes.append(size)
            px.append(f)
            units.add(mm)
        if len(units) > 1 and job.focal is None:
            raise ValueError("some of its focal lengths are in mm and some in px: give argument focal")
        if units == {True}:
            refuse_other_focals([node.focal for node in nodes], job)
        found = contents(nodes, one_size(sizes), job, px=px, mm=units == {True})
        note = (f"Frames have other values of {', '.join(overruled)} than the top, which count.",)
        return dataclasses.replace(found, notes=(*found.notes, *note * bool(overruled)))


def _check_angle(told: Mapping[str, Any], f: float, size: tuple[int, int]) -> None:
    """Raise ValueError where the field of view, which some tools take, is that of another focal length."""
    for name, side in zip(("camera_angle_x", "camera_angle_y"), size, strict=True):
        other = side / 2 / math.tan(told[name] / 2) if name in told else f
        if not math.isclose(other, f, rel_tol=_ALIKE):
            raise ValueError(f"its {name} is that of f = {other:.6g} px, and its fl_x is {f:.6g}")
