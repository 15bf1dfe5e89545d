"""The focal length from a board of known geometry, parallel to the sensor.

At a known distance d the image is the board times a magnification, and eq. 14 of the paper,
``f = d r_c / (R + r_c)``, gives the focal length of the thin lens, which is focused at the board. Here
r_c / R is the scale of the similarity that best maps the board's points to the image.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Num

from .._core.fields import check_positive
from .._core.pixels import check_pitch
from .._core.types import AnyArray, Scalar
from .estimate import FocalEstimate, as_points_of, check_pairs


def focal_from_board(
    points: Num[AnyArray, "point 2"] | list,
    board: Num[AnyArray, "point 2"] | list,
    *,
    distance: float | int | Scalar,
    pixel_pitch: float | int | Scalar,
) -> FocalEstimate:
    """Estimate the focal length from one picture of a board parallel to the sensor: eq. 14.

    Args:
        points: corrected positions in the image, px, at least 3.
        board: the same points on the board, mm. Its position and rotation in its plane do not matter, nor
            whether y goes up or down: of the two that fits better is taken.
        distance: from the projection plane to the board, mm, > 0: eq. 14's d.
        pixel_pitch: side of a pixel on the sensor, mm. 1 is for points measured in mm.

    Returns:
        The focal length in mm. Residuals are treated as independent errors of the points' coordinates.
        Errors of distance, pixel_pitch and board are not included: f changes by as many per cent as the
        distance.

    Raises:
        ValueError: shapes differ, there are fewer than 3 points, a length is not positive, or
            pixels are of a width that no sensor has.
        RuntimeError: a length that was not known is not positive, or all points of the board coincide.

    References:
        Eq. 14 of the paper.

    Example:
        >>> import numpy as np
        >>> board = 10 * np.stack(np.meshgrid(np.arange(5.0), np.arange(4.0)), axis=-1).reshape(-1, 2)
        >>> image = board * 50 / (1000 - 50) / 0.005 + 100
        >>> print(round(float(focal_from_board(image, board, distance=1000, pixel_pitch=0.005).focal), 3))
        50.0
    """
    points, board = as_points_of("points", points), as_points_of("board", board)
    check_pairs(points.shape, board.shape, fewest=3)
    check_positive("distance", np.asarray(distance) if isinstance(distance, int | float) else distance)
    check_positive(
        "pixel_pitch", np.asarray(pixel_pitch) if isinstance(pixel_pitch, int | float) else pixel_pitch
    )
    if not (isinstance(pixel_pitch, int | float) and pixel_pitch == 1):
        check_pitch(pixel_pitch)
    # A similarity is one complex factor: its absolute value is px in the image per mm on the board.
    seen, known = _complex(points), _complex(board)
    seen, known = seen - jnp.mean(seen), known - jnp.mean(known)
    # The error depends on the board alone: `shard_map` takes none that differs from device to device.
    spread = jnp.sum(abs(known) ** 2)
    positive = (jnp.asarray(distance) > 0) & (jnp.asarray(pixel_pitch) > 0) & (spread > 0)
    spread = eqx.error_if(
        spread,
        ~positive,
        "Arguments distance and pixel_pitch must be positive, and the points of board must differ.",
    )
    mirrored = abs(jnp.sum(known * seen)) > abs(jnp.sum(jnp.conj(known) * seen))
    known = jnp.where(mirrored, jnp.conj(known), known)
    factor = jnp.sum(jnp.conj(known) * seen) / spread
    squares = jnp.sum(abs(seen - factor * known) ** 2)
    ratio = abs(factor) * pixel_pitch  # r_c / R
    error = jnp.sqrt(squares / (2 * len(points) - 4) / spread) * pixel_pitch
    return FocalEstimate(
        focal=distance * ratio / (1 + ratio),
        std=distance * error / (1 + ratio) ** 2,
        rms=jnp.sqrt(squares / len(points)),
    )


def _complex(points):
    return points[:, 0] + 1j * points[:, 1]
