"""What `fit_boards` is given, checked, and in arrays of few sizes as the residuals need it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

from .._core.arrays import as_jax
from .._core.checks import checked_size
from .._core.fields import refuse_masked, without_rounding
from .._core.types import traced
from ..lines.buckets import bucket as bucket_of
from ._board_rows import Data
from ._board_shape import grid_places, shape_basis
from ._structure import bucket

_PHOTOS = (16, 32, 64, 96, 128)
"""Numbers of photos that programs are compiled for; larger ones are four to each doubling."""

_OF_A_BOARD = (8, *_PHOTOS)
"""The same of one board, where there are several."""

LEAST_CORNERS = 12
"""Corners of a photo that count: fewer hardly tell its pose and something more."""


_NAN = "give arrays with NaN in place of what is masked"


class Given(NamedTuple):
    """Grids, NaN where no corner is seen, the labels of their zooms and the numbers of their boards."""

    grids: Float[np.ndarray, "photo row column 2"]
    label: Float[np.ndarray, "photo"]
    board: Int[np.ndarray, "photo"]
    image_size: tuple[int, int]


def checked_grids(grids, focal, board, image_size, shape: tuple[int, ...] | None = None) -> Given:
    """The grids as one array, and their labels."""
    if traced((grids, focal)):
        raise ValueError("Arguments of fit_boards must have known values: call it outside of jit and vmap.")
    refuse_masked("grids", grids, _NAN)
    for grid in grids:
        refuse_masked("grids", grid, _NAN)
    arrays = [np.asarray(grid, float) for grid in grids]
    if not arrays:
        raise ValueError("Argument grids must hold the corners of one photo at least, but it is empty.")
    wrong = [array.shape for array in arrays if array.ndim != 3 or array.shape[2] != 2]
    if wrong:
        raise ValueError(f"Argument grids must hold arrays (row, column, 2), but one is {wrong[0]}.")
    sizes = sorted({array.shape[:2] for array in arrays} | ({shape} if shape else set()))
    if len(sizes) > 1:
        raise ValueError(
            f"Argument grids must be of one board, but they have {sizes[0]} and {sizes[1]} corners: keep "
            "those of one size, with NaN for corners that are not seen."
        )
    if min(sizes[0]) < 3:
        raise ValueError(f"Argument grids must have 3 rows and 3 columns or more, but has {sizes[0]}.")
    label = np.asarray(focal, float)
    if label.shape != (len(arrays),) or not (np.isfinite(label) & (label > 0)).all():
        raise ValueError(
            f"Argument focal must have a positive label for each of the {len(arrays)} grids, the same for "
            f"photos of one zoom, but it is {np.array2string(label, threshold=8)}."
        )
    number = np.zeros(len(arrays), int) if board is None else np.asarray(board)
    whole = number.dtype.kind in "iu" and number.shape == (len(arrays),) and number.min() >= 0
    if not whole or (shape is None and np.unique(number).size <= number.max()):
        raise ValueError(
            f"Argument board must have a number for each of the {len(arrays)} grids, 0 for the first "
            f"board, with none left out, but it is {np.array2string(number, threshold=8)}."
        )
    stack = np.stack(arrays)
    stack = np.where(np.isfinite(stack).all(axis=-1, keepdims=True), stack, np.nan)
    count = np.isfinite(stack[..., 0]).sum(axis=(1, 2))
    if count.min() < LEAST_CORNERS:
        raise ValueError(
            f"Argument grids must have {LEAST_CORNERS} corners or more in each photo, but number "
            f"{int(count.argmin())} has {count.min()}: leave it out."
        )
    return Given(stack, without_rounding(label), number, checked_size(image_size))


def data_of(
    given: Given,
    number: Int[np.ndarray, "photo"],
    zooms: int,
    origin: np.ndarray,
    centre_std: float,
    smooth=None,
    label=None,
    boards: int | None = None,
) -> Data:
    """The grids, padded to few numbers of photos, corners, zooms and boards."""
    photos, rows, columns = given.grids.shape[:3]
    places, _ = grid_places(rows, columns)
    corners, wide, more = bucket(rows * columns), bucket_of(photos, _PHOTOS), bucket(zooms)
    points = given.grids.reshape(photos, -1, 2)
    there = np.zeros((wide, corners), bool)
    there[:photos, : rows * columns] = np.isfinite(points[..., 0])
    about = np.zeros((wide, corners, 2))
    about[:photos, : rows * columns] = np.nan_to_num(points - origin)
    smoothness = np.zeros((more, more))
    if smooth is not None and label is not None and zooms > 3:
        curve = np.linalg.qr(np.vander(np.log(label), 3))[0]
        smoothness[:zooms, :zooms] = (np.eye(zooms) - curve @ curve.T) / smooth
    extra = corners - len(places)
    return Data(
        points=as_jax(about),
        there=as_jax(there),
        zoom=as_jax(np.pad(number, (0, wide - photos)).astype(np.int32)),
        board=as_jax(np.pad(given.board, (0, wide - photos)).astype(np.int32)),
        members=as_jax(_members(given.board, boards, wide).astype(np.int32)),
        places=as_jax(np.pad(places, ((0, extra), (0, 0)), mode="wrap")),
        basis=shape_basis(places, extra),
        smooth=as_jax(smoothness),
        zooms=as_jax(np.asarray(zooms)),
        centre_std=as_jax(np.asarray(centre_std, float)),
        scale=float(np.hypot(*given.image_size) / 2),
    )


def _members(board, boards, wide):
    """The photos of each board, padded to few numbers of them with one that there is not."""
    counts = np.bincount(board, minlength=boards or 0)
    out = np.full((bucket(len(counts)), bucket_of(int(counts.max()), _OF_A_BOARD)), wide)
    for number, count in enumerate(counts):
        out[number, :count] = np.flatnonzero(board == number)
    return out


def padded_to(values: np.ndarray, size: int) -> Array:
    """An array whose last element is repeated."""
    return as_jax(np.concatenate([values, np.repeat(values[-1:], size - len(values), axis=0)]))
