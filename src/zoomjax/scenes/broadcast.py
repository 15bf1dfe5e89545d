"""A synthetic scene with exact truth like the paper's second experiment: a zooming football broadcast.

The paper had 841 frames, 1920 x 1080 px, of an unknown camera, and took 55 of them, at 45.16 to 156.55 mm,
to fit the polynomials that it prints; these are the truth here. It found the focal lengths by homographies,
in the unit of a sensor that it does not name. Seen with one 36 mm wide from a stand, they show one half of
the pitch at 45 mm, and the areas before one goal at 157 mm. The camera's place and where it looks are ours,
chosen for markings near the borders of the image, where lenses distort.
"""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._core.checks import check_above, check_between, checked_focal, checked_integer
from .._core.types import AnyArray
from ..focal.pitch import PITCH_LINES
from ..lines.lines import Lines
from ..models.lens import ZoomLens
from ..models.zoom import PolynomialZoom
from .board import farthest

_PIXELS = np.array(  # section 5.2: rows are powers of 1/f, columns k1 (px^-2) and k2 (px^-4)
    [[2.65e-8, 1.99e-14], [-8.88e-6, 3.07e-12], [2.86e-4, -1.04e-10]]
)
_SIZE = (1920, 1080)
_SENSOR = 36.0
"""Width, mm."""

_CAMERA = np.array([20.0, 91.0, 27.0])
"""Where it stands, m: x to the right, y towards the stand from the middle of the pitch, and its height."""

_WIDE, _LONG = np.array([28.0, -14.0, 0.0]), np.array([44.0, 3.0, 0.0])
"""What it looks at, m, at the shortest and at the longest focal length."""


def broadcast_zoom() -> ZoomLens:
    """The lens of the paper's second experiment, from its published polynomials (section 5.2)."""
    scale = np.hypot(*_SIZE) / 2
    focal_range = jnp.array([45.16, 156.55])
    return ZoomLens(
        zoom=PolynomialZoom.from_inverse_focal(_PIXELS * [scale**2, scale**4], focal_range[0]),
        centre=(jnp.array(_SIZE) - 1) / 2,
        focal_range=focal_range,
        image_size=_SIZE,
        focal_unit="mm",
    )


def broadcast_lines(
    lens: ZoomLens,
    focal: Float[np.ndarray, "frame"],
    *,
    spacing: float | int = 6,
    noise: float | int = 0,
    seed: int = 0,
) -> Lines:
    """The centre lines of a pitch's straight markings at each focal length, as a detector would give them.

    Args:
        lens: the true lens; its dtype is the result's.
        focal: focal lengths within the lens's range, a frame each; the camera pans as it zooms.
        spacing: distance between neighbouring points of a line, px.
        noise: standard deviation, px, of the error of each coordinate of each point.
        seed: of the noise.

    Returns:
        All markings at least a tenth of the image's height long.
    """
    focal = checked_focal(focal)
    check_above(0, spacing=spacing)
    check_between(0, math.inf, noise=noise)
    rng = np.random.default_rng(checked_integer("seed", seed, 0))
    dtype = np.asarray(lens.centre).dtype
    points: list[np.ndarray] = []
    frame: list[int] = []
    last = np.array(lens.image_size) - 1
    for index, f in enumerate(focal):
        distortion = lens(float(f))
        reach = np.fmax(1.2 * lens.scale, float(farthest(distortion, lens.image_size)))
        straight = _straight(lens, float(f), spacing, reach)
        seen = np.asarray(distortion.distort(jnp.asarray(straight, dtype)))
        for line in seen:
            line = line[np.all((line >= 0) & (line <= last), axis=1)]
            if len(line) > 2 and np.hypot(*(line[-1] - line[0])) >= lens.image_size[1] / 10:
                points.append(line + (noise * rng.standard_normal(line.shape)).astype(dtype))
                frame.append(index)
    return Lines.from_ragged(
        points, frame, np.asarray(focal, dtype), image_size=lens.image_size, focal_unit=lens.focal_unit
    )


def _straight(
    lens: ZoomLens, focal: float, spacing: float | int, reach: float
) -> Float[np.ndarray, "line point 2"]:
    """Points of all markings in the corrected image, up to so far from its centre, px, evenly spaced.

    NaN where there are none.
    """
    low, high = (float(end) for end in lens.focal_range)
    zoomed = (1 / low - 1 / focal) / (1 / low - 1 / high)
    rotation = _looking(_WIDE + zoomed * (_LONG - _WIDE) - _CAMERA)
    pixels = focal / _SENSOR * lens.image_size[0]
    steps = spacing * np.arange(2 * reach // spacing + 1)
    lines = np.full((len(PITCH_LINES), len(steps), 2), np.nan)
    for line, ends in zip(lines, PITCH_LINES.values(), strict=True):
        world = np.column_stack([ends, np.zeros(2)]) - _CAMERA
        x, y, depth = (world @ rotation.T).T
        if (depth <= 0).any():
            continue  # a marking that passes the camera is far out of the picture
        start, end = pixels * np.column_stack([x, y]) / depth[:, None]
        along = (end - start) / np.hypot(*(end - start))
        nearest = start - (start @ along) * along  # of the line to the middle
        if np.hypot(*nearest) >= reach:
            continue
        half = np.sqrt(reach**2 - nearest @ nearest)
        first, length = max(start @ along, -half), min(end @ along, half)
        inside = first + steps <= length
        line[inside] = nearest + (first + steps[inside])[:, None] * along
    return lines + np.asarray(lens.centre)


def _looking(direction: Float[AnyArray, "3"]) -> Float[np.ndarray, "3 3"]:
    """From the world to a camera that looks along a direction, its x axis level: x right, y down."""
    forward = np.asarray(direction) / np.linalg.norm(direction)
    right = np.array([-forward[1], forward[0], 0.0])
    down = forward * forward[2] - [0.0, 0.0, 1.0]
    return np.stack([right / np.linalg.norm(right), down / np.linalg.norm(down), forward])
