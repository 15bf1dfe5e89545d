"""Fits of zoom models: minimisation of the global energy (eq. 13).

The unknowns are the parameters of the zoom model alone, as the lines are eliminated (`energy`). Solvers are
those of optimistix, with Jacobians by automatic differentiation. A fitted model is differentiable with
respect to the points by the implicit function theorem. A model that is not certified to be invertible is
refitted under that constraint (`constrained`).

Compiled once for a shape of the lines; once per fit an algebraic start and, after it, the covariance and
the certificate; per iteration one Jacobian of the residuals.
"""

import equinox as eqx
import jax
import optimistix as optx

from .._core.arguments import kinds_checked
from ..lines.base import AbstractLines
from ..models.family import AbstractFamily
from ..models.zoom import AbstractLinearZoom, AbstractZoom, PolynomialZoom, with_parameters
from ._least_squares import Solver, default_solver
from .algebraic import algebraic_parameters
from .constrained import or_else, refit_zoom
from .energy import coefficients_by, prior_residuals, residuals
from .family_lines import with_family
from .prepare import algebraic_start, compressed_as_measured, ready_model
from .result import ZoomFit, described_fit, outcome_of, thrown


@kinds_checked
def fit_zoom(
    lines: AbstractLines,
    *,
    zoom: AbstractZoom | None = None,
    family: AbstractFamily | None = None,
    terms: int | None = None,
    solver: Solver | None = None,
    max_steps: int = 256,
    invertible: bool = True,
    throw: bool = True,
) -> ZoomFit:
    """Fit a zoom lens: the zoom model of least global energy (eq. 13), by default among invertible ones.

    Args:
        lines: the lines, or, much faster and with the same result, ``compress(lines)``.
        zoom: the zoom model; `PolynomialZoom` of degree 2 by default. If it has parameters, the solver
            starts there. Otherwise it starts from the algebraic estimate if the model is linear and the
            distortion model is the radial polynomial, else from no distortion.
        family: the distortion model: `RadialPolynomial` (eq. 2) unless the lines have another one
            (`compress_family`); or `Division`, or `BrownConrady`, which has two additional coefficients.
        terms: the number N of radial distortion coefficients (eq. 2): by default 2, or as many as a `zoom`
            with parameters has.
        solver: any optimistix least-squares solver or minimiser; Levenberg-Marquardt by default, with
            tolerances for the dtype of the lines.
        max_steps: the maximum number of solver steps.
        invertible: whether a model that is not certified to be invertible over the whole image and the
            range of focal lengths is refitted under that constraint, with a slope of the radius (see
            `Certificate`) of at least 0.02. A certified model is returned unchanged, bit for bit. This has
            no effect on zoom models that do not state their `pieces`. For a `PowerZoom`, which is not
            linear, the refitted model is invertible but not necessarily the best, and with a distortion
            model other than the polynomial it has no proof. Under ``vmap`` the refit runs for the whole
            batch if one fit needs it, and not at all if none does.
        throw: whether to raise if the solver fails. Otherwise see `ZoomFit.result`. Results about the model
            (undetermined, folded, constrained) never raise.

    Raises:
        ValueError: there are fewer distinct focal lengths than the zoom model needs, the lines were
            compressed for fewer terms, or the parameters of `zoom` are for another number of terms.
        TypeError: an argument has the wrong type, such as the class PolynomialZoom instead of an instance.
        RuntimeError: the solver failed (see `throw`).

    Example:
        >>> import jax.numpy as jnp, numpy as np
        >>> from zoomjax import Lines, compress
        >>> t = np.linspace(0.0, 479.0, 50)
        >>> bent = [np.stack([x + f * (t / 240 - 1) ** 2, t], axis=-1) for f in (1, 2) for x in (9, 599)]
        >>> lines = Lines.from_ragged(bent, [0, 0, 1, 1], [50, 100], image_size=(640, 480))
        >>> fit = fit_zoom(compress(lines), zoom=PolynomialZoom(degree=1), terms=1)
        >>> bool(fit.rms < 1)
        True
    """
    lines = lines if family is None else with_family(lines, family)
    model, terms = ready_model(lines, PolynomialZoom() if zoom is None else zoom, terms)
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
        return residuals(lines, coefficients_by(zoom, lines)), prior_residuals(lines, zoom)

    start = jax.tree.map(jax.lax.stop_gradient, zoom.parameters)
    solution = optx.least_squares(
        function, solver, start, args=(lines, zoom), max_steps=max_steps, throw=False
    )
    return with_parameters(zoom, solution.value), solution.result, solution.stats["num_steps"]
