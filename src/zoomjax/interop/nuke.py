"""Nuke scripts with a node that corrects, its coefficients curves over the frames of a track.

Radial polynomials and Brown-Conrady of up to two terms become 3DEqualizer's "Radial - Standard, Degree 4",
``x (1 + c2 r² + c4 r⁴) + ...`` with half the filmback's diagonal for radius 1 and y up; all others Nuke's
own LensDistortion2 with a rational model of three over three. The centre has a curve where it moves. Both
nodes are read; only the first has focal lengths. Without a track the focal lengths are frames 1, 2, ....
"""

import math
import re

import numpy as np

from ..models.brown_conrady import BrownConrady
from ..models.lens import ZoomLens
from ..models.polynomial import RadialPolynomial
from ._forms import Form
from ._pinhole import refuse_other_focals
from .base import IN_PX, Contents, Export, Import, Node, NodeFormat, read_text, refuse_others

_DEGREE_4 = Form(2, tangential=True, corrects=True)
_RATIONAL = Form(3, 3, corrects=True)
_NODE, _OWN_NODE = "LD_3DE4_Radial_Standard_Degree_4", "LensDistortion2"
_SETTINGS = {"normalisationType": "Diagonal", "projection": "Rectilinear"}
"""Of Nuke's own node, as they are written and must be."""

_NEUTRAL = {
    _NODE: {
        "tde4_pixel_aspect": 1,
        **dict.fromkeys(("field_of_view_xa_unit", "field_of_view_ya_unit"), 0),
        **dict.fromkeys(("field_of_view_xb_unit", "field_of_view_yb_unit"), 1),
        **dict.fromkeys(("U_Degree_4", "V_Degree_4", "B_Cylindric_Bending"), 0),
    },
    _OWN_NODE: {
        **_SETTINGS,
        **{"distortionDomain": "Rectilinear", "distortInFisheyeSpace": "false"},
        **{"anamorphicSqueeze": 1, "anamorphicScale": 1, "anamorphicTwist": 0, "beamSplitterBending": 0},
    },
}
"""Knobs that change what a node does, and the values without which they are read: there is no model of
others."""

_ASYMMETRIC = re.compile(r"distortion(Numerator|Denominator)[A-Z]\d+")
"""Knobs of Nuke's own node of which the same is true, and that must be 0."""

_MOST = 12
"""Coefficients that are read."""

_KNOBS = {
    "Distortion_Degree_2": (0, 1.0),
    "Quartic_Distortion_Degree_4": (1, 1.0),
    "U_Degree_2": (3, 1.0),
    "V_Degree_2": (2, -1.0),
}
"""Knobs by the coefficient of `_DEGREE_4` that they hold, and its sign: y is up there."""


class Nuke(NodeFormat):
    """A node for Nuke, with curves."""

    name, tools, suffixes = "nuke", "Nuke with 3DEqualizer's nodes", (".nk",)
    exact, zoom = True, "list"
    note = "Paste the file into Nuke. Direction undistort corrects; set it to distort for the way back."

    def forms(self, lens: ZoomLens):
        """3DEqualizer's degree 4 where it holds the lens, else rational."""
        if isinstance(lens.distortion_model, BrownConrady):
            return (_DEGREE_4,)
        k = lens(float(np.asarray(lens.focal_range)[0])).coefficients
        polynomial = isinstance(lens.distortion_model, RadialPolynomial) and len(k) <= 2
        return (_DEGREE_4,) if polynomial else (_RATIONAL,)

    def text(self, nodes: list[Node], job: Export) -> str:
        """The node."""
        return (_degree_4 if nodes[0].form == _DEGREE_4 else _lens_distortion)(nodes, job)

    def recognises(self, head: str) -> bool:
        """By the class of the node."""
        return _NODE in head or _OWN_NODE in head

    def read(self, job: Import) -> Contents:
        """The first node; focal lengths are those of its curve, or of argument focal, one for each key."""
        kind, knobs, notes = _first_node(read_text(job.paths[0]))
        neutral = _NEUTRAL[kind] | dict.fromkeys(filter(_ASYMMETRIC.fullmatch, knobs), 0)
        words = {name: value.strip('"') for name, value in knobs.items()}
        refuse_others(
            {
                n: words[n] if isinstance(neutral[n], str) else _all(n, words[n])
                for n in neutral.keys() & knobs
            },
            neutral,
        )
        size = job.size()
        form, terms, centre, focal = (_read_degree_4 if kind == _NODE else _read_rational)(knobs, size)
        curves = [*terms, *centre]
        frames = max(map(sorted, curves), key=len)
        if any(len(keys) > 1 and sorted(keys) != frames for keys in curves):
            raise ValueError("its curves have keys at different frames")
        values = _at_frames(curves, frames)
        pitch = None
        if kind == _NODE:
            pitch = 10 * float(knobs["tde4_filmback_width_cm"]) / size[0]  # 10 mm in a cm
        own = None
        if focal is not None and sorted(focal) == frames:
            own = [10 * focal[frame] for frame in frames]
            refuse_other_focals(own, job, pitch=pitch)
        if job.focal is not None and len(job.focal) == len(frames):
            told, unit = job.focal, job.focal_unit
        elif job.focal is None and own is not None:
            told, unit = own, "mm"
        else:
            raise ValueError(
                f"it holds no focal lengths: give argument focal, {len(frames)} of them{IN_PX}"
            )
        if focal is not None and own is None:
            notes += ("Its focal lengths are not those of its keys: those of argument focal count.",)
        nodes = [Node(f, form, row[:-2], row[-2:]) for f, row in zip(told, values, strict=True)]
        return Contents(tuple(nodes), size, unit, notes, pixel_pitch=pitch)


Keys = dict[int, float]
"""The values of a knob by frame: of a curve, or one of a constant."""


def _first_node(text: str) -> tuple[str, dict[str, str], tuple[str, ...]]:
    """The class of the first node that is read, its knobs, and what is to be said of others."""
    nodes = re.findall(rf"^\s*({_NODE}|{_OWN_NODE})\s*\{{(.*?)^\s*\}}", text, re.MULTILINE | re.DOTALL)
    if not nodes:
        raise ValueError(f"it has no whole node {_NODE} or {_OWN_NODE}")
    kind, knobs = nodes[0]
    notes = (
        (f"The first of the file's {len(nodes)} nodes is read, and no other.",) if len(nodes) > 1 else ()
    )
    return kind, dict(re.findall(r"^\s*([A-Za-z]\w*) +(\S.*?)\s*$", knobs, re.MULTILINE)), notes


def _read_degree_4(
    knobs: dict[str, str], size: tuple[int, int]
) -> tuple[Form, list[Keys], list[Keys], Keys | None]:
    """Formula, curves of its coefficients and of the centre in px, and that of the focal length in cm."""
    width, height = (float(knobs[f"tde4_filmback_{side}_cm"]) for side in ("width", "height"))
    pitch = width / size[0]
    if abs(height / size[1] - pitch) > 1e-6 * pitch:
        raise ValueError("its filmback has another aspect than the image")
    names = sorted(_KNOBS, key=lambda name: _KNOBS[name][0])
    terms = [_times(_keys(name, knobs.get(name, "0")), _KNOBS[name][1]) for name in names]
    name = "tde4_lens_center_offset_{}_cm"
    offset = [_keys(name.format(axis), knobs.get(name.format(axis), "0")) for axis in "xy"]
    centre = _in_pixels(offset, 1 / pitch, size)
    focal = knobs.get("tde4_focal_length_cm")
    return _DEGREE_4, terms, centre, None if focal is None else _keys("tde4_focal_length_cm", focal)


def _read_rational(
    knobs: dict[str, str], size: tuple[int, int]
) -> tuple[Form, list[Keys], list[Keys], Keys | None]:
    """The same of LensDistortion2, which has no focal length."""
    over, under = map(int, re.findall(r"\d+", knobs.get("distortionOrder", "{3 3}")))
    if not 0 < over + under <= _MOST:
        raise ValueError(f"it must have up to {_MOST} coefficients")
    names = [f"distortionNumerator{i}" for i in range(over)]
    names += [f"distortionDenominator{i}" for i in range(under)]
    terms = [_keys(name, knobs.get(name, "0")) for name in names]
    x, y = re.findall(r"\{[^{}]*\}|[^\s{}]+", re.sub(r"\A\{|\}\Z", "", knobs.get("centre", "{0 0}")))
    centre = _in_pixels([_keys("centre", x), _keys("centre", y)], math.hypot(*size) / 2, size)
    return Form(over, under, corrects=True), terms, centre, None


def _in_pixels(offset: list[Keys], unit: float, size: tuple[int, int]) -> list[Keys]:
    """Curves of the centre in px, of its offset from the middle, y up, in a unit."""
    x, y = (_times(keys, sign * unit) for keys, sign in zip(offset, (1, -1), strict=True))
    return [
        {frame: value + (side - 1) / 2 for frame, value in keys.items()}
        for keys, side in zip((x, y), size, strict=True)
    ]


def _times(keys: Keys, factor: float) -> Keys:
    return {frame: factor * value for frame, value in keys.items()}


def _at_frames(curves: list[Keys], frames: list[int]) -> np.ndarray:
    """The values of curves, (frame, curve); those of constants at each."""
    return np.array(
        [
            [keys[frame] if len(keys) > 1 else next(iter(keys.values())) for keys in curves]
            for frame in frames
        ]
    )


def _keys(name: str, text: str) -> Keys:
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


def _all(name: str, text: str) -> list[float]:
    """All numbers of a knob: the keys of a curve, or components."""
    if "curve" in text:
        return list(_keys(name, text).values())
    return [float(word) for word in re.sub(r"[{}]", " ", text).split()]


def _values(nodes: list[Node], values: np.ndarray) -> str:
    """A knob's value, or its curve over frames where it changes along the zoom."""
    return f"{{{text}}}" if (text := _component(nodes, values)).startswith("{") else text


def _component(nodes: list[Node], values: np.ndarray) -> str:
    """The same of one component of a knob of several."""
    if len(nodes) == 1:
        return repr(float(values[0]))
    frames = [number if node.frame is None else node.frame for number, node in enumerate(nodes, start=1)]
    keys = " ".join(f"x{frame} {float(value)!r}" for frame, value in zip(frames, values, strict=True))
    return f"{{curve {keys}}}"


def _centres(nodes: list[Node], job: Export) -> np.ndarray:
    """From the middle of the image, y up, px; of one node where they do not move."""
    middle = (np.array(job.lens.image_size) - 1) / 2
    found = np.array([node.centre - middle for node in nodes]) * [1, -1]
    return found[:1] if np.ptp(found, axis=0).max() == 0 else found


def _degree_4(nodes: list[Node], job: Export) -> str:
    cm = job.pitch / 10
    width, height = job.lens.image_size
    x, y = (_centres(nodes, job) * cm).T
    theta = np.array([node.theta for node in nodes])
    lines = [
        f"{_NODE} {{",
        " direction undistort",
        f" tde4_focal_length_cm {_values(nodes, np.array([job.focal_mm(n.focal) / 10 for n in nodes]))}",
        f" tde4_filmback_width_cm {width * cm!r}",
        f" tde4_filmback_height_cm {height * cm!r}",
        f" tde4_lens_center_offset_x_cm {_values(nodes[: len(x)], x)}",
        f" tde4_lens_center_offset_y_cm {_values(nodes[: len(y)], y)}",
        " tde4_pixel_aspect 1",
        *(f" {name} {_values(nodes, sign * theta[:, place])}" for name, (place, sign) in _KNOBS.items()),
        " name zoomjax",
        "}",
        "",
    ]
    return "\n".join(lines)


def _lens_distortion(nodes: list[Node], job: Export) -> str:
    x, y = (_centres(nodes, job) / job.lens.scale).T
    theta = np.array([node.theta for node in nodes])
    lines = [
        f"{_OWN_NODE} {{",
        " distortionModelPreset Custom",
        f" distortionOrder {{{_RATIONAL.numerators} {_RATIONAL.denominators}}}",
        *(f" {name} {value}" for name, value in _SETTINGS.items()),
        " output Undistort",
        f" centre {{{_component(nodes[: len(x)], x)} {_component(nodes[: len(y)], y)}}}",
        *(f" distortionNumerator{i} {_values(nodes, theta[:, i])}" for i in range(3)),
        *(f" distortionDenominator{i} {_values(nodes, theta[:, 3 + i])}" for i in range(3)),
        " name zoomjax",
        "}",
        "",
    ]
    return "\n".join(lines)
