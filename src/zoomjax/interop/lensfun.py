"""lensfun's XML, which darktable, RawTherapee and digiKam read.

    poly5    r_d = r (1 + k1 r² + k2 r⁴)
    ptlens   r_d = r (a r³ + b r² + c r + 1 - a - b - c)
    poly3    r_d = r (1 - k1 + k1 r²)

from corrected radii r to distorted ones, in units of half the short side of an image of the calibration's
crop factor and aspect ratio. ptlens and poly3 also scale the corrected image, by what their factor is at
r = 0; straight lines do not tell. poly5 is written where it is good enough, else ptlens.

Between two focal lengths lensfun interpolates f times each coefficient by cubic Hermite polynomials, with
half the difference of the neighbours' values for slopes, whatever their spacing; beyond the ends it takes
the nearest. Files are of version 1, which lensfun 0.3 and later read, in the pixel scale of 0.3. lensfun
0.3 makes errors of its own with ptlens in its SSE code, up to half a pixel; poly5 has none.
"""

import dataclasses
import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from fractions import Fraction
from typing import ClassVar
from xml.sax.saxutils import escape

import numpy as np

from .._core.text import plain
from ..io.equipment import FILM
from ._forms import AbstractForm, Form, minimax
from .base import Contents, Export, Import, InterpolatedFormat, Node, not_alike, refuse_others
from .radial_table import LARGER, SPARE, RadialTable, pitch_by_crop


@dataclasses.dataclass(frozen=True)
class PtLens(AbstractForm):
    """``d = u (g0 + g1 u + g2 u² + g3 u³)``: ptlens with its scale free, for radii in any unit."""

    corrects: bool = False
    any_scale: ClassVar[bool] = True

    @property
    def orders(self) -> np.ndarray:
        """0 to 3."""
        return np.arange(4.0)

    def __call__(self, theta: np.ndarray, z: np.ndarray) -> np.ndarray:
        """The distorted points, the corrected image scaled so that the factor is about 1 at the centre."""
        r = np.hypot(*z.T)[:, None]
        return z * np.polynomial.polynomial.polyval(r, theta)

    def fit(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """The four numbers."""
        r = np.hypot(*start.T)[:, None]
        matrix = np.stack([start * r**i for i in range(4)], axis=-1)
        change = minimax(lambda _: (matrix, end - start), lambda g: self(g + _ONE, start) - end, 4)
        return change + _ONE

    def distances(self, theta: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """How far mapped points are off, with the corrected ones scaled so that the RMS is least."""
        scale = 1.0
        for _ in range(_STEPS):
            found = self(theta, scale * start)
            slope = (self(theta, (scale + _STEP) * start) - found) / _STEP
            scale -= np.sum(slope * (found - end)) / np.sum(slope * slope)
        return np.hypot(*(self(theta, scale * start) - end).T)


_STEPS, _STEP = 4, 1e-6
"""Of Gauss and Newton, for the scale of the corrected image, and of its difference quotient."""

_ONE = np.array([1.0, 0, 0, 0])


_SCALED = "lensfun scales the corrected image here: positions agree up to that."


class Lensfun(InterpolatedFormat):
    """A lens of the lensfun database: poly5 or ptlens at several focal lengths."""

    name, tools, suffixes = "lensfun", "darktable, RawTherapee, digiKam", (".xml",)
    options = ("tolerance", "crop", "name")

    def forms(self, lens):
        """poly5, then ptlens."""
        return Form(2), PtLens()

    def kept(self, nodes: list[Node]) -> list[Node]:
        """One centre, as far from the farthest of the nodes' own on either side."""
        each = np.array([node.centre for node in nodes])
        centre = (each.min(axis=0) + each.max(axis=0)) / 2
        return [dataclasses.replace(node, centre=centre) for node in nodes]

    def foreign(self, node: Node, job: Export) -> np.ndarray:
        """The terms: k1, k2 or a, b, c."""
        ratio = _unit(job.lens.image_size) / job.lens.scale
        if isinstance(node.form, Form):
            return node.form.rescaled(node.theta, ratio)
        g = node.form.rescaled(node.theta, ratio)
        m = 1 / radius_of_one(g)
        return np.array([g[3] / m**4, g[2] / m**3, g[1] / m**2])

    def native(self, numbers: np.ndarray, focal: float, like: Node, job: Export) -> Node:
        """What lensfun makes of terms."""
        return dataclasses.replace(like, focal=focal, theta=_theta(numbers, job))

    def interpolate(self, focal: np.ndarray, numbers: np.ndarray, at: float) -> np.ndarray:
        """Cubic Hermite polynomials of f times the terms."""
        values = numbers * focal[:, None]
        i = int(np.clip(np.searchsorted(focal, at, side="right") - 1, 0, max(len(focal) - 2, 0)))
        if len(focal) == 1 or not focal[0] < at < focal[-1] or at == focal[i]:
            return numbers[int(np.argmin(abs(focal - at)))]
        low, high = values[i], values[i + 1]
        first = (high - values[i - 1]) / 2 if i > 0 else high - low
        last = (values[i + 2] - low) / 2 if i + 2 < len(focal) else high - low
        t = (at - focal[i]) / (focal[i + 1] - focal[i])
        return (
            (2 * t**3 - 3 * t**2 + 1) * low
            + (t**3 - 2 * t**2 + t) * first
            + (3 * t**2 - 2 * t**3) * high
            + (t**3 - t**2) * last
        ) / at

    def text(self, nodes: list[Node], job: Export) -> str:
        """A database of one lens."""
        size = job.lens.image_size
        low, high = (float(job.focal_mm(nodes[i].focal)) for i in (0, -1))
        offset = nodes[0].centre - (np.array(size) - 1) / 2
        x, y = offset / ((min(size) - 1) / 2)
        model, names = ("poly5", "k1 k2") if isinstance(nodes[0].form, Form) else ("ptlens", "a b c")
        model_name = str(job.lens.about.get("lens", f"zoomjax {low:.4g}-{high:.4g}mm"))
        entries = []
        for node in nodes:
            terms = zip(names.split(), self.foreign(node, job), strict=True)
            words = " ".join(f'{name}="{value:.9g}"' for name, value in terms)
            entries.append(
                f'   <distortion model="{model}" focal="{job.focal_mm(node.focal):.9g}" {words}/>'
            )
        return "\n".join(
            [
                '<lensdatabase version="1">',
                " <lens>",
                f"  <maker>{escape(str(job.lens.about.get('maker', 'zoomjax')))}</maker>",
                f"  <model>{escape(model_name)}</model>",
                "  <mount>Generic</mount>",
                f"  <cropfactor>{_crop(size, job.pitch):.9g}</cropfactor>",
                f"  <aspect-ratio>{max(size)}:{min(size)}</aspect-ratio>",
                f'  <center x="{x:.9g}" y="{y:.9g}"/>',
                "  <calibration>",
                *entries,
                "  </calibration>",
                " </lens>",
                "</lensdatabase>",
                "",
            ]
        )

    def notes(self, nodes: list[Node], job: Export) -> tuple[str, ...]:
        """Where to put the file, and the scale of ptlens."""
        told = "Put maker, model and mount of your camera's EXIF data into the file before you use it."
        if isinstance(nodes[0].form, Form):
            return (told,)
        return told, _SCALED

    def recognises(self, head: str) -> bool:
        """By its root."""
        return "<lensdatabase" in head

    def read(self, job: Import) -> Contents:
        """One lens of a database."""
        lens = _chosen(job)
        refuse_others({"type": lens.findtext("type", "rectilinear").strip()}, {"type": "rectilinear"})
        sets = [each for each in lens.findall("calibration") if each.find("distortion") is not None]
        if len(sets) > 1 or sets[0].attrib:
            raise ValueError(
                "it has calibrations of several cameras: leave one in the file, without attributes"
            )
        size = job.size()
        crop = float(lens.findtext("cropfactor", "1"))
        if not 0 < crop < math.inf:
            raise ValueError("its crop factor is not a positive number")
        if job.crop is not None and job.crop * LARGER < crop:
            raise ValueError(
                f"it was calibrated on a sensor of crop factor {crop:g}, and images of crop factor "
                f"{job.crop:g} show more than that: it has no data there"
            )
        if job.crop is not None:
            pitch_by_crop(job.crop, size)  # which is refused; the file's own is told of
        aspect = float(Fraction(*map(float_fraction, lens.findtext("aspect-ratio", "3:2").split(":"))))
        unit = (
            math.hypot(*(side - 1 for side in size)) / 2 * (job.crop or crop) / crop / math.hypot(aspect, 1)
        )
        middle = (np.array(size) - 1) / 2
        place = lens.find("center")
        offset = [0.0, 0.0] if place is None else [float(place.get(axis, "0")) for axis in "xy"]
        centre = middle + np.array(offset) * (min(size) - 1) / 2
        entries = [e for e in lens.findall("calibration/distortion") if e.attrib["model"] != "none"]
        if not entries:
            return Contents((), size, "mm")
        kinds = dict.fromkeys(entry.attrib["model"] for entry in entries)
        entries = [entry for entry in entries if entry.attrib["model"] == next(iter(kinds))]
        pairs = [(float(entry.attrib["focal"]), _read_terms(entry.attrib)) for entry in entries]
        found = dict(reversed(pairs))
        focal = np.array(sorted(found))
        terms = np.array([found[f] for f in focal]).reshape(len(focal), -1)
        ratio = math.hypot(*size) / 2 / unit

        def between(number: int, share: float) -> Node:
            at = float(focal[number] + share * (focal[number + 1] - focal[number]))
            return Node(at, *_formula(self.interpolate(focal, terms, at), ratio), centre)

        def polynomial(at: float) -> np.ndarray:
            return _polynomial(self.interpolate(focal, terms, at))

        nodes = tuple(
            Node(float(f), *_formula(row, ratio), centre) for f, row in zip(focal, terms, strict=True)
        )
        scaled = any(node.form.any_scale for node in nodes)
        low, high = float(focal[0]) / SPARE, float(focal[-1]) * SPARE
        return Contents(
            nodes,
            size,
            "mm",
            (*_others(kinds), *not_alike(pairs), *(_SCALED,) * scaled),
            pixel_pitch=FILM / ((job.crop or crop) * math.hypot(*size)),
            about={
                "lens": plain(lens.findtext("model", "")),
                "maker": plain(lens.findtext("maker", "")),
                "crop_factor": job.crop or crop,
            },
            between=between,
            table=RadialTable(tuple(focal.tolist()), (low, high), polynomial, ratio, scaled),
        )


def _others(kinds: Iterable[str]) -> tuple[str, ...]:
    """What is said of entries of other models than the first, which lensfun leaves out."""
    first, *others = kinds or ("",)
    if not others:
        return ()
    names = plain(", ".join(others))
    return (f"Entries of the model {names} are left out, as by lensfun: the first is {plain(first)}.",)


def float_fraction(text: str) -> Fraction:
    """A number of a ratio."""
    return Fraction(text.strip())


def _chosen(job: Import) -> ET.Element:
    """The lens that was named, or the only one."""
    lenses = [
        lens
        for path in job.paths
        for lens in ET.parse(path).getroot().iter("lens")
        if lens.find("calibration/distortion") is not None
    ]
    wanted = (job.name or "").lower()
    found = [lens for lens in lenses if wanted in _title(lens).lower()]
    if len(found) == 1:
        return found[0]
    exact = [lens for lens in found if _title(lens).lower() == wanted]
    if len(exact) == 1:
        return exact[0]
    if not found:
        raise ValueError(f"none of its {len(lenses)} lenses with a distortion has {job.name!r} in its name")
    names = ", ".join(repr(plain(_title(lens))) for lens in found[:3])
    raise ValueError(f"argument name must choose one of {len(found)} lenses, such as {names}")


def _title(lens: ET.Element) -> str:
    return f"{lens.findtext('maker', '')} {lens.findtext('model', '')}".strip()


def _read_terms(words: dict[str, str]) -> list[float]:
    """The terms of an entry: k1, k2 of poly5, or a, b, c."""
    model = words["model"]
    if model == "poly5":
        return [float(words.get(name, 0)) for name in ("k1", "k2")]
    if model == "poly3":
        return [0.0, float(words.get("k1", 0)), 0.0]
    if model == "ptlens":
        return [float(words.get(name, 0)) for name in "abc"]
    raise ValueError(f"its distortion model {plain(model)!r} is not poly3, poly5 or ptlens")


def _formula(terms: np.ndarray, ratio: float) -> tuple[AbstractForm, np.ndarray]:
    """The formula of terms and its coefficients for radii in half diagonals, `ratio` units each."""
    if len(terms) == 2:
        form = Form(2)
        return form, form.rescaled(terms, ratio)
    form = PtLens()
    return form, form.rescaled(of_unit_slope(_polynomial(terms)[:4]), ratio)


def _polynomial(terms: np.ndarray) -> np.ndarray:
    """Distorted over corrected radius, by powers of the corrected one."""
    if len(terms) == 2:
        return np.array([1.0, 0.0, terms[0], 0.0, terms[1]])
    a, b, c = terms
    return np.array([1 - a - b - c, c, b, a, 0.0])


def of_unit_slope(g: np.ndarray) -> np.ndarray:
    """The same curve for corrected radii so scaled that the factor is 1 at the centre."""
    if not g[0] > 0:
        raise ValueError("its distortion is no map: the factor at the centre is not positive")
    return g / g[0] ** np.arange(1, 5)


def _theta(terms: np.ndarray, job: Export) -> np.ndarray:
    return _formula(terms, job.lens.scale / _unit(job.lens.image_size))[1]


def radius_of_one(g: np.ndarray) -> float:
    """The corrected radius whose distorted one is 1."""
    roots = np.roots([*g[::-1], -1.0])
    real = roots[(abs(roots.imag) < 1e-9) & (roots.real > 0)].real
    if not real.size:
        raise ValueError("The lens is too strong for ptlens, the polynomial of lensfun and Hugin.")
    return float(real.min())


def _unit(size: tuple[int, int]) -> float:
    """px that are radius 1, at the crop factor of the calibration."""
    return math.hypot(size[0] - 1, size[1] - 1) / 2 / math.hypot(max(size) / min(size), 1)


def _crop(size: tuple[int, int], pitch: float) -> float:
    return FILM / (math.hypot(*size) * pitch)
