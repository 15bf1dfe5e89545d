"""ZoomLens: the fitted model, from a focal length to the distortion there, and its file format."""

import json
import math
import os
import warnings

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Num, ScalarLike

from ._checks import checked_size, checked_unit
from ._files import whole_file
from ._types import AnyArray, Point, traced
from .lines import AbstractLines
from .radial import Distortion
from .zoom import AbstractZoom, PolynomialZoom

_FORMAT, _VERSION = "zoomjax.lens", 1


class ZoomLens(eqx.Module):
    """The distortion of a zoom lens at any focal length: ``lens(f)`` is a `Distortion` (eq. 11-12).

    Attributes:
        zoom: from a focal length to the normalised coefficients.
        centre: centre of distortion, px.
        focal_range: the shortest and longest focal length fitted.
        image_size: (width, height) px of the images it is for.
        focal_unit: "mm" or "px".

    Example:
        >>> import jax.numpy as jnp
        >>> zoom = PolynomialZoom(1, jnp.array([[0.0], [0.1]]), jnp.array(20.0))
        >>> lens = ZoomLens(zoom, jnp.array([319.5, 239.5]), jnp.array([20.0, 80.0]), (640, 480))
        >>> lens(40.0).coefficients.round(3).tolist()
        [0.05000000074505806]
    """

    zoom: AbstractZoom
    centre: Point
    focal_range: Float[AnyArray, "2"]
    image_size: tuple[int, int] = eqx.field(static=True)
    focal_unit: str = eqx.field(static=True, default="mm")

    def __check_init__(self):
        """Check the geometry."""
        checked_size(self.image_size)
        checked_unit(self.focal_unit)

    @property
    def scale(self) -> float:
        """The length in px that is radius 1: half the image diagonal."""
        return math.hypot(*self.image_size) / 2

    def __call__(self, focal: ScalarLike) -> Distortion:
        """The distortion at one focal length, in `focal_unit`; ``jax.vmap`` it for many.

        Warns:
            UserWarning: `focal` is outside of the fitted range (not under ``jit`` or ``vmap``).

        Raises:
            ValueError: `focal` is not one number, positive and finite (values are not checked under
                ``jit`` or ``vmap``).
        """
        if np.ndim(focal):
            raise ValueError(
                f"Argument focal must be one number, but its shape is {np.shape(focal)}: "
                "jax.vmap(lens)(focal) takes many."
            )
        self.check_range(focal, stacklevel=3)
        dtype = jnp.asarray(self.centre).dtype
        return Distortion(
            coefficients=self.zoom(jnp.asarray(focal, dtype)),
            centre=jnp.asarray(self.centre),
            scale=jnp.asarray(self.scale, dtype),
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the lens to a JSON file that `load_lens` reads, all digits kept.

        Raises:
            TypeError: the zoom model is of a kind that has no file format.
        """
        if not isinstance(self.zoom, PolynomialZoom):
            raise TypeError(f"A lens with a {type(self.zoom).__name__} cannot be saved.")
        content = {
            "format": _FORMAT,
            "version": _VERSION,
            "image_size": list(self.image_size),
            "centre": _numbers(self.centre),
            "scale": self.scale,
            "focal_unit": self.focal_unit,
            "focal_range": _numbers(self.focal_range),
            "radial": "corrected = centre + z * scale * (1 + k1 r^2 + ... + kN r^2N), "
            "z = (distorted - centre) / scale, r^2 = z.z",
            "zoom": {
                "model": "PolynomialZoom",
                "formula": "k_i(f) = sum_j parameters[j][i-1] * (focal_ref / f)^j",
                "focal_ref": _numbers(self.zoom.focal_ref),
                "parameters": _numbers(self.zoom.parameters),
            },
        }
        with whole_file(path) as part:
            part.write_text(json.dumps(content, indent=2) + "\n")

    def check_range(self, focal: Num[AnyArray | ScalarLike, "..."], *, stacklevel: int = 2) -> None:
        """Look at focal lengths, if their values are known (not under ``jit`` or ``vmap``).

        Warns:
            UserWarning: some are outside of the fitted range.

        Raises:
            ValueError: some are not positive and finite.
        """
        if traced((self, focal)):
            return
        low, high = (float(end) for end in self.focal_range)
        values = np.ravel(np.asarray(focal, np.float64))
        bad = ~(np.isfinite(values) & (values > 0))
        if bad.any():
            raise ValueError(f"Argument focal must be a positive number, but it is {values[bad][0]}.")
        slack = 1e-6 * values  # the end of the range itself, through a float32 or a file
        outside = values[(values < low - slack) | (values > high + slack)]
        if outside.size:
            which = f"focal length {outside[0]:g} {self.focal_unit} is"
            if values.size > 1:
                which = f"focal lengths of {outside.size} of {values.size} frames are"
            warnings.warn(
                f"The {which} outside of the range the lens was fitted on, {low:g} to {high:g} "
                f"{self.focal_unit}: the distortion there is extrapolated.",
                stacklevel=stacklevel + 1,
            )


def lens_of(lines: AbstractLines, zoom: AbstractZoom) -> ZoomLens:
    """The lens that a zoom model fitted to these lines makes."""
    focal = jnp.asarray(lines.focal)
    return ZoomLens(
        zoom=zoom,
        centre=jnp.asarray(lines.centre),
        focal_range=jnp.stack([jnp.min(focal), jnp.max(focal)]),
        image_size=lines.image_size,
        focal_unit=lines.focal_unit,
    )


def load_lens(path: str | os.PathLike[str]) -> ZoomLens:
    """Read a lens that `ZoomLens.save` wrote.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not such a file, or of a later version; the message names it.
    """
    try:
        with open(path, encoding="utf-8") as file:
            content = json.load(file)
        if not isinstance(content, dict) or content.get("format") != _FORMAT:
            raise ValueError("it describes no zoom lens; ZoomLens.save writes such a file")
        if content["version"] != _VERSION:
            raise ValueError(
                f"its format version is {content['version']!r} and this zoomjax reads {_VERSION}; "
                "update zoomjax"
            )
        zoom = content["zoom"]
        if zoom["model"] != "PolynomialZoom":
            raise ValueError(f"its zoom model, {zoom['model']!r}, is unknown; update zoomjax")
        parameters, focal_ref = _array(zoom, "parameters", (None, None)), _array(zoom, "focal_ref", ())
        lens = ZoomLens(
            zoom=PolynomialZoom(degree=len(parameters) - 1, parameters=parameters, focal_ref=focal_ref),
            centre=_array(content, "centre", (2,)),
            focal_range=_array(content, "focal_range", (2,)),
            image_size=checked_size(content["image_size"]),
            focal_unit=checked_unit(content["focal_unit"]),
        )
        low, high = lens.focal_range
        if not (0 < low <= high and focal_ref > 0 and parameters.size):
            raise ValueError("its focal lengths are not positive and in order, or it has no parameters")
        if not math.isclose(content["scale"], lens.scale, rel_tol=1e-6):
            raise ValueError("its scale is not half the diagonal of its image_size")
        return lens
    except FileNotFoundError:
        raise
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError, OSError) as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else str(error).rstrip(".")
        raise ValueError(f"Cannot read a lens from {os.fspath(path)}: {reason}.") from error


def _numbers(array):
    """Nested lists of floats; JSON keeps every digit of them."""
    return np.asarray(array, np.float64).tolist()


def _array(content, name, shape):
    array = np.asarray(content[name], np.float64)
    matches = array.ndim == len(shape) and all(
        want in (None, have) for want, have in zip(shape, array.shape, strict=True)
    )
    if not matches or not np.isfinite(array).all():
        raise ValueError(f"the numbers of its {name!r} are incomplete or not finite")
    return jnp.asarray(array, jnp.result_type(float))
