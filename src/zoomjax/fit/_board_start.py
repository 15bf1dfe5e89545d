"""A start for `fit_boards`: distortion from straightness, then f and poses from homographies."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from .._core.products import exact_products
from .._core.programs import program
from ..focal.estimate import estimate_of
from ..focal.homography import homography, matrix_of
from ..lines.lines import Lines
from ..models.distortion_model import AbstractDistortionModel
from ..models.zoom import AbstractZoom, with_parameters
from ._views import corrected
from .distortion_models import compress_for
from .frames import fit_frames

_UNCERTAIN = 0.3
"""Relative standard deviation of a focal length from which on it is none."""

_NO_LINE = 0.1
"""Width of a row's or column's points across it, in its length, from which on they are on no line: no lens
bends lines so far, and corners in the wrong places scatter."""

_STEPS = 4
"""Of Gauss and Newton's method for the zoom model: more than one for those that are not linear."""


def ordered(grids: Float[np.ndarray, "photo row column 2"]) -> Bool[np.ndarray, "photo"]:
    """Which photos show a grid: most of whose rows and columns are points along a line, if a bent one.

    All, if none do.
    """
    found = np.zeros(len(grids), bool)
    for photo, grid in enumerate(grids):
        widths = []
        for line in (*grid, *grid.swapaxes(0, 1)):
            seen = line[np.isfinite(line[:, 0])]
            if len(seen) >= 3:
                along, across = np.linalg.svd(seen - seen.mean(axis=0), compute_uv=False)
                widths.append(across / along if along > 0 else 1.0)
        found[photo] = not widths or np.median(widths) < _NO_LINE
    return found if found.any() else ~found


def coefficients_of(
    grids: Float[np.ndarray, "photo row column 2"],
    zoom: Int[np.ndarray, "photo"],
    image_size: tuple[int, int],
    centre: Float[np.ndarray, "2"],
    distortion_model: AbstractDistortionModel,
    terms: int,
    zooms: int,
) -> Float[np.ndarray, "zoom size"]:
    """The distortion of each zoom by itself, from the straightness of rows and columns; 0 without any."""
    lines, frame = [], []
    for grid, number in zip(grids, zoom.tolist(), strict=True):
        for line in (*grid, *grid.swapaxes(0, 1)):
            seen = line[np.isfinite(line[:, 0])]
            if len(seen) >= 3:
                lines.append(seen)
                frame.append(number)
    shown, frame = np.unique(frame, return_inverse=True)
    made = Lines.from_ragged(lines, frame, np.arange(1.0, len(shown) + 1), image_size=image_size)
    small = compress_for(made.about(centre), distortion_model, terms=terms)
    coefficients = np.zeros((zooms, distortion_model.num_coefficients(terms)))
    coefficients[shown] = fit_frames(
        small, distortion_model=distortion_model, terms=terms, throw=False
    ).coefficients
    return coefficients


@program
@exact_products
def homographies(
    points: Float[Array, "photo corner 2"],
    there: Bool[Array, "photo corner"],
    zoom: Int[Array, "photo"],
    places: Float[Array, "corner 2"],
    coefficients: Float[Array, "zoom size"],
    distortion_model: AbstractDistortionModel,
    scale: float,
) -> tuple[Float[Array, "photo 3 3"], Float[Array, "zoom"], Float[Array, "zoom"]]:
    """The homography of each photo, corrected, in half image diagonals; f of each zoom there, and its std.

    Infinite where homographies do not tell f.
    """

    def straight(point, k):
        return corrected(point, k, jnp.zeros(2), distortion_model, scale) / scale

    def photo(seen, there, k):
        count = jnp.maximum(jnp.sum(there), 1)
        image = jnp.where(there[:, None], jax.vmap(straight, (0, None))(seen, k), 0)
        middle = jnp.sum(jnp.where(there[:, None], places, 0), axis=0) / count
        # About the middle of what is seen: the last entry, 1, is the depth there. Photos that pad see all.
        plane = jnp.where(there[:, None], places - middle[None], 0)
        pads = ~jnp.any(there)
        plane = jnp.where(pads, places, plane)
        entries, root, squares = homography(
            jnp.where(pads, places, image), plane, (there | pads).astype(float)
        )
        shift = jnp.eye(3).at[:2, 2].set(-middle)
        return (entries, root, squares), matrix_of(entries) @ shift

    (entries, root, squares), matrices = jax.vmap(photo)(points, there, coefficients[zoom])
    good = jnp.isfinite(squares) & jnp.any(there, axis=1)
    flat = jnp.where(good[:, None], entries, jnp.eye(3).ravel()[:8][None])
    root = jnp.where(good[:, None, None], root, jnp.eye(8)[None])

    def estimate(number):
        own = good & (zoom == number)
        counted = jnp.sum(jnp.where(own, jnp.sum(there, axis=1), 0))
        found = estimate_of(flat, root, jnp.sum(jnp.where(own, squares, 0)), counted, 2, 1.0, own)
        return found.focal, found.std

    focal, std = jax.vmap(estimate)(jnp.arange(len(coefficients)))
    return matrices, focal, std


def filled(focal: np.ndarray, std: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Focal lengths where some are unknown: on a line through the others, in logarithms, or usual ones."""
    known = np.isfinite(focal) & (std < _UNCERTAIN * np.nan_to_num(focal))
    if not known.any():
        return np.full(len(focal), 2.0) * label / label.min()  # of a field of view of 53 degrees
    x, y = np.log(label), np.log(np.where(known, focal, 1.0))
    if np.unique(x[known]).size < 2:
        return np.where(known, focal, np.exp(np.mean(y[known])) * np.exp(x - np.mean(x[known])))
    slope = np.polyfit(x[known], y[known], 1)
    return np.where(known, focal, np.exp(np.polyval(slope, x)))


@program
def poses_of(
    matrices: Float[Array, "photo 3 3"], focal: Float[Array, "photo"]
) -> tuple[Float[Array, "photo 3 3"], Float[Array, "photo 3"]]:
    """Rotation and position of a plane with homographies to the image, for focal lengths in its unit."""

    def pose(matrix, focal):
        columns = matrix / jnp.stack([focal, focal, 1.0])[:, None]
        size = jnp.sqrt(jnp.linalg.norm(columns[:, 0]) * jnp.linalg.norm(columns[:, 1]))
        columns = columns / size * jnp.sign(columns[2, 2])
        first, second = columns[:, 0], columns[:, 1]
        left, _, right = jnp.linalg.svd(jnp.stack([first, second, jnp.cross(first, second)], axis=1))
        return left @ right, columns[:, 2]

    rotation, position = jax.vmap(pose)(matrices, focal)
    bad = ~jnp.all(jnp.isfinite(position), axis=1)
    rotation = jnp.where(bad[:, None, None], jnp.eye(3)[None], rotation)
    ahead = jnp.stack([0 * focal, 0 * focal, 2 * focal], axis=1)
    return rotation, jnp.where(bad[:, None], ahead, position)


@program
def through(
    zoom: AbstractZoom, focal: Float[Array, "zoom"], coefficients: Float[Array, "zoom size"]
) -> AbstractZoom:
    """The zoom model through coefficients of each zoom, as well as it can."""
    flat, unravel = ravel_pytree(zoom.parameters)

    def missed(flat):
        return (jax.vmap(with_parameters(zoom, unravel(flat)))(focal) - coefficients).ravel()

    for _ in range(_STEPS):
        table = jax.jacfwd(missed)(flat)
        normal = table.T @ table + 1e-6 * jnp.eye(len(flat))
        flat = flat - jnp.linalg.solve(normal, table.T @ missed(flat))
    flat = jnp.where(jnp.all(jnp.isfinite(flat)), flat, 0)
    return with_parameters(zoom, unravel(flat))
