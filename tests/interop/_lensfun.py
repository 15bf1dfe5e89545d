"""Lensfun's own corrections, point by point, to compare with."""

import lensfunpy
import numpy as np


def distorted(table, focal, crop, size, points):
    """Where lensfun puts corrected points, px. (A single point at a time: its fast path is less exact.)"""
    modifier = lensfunpy.Modifier(table.source, crop, *size)
    modifier.initialize(focal, 4.0, 1000.0, scale=1.0, flags=lensfunpy.ModifyFlags.DISTORTION)
    found = [np.ravel(modifier.apply_geometry_distortion(*map(float, point), 1, 1)) for point in points]
    return np.array(found, float)


def largest_difference(lens, table, focal, crop):
    """How far a lens's distorted points are from lensfun's over the image, at the best magnification."""
    size = lens.image_size
    axes = [np.linspace(0, side - 1, 14) for side in size]
    corrected = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    middle = (np.array(size) - 1) / 2
    theirs = distorted(table, focal, crop, size, corrected)
    seen = (theirs >= -0.5).all(axis=1) & (theirs <= np.array(size) - 0.5).all(axis=1)
    ours, own = lens(focal).undistort(theirs[seen]) - middle, corrected[seen] - middle
    further = lens(focal).undistort(theirs[seen] + 1e-3 * (theirs[seen] - middle)) - middle
    stretch = np.linalg.norm(further - ours, axis=1) / np.linalg.norm(
        1e-3 * (theirs[seen] - middle) + 1e-12, axis=1
    )

    def difference(magnification):
        return (np.linalg.norm(ours - magnification * own, axis=1) / stretch).max()

    best = float(np.sum(ours * own) / np.sum(own * own))
    for step in (2e-3, 3e-4, 4e-5, 6e-6):  # it is convex in the magnification
        best = min(best + step * np.arange(-8, 9), key=difference)
    return difference(best)
