"""What the OpenCV family shares: a camera matrix, and coefficients for radii in focal lengths.

Its formula maps corrected to distorted points, ``x_d = x (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ +
k6 r⁶)`` and decentering p1, p2, with x in focal lengths from the principal point, which is the centre of
distortion. Files order the coefficients k1 k2 p1 p2 k3 k4 k5 k6, and count pixels from pixel centres.
"""

import dataclasses
import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from ..models.distortion_model import AbstractRadial
from ..models.lens import ZoomLens
from ._forms import Form
from .base import Contents, Export, Import, InterpolatedFormat, Node

_SQUARE = 0.01
"""Share by which fx and fy may differ."""

_SAME = 0.01
"""Share by which pixel pitches of several focal lengths may differ: labels on lenses are rounded."""

_ALIKE = 1e-4
"""The same without a word."""


ROUNDED = 0.03
"""Share by which focal lengths engraved on a lens may differ from those of a file."""


@dataclasses.dataclass(frozen=True)
class Pinhole:
    """One camera of the OpenCV family.

    Attributes:
        focal: focal length in the lens's unit.
        f: focal length in px.
        centre: principal point, px from the centre of the top-left pixel.
        k: radial coefficients, k1, k2, ..., without gaps: numerators, then denominators.
        p: p1 and p2.
        stretch: by how much fx and fy are more than `f`, as a factor.
    """

    focal: float
    f: float
    centre: np.ndarray
    k: np.ndarray
    p: np.ndarray
    stretch: tuple[float, float] = (1.0, 1.0)

    @property
    def coefficients(self) -> list[float]:
        """In OpenCV's order: k1, k2, p1, p2, k3, ..."""
        return [*self.k[:2].tolist(), *self.p.tolist(), *self.k[2:].tolist()]


def formula(lens: ZoomLens, numerators: int, denominators: int = 0) -> Form:
    """OpenCV's formula, with decentering where the lens has it."""
    return Form(numerators, denominators, tangential=not isinstance(lens.distortion_model, AbstractRadial))


class Pinholes(InterpolatedFormat):
    """A format whose tool interpolates camera matrices and coefficients for radii in focal lengths."""

    def foreign(self, node: Node, job: Export) -> np.ndarray:
        """Focal length in px, centre, coefficients in its units."""
        f = float(job.focal_px(node.focal))
        return np.concatenate([[f], node.centre, node.form.rescaled(node.theta, f / job.lens.scale)])

    def native(self, numbers: np.ndarray, focal: float, like: Node, job: Export) -> Node:
        """What the tool makes of interpolated numbers."""
        theta = like.form.rescaled(numbers[3:], job.lens.scale / numbers[0])
        return dataclasses.replace(like, focal=focal, theta=theta, centre=numbers[1:3])


def pinhole(node: Node, job: Export) -> Pinhole:
    """A node as a camera; ValueError if the focal length in px is not known."""
    assert isinstance(node.form, Form)
    f = float(job.focal_px(node.focal))
    numerators, denominators, p = node.form.split(node.form.rescaled(node.theta, f / job.lens.scale))
    return Pinhole(node.focal, f, node.centre, np.concatenate([numerators, denominators]), p)


def node_of(camera: Pinhole, size: tuple[int, int], *, numerators: int = 3) -> Node:
    """The node of a camera whose coefficients past the `numerators` are denominators."""
    numbers = np.array([camera.f, *camera.centre, *camera.k, *camera.p], float)
    if not np.isfinite(numbers).all() or camera.f <= 0:
        raise ValueError("its focal lengths and coefficients must be finite numbers")
    if len(camera.k) > 6 and np.any(camera.k[6:]):
        raise ValueError("it has coefficients beyond k6 (thin prism, tilt), which zoomjax has no model of")
    k = camera.k[:6]
    form = Form(min(len(k), numerators), max(len(k) - numerators, 0), tangential=True)
    theta = form.rescaled(np.concatenate([k, camera.p]), math.hypot(*size) / 2 / camera.f)
    return Node(camera.focal, form, theta, np.asarray(camera.centre, float), stretch=camera.stretch)


def from_opencv(focal: float | None, matrix: Any, coefficients: Any, size: tuple[int, int]) -> Node:
    """The node of a camera matrix and coefficients in OpenCV's order; its focal length is in px if None."""
    (fx, skew, cx), (_, fy, cy), _ = np.asarray(matrix, float).reshape(3, 3)
    if skew:
        raise ValueError(f"its camera matrix is skewed, by {skew:g}, and zoomjax has no model of that")
    f, stretch = focal_px(fx, fy)
    values = np.asarray(coefficients, float).ravel()
    values = np.append(values, np.zeros(max(0, 4 - len(values))))
    k, p = np.append(values[:2], values[4:]), values[2:4]
    return node_of(Pinhole(f if focal is None else focal, f, np.array([cx, cy]), k, p, stretch), size)


def focal_px(fx: Any, fy: Any) -> tuple[float, tuple[float, float]]:
    """The focal length in px of pixels that are nearly square, and what it is times for x and for y.

    Raises:
        ValueError: the pixels are not square.
    """
    fx, fy = float(fx), float(fy)
    if not (math.isfinite(fx) and math.isfinite(fy) and fx > 0 and fy > 0):
        raise ValueError("its focal lengths in px must be positive numbers")
    if abs(fx - fy) > _SQUARE * max(fx, fy):
        raise ValueError(f"its pixels are not square: fx is {fx:g} and fy is {fy:g}")
    f = (fx + fy) / 2
    return f, (fx / f, fy / f)


def contents(
    nodes: list[Node],
    size: tuple[int, int],
    job: Import,
    *,
    px: list[float] | None = None,
    mm: bool = False,
) -> Contents:
    """Of cameras with focal lengths in px, or in mm if the file or argument focal has such.

    Args:
        nodes: the cameras.
        size: (width, height) px.
        job: what is given.
        px: focal length of each in px; by default that of the node, as for a file in px.
        mm: whether the nodes' own focal lengths are in mm.
    """
    px = [node.focal for node in nodes] if px is None and not mm else px
    if job.focal is not None:
        if len(job.focal) != len(nodes):
            raise ValueError(f"argument focal must hold {len(nodes)} focal lengths, one for each camera")
        nodes = [dataclasses.replace(n, focal=f) for n, f in zip(nodes, job.focal, strict=True)]
        mm = job.focal_unit == "mm"
        if px is not None and not mm:
            raise ValueError("it holds its focal lengths in px: leave out arguments focal and focal_unit")
    pitch, notes = None, ()
    if mm and px is not None and not any(node.focal_px for node in nodes):
        pitch, notes = pitch_of([node.focal for node in nodes], px)
    return Contents(tuple(nodes), size, "mm" if mm else "px", notes, pixel_pitch=pitch)


def refuse_other_focals(own: Iterable[float], job: Import, *, pitch: float | None = None) -> None:
    """Raise ValueError where argument focal has other focal lengths than a file, which says them in mm.

    The order of the file may be another one. Those in px are compared where it says the width of a pixel.
    """
    unit, one = job.focal_unit, 1.0 if job.focal_unit == "mm" else pitch
    for mm, given in zip(own, job.focal or (), strict=False):
        if one is not None and abs(given * one - mm) > ROUNDED * mm:
            raise ValueError(
                f"its focal length is {mm / one:g} {unit}, and argument focal has {given:g} {unit} there: "
                "leave that out"
            )


def pitch_of(mm: list[float], px: list[float]) -> tuple[float | None, tuple[str, ...]]:
    """The pixel pitch of focal lengths in mm and in px, None where they contradict, and a note of that."""
    found = np.array(mm) / np.array(px)
    mean = float(found.mean()) if found.size else math.nan
    apart = float(np.ptp(found)) / mean if found.size else 0.0
    if not apart > _ALIKE:
        return mean, ()
    told = f"Its focal lengths in mm and in px are of pixels that differ by up to {100 * apart:.2g} %: "
    if apart > _SAME:
        return None, (told + "their size is left open.",)
    return mean, (
        told + "that of the lens is their mean, and its focal lengths in px are off by half of that.",
    )


def matrix_rows(camera: Pinhole) -> list[list[float]]:
    """The camera matrix."""
    return [
        [camera.f, 0.0, float(camera.centre[0])],
        [0.0, camera.f, float(camera.centre[1])],
        [0.0, 0.0, 1.0],
    ]


def numbers(values: Any) -> str:
    """Numbers with all digits, separated by commas."""
    return ", ".join(repr(float(value)) for value in np.ravel(values))


def data_of(value: Any) -> np.ndarray:
    """A matrix: OpenCV's or ROS's with its data, or lists."""
    if not isinstance(value, dict):
        return np.asarray(value, float)
    data = np.asarray(value["data"], float)
    sides = [int(value[side]) for side in ("rows", "cols") if side in value]
    if len(sides) == 2 and data.size != sides[0] * sides[1]:
        raise ValueError(f"a matrix of {sides[0]} x {sides[1]} has {data.size} numbers")
    return data
