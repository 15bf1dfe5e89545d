"""The lens at many focal lengths, as numbers for the report's slider: a bent grid and a curve.

Computed once per report; the page draws them without computing a lens itself.
"""

from typing import Any

import numpy as np

from ..fit.result import ZoomFit
from ..trust.bands import displacement_std
from .outward import distortion_at, middle_centre, outward

_STEPS, _RADII, _CELLS, _PER_CELL = 41, 25, 12, 3
_VISIBLE = 0.03  # of the longer side: how far the grid is bent at least, where that is most
_EXAGGERATIONS = np.outer(10.0 ** np.arange(7), (1, 2, 5)).ravel()


def slider(fit: ZoomFit) -> dict[str, Any] | None:
    """What the slider shows, rounded, for JSON; None for a lens of one focal length.

    Returns:
        ``focal`` and ``corner`` (displacement, px) of each step; ``grid``: the polylines of each step in
        px, distorted and exaggerated by ``times``; ``straight``: the polylines undistorted; ``radius``,
        ``moved`` and ``std``: the displacement along the radius, px, and its deviation, of each step.
    """
    lens = fit.lens
    low, high = (float(f) for f in lens.focal_range)
    if not low < high:
        return None
    focals = 1 / np.linspace(1 / low, 1 / high, _STEPS)
    centre, size = middle_centre(lens), np.array(lens.image_size)
    straight = _grid(size)
    joints = np.concatenate(straight)
    bent = distortion_at(lens, focals).distort(np.broadcast_to(joints, (len(focals), *joints.shape)))
    off = np.asarray(bent) - joints
    far = float(np.nanmax(np.hypot(*np.moveaxis(off, -1, 0)), initial=0.0))
    enough = _EXAGGERATIONS[_EXAGGERATIONS * far >= _VISIBLE * max(size)]
    times = float(enough[0]) if len(enough) else 1.0
    corner = np.where(centre > (size - 1) / 2, 0.0, size - 1)
    share = np.linspace(0, 1, _RADII)[:, None]
    along = centre + share * (corner - centre)
    moved = outward(lens, along, focals)
    std = np.asarray(displacement_std(fit, along[None], focal=focals[:, None]))
    ends = np.cumsum([len(line) for line in straight])[:-1]
    return {
        "unit": lens.focal_unit,
        "size": size.tolist(),
        "times": times,
        "focal": [float(f"{f:.5g}") for f in focals],
        "straight": [_rounded(line, 0) for line in straight],
        "grid": [[_rounded(line, 0) for line in np.split(joints + times * of, ends)] for of in off],
        "radius": _rounded(np.hypot(*(along - centre).T), 0),
        "moved": [_rounded(row, 3) for row in moved],
        "std": [_rounded(row, 3) for row in std],
    }


def _grid(size: np.ndarray) -> list[np.ndarray]:
    """Lines across and down the image, with points between the crossings."""
    cells = np.maximum(2, np.round(_CELLS * size / max(size)).astype(int))
    x, y = (np.linspace(0, side - 1, _PER_CELL * n + 1) for side, n in zip(size, cells, strict=True))
    lines = [np.stack(np.broadcast_arrays(at, y), -1) for at in x[::_PER_CELL]]
    return lines + [np.stack(np.broadcast_arrays(x, at), -1) for at in y[::_PER_CELL]]


def _rounded(values: np.ndarray, digits: int) -> list[Any]:
    """For JSON, which has no NaN: None where a lens folds, or its deviation is not known."""
    rounded = np.round(np.asarray(values, float), digits)
    if np.isfinite(rounded).all():
        return (rounded if digits else rounded.astype(int)).tolist()
    kept = rounded.astype(object)
    kept[~np.isfinite(rounded)] = None
    return kept.tolist()
