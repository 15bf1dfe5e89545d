"""Which lines of a picture are which markings of a pitch, by trying.

Two lines along the pitch and two across it give a homography, and that a camera. So cameras are made of all
choices of four long lines and four markings, as far as a camera over the ground could stand so. The best
are fitted to all lines that lie on a marking, in turns. A camera costs what lines are off, what no marking
explains, and what should be seen and is not. The least cost counts if all else costs clearly more, but for
cameras of nearly the same focal length.

The world is that of `PITCH_LINES`, z pointing down; lengths in the image are in half diagonals about the
principal point. All functions are of many cameras at once. Turned by half a turn the pitch is the same:
cameras are taken to stand where y > 0.
"""

import itertools
from typing import NamedTuple

import numpy as np

NOISE = 0.002
"""Standard deviation of a line's end, half diagonals: 1.5 px of 1280 x 720. Markings are 0.12 m wide."""

_MOST_LINES = 7
"""The longest lines, of which four make a camera."""

_TRIED = 150
"""Cameras that are refined, of those that fit best as they are."""

_NEAR = (0.02, 0.01, 0.006)
"""How near a marking a line must lie to be one, half diagonals, from turn to turn."""

_SLACK = (12.0, 3.0)
"""How far beyond a marking's end a line may reach, m: at first, and in the end."""

_UNEXPLAINED, _UNSEEN = 12.0, 2.0
"""Cost of a line that is no marking, and of a marking that should be seen and is not."""

_SHORT, _LONG = 0.1, 0.3
"""Visible length, half diagonals, below which a marking may be overlooked, and from which it may not."""

_CLEAR = 6.0
"""By how much all other cameras must cost more."""

_SAME_FOCAL = 0.05
"""Cameras whose focal lengths differ by less, relative, are one."""

_USUAL_HEIGHT, _SPREAD = 18.0, 0.5
"""m, of cameras over the ground, and the standard deviation of its logarithm."""

_HEIGHTS, _FARTHEST = (2.0, 80.0), 200.0
"""Heights and distance from the middle, m, at which cameras stand."""

_STEEPEST = 0.3
"""Sine of the largest roll."""


class Cameras(NamedTuple):
    """Pinhole cameras: focal lengths (n,), rotations (n, 3, 3) from world to camera, positions (n, 3)."""

    focal: np.ndarray
    rotation: np.ndarray
    position: np.ndarray

    def take(self, chosen: np.ndarray) -> "Cameras":
        """Some of them."""
        return Cameras(*(values[chosen] for values in self))

    def moved(self, steps: np.ndarray) -> "Cameras":
        """After steps (n, 7): log f, a rotation, and the position in units of 10 m."""
        turn = _rotations(steps[:, 1:4])
        return Cameras(
            self.focal * np.exp(steps[:, 0]), turn @ self.rotation, self.position + 10 * steps[:, 4:]
        )

    def seen(self, places: np.ndarray) -> np.ndarray:
        """Homogeneous positions (n, ..., 3) in the image of places (..., 2) on the ground."""
        world = np.concatenate([places, np.zeros((*places.shape[:-1], 1))], axis=-1)
        flat = world.reshape(1, -1, 3) - self.position[:, None]
        ahead = np.einsum("nij,npj->npi", self.rotation, flat)
        ahead[..., :2] *= self.focal[:, None, None]
        return ahead.reshape(-1, *world.shape)

    def rays(self, points: np.ndarray) -> np.ndarray:
        """Directions (n, ..., 3) in the world of points (..., 2) in the image."""
        flat = points.reshape(1, -1, 2) / self.focal[:, None, None]
        flat = np.concatenate([flat, np.ones((*flat.shape[:-1], 1))], axis=-1)
        return np.einsum("nji,npj->npi", self.rotation, flat).reshape(-1, *points.shape[:-1], 3)


class Found(NamedTuple):
    """For each line the index of its marking, or -1; the camera; and whether it is clear."""

    marking: np.ndarray
    camera: Cameras
    clear: bool


def find_markings(segments: np.ndarray, markings: np.ndarray, half_size: np.ndarray) -> Found | None:
    """The markings that lines lie on; None if no camera could see them so.

    Args:
        segments: (line, 2, 2), the ends of straight lines in the image.
        markings: (marking, 2, 2), the ends of the markings on the ground, along x or y, m.
        half_size: half of the image's width and height.
    """
    cameras = _possible(_of_four_lines(segments, markings), segments)
    _, away = _explained(cameras, segments, markings, _SLACK[0])
    rough = np.minimum((away / (4 * NOISE)) ** 2, _UNEXPLAINED).sum(axis=1)
    cameras = cameras.take(np.argsort(rough)[:_TRIED])
    for near in _NEAR:
        which, away = _explained(cameras, segments, markings, _SLACK[0])
        cameras = _possible(_refined(cameras, segments, markings, which, away < near), segments)
    if not len(cameras.focal):
        return None
    which, away = _explained(cameras, segments, markings, _SLACK[1])
    on_it = away < _NEAR[-1]
    which = np.where(on_it, which, -1)
    unseen = _unseen(cameras, markings, which, half_size)
    cost = np.minimum(2 * (away / NOISE) ** 2, _UNEXPLAINED).sum(axis=1) + _UNSEEN * unseen
    cost += (np.log(-cameras.position[:, 2] / _USUAL_HEIGHT) / _SPREAD) ** 2
    best = int(np.argmin(cost))
    others = abs(np.log(cameras.focal / cameras.focal[best])) > _SAME_FOCAL
    explained, left = int(on_it[best].sum()), int((~on_it[best]).sum())
    few = explained < 6
    clear = (
        np.min(cost[others], initial=np.inf) - cost[best] > _CLEAR
        and _both_ways(markings[which[best][on_it[best]]])
        and left <= max(0, explained - 3) // 3
        and unseen[best] < (0.5 if few else explained / 2)
    )
    return Found(which[best], cameras.take(np.array([best])), bool(clear))


def _both_ways(markings):
    """Whether two different markings or more run along the pitch, and two across it."""
    across = markings[:, 0, 0] == markings[:, 1, 0]
    return all(len(np.unique(markings[way], axis=0)) > 1 for way in (across, ~across))


def _homogeneous(points):
    return np.concatenate([points, np.ones_like(points[..., :1])], axis=-1)


def _of_four_lines(segments, markings):
    """Cameras that see two of the lines along the pitch and two across it, each as some marking."""
    line = np.cross(_homogeneous(segments[:, 0]), _homogeneous(segments[:, 1]))
    line = line / np.linalg.norm(line[:, :2], axis=1, keepdims=True)
    long = np.argsort(-np.linalg.norm(segments[:, 0] - segments[:, 1], axis=1))[:_MOST_LINES]
    fours = [
        (a, b, *pair)
        for a, b in itertools.combinations(long, 2)
        for c, d in itertools.combinations([n for n in long if n not in (a, b)], 2)
        for pair in ((c, d), (d, c))
    ]
    four = line[np.array(fours, int).reshape(-1, 4)]
    y, x = (
        np.unique(markings[markings[:, 0, axis] == markings[:, 1, axis]][:, 0, axis]) for axis in (1, 0)
    )
    pairs = [(*ys, *xs) for ys in itertools.combinations(y, 2) for xs in itertools.combinations(x, 2)]
    low_y, high_y, low_x, high_x = np.array(pairs).T

    # The square of the four lines' corners, from (0, 0) to (1, 1), seen as p0 + x p1 + y p2.
    corner = {(i, j): np.cross(four[:, i], four[:, 2 + j]) for i in (0, 1) for j in (0, 1)}
    frame = np.stack([corner[0, 0], corner[0, 1], corner[1, 0]], axis=-1)
    regular = abs(np.linalg.det(frame)) > 1e-12
    frame = np.where(regular[:, None, None], frame, np.eye(3))
    share = np.linalg.solve(frame, corner[1, 1][..., None])[..., 0]
    origin = -share[:, :1] * corner[0, 0]
    along_x, along_y = share[:, 1:2] * corner[0, 1] - origin, share[:, 2:] * corner[1, 0] - origin
    first = along_x[:, None] / (high_x - low_x)[None, :, None]
    second = along_y[:, None] / (high_y - low_y)[None, :, None]
    third = origin[:, None] - first * low_x[None, :, None] - second * low_y[None, :, None]
    columns = np.stack([first, second, third], axis=-1)[regular].reshape(-1, 3, 3)
    return _of_homographies(columns)


def _of_homographies(matrix):
    """The cameras of homographies from the ground, as far as these are any: two each, up and down."""
    first, second = matrix[..., 0], matrix[..., 1]
    size = np.sum(first[:, :2] ** 2 + second[:, :2] ** 2, axis=1)
    factor = np.stack(
        [
            np.sum(first[:, :2] * second[:, :2], axis=1),
            np.sum(first[:, :2] ** 2 - second[:, :2] ** 2, axis=1),
        ]
    )
    constant = np.stack([first[:, 2] * second[:, 2], first[:, 2] ** 2 - second[:, 2] ** 2])
    factor, constant = factor / size, constant / size  # Zhang's equations: factor + f^2 constant = 0
    with np.errstate(divide="ignore", invalid="ignore"):
        squared = -np.sum(factor * constant, axis=0) / np.sum(constant**2, axis=0)
        wrong = np.linalg.norm(factor + squared * constant, axis=0)
        good = (squared > 0.3) & (squared < 900) & (wrong < 0.15)
    matrix, focal = matrix[good], np.sqrt(squared[good])
    inner = matrix * np.stack([np.ones_like(focal), np.ones_like(focal), focal], axis=1)[..., None]
    length = np.sqrt(np.prod(np.linalg.norm(inner[..., :2], axis=1), axis=1))
    inner = inner / length[:, None, None]
    third = np.cross(inner[..., 0], inner[..., 1])
    left, _, right = np.linalg.svd(np.stack([inner[..., 0], inner[..., 1], third], axis=-1))
    rotation, shift = left @ right, inner[..., 2]
    cameras = [
        Cameras(focal, turned, -np.einsum("nji,nj->ni", turned, sign * shift))
        for sign in (1, -1)
        for turned in (rotation * np.array([sign, sign, 1]),)
    ]
    return _turned(Cameras(*(np.concatenate(values) for values in zip(*cameras, strict=True))))


def _turned(cameras):
    """The same cameras on the pitch's side of y > 0, turned with it by half a turn if need be."""
    sign = np.where(cameras.position[:, 1] < 0, -1.0, 1.0)
    turn = np.stack([sign, sign, np.ones_like(sign)], axis=1)
    return Cameras(cameras.focal, cameras.rotation * turn[:, None], cameras.position * turn)


def _possible(cameras, segments):
    """Those that stand where cameras stand, upright, and see all the lines on the ground before them."""
    position, rotation = cameras.position, cameras.rotation
    good = (-position[:, 2] > _HEIGHTS[0]) & (-position[:, 2] < _HEIGHTS[1])
    good &= (np.hypot(position[:, 0], position[:, 1]) < _FARTHEST) & (position[:, 1] > -1)
    good &= (rotation[:, 1, 2] > 0) & (abs(rotation[:, 0, 2]) < _STEEPEST)
    good &= np.all(cameras.rays(segments)[..., 2] > 1e-3, axis=(1, 2))
    return cameras.take(good)


def _images(cameras, markings):
    """The markings as lines in the image, (n, marking, 3), with normals of length 1."""
    first, second = np.moveaxis(cameras.seen(markings), 2, 0)
    line = np.cross(first, second)
    return line / np.linalg.norm(line[..., :2], axis=-1, keepdims=True)


def _explained(cameras, segments, markings, slack):
    """For each line the marking that it is nearest to, and how far it is from it: (n, line) both."""
    away = np.einsum("nmc,lec->nmle", _images(cameras, markings), _homogeneous(segments))
    away = np.sqrt(np.mean(away**2, axis=-1))
    rays = cameras.rays(segments)
    place = cameras.position[:, None, None, :2] - rays[..., :2] * (
        cameras.position[:, None, None, 2:] / rays[..., 2:]
    )
    along = (markings[:, 0, 0] == markings[:, 1, 0]).astype(int)  # y of those across the pitch
    on = np.moveaxis(place[..., along], -1, 1)
    ends = np.take_along_axis(markings, along[:, None, None], axis=2)[..., 0]
    low, high = (ends.min(axis=1) - slack)[:, None, None], (ends.max(axis=1) + slack)[:, None, None]
    away = np.where(np.all((on > low) & (on < high), axis=-1), away, np.inf)
    return np.argmin(away, axis=1), np.min(away, axis=1)


def _refined(cameras, segments, markings, which, used, steps=6):
    """Least squares of the distances of the lines' ends from their markings, by damped Gauss-Newton."""
    ends = _homogeneous(segments)

    def residuals(cameras):
        line = np.take_along_axis(_images(cameras, markings), which[..., None], axis=1)
        away = np.einsum("nlc,lec->nle", line, ends) * used[..., None]
        return away.reshape(len(which), 2 * len(segments)) / NOISE

    now, damping, tiny = residuals(cameras), np.full(len(which), 1e-4), 1e-5
    for _ in range(steps):
        slope = np.stack(
            [
                (residuals(cameras.moved(np.tile(tiny * row, (len(which), 1)))) - now) / tiny
                for row in np.eye(7)
            ],
            axis=-1,
        )
        normal = np.einsum("nri,nrj->nij", slope, slope)
        diagonal = damping[:, None] * (1 + np.einsum("nii->ni", normal))
        downhill = np.einsum("nri,nr->ni", slope, now)[..., None]
        step = -np.linalg.solve(normal + diagonal[..., None] * np.eye(7), downhill)[..., 0]
        there = cameras.moved(np.clip(step, -0.5, 0.5))
        new = residuals(there)
        better = np.sum(new**2, axis=1) < np.sum(now**2, axis=1)
        cameras = Cameras(
            *(
                np.where(better.reshape(-1, *[1] * (a.ndim - 1)), a, b)
                for a, b in zip(there, cameras, strict=True)
            )
        )
        now = np.where(better[:, None], new, now)
        damping = np.where(better, damping / 5, damping * 10)
    return cameras


def _rotations(vectors):
    """Rotation matrices of rotation vectors."""
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    x, y, z = vectors.T
    none = np.zeros_like(x)
    cross = np.stack([none, -z, y, z, none, -x, -y, x, none], axis=1).reshape(-1, 3, 3)
    return (
        np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * np.sinc(angle / 2 / np.pi) ** 2 * cross @ cross
    )


def _unseen(cameras, markings, which, half_size):
    """How many markings should be seen and are not, those that are hardly in sight for a part."""
    along = np.linspace(0, 1, 33)[:, None]
    places = markings[:, :1] + along * (markings[:, 1:] - markings[:, :1])
    seen = cameras.seen(places)
    depth = seen[..., 2:]
    place = seen[..., :2] / np.maximum(depth, 1e-6)
    inside = (depth[..., 0] > 0.5) & np.all(abs(place) < half_size, axis=-1)
    step = np.linalg.norm(np.diff(place, axis=2), axis=-1) * (inside[..., 1:] & inside[..., :-1])
    length = step.sum(axis=-1)
    found = np.any(which[:, None] == np.arange(len(markings))[:, None], axis=-1)
    share = np.where(length > _SHORT, np.minimum(length / _LONG, 1), 0)
    return np.sum(np.where(found, 0, share), axis=1)
