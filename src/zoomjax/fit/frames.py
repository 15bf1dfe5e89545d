"""Separate fits of each frame (eq. 3 and 6).

The fit of one frame is a zoom polynomial of degree 0 on the lines of that frame, so that the solver of
`zoom` is used, frame after frame.
"""

import jax
import jax.numpy as jnp
import numpy as np

from .._core.arguments import kinds_checked
from .._core.programs import begin, light_program, program, rare_program
from ..lines.base import AbstractLines
from ..lines.buckets import bucketed_frames
from ..lines.lines import Lines
from ..models.distortion_model import AbstractDistortionModel
from ..models.zoom import PolynomialZoom
from ._least_squares import Solver, default_solver
from .algebraic import algebraic_parameters, algebraic_start
from .centre import fit_frame_centres
from .compression import compressed_as_measured
from .constrained import or_else, refit_zoom
from .minimise import ended_like, minimise
from .prepare import asked_for, ready_model
from .problem import data_of
from .result import FrameFits, collected, described_fit, each_of_given, is_invertible, outcome_of, thrown
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
    number = len(frames.chosen)
    like = np.zeros((number, 1, model.num_coefficients), lines.focal.dtype)
    ended = jax.tree.map(lambda of: np.zeros(number, of.dtype), ended_like(None)[1:])
    begin(
        (_described, (lines, frames, model, like, *ended)),
        (_minima, (lines, frames, model, None if start is None else like, solver, max_steps)),
    )
    parameters = None if start is None else _starts(start, frames, model)
    minima = _minima(lines, frames, model, parameters, solver, max_steps)
    return _described(lines, frames, model, *minima)


@light_program
def _starts(lines, frames, model):
    """The parameters that each frame's algebraic estimate gives."""

    def start(frame):
        return algebraic_parameters(frame, ready_model(frame, model))

    return _over_frames(start, lines, frames)


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
def _described(lines, frames, model, parameters, result, steps):
    def describe(frame, parameters, result, steps):
        return described_fit(
            frame, ready_model(frame, model).with_parameters(parameters).zoom, result, steps
        )

    fits = _over_frames(describe, lines, frames, parameters, result, steps)
    each = collected(lines, fits, frames.there)
    return each, outcome_of(each)


def _over_frames(function, lines, frames, *rows):
    """A function of the lines of a frame, and of what there is of it, for all frames.

    On a CPU one after the other: side by side, under ``vmap``, they take twice as long to compile and no
    less to run, as the solver goes on until the last frame is done. The points themselves so on any device,
    for side by side they would all be in memory at once, padded to the fullest frame.
    """

    def one(frame):
        chosen, rows = frame
        return function(lines.take(*chosen), *rows)

    each = (frames.chosen, frames.present), rows
    in_turn = jax.default_backend() == "cpu" or isinstance(data_of(lines), Lines)
    return jax.lax.map(one, each) if in_turn else jax.vmap(one)(each)


@program
def _refit_frames(lines, frames, model, free):
    """Each frame's fit, refitted to be invertible where it is not."""

    def fit(frame, result, coefficients):
        constant = ready_model(frame, model).with_parameters(coefficients[None])
        own = described_fit(frame, constant.zoom, result, jnp.asarray(0))
        return jax.lax.cond(is_invertible(own), lambda: own, lambda: refit_zoom(frame, own)[0])

    fits = _over_frames(fit, lines, frames, free.result, free.coefficients)
    each = collected(lines, fits, frames.there)
    return each, outcome_of(each)
