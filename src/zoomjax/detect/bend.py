"""How bent images are, as detectors take them: to compare, and to hand on from one image to another."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from ._frame_model import OneFrame, extent

Bend = tuple[float, float, float, float]
"""As `Edges.bend`: k1 and k2 of the division model, and the place of its centre."""

_REACH = 0.8
"""Of the half diagonal: how far out two are compared. Beyond, few images have lines."""

_CHORDS = np.linspace(-0.6, 0.6, 7)
"""Where lines are, level and upright, in half diagonals from the centre."""

_POINTS, _LEAST_POINTS = 33, 8


def bend_of(
    image_size: tuple[int, int], centre: np.ndarray, undistort: Callable[[np.ndarray], np.ndarray]
) -> Bend:
    """How bent a radial correction of points (n, 2), px, about a centre takes images to be."""
    return OneFrame.of_correction(image_size, centre, undistort).values


def bends_apart(image_size: tuple[int, int], one: Sequence[float], other: Sequence[float]) -> float:
    """px, RMS, by which lines that are straight by the one are bent by the other."""
    model, judge = (OneFrame.of_values(image_size, bend) for bend in (one, other))
    points = _straight(model)
    inside = np.hypot(*np.moveaxis(points - model.centre, -1, 0)) < _REACH * model.scale
    some = [line[keep] for line, keep in zip(points, inside, strict=True) if keep.sum() >= _LEAST_POINTS]
    errors = [judge.errors(line[None])[0] for line in some]
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2))) if errors else 0.0


def straight_length(
    image_size: tuple[int, int], bend: Sequence[float], lines: Iterable[np.ndarray], within: float
) -> float:
    """px, the length of those lines that are straight by a model to so many px, RMS."""
    model = OneFrame.of_values(image_size, bend)
    rms = [(float(np.sqrt(np.mean(model.errors(line[None]) ** 2))), extent(line)) for line in lines]
    return sum((length for off, length in rms if off <= within), 0.0)


def _straight(model: OneFrame) -> np.ndarray:
    """(l, s, 2) px: points in the image on level and upright lines of the scene, by the model.

    Found on a grid of the image, in which the corrected height, or breadth, is constant along them.
    """
    width, height = model.image_size
    t = np.linspace(-1, 1, _POINTS)
    lines = []
    for place in _CHORDS:
        for axis in (0, 1):
            start = np.full((_POINTS, 2), place) * model.scale
            start[:, axis] = t * (width, height)[axis] / 2
            start += model.centre
            wanted = model.undistort(model.centre + np.eye(2)[[1 - axis]] * place * model.scale)[
                0, 1 - axis
            ]
            lines.append(_moved_to(model, start, 1 - axis, float(wanted)))
    return np.stack(lines)


def _moved_to(model: OneFrame, points: np.ndarray, axis: int, wanted: float) -> np.ndarray:
    """Points moved along an axis until their corrected coordinate is what is wanted, by secants."""
    step = np.zeros(2)
    step[axis] = 1.0
    for _ in range(8):
        value = model.undistort(points)[:, axis]
        slope = (model.undistort(points + step)[:, axis] - value).clip(0.05)
        move = ((wanted - value) / slope).clip(-0.1 * model.scale, 0.1 * model.scale)
        points = points + move[:, None] * step
    return points
