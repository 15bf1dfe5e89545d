"""Adobe's lens profiles, .lcp: read only.

Radial coefficients 1 to 3 are OpenCV's k1, k2, k3, for radii in focal lengths; ``FocalLengthX`` is the
focal length as a share of the image's longer side, ``FocalLengthY`` the same for y, and the centre a share
of its width and height. Without the first, ``SensorFormatFactor``, the crop factor, tells the share.
Between entries all are linear in log f. Of entries at one focal length, that of the farthest focus counts.
Whether centres count from pixel centres or corners is not documented: here from corners.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator

import numpy as np

from ..io.equipment import FILM
from ._pinhole import Pinhole, focal_px, node_of, pitch_of
from .base import Contents, Format, Import, Node, one_size

_SAME = 1.1
"""Ratio of crop factors of one camera's entries, which are rounded."""

_CAMERA = "{http://ns.adobe.com/photoshop/1.0/camera-profile}"


class LCP(Format):
    """Adobe's lens profiles."""

    name, tools, suffixes = "lcp", "Adobe Camera Raw, Lightroom, RawTherapee", (".lcp",)
    zoom = "interpolated"
    writes = False

    def recognises(self, head: str) -> bool:
        """By its name space."""
        return "camera-profile" in head

    def read(self, job: Import) -> Contents:
        """All entries with a perspective model."""
        found: dict[float, tuple[float, np.ndarray]] = {}
        sizes, factors = [], set[float]()
        for profile, model in _profiles(ET.parse(job.paths[0]).getroot()):
            stated = (profile["ImageWidth"], profile["ImageLength"]) if "ImageWidth" in profile else None
            sizes.append(size := job.size(stated))
            factors.add(factor := float(profile.get("SensorFormatFactor", 1)))
            focal = float(profile["FocalLength"])
            far = float(profile.get("FocusDistance", "inf"))
            if focal not in found or far > found[focal][0]:
                found[focal] = far, _numbers(focal * factor, model, size)
        if not found:
            raise ValueError("it has no perspective model with a focal length")
        if not (min(factors) > 0 and max(factors) < _SAME * min(factors)):
            told = ", ".join(f"{factor:g}" for factor in sorted(factors))
            raise ValueError(f"it has entries of cameras of other sensors, SensorFormatFactor {told}")
        size, focal = one_size(sizes), sorted(found)
        rows = [found[f][1] for f in focal]

        pitch, notes = pitch_of(focal, [float(row[0]) * max(size) for row in rows])

        def between(i: int, share: float) -> Node:
            at = (1 - share) * focal[i] + share * focal[i + 1]
            t = math.log(at / focal[i]) / math.log(focal[i + 1] / focal[i])
            return _node(at, (1 - t) * rows[i] + t * rows[i + 1], size)

        return Contents(
            tuple(_node(f, row, size) for f, row in zip(focal, rows, strict=True)),
            size,
            "mm",
            notes,
            pixel_pitch=pitch,
            between=between,
        )


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


def _numbers(on_film: float, model: dict[str, str], size: tuple[int, int]) -> np.ndarray:
    """Focal lengths and centre as shares of sides, three radial and two tangential coefficients.

    Where the first are not there, they follow from the focal length of equal view on film, mm.
    """
    usual = on_film / FILM * math.hypot(*size) / max(size)
    share = float(model.get("FocalLengthX", 0)) or usual
    place = [float(model.get(name, 0.5)) for name in ("ImageXCenter", "ImageYCenter")]
    k = [float(model.get(f"RadialDistortParam{i}", 0)) for i in (1, 2, 3)]
    p = [float(model.get(f"TangentialDistortParam{i}", 0)) for i in (1, 2)]
    return np.array([share, float(model.get("FocalLengthY", 0)) or share, *place, *k, *p])


def _node(focal: float, numbers: np.ndarray, size: tuple[int, int]) -> Node:
    f, stretch = focal_px(*(numbers[:2] * max(size)))
    return node_of(Pinhole(focal, f, numbers[2:4] * size - 0.5, numbers[4:7], numbers[7:], stretch), size)
