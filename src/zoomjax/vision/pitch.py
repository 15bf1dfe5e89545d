"""The white markings of a pitch: the lines that broadcast football is seen with.

Grass first (`grass`), then the middles of white ridges on it (`ridge_points`), linked into smooth pieces
(`fragments`), and the pieces of one marking joined where players stand on it (`joining`). Circles on the
pitch are ellipses in the image, and their flattest parts are tempting: a marking is a line only if it bends
no more than a lens makes it bend.
"""

import cv2
import numpy as np

from .detector import AbstractDetector
from .edges import as_grey
from .fragments import fragments
from .grass import find_grass
from .joining import joined
from .ridge_points import ridge_points

_LEAST_RADIUS = 4.0
"""Of the arc that a lens may bend a line to, in halves of the image's diagonal."""


class PitchDetector(AbstractDetector):
    least_length: float = 0.08

    def __call__(self, image: np.ndarray) -> list[np.ndarray]:
        grass = find_grass(image)
        if grass is None:
            return []
        pieces = fragments(ridge_points(image, grass))
        radius = _LEAST_RADIUS * np.hypot(*image.shape[:2]) / 2
        marking = joined(pieces, radius)
        label = marking[pieces.piece()]
        lines = []
        for m in np.unique(label):
            l = pieces.points[label == m]
            c = l - l.mean(0); _, _, v = np.linalg.svd(c, full_matrices=False)
            o = np.argsort(c @ v[0]); l = l[o]; t = (c @ v[0])[o]; d = (c @ v[1])[o]
            L = t[-1] - t[0]
            if L < self.least_length * np.hypot(*image.shape[:2]):
                continue
            q = np.polyfit(t, d, 2)
            R = 1 / max(abs(2 * q[0]), 1e-9)
            rms = np.sqrt(np.mean((d - np.polyval(q, t)) ** 2))
            if R < radius or rms > 2:
                continue
            lines.append(l)
        return lines
