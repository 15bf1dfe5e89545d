"""Uncertainty of a fitted lens: standard deviations and bands of anything computed from it.

The delta method: a quantity q(a) of the parameters a, whose covariance is C, has the covariance
``(dq/da) C (dq/da)^T``. For a zoom model that is linear in its parameters, this is exact for the
coefficients at a focal length and for corrected points, because these q are linear too.

The parameters are those of the zoom model; those of the centre of distortion, where it was fitted
(`ZoomFit.joint`); and what the lens is off the model at any focal length, where that was estimated
(`ZoomFit.misfit`, `ZoomFit.off_centre`).

Each call computes one derivative with respect to each parameter; nothing is fitted or sampled.
"""

import functools
import inspect
import math
import warnings
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm
from jaxtyping import Array, Float, Num, PyTree, ScalarLike

from .._core.arguments import kinds_checked
from .._core.arrays import as_jax
from .._core.checks import warn_caller
from .._core.fields import check_positive, real_argument
from .._core.products import exact_products
from .._core.programs import light_program, used_once
from .._core.types import AnyArray, Points, traced
from ..fit.result import ZoomFit
from ..lines.buckets import bucket, padded_to
from ..models.lens import ZoomLens
from ..models.sizes import at_focal
from ._uncertain import uncertain

_SIZES = (16, 512, 8192)
"""Numbers of points that functions of points are compiled for; larger ones are four to each doubling."""

_ONCE = 2048
"""The one where programs run once or twice: more points are passed in so many at a time."""

Given = ParamSpec("Given")
Result = TypeVar("Result")


def _compiled(function: Callable[Given, Result]) -> Callable[Given, Result]:
    """Compile a function of a fit; refuse focal lengths and levels that are none, where they are known.

    It does not see the errors of the frames, so that their number is no matter, and gets points in a row of
    few sizes.
    """
    compiled, signature = light_program(function), inspect.signature(function)

    @functools.wraps(function)
    def checked(*args: Given.args, **kwargs: Given.kwargs) -> Result:
        given: dict[str, Any] = signature.bind(*args, **kwargs).arguments
        for name in given.keys() & {"points", "focal"}:
            given[name] = real_argument(name, given[name])
        check_positive("focal", given["focal"])
        level = given.get("level", 0.5)
        if not traced(level) and not (_is_number(level) and 0 < level < 1):
            raise ValueError(f"Argument level must be a number between 0 and 1, but it is {level!r}.")
        given["fit"] = eqx.tree_at(lambda fit: fit.frame_rms, given["fit"], None)
        if "points" in given and _known(given) and np.shape(given["points"])[-1:] == (2,):
            return _in_few_sizes(compiled, given)
        return compiled(**given)  # pyright: ignore[reportCallIssue]

    return checked


def _known(given: dict[str, Any]) -> bool:
    """Whether all is known, and where to pad costs nothing."""
    return jax.default_backend() == "cpu" and not traced(given)


def _in_few_sizes(compiled: Callable[..., Any], given: dict[str, Any]) -> Any:
    """What a function finds of points, which are padded by the last one."""
    points, focal = np.asarray(given["points"]), np.asarray(given["focal"])
    shape = np.broadcast_shapes(points.shape[:-1], focal.shape)
    number = math.prod(shape)
    if not number:
        return compiled(**given)
    points = np.broadcast_to(points, (*shape, 2)).reshape(number, 2)
    focal = np.broadcast_to(focal, shape).reshape(number)
    size = _ONCE if used_once() else bucket(number, _SIZES)
    parts = []
    for start in range(0, number, size):
        some = (padded_to(of[start : start + size], size) for of in (points, focal))
        parts.append(compiled(**given | dict(zip(("points", "focal"), some, strict=True))))

    def cut(*of):  # by NumPy, which compiles nothing
        found = np.concatenate([np.asarray(part) for part in of])[:number]
        return as_jax(found.reshape((*shape, *found.shape[1:])))

    return jax.tree.map(cut, *parts)


def _is_number(value: Any) -> bool:
    return np.ndim(value) == 0 and np.issubdtype(np.asarray(value).dtype, np.floating)


Focals = Num[AnyArray | ScalarLike, "*focal"]


@kinds_checked
@exact_products
def std_of(fit: ZoomFit, function: Callable[[ZoomLens], PyTree]) -> PyTree:
    """Standard deviations of anything computed from a fitted lens.

    Args:
        fit: the fit.
        function: a function from a lens to arrays, differentiable by JAX. If the fit has a `misfit`, the
            lens may have one coefficient more than that of the fit: see `with_misfit`.

    Returns:
        What `function` returns, each number replaced by its standard deviation: infinite where it depends
        on a parameter that the lines do not determine, NaN where the number itself is not finite, or
        changes though its derivative is 0.

    Raises:
        ValueError: `function` returns integers or booleans, as `jnp.argmax` and `has_inverse` do.

    Warns:
        UserWarning: a number changes with the lens though its derivative is 0, as that of ``jnp.round`` or
            a comparison. Under ``jit`` its standard deviation is 0.

    Example:
        >>> import jax.numpy as jnp, numpy as np
        >>> from zoomjax import Lines, PolynomialZoom, compress, fit_zoom
        >>> rng, t = np.random.default_rng(0), np.linspace(10.0, 470.0, 60)
        >>> points = [np.stack([x + 0.1 * rng.standard_normal(60), t], -1) for x in range(20, 620, 60)]
        >>> lines = Lines.from_ragged(points, [0] * 10, [50], image_size=(640, 480))
        >>> fit = fit_zoom(compress(lines), zoom=PolynomialZoom(degree=0), terms=1)
        >>> pixel = jnp.array([600.0, 440.0])
        >>> std_of(fit, lambda lens: lens(50.0).distort(pixel)).shape
        (2,)
    """
    flat, lens_at, covariance = uncertain(fit)
    derivatives, values = _derivatives(lambda flat: function(lens_at(flat)), flat)
    known = jax.tree.map(jnp.isfinite, values)
    if not traced((derivatives, values, covariance)):
        known = _continuous(lambda flat: function(lens_at(flat)), flat, covariance, derivatives, values)
    return jax.tree.map(
        lambda rows, known: jnp.where(known, _root(_variance(covariance, rows)), jnp.nan),
        derivatives,
        known,
    )


def _continuous(function, flat, covariance, derivatives, values):
    """Which values are numbers, and do not change within 3 deviations where all derivatives are 0."""
    still = jax.tree.map(lambda rows: (rows == 0).all(-1), derivatives)
    known = jax.tree.map(jnp.isfinite, values)
    if not any(leaf.any() for leaf in jax.tree.leaves(still)):
        return known
    variances = jnp.diag(covariance)
    step = 3 * jnp.sqrt(jnp.where(jnp.isfinite(variances), variances, 0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # said before
        others = [function(flat + step), function(flat - step)]
    moved = jax.tree.map(
        lambda still, at, *others: still & (sum(abs(other - at) for other in others) > 1e-6 * abs(at)),
        *(still, values, *others),
    )
    if any(leaf.any() for leaf in jax.tree.leaves(moved)):
        warn_caller(
            "A result of argument function changes with the lens, but its derivative is 0, as that of "
            "rounding, argmax and comparisons: its standard deviation is not known."
        )
    return jax.tree.map(lambda known, moved: known & ~moved, known, moved)


def _derivatives(function, flat):
    """By all that is uncertain, and the values: where those are NaN, derivatives of zero say nothing."""

    def both(flat):
        found = function(flat)
        for leaf in jax.tree.leaves(found):
            if jnp.result_type(leaf).kind not in "fV":  # bfloat16 is of kind V
                raise ValueError(
                    "Argument function must return real numbers, as others have no standard deviation, but "
                    f"it returns {jnp.result_type(leaf)}."
                )
        return found, found

    return jax.jacfwd(both, has_aux=True)(flat)


@kinds_checked
@_compiled
def coefficient_std(fit: ZoomFit, focal: Focals) -> Float[Array, "*focal terms"]:
    """Standard deviations of the normalised coefficients k1(f), ..., kN(f).

    Args:
        fit: the fit.
        focal: one focal length or an array of them, in the lens's unit. Beyond the fitted range the bands
            widen with the uncertainty of the parameters, but do not include errors of the model itself.

    Returns:
        For each focal length N numbers, infinite where the lines do not determine them.

    Example:
        >>> import numpy as np
        >>> from zoomjax import compress, fit_zoom, scenes
        >>> focal = scenes.focal_sweep(3)
        >>> lines = scenes.board_lines(scenes.nikkor_18_200(), focal, spacing=99.0, noise=0.5)
        >>> coefficient_std(fit_zoom(compress(lines)), focal).shape
        (3, 2)
    """

    def of_model(f):  # without the next one that a misfit may have
        return std_of(fit, lambda lens: lens.zoom(f))[: len(fit.lens.zoom(f))]

    return _each_focal(of_model, fit, focal)


@kinds_checked
@_compiled
def displacement_covariance(fit: ZoomFit, points: Points, *, focal: Focals) -> Float[Array, "*both 2 2"]:
    """Covariance of corrected points, and so of displacements, px^2.

    Args:
        fit: the fit.
        points: distorted image points, px, of any leading shape.
        focal: focal length of each point, of a shape that broadcasts with the points' leading shape.

    Returns:
        A matrix for each point, for x and y; infinite on its diagonal where the lines do not determine it.
        For radial models about a given centre only the radius is uncertain: their matrices have rank 1.

    Example:
        >>> import numpy as np
        >>> from zoomjax import compress, fit_zoom, scenes
        >>> focal = scenes.focal_sweep(3)
        >>> lines = scenes.board_lines(scenes.nikkor_18_200(), focal, spacing=99.0, noise=0.5)
        >>> displacement_covariance(fit_zoom(compress(lines)), np.zeros((5, 1, 2)), focal=focal).shape
        (5, 3, 2, 2)
    """
    return _each_point(_point_covariance, "(c,d)", fit, points, focal)


@kinds_checked
@_compiled
def displacement_std(fit: ZoomFit, points: Points, *, focal: Focals) -> Float[Array, "*both"]:
    """Standard deviation of corrected points, px: the root of the mean squared distance.

    For radial models it is the standard deviation along the radius.

    Args:
        fit, points, focal: as for `displacement_covariance`.

    Returns:
        A number for each point; infinite where the lines do not determine it.

    Example:
        >>> import numpy as np
        >>> from zoomjax import compress, fit_zoom, scenes
        >>> focal = scenes.focal_sweep(3)
        >>> lines = scenes.board_lines(scenes.nikkor_18_200(), focal, spacing=99.0, noise=0.5)
        >>> bool(displacement_std(fit_zoom(compress(lines)), np.zeros(2), focal=50.0) < 0.5)
        True
    """
    return _each_point(lambda *one: _root(jnp.trace(_point_covariance(*one))), "()", fit, points, focal)


@kinds_checked
@_compiled
def displacement_band(
    fit: ZoomFit, points: Points, *, focal: Focals, level: ScalarLike = 0.95
) -> tuple[Float[Array, "*both"], Float[Array, "*both"]]:
    """Confidence interval of the outward displacement of points, px.

    The displacement is the distance of the corrected point from the centre of distortion minus that of the
    point itself; negative where the correction moves it inwards.

    Args:
        fit, points, focal: as for `displacement_covariance`.
        level: the confidence level, between 0 and 1, which are excluded: a share, not per cent.

    Returns:
        The lower and the upper end for each point.

    Example:
        >>> import numpy as np
        >>> from zoomjax import compress, fit_zoom, scenes
        >>> lens, focal = scenes.nikkor_18_200(), scenes.focal_sweep(3)
        >>> lines = scenes.board_lines(lens, focal, spacing=99.0, noise=0.5)
        >>> low, high = displacement_band(fit_zoom(compress(lines)), np.zeros(2), focal=50.0)
        >>> bool(low < high)
        True
    """
    quantile = norm.ppf((1 + jnp.asarray(level)) / 2)

    def band(fit, point, f):
        offset = point - fit.lens.centre_at(f).astype(point.dtype)
        squared = offset @ offset
        outward = offset / jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1)), 1)
        variance = _variance(uncertain(fit)[2], outward @ _point_rows(fit, point, f))
        middle = (at_focal(fit.lens, f).undistort(point) - point) @ outward
        half = quantile.astype(point.dtype) * _root(variance)
        return jnp.stack([middle - half, middle + half])

    ends = _each_point(band, "(e)", fit, points, focal)
    return ends[..., 0], ends[..., 1]


def _each_focal(function, fit, focal):
    focal = _positive(jnp.asarray(focal, fit.covariance.dtype))
    return jnp.vectorize(function, signature="()->(k)")(focal)


def _each_point(function, result, fit, points, focal):
    """Apply a function of the fit, one point and one focal length to all of them."""
    dtype = fit.covariance.dtype
    points, focal = jnp.asarray(points, dtype), _positive(jnp.asarray(focal, dtype))
    if points.shape[-1:] != (2,):
        raise ValueError(f"Argument points must have shape (..., 2), but its shape is {points.shape}.")
    both = jnp.broadcast_shapes(points.shape[:-1], focal.shape)
    over = jnp.vectorize(lambda *one: function(fit, *one), signature=f"(c),()->{result}")
    return over(jnp.broadcast_to(points, (*both, 2)), jnp.broadcast_to(focal, both))


def _point_rows(fit: ZoomFit, point: Any, f: Any) -> Float[Array, "2 parameter"]:
    """Derivatives of one corrected point by all that is uncertain."""
    flat, lens_at, _ = uncertain(fit)
    rows, place = _derivatives(lambda flat: at_focal(lens_at(flat), f).undistort(point), flat)
    return jnp.where(jnp.isfinite(place)[:, None], rows, jnp.nan)


def _positive(focal):
    """NaN instead of focal lengths that are none, which only ``jit`` does not know before."""
    return jnp.where((focal > 0) & jnp.isfinite(focal), focal, jnp.nan)


def _point_covariance(fit: ZoomFit, point: Any, f: Any) -> Float[Array, "2 2"]:
    """Of one corrected point."""
    rows, (_, _, own) = _point_rows(fit, point, f), uncertain(fit)
    variance = _variance(own, rows)
    covariance = rows @ _finite(own) @ rows.T
    unknown = jnp.any(jnp.isinf(variance))
    off_diagonal = jnp.where(unknown, 0, covariance)
    return jnp.where(jnp.eye(2, dtype=bool), variance[:, None], off_diagonal)


def _variance(covariance, rows):
    """The diagonal of ``rows C rows^T``, infinite where a row uses a parameter of infinite variance.

    Never below what rounding may make of it. Focal lengths that are nearly the same give parameters with
    variances of 1e18, say, whose sum cancels: its last digits, or a negative number, say nothing.
    """
    finite = jnp.einsum("...p,pq,...q->...", rows, _finite(covariance), rows)
    size = jnp.einsum("...p,pq,...q->...", *map(jnp.abs, (rows, _finite(covariance), rows)))
    rounding = jax.lax.stop_gradient(rows.shape[-1] * jnp.finfo(rows.dtype).eps * size)
    unknown = jnp.isinf(jnp.diagonal(covariance)).astype(rows.dtype)
    variance = jnp.where(
        (rows != 0).astype(rows.dtype) @ unknown > 0, jnp.inf, jnp.maximum(finite, rounding)
    )
    return jnp.where(jnp.isnan(rows).any(axis=-1), jnp.nan, variance)


def _finite(covariance):
    return jnp.where(jnp.isinf(covariance), 0, covariance)


def _root(variance):
    """The square root, with a gradient of zero at zero; infinity and NaN as they are."""
    regular = (variance > 0) & jnp.isfinite(variance)
    root = jnp.sqrt(jnp.where(regular, variance, 1))
    return jnp.where(regular, root, jnp.where(jnp.isfinite(variance), 0, variance))
