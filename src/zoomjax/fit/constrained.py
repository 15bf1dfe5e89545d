"""Refit under the constraint of invertibility, if the best model is not invertible.

A model that is not certified to be invertible is replaced by the best one that is: the same energy is
minimised again, the slope of the radius kept above `LEAST_SLOPE` all over the image and focal range, by an
interior-point method. For a linear zoom model the inequalities are linear, and hold without distortion.
"""

from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from .._core.programs import program
from .._core.types import traced
from ..models.invertibility import slope_controls
from ..models.zoom import AbstractLinearZoom, with_parameters
from ._interior import implicit, least_squares_within
from .energy import coefficients_by, prior_residuals, residuals
from .result import RESULTS, described_fit, lens_of, outcome_of

LEAST_SLOPE = 0.02
"""What the slope of the radius is kept above where a fit has to be made invertible: the inverse then
magnifies distances at most 50 times. Real lenses are far from it (the Nikkor 18-200 of the paper: 0.91)."""

_MOST_STEPS = 200
"""Of the interior-point method, which takes 10 to 20."""


@program
def refit_zoom(lines, free):
    """The best invertible model."""
    zoom = free.lens.zoom
    if not free.certificate.stated:  # there is nothing to demand
        return free, outcome_of(free)
    nothing = jax.tree.map(jnp.zeros_like, zoom.parameters)
    if not isinstance(zoom, AbstractLinearZoom):
        terms = jax.eval_shape(coefficients_by, zoom, lines).shape[1]
        nothing = zoom.prepare(jnp.asarray(lines.focal), terms).parameters
    start, unravel = ravel_pytree(nothing)

    def functions(lines, zoom):
        def errors(flat):
            model = with_parameters(zoom, unravel(flat))
            distances = residuals(lines, coefficients_by(model, lines)).reshape(-1)
            prior = prior_residuals(lines, model)
            return distances if prior is None else jnp.concatenate([distances, prior])

        def slack(flat):
            return slope_controls(lens_of(lines, with_parameters(zoom, unravel(flat)))) - LEAST_SLOPE

        return errors, slack

    constant = functions(*jax.lax.stop_gradient((lines, zoom)))
    flat, strength, reached, steps = least_squares_within(*constant, start, _MOST_STEPS)
    errors, slack = functions(lines, zoom)
    flat = implicit(lambda flat: jnp.sum(errors(flat) ** 2) / 2, slack, flat, strength)
    good: Any = RESULTS.successful  # inherited members, which pyright takes for another class's
    unfinished: Any = RESULTS.nonlinear_max_steps_reached
    # Curved inequalities, of models that are not linear, may keep it from the last digits.
    near_enough = reached | (not isinstance(zoom, AbstractLinearZoom))
    result = RESULTS.where(near_enough, good, unfinished)
    fit = described_fit(lines, with_parameters(zoom, unravel(flat)), result, free.steps + steps)
    result = RESULTS.where(fit.result == good, RESULTS.constrained, fit.result)
    fit = eqx.tree_at(lambda fit: (fit.result, fit.rms_unconstrained), fit, (result, free.rms))
    return fit, outcome_of(fit)


def or_else(fit, outcome, other):
    """The fit and its outcome where it is invertible, and otherwise another, not even begun where it is.

    Under `vmap` it is begun if one of the batch needs it, and then for all: a condition on the batch as a
    whole stays one, where a condition of each would make XLA compute both ways for all, always.
    """
    invertible, _ = outcome
    if not traced(invertible):
        return (fit, outcome) if invertible else other()

    def chosen():
        return jax.tree.map(lambda own, new: jnp.where(invertible, own, new), (fit, outcome), other())

    return jax.lax.cond(eqxi.unvmap_all(invertible), lambda: (fit, outcome), chosen)
