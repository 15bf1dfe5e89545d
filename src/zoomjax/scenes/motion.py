"""Tracks with exact truth: a camera on a tripod that pans, tilts and zooms, and points that it sees."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

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


def pan_and_zoom(
    lens: ZoomLens, frames: int = 150, *, pan: float | int = 30, tilt: float | int = 5
) -> tuple[Float[np.ndarray, "frame"], Float[np.ndarray, "frame 3 3"]]:
    """A camera that pans to and fro, tilts, and zooms over its lens's range: focal lengths and rotations.

    Args:
        lens: with focal lengths in px.
        frames: number of frames.
        pan, tilt: angles from end to end, degrees.
    """
    t = np.linspace(0, 1, frames)
    low, high = np.log(np.asarray(lens.focal_range))
    focal = np.exp(low + (high - low) * (0.5 - 0.5 * np.cos(2 * np.pi * t)))
    focal = np.clip(focal, *np.asarray(lens.focal_range))
    across = np.radians(pan) / 2 * np.sin(2 * np.pi * 1.3 * t)
    up = np.radians(tilt) / 2 * np.sin(2 * np.pi * 2.1 * t + 0.7)
    return focal, np.stack([_rotation(a, b) for a, b in zip(across, up, strict=True)])


def motion_tracks(
    lens: ZoomLens,
    focal: Float[np.ndarray, "frame"],
    rotation: Float[np.ndarray, "frame 3 3"],
    *,
    views: int = 200,
    life: float | int = 40,
    noise: float | int = 0,
    drift: float | int = 0,
    moving: float | int = 0,
    pupil: float | int = 0,
    distance: tuple[float, float] = (40.0, 120.0),
    seed: int = 0,
) -> MotionScene:
    """Tracks of points in a scene, as a turning and zooming camera sees them.

    Args:
        lens: the true lens, with focal lengths in px.
        focal, rotation: of each frame: `pan_and_zoom`, or of a real camera.
        views: tracks seen at a time.
        life: mean number of frames that a track lives.
        noise: standard deviation of each coordinate of each point, px.
        drift: of a track, px a frame: a random walk's steps.
        moving: share of tracks on things that move, some 2 px a frame.
        pupil: distance of the entrance pupil before the axis of rotation, m.
        distance: of the scene's points, m.
        seed: of everything random.
    """
    rng = np.random.default_rng(seed)
    frames, (width, height) = len(focal), lens.image_size
    points: list[np.ndarray] = []
    first, last = np.zeros(0, int), np.zeros(0, int)
    for frame in range(frames):
        # Tracks end by age; those that leave the image end there, below.
        short = views - np.sum((first <= frame) & (last > frame))
        if short <= 0:
            continue
        pixels = rng.uniform(0, [width - 1, height - 1], (short, 2))
        corrected = np.asarray(lens(float(focal[frame])).undistort(pixels)) - np.asarray(lens.centre)
        ahead = np.column_stack([corrected / focal[frame], np.ones(short)])
        away = rng.uniform(*distance, short)
        points += list(away[:, None] * (ahead / np.linalg.norm(ahead, axis=1)[:, None]) @ rotation[frame])
        first = np.append(first, np.full(short, frame))
        last = np.append(last, frame + 1 + rng.geometric(1 / life, short))
    scene = np.array(points)
    on_move = rng.uniform(size=len(scene)) < moving
    seen = _seen(lens, focal, rotation, scene, pupil)
    age = np.arange(frames)[None, :] - first[:, None]
    speed = rng.normal(0, 2, (len(scene), 1, 2)) * on_move[:, None, None]
    walk = drift * np.cumsum(rng.standard_normal(seen.shape), axis=1)
    seen = seen + speed * age[..., None] + walk + noise * rng.standard_normal(seen.shape)
    there = (age >= 0) & (np.arange(frames) < last[:, None]) & np.isfinite(seen).all(axis=-1)
    inside = there & ((seen >= 0) & (seen <= [width - 1, height - 1])).all(axis=-1)
    inside &= np.cumsum((age >= 0) & ~inside, axis=1) == 0  # a track ends where it leaves the image
    keep = inside.sum(axis=1) > 1
    track, frame = np.nonzero(inside[keep])
    tracks = Tracks.from_arrays(
        track, frame, seen[keep][track, frame], image_size=lens.image_size, frames=frames
    )
    return MotionScene(tracks, np.asarray(focal), np.asarray(rotation), scene[keep], on_move[keep])


def _seen(lens, focal, rotation, scene, pupil):
    """Where the points of a scene are seen in each frame, px; NaN where not: (track, frame, 2)."""
    centre = np.asarray(lens.centre)
    seen = np.full((len(scene), len(focal), 2), np.nan)
    for frame, (f, r) in enumerate(zip(focal, rotation, strict=True)):
        ahead = scene @ r.T - [0, 0, pupil]
        front = ahead[:, 2] > 0
        straight = centre + f * ahead[front, :2] / ahead[front, 2:]
        near = np.abs(straight - centre).max(axis=1) < 3 * max(lens.image_size)
        seen[np.flatnonzero(front)[near], frame] = np.asarray(lens(float(f)).distort(straight[near]))
    return seen


def _rotation(pan: float, tilt: float) -> Float[np.ndarray, "3 3"]:
    """From the scene to a camera that is panned to the right and tilted down, angles in radians."""
    a, b = np.cos(pan), np.sin(pan)
    c, d = np.cos(tilt), np.sin(tilt)
    return np.array([[1, 0, 0], [0, c, -d], [0, d, c]]) @ np.array([[a, 0, -b], [0, 1, 0], [b, 0, a]])
