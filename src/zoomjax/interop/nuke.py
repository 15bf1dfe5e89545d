"""Nuke scripts with a node that corrects, its coefficients curves over the frames of a track.

Radial polynomials and Brown-Conrady of up to two terms become 3DEqualizer's "Radial - Standard, Degree 4",
``x (1 + c2 r² + c4 r⁴) + ...`` with half the filmback's diagonal for radius 1 and y up; all others Nuke's
own LensDistortion2 with a rational model of three over three. Without a track the focal lengths are frames
1, 2, ....
"""

import re

import numpy as np

from ..models.brown_conrady import BrownConrady
from ..models.lens import ZoomLens
from ..models.polynomial import RadialPolynomial
from ._forms import Form
from .base import Contents, Export, Format, Import, Node

_DEGREE_4 = Form(2, tangential=True, corrects=True)
_RATIONAL = Form(3, 3, corrects=True)
_NODE = "LD_3DE4_Radial_Standard_Degree_4"
_KNOBS = {
    "Distortion_Degree_2": (0, 1.0),
    "Quartic_Distortion_Degree_4": (1, 1.0),
    "U_Degree_2": (3, 1.0),
    "V_Degree_2": (2, -1.0),
}
"""Knobs by the coefficient of `_DEGREE_4` that they hold, and its sign: y is up there."""


class Nuke(Format):
    """A node for Nuke, with curves."""

    name, tools, suffixes = "nuke", "Nuke with 3DEqualizer's nodes", (".nk",)
    exact, zoom = True, "list"
    note = "Paste the file into Nuke. Direction undistort corrects; set it to distort for the way back."

    def forms(self, lens: ZoomLens):
        """3DEqualizer's degree 4 where it holds the lens, else rational."""
        if isinstance(lens.family, BrownConrady):
            return (_DEGREE_4,)
        k = lens(float(np.asarray(lens.focal_range)[0])).coefficients
        polynomial = isinstance(lens.family, RadialPolynomial) and len(k) <= 2
        return (_DEGREE_4,) if polynomial else (_RATIONAL,)

    def text(self, nodes: list[Node], job: Export) -> str:
        """The node."""
        return (_degree_4 if nodes[0].form == _DEGREE_4 else _lens_distortion)(nodes, job)

    def recognises(self, head: str) -> bool:
        """By the class of the node."""
        return _NODE in head or "LensDistortion2" in head

    def read(self, job: Import) -> Contents:
        """3DEqualizer's node; focal lengths are those of argument focal, one for each key."""
        text = job.paths[0].read_text(encoding="utf-8")
        knobs = dict(re.findall(r"^\s*([A-Za-z]\w*) (.+)$", text, re.MULTILINE))
        if _NODE not in text:
            raise ValueError(f"it has no node {_NODE}, the only one that is read")
        width, height = (float(knobs[f"tde4_filmback_{side}_cm"]) for side in ("width", "height"))
        size = job.size()
        pitch = width / size[0]
        if abs(height / size[1] - pitch) > 1e-6 * pitch:
            raise ValueError("its filmback has another aspect than the image")
        curves = {name: _keys(name, knobs.get(name, "0")) for name in _KNOBS}
        frames = max((sorted(keys) for keys in curves.values()), key=len)
        if any(len(keys) > 1 and sorted(keys) != frames for keys in curves.values()):
            raise ValueError("its curves have keys at different frames")
        if job.focal is None or len(job.focal) != len(frames):
            raise ValueError(f"it holds no focal lengths: give argument focal, {len(frames)} of them")
        offset = [float(knobs.get(f"tde4_lens_center_offset_{axis}_cm", 0)) for axis in "xy"]
        centre = (np.array(size) - 1) / 2 + np.array([offset[0], -offset[1]]) / pitch
        nodes = []
        for frame, focal in zip(frames, job.focal, strict=True):
            theta = np.zeros(4)
            for name, (place, sign) in _KNOBS.items():
                keys = curves[name]
                theta[place] = sign * (keys[frame] if len(keys) > 1 else next(iter(keys.values())))
            nodes.append(Node(focal, _DEGREE_4, theta, centre))
        return Contents(tuple(nodes), size, "mm")


def _keys(name: str, text: str) -> dict[int, float]:
    """The keys of a knob: of a curve, or one of a constant. Values after a key are of the next frames."""
    if "curve" not in text:
        return {1: float(text)}
    frame, keys = 1, {}
    for word in re.sub(r"[{}]", " ", text).split():
        if re.fullmatch(r"x-?\d+", word):
            frame = int(word[1:])
        elif re.match(r"[-+.\d]", word):  # others say how it is interpolated
            keys[frame] = float(word)
            frame += 1
    if not keys:
        raise ValueError(f"its curve {name} has no keys")
    return keys


def curve(nodes: list[Node], values: np.ndarray) -> str:
    """A knob's value, or its curve over frames."""
    if len(nodes) == 1:
        return repr(float(values[0]))
    frames = [number if node.frame is None else node.frame for number, node in enumerate(nodes, start=1)]
    keys = " ".join(f"x{frame} {float(value)!r}" for frame, value in zip(frames, values, strict=True))
    return f"{{{{curve {keys}}}}}"


def _offsets(nodes: list[Node], job: Export) -> np.ndarray:
    """Of the centres from the middle of the image, y up, px."""
    middle = (np.array(job.lens.image_size) - 1) / 2
    return np.array([node.centre - middle for node in nodes]) * [1, -1]


def _degree_4(nodes: list[Node], job: Export) -> str:
    cm = job.pitch / 10
    width, height = job.lens.image_size
    x, y = (_offsets(nodes, job) * cm).T
    theta = np.array([node.theta for node in nodes])
    lines = [
        f"{_NODE} {{",
        " direction undistort",
        f" tde4_focal_length_cm {curve(nodes, np.array([job.focal_mm(n.focal) / 10 for n in nodes]))}",
        f" tde4_filmback_width_cm {width * cm!r}",
        f" tde4_filmback_height_cm {height * cm!r}",
        f" tde4_lens_center_offset_x_cm {curve(nodes[:1], x)}",
        f" tde4_lens_center_offset_y_cm {curve(nodes[:1], y)}",
        " tde4_pixel_aspect 1",
        *(f" {name} {curve(nodes, sign * theta[:, place])}" for name, (place, sign) in _KNOBS.items()),
        " name zoomjax",
        "}",
        "",
    ]
    return "\n".join(lines)


def _lens_distortion(nodes: list[Node], job: Export) -> str:
    x, y = (_offsets(nodes, job) / job.lens.scale).T
    theta = np.array([node.theta for node in nodes])
    lines = [
        "LensDistortion2 {",
        " distortionModelPreset Custom",
        f" distortionOrder {{{_RATIONAL.numerators} {_RATIONAL.denominators}}}",
        " normalisationType Diagonal",
        " projection Rectilinear",
        " output Undistort",
        f" centre {{{curve(nodes[:1], x)} {curve(nodes[:1], y)}}}",
        *(f" distortionNumerator{i} {curve(nodes, theta[:, i])}" for i in range(3)),
        *(f" distortionDenominator{i} {curve(nodes, theta[:, 3 + i])}" for i in range(3)),
        " name zoomjax",
        "}",
        "",
    ]
    return "\n".join(lines)
