"""Errors of corrections in px of the image: of points about their lines, and beyond a homography.

In NumPy, for many points at once and coefficients of each line; `z` are points from the centre of
distortion, in half diagonals.
"""

import numpy as np

from ..models.distortion_model import AbstractDistortionModel

_GRID = (15, 11)
"""Points over the image."""

_STEP = 1e-5
_LEAST_STRETCH = 1e-6
_LEAST_SOUND = 8


def corrected(distortion_model: AbstractDistortionModel, z: np.ndarray, k: np.ndarray) -> np.ndarray:
    """Corrected points (..., s, 2) by coefficients (..., n)."""
    x, y = np.moveaxis(z, -1, 0)
    return np.stack(
        distortion_model.correct((x, y), x * x + y * y, np.moveaxis(k, -1, 0)[..., None]), axis=-1
    )


def derivatives(
    distortion_model: AbstractDistortionModel, z: np.ndarray, k: np.ndarray, by_parameter: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corrected points (..., s, 2), and derivatives by the points, (..., s, 2, 2), and by all parameters.

    These are those of the zoom model and the place of the centre: (..., s, 2, p + 2).
    """

    def slope(moved_z, moved_k):
        plus, minus = (
            corrected(distortion_model, z + sign * moved_z, k + sign * moved_k) for sign in (_STEP, -_STEP)
        )
        return (plus - minus) / (2 * _STEP)

    with np.errstate(all="ignore"):  # beyond a pole
        by_point = np.stack([slope(unit, 0) for unit in np.eye(2)], axis=-1)
        by_k = np.stack([slope(0, unit) for unit in np.eye(k.shape[-1])], axis=-1)
        at = corrected(distortion_model, z, k)
    by_zoom = np.einsum("...sck,...kp->...scp", by_k, by_parameter)
    return at, by_point, np.concatenate([by_zoom, np.eye(2) - by_point], axis=-1)


def residuals(
    distortion_model: AbstractDistortionModel, z: np.ndarray, k: np.ndarray, by_parameter: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distances (l, s) of points to their lines, in the image, and their derivatives (l, s, p + 2).

    The best line follows the parameters: what a shift or a turn of it explains is taken out of these.
    Distances are NaN of a line that is moved nowhere, beyond a pole.
    """
    at, by_point, by_all = derivatives(distortion_model, z, k, by_parameter)
    nowhere = ~(np.isfinite(at).all(axis=(1, 2)) & np.isfinite(by_all).all(axis=(1, 2, 3)))
    at[nowhere], by_point[nowhere], by_all[nowhere] = z[nowhere], np.eye(2), 0
    *_, stretch = _best_lines(at, by_point, np.ones(at.shape[:2]))  # good enough for the stretch across it
    centred, along, normal, stretch = _best_lines(at, by_point, stretch**-2.0)
    error = np.einsum("lsc,lc->ls", centred, normal) / stretch
    error[nowhere] = np.nan
    slope = np.einsum("lscp,lc->lsp", by_all, normal) / stretch[..., None]
    free = np.stack([np.ones_like(stretch), np.einsum("lsc,lc->ls", centred, along)], axis=-1)
    basis = np.linalg.qr(free / stretch[..., None])[0]
    return error, slope - basis @ (np.swapaxes(basis, 1, 2) @ slope)


def _best_lines(at: np.ndarray, by_point: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, ...]:
    """Points about their mean, the directions along lines and across, and the stretch across at points."""
    mean = np.einsum("ls,lsc->lc", weight, at) / weight.sum(axis=1)[:, None]
    centred = at - mean[:, None]
    along, normal = _axes(np.einsum("ls,lsc,lsd->lcd", weight, centred, centred))
    stretch = np.linalg.norm(np.einsum("lsck,lc->lsk", by_point, normal), axis=-1).clip(_LEAST_STRETCH)
    return centred, along, normal, stretch


def _axes(scatter: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The unit vectors of most and of least scatter."""
    vectors = np.linalg.eigh(scatter)[1]
    return vectors[..., 1], vectors[..., 0]


def over_image(size: tuple[int, int]) -> np.ndarray:
    """Points over an image, (n, 2) px."""
    sides = (np.linspace(0.02, 0.98, n) * (side - 1) for n, side in zip(_GRID, size, strict=True))
    return np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)


def beyond(at: np.ndarray, by_point: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Displacements (n, 2, m) of corrected points, in the image, less the homography nearest to each.

    Args:
        at: (n, 2), corrected points.
        by_point: (n, 2, 2), their derivatives by the points of the image. Points beyond a fold, or moved
            nowhere, are left out; all, if there are too few others.
        moved: what displaces them.
    """
    with np.errstate(all="ignore"):
        sound = np.isfinite(moved).all(axis=(1, 2)) & np.isfinite(by_point).all(axis=(1, 2))
        sound &= np.linalg.det(by_point) > 0
    if sound.sum() < _LEAST_SOUND:
        return moved[:0]
    at, moved, into = at[sound], moved[sound], np.linalg.inv(by_point[sound])
    x, y = ((at - at.mean(axis=0)) / np.abs(at - at.mean(axis=0)).max()).T
    one, none = np.ones_like(x), np.zeros_like(x)
    free = np.array(
        [[x, y, one, none, none, none, x * x, x * y], [none, none, none, x, y, one, x * y, y * y]]
    )
    free = (into @ np.moveaxis(free, -1, 0)).reshape(-1, 8)
    rows = (into @ moved).reshape(2 * len(at), -1)
    return (rows - free @ np.linalg.lstsq(free, rows, rcond=None)[0]).reshape(len(at), 2, -1)
