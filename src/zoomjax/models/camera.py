"""A pinhole camera behind a zoom lens: from pixels to rays, and from points in space to pixels.

    ray of a pixel      ((x̂ - c) / f, 1),  x̂ the corrected pixel (eq. 1), c the principal point, f in px
    pixel of (X, Y, Z)  the distorted position of  c + f (X, Y) / Z

Axes are OpenCV's: x to the right, y down, z forward. There is no pose: transform points before, rays after.
All functions are elementwise, with a focal length for each pixel if wanted, and differentiable in pixels,
points, focal lengths and the lens.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Bool, Float, Num

from .._core.arrays import aligned, finite, namespace
from .._core.fields import check_finite, check_positive, check_shapes, numbers
from .._core.pixels import check_pitch
from .._core.types import AnyArray, FocalLike, Points
from ._arguments import as_points
from .about import WIDTH_OF_FOCALS
from .lens import ZoomLens


class Camera(eqx.Module):
    """A zoom lens, a principal point, and the size of a pixel.

    Attributes:
        lens: from `fit_zoom` or `load_lens`.
        principal: the principal point, px: where the optical axis meets the image. By default the centre of
            distortion, which moves along the zoom if the lens has a `shift`.
        pixel_pitch: mm from one pixel to the next, for lenses whose focal lengths are in mm; by default the
            lens's own. None for lenses in px.

    Example:
        >>> import jax.numpy as jnp
        >>> from zoomjax import PolynomialZoom, ZoomLens
        >>> zoom = PolynomialZoom(1, jnp.array([[0.0], [0.1]]), jnp.array(20.0))
        >>> lens = ZoomLens(zoom, jnp.array([319.5, 239.5]), jnp.array([20.0, 80.0]), (640, 480))
        >>> camera = Camera(lens, pixel_pitch=0.02)
        >>> rays, known = camera.rays(jnp.array([[319.5, 239.5], [0.0, 0.0]]), 40.0)
        >>> pixels, seen = camera.project(5 * rays, 40.0)
        >>> pixels.round(1).tolist(), seen.tolist()
        ([[319.5, 239.5], [-0.0, 0.0]], [True, True])
    """

    lens: ZoomLens
    principal: Float[AnyArray, "2"] | None = eqx.field(default=None, converter=numbers("principal"))
    pixel_pitch: Float[AnyArray, ""] | None = eqx.field(default=None, converter=numbers("pixel_pitch"))

    def __check_init__(self):
        """Check that the focal length in px is known, and shapes."""
        if not isinstance(self.lens, ZoomLens):
            raise TypeError(
                f"Argument lens must be a ZoomLens, but its type is {type(self.lens).__name__}."
            )
        known = self.pixel_pitch is not None or self.lens.pixel_pitch is not None
        if not known if self.lens.focal_unit == "mm" else self.pixel_pitch is not None:
            raise ValueError(
                "Argument pixel_pitch, mm from one pixel to the next (the sensor's width over that of the "
                "image in px), must be given for a lens whose focal lengths are in mm and that does not "
                "know it itself."
                if self.pixel_pitch is None
                else "Argument pixel_pitch must be left out: the lens's focal lengths are in px already."
            )
        check_shapes({"principal": (self.principal, (2,)), "pixel_pitch": (self.pixel_pitch, ())})
        check_finite("principal", self.principal)
        check_positive("pixel_pitch", self.pixel_pitch)
        check_pitch(self.pixel_pitch, self.lens.image_size)

    def rays(
        self,
        pixels: Points,
        focal: FocalLike,
        focus: FocalLike | None = None,
    ) -> tuple[Float[AnyArray, "*pixels 3"], Bool[AnyArray, "*pixels"]]:
        """Compute the viewing ray of each pixel.

        Args:
            pixels: (..., 2) px of the distorted image.
            focal: focal lengths in the lens's unit, which broadcast with the pixels, as for
                `ZoomLens.undistort`.
            focus: as for a call of the lens.

        Returns:
            Directions ``(x, y, 1)``, not of length 1, and a mask of the pixels that have one. Beyond the
            fold of a lens, directions are NaN with derivatives of zero.
        """
        corrected = self.lens.undistort(pixels, focal, focus)
        xp = namespace(corrected)
        corrected, principal, length = self._aligned(corrected, focal)
        # A NaN in a difference or a quotient would be one in all derivatives.
        known = xp.isfinite(corrected[..., :1])
        flat = (xp.where(known, corrected, 0) - principal) / length[..., None]
        flat = xp.where(known, flat, np.nan)
        return xp.concatenate([flat, xp.ones_like(flat[..., :1])], axis=-1), finite(flat[..., 0])

    def project(
        self,
        points: Num[AnyArray, "*points 3"] | list | tuple,
        focal: FocalLike,
        focus: FocalLike | None = None,
    ) -> tuple[Float[AnyArray, "*pixels 2"], Bool[AnyArray, "*pixels"]]:
        """Project points in space to pixels.

        Args:
            points: (..., 3) in the camera's axes, in any unit.
            focal, focus: as for `rays`.

        Returns:
            Positions in the distorted image, px, inside of it or not, and a mask of the points that have
            one. Points not in front of the camera, or without an inverse, are NaN with derivatives of zero.
        """
        space = as_points(points, 3)
        xp = namespace(space)
        before = space[..., 2] > 0
        depth = xp.where(before, space[..., 2], 1)
        flat, principal, length = self._aligned(space[..., :2] / depth[..., None], focal)
        flat = principal + length[..., None] * flat
        before = xp.broadcast_to(before, flat.shape[:-1])
        # NaN goes in where nothing is to be seen: the inverse has no derivative there.
        pixels = self.lens.distort(xp.where(before[..., None], flat, np.nan), focal, focus)
        return pixels, finite(pixels[..., 0])

    def _aligned(self, points: Any, focal: Any) -> list[Any]:
        """Points, the principal point and focal lengths in px, ready to broadcast."""
        if isinstance(focal, Tracer):  # a NaN gives NaN by the lens, and would be one in all derivatives
            focal = jnp.where(jnp.isfinite(focal), focal, jnp.asarray(self.lens.focal_range)[..., 1])
        principal = self.principal
        if principal is None:
            moves = self.lens.shift is not None
            principal = self.lens._centre_at(focal) if moves else self.lens.centre
        principal = _as(principal, points)
        length = _as(focal, points)
        if self.lens.focal_unit == "mm":
            pitch = self.lens.pixel_pitch if self.pixel_pitch is None else self.pixel_pitch
            length = length / _as(pitch, points)
        else:
            length = length * px_of_focal_px(self.lens)
        return aligned((points, 1), (principal, 1), (length, 0))


def px_of_focal_px(lens: ZoomLens) -> float:
    """By what focal lengths in px are multiplied to be those of the lens's images: see `lens_for_size`."""
    width = lens.about.get(WIDTH_OF_FOCALS, lens.image_size[0])
    return lens.image_size[0] / float(width)


def _as(values: Any, like: Any) -> Any:
    """An array of the dtype of another, and NumPy's if both are."""
    known = isinstance(like, np.ndarray) and not isinstance(values, Tracer)
    return (np if known else jnp).asarray(values, like.dtype)
