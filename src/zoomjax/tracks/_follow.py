"""Tracks followed from frame to frame: one `Follower` for a clip, which is given its frames in order.

Once a frame: the flow of all tracks and its way back, in smaller images if the frames are large; the
camera's motion from it; the match of each track with the patch it began with, at full size; and, where the
image has too few tracks, corners for new ones.
"""

import dataclasses

import cv2
import numpy as np
from jaxtyping import Float, Int

from ._camera import camera_motion, carried, local_shape
from ._corners import best_corners
from ._flow import Grey, as_bright, followed
from ._patches import HALF, Patches

_BACK = 0.4
"""px: how near the flow there and back must return."""

_NEAR = 2.0
"""px: how far the match may be from where the flow leads."""

ALIKE = 0.85
"""Least correlation with the patch of the anchor."""

GROWTH = 1.4
"""Change of scale after which a track ends: patches are bent, and the error hardly grows up to there."""

_WEAKEST = 3.0
"""Least mean square of the slope across a corner's weaker direction, (grey levels / px)^2."""

_LARGE = 600
"""px a side: frames that are larger are halved for the flow, which only has to lead near."""

_CELLS = (16, 9)
"""That tracks are spread over, across and down; fewer if there are fewer tracks."""

_REFILL = 20
"""Corners are looked for when one in so many tracks has ended."""

_SURVIVORS = 0.2
"""Share of tracks that outlive a cut at most."""

_STILL, _EXPECTED = 1.0, 4.0
"""px: what stays within the one, while the camera would carry it by the other, is no part of the scene."""

_REMEMBERED = 250
"""Frames for which a caption's place is left alone."""


@dataclasses.dataclass
class _Active:
    """The tracks that are followed, an entry each."""

    number: Int[np.ndarray, "track"]
    begun: Int[np.ndarray, "track"]
    until: Int[np.ndarray, "track"]
    anchor: Float[np.ndarray, "track 2"]
    point: Float[np.ndarray, "track 2"]
    speed: Float[np.ndarray, "track 2"]
    shape: Float[np.ndarray, "track 2 2"]
    carried: Float[np.ndarray, "track 2"]
    strayed: Float[np.ndarray, "track"]
    expected: Float[np.ndarray, "track"]
    patches: Patches

    def __getitem__(self, which: np.ndarray) -> "_Active":
        return _Active(*(getattr(self, f.name)[which] for f in dataclasses.fields(self)))

    def __add__(self, others: "_Active") -> "_Active":
        pairs = [(getattr(self, f.name), getattr(others, f.name)) for f in dataclasses.fields(self)]
        arrays = [np.concatenate(pair) for pair in pairs[:-1]]
        return _Active(*arrays, patches=self.patches + others.patches)  # pyright: ignore[reportCallIssue]

    @property
    def is_still(self) -> np.ndarray:
        """Which have stayed where the camera's motion would not have left them."""
        return (self.strayed < _STILL) & (self.expected > _EXPECTED)


class Follower:
    """Follows points of a clip; `views` has what was found."""

    def __init__(self, size: tuple[int, int], *, most: int, life: int):
        """For frames of a size, (width, height) px, so many tracks at a time, and frames of a track."""
        self.size, self.most, self.life = size, most, life
        fewer = min(1.0, (most / (_CELLS[0] * _CELLS[1])) ** 0.5)
        self.cells = (max(1, round(fewer * _CELLS[0])), max(1, round(fewer * _CELLS[1])))
        self.shrunk = 1 if min(size) < _LARGE else 2
        self.frame = -1
        self._rng = np.random.default_rng(0)
        self._small: Grey | None = None
        self._active: _Active | None = None
        self._views: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        self._ended: list[tuple[np.ndarray, ...]] = []
        self._captions = np.zeros((0, 3))  # x, y, and the frame after which they are forgotten
        self._next = 0

    def add(self, image: Grey) -> None:
        """Follow all tracks into the next frame, and begin new ones there."""
        self.frame += 1
        image = cv2.GaussianBlur(image, (5, 5), 0.8)  # what is sampled between pixels is then smooth
        small = image[:: self.shrunk, :: self.shrunk]
        if self.shrunk > 1:
            small = cv2.resize(image, small.shape[::-1], interpolation=cv2.INTER_AREA)
        if self._active is not None and len(self._active.number):
            self._follow(image, small)
        self._begin(image, small)
        if self._active is not None and len(active := self._active.number):
            self._views.append((active, np.full(len(active), self.frame), self._active.point))
        self._small = small

    @property
    def moves(self) -> tuple[np.ndarray, np.ndarray]:
        """Points in the frame that were in the one before it, too, and how they moved, px."""
        if self._active is None:
            return np.zeros((0, 2)), np.zeros((0, 2))
        older = self._active.begun < self.frame
        return self._active.point[older], self._active.speed[older]

    def views(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Track, frame and point of each view, of tracks on the scene that have two views or more."""
        if self._active is not None:
            self._end(self._active)
            self._active = None
        if not self._views:
            return np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2))
        number, frame, points = (np.concatenate(parts) for parts in zip(*self._views, strict=True))
        keep = np.zeros(self._next, bool)
        ended = [np.concatenate(parts) for parts in zip(*self._ended, strict=True)]
        keep[ended[0]] = ~self._on_captions(*ended[1:])
        keep &= np.bincount(number, minlength=self._next) > 1
        kept = keep[number]
        return number[kept], frame[kept], points[kept]

    def _follow(self, image: Grey, small: Grey) -> None:
        assert self._active is not None
        active = self._active
        flow, good = self._flow(small, active)
        count = good.sum()
        if len(good) >= 10 and count < _SURVIVORS * len(good):
            good[:] = False  # a cut: those few are chance, or captions
        self._end(active[~good])
        active, flow = active[good], flow[good]
        self._active = active
        if not len(flow):
            return
        motion = camera_motion(active.point, flow, self.size)
        active.shape = local_shape(motion, active.point) @ active.shape
        active.carried = carried(motion, active.carried)
        points, likeness = active.patches.matched(image, flow, active.shape)
        growth = np.sqrt(np.abs(np.linalg.det(active.shape)))
        active.speed, active.point = points - active.point, points
        active.strayed = np.maximum(active.strayed, np.linalg.norm(points - active.anchor, axis=1))
        away = np.linalg.norm(active.carried - active.anchor, axis=1)
        active.expected = np.maximum(active.expected, away)
        good = (likeness > ALIKE) & (np.linalg.norm(points - flow, axis=1) < _NEAR)
        good &= (growth < GROWTH) & (growth > 1 / GROWTH) & (active.until > self.frame)
        good &= self._inside(points) & ~active.is_still
        self._end(active[~good])
        self._active = active[good]

    def _flow(self, small: Grey, active: _Active) -> tuple[np.ndarray, np.ndarray]:
        """Where the points are in the next frame, and for which the way back returns."""
        assert self._small is not None
        half = (self.shrunk - 1) / 2  # from the middle of the first pixel of the one to that of the other
        before = (active.point - half) / self.shrunk
        guess = before + active.speed / self.shrunk
        earlier = as_bright(self._small, small)
        after, good = followed(earlier, small, before, guess, back=_BACK / self.shrunk)
        after = self.shrunk * after + half
        return after, good & self._inside(after)

    def _inside(self, points: np.ndarray) -> np.ndarray:
        """Which points have their patches in the image."""
        return np.all((points > HALF + 2) & (points < np.array(self.size) - HALF - 3), axis=1)

    def _begin(self, image: Grey, small: Grey) -> None:
        """New tracks in the cells of the image that have few."""
        points = np.zeros((0, 2)) if self._active is None else self._active.point
        corners = self._corners(small, points)
        if not len(corners):
            return
        n = len(corners)
        # Not all at once: lives end between two thirds of the longest and the longest.
        life = self._rng.integers(max(2 * self.life // 3, 1), self.life + 1, n)
        fresh = _Active(
            number=self._next + np.arange(n),
            begun=np.full(n, self.frame),
            until=self.frame + life,
            anchor=corners,
            point=corners,
            speed=self._speeds(corners),
            shape=np.tile(np.eye(2), (n, 1, 1)),
            carried=corners,
            strayed=np.zeros(n),
            expected=np.zeros(n),
            patches=Patches.cut(image, corners),
        )
        self._next += n
        self._active = fresh if self._active is None else self._active + fresh

    def _speeds(self, corners: np.ndarray) -> np.ndarray:
        """Of new tracks, as of the nearest that are followed."""
        active = self._active
        if active is None or not len(active.number):
            return np.zeros_like(corners)
        apart = np.linalg.norm(corners[:, None] - active.point, axis=-1)
        return active.speed[np.argmin(apart, axis=1)]

    def _corners(self, small: Grey, points: np.ndarray) -> np.ndarray:
        """The best corner of each cell that has too few tracks, whole px; away from tracks and captions."""
        room = self.most - len(points)
        if room <= self.most // _REFILL and len(points):
            return np.zeros((0, 2))
        self._captions = self._captions[self._captions[:, 2] > self.frame]
        place, strength = best_corners(
            small,
            self.cells,
            taken=np.concatenate([points, self._captions[:, :2]]) / self.shrunk,
            apart=2 * HALF // self.shrunk,
            edge=HALF // self.shrunk + 3,
            weakest=_WEAKEST * self.shrunk**2,
        )
        place = self.shrunk * place
        number = np.zeros(self.cells, int)
        np.add.at(number, self._cell(points), 1)
        crowd = number[self._cell(place)]
        order = np.lexsort((-strength, crowd))
        order = order[crowd[order] <= self.most // number.size]
        return place[order[:room]]

    def _cell(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The column and the row of each point's cell."""
        place = points // (np.array(self.size) / self.cells)
        column, row = place.astype(int).clip(0, np.array(self.cells) - 1).T
        return column, row

    def _end(self, ended: _Active) -> None:
        """Keep what tells captions from the scene."""
        self._ended.append((ended.number, ended.anchor, ended.begun, ended.strayed, ended.expected))
        still = ended.anchor[ended.is_still]
        until = np.full((len(still), 1), float(self.frame + _REMEMBERED))
        self._captions = np.concatenate([self._captions, np.concatenate([still, until], axis=1)])

    def _on_captions(self, anchor, begun, strayed, expected) -> np.ndarray:
        """Which tracks stayed while the camera moved; or near such a place, for too short to tell."""
        stayed = strayed < _STILL
        still = stayed & (expected > _EXPECTED)
        for place, time in zip(anchor[still], begun[still], strict=True):
            near = (np.abs(anchor - place) < 2 * HALF).all(axis=1) & (np.abs(begun - time) < _REMEMBERED)
            still |= stayed & near
        return still
