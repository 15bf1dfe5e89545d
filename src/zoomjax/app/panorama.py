"""A panorama of a clip by its fitted path and lens: where it is blurred, they are wrong."""

import os
from pathlib import Path

import cv2
import numpy as np

from ..fit.motion_fit import MotionFit
from ..io.video_reader import decode_video

_WIDTH = 1600  # px, at most
_FRAMES = 40
_MARGIN = 0.05  # least cosine of an angle to the camera's axis


def write_panorama(clip: str | os.PathLike[str], fit: MotionFit, path: Path) -> None:
    """Write the mean of frames, evenly over the longest scene, on a sphere about the camera.

    A point that frames put to different places is blurred, and shows an error to anyone. So are things
    that move.
    """
    scene, focal = np.asarray(fit.scene), np.asarray(fit.focal)
    longest = np.argmax(np.bincount(scene[scene >= 0]))
    members = np.flatnonzero((scene == longest) & np.isfinite(focal))
    chosen = members[np.unique(np.linspace(0, len(members) - 1, _FRAMES).astype(int))]
    rotation = np.asarray(fit.rotation)
    rays = _sphere(fit, chosen)
    total, count = np.zeros((*rays.shape[:2], 3), np.float32), np.zeros(rays.shape[:2], np.float32)
    with decode_video(clip) as (_, frames):
        for frame, (_, _, image) in enumerate(frames):
            if frame in chosen:
                add = _seen(fit, float(focal[frame]), rotation[frame], rays, image())
                total += add[..., :3]
                count += add[..., 3]
    mean = total / np.maximum(count, 1)[..., None]
    done = cv2.imwrite(str(path), np.round(mean).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 92])
    if not done:
        raise OSError(f"Cannot write {path}.")


def _sphere(fit, chosen):
    """Directions of a panorama's pixels, (height, width, 3): even in longitude and latitude."""
    lens = fit.lens
    borders = [(0, size / 2, size - 1) for size in lens.image_size]
    corners = np.stack(np.meshgrid(*borders), -1).reshape(-1, 2)
    seen = []
    for frame in chosen:
        f = float(fit.focal[frame])
        straight = np.asarray(lens(f).undistort(corners)) - np.asarray(lens(f).centre)
        ahead = np.column_stack([straight, np.full(len(straight), f)])
        seen.append(ahead / np.linalg.norm(ahead, axis=1, keepdims=True) @ np.asarray(fit.rotation[frame]))
    seen = np.concatenate(seen)
    longitude, latitude = np.arctan2(seen[:, 0], seen[:, 2]), np.arcsin(np.clip(seen[:, 1], -1, 1))
    west, east, top, bottom = longitude.min(), longitude.max(), latitude.min(), latitude.max()
    step = max((east - west) / _WIDTH, (bottom - top) / _WIDTH, 1 / float(np.max(fit.focal[chosen])))
    x, y = np.meshgrid(np.arange(west, east, step), np.arange(top, bottom, step))
    return np.stack([np.sin(x) * np.cos(y), np.sin(y), np.cos(x) * np.cos(y)], axis=-1)


def _seen(fit, focal, rotation, rays, image):
    """A frame's colours in the panorama's pixels, and 1 where it has any."""
    distortion = fit.lens(focal)
    ahead = rays @ rotation.T
    front = ahead[..., 2] > _MARGIN
    depth = np.where(front, ahead[..., 2], 1)[..., None]
    straight = np.asarray(distortion.centre) + focal * ahead[..., :2] / depth
    size = np.array(fit.lens.image_size)
    near = np.logical_and(front, (np.abs(straight - size / 2) < size).all(axis=-1))
    place = np.full((*rays.shape[:2], 2), -10.0, np.float32)
    place[near] = np.nan_to_num(np.asarray(distortion.distort(straight[near])), nan=-10.0)
    inside = np.asarray(((place >= 0) & (place <= size - 1)).all(axis=-1))
    colours = cv2.remap(image, place[..., 0], place[..., 1], cv2.INTER_LINEAR).astype(np.float32)
    return np.concatenate([colours, np.ones_like(colours[..., :1])], axis=-1) * inside[..., None]
