"""Detection of flat grids, checkerboards and dots, of unknown numbers of rows and columns.

Checkerboards: OpenCV's sector-based search lets a board grow from a small start while corners are found.
How far it gets depends on the scale of the image, so it runs at several and the largest board counts; its
corners are those found in the full image where that is possible. What is found must be dark and bright in
turn, or else it is no board.

Dots: the image less its background is cut at Otsu's threshold into spots. From one spot the grid grows,
neighbour by neighbour, each expected one step of the grid further; steps follow those found last, so that
they bend with the lens and shrink with perspective. A spot's position is the centroid of its contrast.
"""

from collections import deque

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from .._core.checks import checked_integer
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

_FLAGS = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY

_FEWEST_PIXELS = 6
"""Spots of fewer pixels are noise."""

_NEAR = 0.3
"""How far, in steps of the grid, a dot may be from where it is expected."""

_SEEDS = 9
"""How many dots, from the middle of all outwards, a grid is grown from before the largest one counts."""


class GridDetector(AbstractDetector):
    """Detects rows and columns of a checkerboard's inner corners, or of a grid of dots, as lines.

    Checkerboards, dark dots and bright dots are searched for, and the grid with most nodes is used: one per
    image, of any size.

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

        Rows run to the right, columns downwards. Dots that are not seen are NaN.
        """
        grey = _grey(image)
        grids = [grid for grid in (find_checkerboard(grey), find_dots(grey)) if grid is not None]
        # A board's squares are dots of a sort, half as many; boards found by chance among dots are small.
        best = max(grids, key=lambda grid: np.isfinite(grid[..., 0]).sum(), default=None)
        return None if best is None or min(best.shape[:2]) < self.fewest else best


def find_checkerboard(
    image: UInt8[np.ndarray, "height width *channels"],
) -> Float[np.ndarray, "row column 2"] | None:
    """The inner corners of the largest checkerboard found, px, or None.

    Args:
        image: grey or blue, green, red.

    Returns:
        At least 3 x 3 corners; rows run to the right, columns downwards.
    """
    grey, reduced = shrunk(_grey(image), _LONGEST)
    best, best_scale = None, 1.0
    for scale in _SCALES + ((_LARGER,) if min(grey.shape) < _SMALL else ()):
        found = _search(_resized(grey, scale), (_START, _START), cv2.CALIB_CB_LARGER)
        if found is not None and (best is None or found.size > best.size):
            best, best_scale = (found + 0.5) / scale - 0.5, scale
    if best is None:
        return None
    if best_scale < 1:
        rows, columns = best.shape[:2]
        for size in ((columns, rows), (rows, columns)):
            sharp = _search(grey, size, 0)
            if sharp is not None:
                best = sharp
                break
    return _upright((best + 0.5) / reduced - 0.5)


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
        place = _grown(centres, labels)
        if 2 * len(place) >= len(centres) and len(place) > most:
            best, most = _as_grid(centres, place), len(place)
    if best is None or min(best.shape[:2]) < _START or 2 * most < best[..., 0].size:
        return None
    return _upright((best + 0.5) / reduced - 0.5)


def _grey(image: np.ndarray) -> np.ndarray:
    """One channel of bytes."""
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
    middle = (grid[1:, 1:] + grid[:-1, 1:] + grid[1:, :-1] + grid[:-1, :-1]) / 4
    x, y = np.moveaxis(middle.astype(np.float32), -1, 0)
    bright = cv2.remap(grey, np.ascontiguousarray(x), np.ascontiguousarray(y), cv2.INTER_LINEAR).astype(
        float
    )
    odd = np.indices(bright.shape).sum(axis=0) % 2 == 1
    rises = [bright[1:] > bright[:-1], bright[:, 1:] > bright[:, :-1]]
    as_odd = [rises[0] == odd[1:], rises[1] == odd[:, 1:]]
    share = float(np.mean(np.concatenate([part.ravel() for part in as_odd])))
    return max(share, 1 - share) >= _ALTERNATE


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
    return centres, _nearest(centres, (height, width))


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


def _nearest(centres: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """For each pixel the index of the centre nearest to it."""
    apart = np.ones(shape, np.uint8)
    x, y = np.rint(centres).astype(int).T
    apart[y, x] = 0
    _, label = cv2.distanceTransformWithLabels(
        apart, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    label = np.asarray(label, np.intp)
    index = np.zeros(label.max() + 1, np.int32)
    index[label[y, x]] = np.arange(len(centres))
    return index[label]


def _grown(centres: np.ndarray, nearest: np.ndarray) -> dict[int, tuple[int, int]]:
    """Row and column of each spot of the largest grid that grows from one of some spots."""
    order = np.argsort(np.hypot(*(centres - centres.mean(axis=0)).T))
    best: dict[int, tuple[int, int]] = {}
    for seed in order[np.linspace(0, len(order) - 1, _SEEDS).astype(int)]:
        place = _grown_from(int(seed), centres, nearest)
        if len(place) > len(best):
            best = place
        if 2 * len(best) > len(centres):
            break
    return best


def _grown_from(seed: int, centres: np.ndarray, nearest: np.ndarray) -> dict[int, tuple[int, int]]:
    """Row and column of each spot that is reached from one spot, step by step."""
    steps = _first_steps(seed, centres)
    if steps is None:
        return {}
    place, taken = {seed: (0, 0)}, {(0, 0): seed}
    queue = deque([(seed, *steps)])
    while queue:
        spot, across, down = queue.popleft()
        row, column = place[spot]
        for i, j in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            there = (row + i, column + j)
            if there in taken:
                continue
            step = i * down + j * across
            other = _spot_at(centres[spot] + step, nearest)
            if other is None or other in place:
                continue
            found = centres[other] - centres[spot]
            if np.hypot(*(found - step)) > _NEAR * min(np.hypot(*across), np.hypot(*down)):
                continue
            place[other], taken[there] = there, other
            queue.append((other, j * found if j else across, i * found if i else down))
    return place


def _first_steps(seed: int, centres: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """From a spot to the nearest other one, and to the nearest in a clearly other direction."""
    offsets = centres - centres[seed]
    near = offsets[np.argsort(np.hypot(*offsets.T))[1:13]]
    first = near[0]
    sine = abs(first[0] * near[:, 1] - first[1] * near[:, 0])
    other = near[sine > 0.6 * np.hypot(*first) * np.hypot(*near.T)]
    return (first, other[0]) if len(other) else None


def _spot_at(position: np.ndarray, nearest: np.ndarray) -> int | None:
    """The spot nearest to a position, px, that is within the image."""
    x, y = round(position[0]), round(position[1])
    inside = 0 <= y < nearest.shape[0] and 0 <= x < nearest.shape[1]
    return int(nearest[y, x]) if inside else None


def _as_grid(centres: np.ndarray, place: dict[int, tuple[int, int]]) -> np.ndarray:
    """Centres by row and column, NaN where there is none."""
    index = np.array(list(place.values()))
    index -= index.min(axis=0)
    grid = np.full((*(index.max(axis=0) + 1), 2), np.nan)
    grid[index[:, 0], index[:, 1]] = centres[list(place)]
    return grid
