"""Patches of the frames where tracks began, matched again in later frames, so that tracks do not drift.

A patch T around its anchor is fitted to an image I by a shift alone: ``I(x + A (o - d)) = a T(o) + b`` over
the offsets o of its pixels, weighted towards its middle, with the change of shape A that is known. That is
Gauss and Newton's method in the patch's frame (Baker, Matthews 2004, "inverse compositional"): the
derivatives of T and their normal matrix are computed once a patch, and an iteration samples I once.
"""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

HALF = 10
"""px from the middle of a patch to its border."""

_SIGMA = 6.0
"""px: of the Gauss weights."""

_STEPS, _ARRIVED = 12, 0.005
"""At most so many steps, until none is longer than so many px."""

Points = Float[np.ndarray, "point 2"]


def _grid(half: int) -> np.ndarray:
    """Offsets of the pixels of a patch: (pixel, 2)."""
    side = np.arange(-half, half + 1, dtype=np.float32)
    return np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)


_OFFSETS = _grid(HALF)
_WEIGHTS = np.exp(-np.sum(_OFFSETS**2, axis=1) / (2 * _SIGMA**2))
_WEIGHTS = (_WEIGHTS / _WEIGHTS.sum()).astype(np.float32)


class Patches:
    """Patches around the anchors of tracks, n of them, normalised to mean 0 and variance 1."""

    def __init__(self, values: np.ndarray, solve: np.ndarray):
        """From (n, pixel) values, and (n, 2, pixel) of what turns errors to steps."""
        self.values, self.solve = values, solve

    @classmethod
    def cut(cls, image: UInt8[np.ndarray, "height width"], anchors: Points) -> "Patches":
        """The patches of an image around points, each of which has its patch and a px more within it."""
        n, side = len(anchors), 2 * HALF + 3
        wide = _sampled(image, anchors[:, None] + _grid(HALF + 1)).reshape(n, side, side)
        values, scale = _normalised(wide[:, 1:-1, 1:-1].reshape(n, -1))
        across, down = wide[:, 1:-1, 2:] - wide[:, 1:-1, :-2], wide[:, 2:, 1:-1] - wide[:, :-2, 1:-1]
        slopes = np.stack([across.reshape(n, -1), down.reshape(n, -1)], axis=1)
        slopes /= 2 * scale[:, None, None]
        # What a change of brightness or contrast explains is taken out of the derivatives.
        level = slopes @ _WEIGHTS
        gain = (slopes @ (_WEIGHTS * values)[..., None])[..., 0]
        free = (slopes - level[..., None] - gain[..., None] * values[:, None]) * _WEIGHTS
        normal = (free @ slopes.swapaxes(1, 2)).astype(np.float64) + 1e-9 * np.eye(2)
        return cls(values, np.linalg.inv(normal).astype(np.float32) @ free)

    def __getitem__(self, which: np.ndarray) -> "Patches":
        return Patches(self.values[which], self.solve[which])

    def __add__(self, others: "Patches") -> "Patches":
        values = np.concatenate([self.values, others.values])
        return Patches(values, np.concatenate([self.solve, others.solve]))

    def matched(
        self,
        image: UInt8[np.ndarray, "height width"],
        points: Points,
        shapes: Float[np.ndarray, "point 2 2"],
    ) -> tuple[Points, Float[np.ndarray, "point"]]:
        """Where an image shows the patches, started from points, and the correlation there.

        Args:
            image: grey.
            points: where to begin: within some 3 px.
            shapes: of each patch, the change of shape from its own frame to the image.
        """
        points = points.astype(np.float64)
        moving = np.arange(len(points))
        likeness = np.full(len(points), -1.0)
        bent = (_OFFSETS @ shapes.swapaxes(1, 2)).astype(np.float32)
        for _ in range(_STEPS):
            places = points[moving, None].astype(np.float32) + bent[moving]
            found, _ = _normalised(_sampled(image, places))
            likeness[moving] = (found * self.values[moving]) @ _WEIGHTS
            step = (self.solve[moving] @ (found - self.values[moving])[..., None])[..., 0]
            step *= np.minimum(1, 2 / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9))
            points[moving] -= (shapes[moving] @ step[..., None])[..., 0]
            moving = moving[np.linalg.norm(step, axis=1) > _ARRIVED]
            if not len(moving):
                break
        return points, likeness


def _sampled(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Grey levels at (n, pixel, 2) places, (n, pixel)."""
    x, y = (np.ascontiguousarray(places[..., axis], np.float32) for axis in (0, 1))
    return cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float32)


def _normalised(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of mean 0 and variance 1, under the weights, and what they were divided by."""
    values = values - (values @ _WEIGHTS)[:, None]
    scale = np.maximum(np.sqrt(values**2 @ _WEIGHTS), 1e-3)
    return values / scale[:, None], scale
