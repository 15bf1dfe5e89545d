"""ZoomLens: the fitted model, from a focal length to the distortion there, and its file format."""

import json
import math
import os
import warnings

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, ScalarLike

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

    @property
    def scale(self) -> float:
        """The length in px that is radius 1: half the image diagonal."""
        return math.hypot(*self.image_size) / 2

    def __call__(self, focal: ScalarLike) -> Distortion:
        """The distortion at one focal length, in `focal_unit`; ``jax.vmap`` it for many.

        Warns:
            UserWarning: `focal` is outside of the fitted range (not under ``jit`` or ``vmap``).

        Raises:
            ValueError: `focal` is not positive and finite (not under ``jit`` or ``vmap``).
        """
        self._check(focal)
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

    def _check(self, focal):
        if traced((self, focal)):
            return
        low, high = (float(end) for end in self.focal_range)
        value = float(focal)
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"Argument focal must be a positive number, but it is {value}.")
        slack = 1e-6 * value  # the end of the range itself, through a float32 or a file
        if value < low - slack or value > high + slack:
            warnings.warn(
                f"The focal length {value:g} {self.focal_unit} is outside of the range the lens was "
                f"fitted on, {low:g} to {high:g} {self.focal_unit}: its distortion is extrapolated.",
                stacklevel=3,
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
                f"its format version is {content['version']} and this zoomjax reads {_VERSION}"
            )
        zoom = content["zoom"]
        if zoom["model"] != "PolynomialZoom":
            raise ValueError(f"its zoom model, {zoom['model']!r}, is unknown; update zoomjax")
        parameters = _array(zoom["parameters"], (None, None))
        width, height = (int(side) for side in content["image_size"])
        return ZoomLens(
            zoom=PolynomialZoom(
                degree=parameters.shape[0] - 1,
                parameters=parameters,
                focal_ref=_array(zoom["focal_ref"], ()),
            ),
            centre=_array(content["centre"], (2,)),
            focal_range=_array(content["focal_range"], (2,)),
            image_size=(width, height),
            focal_unit=str(content["focal_unit"]),
        )
    except FileNotFoundError:
        raise
    except (ValueError, TypeError, KeyError, OSError) as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else error
        raise ValueError(f"Cannot read a lens from {os.fspath(path)}: {reason}.") from error


def _numbers(array):
    """Nested lists of floats; JSON keeps every digit of them."""
    return np.asarray(array, np.float64).tolist()


def _array(numbers, shape):
    array = np.asarray(numbers, np.float64)
    matches = array.ndim == len(shape) and all(
        want in (None, have) for want, have in zip(shape, array.shape, strict=True)
    )
    if not matches or not np.isfinite(array).all():
        raise ValueError("its numbers are incomplete or not finite")
    return jnp.asarray(array, jnp.result_type(float))
