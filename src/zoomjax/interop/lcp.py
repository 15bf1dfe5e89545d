"""Adobe's lens profiles, .lcp: read only.

Radial coefficients 1 to 3 are OpenCV's k1, k2, k3, for radii in focal lengths; ``FocalLengthX`` is the
focal length as a share of the image's longer side, ``FocalLengthY`` the same for y, and the centre a share
of its width and height. Of entries at one focal length, that of the farthest focus counts. Whether centres
count from pixel centres or corners is not documented: here from corners.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator

import numpy as np

from ._pinhole import Pinhole, focal_px, node_of
from .base import Contents, Format, Import, Node, one_size

_CAMERA = "{http://ns.adobe.com/photoshop/1.0/camera-profile}"


class LCP(Format):
    """Adobe's lens profiles."""

    name, tools, suffixes = "lcp", "Adobe Camera Raw, Lightroom, RawTherapee", (".lcp",)
    writes = False

    def recognises(self, head: str) -> bool:
        """By its name space."""
        return "camera-profile" in head

    def read(self, job: Import) -> Contents:
        """All entries with a perspective model."""
        found: dict[float, tuple[float, Node]] = {}
        sizes = []
        for profile, model in _profiles(ET.parse(job.paths[0]).getroot()):
            stated = (
                (int(profile["ImageWidth"]), int(profile["ImageLength"]))
                if "ImageWidth" in profile
                else None
            )
            sizes.append(size := job.size(stated))
            focal = float(profile["FocalLength"])
            far = float(profile.get("FocusDistance", "inf"))
            if focal not in found or far > found[focal][0]:
                found[focal] = far, _node(focal, model, size)
        if not found:
            raise ValueError("it has no perspective model with a focal length")
        return Contents(tuple(node for _, node in found.values()), one_size(sizes), "mm")


def _profiles(root: ET.Element) -> Iterator[tuple[dict[str, str], dict[str, str]]]:
    """The values of each profile, and those of its perspective model."""
    for element in root.iter():
        models = element.findall(f"{_CAMERA}PerspectiveModel")
        if models:
            values = _values(element)
            model = {**values, **_values(models[0])}
            for inner in models[0]:
                model |= _values(inner)
            yield values, model


def _values(element: ET.Element) -> dict[str, str]:
    """Attributes and simple elements of Adobe's name space."""
    pairs = [
        *element.attrib.items(),
        *((child.tag, child.text or "") for child in element if not len(child)),
    ]
    return {name.removeprefix(_CAMERA): value for name, value in pairs if name.startswith(_CAMERA)}


def _node(focal: float, model: dict[str, str], size: tuple[int, int]) -> Node:
    usual = focal / math.hypot(36, 24) * math.hypot(*size) / max(size)
    share = float(model.get("FocalLengthX", 0)) or usual
    f, stretch = focal_px(share * max(size), (float(model.get("FocalLengthY", 0)) or share) * max(size))
    place = [float(model.get(name, 0.5)) for name in ("ImageXCenter", "ImageYCenter")]
    k = np.array([float(model.get(f"RadialDistortParam{i}", 0)) for i in (1, 2, 3)])
    p = np.array([float(model.get(f"TangentialDistortParam{i}", 0)) for i in (1, 2)])
    return node_of(Pinhole(focal, f, np.array(place) * size - 0.5, k, p, stretch), size)
