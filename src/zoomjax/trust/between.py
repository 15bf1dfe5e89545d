"""How far a lens may be from its model between a few focal lengths, by what zoom lenses do.

A model of few numbers goes through two or three focal lengths whatever the lens does between them, and no
line contradicts it. Its covariance is that of the lines alone. What lenses do between is known from others:
from the prior of `SmoothZoom`. Given the distortion at the focal lengths of the lines, a lens has a mean
and a covariance at each other one (Gaussian process regression). The model is off by its distance from that
mean, and by that covariance.

Distortion is taken to first order here, as the two coefficients of the radial polynomial that are nearest
to the displacement over the image. So any distortion model can be judged.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._core.programs import light_program
from ..models.lens import ZoomLens
from ..models.sizes import at_focal
from ..models.smooth import SmoothZoom

FEWEST_CHECKED = 4
"""From so many places in the zoom on, some can be left out, and so contradict a model."""

_PLACE = 1.05
"""Focal lengths within this ratio are one place: what a photo between them tells is next to nothing."""
_FOCALS = 16  # over the range, evenly in 1/f
_GRID = 9  # points a side of the image


def zoom_places(focal: Any) -> Float[np.ndarray, "place"]:
    """The shortest focal length of each place in the zoom.

    Args:
        focal: focal lengths, (number,), in any unit and order.
    """
    places: list[float] = []
    for f in np.unique(np.asarray(focal, float)):
        if not places or f > _PLACE * places[-1]:
            places.append(float(f))
    return np.array(places)


def deviation_between(lens: ZoomLens, places: Float[np.ndarray, "place"]) -> tuple[float, float]:
    """How far a zoom lens with the same distortion at some places may be from this one between them.

    Args:
        lens: the lens, fitted.
        places: fewer than `FEWEST_CHECKED` focal lengths at which its distortion was measured.

    Returns:
        The expected deviation of corrected points, px, RMS over the image, where it is largest in the range
        of the places, and the focal length there.
    """
    between = 1 / np.linspace(1 / places.max(), 1 / places.min(), _FOCALS)
    focal = np.concatenate([np.resize(places, FEWEST_CHECKED - 1), between])
    columns, own = _first_order(lens, focal)
    square = np.einsum("pci,pcj->ij", columns, columns) / len(columns)  # px^2 of coefficients, in scale^2
    prior = SmoothZoom().prepare(jnp.asarray(places), 2)
    covariance = _covariance(prior)
    seen, free = (_observed(prior, of) for of in (places, between))
    error = float(np.asarray(prior.error)) ** 2 * np.linalg.inv(square) / 2
    both = seen @ covariance @ seen.T + np.kron(np.eye(len(places)), error)
    gain = np.linalg.solve(both, seen @ covariance).T
    mean = (free @ gain @ own[: len(places)].reshape(-1)).reshape(-1, 2)
    free = free.reshape(_FOCALS, 2, -1)
    spread = np.einsum("fip,pq,fjq->fij", free, covariance - gain @ seen @ covariance, free)
    off = own[FEWEST_CHECKED - 1 :] - mean
    squares = np.einsum("fi,ij,fj->f", off, square, off) + np.einsum("fij,ij->f", spread, square)
    worst = int(np.argmax(squares))
    return float(lens.scale * np.sqrt(squares[worst])), float(between[worst])


def _first_order(lens: ZoomLens, focal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What a unit of each coefficient moves points by, in half diagonals, and the coefficients nearest to
    the lens at each focal length: (point, 2, coefficient) and (focal, coefficient)."""
    sides = (np.linspace(0, side - 1, _GRID) for side in lens.image_size)
    points = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
    dtype = jnp.result_type(float)
    moved = np.asarray(_moved(lens, jnp.asarray(points, dtype), jnp.asarray(focal, dtype)), float)
    place = (points - (np.array(lens.image_size) - 1) / 2) / lens.scale
    radius = np.sum(place**2, axis=1)
    columns = place[:, :, None] * np.stack([radius, radius**2], axis=1)[:, None]
    kept = np.isfinite(moved).all(axis=(0, 2))  # beyond a fold nothing is known
    target = moved[:, kept].reshape(len(focal), -1).T / lens.scale
    return columns, np.linalg.lstsq(columns[kept].reshape(-1, 2), target, rcond=None)[0].T


@light_program
def _moved(lens, points, focal):
    return jax.vmap(lambda f: at_focal(lens, f).undistort(points) - points)(focal)


def _observed(prior: SmoothZoom, focal: np.ndarray) -> np.ndarray:
    """The coefficients at focal lengths, by the parameters, row by row: (2 focal, parameter)."""
    functions = np.polynomial.legendre.legvander(2 * float(np.min(focal)) / focal - 1, prior.degree)
    return np.kron(functions, np.eye(2))


def _covariance(prior: SmoothZoom) -> np.ndarray:
    """The prior covariance of the parameters, row by row."""
    low, high = np.asarray(prior.quadratic, float), np.asarray(prior.beyond, float)
    covariance = np.zeros((2 * prior.degree + 2,) * 2)
    covariance[:6, :6] = low @ low.T
    for j in range(3, prior.degree + 1):
        covariance[2 * j : 2 * j + 2, 2 * j : 2 * j + 2] = (3 / j) ** 4 * high @ high.T
    return covariance
