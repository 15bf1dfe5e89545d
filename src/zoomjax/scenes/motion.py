"""Tracks with exact truth: a camera on a tripod that pans, tilts and zooms, and points that it sees."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation, RotationSpline

from .._core.arguments import check_kind, kinds_checked
from .._core.checks import check_above, check_between, checked_focal, checked_integer
from ..lines.lines import Lines
from ..models.camera import px_of_focal_px
from ..models.lens import ZoomLens
from ..tracks.tracks import Tracks


class MotionScene(NamedTuple):
    """Tracks, and what they were made from.

    Attributes:
        tracks: the tracks.
        focal: focal length of each frame, px.
        rotation: of each frame, from the scene to the camera, whose axes are x right, y down, z forward.
        points: each track's point in the scene, of length `distance` in the mean.
        moving: which tracks are on things that move.
    """

    tracks: Tracks
    focal: Float[np.ndarray, "frame"]
    rotation: Float[np.ndarray, "frame 3 3"]
    points: Float[np.ndarray, "track 3"]
    moving: Bool[np.ndarray, "track"]


def check_in_px(lens: ZoomLens) -> None:
    """Refuse a lens whose focal lengths are not in px of its own images.

    Raises:
        TypeError: it is no lens.
        ValueError: they are in mm, or in px of other images.
    """
    check_kind("lens", lens, (ZoomLens,))
    if lens.focal_unit != "px":
        raise ValueError(
            f"Argument lens must have its focal lengths in px, but they are in {lens.focal_unit}: make one "
            "with focal lengths over the pixel pitch."
        )
    if px_of_focal_px(lens) != 1:
        raise ValueError(
            "Argument lens must have its focal lengths in px of its own images, but it was scaled to "
            f"{lens.image_size[0]} x {lens.image_size[1]} px by lens_for_size: give it as it was before."
        )


def pan_and_zoom(
    lens: ZoomLens,
    frames: int = 150,
    *,
    pan: float | int = 30,
    tilt: float | int = 5,
    seed: int | None = None,
) -> tuple[Float[np.ndarray, "frame"], Float[np.ndarray, "frame 3 3"]]:
    """A camera that pans to and fro, tilts, and zooms over its lens's range: focal lengths and rotations.

    Args:
        lens: with focal lengths in px.
        frames: number of frames.
        pan, tilt: angles from end to end, degrees.
        seed: of where the camera begins its to and fro; by default always the same.
    """
    check_in_px(lens)
    checked_integer("frames", frames, 1)
    check_between(-math.inf, math.inf, pan=pan, tilt=tilt)
    t = np.linspace(0, 1, frames)
    begins = np.array([0.0, 0.0, 0.7])
    if seed is not None:
        begins = np.random.default_rng(checked_integer("seed", seed, 0)).uniform(0, 2 * np.pi, 3)
    # One turn in 150 frames, however many there are.
    zooms, pans, tilts = (2 * np.pi * np.outer([1, 1.3, 2.1], t * max(frames / 150, 1)).T + begins).T
    low, high = np.log(np.asarray(lens.focal_range))
    focal = np.exp(low + (high - low) * (0.5 - 0.5 * np.cos(zooms)))
    focal = np.clip(focal, *np.asarray(lens.focal_range))
    across = np.radians(pan) / 2 * np.sin(pans)
    up = np.radians(tilt) / 2 * np.sin(tilts)
    return focal, np.stack([_rotation(a, b) for a, b in zip(across, up, strict=True)])


@kinds_checked
def motion_tracks(
    lens: ZoomLens,
    focal: Float[np.ndarray, "frame"],
    rotation: Float[np.ndarray, "frame 3 3"],
    *,
    views: int = 200,
    life: float | int = 40,
    returns: bool = False,
    noise: float | int = 0,
    drift: float | int = 0,
    moving: float | int = 0,
    pupil: float | int = 0,
    shutter: float | int = 0,
    distance: tuple[float, float] = (40.0, 120.0),
    seed: int = 0,
) -> MotionScene:
    """Tracks of points in a scene, as a turning and zooming camera sees them.

    Args:
        lens: the true lens, with focal lengths in px.
        focal, rotation: of each frame: `pan_and_zoom`, or of a real camera.
        views: tracks seen at a time.
        life: mean number of frames that a track lives.
        returns: whether a point is the same track whenever it comes back into the image, as points of a map
            are; `life` then has no effect.
        noise: standard deviation of each coordinate of each point, px.
        drift: of a track, px a frame: a random walk's steps.
        moving: share of tracks on things that move, some 2 px a frame.
        pupil: distance of the entrance pupil before the axis of rotation, m.
        shutter: time from the first row to the last, in frames: 0 is a global shutter.
        distance: of the scene's points, m.
        seed: of everything random.

    Raises:
        ValueError: focal lengths of the lens are in mm, or an argument is not one of the above.
    """
    check_in_px(lens)
    checked_focal(focal)
    checked_integer("views", views, 1)
    check_between(1, math.inf, life=life)
    check_between(0, math.inf, noise=noise, drift=drift)
    check_between(0, 1, moving=moving)
    check_between(-1, 1, shutter=shutter)
    check_between(-math.inf, math.inf, pupil=pupil)
    rng = np.random.default_rng(checked_integer("seed", seed, 0))
    corner = np.array(lens.image_size) - 1
    seen_at = _Seen(lens, camera_between(focal, rotation), float(pupil), float(shutter))
    scene, last, speed, walk = np.zeros((0, 3)), np.zeros(0, int), np.zeros((0, 2)), np.zeros((0, 2))
    first, alive = np.zeros(0, int), np.zeros(0, int)
    entries: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for frame, (f, turn) in enumerate(zip(focal, rotation, strict=True)):
        before, alive = alive, np.arange(len(scene)) if returns else alive[last[alive] > frame]
        walk[alive] += drift * rng.standard_normal((len(alive), 2))
        alive, seen = seen_at.inside(frame, scene, alive, speed * (frame - first)[:, None] + walk)
        kept = np.argsort(~np.isin(alive, before), kind="stable")[:views]  # first those just seen
        alive, seen = alive[kept], seen[kept]
        new = max(views - len(alive), 0)
        distortion = lens(float(f))
        ahead = np.asarray(distortion.undistort(rng.uniform(0, corner, (new, 2))))
        ahead = np.column_stack([(ahead - np.asarray(distortion.centre)) / f, np.ones(new)])
        ahead *= rng.uniform(*distance, (new, 1)) / np.linalg.norm(ahead, axis=1, keepdims=True)
        on_move = rng.uniform(size=(new, 1)) < moving
        added = len(scene) + np.arange(new)
        scene = np.concatenate([scene, (ahead + np.array([0, 0, pupil])) @ turn])
        speed = np.concatenate([speed, rng.normal(0, 2, (new, 2)) * on_move])
        walk = np.concatenate([walk, np.zeros((new, 2))])
        first = np.append(first, np.full(new, frame))
        last = np.append(last, frame + 1 + rng.geometric(1 / life, new))
        added, seen_first = seen_at.inside(frame, scene, added, walk)
        alive, seen = np.append(alive, added), np.concatenate([seen, seen_first])
        entries.append((alive, np.full(len(alive), frame), seen + noise * rng.standard_normal(seen.shape)))
    track, moment, seen = (np.concatenate(column) for column in zip(*entries, strict=True))
    twice = np.bincount(track, minlength=len(scene)) > 1
    number = np.cumsum(twice) - 1
    tracks = Tracks.from_arrays(
        number[track[twice[track]]],
        moment[twice[track]],
        seen[twice[track]],
        image_size=lens.image_size,
        frames=len(focal),
    )
    return MotionScene(
        tracks, np.asarray(focal), np.asarray(rotation), scene[twice], (speed[twice] != 0).any(axis=1)
    )


def motion_lines(
    lens: ZoomLens,
    focal: Float[np.ndarray, "frame"],
    *,
    number: int = 10,
    spacing: float | int = 20,
    noise: float | int = 0,
    seed: int = 0,
) -> Lines:
    """Straight lines in any direction at each focal length, as a detector would give them.

    Args:
        lens: the true lens. Lines end at its fold, and where it bends them out of the image.
        focal: focal lengths, a frame each.
        number: of lines in each frame.
        spacing: distance between neighbouring points of a line, px.
        noise: standard deviation of each coordinate of each point, px.
        seed: of everything random.
    """
    focal = checked_focal(focal)
    checked_integer("number", number, 1)
    check_above(0, spacing=spacing)
    check_between(0, math.inf, noise=noise)
    seed = checked_integer("seed", seed, 0)
    rng, again = np.random.default_rng(seed), np.random.default_rng((seed, 1))
    corner = np.array(lens.image_size) - 1
    points: list[np.ndarray] = []
    for f in focal:
        distortion = lens(float(f))
        lines = _straight(distortion, rng.uniform(0, corner, (2, number, 2)), spacing, corner)
        for _ in range(_TRIES):
            bent = [place for place, line in enumerate(lines) if len(line) < 3]  # out of the image
            if not bent:
                break
            new = _straight(distortion, again.uniform(0, corner, (2, len(bent), 2)), spacing, corner)
            for place, line in zip(bent, new, strict=True):
                lines[place] = line
        if min(map(len, lines)) < 3:
            raise ValueError(f"Argument lens shows no lines at {f:g}: it folds nearly everywhere.")
        points += [seen + noise * rng.standard_normal(seen.shape) for seen in lines]
    return Lines.from_ragged(
        points,
        np.repeat(np.arange(len(focal)), number),
        focal,
        image_size=lens.image_size,
        focal_unit=lens.focal_unit,
    )


def _straight(distortion, ends, spacing, corner):
    """Points of the image that are straight in the scene, for each line from one end to the other, px.

    Ends, (2, line, 2), beyond the fold are moved to it. What bends out of the image is left out.
    """
    centre = np.asarray(distortion.centre, float)
    away = ends - centre
    radius = np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1e-9)
    ends = centre + away * np.minimum(1, _BEFORE_FOLD * float(distortion.monotone_radius) / radius)
    first, last = np.asarray(distortion.undistort(ends))
    number = 3 + (np.linalg.norm(last - first, axis=1) / spacing).astype(int)
    along = [np.linspace(0, 1, n)[:, None] for n in number.tolist()]
    straight = [a + share * (b - a) for a, share, b in zip(first, along, last, strict=True)]
    seen = np.asarray(distortion.distort(np.concatenate(straight)))
    inside = ((seen >= -_ROUNDING) & (seen <= corner + _ROUNDING)).all(axis=1)
    ends = np.cumsum(number)[:-1]
    return [line[there] for line, there in zip(np.split(seen, ends), np.split(inside, ends), strict=True)]


_TRIES = 100
_BEFORE_FOLD, _ROUNDING = 0.99, 1e-6
"""Of the radius of a fold, up to which lines go; px by which their ends may round out of the image."""


def camera_between(
    focal: Float[np.ndarray, "frame"], rotation: Float[np.ndarray, "frame 3 3"]
) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Focal lengths and rotations at any times, in frames, smooth; beyond the clip's ends they stay."""
    number = np.arange(len(focal))
    if len(number) == 1:
        return lambda time: (focal.repeat(len(time)), rotation.repeat(len(time), axis=0))
    zooms, turns = (
        PchipInterpolator(number, np.log(focal)),
        RotationSpline(number, Rotation.from_matrix(rotation)),
    )

    def camera(time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        time = np.clip(time, 0, number[-1])
        return np.exp(zooms(time)), turns(time).as_matrix()

    return camera


class _Seen(NamedTuple):
    """What a moving camera sees of a scene."""

    lens: ZoomLens
    camera: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    pupil: float
    shutter: float

    def inside(self, frame, scene, which, shift):
        """Which points of a scene a frame shows, and where, px."""
        if not len(which):
            return which, np.zeros((0, 2))
        corner = np.array(self.lens.image_size) - 1
        row = np.full(len(which), corner[1] / 2)
        seen, front = np.zeros((len(which), 2)), np.zeros(len(which), bool)
        for _ in range(1 + 4 * (self.shutter != 0)):  # the row tells the time, and the time the row
            time = frame + self.shutter * (row / corner[1] - 0.5)
            seen, front = self._at(time, scene[which])
            row = np.where(np.isfinite(seen[:, 1]), seen[:, 1], row)
        seen = seen + shift[which]
        inside = front & ((seen >= 0) & (seen <= corner)).all(axis=1)  # not where it is NaN
        return which[inside], seen[inside]

    def _at(self, time, points):
        """Where points are seen at times, px, and which are before the camera."""
        times, which = np.unique(time, return_inverse=True)
        focal, rotation = self.camera(times)
        ahead = np.einsum("pij,pj->pi", rotation[which], points) - [0, 0, self.pupil]
        front = ahead[:, 2] > 0
        flat = focal[which, None] * ahead[:, :2] / np.where(front, ahead[:, 2], np.inf)[:, None]
        if len(times) == 1:  # with a global shutter
            distortion = self.lens(float(focal[0]))
            return np.asarray(distortion.distort(np.asarray(distortion.centre) + flat)), front
        distortions = self.lens(focal[which])
        straight = np.asarray(distortions.centre) + flat
        return np.asarray(distortions.distort(straight[:, None])[:, 0]), front


def _rotation(pan: float, tilt: float) -> Float[np.ndarray, "3 3"]:
    """From the scene to a camera that is panned to the right and tilted down, angles in radians."""
    a, b = np.cos(pan), np.sin(pan)
    c, d = np.cos(tilt), np.sin(tilt)
    return np.array([[1, 0, 0], [0, c, -d], [0, d, c]]) @ np.array([[a, 0, -b], [0, 1, 0], [b, 0, a]])
