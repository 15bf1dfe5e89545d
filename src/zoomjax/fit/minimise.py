"""Minimisation of the global energy (eq. 13) over the parameters of a zoom model, and the fit around it.

Compiled once for a shape of the lines; once per fit an algebraic start and, after it, the covariance and
the certificate; per iteration one pass over the lines' rows, of which the solver sees `frame_residuals`.
"""

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx

from .._core.programs import begin, light_program, program
from .._core.types import traced
from ..models.zoom import with_parameters
from ._least_squares import default_solver
from .algebraic import algebraic_model, algebraic_start
from .compression import compressed_as_measured
from .constrained import or_else, refit_zoom
from .covariance import are_by_numpy
from .energy import coefficients_by, prior_residuals
from .frame_residuals import frame_residuals
from .result import described_fit, fit_without_covariance, outcome_of, thrown, with_covariance


def fit_about(lines, model, *, algebraic, solver=None, max_steps=256, invertible=True, throw=True):
    """`fit_zoom` of a prepared model about the centre of the lines, which are under its distortion model.

    It starts from the algebraic estimate, if it is to and there is one, or else from its parameters.
    """
    solver = default_solver(lines) if solver is None else solver
    fit, outcome = fit_freely(lines, model, algebraic, solver, max_steps)
    if invertible:
        fit, outcome = or_else(
            fit, outcome, lambda: refit_zoom(compressed_as_measured(lines, model.terms), fit)
        )
    return thrown(fit, outcome, throw)


def fit_freely(lines, model, algebraic, solver, max_steps):
    """The fit that `fit_about` begins with, whether invertible or not, and its outcome."""
    if not traced((lines, model)):
        after = _without_covariance if are_by_numpy(lines, model.zoom) else _described_by_jax
        begin(
            (minimised, (lines, model.zoom, solver, max_steps)),
            (after, (lines, *ended_like(model.zoom))),
        )
    if algebraic and (start := algebraic_start(lines, model)) is not None:
        model = algebraic_model(start, model)
    return fit_prepared(lines, model, solver, max_steps)


def ended_like(zoom):
    """What `minimise` of such a model gives, but for its numbers."""
    return zoom, optx.RESULTS.successful, np.zeros((), int)


def fit_prepared(lines, model, solver, max_steps):
    """The fit of a prepared model from its own parameters, and its outcome."""
    return described(lines, *minimised(lines, model.zoom, solver, max_steps))


def described(lines, *ended):
    """The fit that ended so, and its outcome: once after the steps.

    Of few known lines the covariance is NumPy's, so that less is compiled.
    """
    if not traced(ended) and are_by_numpy(lines, ended[0]):
        found = with_covariance(*_without_covariance(lines, *ended))
        if found is not None:
            return found
    return _described_by_jax(lines, *ended)


@light_program
def _described_by_jax(lines, zoom, result, steps):
    fit = described_fit(lines, zoom, result, steps)
    return fit, outcome_of(fit)


_without_covariance = light_program(fit_without_covariance)


def minimise(lines, zoom, solver, max_steps):
    """The model at the minimum of the global energy, from its own parameters as the start."""

    def function(parameters, args):
        lines, zoom = args
        zoom = with_parameters(zoom, parameters)
        return frame_residuals(lines, coefficients_by(zoom, lines)), prior_residuals(lines, zoom)

    start = jax.tree.map(jax.lax.stop_gradient, zoom.parameters)
    adjoint = optx.ImplicitAdjoint(lx.AutoLinearSolver(well_posed=False))  # the undetermined does not move
    solution = optx.least_squares(
        function,
        solver,
        start,
        args=(lines, zoom),
        max_steps=max_steps,
        adjoint=adjoint,
        throw=False,
    )
    steps = jnp.asarray(solution.stats["num_steps"])
    return with_parameters(zoom, solution.value), solution.result, steps.astype(steps.dtype)  # not weak


minimised = program(minimise)
"""`minimise`, compiled."""
