"""Checkerboards of which any part is seen, grown from the corners that are there.

Where four squares meet, grey levels have a saddle. Two saddles are neighbours on a board if an edge runs
from one to the other of which one side is brighter, and if the brighter side changes beyond either of them:
so no corner is passed over. What has grown is a board if nearly all neighbours in it are linked so, not
only those along which it grew. Both sides are looked at close to the edge, so that a marker within a square
(ChArUco) makes no difference.
"""

import cv2
import numpy as np

from ._growth import as_grid, largest_grid, nearest_of

_SMOOTH = 1.5
"""px, standard deviation, by which the image is smoothed."""

_APART = 7
"""px: of saddles that are nearer to each other the strongest counts."""

_WEAKEST = 0.02
"""Of the strongest saddle's response, which goes with the square of the contrast."""

_RING, _AROUND = 4.0, 16
"""px, and samples: the circle around a saddle on which squares are told apart."""

_UNLIKE = 0.6
"""Greatest difference of opposite sides, in differences of bright and dark squares."""

_MOST = 4000
_SEEDS = 60
"""How many saddles, the strongest first, a board is grown from before the largest one counts."""

_ALONG = np.array([-0.25, 0.25, 0.5, 0.75, 1.25])
"""Places on the way from one corner to the next, and beyond, at which both sides are compared."""

_SIGNS = np.array([-1, 1, 1, 1, -1])
_ASIDE = 0.09
"""How far aside, in distances of the corners: lenses bend edges by less, and markers are farther."""

_CONTRAST = 0.35
"""Of the greatest of the five contrasts, that each of them has at least."""

_FAINTEST = 8.0
"""Grey levels: the least contrast of neighbouring squares."""

_LEAST_STEP = 8.0
"""px between corners: smaller squares have no saddles of their own after smoothing."""

_WINDOW = 0.25
"""Half of the side of the window in which a corner is refined, in distances of corners."""

_WIDEST = 10
_FEWEST = 12
"""Corners: fewer may be in a row by chance."""

_SEEN = 0.5
"""Of the places of a grid, the share that has to be seen."""

_LINKED = 0.92
"""Of the neighbours in a grid, the share between which an edge runs: nearly all in photos of boards, seven
of eight or fewer where a grid grew by chance, on stairs and the like."""


def grown_board(grey: np.ndarray) -> np.ndarray | None:
    """The corners (row, column, 2) of the largest checkerboard, px, NaN where none is seen; or None."""
    centres = _saddles(grey)
    if len(centres) < _FEWEST:
        return None
    smooth = cv2.GaussianBlur(grey, (0, 0), _SMOOTH)
    contrast = _Contrast(smooth.astype(float), centres)
    place = largest_grid(
        centres, nearest_of(centres, grey.shape[:2]), range(min(_SEEDS, len(centres))), contrast.linked
    )
    if len(place) < _FEWEST or _share_linked(place, contrast) < _LINKED:
        return None
    grid = _trimmed(as_grid(centres, place))
    if min(grid.shape[:2]) < 3 or np.isfinite(grid[..., 0]).mean() < _SEEN:
        return None
    refined = _refined(grey, grid)
    return refined if np.isfinite(refined[..., 0]).sum() >= _FEWEST else None


def _saddles(grey: np.ndarray) -> np.ndarray:
    """Saddles (n, 2) of the grey levels, px, the strongest first."""
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), _SMOOTH)
    xx, yy, xy = (cv2.Sobel(smooth, cv2.CV_32F, *order) for order in ((2, 0), (0, 2), (1, 1)))
    response = xy * xy - xx * yy
    peak = response == cv2.dilate(response, np.ones((_APART, _APART), np.uint8))
    strongest = float(np.quantile(response[peak], 0.999)) if peak.any() else 0.0
    y, x = np.nonzero(peak & (response > max(_WEAKEST * strongest, 1.0)))
    alternate = _alternates(smooth, x, y)
    y, x = y[alternate], x[alternate]
    order = np.argsort(-response[y, x], kind="stable")[:_MOST]
    return np.stack([x, y], axis=-1)[order].astype(float)


def _alternates(smooth: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Whether it is bright, dark, bright and dark around positions (n,), alike on opposite sides."""
    angle = np.arange(_AROUND) * (2 * np.pi / _AROUND)
    rows = np.clip(y[:, None] + np.rint(_RING * np.sin(angle)).astype(int), 0, smooth.shape[0] - 1)
    columns = np.clip(x[:, None] + np.rint(_RING * np.cos(angle)).astype(int), 0, smooth.shape[1] - 1)
    ring = smooth[rows, columns]
    opposite = np.roll(ring, _AROUND // 2, axis=1)
    both = (ring + opposite) / 2
    middle = (both.max(axis=1) + both.min(axis=1)) / 2
    bright = both > middle[:, None]
    changes = (bright != np.roll(bright, 1, axis=1)).sum(axis=1)
    return (changes == 4) & (abs(ring - opposite).max(axis=1) < _UNLIKE * np.ptp(both, axis=1))


class _Contrast:
    """Which saddles are neighbours on a board."""

    def __init__(self, grey: np.ndarray, centres: np.ndarray):
        self.grey, self.centres = grey, centres

    def linked(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Whether edges of squares run from ones (n,) to others."""
        start, step = self.centres[first], self.centres[second] - self.centres[first]
        across = np.stack([-step[:, 1], step[:, 0]], axis=-1)
        place = start[:, None] + _ALONG[:, None] * step[:, None]
        aside = _ASIDE * across[:, None]
        sides = np.rint(np.stack([place + aside, place - aside])).astype(int)
        limit = np.array(self.grey.shape[::-1])
        inside = np.all((sides >= 0) & (sides < limit), axis=(0, 3))
        x, y = np.moveaxis(np.clip(sides, 0, limit - 1), -1, 0)
        difference = _SIGNS * (self.grey[y[0], x[0]] - self.grey[y[1], x[1]])
        difference *= np.sign(np.sum(difference, axis=1, where=inside))[:, None]
        least = np.min(difference, axis=1, where=inside, initial=np.inf)
        most = np.max(difference, axis=1, where=inside, initial=-np.inf)
        enough = (np.hypot(step[:, 0], step[:, 1]) >= _LEAST_STEP) & (inside.sum(axis=1) >= 3)
        return enough & (least > np.maximum(_CONTRAST * most, _FAINTEST))


def _share_linked(place: dict[int, tuple[int, int]], contrast: _Contrast) -> float:
    """Of the saddles side by side in a grid, the share between which an edge runs."""
    at = {there: saddle for saddle, there in place.items()}
    pairs = [
        (saddle, at[beside])
        for saddle, (row, column) in place.items()
        for beside in ((row + 1, column), (row, column + 1))
        if beside in at
    ]
    return float(np.mean(contrast.linked(*np.array(pairs).T))) if pairs else 0.0


def _trimmed(grid: np.ndarray) -> np.ndarray:
    """The grid without outer rows and columns that have one corner."""
    seen = np.isfinite(grid[..., 0])
    rows, columns = (np.flatnonzero(seen.sum(axis=axis) > 1) for axis in (1, 0))
    if not (len(rows) and len(columns)):
        return grid[:0, :0]
    return grid[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]


def _refined(grey: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """The corners to a fraction of a pixel; those that are too near to the image's edge are left out."""
    steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1) for axis in (0, 1)]
    step = np.nanmin([np.nanmin(steps[0]), np.nanmin(steps[1])])
    seen = np.isfinite(grid[..., 0])
    points = grid[seen]
    margin = np.minimum(points, np.subtract(grey.shape[::-1], 1) - points).min(axis=1)
    window = np.minimum(min(round(_WINDOW * step), _WIDEST), margin - 1).astype(int)
    refined = np.full(points.shape, np.nan)
    for half in np.unique(window[window >= 2]).tolist():
        some = window == half
        start = points[some, None].astype(np.float32)
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 40, 1e-3)
        refined[some] = cv2.cornerSubPix(grey, start.copy(), (half, half), (-1, -1), stop)[:, 0]
    lost = np.linalg.norm(refined - points, axis=1) > 2 * _SMOOTH + 1
    refined[lost] = np.nan
    result = np.full(grid.shape, np.nan)
    result[seen] = refined
    return result
