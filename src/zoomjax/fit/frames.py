"""Separate fits of each frame (eq. 3 and 6).

The fit of one frame is a zoom polynomial of degree 0 on the lines of that frame, so that the solver of
`zoom` is used, under `vmap` over the frames.
"""

import functools
import operator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._core.arguments import kinds_checked
from .._core.programs import light_program, program, rare_program
from ..lines.base import AbstractLines
from ..lines.buckets import bucketed_frames, padded_frames
from ..lines.lines import Lines
from ..models.distortion_model import AbstractDistortionModel
from ..models.zoom import PolynomialZoom
from ._least_squares import Solver, default_solver
from .algebraic import algebraic_parameters, algebraic_start
from .centre import fit_frame_centres
from .compression import compressed_as_measured
from .constrained import or_else, refit_zoom
from .covariance import are_by_numpy, by_numpy
from .minimise import minimise
from .prepare import asked_for, ready_model
from .problem import data_of
from .result import (
    FrameFits,
    collected,
    described_fit,
    each_of_given,
    is_invertible,
    outcome_of,
    thrown,
    undescribed_fit,
)
from .zoom import CentreArgument, about_centre, is_to_be_fitted


@kinds_checked
def fit_frames(
    lines: AbstractLines,
    *,
    distortion_model: AbstractDistortionModel | None = None,
    terms: int = 2,
    centre: CentreArgument | None = None,
    solver: Solver | None = None,
    max_steps: int = 256,
    invertible: bool = True,
    throw: bool = True,
) -> FrameFits:
    """Fit the distortion of each frame separately (eq. 3 and 6), for comparison with a zoom model.

    Args:
        lines, distortion_model, terms, solver, max_steps, invertible, throw: as for `fit_zoom`, frame by
            frame.
        centre: as for `fit_zoom`, but with "fit" each frame has its own, where its lines determine one:
            `fit_frame_centres(...).each`.

    Raises:
        RuntimeError: the solver failed on some frame, and `throw` is set.
    """
    if is_to_be_fitted(centre, invertible=invertible):
        found = fit_frame_centres(
            lines, distortion_model=distortion_model, terms=terms, solver=solver, max_steps=max_steps
        ).each
        return thrown(found, outcome_of(found), throw) if throw else found
    placed, model = asked_for(lines, PolynomialZoom(degree=0), terms, distortion_model)
    lines = about_centre(placed, centre)
    padded, frames = bucketed_frames(lines)
    solver = default_solver(lines) if solver is None else solver
    start = algebraic_start(padded, model)
    fits, outcome = _fit_frames(padded, start, frames, model, solver, max_steps)
    if invertible:
        small = compressed_as_measured(padded, model.terms)
        fits, outcome = or_else(fits, outcome, lambda: _refit_frames(small, frames, model, fits))
    return each_of_given(thrown(fits, outcome, throw), lines)


def _fit_frames(lines, start, frames, model, solver, max_steps):
    """The fits of all frames, whether invertible or not, and their outcome."""
    parameters = None if start is None else _starts(start, frames, model)
    minima = _minima(lines, frames, model, parameters, solver, max_steps)
    found, few = None, len(frames.there) <= _MOST_FRAMES
    if few and are_by_numpy((lines, frames, minima), minima[0].size // len(frames.there)):
        found = _by_numpy(lines, frames, model, minima)
    return _described(lines, frames, model, *minima) if found is None else found


_MOST_FRAMES = 32
"""Frames whose covariances are NumPy's, one after the other."""


def _by_numpy(lines, frames, model, minima):
    """`_described` with covariances by NumPy, so that less is compiled; None for want of one."""
    known, either = _undescribed(lines, frames, model, *minima)
    known = jax.tree.map(np.asarray, known)
    each = [
        by_numpy(jax.tree.map(operator.itemgetter(m), known), photos=False)
        for m in np.flatnonzero(frames.there)
    ]
    if None in each:
        return None
    covariance, determined = (padded_frames(np.stack(of)) for of in zip(*each, strict=True))
    return _collected(lines, frames, either, covariance, determined)


@light_program
def _starts(lines, frames, model):
    """The parameters that each frame's algebraic estimate gives."""

    def start(chosen, present):
        frame = lines.take(chosen, present)
        return algebraic_parameters(frame, ready_model(frame, model))

    return jax.vmap(start)(frames.chosen, frames.present)


@rare_program
def _minima(lines, frames, model, parameters, solver, max_steps):
    """The parameters of each frame at the minimum, how the solver ended, and after how many steps."""

    def fit(frame, parameters):
        ready = ready_model(frame, model)
        ready = ready if parameters is None else ready.with_parameters(parameters)
        zoom, result, steps = minimise(frame, ready.zoom, solver, max_steps)
        return zoom.parameters, result, steps

    return _over_frames(fit, lines, frames, parameters)


@light_program
def _described(lines, frames, model, *minima):
    """The fits that ended so, and their outcome."""
    return _with_outcome(
        lines, frames, _over_frames(_of_model(described_fit, model), lines, frames, *minima)
    )


@light_program
def _undescribed(lines, frames, model, *minima):
    """What the lines of each frame tell, and its fit, as if it were determined and as if it were not."""
    known, *fits = _over_frames(_of_model(undescribed_fit, model), lines, frames, *minima)
    return known, [fit for fit, _ in fits]


@light_program
def _collected(lines, frames, either, covariance, determined):
    """The fits of `_undescribed` with their covariances, and their outcome."""
    fits = jax.vmap(lambda so, *fits: jax.tree.map(functools.partial(jnp.where, so), *fits))(
        determined, *either
    )
    return _with_outcome(lines, frames, eqx.tree_at(lambda fit: fit.covariance, fits, covariance))


def _of_model(describe, model):
    """A description of the fit of one frame, from its parameters."""

    def of_frame(frame, parameters, result, steps):
        return describe(frame, ready_model(frame, model).with_parameters(parameters).zoom, result, steps)

    return of_frame


def _with_outcome(lines, frames, fits):
    each = collected(lines, fits, frames.there)
    return each, outcome_of(each)


def _over_frames(function, lines, frames, *rows):
    """A function of the lines of a frame, and of what there is of it, for all frames.

    Small compressed frames are taken side by side; the points themselves one frame at a time, for side by
    side they would all be in memory at once, padded to the fullest frame.
    """

    def one(frame):
        chosen, rows = frame
        return function(lines.take(*chosen), *rows)

    each = (frames.chosen, frames.present), rows
    return jax.lax.map(one, each) if isinstance(data_of(lines), Lines) else jax.vmap(one)(each)


@program
def _refit_frames(lines, frames, model, free):
    """Each frame's fit, refitted to be invertible where it is not."""

    def fit(chosen, present, result, coefficients):
        frame = lines.take(chosen, present)
        constant = ready_model(frame, model).with_parameters(coefficients[None])
        own = described_fit(frame, constant.zoom, result, jnp.asarray(0))
        other, _ = refit_zoom(frame, own)
        keep = is_invertible(own)
        return jax.tree.map(lambda own, other: jnp.where(keep, own, other), own, other)

    fits = jax.vmap(fit)(frames.chosen, frames.present, free.result, free.coefficients)
    each = collected(lines, fits, frames.there)
    return each, outcome_of(each)
