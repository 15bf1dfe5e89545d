"""Maps: for every pixel of a corrected image, its position in the distorted one.

Per pixel some 20 multiplications with no square root, division or branch, in one loop that XLA vectorises
and that is bound by writing its result. For that reason the map is not made from one quadrant by symmetry:
the copies would write as much, and need the centre in the middle.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..models.distortion import Distortion
from ._inverse_polynomial import RadialInverse, radius_ratio
from .framing import Framing

OUTSIDE = -16384.0
"""A position, px, that is off any image, and that OpenCV's 16-bit fixed-point coordinates can hold."""


@dataclasses.dataclass(frozen=True)
class Plane:
    """A sampling of an image: its own, or that of a video's colour planes.

    Attributes:
        size: (width, height) of the plane.
        step: image pixels per pixel of the plane, along x and y.
        offset: where in the image the plane's first pixel is, px.
    """

    size: tuple[int, int]
    step: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)


def source_positions(
    distortion: Distortion,
    framing: Framing,
    inverse: RadialInverse | None,
    plane: Plane | None = None,
    into: tuple[Array, Array] | None = None,
) -> tuple[Float[Array, "height width"], Float[Array, "height width"]]:
    """For each output pixel the x and y, px, in the distorted image of what it shows.

    float32. Pixels without a counterpart in the distorted image get a position far off it.

    Args:
        distortion: of the image.
        framing: of the output.
        inverse: from `fit_inverse`, for a radius that holds the whole output; None computes
            `Distortion.distort` instead: exact, and some hundred times slower.
        plane: the sampling of both images; by default every pixel.
        into: what an earlier call for as many pixels returned: its memory is used again if it can be, and
            these arrays are then gone. The system takes longer to give new memory than the map to compute.
    """
    plane = Plane(framing.size) if plane is None else plane
    step, offset = np.array(plane.step), np.array(plane.offset)
    if inverse is None:
        pixels = np.stack(np.meshgrid(*map(np.arange, plane.size)), axis=-1) * step + offset
        positions = (np.asarray(distortion.distort(framing.corrected(pixels))) - offset) / step
        positions = jnp.asarray(np.where(np.isnan(positions), OUTSIDE, positions), jnp.float32)
        return positions[..., 0], positions[..., 1]
    centre, scale = np.asarray(distortion.centre, float), float(distortion.scale)
    first = np.asarray(framing.origin, float) + offset / float(framing.scale)
    geometry = np.stack(
        [
            (first - centre) / scale,
            step / float(framing.scale) / scale,
            (centre - offset) / step,
            scale / step,
        ]
    )
    return _positions(
        into,
        inverse.powers,
        inverse.coefficients,
        np.float32(inverse.reach),
        geometry.astype(np.float32),
        inverse.steps,
        inverse.distortion_model,
        plane.size,
    )


@functools.partial(
    jax.jit,
    static_argnames=("steps", "distortion_model", "size"),
    donate_argnames="into",
    keep_unused=True,
)
def _positions(into, powers, k, reach, geometry, steps, distortion_model, size):
    start, step, centre, scale = geometry
    x = start[0] + step[0] * jax.lax.broadcasted_iota(jnp.float32, size[::-1], 1)
    y = start[1] + step[1] * jax.lax.broadcasted_iota(jnp.float32, size[::-1], 0)
    squared = x * x + y * y
    ratio = radius_ratio(squared, reach, powers, steps, distortion_model, k)
    seen = squared <= reach * reach * (1 + 1e-6)
    return (
        jnp.where(seen, centre[0] + scale[0] * x * ratio, OUTSIDE),
        jnp.where(seen, centre[1] + scale[1] * y * ratio, OUTSIDE),
    )
