"""OpenTrackIO, SMPTE's camera tracking data, with OpenLensIO's "Brown-Conrady D-U", which is our formula.

    x_u = x (1 + k1 r² + k3 r⁴ + k5 r⁶) / (1 + k2 r² + k4 r⁴ + k6 r⁶) + decentering,  x in mm, y down

Odd slots are the numerator and even ones the denominator: polynomials and division models of up to three
terms are exact. A track is one JSON object a line, one for each focal length or frame. Tangential
coefficients are in 1/mm, as in the formula (OpenLensIO's text says 1/mm²).
"""

import json
import math

import numpy as np

from ..models.distortion_model import AbstractRadial
from ._documents import load_json
from ._forms import Form
from .base import Contents, Export, Import, Node, NodeFormat, one_size, read_text, refuse_others

_MODEL = "Brown-Conrady D-U"
_FORM = Form(3, 3, tangential=True, corrects=True)
_SLOTS = np.array([0, 2, 4, 1, 3, 5])
"""Of the numerators, then of the denominators."""

_OFFSET = "Its projectionOffset is left out: the rays of the lens are about its centre of distortion."

_SEVERAL = f"It has several distortions of the model {_MODEL}, which differ: the first is read."
_SQUARE = 0.01
"""Share by which the sides of pixels may differ: sensors' sizes are rounded."""


class OpenTrackIO(NodeFormat):
    """Samples of OpenTrackIO with a lens's distortion."""

    name, tools, suffixes = (
        "opentrackio",
        "Unreal Engine, disguise, Vizrt, stYpe, Mo-Sys",
        (".jsonl", ".json"),
    )
    exact, zoom = True, "list"
    options = ()

    def forms(self, lens):
        """Rational, three over three, from distorted to corrected points."""
        return (
            Form(3, 3, tangential=not isinstance(lens.distortion_model, AbstractRadial), corrects=True),
        )

    def text(self, nodes: list[Node], job: Export) -> str:
        """A sample on each line."""
        if (first := min(job.frames or (0,))) < 0:
            raise ValueError(f"OpenTrackIO numbers samples from 0, and the track begins at frame {first}.")
        return "".join(
            json.dumps(self._sample(node, number, job)) + "\n" for number, node in enumerate(nodes)
        )

    def _sample(self, node: Node, number: int, job: Export) -> dict:
        assert isinstance(node.form, Form)
        pitch, size = job.pitch, np.array(job.lens.image_size)
        numerators, denominators, p = node.form.split(
            node.form.rescaled(node.theta, 1 / (job.lens.scale * pitch))
        )
        radial = np.zeros(6)
        radial[_SLOTS] = np.concatenate([numerators, denominators])
        x, y = ((node.centre - (size - 1) / 2) * pitch).tolist()
        width, height = (size * pitch).tolist()
        low, high = np.asarray(job.lens.focal_range, float)
        share = float(np.clip((node.focal - low) / (high - low), 0, 1)) if high > low else 0.0
        return {
            "protocol": {"name": "OpenTrackIO", "version": [1, 0, 1]},
            "static": {
                "camera": {
                    "activeSensorPhysicalDimensions": {"width": width, "height": height},
                    "activeSensorResolution": {"width": int(size[0]), "height": int(size[1])},
                }
            },
            "timing": {"sequenceNumber": number if node.frame is None else node.frame},
            "lens": {
                "pinholeFocalLength": float(job.focal_mm(node.focal)),
                "encoders": {"zoom": share},
                "distortion": [{"model": _MODEL, "radial": radial.tolist(), "tangential": p.tolist()}],
                "distortionOffset": {"x": x, "y": y},
                "projectionOffset": {"x": 0.0, "y": 0.0},
            },
        }

    def recognises(self, head: str) -> bool:
        """By the name of the protocol."""
        return "OpenTrackIO" in head

    def read(self, job: Import) -> Contents:
        """Samples, one a line, in an array, or one alone; what is static may be in the first of them."""
        nodes, camera, sizes, pitches = [], {}, [], []
        notes: dict[str, None] = {}
        for sample in _samples(read_text(job.paths[0])):
            camera = {**camera, **sample.get("static", {}).get("camera", {})}
            resolution = camera.get("activeSensorResolution")
            found = None if resolution is None else (resolution["width"], resolution["height"])
            sizes.append(size := job.size(found))
            pitch = _pitch(camera, size)
            nodes.append(_node(sample["lens"], pitch, size))
            pitches.append(pitch)
            if any(sample["lens"].get("projectionOffset", {}).values()):
                notes |= {_OFFSET: None}
            first, *others = _chosen(sample["lens"])
            if any(other != first for other in others):
                notes |= {_SEVERAL: None}
        pitch = pitches[0] if len(set(pitches)) == 1 else None
        return Contents(tuple(nodes), one_size(sizes), "mm", tuple(notes), pixel_pitch=pitch)


def _pitch(camera: dict, size: tuple[int, int]) -> float:
    """mm from one pixel to the next; ValueError where pixels or what they show are not square."""
    sensor = camera["activeSensorPhysicalDimensions"]
    pitch, other = float(sensor["width"]) / size[0], float(sensor["height"]) / size[1]
    if abs(pitch - other) > _SQUARE * pitch:
        raise ValueError(f"its pixels are not square, but {pitch:.4g} by {other:.4g} mm")
    squeeze = camera.get("anamorphicSqueeze", 1)
    squeeze = squeeze["num"] / squeeze["denom"] if isinstance(squeeze, dict) else squeeze
    refuse_others({"anamorphicSqueeze": squeeze}, {"anamorphicSqueeze": 1})
    return pitch


def _samples(text: str) -> list[dict]:
    try:
        found = load_json(text)
    except json.JSONDecodeError:
        found = [load_json(line) for line in text.splitlines() if line.strip()]
    found = [found] if isinstance(found, dict) else found
    if not found:
        raise ValueError("it is empty")
    return found


def _first(number: int, values: list) -> np.ndarray:
    """So many coefficients, 0 where they are not there; ValueError if there are more."""
    found = np.append(np.asarray(values, float), np.zeros(number))
    if np.any(found[number:]):
        raise ValueError(f"it has more than {number} coefficients of a kind, which zoomjax has no model of")
    return found[:number]


def _chosen(lens: dict) -> list[dict]:
    """The distortions of our model, of which there must be one."""
    chosen = [entry for entry in lens["distortion"] if entry.get("model", _MODEL) == _MODEL]
    if not chosen:
        models = ", ".join(repr(entry["model"]) for entry in lens["distortion"])
        raise ValueError(f"its distortion model {models} is not {_MODEL!r}")
    return chosen


def _node(lens: dict, pitch: float, size: tuple[int, int]) -> Node:
    chosen = _chosen(lens)
    radial = _first(6, chosen[0]["radial"])
    tangential = _first(2, chosen[0].get("tangential", []))
    theta = np.concatenate([radial[_SLOTS], tangential])
    if not np.isfinite(theta).all():
        raise ValueError("its coefficients must be finite numbers")
    offset = lens.get("distortionOffset", {"x": 0.0, "y": 0.0})
    centre = (np.array(size) - 1) / 2 + np.array([offset["x"], offset["y"]], float) / pitch
    focal = float(lens["pinholeFocalLength"])
    return Node(focal, _FORM, _FORM.rescaled(theta, math.hypot(*size) / 2 * pitch), centre)
