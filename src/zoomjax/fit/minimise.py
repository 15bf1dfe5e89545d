"""Minimisation of the global energy (eq. 13) over the parameters of a zoom model, and the fit around it.

Compiled once for a shape of the lines; once per fit an algebraic start and, after it, the covariance and
the certificate; per iteration one Jacobian of the residuals.
"""

import equinox as eqx
import jax
import optimistix as optx

from ..models.zoom import AbstractLinearZoom, with_parameters
from ._least_squares import default_solver
from .algebraic import algebraic_parameters
from .constrained import or_else, refit_zoom
from .energy import coefficients_by, prior_residuals, weighted_distances
from .prepare import algebraic_start, compressed_as_measured, ready_model
from .result import described_fit, outcome_of, thrown


def fit_about(lines, zoom=None, terms=None, *, solver=None, max_steps=256, invertible=True, throw=True):
    """`fit_zoom` about the centre of the lines, under their own distortion model."""
    model, terms = ready_model(lines, zoom, terms)
    start = None
    if isinstance(model, AbstractLinearZoom) and (zoom is None or zoom.parameters is None):
        start = algebraic_start(lines, terms)
    solver = default_solver(lines) if solver is None else solver
    fit, outcome = fit_prepared(lines, start, model, terms, solver, max_steps)
    if invertible:
        fit, outcome = or_else(fit, outcome, lambda: refit_zoom(compressed_as_measured(lines, terms), fit))
    return thrown(fit, outcome, throw)


@eqx.filter_jit
def fit_prepared(lines, start, zoom, terms, solver, max_steps):
    """The fit of a prepared model, and its outcome."""
    if start is not None:
        zoom = with_parameters(zoom, algebraic_parameters(start, zoom, terms))
    zoom, result, steps = minimise(lines, zoom, solver, max_steps)
    fit = described_fit(lines, zoom, result, steps)
    return fit, outcome_of(fit)


def minimise(lines, zoom, solver, max_steps):
    """The model at the minimum of the global energy, from its own parameters as the start."""

    def function(parameters, args):
        lines, zoom = args
        zoom = with_parameters(zoom, parameters)
        return weighted_distances(lines, coefficients_by(zoom, lines)), prior_residuals(lines, zoom)

    start = jax.tree.map(jax.lax.stop_gradient, zoom.parameters)
    solution = optx.least_squares(
        function, solver, start, args=(lines, zoom), max_steps=max_steps, throw=False
    )
    return with_parameters(zoom, solution.value), solution.result, solution.stats["num_steps"]
