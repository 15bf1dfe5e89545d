"""A synthetic scene with exact truth: the paper's striped board, seen through a known lens.

The paper's first experiment: a board of 31 x 23 white stripes, 1330 x 1010 mm, fronto-parallel at 1185 mm
from the camera, photographed with a Nikon D90 (4288 x 2848 px, sensor 23.7 mm wide) and a Nikkor 18-200 at
50 focal lengths from 20.56 to 127.36 mm. The truth here is the pair of polynomials that the paper
published for that lens. Every stripe has two edges, each a straight line of the scene.

`board_lines` gives those edges as an ideal detector would; `board_photo` renders a photo.
"""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray, ScalarLike, UInt8

from .._core.checks import check_above, check_between, checked_focal, checked_integer, checked_size
from .._core.fields import check_not_negative, real_argument
from .._core.types import AnyArray, traced
from ..lines.lines import Lines
from ..models.camera import px_of_focal_px
from ..models.distortion import Distortion
from ..models.distortion_model import AbstractRadial
from ..models.lens import ZoomLens
from ..models.requirements import check
from ..models.zoom import PolynomialZoom

_NIKKOR_PIXELS = np.array(  # section 5.1: rows are powers of 1/f, columns k1 (px^-2) and k2 (px^-4)
    [[2.26e-9, 1.74e-17], [-7.19e-7, 7.36e-15], [2.14e-5, -6.55e-13]]
)
_SENSOR = (23.7, 4288)
"""Width of the sensor, mm and px, for which the polynomials are."""


def nikkor_18_200(image_size: tuple[int, int] = (4288, 2848)) -> ZoomLens:
    """The lens of the paper's first experiment, from its published polynomials (section 5.1).

    Args:
        image_size: (width, height) px of its images, of which the width always covers the whole sensor.
    """
    width, height = checked_size(image_size)
    scale = np.hypot(width, height) / 2 * _SENSOR[1] / width  # half the diagonal, in the paper's pixels
    focal_range = jnp.array([20.56, 127.36])
    return ZoomLens(
        zoom=PolynomialZoom.from_inverse_focal(_NIKKOR_PIXELS * [scale**2, scale**4], focal_range[0]),
        centre=(jnp.array([width, height]) - 1) / 2,
        focal_range=focal_range,
        image_size=(width, height),
        focal_unit="mm",
    )


@dataclasses.dataclass(frozen=True)
class StripedBoard:
    """The paper's board (Figure 3), fronto-parallel and centred, and the camera's pixels.

    Attributes:
        stripes: number of vertical and of horizontal white stripes.
        size: width and height, mm.
        distance: from the projection plane to the board, mm.
        pixel_pitch: side of a pixel on the sensor, mm.
    """

    stripes: tuple[int, int] = (31, 23)
    size: tuple[float, float] = (1330.0, 1010.0)
    distance: float = 1185.0
    pixel_pitch: float = _SENSOR[0] / _SENSOR[1]

    @classmethod
    def before(cls, lens: ZoomLens) -> "StripedBoard":
        """The paper's board, for a camera whose images have the size of the lens's."""
        return cls(pixel_pitch=_SENSOR[0] / lens.image_size[0])

    def __post_init__(self):
        """Check that it has stripes, and that lengths are some."""
        for number in self.stripes:
            checked_integer("stripes", number, 1)
        for side in self.size:
            check_above(0, size=side)
        check_above(0, distance=self.distance, pixel_pitch=self.pixel_pitch)

    def magnification(self, focal: float) -> float:
        """Pixels per mm on the board: eq. 7, ``r_c / R = f / (d - f)``, f in mm.

        Raises:
            ValueError: the focal length is known and not positive, or not below the distance.
        """
        if not traced(focal) and not ((np.asarray(focal) > 0) & (np.asarray(focal) < self.distance)).all():
            raise ValueError(
                f"Argument focal must be in mm, above 0 and below the distance of the board, "
                f"{self.distance:g} mm, but it is {focal}."
            )
        return focal / (self.distance - focal) / self.pixel_pitch

    def seen_by(self, lens: ZoomLens, focal: float) -> float:
        """The magnification at a focal length of a lens, in its own unit."""
        if lens.focal_unit == "px":
            focal = focal * px_of_focal_px(lens) * self.pixel_pitch
        return self.magnification(focal)

    def edges(self, axis: int) -> np.ndarray:
        """Positions, mm from the middle, of both edges of the stripes that are counted along an axis."""
        period = self.size[axis] / self.stripes[axis]
        return np.arange(2 * self.stripes[axis]) * period / 2 - self.size[axis] / 2


def focal_sweep(
    number: int = 50, shortest: float | int = 20.56, longest: float | int = 127.36
) -> np.ndarray:
    """Focal lengths spread evenly in 1/f, increasing; by default those of the paper's experiment."""
    checked_integer("number", number, 1)
    check_above(0, shortest=shortest, longest=longest)
    return 1 / np.linspace(1 / shortest, 1 / longest, number)


def board_lines(
    lens: ZoomLens,
    focal: np.ndarray,
    *,
    board: StripedBoard | None = None,
    spacing: float | int = 12,
    noise: float | int = 0,
    imperfection: float | int = 0,
    seed: int = 0,
) -> Lines:
    """The edges of the stripes at each focal length, as an edge detector would give them.

    Args:
        lens: the true lens; its dtype is the result's.
        focal: focal lengths in the lens's unit, one image each.
        board: the board and the camera's pixels; by default the paper's, whatever the image size.
        spacing: distance between neighbouring points of a line, px. 12 gives about the paper's number of
            points, 0.8 million; 1, about an edge point a pixel, gives 10 million.
        noise: standard deviation, px, of the error of each coordinate of each point.
        imperfection: RMS, mm, by which the board's edges are bent: smoothly, each in its own way, and the
            same in all images.
        seed: of the noise and of the bends.

    Returns:
        All edges at least a tenth of the image's height long.
    """
    focal = checked_focal(focal).astype(np.asarray(focal).dtype)
    check_above(0, spacing=spacing)
    check_between(0, math.inf, noise=noise, imperfection=imperfection)
    seed = checked_integer("seed", seed, 0)
    board = StripedBoard.before(lens) if board is None else board
    rng = np.random.default_rng(seed)
    own = np.random.default_rng((seed, 1))  # so that bends leave the noise as it is
    bends = [imperfection * _bends(2 * number, own) for number in board.stripes]
    reach = _reach(lens, focal)
    along = spacing * np.arange(-np.ceil(reach / spacing), np.ceil(reach / spacing) + 1)
    points: list[np.ndarray] = []
    frame: list[int] = []
    for index, f in enumerate(focal):
        magnification = board.seen_by(lens, float(f))
        for axis in (0, 1):
            place = along / magnification / board.size[1 - axis]  # from -1/2 to 1/2 along the board
            seen, inside = _seen(
                lens(float(f)),
                magnification * (board.edges(axis)[:, None] + bends[axis] @ _waves(place)),
                np.where(abs(place) <= 0.5, along, np.nan),
                axis,
                lens.image_size,
            )
            for line, keep in zip(np.asarray(seen), np.asarray(inside), strict=True):
                line = line[keep]
                if len(line) > 2 and np.hypot(*(line[-1] - line[0])) >= lens.image_size[1] / 10:
                    error = noise * rng.standard_normal(line.shape)
                    points.append(line + error.astype(line.dtype))
                    frame.append(index)
    return Lines.from_ragged(points, frame, focal, image_size=lens.image_size, focal_unit=lens.focal_unit)


_WAVES = np.arange(1, 4)
"""Half waves along an edge that is bent."""


def _bends(edges: int, rng: np.random.Generator) -> Float[np.ndarray, "edge wave"]:
    """How each edge is bent, of RMS 1 on the average."""
    return rng.standard_normal((edges, len(_WAVES))) * np.sqrt(2 / len(_WAVES))


def _waves(place: Float[np.ndarray, "point"]) -> Float[np.ndarray, "wave point"]:
    """The shapes of bends at places along a board, from -1/2 to 1/2."""
    return np.sin(np.pi * _WAVES[:, None] * (place + 0.5))


def with_noise(
    lines: Lines,
    key: PRNGKeyArray,
    *,
    std: Float[AnyArray, "line"] | ScalarLike,
    correlation: ScalarLike = 0.0,
) -> Lines:
    """The lines with Gaussian errors in their points; for `jax.vmap` and `jax.lax.map` over many draws.

    Args:
        lines: the lines.
        key: of `jax.random`.
        std: standard deviation, px, of each coordinate of each point: one for all lines, or one per line.
        correlation: correlation of the error of a point with that of the next on its line, from 0 to less
            than 1. With 0.8 an edge of many points is as certain as from a ninth of them if independent.

    Raises:
        ValueError: `std` or `correlation` are known, and not as above.
    """
    std = real_argument("std", std)
    check_not_negative("std", std)
    if not traced(correlation):
        check_between(0, float(np.nextafter(1, 0)), correlation=correlation)
    fresh = jax.random.normal(key, lines.points.shape, jnp.asarray(lines.points).dtype)
    correlation = jnp.asarray(correlation, fresh.dtype)
    share = jnp.sqrt(1 - correlation**2)

    def follow(before, new):
        error = correlation * before + share * new
        return error, error

    along = jnp.swapaxes(fresh, 0, 1)
    _, error = jax.lax.scan(follow, along[0], along[1:])
    error = jnp.swapaxes(jnp.concatenate([along[:1], error]), 0, 1)
    size = jnp.broadcast_to(jnp.asarray(std, error.dtype), lines.frame.shape)[:, None, None]
    points = lines.points + jnp.where(lines.mask[..., None], size * error, 0)
    return eqx.tree_at(lambda data: data.points, lines, points)


@eqx.filter_jit
def _seen(
    distortion: Distortion,
    across: Float[AnyArray, "line point"],
    along: Float[AnyArray, "point"],
    axis: int,
    image_size: tuple[int, int],
) -> tuple[Float[Array, "line point 2"], Bool[Array, "line point"]]:
    """Lines parallel to an axis of the image, distorted, and which points fall within it.

    Positions are px from the centre in the corrected image; `axis` is the one that `across` counts on.
    """
    grid = jnp.stack(jnp.broadcast_arrays(jnp.asarray(across), jnp.asarray(along)[None]), axis=-1)
    corrected = distortion.centre[None, None] + (grid if axis == 0 else grid[..., ::-1])
    seen = jnp.asarray(distortion.distort(corrected.astype(distortion.centre.dtype)))
    last = jnp.array(image_size)[None, None] - 1
    return seen, jnp.all((seen >= 0) & (seen <= last), axis=-1)


def _reach(lens: ZoomLens, focal: np.ndarray) -> float:
    """How far, px, corrected images extend from the centre at any of the focal lengths."""
    reach = np.asarray(jax.vmap(lambda f: farthest(lens(f), lens.image_size))(jnp.asarray(focal)))
    if not np.isfinite(reach).all():
        beyond = focal[~np.isfinite(reach)][0]
        raise ValueError(
            f"Argument focal must be within the range of the lens, but at {beyond:g} it folds everywhere."
        )
    return float(reach.max())


def farthest(distortion: Distortion, image_size: tuple[int, int]) -> Float[Array, ""]:
    """How far, px, a corrected image extends from the centre: to a corner, or the fold on the way to it."""
    centre = jnp.asarray(distortion.centre)
    corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * (np.array(image_size) - 1)
    away = jnp.asarray(corners, centre.dtype) - centre[None]
    radius = jnp.linalg.norm(away, axis=1, keepdims=True)
    away = away * jnp.minimum(1, distortion.monotone_radius / jnp.where(radius > 0, radius, 1))
    return jnp.max(jnp.linalg.norm(distortion.undistort(centre[None] + away) - centre[None], axis=1))


def board_photo(
    lens: ZoomLens,
    focal: float,
    *,
    board: StripedBoard | None = None,
    blur: float | int = 1.0,
    noise: float | int = 2.0,
    vignetting: float | int = 0.3,
    levels: tuple[float | int, float | int] = (35, 215),
    seed: int = 0,
) -> UInt8[np.ndarray, "height width"]:
    """Render a photo of the board: white stripes in both directions on a dark background.

    Each pixel integrates the blurred scene over its own square: analytically across a border, and by two
    Gauss points along it. Blurring an image of pixels instead would move its borders by up to 0.02 px.

    Args:
        lens: the true lens; its dtype is that of the computation, its image size the photograph's.
        focal: the focal length, in the lens's unit.
        board: the board and the camera's pixels; by default the paper's, whatever the image size.
        blur: standard deviation, px, of the Gaussian blur of the optics; at most an eighth of a stripe, for
            each border is blurred separately.
        noise: standard deviation, grey levels, of the noise of each pixel.
        vignetting: the fraction of light lost in the corners.
        levels: grey levels of dark and white in the middle, of 255.
        seed: of the noise.

    Raises:
        ValueError: its distortion model is not radial.
    """
    check("board_photo", zoom=lens.zoom, distortion_model=lens.distortion_model)
    check_above(0, focal=focal)
    check_between(0, math.inf, blur=blur, noise=noise)
    check_between(0, 1, vignetting=vignetting)
    seed = checked_integer("seed", seed, 0)
    for level in levels:
        check_between(0, math.inf, levels=level)
    board = StripedBoard.before(lens) if board is None else board
    dtype = lens.centre.dtype
    photo = np.asarray(
        _expose(
            lens(float(focal)),
            (jnp.asarray(board.edges(0), dtype), jnp.asarray(board.edges(1), dtype)),
            jnp.asarray(board.seen_by(lens, float(focal)), dtype),
            jnp.asarray(max(blur, 1e-6), dtype),
            jnp.asarray([*levels, vignetting], dtype),
            lens.image_size,
        )
    )
    if noise:
        rng = np.random.default_rng(seed)
        photo = photo + noise * rng.standard_normal(photo.shape, dtype=np.float32)
    return np.clip(np.rint(photo), 0, 255).astype(np.uint8)


@eqx.filter_jit
def _expose(
    distortion: Distortion,
    edges: tuple[Float[Array, "vertical"], Float[Array, "horizontal"]],
    magnification: Float[Array, ""],
    blur: Float[Array, ""],
    light: Float[Array, "3"],
    image_size: tuple[int, int],
) -> Float[Array, "height width"]:
    """Light on each pixel, grey levels: coverage by white, and vignetting."""
    k, scale, distortion_model = distortion.coefficients, distortion.scale, distortion.distortion_model
    assert isinstance(distortion_model, AbstractRadial)
    x, y = (
        (jnp.arange(side) - centre) / scale
        for side, centre in zip(image_size, distortion.centre, strict=True)
    )
    columns, rows = x[None, :], y[:, None]
    gauss = 0.5 / math.sqrt(3) / scale

    def covered(across, along, edges):
        """Coverage of a pixel by the stripes and by the board, as far as one coordinate tells."""

        def at(along):
            squared = across**2 + along**2
            factor = distortion_model.factor(squared, k)
            # d(z L)/dz across, by L's derivative: (slope - L) / (2 t) per unit of t.
            growth = (distortion_model.slope(squared, k) - factor) / jnp.where(squared > 0, squared, 1)
            span = (factor + across**2 * growth) / magnification
            return _coverage(across * factor * scale / magnification, span, blur, edges)

        both = zip(at(along - gauss), at(along + gauss), strict=True)
        return [(a + b) / 2 for a, b in both]

    in_vertical, within_x = covered(columns, rows, edges[0])
    in_horizontal, within_y = covered(rows, columns, edges[1])
    white = in_vertical * within_y + within_x * in_horizontal - in_vertical * in_horizontal
    dark_level, white_level, vignetting = light
    return (dark_level + (white_level - dark_level) * white) * (1 - vignetting * (columns**2 + rows**2))


def _coverage(
    position: Float[Array, "..."],
    span: Float[Array, "..."],
    blur: Float[Array, ""],
    edges: Float[Array, "edge"],
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """How much of pixels at these positions, mm, `span` mm wide, is in the stripes, and in the board."""

    def passed(edge):
        """Integral over the pixel of a blurred step, from -1/2 to 1/2."""
        low, high = (
            t * jax.lax.erf(t / (math.sqrt(2) * blur))
            + math.sqrt(2 / math.pi) * blur * jnp.exp(-0.5 * (t / blur) ** 2)
            for t in ((position - edge) / span - 0.5, (position - edge) / span + 0.5)
        )
        return (high - low) / 2

    stripe, last = edges[1] - edges[0], edges.shape[0] - 1
    nearest = jnp.clip(jnp.round((position - edges[0]) / stripe), 0, last)
    rising = 1 - 2 * (nearest % 2)
    left = position < (edges[0] + edges[-1]) / 2
    within = 0.5 + jnp.where(left, 1, -1) * passed(jnp.where(left, edges[0], edges[-1]))
    return 0.5 + rising * passed(edges[0] + nearest * stripe), within
