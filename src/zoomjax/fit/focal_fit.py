"""Estimation of focal lengths from the lines, together with the zoom model.

The energy that is minimised, and its derivatives, are in `focal_refinement`.
"""

from typing import Any, NoReturn

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._core.arguments import kinds_checked
from .._core.types import traced
from ..lines.base import AbstractLines
from ..lines.buckets import bucketed
from ..models.model import Model
from ..models.zoom import AbstractZoom
from .energy import counted_frames
from .focal_lengths import UNKNOWN, Sigma, at_focal_lengths, checked_sigma, with_covariances
from .focal_refinement import MOST_STEPS, posterior, refined
from .prepare import asked_for
from .problem import about_own_centre
from .result import RESULTS, ZoomFit, failed
from .zoom import fit_zoom


class FocalFit(eqx.Module):
    """A zoom lens fitted together with the focal lengths of its frames.

    Attributes:
        fit: the fit at the estimated focal lengths; its covariance includes their remaining uncertainty,
            and its result is `undetermined` where they leave a parameter open.
        focal: the estimated focal length of each frame.
        std: their standard deviations, same unit; at most about those given, and 0 where 0 was given.
            Infinite where it is not determined; that given for a frame whose lines all weigh nothing.
        given: the focal lengths of the lines.
        steps: number of steps the joint solver took.
        kept: whether the given focal lengths were kept, as refined ones did harm: see `fit_focal`.
            `std` is then that given.
    """

    fit: ZoomFit
    focal: Float[Array, "frame"]
    std: Float[Array, "frame"]
    given: Float[Array, "frame"]
    steps: Int[Array, ""]
    kept: Bool[Array, ""]

    def __call__(self, *_: Any, **__: Any) -> NoReturn:
        """Raise TypeError: the lens of its fit is asked."""
        raise TypeError("A FocalFit is not a lens: use found.fit.lens, as in found.fit.lens(35.0).")


@kinds_checked
def fit_focal(
    lines: AbstractLines,
    focal_sigma: Sigma,
    *,
    zoom: AbstractZoom | Model | None = None,
    terms: int | None = None,
    invertible: bool = True,
    throw: bool = True,
) -> FocalFit:
    """Fit the zoom model and the focal lengths together, with the given focal lengths as a prior.

    Straight lines alone do not determine focal lengths: after a change of all focal lengths by an
    increasing function, another zoom model makes every line as straight. A polynomial in 1/f stays one if
    1/f is scaled and shifted, so the lines cannot correct scale and offset at all. The scale of the result
    is therefore that of the given focal lengths; the lines correct single ones that deviate from a smooth
    k(f). Deviations that the zoom model cannot follow would be attributed to focal lengths, too. So frames
    are left out, a fifth at a time, and measured at their given focal lengths: where the model that was
    fitted together with the focal lengths of the others makes them less straight than the one fitted at
    the given focal lengths, by more than one standard error, these are kept (all but those of infinite
    `focal_sigma`).

    Args:
        lines: the lines, or, much faster and with the same answer, ``compress(lines)``.
        focal_sigma: standard deviation of the given focal lengths, in their unit: a number, or one per
            frame. 0 keeps a focal length fixed; infinity means that it is unknown, and the given one is
            only the start.
        zoom, terms, invertible, throw: as for `fit_zoom`, whose errors also apply.

    Raises:
        ValueError: `focal_sigma` is not valid, or is infinite for all frames but those at one focal length;
            or the lines are in float32, whose rounding errors can outweigh the prior.
        RuntimeError: the solver failed (see `throw`).

    Example:
        >>> import jax
        >>> from zoomjax import compress, scenes
        >>> jax.config.update("jax_enable_x64", True)
        >>> truth, focal = scenes.nikkor_18_200(), scenes.focal_sweep(8)
        >>> lines = scenes.board_lines(truth, focal, spacing=99, noise=0.1)
        >>> given = eqx.tree_at(lambda lines: lines.focal, lines, jax.numpy.asarray(focal.round()))
        >>> found = fit_focal(compress(given), 0.29)
        >>> bool(abs(found.focal - focal).mean() < abs(found.given - focal).mean())
        True
        >>> jax.config.update("jax_enable_x64", False)
    """
    placed, model = asked_for(lines, zoom, terms)
    lines = about_own_centre(placed)
    sigma = checked_sigma(focal_sigma, lines.focal)
    given = jnp.asarray(lines.focal)
    if given.dtype != jnp.float64:
        raise ValueError(
            "Focal lengths are refined in float64 only: "
            f'jax.config.update("jax_enable_x64", True), and not lines in {given.dtype}.'
        )
    if not traced((sigma, lines)):
        told = np.isfinite(sigma) & np.asarray(counted_frames(bucketed(lines)))[: given.shape[0]]
        if np.unique(np.asarray(given)[told]).size < 2:
            raise ValueError(
                "Argument focal_sigma must be finite for frames at two different focal lengths or more, "
                f"with lines that weigh something, but it is {focal_sigma}. {UNKNOWN}"
            )
    start = fit_zoom(lines, zoom=model, invertible=False, throw=throw)
    focal, refitted, steps, reached, kept = refined(lines, start.lens.zoom, sigma)
    if throw and not traced(reached) and not reached:
        raise RuntimeError(
            f"The focal lengths did not converge in {MOST_STEPS} steps: the lines hardly determine those "
            "with a large focal_sigma. Leave these frames out, or measure their focal lengths."
        )
    moved = at_focal_lengths(lines, focal)
    fit = fit_zoom(moved, zoom=refitted, invertible=invertible, throw=throw)
    std, covariance, joint, determined = posterior(
        moved, fit.lens.zoom, fit.covariance, fit.joint, sigma, given, kept
    )
    fit = with_covariances(_judged(fit, reached, determined), covariance, joint)
    return FocalFit(
        fit=fit.result.error_if(fit, failed(fit.result)) if throw and traced(reached) else fit,
        focal=focal,
        std=std,
        given=given,
        steps=steps,
        kept=kept,
    )


def _judged(fit, reached, determined):
    """The fit whose result says, too, how the focal lengths were found."""
    unfinished: Any = RESULTS.nonlinear_max_steps_reached
    undetermined: Any = RESULTS.undetermined
    told = RESULTS.where(determined | failed(fit.result), fit.result, undetermined)
    told = RESULTS.where(reached | failed(fit.result), told, unfinished)
    return eqx.tree_at(lambda fit: fit.result, fit, told)
