"""Pairs of distorted and corrected points over an image."""

import math

import numpy as np
from jaxtyping import Float

from .._core.text import plain
from ..models.distortion import Distortion
from ..models.distortion_model import AbstractRadial
from ..models.lens import ZoomLens
from ..models.tables import TableZoom
from .base import Node

_RAYS, _RADII, _ONE_RAY = 16, 48, 96
"""Points lie on rays from the centre, to the corners and in between, denser towards the border; if all rays
are alike, as many on one. Errors are looked at there: with half of them those of seven coefficients are
found up to a tenth less."""

_AT_ONCE = 16
"""Focal lengths that a lens is asked for at once: JAX compiles for each number of them."""

Pairs = tuple[np.ndarray, np.ndarray]
"""Distorted and corrected points, or what a formula maps and what to, each (point, 2)."""

_BEYOND, _STEPS = 4.0, 800
"""How far the corrected radius is followed, in units of the corner's, and in how many steps."""


def distortions(lens: ZoomLens, focal: Float[np.ndarray, "focal"]) -> list[Distortion]:
    """The distortion at each focal length, of NumPy arrays in float64."""
    if isinstance(lens.zoom, TableZoom) and lens.shift is None:  # each of which JAX would compile anew
        lens.check_range(focal, stacklevel=3)
        k, centre = _of_table(lens.zoom, np.asarray(focal, float)), np.asarray(lens.centre, float)
        return [Distortion(row, centre, np.float64(lens.scale), lens.distortion_model) for row in k]
    found = []
    for first in range(0, len(focal), _AT_ONCE):
        part = np.asarray(focal[first : first + _AT_ONCE], float)
        many = lens(np.pad(part, (0, _AT_ONCE - len(part)), mode="edge"))
        k = np.asarray(many.coefficients, float)
        centre = np.broadcast_to(np.asarray(many.centre, float), (_AT_ONCE, 2))
        found += [
            Distortion(k[i], centre[i], np.float64(lens.scale), many.distortion_model)
            for i in range(len(part))
        ]
    return found


def _of_table(zoom: TableZoom, focal: np.ndarray) -> np.ndarray:
    """The coefficients of a table, by NumPy."""
    knots, values = np.asarray(zoom.knots, float), np.asarray(zoom.parameters, float)
    x = 1 / focal if zoom.inverse else focal
    return np.stack([np.interp(x, knots, column) for column in values.T], axis=-1)


def pairs(
    each: list[Distortion], size: tuple[int, int], focal: Float[np.ndarray, "focal"], *, all_rays: bool
) -> list[Pairs]:
    """Distorted and corrected points of an image at focal lengths, in half diagonals from the centre.

    A radial distortion is the same in all directions: one ray, to the farthest corner, tells it all unless
    `all_rays` are asked for.

    Raises:
        ValueError: the image folds over.
    """
    first = each[0]
    centres, scale = np.array([one.centre for one in each], float), float(first.scale)
    ends = np.array([border(size, centre) for centre in centres])
    one = isinstance(first.distortion_model, AbstractRadial) and not all_rays
    if one:
        farthest = np.argmax(np.hypot(ends[..., 0], ends[..., 1]), axis=1)
        ends = ends[np.arange(len(ends)), farthest][:, None]
    part = np.sin(np.linspace(0, np.pi / 2, (_ONE_RAY if one else _RADII) + 1)[1:])
    distorted = (part[:, None, None] * ends[:, None]).reshape(len(each), -1, 2)
    k = np.array([one.coefficients for one in each], float)
    together = Distortion(k, centres, np.full(len(each), scale), first.distortion_model)
    corrected = np.asarray(together.undistort(distorted + centres[:, None])) - centres[:, None]
    whole = np.isfinite(corrected).all(axis=(1, 2))
    if not whole.all():
        where = f"{focal[np.argmin(whole)]:g}"
        raise ValueError(
            f"The lens folds over within the image at the focal length {where}, and has no corrected "
            "points there: zj.models.certify says where. Fit it again with fewer terms, or export focal "
            "lengths at which it does not."
        )
    return list(zip(distorted / scale, corrected / scale, strict=True))


def border(size: tuple[int, int], centre: np.ndarray) -> Float[np.ndarray, "ray 2"]:
    """The ends of rays on the border of the image, from the centre: all corners, and points between."""
    width, height = np.array(size) - 1.0
    part = np.linspace(0, 1, _RAYS // 4, endpoint=False)[:, None]
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]])
    sides = [
        start + part * (end - start) for start, end in zip(corners, np.roll(corners, -1, 0), strict=True)
    ]
    return np.concatenate(sides) - centre


def pairs_of(node: Node, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, bool]:
    """Distorted and corrected points of an image by a tool's formula, in half diagonals from the centre.

    Corrected points are followed outwards until their distorted ones leave the image, or turn back.

    Returns:
        Both, and whether the formula reaches the border of the image everywhere.
    """
    scale = math.hypot(*size) / 2
    ends = border(size, node.centre) / scale
    ends = ends[np.any(ends != 0, axis=1)]  # the centre may be a corner
    length = np.hypot(*ends.T)
    part = np.sin(np.linspace(0, np.pi / 2, _RADII + 1)[1:])
    if node.form.corrects:
        distorted = (part[:, None, None] * ends).reshape(-1, 2)
        corrected = node(distorted)
        grows = np.diff(np.hypot(*corrected.T).reshape(_RADII, -1), axis=0, prepend=0) > 0
        keep = np.logical_and.accumulate(grows, axis=0).ravel()
        return distorted[keep], corrected[keep], bool(keep.all())
    chosen, whole = [], True
    for direction, end in zip(ends / length[:, None], length, strict=True):
        radius = np.linspace(0, _BEYOND * end, _STEPS + 1)[1:]
        reached = np.hypot(*node(radius[:, None] * direction).T)
        rises = np.diff(reached, prepend=0) > 0
        last = len(radius) if rises.all() else int(np.argmin(rises))
        if last == 0:
            raise ValueError(f"its distortion at the focal length {plain(f'{node.focal:g}')} is no map")
        whole &= bool(reached[last - 1] >= end)
        chosen.append(np.interp(part * end, reached[:last], radius[:last])[:, None] * direction)
    corrected = np.concatenate(chosen)
    return node(corrected), corrected, whole
