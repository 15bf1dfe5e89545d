"""How far the correction moves a point outward: what tables, plots and reports say of a lens."""

from collections.abc import Iterable

import numpy as np

from ..models.lens import ZoomLens


def outward(lens: ZoomLens, points: np.ndarray, focal: Iterable[float]) -> np.ndarray:
    """Displacement of points (..., 2) away from the centre of distortion, px, at each focal length, first.

    The centre is that at the focal length, if it moves along the zoom.
    """

    def at(f):
        distortion = lens(float(f))
        centre = np.asarray(distortion.centre)
        before, after = points - centre, np.asarray(distortion.undistort(points)) - centre
        return np.hypot(after[..., 0], after[..., 1]) - np.hypot(before[..., 0], before[..., 1])

    return np.stack([at(f) for f in focal])
