"""ZoomLens: the fitted model, from a focal length to the distortion there, and its file format."""

import dataclasses
import json
import math
import os
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Num, ScalarLike

from ._checks import checked_size, checked_unit
from ._files import whole_file
from ._types import AnyArray, Point, traced
from .families import AbstractFamily, BrownConrady, Division, RadialPolynomial
from .focus import FocusSplineZoom
from .lines import AbstractLines
from .radial import Distortion
from .rivals import PowerZoom, SplineZoom, TableZoom, TwoRegionZoom
from .smooth import SmoothZoom
from .zoom import AbstractFocusZoom, AbstractZoom, PolynomialZoom

_FORMAT, _VERSION = "zoomjax.lens", 2


class ZoomLens(eqx.Module):
    """The distortion of a zoom lens at any focal length: ``lens(f)`` is a `Distortion` (eq. 11-12).

    Attributes:
        zoom: from a focal length to the normalised coefficients.
        centre: centre of distortion, px.
        shift: from a focal length to the offset of its own centre of distortion from `centre`, in units of
            `scale`; None where the centre stays.
        focal_range: the shortest and longest focal length fitted.
        image_size: (width, height) px of the images it is for.
        focal_unit: "mm" or "px".
        focus_range: the least and greatest focus fitted, where the zoom model depends on it.
        family: what the coefficients mean: by default the radial polynomial.

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
    shift: AbstractZoom | None = None
    focus_range: Float[AnyArray, "2"] | None = None
    family: AbstractFamily = RadialPolynomial()

    def __check_init__(self):
        """Check the geometry."""
        checked_size(self.image_size)
        checked_unit(self.focal_unit)

    @property
    def scale(self) -> float:
        """The length in px that is radius 1: half the image diagonal."""
        return math.hypot(*self.image_size) / 2

    def __call__(self, focal: ScalarLike, focus: ScalarLike | None = None) -> Distortion:
        """The distortion at one focal length, in `focal_unit`; ``jax.vmap`` it for many.

        Args:
            focal: the focal length.
            focus: where the lens is focused, for models that depend on it (`AbstractFocusZoom`), which hold
                it within the fitted range.

        Warns:
            UserWarning: `focal` is outside of the fitted range (not under ``jit`` or ``vmap``).

        Raises:
            ValueError: `focal` is not one number, positive and finite (values are not checked under
                ``jit`` or ``vmap``), or the zoom model depends on the focus and none is given.
        """
        if np.ndim(focal):
            raise ValueError(
                f"Argument focal must be one number, but its shape is {np.shape(focal)}: "
                "jax.vmap(lens)(focal) takes many."
            )
        self.check_range(focal, stacklevel=3)
        dtype = jnp.asarray(self.centre).dtype
        focal = jnp.asarray(focal, dtype)
        centre = jnp.asarray(self.centre)
        return Distortion(
            coefficients=self.zoom(focal, focus)
            if isinstance(self.zoom, AbstractFocusZoom)
            else self.zoom(focal),
            centre=centre if self.shift is None else centre + self.scale * self.shift(focal),
            scale=jnp.asarray(self.scale, dtype),
            family=self.family,
        )

    def at_focus(self, focus: ScalarLike) -> "ZoomLens":
        """The lens focused at one place, a lens of the focal length alone: to correct images and video by.

        Raises:
            TypeError: the zoom model does not depend on the focus.
        """
        if not isinstance(self.zoom, AbstractFocusZoom):
            raise TypeError(
                f"A {type(self.zoom).__name__} does not depend on the focus: use the lens as it is."
            )
        return dataclasses.replace(self, zoom=self.zoom.at_focus(focus), focus_range=None)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the lens to a JSON file that `load_lens` reads, all digits kept.

        Raises:
            TypeError: the zoom model, or the family, is of a kind that has no file format.
        """
        if type(self.family) not in _FAMILIES.values():
            raise TypeError(f"A lens with a {type(self.family).__name__} cannot be saved.")
        for model in (self.zoom, self.shift):
            if model is not None and type(model) not in _FORMULAS:
                raise TypeError(f"A lens with a {type(model).__name__} cannot be saved.")
        polynomial = isinstance(self.family, RadialPolynomial)
        content = {
            "format": _FORMAT,
            # Older readers know no families, and must not take this one's coefficients for a polynomial's.
            "version": 1 if polynomial else _VERSION,
            "image_size": list(self.image_size),
            "centre": _numbers(self.centre),
            "scale": self.scale,
            "focal_unit": self.focal_unit,
            "focal_range": _numbers(self.focal_range),
            **({} if polynomial else {"family": type(self.family).__name__}),
            "radial": self.family.formula,
            "zoom": _described(self.zoom),
        }
        if self.focus_range is not None:
            content["focus_range"] = _numbers(self.focus_range)
        if self.shift is not None:
            content["shift"] = _described(self.shift)
            content["shift_meaning"] = "centre at f = centre + scale (k_1(f), k_2(f)) of the model in shift"
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
        if np.any((values < low - slack) | (values > high + slack)):
            asked = f"The focal length {values[0]:g} {self.focal_unit} is"
            if values.size > 1:
                asked = f"Focal lengths from {values.min():g} to {values.max():g} {self.focal_unit} are"
            warnings.warn(
                f"{asked} asked for, and the lens was fitted on {low:g} to {high:g} {self.focal_unit}: "
                "beyond that its distortion is extrapolated.",
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
        focus_range=_focus_range(lines) if isinstance(zoom, AbstractFocusZoom) else None,
        family=lines.family,
    )


def _focus_range(lines):
    focus = jnp.asarray(lines.focus)
    return jnp.stack([jnp.min(focus), jnp.max(focus)])


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
        if content["version"] not in range(1, _VERSION + 1):
            raise ValueError(
                f"its format version is {content['version']!r} and this zoomjax reads up to {_VERSION}; "
                "update zoomjax"
            )
        family = content.get("family", "RadialPolynomial")
        if family not in _FAMILIES:
            raise ValueError(f"its family of distortions, {family!r}, is unknown; update zoomjax")
        lens = ZoomLens(
            zoom=_read_zoom(content["zoom"], None),
            centre=_array(content, "centre", (2,)),
            focal_range=_array(content, "focal_range", (2,)),
            image_size=checked_size(content["image_size"]),
            focal_unit=checked_unit(content["focal_unit"]),
            shift=_read_zoom(content["shift"], 2) if "shift" in content else None,
            focus_range=_array(content, "focus_range", (2,)) if "focus_range" in content else None,
            family=_FAMILIES[family](),
        )
        size = jax.eval_shape(lens.zoom, *[jnp.ones(())] * _settings(lens.zoom)).shape[0]
        if size < lens.family.size(1):
            raise ValueError(f"it has {size} coefficients, and {family} has {lens.family.size(1)} or more")
        low, high = lens.focal_range
        if not 0 < low <= high:
            raise ValueError("its focal_range is not positive and in order")
        if not math.isclose(content["scale"], lens.scale, rel_tol=1e-6):
            raise ValueError("its scale is not half the diagonal of its image_size")
        return lens
    except FileNotFoundError:
        raise
    except (
        ValueError,
        TypeError,
        KeyError,
        AttributeError,
        ArithmeticError,
        RecursionError,
        OSError,
    ) as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else str(error).rstrip(".")
        raise ValueError(f"Cannot read a lens from {os.fspath(path)}: {reason}.") from error


# The zoom models that lens.json can hold, and what it says of them. Their fields are written as they are.
_FORMULAS = {
    PolynomialZoom: "k_i(f) = sum_j parameters[j][i-1] * (focal_ref / f)^j",
    TableZoom: "k_i(f): parameters[.][i-1] at the knots, 1/f (or f, if not inverse), linear in between",
    SplineZoom: "k_i(f): the natural cubic spline in 1/f through parameters[.][i-1] at the knots",
    PowerZoom: "k_i(f) = d0 + d1 (f / focal_ref)^d2 with rows d0, d1, d2 of parameters[.][i-1]",
    TwoRegionZoom: "k_i(f) = sum_j c_j (focal_ref / f)^j with c = parameters[0..2][i-1] for f < crossover, "
    "parameters[3..5][i-1] from there on",
    SmoothZoom: "k_i(f) = sum_j parameters[j][i-1] P_j(2 focal_ref / f - 1), P_j Legendre's polynomials; "
    "the rest is the prior",
    FocusSplineZoom: "k_i(f, d) = sum over knots z of 1/f and e of the focus d of "
    "parameters[z * focus_number + e][i-1] S_z(1/f) T_e(d), S and T the cardinal natural cubic splines",
}

_FAMILIES = {family.__name__: family for family in (RadialPolynomial, Division, BrownConrady)}
"""The families that it can hold."""

_TABLE = (None, None)
_SHAPES = {
    "parameters": _TABLE,
    "knots": (None,),
    "curvature": _TABLE,
    "focus_knots": (None,),
    "focus_curvature": _TABLE,
    "quadratic": _TABLE,
    "beyond": _TABLE,
}
"""Of their fields that are not single numbers."""


def _described(model: AbstractZoom) -> dict[str, object]:
    return {
        "model": type(model).__name__,
        "formula": _FORMULAS[type(model)],
        **{name: _plain(value) for name, value in vars(model).items()},
    }


def _read_zoom(content, numbers: int | None) -> AbstractZoom:
    """A zoom model that gives so many numbers, or as many as it has parameters for."""
    models = {model.__name__: model for model in _FORMULAS}
    if content["model"] not in models:
        raise ValueError(f"its zoom model, {content['model']!r}, is unknown; update zoomjax")
    model = models[content["model"]]
    fields = {}
    for field in dataclasses.fields(model):
        if field.metadata.get("static"):
            fields[field.name] = content[field.name]
        else:
            fields[field.name] = _array(content, field.name, _SHAPES.get(field.name, ()))
    for name in ("focal_ref", "crossover"):
        if name in fields and not fields[name] > 0:
            raise ValueError(f"its {name} is not positive")
    if not isinstance(fields.get("inverse", True), bool):
        raise ValueError("its 'inverse' is neither true nor false")
    rows, columns = fields["parameters"].shape
    for name in ("", "focus_"):
        knots, curvature = fields.get(f"{name}knots"), fields.get(f"{name}curvature")
        if knots is None:
            continue
        if not (np.diff(knots) > 0).all():
            raise ValueError(f"its {name}knots do not increase")
        if curvature is not None and curvature.shape != (knots.size, knots.size):
            raise ValueError(f"its {name}curvature is not that of its {name}knots")
    numbers_of_knots = [fields[name].size for name in ("knots", "focus_knots") if name in fields]
    if numbers_of_knots and math.prod(numbers_of_knots) != rows:
        raise ValueError("its knots are not as many as its parameters")
    zoom = model(**fields)
    if jax.eval_shape(zoom, *[jnp.ones(())] * _settings(zoom)).shape != (numbers or columns,):
        raise ValueError("its parameters are not those of its model")
    return zoom


def _settings(zoom):
    """How many numbers a zoom model's coefficients depend on: the focal length, and perhaps the focus."""
    return 2 if isinstance(zoom, AbstractFocusZoom) else 1


def _plain(value):
    return _numbers(value) if eqx.is_array_like(value) and not isinstance(value, bool | int) else value


def _numbers(array):
    """Nested lists of floats; JSON keeps every digit of them."""
    return np.asarray(array, np.float64).tolist()


def _array(content, name, shape):
    array = np.asarray(content[name], np.float64)
    matches = array.ndim == len(shape) and all(
        want in (None, have) for want, have in zip(shape, array.shape, strict=True)
    )
    dtype = jnp.result_type(float)
    if not matches or not array.size or not (abs(array) <= jnp.finfo(dtype).max).all():
        raise ValueError(f"the numbers of its {name!r} are incomplete or not finite")
    return jnp.asarray(array, dtype)
