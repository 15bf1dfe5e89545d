"""What OpenCV and Hugin make of the simulated tracks of `benchmarks/motion.py`.

Neither knows of a lens that zooms, and both need pairs of images that match: every fifth frame, the tracks
that two frames share being their matches. OpenCV's `detail` (the stitcher's estimator and its adjuster of
rays) has a focal length and a rotation for each image, and no distortion. Hugin's optimiser has a
distortion of three coefficients, one for all images or one for each; its fields of view begin at 50
degrees, and its images one after the other, from the neighbour.
"""

import math
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from zoomjax import ZoomLens
from zoomjax.fit import fit_motion
from zoomjax.scenes import MotionScene
from zoomjax.tracks import Tracks

from .motion_simulated import SHOWN, SIZE, Rows, random_scene, wide

_EVERY, _REACH, _LEAST = 5, 6, 12
"""Frames from an image to the next; images that are matched with each; matches of a pair."""

_VIEW = 50.0  # degrees across, from which Hugin starts

Found = tuple[np.ndarray, Callable[[int, np.ndarray], np.ndarray]]
"""f of each image, px, and its correction of points about the middle of the image, px."""


def rivals(only: str) -> Rows:
    """Errors of each, on the same tracks."""
    lens, scene = random_scene(0, {}, {})
    images = np.arange(0, len(scene.focal), _EVERY)
    for name, solve in {
        "zoomjax": _zoomjax,
        "OpenCV detail": _opencv,
        "Hugin, one distortion": lambda tracks, images: _hugin(tracks, images, single=True),
        "Hugin, a distortion each": lambda tracks, images: _hugin(tracks, images, single=False),
    }.items():
        if only not in name or ("Hugin" in name and not shutil.which("autooptimiser")):
            continue
        begin = time.perf_counter()
        focal, correct = solve(scene.tracks, images)
        yield name, _errors(lens, scene, images, focal, correct) | {"seconds": time.perf_counter() - begin}


def _errors(lens: ZoomLens, scene: MotionScene, images, focal, correct) -> dict:
    """Errors of f, and of points of the image corrected, px, without a shift common to all of them."""
    ratio = np.log(focal / scene.focal[images])
    missed = []
    for place, frame in enumerate(images):
        true = np.asarray(wide(lens)(float(scene.focal[frame])).undistort(SHOWN))
        own = correct(place, SHOWN - (np.array(SIZE) - 1) / 2)
        missed.append((own - own.mean(axis=0)) - (true - true.mean(axis=0)))
    return {
        "f": float(np.sqrt(np.mean(np.expm1(ratio) ** 2))),
        "factor": float(np.expm1(ratio.mean())),
        "rest": float(ratio.std()),
        "lens": float(np.sqrt(np.mean(np.sum(np.square(missed), axis=-1)))),
    }


def _zoomjax(tracks: Tracks, images: np.ndarray) -> Found:
    """Of all frames, from nothing."""
    fit = fit_motion(tracks)
    focal, lens = np.asarray(fit.focal)[images], wide(fit.lens)
    middle = (np.array(SIZE) - 1) / 2
    return focal, lambda place, points: np.asarray(lens(float(focal[place])).undistort(points + middle))


def _pairs(tracks: Tracks, images: np.ndarray):
    """Of each pair of images near each other: their numbers and the points that both see."""
    number, frame, points = tracks.views()
    for one in range(len(images)):
        for two in range(one + 1, min(one + 1 + _REACH, len(images))):
            here, there = frame == images[one], frame == images[two]
            _, a, b = np.intersect1d(number[here], number[there], return_indices=True)
            if len(a) >= _LEAST:
                yield one, two, points[here][a], points[there][b]


def _opencv(tracks: Tracks, images: np.ndarray) -> Found:
    """The stitcher's way: homographies, their focal lengths, and the adjustment of rays."""
    count = len(images)
    seen: list[list[np.ndarray]] = [[] for _ in images]
    matches = [cv2.detail.MatchesInfo() for _ in range(count * count)]
    for one, two, a, b in _pairs(tracks, images):
        start = sum(map(len, seen[one])), sum(map(len, seen[two]))
        seen[one].append(a)
        seen[two].append(b)
        for (i, j), (p, q), (k, m) in (
            ((one, two), (a, b), start),
            ((two, one), (b, a), start[::-1]),
        ):
            info = matches[i * count + j]
            homography, _ = cv2.findHomography(p - _MIDDLE, q - _MIDDLE, cv2.RANSAC, 3.0)
            info.src_img_idx, info.dst_img_idx, info.H = i, j, homography
            info.matches = [cv2.DMatch(k + n, m + n, 0.0) for n in range(len(a))]
            info.inliers_mask = np.ones(len(a), np.uint8)
            info.num_inliers, info.confidence = len(a), 2.0
    features = []
    for place, points in enumerate(seen):
        image = cv2.detail.ImageFeatures()
        image.img_idx, image.img_size = place, SIZE
        image.keypoints = [cv2.KeyPoint(float(x), float(y), 1.0) for x, y in np.concatenate(points)]
        features.append(image)
    done, cameras = cv2.detail.HomographyBasedEstimator().apply(features, matches, [])
    assert done
    for camera in cameras:
        camera.R = camera.R.astype(np.float32)
    adjuster = cv2.detail.BundleAdjusterRay()
    adjuster.setConfThresh(1.0)
    done, cameras = adjuster.apply(features, matches, cameras)
    assert done
    return np.array([camera.focal for camera in cameras]), lambda _, points: points


_MIDDLE = np.array(SIZE) / 2  # as the stitcher has it


def _hugin(tracks: Tracks, images: np.ndarray, *, single: bool) -> Found:
    """Hugin's `autooptimiser` for a project of control points."""
    width, height = SIZE
    lines = ['p f2 w3000 h1500 v180 n"TIFF_m"', "m g1 i0"]
    for place in range(len(images)):
        link = "".join(f" {c}=0" for c in "abc") if single and place else " a0 b0 c0"
        lines.append(f'i w{width} h{height} f0 v{_VIEW} r0 p0 y0{link} d0 e0 n"{place}.jpg"')
    for place in range(len(images)):
        free = [f"v{place}"] + [f"{angle}{place}" for angle in "rpy" if place]
        free += [f"{c}{place}" for c in "abc"] if not single or not place else []
        lines.append("v " + " ".join(free))
    for one, two, a, b in _pairs(tracks, images):
        for (x, y), (u, v) in zip(a[::4], b[::4], strict=True):
            lines.append(f"c n{one} N{two} x{x:.4f} y{y:.4f} X{u:.4f} Y{v:.4f} t0")
    with tempfile.TemporaryDirectory() as folder:
        project, solved = Path(folder) / "tracks.pto", Path(folder) / "solved.pto"
        project.write_text("\n".join(lines) + "\n")
        subprocess.run(["autooptimiser", "-n", "-o", solved, project], check=True, capture_output=True)
        found = [line for line in solved.read_text().splitlines() if line.startswith("i ")]
    rows = [dict(re.findall(r" ([abcv])(=?-?[\d.e+-]+)", line)) for line in found]
    k = np.array(
        [[float(rows[0 if row[c].startswith("=") else n][c]) for c in "abc"] for n, row in enumerate(rows)]
    )
    focal = np.array([width / 2 / math.tan(math.radians(float(row["v"])) / 2) for row in rows])
    # Its f is where half the height stays what it is; ours is that of the middle.
    middle = 1 - k.sum(axis=1)
    return focal * middle, lambda place, points: _straight(points, k[place], height / 2)


def _straight(points: np.ndarray, k: np.ndarray, unit: float) -> np.ndarray:
    """Points corrected by Hugin's polynomial, in which the corrected radius gives the seen one."""
    a, b, c = k
    d = 1 - a - b - c
    seen = np.linalg.norm(points, axis=1, keepdims=True) / unit
    r = seen.copy()
    for _ in range(30):
        slope = ((4 * a * r + 3 * b) * r + 2 * c) * r + d
        r -= (((a * r + b) * r + c) * r + d) * r / slope - seen / slope
    return points * np.where(seen > 0, d * r / np.where(seen > 0, seen, 1), 1)
