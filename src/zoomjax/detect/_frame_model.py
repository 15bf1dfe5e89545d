"""The distortion of one frame, from its longest borders, to tell what runs straight across the image.

A working model for joining only, in NumPy: numbers of lines and points differ from frame to frame, and JAX
would compile for each. Two radial terms and two decentering ones (Brown's p1 and p2, for a centre of
distortion that is not the image's), all linear, minimise eq. 3, with lines that do not become straight
(arcs, folds in a cloth) weighted down as a whole.
"""

import numpy as np

_PRIOR = np.array([1.0, 1.0, 0.02, 0.02])
"""Standard deviations of k1, k2, p1, p2 before anything is seen: real lenses have less."""

_STEPS = 8
_LEAST_SPREAD = 0.1
"""px: a spread of the lines' errors that noise alone gives. Below, no line is doubtful."""


class OneFrame:
    """Radial and decentering distortion about the centre of an image of one size."""

    def __init__(self, image_size: tuple[int, int]):
        self.centre = (np.array(image_size) - 1) / 2
        self.scale = np.hypot(*image_size) / 2
        self.k = np.zeros(4)  # k1, k2, p1, p2, normalised

    def undistort(self, points: np.ndarray) -> np.ndarray:
        """Corrected positions of points (..., 2), px."""
        x, y = ((points[..., axis] - self.centre[axis]) / self.scale for axis in (0, 1))
        t = x * x + y * y
        k1, k2, p1, p2 = self.k
        factor = 1 + t * (k1 + t * k2) + 2 * (p1 * x + p2 * y)
        corrected = np.empty(points.shape)
        corrected[..., 0] = self.centre[0] + self.scale * (x * factor + p1 * t)
        corrected[..., 1] = self.centre[1] + self.scale * (y * factor + p2 * t)
        return corrected

    def fit(self, lines: list[np.ndarray], samples: int = 64) -> None:
        """Find the coefficients that straighten lines, (n, 2) px each; leave them if there is none.

        Gauss-Newton on eq. 3 for the normals of each step, from the coefficients as they are. `samples` of
        each line's points are used.
        """
        if not lines:
            return
        chosen = [line[np.linspace(0, len(line) - 1, samples).round().astype(int)] for line in lines]
        z = (np.stack(chosen) - self.centre) / self.scale
        basis = np.stack([z, *_columns(z)], axis=1)
        basis -= basis.mean(axis=2, keepdims=True)  # (line, term, sample, 2)
        for _ in range(_STEPS):
            corrected = basis[:, 0] + np.einsum("k,lksc->lsc", self.k, basis[:, 1:])
            normal = normals(corrected)
            error = np.einsum("lsc,lc->ls", corrected, normal)
            weight = _weights(self.scale * np.sqrt(np.mean(error**2, axis=1))) * self.scale**2
            slope = np.einsum("lksc,lc->lks", basis[:, 1:], normal)
            hessian = np.einsum("l,lks,ljs->kj", weight, slope, slope) + np.diag(_PRIOR**-2.0)
            gradient = np.einsum("l,lks,ls->k", weight, slope, error) + self.k / _PRIOR**2
            self.k = self.k - np.linalg.solve(hessian, gradient)


def _columns(z: np.ndarray) -> np.ndarray:
    """(4, ..., 2), what a unit of each coefficient adds to normalised positions (..., 2)."""
    x, y = z[..., 0], z[..., 1]
    t = x * x + y * y
    return np.stack(
        [
            t[..., None] * z,
            (t * t)[..., None] * z,
            np.stack([t + 2 * x * x, 2 * x * y], axis=-1),
            np.stack([2 * x * y, t + 2 * y * y], axis=-1),
        ]
    )


def normals(centred: np.ndarray) -> np.ndarray:
    """(l, 2), the unit normals of the best lines through points (l, s, 2) about their mean."""
    x, y = np.moveaxis(centred, -1, 0)
    xx, xy, yy = np.sum(x * x, axis=-1), np.sum(x * y, axis=-1), np.sum(y * y, axis=-1)
    angle = np.arctan2(2 * xy, xx - yy) / 2
    return np.stack([-np.sin(angle), np.cos(angle)], axis=-1)


def _weights(rms: np.ndarray) -> np.ndarray:
    """Of whole lines, by their errors, px: Geman and McClure's, with the median as the scale."""
    spread = max(2 * float(np.median(rms)), _LEAST_SPREAD)
    return 1 / (1 + (rms / spread) ** 2) ** 2
