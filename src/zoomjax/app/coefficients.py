"""The coefficients of a lens in px, for tables and summaries."""

from collections.abc import Iterable

import numpy as np

from ..models.lens import ZoomLens
from ..models.zoom import PolynomialZoom, number_of_coefficients
from .outward import distortion_at


def pixel_polynomials(lens: ZoomLens) -> np.ndarray:
    """Coefficients of ``f^(-j)`` (rows) of each coefficient (columns) in px, as printed in the paper.

    None, of shape (0, 0), for another model.
    """
    model = lens.zoom
    if not isinstance(model, PolynomialZoom):
        return np.zeros((0, 0))
    normalised = np.asarray(model.in_inverse_focal())
    orders = lens.distortion_model.orders(normalised.shape[1])
    return normalised / lens.scale**orders


def coefficient_names(lens: ZoomLens) -> dict[str, int]:
    """Names of the coefficients, k1, ..., kN and p1, p2, and the powers of 1/px in their units."""
    distortion_model = lens.distortion_model
    size = number_of_coefficients(lens.zoom)
    radial, orders = size - distortion_model.num_coefficients(0), distortion_model.orders(size).tolist()
    names = [f"k{i + 1}" if i < radial else f"p{i + 1 - radial}" for i in range(size)]
    return dict(zip(names, orders, strict=True))


def coefficient_rows(lens: ZoomLens) -> list[list[float]]:
    """Focal length and k1, ..., kN, px, at some focal lengths over the range, evenly in 1/f."""
    low, high = (float(f) for f in lens.focal_range)
    focal = np.unique(1 / np.linspace(1 / low, 1 / high, 5))
    k = np.asarray(distortion_at(lens, focal).pixel_coefficients)
    return np.concatenate([focal[:, None], k], axis=1).tolist()


def finite(values: Iterable[float]) -> list[float | None]:
    """Values for JSON, which has no infinity: None means that a value is not determined."""
    return [float(v) if np.isfinite(v) else None for v in values]
