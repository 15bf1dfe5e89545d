"""Rendered clips with exact truth: a camera on a tripod turns and zooms before a distant panorama.

A pixel x shows the ray ``X = R^T (z, 1)``, ``z = (undistorted x - centre) / f``, and the ray shows the
texture at ``2 density (X1, X2) / (|X| + X3)``: a stereographic map, which keeps angles, mirrored at the
texture's borders again and again. Each pixel averages samples of it, taken from copies averaged
down to their spacing.

Once a clip: the texture and its smaller copies. Once a frame: the samples' places, in one compiled program.
"""

import dataclasses
import math
from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, UInt8

from .._core.arguments import kinds_checked
from .._core.checks import check_above, check_between, checked_focal, checked_integer, checked_size
from ..correct.sampler import remap
from ..models.lens import ZoomLens
from .motion import camera_between, check_in_px

_SIDE, _PHASES = 0.11, 32
"""Of the cells that moving things stay in: radians, and after how many all repeats."""

_BOXES = ((0.04, 0.05, 0.24, 0.13), (0.85, 0.05, 0.96, 0.16))
"""Of the caption and the logo: left, top, right and bottom, in widths and heights."""


@dataclasses.dataclass(frozen=True, eq=False)
class MotionClip:
    """A clip to be rendered, and what is true of it; `motion_clip` makes it.

    Attributes:
        lens: the lens, with focal lengths in px.
        focal: focal length of each frame, px.
        rotation: of each frame, from the scene to the camera, whose axes are x right, y down, z forward.
        texture: the panorama, blue, green, red.
        density: pixels of the texture a radian, in its middle.
        noise: standard deviation of each pixel's noise, grey levels.
        moving: share of the area that moving things cover.
        shutter: time from the first row to the last, in frames; the middle one has the frame's own.
        caption: whether a caption and a logo stand in the image.
        samples: of a pixel, in each direction.
        seed: of the noise and of how things move.
    """

    lens: ZoomLens
    focal: Float[np.ndarray, "frame"]
    rotation: Float[np.ndarray, "frame 3 3"]
    texture: UInt8[np.ndarray, "high wide 3"]
    density: float
    noise: float
    moving: float
    shutter: float
    caption: bool
    samples: int
    seed: int

    def frames(self) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
        """The frames, blue, green, red."""
        rng = np.random.default_rng(self.seed)
        copies = _copies(self.texture)
        size = np.array(self.lens.image_size)
        x, y = ((np.arange(n * self.samples) + 0.5) / self.samples - 0.5 for n in size)
        for number in range(len(self.focal)):
            time = self._time(number, y)
            focal, rotation = self._camera(time)
            spacing = self.density / float(np.median(focal)) / self.samples
            level = int(np.clip(np.floor(np.log2(spacing)), 0, len(copies) - 1))
            things = self._things(number) if self.moving else None
            u, v = _map(
                self.lens, focal, rotation, x, y, self.density, things, self.texture.shape[1::-1], level
            )
            image = _averaged(_sampled(copies[level], np.asarray(u), np.asarray(v)), self.samples)
            if self.noise:
                image = image + self.noise * rng.standard_normal(image.shape, np.float32)
            image = np.clip(np.rint(image), 0, 255).astype(np.uint8)
            if self.caption:
                _write_captions(image)
            yield image

    def rays(self, frame: int, points: Float[np.ndarray, "point 2"]) -> Float[np.ndarray, "point 3"]:
        """The rays of the scene, of length 1, that points of a frame show, px.

        Raises:
            IndexError: there is no such frame; so for `points` and `is_moving`.
        """
        self._check(frame)
        focal, rotation = self._camera(self._time(frame, points[:, 1]))
        ahead = _each(_ahead, self.lens, focal, points)
        rays = np.einsum("pji,pj->pi", rotation, ahead)
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def points(self, frame: int, rays: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point 2"]:
        """Where a frame shows rays, px: perhaps outside of it; NaN behind the camera."""
        self._check(frame)
        time, seen = np.full(len(rays), float(frame)), np.empty((len(rays), 2))
        for _ in range(8 if self.shutter else 1):  # the row tells the time, and the time the row
            focal, rotation = self._camera(time)
            ahead = np.einsum("pij,pj->pi", rotation, rays)
            with np.errstate(divide="ignore", invalid="ignore"):
                flat = np.where(ahead[:, 2:] > 0, ahead[:, :2] / ahead[:, 2:], np.nan)
            seen = _each(_seen, self.lens, focal, flat)
            time = self._time(frame, np.nan_to_num(seen[:, 1]))
        return seen

    def is_moving(self, frame: int, points: Float[np.ndarray, "point 2"]) -> Bool[np.ndarray, "point"]:
        """Which points of a frame are on things that move."""
        places = _places(self.rays(frame, points), self.density)
        return np.asarray(_with_things(places, *self._things(frame))[1]) & (self.moving > 0)

    def is_caption(self, points: Float[np.ndarray, "point 2"]) -> Bool[np.ndarray, "point"]:
        """Which points are on the caption or the logo, whose borders belong to them."""
        size = np.array(self.lens.image_size)
        return np.array(self.caption) & np.any(
            [
                ((points >= size * box[:2] - 1) & (points <= size * box[2:])).all(axis=1)
                for box in np.array(_BOXES)
            ],
            axis=0,
        )

    def _check(self, frame: int) -> None:
        """Refuse a frame that there is not: a camera stays where it is beyond the ends of a clip."""
        if not 0 <= frame < len(self.focal):
            raise IndexError(f"There is no frame {frame}: the frames are 0 to {len(self.focal) - 1}.")

    def _time(self, frame: int, y: np.ndarray) -> np.ndarray:
        """When rows are seen, in frames."""
        return frame + self.shutter * (y / (self.lens.image_size[1] - 1) - 0.5)

    def _camera(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Focal lengths and rotations at any times."""
        return camera_between(self.focal, self.rotation)(time)

    def _things(self, frame: int) -> tuple[np.ndarray, float, float, float]:
        """Where each thing is from the middle of its cell; the sides of cell and thing; another texture."""
        rng = np.random.default_rng((self.seed, 1))
        shape, cell = (_PHASES, _PHASES, 2), _SIDE * self.density
        side = cell * float(np.sqrt(self.moving))
        phase, period = rng.uniform(0, 2 * np.pi, shape), rng.uniform(40, 80, shape)
        shift = (cell - side) / 2 * np.sin(phase + 2 * np.pi * frame / period)
        return shift, cell, side, 0.41 * self.texture.shape[1]


@kinds_checked
def motion_clip(
    lens: ZoomLens,
    focal: Float[np.ndarray, "frame"],
    rotation: Float[np.ndarray, "frame 3 3"],
    *,
    texture: UInt8[np.ndarray, "high wide 3"] | None = None,
    density: float | int | None = None,
    noise: float | int = 0,
    moving: float | int = 0,
    shutter: float | int = 0,
    caption: bool = False,
    samples: int = 2,
    seed: int = 0,
) -> MotionClip:
    """A clip of a distant panorama, as a turning and zooming camera sees it.

    Args:
        lens: the true lens, with focal lengths in px.
        focal, rotation: of each frame: `pan_and_zoom`, or of a real camera.
        texture: the panorama: a photograph, blue, green, red; by default `leaves`.
        density: pixels of the texture a radian, in its middle; by default the largest of the focal lengths.
        noise: standard deviation of each pixel's noise, grey levels.
        moving: share of the area that moving things cover, from 0 to 0.6. Each moves to and fro about its
            place, by some 2 px a frame at a focal length of 1,000 px.
        shutter: time from the first row to the last, in frames: 0 is a global shutter.
        caption: whether a caption and a logo stand in the image, as a broadcaster's do.
        samples: of a pixel, in each direction.
        seed: of everything random.

    Returns:
        What renders the frames, one after the other, and tells where they show what.
    """
    check_in_px(lens)
    checked_focal(focal)
    checked_integer("samples", samples, 1)
    check_between(0, math.inf, noise=noise)
    check_between(0, 0.6, moving=moving)
    check_between(-1, 1, shutter=shutter)
    seed = checked_integer("seed", seed, 0)
    texture = leaves(seed=seed) if texture is None else texture
    density = float(np.max(focal)) if density is None else density
    check_above(0, density=density)
    return MotionClip(
        lens,
        np.asarray(focal, np.float64),
        np.asarray(rotation, np.float64),
        texture,
        float(density),
        float(noise),
        float(moving),
        float(shutter),
        caption,
        samples,
        seed,
    )


def leaves(size: tuple[int, int] = (2048, 1024), *, seed: int = 0) -> UInt8[np.ndarray, "high wide 3"]:
    """A texture with sharp edges and corners of all sizes: tilted rectangles, small over large.

    Args:
        size: (width, height) px.
        seed: of everything random.
    """
    rng = np.random.default_rng(checked_integer("seed", seed, 0))
    width, height = size = checked_size(size, "size")
    image = np.full((height, width, 3), 110, np.uint8)
    radius, share = min(size) // 4, 1.5
    while radius >= 6:
        offset = np.arange(-radius - 1, radius + 2)
        number = int(share * width * height / (0.5 * radius**2)) + 1
        for some in np.array_split(np.arange(number), number * len(offset) ** 2 // 4_000_000 + 1):
            n = (len(some), 1, 1)
            x, y = rng.uniform(0, width, n), rng.uniform(0, height, n)
            across = np.floor(x) + offset
            down = np.floor(y) + offset[:, None]
            angle, reach, narrow = (rng.uniform(*ends, n) for ends in ((0, np.pi), (0.35, 0.7), (0.3, 0.7)))
            c, s = np.cos(angle), np.sin(angle)
            inside = abs(c * (across - x) + s * (down - y)) < reach * radius
            inside &= abs(c * (down - y) - s * (across - x)) < narrow * reach * radius
            leaf, i, j = np.nonzero(inside)
            rows, columns = down[leaf, i, 0].astype(int), across[leaf, 0, j].astype(int)
            colours = rng.uniform(25, 230, (len(some), 1)) + rng.uniform(-25, 25, (len(some), 3))
            image[rows % height, columns % width] = colours.astype(np.uint8)[leaf]
        radius, share = radius // 2, 0.65 * share
    return image


def _copies(texture: np.ndarray) -> list[np.ndarray]:
    """The texture, and smaller ones: each pixel the mean of 2 x 2."""
    copies = [texture]
    while min(copies[-1].shape[:2]) >= 128:
        rows, columns = (n // 2 * 2 for n in copies[-1].shape[:2])
        copies.append(np.rint(_averaged(copies[-1][:rows, :columns], 2)).astype(np.uint8))
    return copies


def _averaged(image: np.ndarray, number: int) -> np.ndarray:
    """The means of squares of so many pixels a side."""
    total = np.zeros((image.shape[0] // number, image.shape[1] // number, 3), np.float32)
    for i in range(number):
        for j in range(number):
            total += image[i::number, j::number]
    return total / number**2


def _sampled(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return remap(image, u, v, "linear", "replicate", np.zeros(3))


def _write_captions(image: np.ndarray) -> None:
    """Blocks of grey, the same in all frames."""
    rng, (height, width) = np.random.default_rng(0), image.shape[:2]
    for left, top, right, bottom in _BOXES:
        box = image[int(top * height) : int(bottom * height), int(left * width) : int(right * width)]
        block = max(height // 100, 3)
        blocks = rng.integers(20, 235, (len(box) // block + 1, box.shape[1] // block + 1, 1), np.uint8)
        box[:] = blocks.repeat(block, axis=0).repeat(block, axis=1)[: len(box), : box.shape[1]]


def _each(function, lens: ZoomLens, focal: np.ndarray, values: np.ndarray) -> np.ndarray:
    """A compiled function of points, each at a focal length of its own; compiled for few sizes."""
    more = (0, 2 ** int(np.ceil(np.log2(max(len(values), 16)))) - len(values))
    focal = np.pad(focal, more, constant_values=float(lens.focal_range[0]))
    return np.asarray(function(lens, focal, np.pad(values, (more, (0, 0)))))[: len(values)]


@eqx.filter_jit
def _ahead(lens, focal, points):
    """Rays of the camera through points."""

    def one(f, point):
        flat = (jnp.asarray(lens(f).undistort(point)) - lens.centre_at(f)) / f
        return jnp.append(flat, 1)

    return jax.vmap(one)(focal, points)


@eqx.filter_jit
def _seen(lens, focal, flat):
    """Where flat points are seen, px."""
    return jax.vmap(lambda f, z: lens(f).distort(lens.centre_at(f) + f * z))(focal, flat)


@eqx.filter_jit
def _map(lens, focal, rotation, x, y, density, things, size, level):
    """Where pixels show a copy of the texture, in its pixels, in float32 for OpenCV."""

    def row(f, turn, height):
        points = jnp.stack([x, jnp.full_like(x, height)], axis=-1)
        flat = (lens(f).undistort(points) - lens.centre_at(f)[None]) / f
        rays = [flat[:, 0] * turn[0, i] + flat[:, 1] * turn[1, i] + turn[2, i] for i in range(3)]
        places = _places(jnp.stack(rays, axis=-1), density)
        return places if things is None else _with_things(places, *things)[0]

    places, folded = jax.vmap(row)(focal, rotation, y), []
    for axis in (0, 1):
        edge = places[..., axis] + size[axis] / 2  # from the texture's left or upper edge
        inside = size[axis] - jnp.abs(edge % (2 * size[axis]) - size[axis])
        folded.append((inside / 2.0**level - 0.5).astype(jnp.float32))
    return folded


def _places(rays, density):
    """Where rays show the texture, in its pixels from its middle."""
    length = jnp.sqrt(jnp.sum(jnp.square(rays), axis=-1))
    return 2 * density * rays[..., :2] / (length + rays[..., 2])[..., None]


def _with_things(places, shift, cell, side, other):
    """The same where things move, each in a cell of its own; and which places are on things."""
    number = jnp.floor(places / cell)
    column, row = jnp.moveaxis(number.astype(jnp.int32) % _PHASES, -1, 0)
    shift = jnp.asarray(shift, places.dtype)[row, column]
    inside = jnp.all(jnp.abs(places - (number + 0.5) * cell - shift) < side / 2, axis=-1)
    return jnp.where(inside[..., None], places - shift + other, places), inside
