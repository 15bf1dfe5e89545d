"""ZoomLens: a fitted zoom model, which gives the distortion at any focal length, and its file format."""

import dataclasses
import json
import math
import os
from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import eval_context
from jaxtyping import Float, Num, ScalarLike

from .._core.arguments import check_kind, kinds_checked
from .._core.arrays import aligned
from .._core.checks import centre_problem, check_above, checked_size, checked_unit, warn_caller
from .._core.fields import check_finite, check_focal, check_range, check_shapes, numbers
from .._core.files import whole_file
from .._core.pixels import check_pitch
from .._core.programs import light_program
from .._core.types import AnyArray, FocalLike, Point, Points, traced
from ._arguments import (
    SLACK,
    as_focal,
    as_points,
    check_focus,
    check_one_lens,
    check_range_of,
    check_settings,
    check_terms,
)
from ._known_number import known_number
from ._known_sizes import with_known_size
from .about import About, checked_about, checked_pitch
from .distortion import Distortion, compiled, mapped
from .distortion_model import AbstractDistortionModel
from .model import Model
from .polynomial import RadialPolynomial
from .registry import (
    array_of,
    described,
    distortion_model_from,
    distortion_model_name,
    once,
    refuse_misspelled,
    warn_of_unknown,
    zoom_from,
)
from .zoom import AbstractFocusZoom, AbstractZoom, one_focus

_FORMAT, _VERSION = "zoomjax.lens", 3
_UNREADABLE = ValueError, TypeError, KeyError, AttributeError, ArithmeticError, RecursionError, OSError

_ENTRIES = ("image_size", "centre", "scale", "focal_unit", "focal_range", "radial", "zoom", "shift_meaning")
_OPTIONAL = ("distortion_model", "family", "focus_range", "shift", "pixel_pitch", "about")


class ZoomLens(eqx.Module):
    """The distortion of a zoom lens at any focal length: ``lens(f)`` is a `Distortion` (eq. 11-12).

    Attributes:
        zoom: zoom model of the normalised coefficients.
        centre: centre of distortion, px.
        shift: zoom model of the offset of the centre of distortion from `centre`, in units of `scale`; None
            if the centre is fixed.
        focal_range: the shortest and longest focal length fitted.
        image_size: (width, height) px of the images it is for.
        focal_unit: "mm" or "px".
        focus_range: the least and greatest focus fitted, if the zoom model depends on it.
        distortion_model: the distortion model of the coefficients, by default the radial polynomial.
        pixel_pitch: width of a pixel of these images on the sensor, mm; None if it is not known.
        about: words and numbers by name, such as camera, lens and crop_factor; see `About`.

    Example:
        >>> import jax.numpy as jnp
        >>> from zoomjax import PolynomialZoom
        >>> zoom = PolynomialZoom(1, jnp.array([[0.0], [0.1]]), jnp.array(20.0))
        >>> lens = ZoomLens(zoom, jnp.array([319.5, 239.5]), jnp.array([20.0, 80.0]), (640, 480))
        >>> lens(40.0).coefficients.round(3).tolist()
        [0.05000000074505806]
    """

    zoom: AbstractZoom
    centre: Point = eqx.field(converter=numbers("centre"))
    focal_range: Float[AnyArray, "2"] = eqx.field(converter=numbers("focal_range"))
    image_size: tuple[int, int] = eqx.field(static=True, converter=checked_size)
    focal_unit: str = eqx.field(static=True, default="mm", converter=checked_unit)
    shift: AbstractZoom | None = None
    focus_range: Float[AnyArray, "2"] | None = eqx.field(default=None, converter=numbers("focus_range"))
    distortion_model: AbstractDistortionModel = RadialPolynomial()
    pixel_pitch: float | None = eqx.field(static=True, default=None, converter=checked_pitch)
    about: Mapping[str, str | float] = eqx.field(static=True, default=About(), converter=checked_about)

    def __check_init__(self):
        """Check the geometry, and that the zoom model gives the coefficients of the distortion model."""
        for name, kinds in (
            ("zoom", (AbstractZoom,)),
            ("distortion_model", (AbstractDistortionModel,)),
            ("shift", (AbstractZoom, type(None))),
        ):
            value = getattr(self, name)
            # Booleans stand for modules in filters, bare objects in JAX's own handling of trees.
            if not (isinstance(value, bool) or type(value) is object):
                check_kind(name, value, kinds)
        check_shapes(
            {
                "centre": (self.centre, (2,)),
                "focal_range": (self.focal_range, (2,)),
                "focus_range": (self.focus_range, (2,)),
            }
        )
        check_finite("centre", self.centre)
        if self.pixel_pitch is not None:
            check_pitch(self.pixel_pitch, self.image_size)
        check_focal("focal_range", self.focal_range)
        check_range("focal_range", self.focal_range)
        check_range("focus_range", self.focus_range)
        one = getattr(self.centre, "ndim", 0) == 1  # or it is a batch of lenses, or stands in for one
        size, shift = (known_number(model) if one else None for model in (self.zoom, self.shift))
        if shift not in (None, 2):
            raise ValueError(
                f"Argument shift must give two numbers, the offset of the centre, but it gives {shift}."
            )
        if size is not None and isinstance(self.distortion_model, AbstractDistortionModel):
            check_terms("zoom", size, self.distortion_model)

    @property
    def scale(self) -> float:
        """The length in px that is radius 1: half the image diagonal."""
        return math.hypot(*self.image_size) / 2

    @property
    def model(self) -> Model:
        """Zoom model, number of coefficients and distortion model, as fits of other lines take them."""
        return Model(self.zoom, None, self.distortion_model)

    def __call__(self, focal: FocalLike, focus: FocalLike | None = None) -> Distortion:
        """The distortion at a focal length in `focal_unit`, or at several.

        Args:
            focal: the focal length, or an array or list of them, whose axes come first in the distortion.
            focus: focus of the lens, for models that depend on it (`AbstractFocusZoom`); it is clipped to
                the fitted range.

        Under ``jit``, ``vmap`` and ``grad``, where values are not known and a warning is impossible, focal
        lengths outside of the fitted range give NaN; see `extended`.

        Warns:
            UserWarning: `focal` or `focus` is outside of the fitted range.

        Raises:
            ValueError: `focal` is not positive and finite, `focus` is not finite, or it is missing and the
                zoom model depends on it.
        """
        focal = self._checked(focal, focus, stacklevel=4)
        if traced((self, focal, focus)):
            d = self._distortion(focal, focus, within=traced((self, focal)))
            return with_known_size(d, self.image_size)
        with eval_context():  # what is known stays known inside of ``jit``
            return with_known_size(_known_distortion(self, focal, focus), self.image_size)

    def undistort(
        self,
        points: Points,
        focal: FocalLike,
        focus: FocalLike | None = None,
    ) -> Float[AnyArray, "*points 2"]:
        """Correct distorted `points`, each at its own focal length.

        Args:
            points: (..., 2) px.
            focal: focal lengths, which broadcast with the points: one for all, or one for each, as for the
                rays of a radiance field.
            focus: as for a call of the lens.

        Returns:
            Points of the broadcast shape; see `Distortion.undistort`.
        """
        return self._mapped("undistort", points, focal, focus)

    def distort(
        self,
        points: Points,
        focal: FocalLike,
        focus: FocalLike | None = None,
    ) -> Float[AnyArray, "*points 2"]:
        """Distort corrected `points`, each at its own focal length; see `undistort`."""
        return self._mapped("distort", points, focal, focus)

    def extended(self, low: float, high: float) -> "ZoomLens":
        """The same lens with another focal range, for deliberate extrapolation.

        The distortion is not validated beyond the fitted range; check it with `certify`.
        """
        check_above(0, low=low, high=high)
        return dataclasses.replace(self, focal_range=np.array([low, high], float))

    def _mapped(self, method, points, focal, focus):
        points = as_points(points)
        focal = self._checked(focal, focus, stacklevel=5, points=points.shape[:-1])
        if isinstance(points, np.ndarray) and not traced((self, focal, focus)):
            d = self._distortion(focal, focus)
            return mapped(method, d.distortion_model, points, d.coefficients, d.centre, d.scale)
        points = jnp.asarray(points)
        operands = (self, jnp.asarray(focal, points.dtype), focus, traced((self, focal)))
        return compiled(method, _bent, points, operands)

    def _checked(self, focal, focus, stacklevel, points=()):
        """Focal lengths as an array; these and the focus are looked at where they are known."""
        check_one_lens(self.centre)
        self.check_range(focal := as_focal(focal), stacklevel=stacklevel)
        check_focus(focus, self.focus_range)
        check_settings(points, focal, focus if isinstance(self.zoom, AbstractFocusZoom) else None)
        return focal

    def _distortion(self, focal, focus, within=False):
        """The distortion; NaN outside of the range, if it is to be `within`, else extrapolated."""
        dtype = jnp.asarray(self.centre).dtype
        focal = jnp.asarray(focal, dtype)
        low, high = jnp.moveaxis(jnp.asarray(self.focal_range, dtype), -1, 0)
        inside = (focal >= low * (1 - SLACK)) & (focal <= high * (1 + SLACK))
        if within:  # at a focal length that is: a NaN in `focal` would be one in all derivatives
            focal = jnp.where(inside, focal, high)
        k = _at(self.zoom, focal, focus, dtype)
        if within:
            k = jnp.where(inside[..., None], k, jnp.nan)
        return Distortion(k, self._centre_at(focal), jnp.asarray(self.scale, dtype), self.distortion_model)

    def centre_at(self, focal: FocalLike) -> Float[AnyArray, "*focal 2"]:
        """The centre of distortion at focal lengths, px.

        Where it does not move along the zoom it is `centre`, one for all. Warns and raises as a call does.
        """
        given = as_focal(focal)
        if self.shift is not None:
            check_one_lens(self.centre)
            self.check_range(given)
        return self._centre_at(given)

    def _centre_at(self, focal):
        """The same, whatever the focal lengths."""
        centre = jnp.asarray(self.centre)
        if self.shift is None:
            return centre
        centre, moved = aligned((centre, 1), (_at(self.shift, focal, None, centre.dtype), 1))
        return centre + self.scale * moved

    def at_focus(self, focus: ScalarLike) -> "ZoomLens":
        """The lens at one focus: a lens that depends on the focal length alone, for images and video.

        Raises:
            TypeError: the zoom model does not depend on the focus.
        """
        if not isinstance(self.zoom, AbstractFocusZoom):
            raise TypeError(
                f"A {type(self.zoom).__name__} does not depend on the focus: use the lens as it is."
            )
        check_focus(one_focus(focus), self.focus_range)
        return dataclasses.replace(self, zoom=self.zoom.at_focus(focus), focus_range=None)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the lens to a JSON file for `load_lens`, with all digits.

        Raises:
            TypeError: the class of the zoom model or the distortion model is not registered
                (`register_model`), or has fields that a file cannot hold.
            ValueError: these are several lenses in one, as `jax.vmap` makes.
        """
        check_kind("path", path, (str, os.PathLike))
        check_one_lens(self.centre)
        polynomial = isinstance(self.distortion_model, RadialPolynomial)
        content = {
            "format": _FORMAT,
            # Older readers know the polynomial alone, or another key: they must not take k for its own.
            "version": 1 if polynomial else _VERSION,
            "image_size": list(self.image_size),
            "centre": _numbers(self.centre),
            "scale": self.scale,
            "focal_unit": self.focal_unit,
            "focal_range": _numbers(self.focal_range),
            **({} if polynomial else {"distortion_model": distortion_model_name(self.distortion_model)}),
            "radial": self.distortion_model.formula,
            "zoom": described(self.zoom),
        }
        if self.focus_range is not None:
            content["focus_range"] = _numbers(self.focus_range)
        if self.shift is not None:
            content["shift"] = described(self.shift)
            content["shift_meaning"] = "centre at f = centre + scale (k_1(f), k_2(f)) of the model in shift"
        if self.pixel_pitch is not None:
            content["pixel_pitch"] = self.pixel_pitch
        if self.about:
            content["about"] = dict(self.about)
        with whole_file(path) as part:
            part.write_text(json.dumps(content, indent=2) + "\n")

    def check_range(self, focal: Num[AnyArray | ScalarLike, "..."], *, stacklevel: int = 2) -> None:
        """Check focal lengths, if their values are known (not under ``jit`` or ``vmap``).

        Warns:
            UserWarning: some are outside of the fitted range.

        Raises:
            ValueError: some are not positive and finite.
        """
        if traced((self, focal)):
            return
        check_range_of(focal, self.focal_range, self.focal_unit, stacklevel=stacklevel + 1)


def _at(zoom, focal, focus, dtype):
    """The coefficients of a zoom model at focal lengths of any shape, which come first."""
    function, arguments = zoom, [jnp.asarray(focal, dtype)]
    if isinstance(zoom, AbstractFocusZoom):
        if focus is None:
            return zoom(arguments[0].reshape(-1)[0], None)  # says what is missing
        arguments = jnp.broadcast_arrays(*arguments, jnp.asarray(focus, dtype))
    for _ in range(arguments[0].ndim):
        function = jax.vmap(function)
    return function(*arguments)


_distortion_at = light_program(ZoomLens._distortion)


def _known_distortion(lens, focal, focus):
    try:
        return _distortion_at(lens, focal, focus)
    except jax.errors.JAXTypeError:
        return lens._distortion(focal, focus)  # of a zoom model of your own, which branches on values


def _bent(operands):
    lens, focal, focus, within = operands
    d = lens._distortion(focal, focus, within)
    return d.distortion_model, d.coefficients, d.centre, d.scale


def _pair(content, name):
    return array_of(name, content[name], (2,)).astype(float)


@kinds_checked
def load_lens(path: str | os.PathLike[str]) -> ZoomLens:
    """Read a lens that `ZoomLens.save` wrote.

    User-defined models must be registered first, by the module that defines them (`register_model`).

    Warns:
        UserWarning: the file has entries that are not known, as of another program; they do not count. The
            centre is outside of the image.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file does not describe a lens, or is of a later version; the message names it.
    """
    try:
        with open(path, encoding="utf-8-sig") as file:
            content = json.load(file, object_pairs_hook=once)
        if not isinstance(content, dict) or content.get("format") != _FORMAT:
            raise ValueError("it describes no zoom lens; ZoomLens.save writes such a file")
        if content["version"] not in range(1, _VERSION + 1):
            raise ValueError(
                f"its format version is {content['version']!r} and this zoomjax reads up to {_VERSION}; "
                "update zoomjax"
            )
        refuse_misspelled(content, _ENTRIES, _OPTIONAL)
        lens = ZoomLens(
            zoom=zoom_from(content["zoom"]),
            centre=_pair(content, "centre"),
            focal_range=_pair(content, "focal_range"),
            image_size=content["image_size"],
            focal_unit=content["focal_unit"],
            shift=zoom_from(content["shift"], 2) if "shift" in content else None,
            focus_range=_pair(content, "focus_range") if "focus_range" in content else None,
            distortion_model=distortion_model_from(content),
            pixel_pitch=content.get("pixel_pitch"),
            about=content.get("about", {}),
        )
        if not math.isclose(content["scale"], lens.scale, rel_tol=1e-6):
            raise ValueError("its scale is not half the diagonal of its image_size")
        problem = centre_problem(np.asarray(lens.centre), lens.image_size)
        if problem and lens.shift is None:
            warn_caller(f"{os.fspath(path)}: {problem[0].lower()}{problem[1:]}")
        warn_of_unknown(content, (*_ENTRIES, *_OPTIONAL, "format", "version"), os.fspath(path))
        return lens
    except FileNotFoundError:
        raise
    except _UNREADABLE as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else str(error).rstrip(".")
        raise ValueError(f"Cannot read a lens from {os.fspath(path)}: {reason}.") from error


def _numbers(array):
    """Nested lists of floats; JSON keeps every digit of them."""
    return np.asarray(array, np.float64).tolist()
