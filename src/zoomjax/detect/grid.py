"""Detection of flat grids, checkerboards and dots, of unknown numbers of rows and columns.

Checkerboards: a board grows from the corners that are there (`_saddles`), whatever part of it is outside of
the image. Where all of it is seen, OpenCV's sector-based search for a board of its size places the
corners. Where much of it is missing, or no board has grown, that search also lets a board grow from a small
start while whole rows and columns are found; how far it gets depends on the scale of the image, so that it
runs at several, and the largest board counts. What is found must be dark and bright in turn, or else it is
no board.

Dots: the image less its background is cut at Otsu's threshold into spots. From one spot the grid grows,
neighbour by neighbour (`_growth`). A spot's position is the centroid of its contrast.
"""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from .._core.checks import checked_integer
from .._core.fields import refuse_masked_image
from ._growth import as_grid, largest_grid, nearest_of
from ._saddles import grown_board
from .base import AbstractDetector
from .sources import shrunk

_START = 3
"""Rows and columns from which a checkerboard grows: the fewest that OpenCV takes."""

_SCALES = (1.0, 0.75, 0.65, 0.5)
"""Scales at which checkerboards are searched. In 30 photos of 22 x 15 corners each finds 29 or 30 of the
boards whole, not the same ones; larger scales find fewer, and take longer."""

_LONGEST = 1600
"""px: larger images are searched at this size. That finds as many boards, corners of 12-megapixel photos to
0.05 px, and takes seconds where the full size takes minutes."""

_SMALL, _LARGER = 600, 1.5
"""Images with a side below so many px are searched at this scale too, where they give whole boards more
often, and positions as good."""

_ALTERNATE = 0.95
"""Of neighbouring squares so many must be dark and bright in turn. Boards have all of them so; what the
search takes for a board in dots, lawns or noise has up to 0.9, by chance more only where it is 3 x 3."""

_WHOLE = 0.8
"""Of a grown board's places, the share from which on it holds all that is seen of the board: some corners
may be hidden, or outside of the image."""

_SURE = 36
"""Corners of a board that has grown, none of them missing, from which on no dots are searched for in the
image. What is only searched for has had 42 by chance, in a photo of dots."""

_FLAGS = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY

_FEWEST_PIXELS = 6
"""Spots of fewer pixels are noise."""

_SEEDS = 9
"""How many dots, from the middle of all outwards, a grid is grown from before the largest one counts."""


class GridDetector(AbstractDetector):
    """Detects rows and columns of a checkerboard's inner corners, or of a grid of dots, as lines.

    Checkerboards, dark dots and bright dots are searched for, and the grid with most nodes is used: one per
    image, of any size. Where a checkerboard is whole, dots are not searched for.

    Attributes:
        fewest: smallest number of rows and of columns of a grid, at least 3.

    Example:
        >>> import numpy as np
        >>> squares = np.kron(np.indices((8, 10)).sum(0) % 2, np.ones((20, 20)))
        >>> board = np.pad((255 * squares).astype(np.uint8), 20, constant_values=255)
        >>> lines = GridDetector()(board)
        >>> len(lines), sorted({len(line) for line in lines})
        (16, [7, 9])
    """

    fewest: int = 4

    def __check_init__(self):
        """Check the setting."""
        checked_integer("fewest", self.fewest, _START)

    def __call__(self, image: UInt8[np.ndarray, "height width *channels"]) -> list[np.ndarray]:
        """The rows of the grid, then its columns, each with at least 3 points."""
        return self.lines(self.find(image))

    @staticmethod
    def lines(grid: Float[np.ndarray, "row column 2"] | None) -> list[np.ndarray]:
        """The rows and columns of what `find` found, each with at least 3 points."""
        if grid is None:
            return []
        lines = [*grid, *grid.swapaxes(0, 1)]
        seen = [np.ascontiguousarray(line[np.isfinite(line[:, 0])]) for line in lines]
        return [line for line in seen if len(line) >= 3]

    def find(
        self, image: UInt8[np.ndarray, "height width *channels"]
    ) -> Float[np.ndarray, "row column 2"] | None:
        """The nodes of the grid, px, or None if there is none.

        Rows run to the right, columns downwards; or both the other way, where a checkerboard shows itself
        upside down (see `find_checkerboard`). Corners and dots that are not seen are NaN.
        """
        grey = _grey(image)
        best, whole = _checkerboard(grey)
        # A board's squares are dots of a sort, half as many; boards found by chance among dots are small.
        corners = 0 if best is None else int(np.isfinite(best[..., 0]).sum())
        if not whole or corners < _SURE:
            dots = find_dots(grey)
            best = dots if dots is not None and np.isfinite(dots[..., 0]).sum() > corners else best
        return None if best is None or min(best.shape[:2]) < self.fewest else best


def find_checkerboard(
    image: UInt8[np.ndarray, "height width *channels"],
) -> Float[np.ndarray, "row column 2"] | None:
    """The inner corners of the largest checkerboard found, px, or None.

    Args:
        image: grey or blue, green, red.

    Returns:
        At least 3 x 3 corners; rows run to the right, columns downwards. NaN where no corner is seen: a
        part of the board may be hidden, or outside of the image. A board with an odd number of rows and an
        even one of columns, or the other way round, looks different upside down: its corners are in the
        order in which the first square, between the first corners of the first two rows, is dark. So they
        are the same corners of the board in all photos.
    """
    return _checkerboard(_grey(image))[0]


def _checkerboard(grey: np.ndarray) -> tuple[np.ndarray | None, bool]:
    """As `find_checkerboard`, and whether it has grown and is whole."""
    small, reduced = shrunk(grey, _LONGEST)
    best, whole = _board(small)
    if best is None:
        return None, whole
    best = _upright(best)
    best = best[::-1, ::-1] if _is_upside_down(small, best) else best
    return (best + 0.5) / reduced - 0.5, whole


def find_dots(
    image: UInt8[np.ndarray, "height width *channels"],
) -> Float[np.ndarray, "row column 2"] | None:
    """The centres of the largest grid of dark or bright dots found, px, or None.

    Args:
        image: grey or blue, green, red.

    Returns:
        Rows run to the right, columns downwards; NaN where no dot is seen. A grid counts if it holds at
        least half of the spots of its dots' size, and if at least half of its own places are seen.
    """
    grey, reduced = shrunk(_grey(image), _LONGEST)
    best, most = None, 0
    for tone in (grey, 255 - grey):
        centres, labels = _spots(tone)
        if len(centres) < _START**2:
            continue
        place = largest_grid(centres, labels, _seeds(centres))
        if 2 * len(place) >= len(centres) and len(place) > most:
            best, most = as_grid(centres, place), len(place)
    if best is None or min(best.shape[:2]) < _START or 2 * most < best[..., 0].size:
        return None
    return _upright((best + 0.5) / reduced - 0.5)


def _grey(image: np.ndarray) -> np.ndarray:
    """One channel of bytes."""
    refuse_masked_image("image", image)
    if not isinstance(image, np.ndarray):
        raise ValueError(
            f"Argument image must be an array of bytes (uint8), but it is {type(image).__name__}. "
            "cv2.imread gives None where it cannot read a file."
        )
    colour = image.ndim == 3 and image.shape[2] == 3
    if image.dtype != np.uint8 or not (image.ndim == 2 or colour) or image.size == 0:
        raise ValueError(
            "Argument image must be uint8 of shape (h, w) or (h, w, 3), but its shape is "
            f"{image.shape} and its dtype {image.dtype}."
        )
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if colour else np.ascontiguousarray(image)


def _resized(grey: np.ndarray, scale: float) -> np.ndarray:
    """The image at another scale: a position x in it was at (x + 0.5) / scale - 0.5."""
    if scale == 1 or min(grey.shape) * scale < 1:
        return grey
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    return cv2.resize(grey, None, fx=scale, fy=scale, interpolation=way)


def _board(grey: np.ndarray) -> tuple[np.ndarray | None, bool]:
    """Corners of the largest checkerboard: grown from those that are there, or searched for as a whole.

    And whether it has grown, and the search finds all of its corners, too.
    """
    grown = _grown(grey)
    if grown is not None and np.isfinite(grown[..., 0]).mean() >= _WHOLE:
        sharp = _sharp(grey, grown)
        return (grown, False) if sharp is None else (sharp, True)
    found = _searched(grey)
    if grown is None or (found is not None and found[..., 0].size > np.isfinite(grown[..., 0]).sum()):
        return found, False
    return grown, False


def _grown(grey: np.ndarray) -> np.ndarray | None:
    """Corners of a board of which a part may be seen; of a blurred one, from a smaller image."""
    grown = grown_board(grey)
    if grown is None and min(grey.shape) > _SMALL:
        grown = grown_board(_resized(grey, 0.5))
        grown = None if grown is None else (grown + 0.5) / 0.5 - 0.5
    return grown


def _sharp(grey: np.ndarray, board: np.ndarray) -> np.ndarray | None:
    """The same board, searched for by its numbers of rows and columns; None unless it is found there."""
    rows, columns = board.shape[:2]
    for size in ((columns, rows), (rows, columns)):
        sharp = _search(grey, size, 0)
        if sharp is not None and _as_far(sharp, board):
            return sharp
    return None


def _as_far(sharp: np.ndarray, board: np.ndarray) -> bool:
    """Whether each corner of the one is near one of the other, as far as that is seen."""
    seen = board[np.isfinite(board[..., 0])]
    distance = np.linalg.norm(seen[:, None] - sharp.reshape(-1, 2), axis=-1).min(axis=1)
    step = np.median(np.linalg.norm(np.diff(sharp, axis=1), axis=-1))
    return bool(distance.max() < step / 4)


def _searched(grey: np.ndarray) -> np.ndarray | None:
    """Corners of a board of complete rows and columns, searched for at several scales."""
    best, best_scale = None, 1.0
    for scale in _SCALES + ((_LARGER,) if min(grey.shape) < _SMALL else ()):
        found = _search(_resized(grey, scale), (_START, _START), cv2.CALIB_CB_LARGER)
        if found is not None and (best is None or found.size > best.size):
            best, best_scale = (found + 0.5) / scale - 0.5, scale
    if best is not None and best_scale < 1:
        sharp = _sharp(grey, best)
        best = best if sharp is None else sharp
    return best


def _search(grey: np.ndarray, size: tuple[int, int], flags: int) -> np.ndarray | None:
    """Corners (row, column, 2) of a board of (columns, rows), or a larger one if the flags say so."""
    if min(grey.shape) < 4 * _START:
        return None
    cv2.setRNGSeed(0)  # the search draws samples: the same image shall have the same corners
    found, corners, meta = cv2.findChessboardCornersSBWithMeta(grey, size, _FLAGS | flags)
    if not found:
        return None
    grid = corners.reshape(*meta.shape, 2).astype(np.float64)
    return grid if _alternates(grey, grid) else None


def _alternates(grey: np.ndarray, grid: np.ndarray) -> bool:
    """Whether the squares between the corners are dark and bright in turn."""
    bright = _squares(grey, grid)
    odd = np.indices(bright.shape).sum(axis=0) % 2 == 1
    rises = [bright[1:] > bright[:-1], bright[:, 1:] > bright[:, :-1]]
    as_odd = [rises[0] == odd[1:], rises[1] == odd[:, 1:]]
    share = float(np.mean(np.concatenate([part.ravel() for part in as_odd])))
    return max(share, 1 - share) >= _ALTERNATE


def _squares(grey: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """How bright the squares between the corners are; NaN where a corner is not seen."""
    middle = (grid[1:, 1:] + grid[:-1, 1:] + grid[1:, :-1] + grid[:-1, :-1]) / 4
    x, y = np.moveaxis(np.nan_to_num(middle).astype(np.float32), -1, 0)
    bright = cv2.remap(grey, np.ascontiguousarray(x), np.ascontiguousarray(y), cv2.INTER_LINEAR)
    return np.where(np.isfinite(middle[..., 0]), bright.astype(float), np.nan)


def _is_upside_down(grey: np.ndarray, grid: np.ndarray) -> bool:
    """Whether the first square of a board is bright, where another one would be first if it was turned."""
    if sum(grid.shape[:2]) % 2 == 0:
        return False
    bright = _squares(grey, grid)
    even = np.indices(bright.shape).sum(axis=0) % 2 == 0
    seen = np.isfinite(bright)
    first, second = (bright[seen & of] for of in (even, ~even))
    return bool(len(first) and len(second) and first.mean() > second.mean())


def _upright(grid: np.ndarray) -> np.ndarray:
    """The same grid with rows that run to the right and columns that run downwards."""
    across = np.nanmean(np.diff(grid, axis=1), axis=(0, 1))
    down = np.nanmean(np.diff(grid, axis=0), axis=(0, 1))
    if abs(across[0]) * abs(down[1]) < abs(across[1]) * abs(down[0]):
        grid, across, down = grid.swapaxes(0, 1), down, across
    return grid[:: 1 if down[1] > 0 else -1, :: 1 if across[0] > 0 else -1]


def _spots(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres (n, 2) px of compact dark spots of like size, and for each pixel the spot nearest to it."""
    height, width = grey.shape
    light = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), max(height, width) / 20)
    even = np.clip(grey * (128 / np.maximum(light, 1)), 0, 255).astype(np.uint8)
    _, dark = cv2.threshold(even, 0, 1, cv2.THRESH_BINARY_INV | cv2.THRESH_OTSU)
    _, label, box, _ = cv2.connectedComponentsWithStats(dark, connectivity=4)
    left, top, wide, high, area = box.T
    fits = (area >= _FEWEST_PIXELS) & (left > 0) & (top > 0)
    fits &= (left + wide < width) & (top + high < height)
    fits &= (area > 0.5 * wide * high) & (np.maximum(wide, high) < 4 * np.minimum(wide, high))
    fits[0] = False
    if not fits.any():
        return np.zeros((0, 2)), np.zeros((height, width), np.int32)
    usual = np.median(area[fits])
    fits &= (area > usual / 5) & (area < 5 * usual)
    new = np.where(fits, np.cumsum(fits), 0)
    centres = _centroids(grey, new[np.asarray(label, np.intp)], int(fits.sum()), float(np.sqrt(usual)))
    return centres, nearest_of(centres, (height, width))


def _seeds(centres: np.ndarray) -> list[int]:
    """Some spots, from the middle of all outwards."""
    order = np.argsort(np.hypot(*(centres - centres.mean(axis=0)).T))
    return order[np.linspace(0, len(order) - 1, _SEEDS).astype(int)].tolist()


def _centroids(grey: np.ndarray, label: np.ndarray, number: int, across: float) -> np.ndarray:
    """Centroids, px, of the contrast of each labelled spot and the pixels just around it."""
    # Closing removes what is dark and narrow: what is left is the brightness around each spot.
    side = 2 * int(np.ceil(across)) + 1
    contrast = cv2.morphologyEx(
        cv2.GaussianBlur(grey, (0, 0), 1), cv2.MORPH_CLOSE, np.ones((side, side), np.uint8)
    ) - grey.astype(np.float32)
    # The blurred edge of a spot reaches some 2 px beyond the threshold's contour.
    wider = cv2.dilate(label.astype(np.float32), np.ones((5, 5), np.uint8)).astype(int)
    own = np.where(label > 0, label, wider).ravel()
    depth = np.bincount(own, np.where(label > 0, contrast, 0).ravel(), number + 1)
    depth /= np.maximum(np.bincount(label.ravel(), minlength=number + 1), 1)
    # Below a tenth of its depth a spot cannot be distinguished from noise.
    weight = np.maximum(contrast.ravel() - 0.1 * depth[own], 0)
    y, x = (axis.ravel() for axis in np.indices(grey.shape))
    total = np.maximum(np.bincount(own, weight, number + 1), 1e-9)
    sums = [np.bincount(own, weight * axis, number + 1) for axis in (x, y)]
    return np.stack(sums, axis=-1)[1:] / total[1:, None]
