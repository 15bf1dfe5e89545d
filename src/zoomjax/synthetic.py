"""Scenes with exact truth: the paper's striped board, seen through a lens that is known.

The paper's first experiment: a board of 31 x 23 white stripes, 1330 x 1010 mm, fronto-parallel at 1185 mm
from the camera, photographed with a Nikon D90 (4288 x 2848 px, sensor 23.7 mm wide) and a Nikkor 18-200 at
50 focal lengths from 20.56 to 127.36 mm. The truth here is the pair of polynomials that the paper
published for that lens. Every stripe has two edges, each a straight line of the scene.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ._types import AnyArray
from .lens import ZoomLens
from .lines import Lines
from .radial import Distortion
from .zoom import PolynomialZoom

_NIKKOR_PIXELS = np.array(  # section 5.1: rows are powers of 1/f, columns k1 (px^-2) and k2 (px^-4)
    [[2.26e-9, 1.74e-17], [-7.19e-7, 7.36e-15], [2.14e-5, -6.55e-13]]
)


def nikkor_18_200() -> ZoomLens:
    """The lens of the paper's first experiment, from its published polynomials (section 5.1)."""
    size = (4288, 2848)
    scale = np.hypot(*size) / 2
    focal_range = jnp.array([20.56, 127.36])
    return ZoomLens(
        zoom=PolynomialZoom.from_inverse_focal(_NIKKOR_PIXELS * [scale**2, scale**4], focal_range[0]),
        centre=(jnp.array(size) - 1) / 2,
        focal_range=focal_range,
        image_size=size,
        focal_unit="mm",
    )


@dataclasses.dataclass(frozen=True)
class StripedBoard:
    """The paper's board (Figure 3), fronto-parallel and centred, and the camera's pixels.

    Attributes:
        stripes: number of vertical and of horizontal white stripes.
        size: width and height, mm.
        distance: from the projection plane to the board, mm.
        pixel: side of a pixel on the sensor, mm.
    """

    stripes: tuple[int, int] = (31, 23)
    size: tuple[float, float] = (1330.0, 1010.0)
    distance: float = 1185.0
    pixel: float = 23.7 / 4288

    def magnification(self, focal: float) -> float:
        """Pixels per mm on the board: eq. 7, ``r_c / R = f / (d - f)``."""
        return focal / (self.distance - focal) / self.pixel

    def edges(self, axis: int) -> np.ndarray:
        """Positions, mm from the middle, of both edges of the stripes that are counted along an axis."""
        period = self.size[axis] / self.stripes[axis]
        return np.arange(2 * self.stripes[axis]) * period / 2 - self.size[axis] / 2


def focal_sweep(
    number: int = 50, shortest: float | int = 20.56, longest: float | int = 127.36
) -> np.ndarray:
    """Focal lengths spread evenly in 1/f, increasing; by default those of the paper's experiment."""
    return 1 / np.linspace(1 / shortest, 1 / longest, number)


def board_lines(
    lens: ZoomLens,
    focal: np.ndarray,
    *,
    board: StripedBoard | None = None,
    spacing: float | int = 12,
    noise: float | int = 0,
    seed: int = 0,
) -> Lines:
    """The edges of the stripes at each focal length, as an edge detector would give them.

    Args:
        lens: the true lens; its dtype is the result's.
        focal: focal lengths, one image each.
        board: the board and the camera's pixels.
        spacing: distance between neighbouring points of a line, px. 12 gives about the paper's number of
            points, 0.8 million; 1, about an edge point a pixel, gives 10 million.
        noise: standard deviation, px, of the error of each coordinate of each point.
        seed: of the noise.

    Returns:
        All edges at least a tenth of the image's height long.
    """
    board = StripedBoard() if board is None else board
    rng = np.random.default_rng(seed)
    reach = _reach(lens, focal)
    along = spacing * np.arange(-np.ceil(reach / spacing), np.ceil(reach / spacing) + 1)
    points: list[np.ndarray] = []
    frame: list[int] = []
    for index, f in enumerate(focal):
        magnification = board.magnification(float(f))
        for axis in (0, 1):
            seen, inside = _seen(
                lens(float(f)),
                magnification * board.edges(axis),
                np.where(abs(along) <= magnification * board.size[1 - axis] / 2, along, np.nan),
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


@eqx.filter_jit
def _seen(
    distortion: Distortion,
    across: Float[AnyArray, "line"],
    along: Float[AnyArray, "point"],
    axis: int,
    image_size: tuple[int, int],
) -> tuple[Float[Array, "line point 2"], Bool[Array, "line point"]]:
    """Lines parallel to an axis of the image, distorted, and which points fall within it.

    Positions are px from the centre in the corrected image; `axis` is the one that `across` counts on.
    """
    grid = jnp.stack(jnp.meshgrid(across, along, indexing="ij"), axis=-1)
    corrected = distortion.centre[None, None] + (grid if axis == 0 else grid[..., ::-1])
    seen = distortion.distort(corrected.astype(distortion.centre.dtype))
    last = jnp.array(image_size)[None, None] - 1
    return seen, jnp.all((seen >= 0) & (seen <= last), axis=-1)


def _reach(lens: ZoomLens, focal: np.ndarray) -> float:
    """How far, px, corrected images extend from the centre at any of the focal lengths."""
    corner = jnp.zeros(2, lens.centre.dtype)
    corners = jax.vmap(lambda f: lens(f).undistort(corner))(jnp.asarray(focal))
    return float(jnp.max(jnp.linalg.norm(corners - lens.centre[None], axis=-1)))
