"""Robust fits: an M-estimator over whole lines, against lines that are not straight in the scene.

A curved marking, a bent edge or two borders joined by mistake are wrong as a whole. So whole lines are
weighted, not points, and compression stays exact. With the RMS distance r of a line's corrected points
to their line, m its median over the lines, and s its spread, the weight of a line is Tukey's

    v = (1 - t^2)^2,  t = (r - m) / (c s),    but 1 for r < m, and 0 for t > 1.

The spread is that of the better half, 1.48 times the median of m - r there, for the bad lines are all in
the other; to it is added m / sqrt(2 (n - 2)), by which a line of n points may be rough by chance, and what
coordinates are rounded by.

Weights and fit are found in turns (iteratively reweighted least squares, a Gauss-Newton step a turn), from
a wide c that narrows to `_CUT`, so that good lines that the first, unweighted fit misjudges are not lost;
then `fit_zoom` converges with these weights.
"""

from typing import Any, NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from .._core.arguments import kinds_checked
from .._core.arrays import as_jax
from .._core.programs import light_program, rare_program
from .._core.types import AnyArray, traced
from ..lines.base import AbstractLines, SomeLines
from ..lines.best_line import line_residuals, rounded_by
from ..lines.buckets import bucketed, of_lines
from ..models.distortion_model import AbstractDistortionModel
from ..models.model import Model
from ..models.polynomial import RadialPolynomial
from ..models.zoom import AbstractLinearZoom, AbstractZoom, with_parameters
from ._least_squares import Solver
from ._linear import least_squares
from .algebraic import algebraic_model
from .centre import fit_centre, small_about
from .energy import coefficients_by, linearised, prior_jacobian
from .minimise import fit_prepared
from .moved_centre import for_any_centre
from .prepare import asked_for, ready_model
from .result import ZoomFit, of_given
from .zoom import CentreArgument, about_centre, fit_zoom, is_to_be_fitted

_CUT = 6.0  # standard deviations of r among good lines, were they normal
_NARROWING = (np.inf, 24.0, 16.0, 10.0, *(_CUT,) * 4)  # c of each turn
_NEAR = (_CUT,) * len(_NARROWING)  # the same from a start that is to be kept: one compiled program
_CENTRES = 2  # how often weights and a centre that is fitted are found in turn, at most
_LEAST_SPREAD = 0.02  # of m: lines of thousands of points, or without noise, are all alike


class RobustFit(eqx.Module):
    """A robust fit and the weights of its lines.

    Attributes:
        fit: the zoom model fitted to the weighted lines; its RMS and covariance are theirs.
        weight: of each line, from 0 (rejected) to 1, or to the weight it had before.
        line_rms: RMS distance of each line's n corrected points to their line, px, with a divisor of n - 2
            so that short lines do not look better than they are; of rejected ones too. NaN for lines of
            fewer than three points, which count as none.
        scale: the typical `line_rms`, px: the median over the lines that had a weight above 0 before.
    """

    fit: ZoomFit
    weight: Float[Array, "line"]
    line_rms: Float[Array, "line"]
    scale: Float[Array, ""]

    def __call__(self, *_: Any, **__: Any) -> NoReturn:
        """Raise TypeError: call the lens of the fit instead."""
        raise TypeError("A RobustFit is not a lens: use robust.fit.lens, as in robust.fit.lens(35.0).")

    @property
    def rejected(self) -> Int[np.ndarray, "rejected"]:
        """Indices of the rejected lines, the least straight first."""
        lines = np.flatnonzero((np.asarray(self.weight) == 0) & ~np.isnan(np.asarray(self.line_rms)))
        return lines[np.argsort(-np.asarray(self.line_rms)[lines], kind="stable")]


@kinds_checked
def fit_robust(
    lines: AbstractLines,
    *,
    zoom: AbstractZoom | Model | None = None,
    distortion_model: AbstractDistortionModel | None = None,
    terms: int | None = None,
    centre: CentreArgument | None = None,
    solver: Solver | None = None,
    max_steps: int = 256,
    invertible: bool = True,
    throw: bool = True,
) -> RobustFit:
    """Fit a zoom model robustly, rejecting lines that are not straight in the scene.

    Args:
        lines: the lines, or, much faster and with the same result, ``compress(lines)``. Existing weights
            are kept as factors.
        zoom, distortion_model, terms, invertible, throw: as for `fit_zoom`, whose errors also apply.
        centre: as for `fit_zoom`. With "fit", weights and centre are found in turn: about a centre that is
            far from the lens's, straight lines look bent, the longest ones most. Those weights count that
            keep more of the lines.
        solver, max_steps: of the final fit with fixed weights; as for `fit_zoom`. The turns before it are
            single Gauss-Newton steps.

    Returns:
        The fit of the remaining lines, and the weight of each line.

    Example:
        >>> import numpy as np
        >>> from zoomjax import Lines, PolynomialZoom, compress
        >>> rng, t = np.random.default_rng(0), np.linspace(10.0, 470.0, 60)
        >>> straight = [np.stack([x + 0.1 * rng.standard_normal(60), t], -1) for x in range(20, 620, 60)]
        >>> arc = np.stack([300 + 30 * np.sin(t / 150), t], axis=-1)
        >>> lines = Lines.from_ragged([*straight, arc], [0] * 11, [50], image_size=(640, 480))
        >>> fit_robust(compress(lines), zoom=PolynomialZoom(degree=0), terms=1).rejected.tolist()
        [10]
    """
    given, asked = asked_for(lines, zoom, terms, distortion_model)
    model = ready_model(given, asked)
    options: Any = {"solver": solver, "max_steps": max_steps, "throw": throw}
    if is_to_be_fitted(centre, invertible=invertible):
        held = for_any_centre(bucketed(given), asked.terms)
        weighted = held.weighted(weights_for_any_centre(held, asked))
        fit = fit_zoom(weighted, zoom=asked, centre="fit", **options)
        return robust_of_given(_described(small_about(held, fit.lens.centre, asked), weighted, fit), given)
    padded = about_centre(bucketed(given), centre)
    weighted, model = _turns(padded, model, asked.zoom.parameters is None)
    fit = fit_zoom(weighted, zoom=model, invertible=invertible, **options)
    return robust_of_given(_described(padded, weighted, fit), given)


def weights_for_any_centre(held: AbstractLines, model: Model) -> Float[AnyArray, "line"]:
    """The weights of the lines about their centre, or about one fitted to them, whichever keeps more.

    Args:
        held: lines for any centre.
        model: of them.
    """

    def about(centre: Any) -> Any:
        weight = reweighted(small_about(held, centre, model), model)[0].weight
        return weight if traced(weight) else np.asarray(weight)

    best, tried = about(held.centre), held
    for _ in range(_CENTRES):
        if not traced(best) and best[np.asarray(_own_weights(held)) > 0].all():
            break
        found = fit_centre(tried, zoom=model, throw=False)
        other = about(found.fit.lens.centre)
        if not traced((found.determined, other)):
            if not found.determined or other.sum() <= best.sum():
                break
            best = other
        else:
            best = jnp.where(found.determined & (jnp.sum(other) > jnp.sum(best)), other, best)
        tried = held.weighted(best)
    return best


def fit_robust_freely(lines, model, algebraic, solver, max_steps):
    """`fit_robust` of padded lines and a prepared model, whether invertible or not, and its outcome."""
    weighted, model = _turns(lines, model, algebraic)
    fit, outcome = fit_prepared(weighted, model, solver, max_steps)
    return _described(lines, weighted, fit), outcome


def _described(lines, weighted, fit):
    """The fit with the weights and the errors of its lines."""
    line_rms, median = _line_rms(lines, fit.lens.zoom)
    line_rms = jnp.where(lines.counts > 2, line_rms, jnp.nan)
    return RobustFit(fit, jnp.asarray(weighted.weight), line_rms, median)


def robust_of_given(robust: RobustFit, lines: AbstractLines) -> RobustFit:
    """A robust fit of padded lines as one of the lines themselves."""
    own = (of_given(robust.fit, lines), of_lines(robust.weight, lines), of_lines(robust.line_rms, lines))
    return eqx.tree_at(lambda robust: (robust.fit, robust.weight, robust.line_rms), robust, own)


def reweighted(lines: SomeLines, asked: Model, *, near: bool = False) -> tuple[SomeLines, Model]:
    """The lines with the weights of `fit_robust`, and the model of its last turn.

    The first turn starts from the algebraic estimate; under another distortion model, which has none, from
    the fit to all lines: far from it, whole frames would seem not to be straight. A model that has
    parameters is where it starts, and with `near` it stays there: no turn is with a wide c.
    """
    padded = bucketed(lines)
    narrowing = _NEAR if near else _NARROWING
    weighted, model = _turns(padded, ready_model(lines, asked), asked.zoom.parameters is None, narrowing)
    return lines.weighted(of_lines(jnp.asarray(weighted.weight), lines)), model


def typical_rms(lines: AbstractLines, model: Model) -> float:
    """The median of the lines' RMS, px, under a model with parameters: the `scale` of `RobustFit`.

    Of several models the one of the least median is nearest to what most lines have in common (Rousseeuw,
    "Least median of squares regression", 1984), while fewer than half of them are not straight.
    """
    return float(_line_rms(bucketed(lines), model.zoom)[1])


def _turns(lines, model, unfitted, narrowing=_NARROWING):
    """The lines with their weights, and the model of the last turn, of a prepared model."""
    if unfitted:
        if not isinstance(model.distortion_model, RadialPolynomial):
            weighted = lines.weighted(_own_weights(lines))
            model = model.with_zoom(fit_zoom(weighted, zoom=model, invertible=False, throw=False).lens.zoom)
        elif isinstance(model.zoom, AbstractLinearZoom):
            model = algebraic_model(lines, model)
    dtype = jax.dtypes.canonicalize_dtype(lines.focal.dtype)
    weighted, zoom = _reweighted(lines, model.zoom, as_jax(np.asarray(narrowing, dtype)))
    return weighted, model.with_zoom(zoom)


def _own_weights(lines):
    return jnp.ones_like(lines.counts) if lines.weight is None else lines.weight


@rare_program
def _reweighted(lines, start, narrowing):
    """The lines with their weights, and the model that goes with them: a Gauss-Newton step a turn."""
    own = _own_weights(lines)

    def turn(model, cut):
        weighted = lines.weighted(own * _weights(lines, model, cut))
        residuals, jacobian, *_ = linearised(weighted, model)
        flat, unravel = ravel_pytree(model.parameters)
        prior = prior_jacobian(weighted, model)  # a prior's residuals are linear in the parameters
        matrix = jnp.concatenate([jacobian.reshape(-1, flat.size), prior])
        right = jnp.concatenate([residuals.reshape(-1), prior @ flat])
        step = least_squares(matrix, -right, floor=0.0)
        return with_parameters(model, unravel(flat + step)), None

    model, _ = jax.lax.scan(turn, start, narrowing)
    return lines.weighted(own * _weights(lines, model, _CUT)), model


def _weights(lines, model, cut):
    """Tukey's weight of each line under a model; 0 for lines that are not there."""
    line_rms, median = _line_rms(lines, model)
    spread = 1.4826 * (median - _median(line_rms, _counted(lines), better_half=True))
    chance = median / jnp.sqrt(2 * jnp.maximum(lines.counts - 2, 1))
    rounding = rounded_by(lines.scale, line_rms.dtype)
    spread = jnp.sqrt(jnp.maximum(spread, _LEAST_SPREAD * median) ** 2 + chance**2 + rounding**2)
    # 1/cut is 0 in the first turn: by an infinite cut the derivative would be 0 times infinity.
    excess = (1 / cut) * jnp.maximum(line_rms - median, 0) / jnp.where(spread > 0, spread, 1)
    return jnp.where((excess < 1) & (lines.counts > 2), (1 - excess**2) ** 2, 0)


@light_program
def _line_rms(lines, model):
    """RMS distance of each line, px, over its degrees of freedom, and the median over lines."""
    corrected = lines.corrected(coefficients_by(model, lines))
    squares = jnp.sum(jax.vmap(line_residuals)(corrected) ** 2, axis=1)
    line_rms = jnp.sqrt(squares / jnp.maximum(lines.counts - 2, 1))
    return line_rms, _median(line_rms, _counted(lines))


def _counted(lines):
    """The lines that tell what is usual: three points or more, and, before the fit, a weight above 0."""
    return (lines.counts > 2) & (_own_weights(lines) > 0)


def _median(values, counted, *, better_half=False):
    """The median of those that are counted, or of the better half of them; NaN of none.

    Unlike `jnp.nanmedian` it has a derivative. The half is by rank: lines of one RMS, as those that mirror
    each other have, would by their values be in either half, as rounding has it.
    """
    ordered = jnp.sort(jnp.where(counted, values, jnp.inf))
    all_of_them = jnp.sum(counted)
    number = (all_of_them + 1) // 2 if better_half else all_of_them
    middle = (ordered[(number - 1) // 2] + ordered[number // 2]) / 2
    return jnp.where(number > 0, middle, jnp.nan)
