"""How the image moves from a frame to the next, as the camera's turning and zooming makes it."""

import cv2
import numpy as np
from jaxtyping import Float

Points = Float[np.ndarray, "point 2"]
Homography = Float[np.ndarray, "3 3"]

_FEWEST = 12
"""Points that tell a motion."""


def camera_motion(before: Points, after: Points, size: tuple[int, int]) -> Homography:
    """The homography that most points follow from a frame to the next; the identity where none is seen.

    Captions stay, and may be most of what is seen. So where most points stay but others move, those
    decide, if they move together and are all over the image.

    Args:
        before, after: the points in both frames, px.
        size: (width, height) px.
    """
    if len(before) < _FEWEST:
        return np.eye(3)
    within = 0.002 * float(np.hypot(*size))
    homography, _ = _fitted(before, after, within)
    corners = np.array([[0, 0], [size[0], 0], [0, size[1]], size], float)
    if np.linalg.norm(carried(homography, corners) - corners, axis=1).max() > 1:
        return homography
    moves = np.linalg.norm(after - before, axis=1) > 1
    if moves.sum() < max(_FEWEST, 0.15 * len(before)):
        return homography
    other, follow = _fitted(before[moves], after[moves], within)
    spread = np.ptp(before[moves][follow], axis=0) if follow.any() else np.zeros(2)
    together = follow.mean() > 0.7 and (spread > 0.5 * np.array(size)).all()
    return other if together else homography


def carried(homography: Homography, points: Points) -> Points:
    """The points that a homography makes of points."""
    flat = points @ homography[:, :2].T + homography[:, 2]
    return flat[:, :2] / flat[:, 2:]


def local_shape(homography: Homography, points: Points) -> Float[np.ndarray, "point 2 2"]:
    """The derivative of a homography at points."""
    third = points @ homography[2, :2] + homography[2, 2]
    after = carried(homography, points)
    slope = homography[None, :2, :2] - after[:, :, None] * homography[2, :2]
    return slope / third[:, None, None]


def _fitted(before: Points, after: Points, within: float) -> tuple[Homography, np.ndarray]:
    """The homography that most points follow, and which; the identity where there is none."""
    homography, inliers = cv2.findHomography(
        before, after, cv2.RANSAC, within, maxIters=300, confidence=0.995
    )
    if homography is None or not np.isfinite(homography).all():
        return np.eye(3), np.zeros(len(before), bool)
    return homography, inliers.ravel() > 0
