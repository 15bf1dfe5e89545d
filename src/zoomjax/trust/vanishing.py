"""Vanishing points of a man-made scene: a check of a lens that straightness has no part in.

Lines that are parallel in the scene meet in one point of a corrected image. A fit asks only that each line
is straight by itself, so that whether they meet is evidence of its own: it tells the distortion from how
the directions of short lines change over the image.

In each photo, lines are gathered to vanishing points by taking pairs and keeping a pencil of lines that
chance does not explain. Then it is asked by which factor the displacement must be multiplied for the lines
of each pencil to meet best: 1 if the lens is right.
"""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import bdtrc

from .._core.arguments import kinds_checked
from .._core.types import of_known_values
from ..fit.own_weights import own_weights
from ..fit.same_camera import check_camera
from ..lines.lines import Lines
from ..models.lens import ZoomLens
from ..models.sizes import at_focal

_PHOTOS = 12  # evenly spread over the focal lengths
_MOST_LINES = 100  # of a photo, the longest
_SHORTEST = 0.03  # of the image's diagonal
_TOLERANCE = np.radians(0.75)  # between a line and the direction to its vanishing point
_POINTS_MOST = 4  # vanishing points of a photo
_LEAST_LINES = 6  # of a vanishing point, on different lines of the scene
_SAME_LINE = 0.01  # of the diagonal: lines that are nearer may be two edges of one thing
_CHANCE = 1e-3  # expected number of pencils that chance makes in a photo
_CAUCHY = 2.4  # deviations, beyond which a line counts little
_FACTORS = (0.5, 1.5)


@dataclasses.dataclass(frozen=True)
class VanishingPoints:
    """Whether lines that are parallel in the scene meet under a lens.

    Attributes:
        lines: how many lines meet in vanishing points.
        points: how many vanishing points there are, in all photos looked at.
        photos: how many photos have any.
        miss: RMS distance, px of the image, of points to the line through their middle and the vanishing
            point; of most lines: a few that miss it by far count little. NaN without vanishing points.
        factor: of the lens's displacement, by which the lines meet best, between a half and one and a half;
            NaN without vanishing points.
        std: its standard deviation, from how the lines scatter; infinite where they do not determine it.
    """

    lines: int
    points: int
    photos: int
    miss: float
    factor: float
    std: float


@kinds_checked
@of_known_values
def vanishing_points(lines: Lines, lens: ZoomLens) -> VanishingPoints:
    """Check by vanishing points whether a lens corrects too much or too little.

    Args:
        lines: the lines of photos of a man-made scene, or of a board; those of weight 0 do not count.
        lens: the lens.

    Returns:
        What was found. The `factor` is near 1, by its standard deviation, if the lens is right. Lines whose
        middles are nearest to the centre of distortion say nothing, as those that span the image do not.

    Raises:
        ValueError: the lens is for images of another size or focal lengths in another unit.

    Example:
        >>> from zoomjax import scenes
        >>> lens = scenes.nikkor_18_200()
        >>> lines = scenes.board_lines(lens, scenes.focal_sweep(2), spacing=99, noise=0.5)
        >>> found = vanishing_points(lines, lens)
        >>> found.points >= 2, abs(found.factor - 1) < 5 * found.std
        (True, True)
    """
    check_camera(lens, lines)
    frame, counted = np.asarray(lines.frame), own_weights(lines) > 0
    focal, points = np.asarray(lines.focal, float), lines.to_ragged()
    there = np.unique(frame[counted])
    order = there[np.argsort(focal[there], kind="stable")]
    looked_at = order[np.unique(np.linspace(0, len(order) - 1, min(_PHOTOS, len(order))).astype(int))]
    found = []
    for index in looked_at:
        own = [points[line] for line in np.flatnonzero((frame == index) & counted)]
        photo = _corrected(own, lens, float(focal[index])) if len(own) >= _LEAST_LINES else None
        if photo is not None and (one := _of_photo(photo)) is not None:
            found.append(one)
    if not found:
        return VanishingPoints(0, 0, 0, np.nan, np.nan, np.nan)
    members, groups, misses, factors, stds = (np.array(values) for values in zip(*found, strict=True))
    factor, std = _together(factors, stds)
    miss = float(np.sqrt(np.average(misses**2, weights=members)))
    return VanishingPoints(int(members.sum()), int(groups.sum()), len(found), miss, factor, std)


@dataclasses.dataclass(frozen=True)
class _Photo:
    """The longest lines of a photo, in half diagonals about the centre of distortion.

    Attributes:
        middle: of each line: where it is, and by how much the lens moves it.
        scatter: the mean of ``p p^T``, ``p d^T`` and ``d d^T`` over each line's points p and their
            displacements d, both about their means.
        length: RMS distance of a line's points from their middle, in the image.
        scale: a half diagonal, px.
    """

    middle: Float[np.ndarray, "line 2 2"]
    scatter: Float[np.ndarray, "line 3 2 2"]
    length: Float[np.ndarray, "line"]
    scale: float

    def lines(self, factor: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """Middles and normals of the lines, corrected by so much of the displacement."""
        own, mixed, moved = np.moveaxis(self.scatter, 1, 0)
        angle, _ = _straight(own + factor * (mixed + mixed.swapaxes(1, 2)) + factor**2 * moved)
        normal = np.stack([-np.sin(angle), np.cos(angle)], axis=1)
        return self.middle[:, 0] + factor * self.middle[:, 1], normal


def _straight(scatter: Float[np.ndarray, "line 2 2"]) -> tuple[np.ndarray, np.ndarray]:
    """The direction of each line, an angle, and the RMS distance of its points from their middle."""
    across, along, both = scatter[:, 0, 0], scatter[:, 1, 1], scatter[:, 0, 1]
    angle = np.arctan2(2 * both, across - along) / 2
    return angle, np.sqrt((across + along + np.hypot(across - along, 2 * both)) / 2)


def _corrected(points: list[np.ndarray], lens: ZoomLens, focal: float) -> _Photo | None:
    """The longest lines of a photo; None if there are too few."""
    distortion = at_focal(lens, np.asarray(focal))  # an array: a number would be one more program
    centre = np.asarray(distortion.centre, float)
    every = np.concatenate(points).astype(float)
    moved = (np.asarray(distortion.undistort(every), float) - every) / lens.scale
    both = np.stack([(every - centre) / lens.scale, moved], axis=1)
    parts = np.split(both, np.cumsum([len(line) for line in points])[:-1])
    parts = [part for part in parts if np.isfinite(part).all()]
    if len(parts) < _LEAST_LINES:
        return None
    middle = np.stack([part.mean(axis=0) for part in parts])
    about = [part - mean for part, mean in zip(parts, middle, strict=True)]
    scatter = np.stack([np.einsum("pai,pbj->abij", part, part) / len(part) for part in about])
    scatter = scatter[:, [0, 0, 1], [0, 1, 1]]
    length = _straight(scatter[:, 0])[1]
    longest = np.argsort(-length, kind="stable")[:_MOST_LINES]
    longest = longest[length[longest] * np.sqrt(12) > 2 * _SHORTEST]
    if len(longest) < _LEAST_LINES:
        return None
    return _Photo(middle[longest], scatter[longest], length[longest], lens.scale)


def _of_photo(photo: _Photo) -> tuple[int, int, float, float, float] | None:
    """Lines that meet, vanishing points, by how much they miss, the factor and its standard deviation."""
    placed = photo.lines()
    left, pencils, starts = np.ones(len(photo.length), bool), [], []
    while len(pencils) < _POINTS_MOST and left.sum() >= _LEAST_LINES:
        found = _pencil(photo, placed, left)
        if found is None:
            break
        meeting, start = found
        pencils.append(np.flatnonzero(meeting))
        starts.append(start)
        left &= ~meeting
    if not pencils:
        return None
    return sum(map(len, pencils)), len(pencils), *_best_factor(photo, pencils, starts)


def _sines(placed: tuple[np.ndarray, np.ndarray], points: Float[np.ndarray, "point 3"]) -> np.ndarray:
    """Of the angles between lines and the directions from their middles to homogeneous points."""
    middle, normal = placed
    towards = points[:, None, :2] - points[:, None, 2:] * middle
    far = np.maximum(np.hypot(*np.moveaxis(towards, -1, 0)), 1e-12)
    return np.sum(towards * normal, axis=-1) / far


def _pencil(
    photo: _Photo, placed: tuple[np.ndarray, np.ndarray], left: Bool[np.ndarray, "line"]
) -> tuple[np.ndarray, np.ndarray] | None:
    """The lines through the point in which most of those left meet, and that point; None if by chance."""
    lines = np.flatnonzero(left)
    middle, normal = (values[lines] for values in placed)
    rows = np.column_stack([normal, -np.sum(normal * middle, axis=1)])
    one, other = np.triu_indices(len(lines), 1)
    points = np.cross(rows[one], rows[other])
    size = np.linalg.norm(points, axis=1)
    points = points[size > 1e-9] / size[size > 1e-9, None]
    if not len(points):
        return None
    near = abs(_sines((middle, normal), points)) < np.sin(_TOLERANCE)
    best = int(np.argmax(near @ photo.length[lines]))
    meeting = np.zeros(len(left), bool)
    meeting[lines[near[best]]] = True
    number = _different(photo, placed, np.flatnonzero(meeting))
    share = 2 * _TOLERANCE / np.pi
    if number < _LEAST_LINES or len(points) * bdtrc(number - 3, len(lines) - 2, share) > _CHANCE:
        return None
    return meeting, points[best]


def _different(photo: _Photo, placed: tuple[np.ndarray, np.ndarray], lines: Int[np.ndarray, "some"]) -> int:
    """How many of the lines are not continued, or accompanied closely, by a longer one."""
    middle, normal = placed
    kept: list[int] = []
    for line in lines[np.argsort(-photo.length[lines], kind="stable")]:
        far = abs((middle[kept] - middle[line]) @ normal[line]) if kept else np.array([np.inf])
        if far.min() > 2 * _SAME_LINE:
            kept.append(int(line))
    return len(kept)


def _best_factor(
    photo: _Photo, pencils: list[np.ndarray], starts: list[np.ndarray]
) -> tuple[float, float, float]:
    """By how much lines miss, px; the factor by which they meet best; its standard deviation."""
    across = [np.linalg.svd(start[None])[2][1:] for start in starts]  # directions in which a point moves

    def misses(unknowns: np.ndarray, factor: float | None = None) -> np.ndarray:
        middle, normal = photo.lines(unknowns[0] if factor is None else factor)
        parts = []
        for place, (lines, start, ways) in enumerate(zip(pencils, starts, across, strict=True)):
            point = start + unknowns[1 + 2 * place : 3 + 2 * place] @ ways
            parts.append(photo.length[lines] * _sines((middle[lines], normal[lines]), point[None])[0])
        return np.concatenate(parts)

    start = np.array([1.0, *np.zeros(2 * len(pencils))])
    as_is, _ = _robust(lambda rest: misses(np.array([1.0, *rest]), 1.0), start[1:])
    low, high = np.full((2, len(start)), [[-np.inf], [np.inf]])
    low[0], high[0] = _FACTORS
    best, scale = _robust(misses, np.array([1.0, *as_is]), (low, high))
    rest, jacobian = misses(best), _derivative(misses, best)
    weight = 1 / (1 + (rest / scale) ** 2)
    inverse = np.linalg.pinv((jacobian * weight[:, None]).T @ jacobian, hermitian=True)
    scatter = jacobian * (weight * rest)[:, None]
    spare = len(rest) - len(best)
    variance = (inverse @ (scatter.T @ scatter) @ inverse)[0, 0] * len(rest) / max(spare, 1)
    known = spare > 0 and variance > 0 and _FACTORS[0] < best[0] < _FACTORS[1]
    miss = _scale(misses(np.array([1.0, *as_is]), 1.0)) * photo.scale
    return miss, float(best[0]), float(np.sqrt(variance)) if known else np.inf


def _robust(function: Any, start: np.ndarray, bounds: Any = (-np.inf, np.inf)) -> tuple[np.ndarray, float]:
    """The unknowns of least residuals under a Cauchy loss, and its scale, from the residuals themselves."""
    from scipy.optimize import least_squares  # which takes its time to be read

    scale = 1.0
    for _ in range(3):
        scale = max(_CAUCHY * _scale(function(start)), 1e-9)
        start = least_squares(function, start, bounds=bounds, loss="cauchy", f_scale=scale).x
    return start, scale


def _scale(values: np.ndarray) -> float:
    """Standard deviation of most of the values, about 0."""
    return 1.4826 * float(np.median(abs(values)))


def _derivative(function: Any, at: np.ndarray) -> np.ndarray:
    """Central differences: (value, unknown)."""
    steps = 1e-6 * np.eye(len(at))
    return np.stack([(function(at + step) - function(at - step)) / 2e-6 for step in steps], axis=1)


def _together(factors: np.ndarray, stds: np.ndarray) -> tuple[float, float]:
    """The mean over photos by their variances; its standard deviation allows for their scatter."""
    known = np.isfinite(stds) & (stds > 0)
    if not known.any():
        return np.nan, np.inf
    weight = 1 / stds[known] ** 2
    mean = float(np.sum(weight * factors[known]) / weight.sum())
    excess = float(np.sum(weight * (factors[known] - mean) ** 2)) / max(known.sum() - 1, 1)
    return mean, float(np.sqrt(max(excess, 1.0) / weight.sum()))
