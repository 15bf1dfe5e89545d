"""Rendered facades and halls with clutter, seen through a known lens, for `benchmarks.wide`.

A plane in perspective holds what is straight: ledges, window frames, floor markings, and arches, discs and
people-sized blobs that are not. The lens is the division model about a centre that is not the image's.
"""

import dataclasses

import cv2
import numpy as np

_OVER = 2
"""Samples a pixel, each way."""

HARD = ("few lines", "blur", "noise", "clutter", "tiny", "few lines and clutter", "blur and noise")
"""What makes scenes hard."""


@dataclasses.dataclass(frozen=True)
class Scene:
    """What one scene is made of.

    Attributes:
        size: (width, height) px.
        corner: by how many times its radius the corner moves outwards.
        centre: of distortion, px.
        seed: of all that is drawn.
        hard: what makes it hard: one of `HARD`, or nothing.
    """

    size: tuple[int, int]
    corner: float
    centre: np.ndarray
    seed: int
    hard: str = ""

    def undistort(self, points: np.ndarray) -> np.ndarray:
        """Corrected positions of points (..., 2), px."""
        z = (points - self.centre) / (np.hypot(*self.size) / 2)
        k = 1 / (1 + self.corner) - 1
        return self.centre + (points - self.centre) / (1 + k * np.sum(z * z, axis=-1))[..., None]


def scene(seed: int) -> Scene:
    """A scene: the corner's displacement from -30 % to +120 %, the centre off by up to 5 % of the width."""
    rng = np.random.default_rng((77, seed))
    size = (960, 640)
    shift = rng.uniform(-0.05, 0.05, 2) * size[0] * (1 if seed % 2 else 0.2)
    return Scene(size, float(rng.uniform(-0.3, 1.2)), (np.array(size) - 1) / 2 + shift, seed)


def hard_scene(seed: int) -> Scene:
    """A scene as `scene` makes them, but with what makes lines hard to find: each of `HARD` in turn."""
    rng, made = np.random.default_rng((79, seed)), scene(seed)
    hard = HARD[seed % len(HARD)]
    if hard != "tiny":
        return dataclasses.replace(made, hard=hard)
    width = int(rng.choice([120, 180, 240]))
    size = (width, round(width / 1.5))
    shift = (made.centre - (np.array(made.size) - 1) / 2) * width / made.size[0]
    return dataclasses.replace(made, size=size, centre=(np.array(size) - 1) / 2 + shift, hard=hard)


def render(made: Scene) -> np.ndarray:
    """A photo of the scene: grey levels, with blur, vignetting, noise of 3 levels and JPEG."""
    rng, harder = np.random.default_rng((78, made.seed)), np.random.default_rng((80, made.seed))
    width, height = made.size
    wide, high = width * _OVER, height * _OVER
    y, x = np.mgrid[0:high, 0:wide]
    at = (np.stack([x, y], axis=-1) + 0.5) / _OVER - 0.5
    corrected = made.undistort(at)
    side = np.quantile(np.abs(corrected - made.centre).reshape(-1, 2), 0.995, axis=0)
    plane, extent = _facade(rng) if made.seed % 3 else _hall(rng)
    if "few lines" in made.hard:
        plane, extent = _bare(harder)
    if made.hard in PLANES:
        plane, extent = PLANES[made.hard](harder)
    # A plane turned and tilted by a homography of its four corners, somewhat larger than what is seen.
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
    shaken = square * side * rng.uniform(1.0, 1.2) * (1 + rng.uniform(-0.2, 0.2, (4, 2))) + made.centre
    into = cv2.getPerspectiveTransform(
        shaken.astype(np.float32), ((square + 1) / 2 * extent).astype(np.float32)
    )
    place = cv2.perspectiveTransform(corrected.reshape(-1, 1, 2), into).reshape(high, wide, 2)
    big = cv2.remap(
        plane,
        place[..., 0].astype(np.float32),
        place[..., 1].astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REFLECT,
    )
    _people(big, rng)
    if "clutter" in made.hard:
        _people(big, harder, int(harder.integers(40, 160)))
    image = cv2.resize(big, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
    blur = harder.uniform(2.5, 8) if "blur" in made.hard else rng.uniform(0.5, 1.1)
    image = cv2.GaussianBlur(image, (0, 0), blur)
    row, column = np.indices((height, width))
    distance = np.hypot(row - height / 2, column - width / 2)
    image *= 1 - 0.3 * (distance / np.hypot(width, height) * 2) ** 2
    image += rng.normal(0, harder.uniform(12, 20) if "noise" in made.hard else 3, image.shape)
    _, packed = cv2.imencode(
        ".jpg", np.clip(np.rint(image), 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 90]
    )
    photo = cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE)
    assert photo is not None
    return photo


def _facade(rng: np.random.Generator) -> tuple[np.ndarray, tuple[int, int]]:
    """Windows in rows, ledges, a row of arches below, and lamps."""
    extent = (2400, 1600)
    wall = rng.uniform(140, 200)
    plane = np.full(extent[::-1], wall, np.float32)
    columns, rows = int(rng.integers(8, 13)), int(rng.integers(3, 5))
    step, rise = extent[0] / columns, 1100 / rows
    for row in range(rows):
        for column in range(columns):
            left, top = (column + 0.28) * step, 120 + (row + 0.2) * rise
            size = np.array([0.44 * step, 0.6 * rise])
            _box(plane, (left - 12, top - 12), size + 24, wall * 0.5)
            _box(plane, (left, top), size, rng.uniform(40, 120))
            _box(plane, (left + size[0] / 2 - 5, top), (10, size[1]), 220)
    for top, thick in ((60, 25), (1190, 30), (1540, 40)):
        _box(plane, (0, top), (extent[0], thick), wall * 0.45)
    for column in range(columns):
        middle = (round((column + 0.5) * step), 1400)
        radius = round(0.35 * step)
        cv2.circle(plane, middle, radius, wall * 0.4, -1, cv2.LINE_AA)
        _box(plane, (middle[0] - radius, middle[1]), (2 * radius, 140), wall * 0.4)
    for _ in range(12):
        middle = tuple(rng.integers((0, 0), extent).tolist())
        cv2.ellipse(plane, middle, (40, 12), float(rng.uniform(0, 180)), 0, 360, 60, -1, cv2.LINE_AA)
    return plane, extent


def _hall(rng: np.random.Generator) -> tuple[np.ndarray, tuple[int, int]]:
    """A floor with markings of two sports, straight and round, and seams of boards."""
    extent = (2400, 1600)
    floor = rng.uniform(110, 170)
    plane = np.full(extent[::-1], floor, np.float32)
    for top in range(0, extent[1], 100):
        _box(plane, (0, top), (extent[0], 3), floor - 25)
    for tone, shrink in ((235, 0.05), (50, 0.18)):
        low, high = np.multiply(extent, shrink), np.multiply(extent, 1 - shrink)
        for x in (low[0], extent[0] / 2, high[0], (low[0] * 3 + high[0]) / 4, (low[0] + high[0] * 3) / 4):
            _box(plane, (x, low[1]), (14, high[1] - low[1]), tone)
        for y in (low[1], high[1], extent[1] / 2 if tone > 99 else low[1] + 200):
            _box(plane, (low[0], y), (high[0] - low[0], 14), tone)
        for _ in range(4):
            middle = tuple(rng.integers((200, 200), np.subtract(extent, 200)).tolist())
            cv2.circle(plane, middle, int(rng.integers(80, 300)), tone, 12, cv2.LINE_AA)
    return plane, extent


def _bare(rng: np.random.Generator) -> tuple[np.ndarray, tuple[int, int]]:
    """A wall with two to five boards, level or upright, and nothing else."""
    extent = (2400, 1600)
    wall = rng.uniform(140, 200)
    plane = np.full(extent[::-1], wall, np.float32)
    for _ in range(int(rng.integers(2, 6))):
        (x, y), thick = rng.uniform(0.1, 0.9, 2) * extent, rng.uniform(15, 60)
        long = rng.uniform(0.4, 1.6) * extent[1]
        level = rng.random() < 0.5
        size = np.array((long, thick) if level else (thick, long))
        _box(plane, (x - size[0] / 2, y - size[1] / 2), size, wall * rng.uniform(0.2, 0.8))
    return plane, extent


def _arena(rng: np.random.Generator) -> tuple[np.ndarray, tuple[int, int]]:
    """Rows of seats on arcs about one point, and a few level and upright boards seen through gaps."""
    extent = (2400, 1600)
    ground = rng.uniform(120, 180)
    plane = np.full(extent[::-1], ground, np.float32)
    middle = (round(rng.uniform(0.2, 0.8) * extent[0]), round(rng.uniform(1.3, 2.2) * extent[1]))
    row, column = np.indices(plane.shape, dtype=np.float32)
    radius, step = np.hypot(column - middle[0], row - middle[1]), rng.uniform(60, 110)
    tones = ground * rng.uniform(0.4, 0.8, int(radius.max() / step) + 1)
    seats = radius % step < 14
    plane[seats] = tones[(radius[seats] / step).astype(int)]
    for _ in range(int(rng.integers(4, 8))):
        place, thick, tone = rng.uniform(0.1, 0.9, 2) * extent, rng.uniform(20, 50), ground * 0.25
        level = rng.random() < 0.4
        for start in np.arange(0, extent[0 if level else 1], 260):
            size = (140, thick) if level else (thick, 140)
            _box(plane, (start, place[1]) if level else (place[0], start), size, tone)
    return plane, extent


PLANES = {"arcs": _arena}
"""What is photographed in place of facades and halls, by what makes scenes hard."""


def _box(plane: np.ndarray, corner, size, tone: float) -> None:
    """Fill a box with a tone."""
    left, top = (round(value) for value in corner)
    plane[max(top, 0) : round(top + size[1]), max(left, 0) : round(left + size[0])] = tone


def _people(image: np.ndarray, rng: np.random.Generator, number: int | None = None) -> None:
    """Blobs in front of the scene, round and in all directions."""
    high, wide = image.shape
    for _ in range(int(rng.integers(4, 14)) if number is None else number):
        middle = tuple(rng.integers((0, 0), (wide, high)).tolist())
        axes = tuple(rng.integers((20, 40), (60, 140)).tolist())
        cv2.ellipse(
            image,
            middle,
            axes,
            float(rng.uniform(-30, 30)),
            0,
            360,
            float(rng.uniform(20, 240)),
            -1,
            cv2.LINE_AA,
        )
